"""Which directions have rays that arrive at an element in its own voxel (see `transport.marks`), and who reads in which."""

from __future__ import annotations

import numpy as np

from ..reading import BEHIND
from .compiling import inlined
from .paths import chords
from .readers import height_of, tilt


@inlined
def _at_rim(k, row, column, around):
    on_rim = around.padded[0] and (k == 0 or k == around.count - 1)
    on_rim |= around.padded[1] and (row == 0 or row == around.height - 1)
    return on_rim | (around.padded[2] and (column == 0 or column == around.width - 1))


@inlined
def _within(i, count):
    """A neighbour's place where the ends are joined."""
    return i + count if i < 0 else i - count if i >= count else i


@inlined
def _clean(around, elements, i, k, number, sense, way):
    """Whether a ray that arrives was outside of solids in the voxel before."""
    row, column, move = elements.row[i], elements.column[i], way.move[number]
    along_v = move if abs(move) == 1 and around.width > 1 else 0
    along_u = (move - along_v) // around.width
    step = sense if number == 0 else 0
    k0, row0 = _within(k - step, around.count), _within(row - along_u, around.height)
    column0 = _within(column - along_v, around.width)
    # Ghost voxels emit at their faces: what leaves them for the lattice has not been inside a solid.
    if _at_rim(k0, row0, column0, around) and not _at_rim(k, row, column, around):
        return True
    before = k0 * around.strides[0] + row0 * around.strides[1] + column0 * around.strides[2]
    above = around.planes[0, before]
    if abs(above) > 0.9:  # further than a voxel's corners
        return above > 0
    above += around.planes[1, before] * (way.begin[number, 0] + step)
    above += around.planes[2, before] * (way.begin[number, 1] + along_u)
    return above + around.planes[3, before] * (way.begin[number, 2] + along_v) > -1e-3


@inlined
def _arrives(face, i, segments, way):
    """In which segments rays arrive at an element, as bits."""
    found = 0
    if tilt(face, i, way.step[0], way.step[1], way.step[2]) < 0:
        for number in range(segments):
            g0, g1 = height_of(face, i, way.begin, number), height_of(face, i, way.end, number)
            if g0 >= -BEHIND and g1 < 0 and way.share[number] > 0 and g0 > g1:
                found |= 1 << number
    return found


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
            found = 0
            for i in range(begun, end):
                if not elements.alike[i]:
                    found = _arrives(elements.face, i, segments, way)
                if found == 0:
                    continue
                clean = True
                for number in range(segments):
                    if found >> number & 1:
                        clean = clean and _clean(around, elements, i, k, number, sense, way)
                if clean:
                    bits[g, word, i] |= bit


def pack(chosen, ways, words, wanted, chunk, place, image, face, own, reads, bits):
    """Set the bits [N, M / 8] of readers in the `chosen` directions: where those of their `image` in `words` [G, words, I] are
    `wanted`, and light comes from before their `face`. `own` [M] and `reads`, of zeros, eight a byte, are room to work in."""
    count, face1, face2, face3 = len(image), face[1], face[2], face[3]
    for j in range(len(chosen)):
        n, before = chosen[j], chosen[max(j - 1, 0)]
        if j == 0 or chunk[n] != chunk[before] or place[n] >> 5 != place[before] >> 5:
            of_word = words[chunk[n], place[n] >> 5]
            for m in range(count):
                own[m] = of_word[image[m]]
        by, a, u, v = np.uint32(place[n] & 31), ways.toward[n, 0], ways.toward[n, 1], ways.toward[n, 2]
        for m in range(count):
            marked, lit = (own[m] >> by) & np.uint32(1) == wanted, face1[m] * a + face2[m] * u + face3[m] * v < 0
            reads[m] = np.uint8(marked & lit)
        for byte in range(bits.shape[1]):
            marks = np.uint8(0)
            for i in range(8):
                marks |= reads[np.uintp(8 * byte + i)] << np.uint8(i)
            bits[n, byte] = marks
