"""A coordinate evolution where nothing attenuates.

A ray keeps its place in memory, and what changes is only which voxel it is in: that of voxel i is at i - shift, and every move
adds to the shift. So a plane costs what its CUT voxels, ghosts and readers do, and, where the sums in voxels are asked for, one
multiplication a voxel and segment.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from .arguments import BLOCK, ROWS
from .compiling import compiled, inlined
from .cut import place, put_cut, take_cut, through_cut_in_vacuum
from .evolution import most_laps
from .paths import chords
from .readers import add_each, forms_of, pick_marked, take_cut_numbers, tilt
from .voxels import light_of_ghosts


@compiled
def _carry(row, shift, move, planes):
    """The shift after a move; where the ends of rows are joined, the rays of one column are handed on to the next row's."""
    height, width = planes.height, planes.width
    size = height * width
    shift = (shift + move) % size
    if planes.wrap_v and width > 1:
        if move == 1:
            first = row[place(0, shift, size)]
            for u in range(height - 1):
                row[place(u * width, shift, size)] = row[place((u + 1) * width, shift, size)]
            row[place(size - width, shift, size)] = first
        elif move == -1:
            last = row[place(size - 1, shift, size)]
            for u in range(height - 1, 0, -1):
                row[place((u + 1) * width - 1, shift, size)] = row[place(u * width - 1, shift, size)]
            row[place(width - 1, shift, size)] = last
    return shift


@register_jitable
def _picked(reading, hits, probes, n, k, picked):
    """Hits and probes of a plane that read in a direction; none of them on the laps before."""
    if not reading:
        return picked[0, :0], picked[1, :0]
    many = pick_marked(hits.bits, n, hits.first[hits.runs[k]], hits.first[hits.runs[k + 1]], picked[0])
    more = pick_marked(probes.bits, n, probes.first[probes.runs[k]], probes.first[probes.runs[k + 1]], picked[1])
    return picked[0, :many], picked[1, :more]


# Loops of their own, which take few arrays: in a long function their addresses would be fetched anew in every turn.


@compiled
def _take_rays(cell, picked, row, shift, seen):
    """Keep the rays of one segment that readers ask for: they may be other ones after it."""
    for i in range(len(picked)):
        seen[i] = row[place(cell[picked[i]], shift, len(row))]


@compiled
def _add_to(sums, row, weight):
    w = row.dtype.type(weight)
    for i in range(len(sums)):
        sums[i] += w * row[i]


@compiled
def _put_rays(cell, row, shift, sent):
    """Let rays begin in listed voxels."""
    size = len(row)
    if len(cell) == size:  # all of the plane, in order
        for i in range(shift):
            row[np.uintp(size - shift + i)] = sent[i]
        for i in range(size - shift):
            row[i] = sent[np.uintp(shift + i)]
        return
    for i in range(len(cell)):
        row[place(cell[i], shift, size)] = sent[i]


@compiled
def _begin_batch(work, count):
    for b in range(count):
        work.shift[b] = 0
        for i in range(work.rows.shape[1]):
            work.rows[b, i] = 0


@compiled
def _add_times(total, form, seen):
    for i in range(len(total)):
        total[i] += form[i] * seen[i]


@inlined
def _read(paths, readers, picked, ways, n, count, way, seen, emitted, manner, form, at, sums):
    """Add what elements read of one direction in a plane, as the mean of free `paths` or else of hits."""
    for first in range(0, len(picked), BLOCK):
        last = min(first + BLOCK, len(picked))
        readers_here, size = picked[first:last], last - first
        forms_of(paths, readers, ways, n, 0, readers_here, count, way, 0.0, 0.0, manner, form)
        total = form[ROWS * BLOCK : ROWS * BLOCK + size]
        for i in range(size):
            total[i] = 0.0
        for number in range(count):
            _add_times(total, form[number * BLOCK :], seen[number, first:last])
        if paths and len(emitted):
            take_cut_numbers(at, readers.cut, readers_here)
            add_each(total, form[7 * BLOCK :], emitted, at[:size])
        for i in range(size):
            sums[readers_here[i]] += total[i]


def in_vacuum(chosen, ways, planes, cut, ghosts, hits, probes, light, manner, work, at_hits, at_probes, in_voxels):
    """As `evolution.forwards`, without a medium."""
    count, bands, size = planes.even.shape[0], planes.even.shape[1], planes.height * planes.width
    rows, shift, way, here, form = work.rows, work.shift, work.way, work.here, work.form
    most = len(rows)
    for first in range(0, len(chosen), most):
        batch = chosen[first : first + most]
        laps = most_laps(ways, batch)
        for c in range(bands):
            _begin_batch(work, len(batch))
            emitted = light.cut[c]
            for when in range(-(laps - 1) * count, count):
                reading = when >= 0
                # Batches may hold both senses: those of one sense go together.
                for sense in (1, -1):
                    k = when % count if sense > 0 else count - 1 - when % count
                    summing = reading and manner.fluence and ghosts.first[k + 1] - ghosts.first[k] < size
                    sums = in_voxels[k, c] if summing else work.nowhere
                    take_cut(cut, k, c, light, summing, sums, manner, here)
                    for b in range(len(batch)):
                        n = batch[b]
                        if ways.sense[n] != sense or when < -(ways.laps[n] - 1) * count:
                            continue
                        segments, row = chords(ways, n, when, planes.width, planes.wrap_v, way), rows[b]
                        light_of_ghosts(ghosts, k, c, n, ways, light, work.sent)
                        of_hits, of_probes = _picked(reading, hits, probes, n, k, work.picked)
                        for number in range(segments):
                            shift[b] = _carry(row, shift[b], way.move[number], planes)
                            if reading:
                                _take_rays(hits.cell, of_hits, row, shift[b], work.hits[number])
                                _take_rays(probes.cell, of_probes, row, shift[b], work.probes[number])
                            if summing:
                                ahead, weight = shift[b], ways.weight[n] * way.share[number]
                                _add_to(sums[:ahead], row[size - ahead :], weight)
                                _add_to(sums[ahead:size], row[: size - ahead], weight)
                            through_cut_in_vacuum(cut, k, number, way, row, shift[b], here, ways.weight[n])
                            _put_rays(ghosts.cell[ghosts.first[k] : ghosts.first[k + 1]], row, shift[b], work.sent)
                        if reading:
                            there = emitted, manner, form, work.at
                            _read(False, hits, of_hits, ways, n, segments, way, work.hits, *there, at_hits[c])
                            _read(True, probes, of_probes, ways, n, segments, way, work.probes, *there, at_probes[c])
                    if summing:
                        put_cut(cut, k, sums, here)


@inlined
def _number_cut(cells, k, number, way, row, shift, sent):
    """One segment through the voxels that surfaces cut."""
    size = len(row)
    for j in range(cells.first[k], cells.first[k + 1]):
        slope = tilt(cells.plane, j, way.step[0], way.step[1], way.step[2])
        g0 = cells.plane[0, j] + tilt(cells.plane, j, way.begin[number, 0], way.begin[number, 1], way.begin[number, 2])
        if g0 < 0 or g0 + way.share[number] * slope < 0:
            row[place(cells.cell[j], shift, size)] = sent[j]


@compiled
def _append(picked, codes, shares, of_readers, element, source, weight):
    """Write links to the lists; how many. All are written: a processor cannot guess which count."""
    links = np.uintp(0)
    for i in range(len(picked)):
        code, share = codes[i], shares[i]
        element[links], source[links], weight[links] = of_readers[picked[i]], code, share
        links += np.uintp((code > 0) & (share != 0))
    return np.int64(links)


@inlined
def _note_links(paths, readers, picked, ways, n, count, way, numbers, sent, manner, form, at, links, element, source, weight):
    """Add what elements of a plane see in one direction to the list of `links`, and return how long it is."""
    for first in range(0, len(picked), BLOCK):
        last = min(first + BLOCK, len(picked))
        here, known = picked[first:last], readers.element
        forms_of(paths, readers, ways, n, 0, here, count, way, 0.0, 0.0, manner, form)
        for number in range(count):
            lists = element[links:], source[links:], weight[links:]
            links += _append(here, numbers[number, first:last], form[number * BLOCK :], known, *lists)
        if paths and len(sent):
            lists = element[links:], source[links:], weight[links:]
            take_cut_numbers(at, readers.cut, here)
            for i in range(last - first):
                at[i] = sent[at[i]]
            links += _append(here, at, form[7 * BLOCK :], known, *lists)
    return links


def views(chosen, ways, planes, cut, ghosts, hits, probes, manner, work, of_cut, of_ghosts, element, source, weight):
    """Rays that carry the number of the voxel they left, and which of these elements read (see `transport.links`).

    Written one by one in the `chosen` directions: element, number and weight; returns how many there are. `of_cut` and
    `of_ghosts` are the numbers of listed voxels, 0 for those that send nothing.
    """
    count = planes.even.shape[0]
    rows, shift, way, form = work.rows, work.shift, work.way, work.form
    most, links = len(rows), 0
    for first in range(0, len(chosen), most):
        batch = chosen[first : first + most]
        _begin_batch(work, len(batch))
        for when in range(-(most_laps(ways, batch) - 1) * count, count):
            for sense in (1, -1):
                k = when % count if sense > 0 else count - 1 - when % count
                for b in range(len(batch)):
                    n = batch[b]
                    if ways.sense[n] != sense or when < -(ways.laps[n] - 1) * count:
                        continue
                    segments, row = chords(ways, n, when, planes.width, planes.wrap_v, way), rows[b]
                    read_hits, read_probes = _picked(when >= 0, hits, probes, n, k, work.picked)
                    for number in range(segments):
                        shift[b] = _carry(row, shift[b], way.move[number], planes)
                        if when >= 0:
                            _take_rays(hits.cell, read_hits, row, shift[b], work.hits[number])
                            _take_rays(probes.cell, read_probes, row, shift[b], work.probes[number])
                        _number_cut(cut, k, number, way, row, shift[b], of_cut)
                        begun, end = ghosts.first[k], ghosts.first[k + 1]
                        _put_rays(ghosts.cell[begun:end], row, shift[b], of_ghosts[begun:end])
                    if when >= 0:
                        there = of_cut, manner, form, work.at
                        known = ways, n, segments, way
                        links = _note_links(False, hits, read_hits, *known, work.hits, *there, links, element, source, weight)
                        links = _note_links(
                            True, probes, read_probes, *known, work.probes, *there, links, element, source, weight
                        )
    return links


def tally(element, count):
    """Count the links of each element."""
    for i in range(len(element)):
        count[element[i]] += 1


def sort(element, source, weight, place, to_source, to_weight):
    """Write links to where those of their elements go: the next one's `place`."""
    for i in range(len(element)):
        j = place[element[i]]
        place[element[i]] = j + 1
        to_source[j], to_weight[j] = source[i], weight[i]


def follow(begin, end, first, source, weight, sent, got):
    """What is got [C, E] by the elements `begin` to `end` of what is sent [C, n]: the sum of their links' weights times it."""
    for c in range(sent.shape[0]):
        for e in range(begin, end):
            total = 0.0
            for i in range(first[e], first[e + 1]):
                total += weight[i] * sent[c, source[i]]
            got[c, e] = total


def retrace(begin, end, first, source, weight, asked, got):
    """The transpose of `follow`, added to what is got [C, n] of what is asked [C, E]."""
    for c in range(asked.shape[0]):
        for e in range(begin, end):
            for i in range(first[e], first[e + 1]):
                got[c, source[i]] += weight[i] * asked[c, e]
