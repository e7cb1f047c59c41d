"""What elements read of the rays, and the transpose.

It is linear in the rays before each of three segments (0 to 2), the voxel's source (3), its slopes (4 to 6) and its exitance
(7): the *form* of an element. Runs of elements with the same surface and extinction share one. Of all others, those that read
in a direction are picked, and their forms worked out `BLOCK` at a time, without branches, in one array: row r of it begins
at r * BLOCK.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from ..reading import BEHIND, ONWARD
from ..slopes import THIN
from .arguments import BLOCK, ROWS
from .compiling import compiled, inlined
from .cut import ask_cut
from .paths import bend_of, exp, mean_of

#: Rows of the array that follow the form: what it is multiplied by, how many hits or how much of paths, the elements' surfaces
#: and those in their voxels (offset and normal), and what else their forms depend on.
FACTOR, _TOTAL, _FACE, _PLANE, _HEIGHT, _DEPTH = 8, 9, 10, 14, 18, 19
# Unsigned, because numba looks whether others are negative, and does not vectorise then.
_row = lambda number: np.uintp(number * BLOCK)
_O0, _O1, _O2, _O3, _O7 = _row(0), _row(1), _row(2), _row(3), _row(7)
_A, _U, _V = _row(4), _row(5), _row(6)
_OF, _OT, _OH, _OD = _row(FACTOR), _row(_TOTAL), _row(_HEIGHT), _row(_DEPTH)
_F0, _F1, _F2, _F3 = (_row(_FACE + i) for i in range(4))
_P0, _P1, _P2, _P3 = (_row(_PLANE + i) for i in range(4))

#: Of each byte of marks: their places, and how many they are.
_PLACES = np.array([([i for i in range(8) if byte >> i & 1] + [0] * 8)[:8] for byte in range(256)], np.uint32)
_MARKED = np.array([byte.bit_count() for byte in range(256)], np.uintp)


@register_jitable
def height_of(faces, j, points, number):
    return faces[0, j] + faces[1, j] * points[number, 0] + faces[2, j] * points[number, 1] + faces[3, j] * points[number, 2]


@register_jitable
def tilt(faces, r, a, u, v):
    """n . (a, u, v) of a surface."""
    return faces[1, r] * a + faces[2, r] * u + faces[3, r] * v


@register_jitable
def marked(bits, n, m):
    return (bits[n, m >> 3] >> np.uint8(m & 7)) & np.uint8(1)


@register_jitable
def faces_away(readers, m, ways, n):
    return tilt(readers.face, m, ways.toward[n, 0], ways.toward[n, 1], ways.toward[n, 2]) >= 0


@inlined
def attenuations(tau, limit):
    """As `paths.attenuation`, without a branch."""
    thin, thick, kept = tau < limit, max(tau, limit), exp(-tau)
    mean = mean_of(tau) if thin else (1 - kept) / thick
    bend = bend_of(tau) if thin else ((1 + kept) / 2 - mean) / thick
    return 1 - tau * mean if thin else kept, mean, bend


@register_jitable
def _marks_within(bits, n, byte, first, last):
    """Eight marks, but for those of readers before `first` and from `last` on."""
    marks = np.int64(bits[n, byte])
    if 8 * byte < first:
        marks &= 255 << (first - 8 * byte)
    if 8 * byte + 8 > last:
        marks &= 255 >> (8 * byte + 8 - last)
    return np.uintp(marks)


@compiled
def pick_marked(bits, n, first, last, picked):
    """Write those of readers `first` to `last` that read in a direction to `picked`, which has room for 7 more; how many."""
    count = np.uintp(0)
    for byte in range(first >> 3, (last + 7) >> 3):
        marks = _marks_within(bits, n, byte, first, last)
        if marks != 0:
            for i in range(8):  # always as many, without a branch: a processor cannot guess the marks
                picked[count + np.uintp(i)] = np.uint32(8 * byte) + _PLACES[marks, i]
            count += _MARKED[marks]
    return np.int64(count)


@compiled
def take(to, values, picked):
    for i in range(len(picked)):
        to[i] = values[picked[i]]


@compiled
def take_cut_numbers(to, cut, picked):
    """The numbers of the CUT voxels that readers are in; any number where it is none: there is a 0 in the form for it."""
    for i in range(len(picked)):
        to[i] = max(cut[picked[i]], 0)


@register_jitable
def _used(r, manner):
    """Whether a row of the form is anything but 0: without a medium, or slopes, some are not looked at."""
    return r < 3 or r == 7 or (manner.medium and (r == 3 or manner.sloped))


@inlined
def _load(paths, readers, ways, n, picked, manner, form):
    """The surfaces of readers, and the cosine and the weight of a direction."""
    size, w = len(picked), ways.weight[n]
    a, u, v = ways.toward[n, 0], ways.toward[n, 1], ways.toward[n, 2]
    for r in range(4):
        take(form[(_FACE + r) * BLOCK : (_FACE + r + 1) * BLOCK], readers.face[r], picked)
        if paths:
            take(form[(_PLANE + r) * BLOCK : (_PLANE + r + 1) * BLOCK], readers.plane[r], picked)
    for i in range(size):
        j = np.uintp(i)
        form[j + _OF] = -w * (form[j + _F1] * a + form[j + _F2] * u + form[j + _F3] * v)
        form[j + _OT] = 0.0
    for r in range(8):
        of_row = np.uintp(r) * np.uintp(BLOCK)
        if _used(r, manner):
            for i in range(size):
                form[np.uintp(i) + of_row] = 0.0


@compiled
def _hits_in_vacuum(form, size, to, b, e):
    b0, b1, b2, e0, e1, e2 = b[0], b[1], b[2], e[0], e[1], e[2]
    for i in range(size):
        j = np.uintp(i)
        g0 = form[j + _F0] + form[j + _F1] * b0 + form[j + _F2] * b1 + form[j + _F3] * b2
        g1 = form[j + _F0] + form[j + _F1] * e0 + form[j + _F2] * e1 + form[j + _F3] * e2
        hit = 1.0 if (g0 >= -BEHIND) & (g1 < 0) & (g0 > g1) else 0.0
        form[j + _OT] += hit
        form[j + to] = hit


@compiled
def _hits(form, size, to, b, e, s, share, length, limit, sloped):
    b0, b1, b2, e0, e1, e2 = b[0], b[1], b[2], e[0], e[1], e[2]
    s0, s1, s2 = s[0], s[1], s[2]
    for i in range(size):
        j = np.uintp(i)
        g0 = form[j + _F0] + form[j + _F1] * b0 + form[j + _F2] * b1 + form[j + _F3] * b2
        g1 = form[j + _F0] + form[j + _F1] * e0 + form[j + _F2] * e1 + form[j + _F3] * e2
        hit = 1.0 if (g0 >= -BEHIND) & (g1 < 0) & (g0 > g1) else 0.0
        path = share * min(max(g0 / max(g0 - g1, 1e-9), 0.0), 1.0)
        tau = form[j + _OD] * length * path
        kept, _, bend = attenuations(tau, limit)
        form[j + _OT] += hit
        form[j + to] = hit * kept
        middle, rise, half = hit * (1 - kept), hit * tau * bend * path, path / 2
        form[j + _O3] += middle
        if sloped:
            form[j + _A] += middle * (b0 + s0 * half) + rise * s0
            form[j + _U] += middle * (b1 + s1 * half) + rise * s1
            form[j + _V] += middle * (b2 + s2 * half) + rise * s2


@compiled
def _paths_in_vacuum(form, size, to, b, s, share):
    b0, b1, b2, s0, s1, s2 = b[0], b[1], b[2], s[0], s[1], s[2]
    for i in range(size):
        j = np.uintp(i)
        g0 = form[j + _P0] + form[j + _P1] * b0 + form[j + _P2] * b1 + form[j + _P3] * b2
        slope = form[j + _P1] * s0 + form[j + _P2] * s1 + form[j + _P3] * s2
        free = max(min(max(g0, g0 + share * slope) / (abs(slope) + 1e-20), share), 0.0)
        behind = 1.0 if g0 < 0 else 0.0
        form[j + _OT] += free
        form[j + _O7] += behind * free
        form[j + to] = (1 - behind) * free


@compiled
def _paths(form, size, to, b, s, share, length, spacing, limit, onward, sloped):
    b0, b1, b2, s0, s1, s2 = b[0], b[1], b[2], s[0], s[1], s[2]
    for i in range(size):
        j = np.uintp(i)
        g0 = form[j + _P0] + form[j + _P1] * b0 + form[j + _P2] * b1 + form[j + _P3] * b2
        slope = form[j + _P1] * s0 + form[j + _P2] * s1 + form[j + _P3] * s2
        free = max(min(max(g0, g0 + share * slope) / (abs(slope) + 1e-20), share), 0.0)
        behind = 1.0 if g0 < 0 else 0.0
        start, extinction, weight = behind * (share - free), form[j + _OD], free
        if onward:
            # From the middle of the path on to the element's plane.
            towards = -(form[j + _F1] * s0 + form[j + _F2] * s1 + form[j + _F3] * s2)
            height = form[j + _OH] + form[j + _F1] * b0 + form[j + _F2] * b1 + form[j + _F3] * b2
            time = min(max((height - (start + free / 2) * towards) / max(towards, 1e-6), 0.0), ONWARD)
            time *= min(max(extinction * spacing / THIN - 1, 0.0), 1.0)
            tau = extinction * length * time
            kept, _, bend = attenuations(tau, limit)
            middle, rise, at = weight * (1 - kept), weight * tau * bend * time, start + free / 2 + time / 2
            form[j + _O3] += middle
            if sloped:
                form[j + _A] += middle * (b0 + s0 * at) + rise * s0
                form[j + _U] += middle * (b1 + s1 * at) + rise * s1
                form[j + _V] += middle * (b2 + s2 * at) + rise * s2
            weight *= kept
        _, mean, bend = attenuations(extinction * length * free, limit)
        middle, rise, at = weight * (1 - mean), -weight * bend * free, start + free / 2
        form[j + _O3] += middle
        if sloped:
            form[j + _A] += middle * (b0 + s0 * at) + rise * s0
            form[j + _U] += middle * (b1 + s1 * at) + rise * s1
            form[j + _V] += middle * (b2 + s2 * at) + rise * s2
        weight *= mean
        form[j + _OT] += free
        form[j + _O7] += behind * weight
        form[j + to] = (1 - behind) * weight


@inlined
def forms_of(paths, readers, ways, n, c, picked, count, way, length, spacing, manner, form):
    """The forms of the `picked` readers, times cosine and weight of the direction: the mean of free `paths` or else of hits."""
    size = len(picked)
    _load(paths, readers, ways, n, picked, manner, form)
    if manner.medium:
        take(form[_HEIGHT * BLOCK : (_HEIGHT + 1) * BLOCK], readers.height, picked)
        take(form[_DEPTH * BLOCK : (_DEPTH + 1) * BLOCK], readers.extinction[c], picked)
    for number in range(count):
        share, to = way.share[number], np.uintp(number) * np.uintp(BLOCK)
        if share <= 0:
            continue
        b, e, s = way.begin[number], way.end[number], way.step
        if paths and manner.medium:
            # Programs of their own, without branches.
            if manner.onward and manner.sloped:
                _paths(form, size, to, b, s, share, length, spacing, manner.limit, True, True)
            elif manner.onward:
                _paths(form, size, to, b, s, share, length, spacing, manner.limit, True, False)
            elif manner.sloped:
                _paths(form, size, to, b, s, share, length, spacing, manner.limit, False, True)
            else:
                _paths(form, size, to, b, s, share, length, spacing, manner.limit, False, False)
        elif paths:
            _paths_in_vacuum(form, size, to, b, s, share)
        elif manner.medium:
            _hits(form, size, to, b, e, s, share, length, manner.limit, manner.sloped)
        else:
            _hits_in_vacuum(form, size, to, b, e)
    _finish(form, size, manner)


@compiled
def _finish(form, size, manner):
    for i in range(size):
        j = np.uintp(i)
        total = form[j + _OT]
        form[j + _OF] = form[j + _OF] / max(total, 1e-6) if total > 1e-6 else 0.0
    for r in range(8):
        of_row = np.uintp(r) * np.uintp(BLOCK)
        if _used(r, manner):
            for i in range(size):
                j = np.uintp(i)
                form[j + of_row] *= form[j + _OF]


@compiled
def _any_marked(bits, n, first, last):
    marks = np.uintp(0)
    for byte in range(first >> 3, (last + 7) >> 3):
        marks |= _marks_within(bits, n, byte, first, last)
    return marks != 0


@register_jitable
def _even(readers, r, c, manner):
    """Whether all of a run have the same form, but for the marks."""
    return not manner.medium or readers.even[c, r]


@inlined
def _pick_runs(readers, r, end, ways, n, c, manner, picked, runs):
    """Of the runs from r on, in which some read, the next that have one form each, a block of them at most.

    Their first readers go to `picked`, and their numbers to `runs`. Returns how many, and the run behind them.
    """
    many = 0
    while r < end and many < BLOCK:
        first, last = readers.first[r], readers.first[r + 1]
        lit = _even(readers, r, c, manner) and not faces_away(readers, first, ways, n)
        if lit and _any_marked(readers.bits, n, first, last):
            picked[many], runs[many] = first, r
            many += 1
        r += 1
    return many, r


@inlined
def _pick_others(readers, k, n, c, manner, picked):
    """Those of a plane that read and have a form of their own; how many."""
    many = 0
    for r in range(readers.runs[k], readers.alone[k]):
        if not _even(readers, r, c, manner):
            many += pick_marked(readers.bits, n, readers.first[r], readers.first[r + 1], picked[many:])
    first, last = readers.first[readers.alone[k]], readers.first[readers.runs[k + 1]]
    return many + pick_marked(readers.bits, n, first, last, picked[many:])


@compiled
def add_terms(sums, bits, n, cell, first, last, f0, f1, f2, f3, v0, v1, v2, v3):
    """Four terms at once, in those of the readers `first` to `last` that read: without a branch for each, which a processor
    cannot guess."""
    for byte in range(first >> 3, (last + 7) >> 3):
        marks = _marks_within(bits, n, byte, first, last)
        if marks == 0:
            continue
        for i in range(8):
            m = np.uintp(8 * byte + i)
            at = cell[m]
            total = f0 * v0[at] + f1 * v1[at] + f2 * v2[at] + f3 * v3[at]
            sums[m] += np.float64((marks >> np.uintp(i)) & np.uintp(1)) * total


@compiled
def add_each(total, form, values, at):
    for i in range(len(at)):
        total[i] += form[i] * values[at[i]]


@inlined
def _read_block(readers, c, k, picked, count, rows, way, margin, light, manner, form, at, sums):
    size = len(picked)
    total, at = form[ROWS * BLOCK : ROWS * BLOCK + size], at[:size]
    for i in range(size):
        total[i] = 0.0
    take(at, readers.cell, picked)
    for number in range(count):
        add_each(total, form[number * BLOCK :], rows[way.row[number], margin - way.move[number] :], at)
    add_each(total, form[3 * BLOCK :], light.source[k, c], at)
    if manner.sloped:
        for d in range(3):
            add_each(total, form[(4 + d) * BLOCK :], light.slopes[d][k, c], at)
    if light.cut.shape[1]:
        take_cut_numbers(at, readers.cut, picked)
        add_each(total, form[7 * BLOCK :], light.cut[c], at)
    for i in range(size):
        sums[c, picked[i]] += total[i]


@inlined
def _read_run(bits, cell, n, c, k, first, last, count, rows, way, margin, light, manner, form, i, sums):
    """Of elements that share the form of number i."""
    where = sums[c], bits, n, cell, first, last
    seen0 = rows[way.row[0], margin - way.move[0] :]
    seen1 = rows[way.row[1], margin - way.move[1] :] if count > 1 else seen0
    seen2 = rows[way.row[2], margin - way.move[2] :] if count > 2 else seen0
    of_rays = form[i], form[BLOCK + i], form[2 * BLOCK + i]
    add_terms(*where, *of_rays, form[3 * BLOCK + i], seen0, seen1, seen2, light.source[k, c])
    if manner.sloped:
        slope0, slope1, slope2 = light.slopes[0][k, c], light.slopes[1][k, c], light.slopes[2][k, c]
        of_slopes = form[4 * BLOCK + i], form[5 * BLOCK + i], form[6 * BLOCK + i]
        add_terms(*where, *of_slopes, 0.0, slope0, slope1, slope2, slope2)


@inlined
def read(paths, readers, ways, n, k, c, count, way, length, margin, light, spacing, manner, work, sums):
    """Add what elements read of one direction in a plane, as the mean of free `paths` or else of hits."""
    rows, form, runs, r, end = work.rows, work.form, work.at, readers.runs[k], readers.alone[k]
    while r < end:
        many, r = _pick_runs(readers, r, end, ways, n, c, manner, work.picked, runs)
        if many:
            forms_of(paths, readers, ways, n, c, work.picked[:many], count, way, length, spacing, manner, form)
        for i in range(many):
            first, last = readers.first[runs[i]], readers.first[runs[i] + 1]
            _read_run(readers.bits, readers.cell, n, c, k, first, last, count, rows, way, margin, light, manner, form, i, sums)
    many = _pick_others(readers, k, n, c, manner, work.picked)
    for begun in range(0, many, BLOCK):
        picked = work.picked[begun : min(begun + BLOCK, many)]
        forms_of(paths, readers, ways, n, c, picked, count, way, length, spacing, manner, form)
        _read_block(readers, c, k, picked, count, rows, way, margin, light, manner, form, work.at, sums)


@compiled
def _ask_term(values, bits, n, cell, first, last, factor, wanted):
    for m in range(first, last):
        values[cell[m]] += factor * marked(bits, n, m) * wanted[m]


@compiled
def _ask_each(values, form, at, wanted):
    for i in range(len(at)):
        values[at[i]] += form[i] * wanted[i]


@compiled
def _ask_medium(readers, c, k, picked, back, here, cut_begun, manner, form, wanted):
    """What elements ask of the sources; those of CUT voxels are kept apart for now."""
    for i in range(len(picked)):
        m, value = picked[i], wanted[i]
        if readers.cut[m] >= 0:
            j = readers.cut[m] - cut_begun
            ask_cut(here, j, 0, form[3 * BLOCK + i] * value)
            if manner.sloped:
                for a in range(3):
                    ask_cut(here, j, 1 + a, form[(4 + a) * BLOCK + i] * value)
            continue
        back.source[k, c, readers.cell[m]] += form[3 * BLOCK + i] * value
        if manner.sloped:
            for a in range(3):
                back.slopes[a][k, c, readers.cell[m]] += form[(4 + a) * BLOCK + i] * value


@inlined
def _ask_run(bits, cell, n, c, k, first, last, count, asked, back, manner, form, i, wanted):
    where, of_band = (bits, n, cell, first, last), wanted[c]
    for number in range(count):
        if form[number * BLOCK + i] != 0:
            _ask_term(asked[number], *where, form[number * BLOCK + i], of_band)
    if manner.medium:
        _ask_term(back.source[k, c], *where, form[3 * BLOCK + i], of_band)
    if manner.sloped:
        for d in range(3):
            _ask_term(back.slopes[d][k, c], *where, form[(4 + d) * BLOCK + i], of_band)


@inlined
def _ask_block(readers, c, k, picked, count, asked, back, cut_begun, manner, work, wanted):
    form = work.form
    at, of_each = work.at[: len(picked)], form[ROWS * BLOCK : ROWS * BLOCK + len(picked)]
    take(of_each, wanted[c], picked)
    take(at, readers.cell, picked)
    for number in range(count):
        _ask_each(asked[number], form[number * BLOCK :], at, of_each)
    if manner.medium:
        _ask_medium(readers, c, k, picked, back, work.here, cut_begun, manner, form, of_each)
    if back.cut.shape[1]:
        take_cut_numbers(at, readers.cut, picked)
        _ask_each(back.cut[c], form[7 * BLOCK :], at, of_each)


@inlined
def ask(paths, readers, ways, n, k, c, count, way, length, back, cut_begun, spacing, manner, work, wanted):
    """The transpose of `read`: what elements ask of the rays before each segment, and of what is sent."""
    asked, form, runs, r, end = work.asked, work.form, work.at, readers.runs[k], readers.alone[k]
    while r < end:
        many, r = _pick_runs(readers, r, end, ways, n, c, manner, work.picked, runs)
        if many:
            forms_of(paths, readers, ways, n, c, work.picked[:many], count, way, length, spacing, manner, form)
        for i in range(many):
            first, last = readers.first[runs[i]], readers.first[runs[i] + 1]
            _ask_run(readers.bits, readers.cell, n, c, k, first, last, count, asked, back, manner, form, i, wanted)
    many = _pick_others(readers, k, n, c, manner, work.picked)
    for begun in range(0, many, BLOCK):
        picked = work.picked[begun : min(begun + BLOCK, many)]
        forms_of(paths, readers, ways, n, c, picked, count, way, length, spacing, manner, form)
        _ask_block(readers, c, k, picked, count, asked, back, cut_begun, manner, work, wanted)
