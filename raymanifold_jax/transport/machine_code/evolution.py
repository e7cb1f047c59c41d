"""A coordinate evolution along one axis through a medium, and the transpose, with a medium or without."""

from __future__ import annotations

from numba.extending import register_jitable

from .compiling import compiled
from .cut import back_cut, give_cut, keep_cut, put_cut, take_cut, through_cut
from .paths import chords, join_ends, turn
from .readers import ask, read
from .voxels import from_ghosts, light_of_ghosts, through_free
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
        if b < most:
            work.own[b] = b
        else:
            work.free[b - most] = b


def forwards(chosen, ways, planes, cut, ghosts, hits, probes, light, manner, work, at_hits, at_probes, in_voxels):
    """One coordinate evolution in the `chosen` directions along one axis; adds to the sums [C, M], [C, M2] and [K, C, P]."""
    count, bands, size = planes.even.shape[0], planes.even.shape[1], planes.height * planes.width
    margin = planes.margin
    rows, way, here, own, free = work.rows, work.way, work.here, work.own, work.free
    most = len(own)
    for first in range(0, len(chosen), most):
        batch = chosen[first : first + most]
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
                    for b in range(len(batch)):
                        n = batch[b]
                        if ways.sense[n] != sense or when < -(ways.laps[n] - 1) * count:
                            continue
                        length = planes.spacing / abs(ways.toward[n, 0])
                        segments = chords(ways, n, when, planes.width, planes.wrap_v, way)
                        light_of_ghosts(ghosts, k, c, n, ways, light, work.sent)
                        weight, row = ways.weight[n], way.row
                        row[0], row[1], row[2], row[3] = own[b], free[0], free[1], free[2]
                        for number in range(segments):
                            if planes.wrap_v and abs(way.move[number]) == 1 and planes.width > 1:
                                turned = free[3]
                                turn(rows[row[number]], rows[turned], way.move[number], planes)
                                free[3], free[number - 1] = row[number], turned
                                row[number], way.move[number] = turned, 0
                            before, after = rows[row[number]], rows[row[number + 1]]
                            move = way.move[number]
                            come, gone = before[margin - move : margin - move + size], after[margin : margin + size]
                            if not dark:
                                through_free(planes, k, c, number, way, length, come, gone, light, manner, work, sums, weight)
                            through_cut(cut, k, number, way, length, come, gone, manner, here, weight)
                            from_ghosts(ghosts, k, gone, work.sent)
                            join_ends(after, planes)
                        if reading:
                            there = length, margin, light, planes.spacing, manner, work
                            read(False, hits, ways, n, k, c, segments, way, *there, at_hits)
                            read(True, probes, ways, n, k, c, segments, way, *there, at_probes)
                        own[b], free[segments - 1] = free[segments - 1], own[b]
                    put_cut(cut, k, sums, here)


@compiled
def _moved_back(row, to, move, planes, size):
    """What was asked of the rays after a move, of the rays before it."""
    margin = planes.margin
    if planes.wrap_v and abs(move) == 1 and planes.width > 1:
        turn(row, to, -move, planes)
        return
    for i in range(size):
        to[margin + i] = row[margin + i + move]
    join_ends(to, planes)


def backwards(chosen, ways, planes, cut, ghosts, hits, probes, manner, work, of_hits, of_probes, in_voxels, back):
    """The transpose of `forwards`: adds to `back` what weights of its three sums ask of what was sent."""
    count, bands, size = planes.even.shape[0], planes.even.shape[1], planes.height * planes.width
    margin = planes.margin
    rows, way, here, own, free = work.rows, work.way, work.here, work.own, work.free
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
                        for number in range(segments - 1, -1, -1):
                            after, before, ask_of = rows[own[b]], rows[free[0]], asked[number]
                            gone, come = after[margin : margin + size], before[margin : margin + size]
                            weight = ways.weight[n]
                            if not dark:
                                of_plane = gone, come, ask_of, wanted, back, manner, work, weight
                                back_free(planes, k, c, number, way, length, *of_plane)
                            back_cut(cut, k, number, way, length, gone, come, ask_of, manner, here, weight)
                            back_ghosts(ghosts, k, c, gone, come, ask_of, back.ghost)
                            join_ends(before, planes)
                            own[b], free[0] = free[0], own[b]
                            move = way.move[number]
                            if move:
                                _moved_back(rows[own[b]], rows[free[0]], move, planes, size)
                                own[b], free[0] = free[0], own[b]
                    give_cut(cut, k, c, back, manner, here)
