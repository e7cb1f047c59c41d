"""One path through a medium, and the way of rays from one voxel to the next."""

from __future__ import annotations

import math

import numba
import numpy as np
from numba.extending import overload, register_jitable

from .arguments import Segments
from .compiling import compiled, inlined


def exp(x):
    raise NotImplementedError


def _of_double(x):
    x = max(x, -700.0)
    shifted = x * 1.4426950408889634 + 6755399441055744.0  # the whole number is in its last bits
    whole = shifted - 6755399441055744.0
    r = (x - whole * 0.693145751953125) - whole * 1.42860682030941723212e-6
    y = 1 / 479001600 * r + 1 / 39916800
    y = (y * r + 1 / 3628800) * r + 1 / 362880
    y = (y * r + 1 / 40320) * r + 1 / 5040
    y = (y * r + 1 / 720) * r + 1 / 120
    y = (y * r + 1 / 24) * r + 1 / 6
    y = (y * r + 1 / 2) * r * r + r + 1.0
    octave = np.float64(shifted).view(np.int64) << np.int64(52)
    return y * np.int64(octave + np.int64(1023 << 52)).view(np.float64)


@overload(exp, jit_options={"forceinline": True})
def _exp_of(x):
    """Of numbers up to 0, by polynomials, which vectorise: in 32 bits (Cephes) to 1 in 10^7, in 64 bits to rounding."""
    if x != numba.float32:
        return _of_double
    f = np.float32
    per_octave, magic, high, low = f(1.44269504), f(12582912.0), f(0.693359375), f(-2.12194440e-4)
    c0, c1, c2, c3, c4, c5 = (
        f(c) for c in (1.9875691e-4, 1.3981999507e-3, 8.3334519073e-3, 4.1665795894e-2, 1.6666665459e-1, 5.0000001201e-1)
    )
    lowest, one, bias, shift = f(-87.0), f(1.0), np.int32(127), np.int32(23)

    def of_single(x):
        x = max(x, lowest)
        shifted = x * per_octave + magic  # the whole number is in its last bits
        whole = shifted - magic
        r = (x - whole * high) - whole * low
        y = ((((c0 * r + c1) * r + c2) * r + c3) * r + c4) * r + c5
        y = y * r * r + r + one
        octave = np.int32(whole)
        return y * np.int32((octave + bias) << shift).view(np.float32)

    return of_single


@inlined
def mean_of(tau):
    """(1 - exp(-tau)) / tau of a thin path."""
    real = type(tau)
    c2, c3, c4, c5, c6, c7 = real(1 / 2), real(1 / 6), real(1 / 24), real(1 / 120), real(1 / 720), real(1 / 5040)
    return real(1) - tau * (c2 - tau * (c3 - tau * (c4 - tau * (c5 - tau * (c6 - tau * c7)))))


@inlined
def bend_of(tau):
    """((1 + exp(-tau)) / 2 - mean) / tau of a thin path."""
    real = type(tau)
    c1, c2, c3, c4, c5, c6 = real(1 / 12), real(1 / 24), real(1 / 80), real(1 / 360), real(1 / 2016), real(1 / 13440)
    return tau * (c1 - tau * (c2 - tau * (c3 - tau * (c4 - tau * (c5 - tau * c6)))))


@register_jitable
def attenuation(tau, thin, limit):
    """exp(-tau), and the mean and the bend of one path."""
    if thin or tau < limit:
        mean = mean_of(tau)
        return 1 - tau * mean, mean, bend_of(tau)
    kept = math.exp(-tau)
    mean = (1 - kept) / tau
    return kept, mean, ((1 + kept) / 2 - mean) / tau


@register_jitable
def _crossing(start, slope, step):
    here, there = start + step * slope, start + (step + 1) * slope
    moved = math.floor(there) - math.floor(here)
    place = here - math.floor(here)
    gap = 1 - place if moved > 0 else place
    when = 1.0 if moved == 0 else min(max(gap / max(abs(slope), 1e-30), 0.0), 1.0)
    return place - 0.5, moved, when


@inlined
def chords(ways, n, step, width, wrap_v, way):
    """The segments between plane `step` and the next, written to `way`; returns how many: the last ones may be empty."""
    share, begin, end, move = way.share, way.begin, way.end, way.move
    p, q, sense = ways.slope[n, 0], ways.slope[n, 1], float(ways.sense[n])
    u, move_u, when_u = _crossing(ways.start[n, 0], p, step)
    v, move_v, when_v = _crossing(ways.start[n, 1], q, step)
    u_first = when_u <= when_v
    first, second = min(when_u, when_v), max(when_u, when_v)
    flat_u, flat_v = int(move_u) * width, 0 if wrap_v and width == 1 else int(move_v)
    move[0], move[1], move[2] = 0, flat_u if u_first else flat_v, flat_v if u_first else flat_u
    share[0], share[1], share[2] = first, second - first, 1 - second
    crossed_u = crossed_v = 0.0
    for number in range(3):
        if number == (1 if u_first else 2):
            crossed_u = float(move_u)
        if number == (2 if u_first else 1):
            crossed_v = float(move_v)
        begins = 0.0 if number == 0 else first if number == 1 else second
        ends = first if number == 0 else second if number == 1 else 1.0
        begin[number, 0], end[number, 0] = sense * (begins - 0.5), sense * (ends - 0.5)
        begin[number, 1] = min(max(u + p * begins - crossed_u, -0.5), 0.5)
        begin[number, 2] = min(max(v + q * begins - crossed_v, -0.5), 0.5)
        end[number, 1] = min(max(u + p * ends - crossed_u, -0.5), 0.5)
        end[number, 2] = min(max(v + q * ends - crossed_v, -0.5), 0.5)
    way.step[0], way.step[1], way.step[2] = sense, p, q
    if share[2] == 0 and move[2] == 0:
        return 1 if share[1] == 0 and move[1] == 0 else 2
    return 3


@inlined
def of_one(way, g):
    """Of several directions' segments, those of one."""
    return Segments(way.share[g], way.begin[g], way.end[g], way.move[g], way.step[g], way.row[g])


@compiled
def join_ends(row, planes):
    """Planes are joined at both ends: what is before the first voxel is the last row, and the other way round."""
    begin, width, end = planes.margin, planes.width, planes.margin + planes.height * planes.width
    before, first, last, behind = row[begin - width : begin], row[begin:], row[end - width : end], row[end:]
    for i in range(width):
        before[i], behind[i] = last[i], first[i]


@compiled
def turn(row, to, move, planes):
    """A step along v where each row's ends are joined."""
    width = planes.width
    for u in range(planes.height):
        a = planes.margin + u * width
        for v in range(width):
            to[a + v] = row[a + (v - move) % width]
    join_ends(to, planes)


@register_jitable
def middle_and_whole(way, number, point, whole):
    for a in range(3):
        whole[a] = way.step[a] * way.share[number]
        point[a] = way.begin[number, a] + whole[a] / 2
