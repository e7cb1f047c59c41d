"""One segment of a direction's rays through the voxels that surfaces cut, and its transpose.

Those of a plane are worked on `BLOCK` at a time, without branches. What is needed of a block is in one array, whose rows lie
one behind the other: row r begins at r * BLOCK, so that LLVM knows them apart (numbers to choose between are read first: else
it sees a branch). Most of it is copied there once for all directions that pass the plane.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from .arguments import BLOCK
from .arguments import CUT_ROWS as ROWS
from .compiling import compiled, inlined
from .paths import bend_of, exp, mean_of

#: Rows of a block: rays; what is summed; source and slopes, or what is asked of them; what surfaces send, or what is asked of
#: it; extinction; the surfaces' offset and normal; sums (or what is asked of sources and slopes) before this plane's.
_row = lambda number: np.uintp(number * BLOCK)
_RAY, _SUM, _SOURCE, _A, _U, _V, _SENT, _EXTINCTION = (_row(r) for r in range(8))
_P0, _P1, _P2, _P3 = (_row(8 + r) for r in range(4))
_BEFORE = tuple(_row(12 + r) for r in range(4))
_SLOPES = _A, _U, _V


@register_jitable
def _block(cells, k, number, here):
    """A block's rows, and its voxels in the plane."""
    begun, end = cells.first[k] + number * BLOCK, cells.first[k + 1]
    return here[number * ROWS * BLOCK : (number + 1) * ROWS * BLOCK], cells.cell[begun : min(begun + BLOCK, end)]


@register_jitable
def _blocks(cells, k):
    return (cells.first[k + 1] - cells.first[k] + BLOCK - 1) // BLOCK


@compiled
def _load(to, row, values):
    for i in range(len(values)):
        to[np.uintp(i) + row] = values[i]


@compiled
def _gather(to, row, values, cell):
    for i in range(len(cell)):
        to[np.uintp(i) + row] = values[cell[i]]


@compiled
def _clear(to, row, size):
    for i in range(size):
        to[np.uintp(i) + row] = 0


@compiled
def _give(to, values, row, cell):
    for i in range(len(cell)):
        to[cell[i]] = values[np.uintp(i) + row]


@compiled
def _give_sum(to, values, one, other, cell):
    for i in range(len(cell)):
        to[cell[i]] = values[np.uintp(i) + one] + values[np.uintp(i) + other]


@register_jitable
def _load_surfaces(rows, cells, k, c, number, size, manner):
    begun = cells.first[k] + number * BLOCK
    _load(rows, _P0, cells.plane[0, begun : begun + size])
    _load(rows, _P1, cells.plane[1, begun : begun + size])
    _load(rows, _P2, cells.plane[2, begun : begun + size])
    _load(rows, _P3, cells.plane[3, begun : begun + size])
    if manner.medium:
        _load(rows, _EXTINCTION, cells.extinction[c, begun : begun + size])


@inlined
def take_cut(cells, k, c, light, summing, sums, manner, here):
    """What is sent in the CUT voxels of a plane and, if `summing`, their sums so far."""
    for number in range(_blocks(cells, k)):
        rows, cell = _block(cells, k, number, here)
        begun, size = cells.first[k] + number * BLOCK, len(cell)
        _load_surfaces(rows, cells, k, c, number, size, manner)
        _load(rows, _SENT, light.cut[c, begun : begun + size])
        _clear(rows, _SUM, size)
        if summing:
            _gather(rows, _BEFORE[0], sums, cell)
        if manner.medium:
            _gather(rows, _SOURCE, light.source[k, c], cell)
            for a in range(3):
                if manner.sloped:
                    _gather(rows, _SLOPES[a], light.slopes[a][k, c], cell)
                else:
                    _clear(rows, _SLOPES[a], size)


@inlined
def put_cut(cells, k, sums, here):
    for number in range(_blocks(cells, k)):
        rows, cell = _block(cells, k, number, here)
        _give_sum(sums, rows, _BEFORE[0], _SUM, cell)


@inlined
def _met(here, j, e0, e1, e2, s0, s1, s2, share):
    """Where a ray begins and ends, as heights over the surface, and how much of its way is free: an unsigned j."""
    real = here.dtype.type
    slope = here[j + _P1] * s0 + here[j + _P2] * s1 + here[j + _P3] * s2
    g0 = here[j + _P0] + here[j + _P1] * e0 + here[j + _P2] * e1 + here[j + _P3] * e2
    g1 = g0 + share * slope
    return g0, g1, max(min(max(g0, g1) / (abs(slope) + real(1e-20)), share), real(0))


@inlined
def _attenuated(tau, limit):
    """exp(-tau), and the mean and the bend of a path, without a branch."""
    real = type(tau)
    kept, thick, one, half = exp(-tau), max(tau, limit), real(1), real(0.5)
    thin = tau < limit
    mean = mean_of(tau) if thin else (one - kept) / thick
    bend = bend_of(tau) if thin else (half * (one + kept) - (one - kept) / thick) / thick
    return kept, mean, bend


@compiled
def _through(here, size, begin, step, share, length, limit, weight):
    real = here.dtype.type
    e0, e1, e2, s0, s1, s2 = real(begin[0]), real(begin[1]), real(begin[2]), real(step[0]), real(step[1]), real(step[2])
    share, length, limit, w, zero, half = real(share), real(length), real(limit), real(weight), real(0), real(0.5)
    for i in range(size):
        j = np.uintp(i)
        g0, g1, free = _met(here, j, e0, e1, e2, s0, s1, s2, share)
        start, sent, ray = share - free if g0 < zero else zero, here[j + _SENT], here[j + _RAY]
        radiance = sent if g0 < zero else ray
        tau = here[j + _EXTINCTION] * length * free
        rise = here[j + _A] * s0 + here[j + _U] * s1 + here[j + _V] * s2
        source = here[j + _SOURCE] + here[j + _A] * e0 + here[j + _U] * e1 + here[j + _V] * e2 + rise * (start + half * free)
        kept, mean, bend = _attenuated(tau, limit)
        excess, rise = radiance - source, rise * free
        gone = radiance - tau * mean * excess if tau < limit else source + kept * excess
        here[j + _SUM] += w * free * (source + mean * excess - bend * rise)
        here[j + _RAY] = sent if g1 < zero else gone + tau * bend * rise


@inlined
def through_cut(cells, k, number, way, length, come, gone, manner, here, weight):
    """What surfaces make of segment `number` in the voxels that they cut: `come` and `gone` are the plane before and after."""
    for block in range(_blocks(cells, k)):
        rows, cell = _block(cells, k, block, here)
        _gather(rows, _RAY, come, cell)
        _through(rows, len(cell), way.begin[number], way.step, way.share[number], length, manner.limit, weight)
        _give(gone, rows, _RAY, cell)


@inlined
def place(cell, shift, size):
    """Where rays are kept that are in a voxel now (see `vacuum`)."""
    at = np.int64(cell) - shift
    return np.uintp(at + size if at < 0 else at)


@compiled
def _through_vacuum(here, size, begin, step, share, weight):
    real = here.dtype.type
    e0, e1, e2, s0, s1, s2 = real(begin[0]), real(begin[1]), real(begin[2]), real(step[0]), real(step[1]), real(step[2])
    share, w, zero = real(share), real(weight), real(0)
    for i in range(size):
        j = np.uintp(i)
        g0, g1, free = _met(here, j, e0, e1, e2, s0, s1, s2, share)
        sent, ray = here[j + _SENT], here[j + _RAY]
        radiance = sent if g0 < zero else ray
        here[j + _SUM] += w * free * radiance
        here[j + _RAY] = sent if g1 < zero else radiance


@inlined
def through_cut_in_vacuum(cells, k, number, way, row, shift, here, weight):
    """The same for rays that keep their places."""
    for block in range(_blocks(cells, k)):
        rows, cell = _block(cells, k, block, here)
        for i in range(len(cell)):
            rows[np.uintp(i) + _RAY] = row[place(cell[i], shift, len(row))]
        _through_vacuum(rows, len(cell), way.begin[number], way.step, way.share[number], weight)
        for i in range(len(cell)):
            row[place(cell[i], shift, len(row))] = rows[np.uintp(i) + _RAY]


@inlined
def keep_cut(cells, k, c, wanted, back, manner, here):
    """What the sums of CUT voxels are `wanted` for, and what has been asked there so far: loops over whole planes ask too."""
    for number in range(_blocks(cells, k)):
        rows, cell = _block(cells, k, number, here)
        _load_surfaces(rows, cells, k, c, number, len(cell), manner)
        _gather(rows, _SUM, wanted, cell)
        for row in (_SENT, _SOURCE, _A, _U, _V):
            _clear(rows, row, len(cell))
        if manner.medium:
            _gather(rows, _BEFORE[0], back.source[k, c], cell)
        else:
            _clear(rows, _EXTINCTION, len(cell))
        if manner.sloped:
            for a in range(3):
                _gather(rows, _BEFORE[1 + a], back.slopes[a][k, c], cell)


@inlined
def give_cut(cells, k, c, back, manner, here):
    for number in range(_blocks(cells, k)):
        rows, cell = _block(cells, k, number, here)
        begun = cells.first[k] + number * BLOCK
        for i in range(len(cell)):
            back.cut[c, begun + i] += rows[np.uintp(i) + _SENT]
        if manner.medium:
            _give_sum(back.source[k, c], rows, _BEFORE[0], _SOURCE, cell)
        if manner.sloped:
            for a in range(3):
                _give_sum(back.slopes[a][k, c], rows, _BEFORE[1 + a], _SLOPES[a], cell)


@register_jitable
def ask_cut(here, j, row, value):
    """Ask for `value` more of the source (row 0), or a slope, of the plane's CUT voxel j."""
    here[(j // BLOCK * ROWS + 2 + row) * BLOCK + j % BLOCK] += value


@compiled
def _back(here, size, begin, step, share, length, limit, weight):
    real = here.dtype.type
    e0, e1, e2, s0, s1, s2 = real(begin[0]), real(begin[1]), real(begin[2]), real(step[0]), real(step[1]), real(step[2])
    share, length, limit, w = real(share), real(length), real(limit), real(weight)
    zero, one, half = real(0), real(1), real(0.5)
    for i in range(size):
        j = np.uintp(i)
        g0, g1, free = _met(here, j, e0, e1, e2, s0, s1, s2, share)
        start, ray = share - free if g0 < zero else zero, here[j + _RAY]
        gone = zero if g1 < zero else ray
        asks = w * free * here[j + _SUM]
        tau = here[j + _EXTINCTION] * length * free
        kept, mean, bend = _attenuated(tau, limit)
        lost = tau * mean if tau < limit else one - kept
        radiance = gone - lost * gone + mean * asks
        here[j + _SOURCE] += lost * gone + (one - mean) * asks
        off, rise, time = lost * gone - mean * asks, (tau * gone - asks) * bend * free, start + half * free
        here[j + _A] += (e0 + s0 * time) * off + s0 * rise
        here[j + _U] += (e1 + s1 * time) * off + s1 * rise
        here[j + _V] += (e2 + s2 * time) * off + s2 * rise
        here[j + _SENT] += (ray if g1 < zero else zero) + (radiance if g0 < zero else zero)
        here[j + _RAY] = zero if g0 < zero else radiance


@inlined
def back_cut(cells, k, number, way, length, gone, come, asked, manner, here, weight):
    """The transpose of `through_cut`; `asked` is what elements ask of the rays before."""
    for block in range(_blocks(cells, k)):
        rows, cell = _block(cells, k, block, here)
        _gather(rows, _RAY, gone, cell)
        _back(rows, len(cell), way.begin[number], way.step, way.share[number], length, manner.limit, weight)
        for i in range(len(cell)):
            come[cell[i]] = rows[np.uintp(i) + _RAY] + asked[cell[i]]
