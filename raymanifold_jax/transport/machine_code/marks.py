"""Which directions have rays that arrive at an element in its own voxel (see `transport.marks`), and who reads in which."""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from ..reading import BEHIND
from .paths import chords
from .readers import height_of, tilt


@register_jitable
def _at_rim(k, row, column, around):
    on_rim = around.padded[0] and (k == 0 or k == around.count - 1)
    on_rim |= around.padded[1] and (row == 0 or row == around.height - 1)
    return on_rim | (around.padded[2] and (column == 0 or column == around.width - 1))


@register_jitable
def _clean(around, elements, i, k, number, sense, way):
    """Whether a ray that arrives was outside of solids in the voxel before."""
    row, column, move = elements.row[i], elements.column[i], way.move[number]
    along_v = move if abs(move) == 1 and around.width > 1 else 0
    along_u = (move - along_v) // around.width
    step = sense if number == 0 else 0
    k0, row0, column0 = (k - step) % around.count, (row - along_u) % around.height, (column - along_v) % around.width
    # Ghost voxels emit at their faces: what leaves them for the lattice has not been inside a solid.
    if _at_rim(k0, row0, column0, around) and not _at_rim(k, row, column, around):
        return True
    before = k0 * around.strides[0] + row0 * around.strides[1] + column0 * around.strides[2]
    above = around.planes[0, before] + around.planes[1, before] * (way.begin[number, 0] + step)
    above += around.planes[2, before] * (way.begin[number, 1] + along_u)
    return above + around.planes[3, before] * (way.begin[number, 2] + along_v) > -1e-3


def mark(chosen, ways, around, elements, chunk, place, way, bits):
    """Set the bits [G, words, I] of the `chosen` directions, which have a `place` in a `chunk` each."""
    for n in chosen:
        sense, g, word = ways.sense[n], chunk[n], place[n] >> 5
        bit = 1 << (place[n] & 31)
        for k in range(around.count):
            begun, end = elements.first[k], elements.first[k + 1]
            if begun == end:
                continue
            when = k if sense > 0 else around.count - 1 - k
            segments = chords(ways, n, when, around.width, not around.padded[2], way)
            for i in range(begun, end):
                if tilt(elements.face, i, way.step[0], way.step[1], way.step[2]) >= 0:
                    continue
                found, clean = False, True
                for number in range(segments):
                    g0, g1 = height_of(elements.face, i, way.begin, number), height_of(elements.face, i, way.end, number)
                    if g0 >= -BEHIND and g1 < 0 and way.share[number] > 0 and g0 > g1:
                        found, clean = True, clean and _clean(around, elements, i, k, number, sense, way)
                if found and clean:
                    bits[g, word, i] |= bit


def pack(chosen, ways, words, wanted, chunk, place, image, face, bits):
    """Set the bits [N, M / 8] of readers in the `chosen` directions: where those of their `image` in `words` [G, words, I] are
    `wanted`, and light comes from before their `face`."""
    for n in chosen:
        of_word, by = words[chunk[n], place[n] >> 5], np.uint32(place[n] & 31)
        a, u, v = ways.toward[n, 0], ways.toward[n, 1], ways.toward[n, 2]
        for byte in range(bits.shape[1]):
            marks = np.uint8(0)
            for m in range(8 * byte, min(8 * byte + 8, len(image))):
                reads = ((of_word[image[m]] >> by) & np.uint32(1)) == wanted
                reads &= face[1, m] * a + face[2, m] * u + face[3, m] * v < 0
                marks |= np.uint8(reads) << np.uint8(m & 7)
            bits[n, byte] = marks
