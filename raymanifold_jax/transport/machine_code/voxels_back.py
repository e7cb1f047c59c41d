"""The transpose of `voxels`: from what is asked of a plane of rays after a segment to what that asks of the rays before it, and
of what is sent.

`after` are the rays asked for; `asked` is what elements ask of the rays before, `wanted` what the sums in voxels do.
"""

from __future__ import annotations

from .arguments import EVEN, PATCHY
from .compiling import compiled
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


@compiled
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


@compiled
def back_cut(cells, k, c, number, way, length, after, before, asked, margin, wanted, emitted, manner, here, weight):
    """The transpose of `through_cut`; `here`: what is asked of what is sent there."""
    begun, count = cells.first[k], cells.first[k + 1] - cells.first[k]
    real = after.dtype.type
    cell, emitted = cells.cell[begun : begun + count], emitted[c, begun : begun + count]
    p0, p1 = cells.plane[0, begun : begun + count], cells.plane[1, begun : begun + count]
    p2, p3 = cells.plane[2, begun : begun + count], cells.plane[3, begun : begun + count]
    e0, e1, e2 = real(way.begin[number, 0]), real(way.begin[number, 1]), real(way.begin[number, 2])
    s0, s1, s2 = real(way.step[0]), real(way.step[1]), real(way.step[2])
    share, w, tiny, zero, one, half = real(way.share[number]), real(weight), real(1e-20), real(0), real(1), real(0.5)
    rays, passing, length, limit = here[0, :count], here[1, :count], real(length), real(manner.limit)
    source, a, u, v = here[2, :count], here[3, :count], here[4, :count], here[5, :count]
    for j in range(count):
        rays[j], passing[j] = after[margin + cell[j]], wanted[cell[j]]
    extinction = cells.extinction[c, begun : begun + count] if manner.medium else p0
    for j in range(count):
        slope = p1[j] * s0 + p2[j] * s1 + p3[j] * s2
        g0 = p0[j] + p1[j] * e0 + p2[j] * e1 + p3[j] * e2
        g1 = g0 + share * slope
        free = max(min(max(g0, g1) / (abs(slope) + tiny), share), zero)
        start = share - free if g0 < zero else zero
        gone = zero if g1 < zero else rays[j]
        asks = w * free * passing[j]
        tau = extinction[j] * length * free if manner.medium else zero
        kept, thick = exp(-tau), max(tau, limit)
        thin = tau < limit
        mean = mean_of(tau) if thin else (one - kept) / thick
        bend = bend_of(tau) if thin else (half * (one + kept) - (one - kept) / thick) / thick
        lost = tau * mean if thin else one - kept
        radiance = gone - lost * gone + mean * asks
        source[j] += lost * gone + (one - mean) * asks
        off, rise, time = lost * gone - mean * asks, (tau * gone - asks) * bend * free, start + half * free
        a[j] += (e0 + s0 * time) * off + s0 * rise
        u[j] += (e1 + s1 * time) * off + s1 * rise
        v[j] += (e2 + s2 * time) * off + s2 * rise
        emitted[j] += (rays[j] if g1 < zero else zero) + (radiance if g0 < zero else zero)
        rays[j] = zero if g0 < zero else radiance
    for j in range(count):
        before[margin + cell[j]] = rays[j] + asked[cell[j]]


@compiled
def keep_cut(cells, k, c, back, manner, here):
    """What has been asked so far of the CUT voxels of a plane: loops over the whole plane write there too."""
    begun = cells.first[k]
    for j in range(cells.first[k + 1] - begun):
        cell = cells.cell[begun + j]
        for row in range(2, 6):
            here[row, j] = 0.0
        if manner.medium:
            here[6, j] = back.source[k, c, cell]
        if manner.sloped:
            for a in range(3):
                here[7 + a, j] = back.slopes[a][k, c, cell]


@compiled
def give_cut(cells, k, c, back, manner, here):
    begun = cells.first[k]
    for j in range(cells.first[k + 1] - begun):
        cell = cells.cell[begun + j]
        if manner.medium:
            back.source[k, c, cell] = here[6, j] + here[2, j]
        if manner.sloped:
            for a in range(3):
                back.slopes[a][k, c, cell] = here[7 + a, j] + here[3 + a, j]


@compiled
def back_ghosts(ghosts, k, c, after, before, asked, margin, emitted):
    for j in range(ghosts.first[k], ghosts.first[k + 1]):
        cell = ghosts.cell[j]
        emitted[c, j] += after[margin + cell]
        before[margin + cell] = asked[cell]
