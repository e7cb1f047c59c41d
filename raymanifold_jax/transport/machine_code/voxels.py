"""One segment of a direction's rays through a plane: the voxels that are free, and ghosts."""

from __future__ import annotations

from numba.extending import register_jitable

from .arguments import EVEN, PATCHY, TOGETHER
from .compiling import compiled, inlined
from .paths import attenuation, bend_of, exp, mean_of, middle_and_whole, of_one


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


@register_jitable
def _lost_and_spent(depth, length, limit):
    """What a path takes of a ray's end and of its mean, for each unit of extinction."""
    kept, mean, _ = attenuation(depth * length, False, limit)
    lost = depth * length * mean if depth * length < limit else 1 - kept
    return lost / depth, (1 - mean) / depth


@compiled
def through_patchy(before, after, source, sums, extinction, depth, length, limit, weight):
    """Where the extinction is `depth` or none."""
    real = before.dtype.type
    lost, spent = _lost_and_spent(depth, length, limit)
    lost, spent, w = real(lost), real(spent), real(weight)
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


@compiled
def through_four_void(before, after, sums, weight):
    b0, b1, b2, b3 = before
    a0, a1, a2, a3 = after
    w0, w1, w2, w3 = weight
    for i in range(len(a0)):
        r0, r1, r2, r3 = b0[i], b1[i], b2[i], b3[i]
        a0[i], a1[i], a2[i], a3[i] = r0, r1, r2, r3
        sums[i] += (w0 * r0 + w1 * r1) + (w2 * r2 + w3 * r3)


@compiled
def through_four_even(before, after, source, sums, lost, mean, weight):
    """Four directions at once: what they share of a plane is read, and what is summed is written, once for all of them."""
    b0, b1, b2, b3 = before
    a0, a1, a2, a3 = after
    l0, l1, l2, l3 = lost
    m0, m1, m2, m3 = mean
    w0, w1, w2, w3 = weight
    for i in range(len(a0)):
        s, r0, r1, r2, r3 = source[i], b0[i], b1[i], b2[i], b3[i]
        e0, e1, e2, e3 = r0 - s, r1 - s, r2 - s, r3 - s
        a0[i], a1[i], a2[i], a3[i] = r0 - l0 * e0, r1 - l1 * e1, r2 - l2 * e2, r3 - l3 * e3
        sums[i] += (w0 * (s + m0 * e0) + w1 * (s + m1 * e1)) + (w2 * (s + m2 * e2) + w3 * (s + m3 * e3))


@compiled
def through_four_patchy(before, after, source, sums, extinction, lost, spent, weight):
    b0, b1, b2, b3 = before
    a0, a1, a2, a3 = after
    l0, l1, l2, l3 = lost
    s0, s1, s2, s3 = spent
    w0, w1, w2, w3 = weight
    for i in range(len(a0)):
        x, s, r0, r1, r2, r3 = extinction[i], source[i], b0[i], b1[i], b2[i], b3[i]
        e0, e1, e2, e3 = x * (r0 - s), x * (r1 - s), x * (r2 - s), x * (r3 - s)
        a0[i], a1[i], a2[i], a3[i] = r0 - l0 * e0, r1 - l1 * e1, r2 - l2 * e2, r3 - l3 * e3
        sums[i] += (w0 * (r0 - s0 * e0) + w1 * (r1 - s1 * e1)) + (w2 * (r2 - s2 * e2) + w3 * (r3 - s3 * e3))


@compiled
def through_four_thin(before, after, source, sums, extinction, length, weight):
    b0, b1, b2, b3 = before
    a0, a1, a2, a3 = after
    l0, l1, l2, l3 = length
    w0, w1, w2, w3 = weight
    for i in range(len(a0)):
        x, s, r0, r1, r2, r3 = extinction[i], source[i], b0[i], b1[i], b2[i], b3[i]
        t0, t1, t2, t3 = x * l0, x * l1, x * l2, x * l3
        e0, e1, e2, e3 = mean_of(t0) * (r0 - s), mean_of(t1) * (r1 - s), mean_of(t2) * (r2 - s), mean_of(t3) * (r3 - s)
        a0[i], a1[i], a2[i], a3[i] = r0 - t0 * e0, r1 - t1 * e1, r2 - t2 * e2, r3 - t3 * e3
        sums[i] += (w0 * (s + e0) + w1 * (s + e1)) + (w2 * (s + e2) + w3 * (s + e3))


@inlined
def rays_of(g, number, planes, work):
    """A direction's rays before a segment, each in the voxel it passes next, and where they are written behind it."""
    margin, size, way = planes.margin, planes.height * planes.width, of_one(work.way, g)
    before, after, move = work.rows[way.row[number]], work.rows[way.row[number + 1]], way.move[number]
    return before[margin - move : margin - move + size], after[margin : margin + size]


@inlined
def _alone(planes, k, c, g, number, light, manner, work, sums):
    even, depth, share = planes.even[k, c] == EVEN, planes.depth[k, c], work.way.share[g, number]
    come, gone = rays_of(g, number, planes, work)
    path, w = share * work.length[g], work.weight[g] * share
    if even and depth == 0:
        through_void(come, gone, sums, w)
    elif manner.sloped:
        middle_and_whole(of_one(work.way, g), number, work.point, work.whole)
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
def _thin_together(planes, k, c, number, manner, work):
    """Whether enough of four directions pass, and what they pass is thin, or is all the same to a program."""
    passing, longest = 0, 0.0
    for g in range(TOGETHER):
        if number < work.count[g]:
            passing, longest = passing + 1, max(longest, work.way.share[g, number] * work.length[g])
    if passing < TOGETHER - 1:
        return False
    even = planes.even[k, c]
    return planes.depth[k, c] * longest < manner.limit if even == EVEN else manner.thin or even == PATCHY


@inlined
def _together(planes, k, c, number, light, manner, work, sums):
    real, share, length, weight = sums.dtype.type, work.way.share, work.length, work.weight
    (b0, a0), (b1, a1) = rays_of(0, number, planes, work), rays_of(1, number, planes, work)
    (b2, a2), (b3, a3) = rays_of(2, number, planes, work), rays_of(3, number, planes, work)
    rays, source = ((b0, b1, b2, b3), (a0, a1, a2, a3)), light.source[k, c]
    l0, l1, l2, l3 = (
        share[0, number] * length[0], share[1, number] * length[1], share[2, number] * length[2], share[3, number] * length[3],
    )  # fmt: skip
    w = (
        real(share[0, number] * weight[0]), real(share[1, number] * weight[1]),
        real(share[2, number] * weight[2]), real(share[3, number] * weight[3]),
    )  # fmt: skip
    depth, limit = planes.depth[k, c], manner.limit
    if planes.even[k, c] == EVEN and depth == 0:
        through_four_void(*rays, sums, w)
    elif planes.even[k, c] == EVEN:
        t0, t1, t2, t3 = depth * l0, depth * l1, depth * l2, depth * l3
        mean = real(mean_of(t0)), real(mean_of(t1)), real(mean_of(t2)), real(mean_of(t3))
        lost = real(t0) * mean[0], real(t1) * mean[1], real(t2) * mean[2], real(t3) * mean[3]
        through_four_even(*rays, source, sums, lost, mean, w)
    elif planes.even[k, c] == PATCHY:
        lost0, spent0 = _lost_and_spent(depth, l0, limit)
        lost1, spent1 = _lost_and_spent(depth, l1, limit)
        lost2, spent2 = _lost_and_spent(depth, l2, limit)
        lost3, spent3 = _lost_and_spent(depth, l3, limit)
        lost = real(lost0), real(lost1), real(lost2), real(lost3)
        spent = real(spent0), real(spent1), real(spent2), real(spent3)
        through_four_patchy(*rays, source, sums, planes.extinction[k, c], lost, spent, w)
    else:
        through_four_thin(*rays, source, sums, planes.extinction[k, c], (real(l0), real(l1), real(l2), real(l3)), w)


@inlined
def through_free(planes, k, c, number, many, light, manner, work, sums):
    """One segment of several directions as if all voxels were free."""
    if not manner.sloped and _thin_together(planes, k, c, number, manner, work):
        _together(planes, k, c, number, light, manner, work, sums)
        return
    for g in range(many):
        if number < work.count[g]:
            _alone(planes, k, c, g, number, light, manner, work, sums)


@inlined
def light_of_ghosts(ghosts, k, c, n, ways, light, sent):
    """What the ghost voxels of a plane send in a direction: their surfaces' light, and what comes in through open sides."""
    first, last = ghosts.first[k], ghosts.first[k + 1]
    own, image, factor = light.ghost[c, first:last], ghosts.image[first:last], light.factor[c, first:last]
    for i in range(len(own)):
        sent[i] = own[i]
    if light.radiance.shape[0]:
        for i in range(len(own)):
            if image[i] >= 0:
                sent[i] += light.radiance[image[i], ways.index[n], c] * factor[i]


@inlined
def from_ghosts(ghosts, k, gone, sent):
    cell = ghosts.cell[ghosts.first[k] : ghosts.first[k + 1]]
    if len(cell) == len(gone):  # all of the plane, in order
        for i in range(len(gone)):
            gone[i] = sent[i]
        return
    for i in range(len(cell)):
        gone[cell[i]] = sent[i]
