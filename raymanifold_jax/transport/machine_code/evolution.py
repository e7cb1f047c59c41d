"""A coordinate evolution along one axis through a medium, and the transpose, with a medium or without."""

from __future__ import annotations

from numba.extending import register_jitable

from .arguments import TOGETHER
from .compiling import compiled, inlined
from .cut import back_cut, give_cut, keep_cut, put_cut, take_cut, through_cut
from .paths import chords, join_ends, of_one, turn
from .readers import ask, read
from .voxels import from_ghosts, light_of_ghosts, rays_of, through_free
from .voxels_back import back_free, back_ghosts


@register_jitable
def most_laps(ways, batch):
    laps = 1
    for n in batch:
        laps = max(laps, ways.laps[n])
    return laps


@compiled
def begin_batch(work):
    rows, most = work.rows, len(work.own)
    for b in range(len(rows)):
        for i in range(rows.shape[1]):
            rows[b, i] = 0
    for b in range(most):
        work.own[b] = b
    for g in range(len(work.free)):
        for i in range(4):
            work.free[g, i] = most + 4 * g + i


@compiled
def _those_passing(ways, batch, sense, laps, passing):
    """Write which of a batch go this way, on so many laps or more, to `passing`; how many."""
    count = 0
    for b in range(len(batch)):
        if ways.sense[batch[b]] == sense and ways.laps[batch[b]] >= laps:
            passing[count] = b
            count += 1
    return count


@inlined
def _set_out(batch, group, ways, when, k, c, planes, ghosts, light, work):
    """Begin with a plane for a group of directions; the most segments that one of them has there."""
    most = 0
    for g in range(len(group)):
        n, way = batch[group[g]], of_one(work.way, g)
        work.count[g] = chords(ways, n, when, planes.width, planes.wrap_v, way)
        work.length[g], work.weight[g] = planes.spacing / abs(ways.toward[n, 0]), ways.weight[n]
        light_of_ghosts(ghosts, k, c, n, ways, light, work.sent[g])
        way.row[0] = work.own[group[g]]
        for i in range(3):
            way.row[1 + i] = work.free[g, i]
        most = max(most, work.count[g])
    for g in range(len(group), TOGETHER):  # as if there were one more, that carries no light
        way = of_one(work.way, g)
        work.count[g], work.length[g], work.weight[g], way.row[0] = 0, 0.0, 0.0, work.free[g, 3]
        for i in range(3):
            way.share[i], way.move[i], way.row[1 + i] = 0.0, 0, work.free[g, i]
    return most


@inlined
def _turn_all(number, many, planes, work):
    """Where each row's ends are joined, steps along v are no moves of the whole plane."""
    rows, free = work.rows, work.free
    for g in range(many):
        way = of_one(work.way, g)
        if number < work.count[g] and abs(way.move[number]) == 1:
            turned = free[g, 3]
            turn(rows[way.row[number]], rows[turned], way.move[number], planes)
            free[g, 3], free[g, number - 1] = way.row[number], turned  # there is no move before the first segment
            way.row[number], way.move[number] = turned, 0


def forwards(chosen, ways, planes, cut, ghosts, hits, probes, light, manner, work, at_hits, at_probes, in_voxels):
    """One coordinate evolution in the `chosen` directions along one axis; adds to the sums [C, M], [C, M2] and [K, C, P]."""
    count, bands, size = planes.even.shape[0], planes.even.shape[1], planes.height * planes.width
    rows, here, own, free = work.rows, work.here, work.own, work.free
    for first in range(0, len(chosen), len(own)):
        batch = chosen[first : first + len(own)]
        laps = most_laps(ways, batch)
        for c in range(bands):
            begin_batch(work)
            for when in range(-(laps - 1) * count, count):
                reading = when >= 0
                # Batches may hold both senses: those of one sense go together.
                for sense in (1, -1):
                    k = when % count if sense > 0 else count - 1 - when % count
                    sums = in_voxels[k, c] if reading and manner.fluence else work.nowhere
                    dark = ghosts.first[k + 1] - ghosts.first[k] == size
                    take_cut(cut, k, c, light, True, sums, manner, here)
                    passing = _those_passing(ways, batch, sense, 1 - when // count, work.passing)
                    for begun in range(0, passing, TOGETHER):
                        group = work.passing[begun : min(begun + TOGETHER, passing)]
                        many = len(group)
                        segments = _set_out(batch, group, ways, when, k, c, planes, ghosts, light, work)
                        for number in range(segments):
                            if planes.wrap_v and planes.width > 1:
                                _turn_all(number, many, planes, work)
                            if not dark:
                                through_free(planes, k, c, number, many, light, manner, work, sums)
                            for g in range(many):
                                if number < work.count[g]:
                                    way, come, gone = of_one(work.way, g), *rays_of(g, number, planes, work)
                                    path = work.length[g], come, gone, manner, here, work.weight[g]
                                    through_cut(cut, k, number, way, *path)
                                    from_ghosts(ghosts, k, gone, work.sent[g])
                                    join_ends(rows[way.row[number + 1]], planes)
                        for g in range(many):
                            b, way, last = group[g], of_one(work.way, g), work.count[g]
                            if reading:
                                there = work.length[g], planes.margin, light, planes.spacing, manner, work
                                read(False, hits, ways, batch[b], k, c, last, way, *there, at_hits)
                                read(True, probes, ways, batch[b], k, c, last, way, *there, at_probes)
                            own[b], free[g, last - 1] = free[g, last - 1], way.row[0]
                    put_cut(cut, k, sums, here)


def backwards(chosen, ways, planes, cut, ghosts, hits, probes, manner, work, of_hits, of_probes, in_voxels, back):
    """The transpose of `forwards`: adds to `back` what weights of its three sums ask of what was sent."""
    count, bands, size = planes.even.shape[0], planes.even.shape[1], planes.height * planes.width
    margin = planes.margin
    rows, way, here, own, free = work.rows, of_one(work.way, 0), work.here, work.own, work.free[0]
    asked, most = work.asked, len(own)
    for first in range(0, len(chosen), most):
        batch = chosen[first : first + most]
        laps = most_laps(ways, batch)
        for c in range(bands):
            begin_batch(work)
            for when in range(count - 1, -(laps - 1) * count - 1, -1):
                reading = when >= 0
                for sense in (1, -1):
                    k = when % count if sense > 0 else count - 1 - when % count
                    wanted = in_voxels[k, c] if reading and manner.fluence else work.nowhere
                    dark = ghosts.first[k + 1] - ghosts.first[k] == size
                    keep_cut(cut, k, c, wanted, back, manner, here)
                    for b in range(len(batch)):
                        n = batch[b]
                        if ways.sense[n] != sense or when < -(ways.laps[n] - 1) * count:
                            continue
                        length = planes.spacing / abs(ways.toward[n, 0])
                        segments = chords(ways, n, when, planes.width, planes.wrap_v, way)
                        for number in range(segments):
                            for i in range(size):
                                asked[number, i] = 0
                        if reading:
                            there = length, back, cut.first[k], planes.spacing, manner, work
                            ask(False, hits, ways, n, k, c, segments, way, *there, of_hits)
                            ask(True, probes, ways, n, k, c, segments, way, *there, of_probes)
                        move = 0  # from the voxels that rays come to after a segment to those they left
                        for number in range(segments - 1, -1, -1):
                            after, before, ask_of = rows[own[b]], rows[free[0]], asked[number]
                            gone, come = after[margin + move : margin + move + size], before[margin : margin + size]
                            weight = ways.weight[n]
                            if not dark:
                                of_plane = gone, come, ask_of, wanted, back, manner, work, weight
                                back_free(planes, k, c, number, way, length, *of_plane)
                            back_cut(cut, k, number, way, length, gone, come, ask_of, manner, here, weight)
                            back_ghosts(ghosts, k, c, gone, come, ask_of, back.ghost)
                            join_ends(before, planes)
                            own[b], free[0] = free[0], own[b]
                            move = way.move[number]  # none before the first
                            if planes.wrap_v and abs(move) == 1 and planes.width > 1:
                                turn(rows[own[b]], rows[free[0]], -move, planes)
                                own[b], free[0], move = free[0], own[b], 0
                    give_cut(cut, k, c, back, manner, here)
