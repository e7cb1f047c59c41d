"""The transpose of `voxels`: from what is asked of a plane of rays after a segment to what that asks of the rays before it, and
of what is sent.

`after` are the rays asked for; `asked` is what elements ask of the rays before, `wanted` what the sums in voxels do.
"""

from __future__ import annotations

from .arguments import EVEN, PATCHY
from .compiling import compiled, inlined
from .paths import attenuation, bend_of, exp, mean_of, middle_and_whole


@compiled
def back_void(after, before, asked, wanted, weight):
    w = after.dtype.type(weight)
    for i in range(len(after)):
        before[i] = asked[i] + after[i] + w * wanted[i]


@compiled
def back_even(after, before, asked, wanted, source, tau, limit, weight):
    real = after.dtype.type
    kept, mean, _ = attenuation(tau, False, limit)
    lost, kept, mean, w = real(tau * mean), real(kept), real(mean), real(weight)
    other = real(1) - mean
    for i in range(len(after)):
        passing = w * wanted[i]
        before[i] = asked[i] + kept * after[i] + mean * passing
        source[i] += lost * after[i] + other * passing


@compiled
def back_patchy(after, before, asked, wanted, source, extinction, depth, length, limit, weight):
    real = after.dtype.type
    kept, mean, _ = attenuation(depth * length, False, limit)
    lost = depth * length * mean if depth * length < limit else 1 - kept
    lost, spent, w = real(lost / depth), real((1 - mean) / depth), real(weight)
    for i in range(len(after)):
        passing = w * wanted[i]
        taken = extinction[i] * (lost * after[i] + spent * passing)
        before[i] = asked[i] + after[i] + passing - taken
        source[i] += taken


@compiled
def back_mixed(after, before, asked, wanted, source, extinction, length, limit, weight):
    real = after.dtype.type
    length, w, limit, one = real(length), real(weight), real(limit), real(1)
    for i in range(len(after)):
        tau, passing = extinction[i] * length, w * wanted[i]
        kept = exp(-tau)
        thin = tau < limit
        mean = mean_of(tau) if thin else (one - kept) / max(tau, limit)
        lost = tau * mean if thin else one - kept
        before[i] = asked[i] + after[i] - lost * after[i] + mean * passing
        source[i] += lost * after[i] + (one - mean) * passing


@compiled
def back_sloped(
    after, before, asked, wanted, source, slope0, slope1, slope2, point, step, even, depth, extinction, length, limit, weight
):
    real = after.dtype.type
    e0, e1, e2 = real(point[0]), real(point[1]), real(point[2])
    s0, s1, s2 = real(step[0]), real(step[1]), real(step[2])
    length, limit, one, half, w = real(length), real(limit), real(1), real(0.5), real(weight)
    for i in range(len(after)):
        tau, passing = (real(depth) if even else extinction[i]) * length, w * wanted[i]
        kept, thick = exp(-tau), max(tau, limit)
        thin = tau < limit
        mean = mean_of(tau) if thin else (one - kept) / thick
        bend = bend_of(tau) if thin else (half * (one + kept) - (one - kept) / thick) / thick
        lost = tau * mean if thin else one - kept
        before[i] = asked[i] + after[i] - lost * after[i] + mean * passing
        source[i] += lost * after[i] + (one - mean) * passing
        off, rise = lost * after[i] - mean * passing, tau * bend * after[i] - bend * passing
        slope0[i] += e0 * off + s0 * rise
        slope1[i] += e1 * off + s1 * rise
        slope2[i] += e2 * off + s2 * rise


@inlined
def back_free(planes, k, c, number, way, length, gone, come, asked, wanted, back, manner, work, weight):
    """One segment as if all voxels were free."""
    even, depth = planes.even[k, c] == EVEN, planes.depth[k, c]
    path, w = way.share[number] * length, weight * way.share[number]
    if not manner.medium or (even and depth == 0):
        back_void(gone, come, asked, wanted, w)
    elif manner.sloped:
        middle_and_whole(way, number, work.point, work.whole)
        slope0, slope1, slope2 = back.slopes[0][k, c], back.slopes[1][k, c], back.slopes[2][k, c]
        extinction = back.source[k, c] if even else planes.extinction[k, c]
        back_sloped(
            gone, come, asked, wanted, back.source[k, c], slope0, slope1, slope2, work.point, work.whole, even, depth,
            extinction, path, manner.limit, w,
        )  # fmt: skip
    elif even:
        back_even(gone, come, asked, wanted, back.source[k, c], depth * path, manner.limit, w)
    elif planes.even[k, c] == PATCHY:
        back_patchy(gone, come, asked, wanted, back.source[k, c], planes.extinction[k, c], depth, path, manner.limit, w)
    else:
        back_mixed(gone, come, asked, wanted, back.source[k, c], planes.extinction[k, c], path, manner.limit, w)


@inlined
def back_ghosts(ghosts, k, c, gone, come, asked, emitted):
    begun = ghosts.first[k]
    cell = ghosts.cell[begun : ghosts.first[k + 1]]
    for i in range(len(cell)):
        emitted[c, begun + i] += gone[cell[i]]
        come[cell[i]] = asked[cell[i]]
