"""In vacuum: rays that carry the number of the voxel they left, and which of these elements read (see `transport.links`)."""

from __future__ import annotations

from .evolution import begin_batch, most_laps
from .paths import chords, compiled, join_ends, turn
from .readers import form_of, marked, tilt


@compiled
def _through(cells, k, number, way, before, after, margin, sent):
    """One segment through the voxels that surfaces cut."""
    for j in range(cells.first[k], cells.first[k + 1]):
        slope = tilt(cells.plane, j, way.step[0], way.step[1], way.step[2])
        g0 = cells.plane[0, j] + tilt(cells.plane, j, way.begin[number, 0], way.begin[number, 1], way.begin[number, 2])
        if g0 < 0 or g0 + way.share[number] * slope < 0:
            after[margin + cells.cell[j]] = sent[j]
        else:
            after[margin + cells.cell[j]] = before[margin - way.move[number] + cells.cell[j]]


@compiled
def _note(paths, readers, ways, n, k, count, way, rows, margin, cells, sent, manner, form, seen, source, weight):
    """Add what elements of a plane see in one direction to their lists, as far as these reach; `seen` counts it all."""
    for r in range(readers.runs[k], readers.runs[k + 1]):
        along = tilt(readers.face, r, ways.toward[n, 0], ways.toward[n, 1], ways.toward[n, 2])
        if along >= 0:
            continue
        first, last = readers.first[r], readers.first[r + 1]
        if last == first + 1 and not marked(readers.bits, n, first):
            continue
        if not form_of(paths, readers, r, 0.0, count, way, 0.0, 0.0, cells, manner, form):
            continue
        for m in range(first, last):
            if not marked(readers.bits, n, m):
                continue
            for number in range(4):
                share = form[7 if number == 3 else number] if number == 3 or number < count else 0.0
                if share == 0:
                    continue
                code = sent[readers.cut[r]]
                if number < 3:
                    code = rows[way.row[number], margin - way.move[number] + readers.cell[m]]
                if code > 0:
                    if seen[m] < source.shape[1]:
                        source[m, seen[m]], weight[m, seen[m]] = code, -along * ways.weight[n] * share
                    seen[m] += 1


@compiled
def views(chosen, ways, planes, cut, ghosts, hits, probes, manner, work, of_cut, of_ghosts, of_hits, of_probes):
    """What hits and probes see in the `chosen` directions: (seen, source, weight) of each, [M], [M, S], [M, S].

    `of_cut` and `of_ghosts` are the numbers of listed voxels, 0 for those that send nothing.
    """
    count, size, margin = planes.even.shape[0], planes.height * planes.width, planes.width
    rows, way, own, free, form = work.rows, work.way, work.own, work.free, work.form
    most = len(own)
    for first in range(0, len(chosen), most):
        batch = chosen[first : first + most]
        begin_batch(work)
        for when in range(-(most_laps(ways, batch) - 1) * count, count):
            for sense in (1, -1):
                k = when % count if sense > 0 else count - 1 - when % count
                for b in range(len(batch)):
                    n = batch[b]
                    if ways.sense[n] != sense or when < -(ways.laps[n] - 1) * count:
                        continue
                    segments = chords(ways, n, when, planes.width, planes.wrap_v, way)
                    row = way.row
                    row[0], row[1], row[2], row[3] = own[b], free[0], free[1], free[2]
                    for number in range(segments):
                        if planes.wrap_v and abs(way.move[number]) == 1 and planes.width > 1:
                            turned = free[3]
                            turn(rows[row[number]], rows[turned], way.move[number], planes.height, planes.width)
                            free[3], free[number - 1] = row[number], turned
                            row[number], way.move[number] = turned, 0
                        before, after, move = rows[row[number]], rows[row[number + 1]], way.move[number]
                        come, gone = before[margin - move : margin - move + size], after[margin : margin + size]
                        for i in range(size):
                            gone[i] = come[i]
                        _through(cut, k, number, way, before, after, margin, of_cut)
                        for j in range(ghosts.first[k], ghosts.first[k + 1]):
                            after[margin + ghosts.cell[j]] = of_ghosts[j]
                        join_ends(after, margin, size)
                    if when >= 0:
                        there = rows, margin, cut, of_cut, manner, form
                        _note(False, hits, ways, n, k, segments, way, *there, *of_hits)
                        _note(True, probes, ways, n, k, segments, way, *there, *of_probes)
                    own[b], free[segments - 1] = free[segments - 1], own[b]
