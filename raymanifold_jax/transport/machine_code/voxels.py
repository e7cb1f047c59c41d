"""One segment of a direction's rays through a plane: the voxels that are free, and ghosts."""

from __future__ import annotations

from .arguments import EVEN, PATCHY
from .compiling import compiled, inlined
from .paths import attenuation, bend_of, exp, mean_of, middle_and_whole


@compiled
def through_even(before, after, source, sums, tau, limit, weight):
    real = before.dtype.type
    kept, mean, _ = attenuation(tau, False, limit)
    mean, w = real(mean), real(weight)
    if tau < limit:
        lost = real(tau) * mean
        for i in range(len(after)):
            excess = before[i] - source[i]
            after[i] = before[i] - lost * excess
            sums[i] += w * (source[i] + mean * excess)
    else:
        kept = real(kept)
        for i in range(len(after)):
            excess = before[i] - source[i]
            after[i] = source[i] + kept * excess
            sums[i] += w * (source[i] + mean * excess)


@compiled
def through_patchy(before, after, source, sums, extinction, depth, length, limit, weight):
    """Where the extinction is `depth` or none."""
    real = before.dtype.type
    kept, mean, _ = attenuation(depth * length, False, limit)
    lost = depth * length * mean if depth * length < limit else 1 - kept
    lost, spent, w = real(lost / depth), real((1 - mean) / depth), real(weight)
    for i in range(len(after)):
        excess = before[i] - source[i]
        after[i] = before[i] - lost * extinction[i] * excess
        sums[i] += w * (before[i] - spent * extinction[i] * excess)


@compiled
def through_void(before, after, sums, weight):
    w = before.dtype.type(weight)
    for i in range(len(after)):
        after[i] = before[i]
        sums[i] += w * before[i]


@compiled
def through_thin(before, after, source, sums, extinction, length, weight):
    real = before.dtype.type
    length, w = real(length), real(weight)
    for i in range(len(after)):
        tau = extinction[i] * length
        excess = mean_of(tau) * (before[i] - source[i])
        after[i] = before[i] - tau * excess
        sums[i] += w * (source[i] + excess)


@compiled
def through_mixed(before, after, source, sums, extinction, length, limit, weight):
    real = before.dtype.type
    length, w, limit, one = real(length), real(weight), real(limit), real(1)
    for i in range(len(after)):
        tau = extinction[i] * length
        kept, excess = exp(-tau), before[i] - source[i]
        thin = tau < limit
        mean = mean_of(tau) if thin else (one - kept) / max(tau, limit)
        after[i] = before[i] - tau * mean * excess if thin else source[i] + kept * excess
        sums[i] += w * (source[i] + mean * excess)


@compiled
def through_sloped(before, after, source, slopes, sums, point, step, even, depth, extinction, length, limit, weight):
    """The same where the source is linear: point and step are the path's middle from the voxel's, and its whole."""
    real = before.dtype.type
    e0, e1, e2 = real(point[0]), real(point[1]), real(point[2])
    s0, s1, s2 = real(step[0]), real(step[1]), real(step[2])
    w, slope0, slope1, slope2 = real(weight), slopes[0], slopes[1], slopes[2]
    if even:
        kept, mean, bend = attenuation(depth * length, False, limit)
        lost, kept, mean, onto, bend = real(1 - kept), real(kept), real(mean), real(depth * length * bend), real(bend)
        thin = depth * length < limit
        if thin:
            lost = real(depth * length) * mean
        for i in range(len(after)):
            off = slope0[i] * e0 + slope1[i] * e1 + slope2[i] * e2
            rise = slope0[i] * s0 + slope1[i] * s1 + slope2[i] * s2
            excess = before[i] - (source[i] + off)
            after[i] = (before[i] - lost * excess if thin else source[i] + off + kept * excess) + onto * rise
            sums[i] += w * (source[i] + mean * excess - bend * rise)
        return
    length, limit, one, half = real(length), real(limit), real(1), real(0.5)
    for i in range(len(after)):
        off = slope0[i] * e0 + slope1[i] * e1 + slope2[i] * e2
        rise = slope0[i] * s0 + slope1[i] * s1 + slope2[i] * s2
        tau = extinction[i] * length
        kept, excess = exp(-tau), before[i] - (source[i] + off)
        thin, thick = tau < limit, max(tau, limit)
        mean = mean_of(tau) if thin else (one - kept) / thick
        bend = bend_of(tau) if thin else (half * (one + kept) - (one - kept) / thick) / thick
        end = before[i] - tau * mean * excess if thin else source[i] + off + kept * excess
        after[i] = end + tau * bend * rise
        sums[i] += w * (source[i] + mean * excess - bend * rise)


@inlined
def through_free(planes, k, c, number, way, length, come, gone, light, manner, work, sums, weight):
    """One segment as if all voxels were free."""
    even, depth = planes.even[k, c] == EVEN, planes.depth[k, c]
    path, w = way.share[number] * length, weight * way.share[number]
    if even and depth == 0:
        through_void(come, gone, sums, w)
    elif manner.sloped:
        middle_and_whole(way, number, work.point, work.whole)
        slopes = light.slopes[0][k, c], light.slopes[1][k, c], light.slopes[2][k, c]
        extinction = light.source[k, c] if even else planes.extinction[k, c]
        through_sloped(
            come, gone, light.source[k, c], slopes, sums, work.point, work.whole, even, depth, extinction, path, manner.limit, w
        )
    elif even:
        through_even(come, gone, light.source[k, c], sums, depth * path, manner.limit, w)
    elif planes.even[k, c] == PATCHY:
        through_patchy(come, gone, light.source[k, c], sums, planes.extinction[k, c], depth, path, manner.limit, w)
    elif manner.thin:
        through_thin(come, gone, light.source[k, c], sums, planes.extinction[k, c], path, w)
    else:
        through_mixed(come, gone, light.source[k, c], sums, planes.extinction[k, c], path, manner.limit, w)


@inlined
def light_of_ghosts(ghosts, k, c, n, ways, light, sent):
    """What the ghost voxels of a plane send in a direction: their surfaces' light, and what comes in through open sides."""
    begun = ghosts.first[k]
    for i in range(ghosts.first[k + 1] - begun):
        sent[i] = light.ghost[c, begun + i]
        image = ghosts.image[begun + i]
        if light.radiance.shape[0] and image >= 0:
            sent[i] += light.radiance[image, ways.index[n], c] * light.factor[c, begun + i]


@inlined
def from_ghosts(ghosts, k, gone, sent):
    cell = ghosts.cell[ghosts.first[k] : ghosts.first[k + 1]]
    for i in range(len(cell)):
        gone[cell[i]] = sent[i]
