"""What elements read of the rays, and the transpose.

It is linear in the rays before each of three segments (0 to 2), the voxel's source (3), its slopes (4 to 6) and its exitance
(7): the *form* of an element, the same for all of a run. These loops make no views of arrays, which would take longer than what
they do.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from ..characteristic import _BEHIND, _ONWARD
from ..slopes import THIN
from .paths import attenuation, compiled


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
def _onto_path(form, sloped, weight, way, number, start, path, of_middle, of_rise):
    """Light of a linear source on a path: so much of it in the middle, and of its rise."""
    form[3] += weight * of_middle
    if sloped:
        for a in range(3):
            middle = way.begin[number, a] + way.step[a] * (start + path / 2)
            form[4 + a] += weight * (of_middle * middle + of_rise * way.step[a] * path)


@register_jitable
def scaled(form, factor):
    for i in range(8):
        form[i] *= factor


@register_jitable
def _form_of_hits(readers, r, extinction, count, way, length, manner, form):
    """Mean radiance of the rays that arrive at the element in its own voxel; False where none does."""
    hits = 0
    scaled(form, 0.0)
    for number in range(count):
        share = way.share[number]
        g0, g1 = height_of(readers.face, r, way.begin, number), height_of(readers.face, r, way.end, number)
        if g0 >= -_BEHIND and g1 < 0 and share > 0 and g0 > g1:
            hits += 1
            path, kept = share * min(max(g0 / max(g0 - g1, 1e-9), 0.0), 1.0), 1.0
            if manner.medium:
                tau = extinction * length * path
                kept, _, bend = attenuation(tau, manner.thin, manner.limit)
                _onto_path(form, manner.sloped, 1.0, way, number, 0.0, path, 1 - kept, tau * bend)
            form[number] += kept
    if hits > 1:
        scaled(form, 1 / hits)
    return hits > 0


@register_jitable
def _onward_time(readers, r, way, number, middle, depth):
    """The time from the middle of a path on to the element's plane; `depth` is the optical depth of a voxel's side."""
    towards = -tilt(readers.face, r, way.step[0], way.step[1], way.step[2])
    height = readers.height[r] + tilt(readers.face, r, way.begin[number, 0], way.begin[number, 1], way.begin[number, 2])
    onward = min(max((height - middle * towards) / max(towards, 1e-6), 0.0), _ONWARD)
    return onward * min(max(depth / THIN - 1, 0.0), 1.0)


@register_jitable
def _form_of_paths(readers, r, extinction, count, way, length, spacing, cells, manner, form):
    """Mean radiance of the free paths in the voxel; False where there are none."""
    j, paths = readers.cut[r], 0.0
    scaled(form, 0.0)
    for number in range(count):
        start, free, behind, share = 0.0, way.share[number], False, way.share[number]
        if j >= 0:
            g0 = height_of(cells.plane, j, way.begin, number)
            slope = tilt(cells.plane, j, way.step[0], way.step[1], way.step[2])
            behind = g0 < 0
            free = max(min(max(g0, g0 + share * slope) / (abs(slope) + 1e-20), share), 0.0)
            start = share - free if behind else 0.0
        if free <= 0:
            continue
        paths += free
        weight = free
        if manner.medium:
            if manner.onward:
                onward = _onward_time(readers, r, way, number, start + free / 2, extinction * spacing)
                if onward > 0:
                    tau = extinction * length * onward
                    kept, _, bend = attenuation(tau, manner.thin, manner.limit)
                    _onto_path(form, manner.sloped, weight, way, number, start + free / 2, onward, 1 - kept, tau * bend)
                    weight *= kept
            _, mean, bend = attenuation(extinction * length * free, manner.thin, manner.limit)
            _onto_path(form, manner.sloped, weight, way, number, start, free, 1 - mean, -bend)
            weight *= mean
        form[7 if behind else number] += weight
    scaled(form, 1 / max(paths, 1e-6))
    return paths > 1e-6


@register_jitable
def form_of(paths, readers, r, extinction, count, way, length, spacing, cells, manner, form):
    if paths:
        return _form_of_paths(readers, r, extinction, count, way, length, spacing, cells, manner, form)
    return _form_of_hits(readers, r, extinction, count, way, length, manner, form)


@register_jitable
def _read_one(c, k, m, j, cell, count, form, rows, way, margin, light, manner, sums):
    total = 0.0
    for number in range(count):
        total += form[number] * rows[way.row[number], margin - way.move[number] + cell]
    if manner.medium:
        total += form[3] * light.source[k, c, cell]
    if manner.sloped:
        for a in range(3):
            total += form[4 + a] * light.slopes[a][k, c, cell]
    if form[7] != 0:
        total += form[7] * light.cut[c, j]
    sums[c, m] += total


@compiled
def _add_term(sums, bits, n, cell, first, last, factor, values):
    """Without a branch: a processor cannot guess the marks."""
    for m in range(first, last):
        sums[m] += factor * marked(bits, n, m) * values[cell[m]]


@compiled
def _ask_term(values, bits, n, cell, first, last, factor, wanted):
    for m in range(first, last):
        values[cell[m]] += factor * marked(bits, n, m) * wanted[m]


@compiled
def read(paths, readers, ways, n, k, c, count, way, length, rows, margin, light, cells, spacing, manner, form, sums):
    """Add what elements read of one direction in a plane, as the mean of free `paths` or else of hits."""
    bits, cell, row, move = readers.bits, readers.cell, way.row, way.move
    a, u, v = ways.toward[n, 0], ways.toward[n, 1], ways.toward[n, 2]
    for r in range(readers.runs[k], readers.runs[k + 1]):
        along = tilt(readers.face, r, a, u, v)
        if along >= 0:
            continue
        first, last = readers.first[r], readers.first[r + 1]
        if last > first + 1 and (not manner.medium or readers.even[c, r]):
            depth = readers.depth[c, r] if manner.medium else 0.0
            if not form_of(paths, readers, r, depth, count, way, length, spacing, cells, manner, form):
                continue
            scaled(form, -along * ways.weight[n])
            of_band = sums[c]
            for number in range(count):
                if form[number] != 0:
                    seen = rows[row[number], margin - move[number] :]
                    _add_term(of_band, bits, n, cell, first, last, form[number], seen)
            if manner.medium:
                _add_term(of_band, bits, n, cell, first, last, form[3], light.source[k, c])
            if manner.sloped:
                for d in range(3):
                    _add_term(of_band, bits, n, cell, first, last, form[4 + d], light.slopes[d][k, c])
            continue
        for m in range(first, last):
            if not marked(bits, n, m):
                continue
            extinction = readers.extinction[c, m] if manner.medium else 0.0
            if not form_of(paths, readers, r, extinction, count, way, length, spacing, cells, manner, form):
                continue
            scaled(form, -along * ways.weight[n])
            _read_one(c, k, m, readers.cut[r], cell[m], count, form, rows, way, margin, light, manner, sums)


@register_jitable
def _ask_one(c, k, m, j, cell, count, form, asked, begun, here, back, manner, wanted):
    value = wanted[c, m]
    for number in range(count):
        asked[number, cell] += form[number] * value
    if form[7] != 0:
        back.cut[c, j] += form[7] * value
    if j >= 0:  # kept apart for now
        here[2, j - begun] += form[3] * value
        for a in range(3):
            here[3 + a, j - begun] += form[4 + a] * value
        return
    if manner.medium:
        back.source[k, c, cell] += form[3] * value
    if manner.sloped:
        for a in range(3):
            back.slopes[a][k, c, cell] += form[4 + a] * value


@compiled
def ask(paths, readers, ways, n, k, c, count, way, length, asked, back, here, cells, spacing, manner, form, wanted):
    """The transpose of `read`: what elements ask of the rays before each segment, and of what is sent."""
    bits, cell, begun = readers.bits, readers.cell, cells.first[k]
    a, u, v = ways.toward[n, 0], ways.toward[n, 1], ways.toward[n, 2]
    for r in range(readers.runs[k], readers.runs[k + 1]):
        along = tilt(readers.face, r, a, u, v)
        if along >= 0:
            continue
        first, last, j = readers.first[r], readers.first[r + 1], readers.cut[r]
        if last > first + 1 and (not manner.medium or readers.even[c, r]):
            depth = readers.depth[c, r] if manner.medium else 0.0
            if not form_of(paths, readers, r, depth, count, way, length, spacing, cells, manner, form):
                continue
            scaled(form, -along * ways.weight[n])
            of_band = wanted[c]
            for number in range(count):
                if form[number] != 0:
                    _ask_term(asked[number], bits, n, cell, first, last, form[number], of_band)
            if manner.medium:
                _ask_term(back.source[k, c], bits, n, cell, first, last, form[3], of_band)
            if manner.sloped:
                for d in range(3):
                    _ask_term(back.slopes[d][k, c], bits, n, cell, first, last, form[4 + d], of_band)
            continue
        for m in range(first, last):
            if not marked(bits, n, m):
                continue
            extinction = readers.extinction[c, m] if manner.medium else 0.0
            if not form_of(paths, readers, r, extinction, count, way, length, spacing, cells, manner, form):
                continue
            scaled(form, -along * ways.weight[n])
            _ask_one(c, k, m, j, cell[m], count, form, asked, begun, here, back, manner, wanted)
