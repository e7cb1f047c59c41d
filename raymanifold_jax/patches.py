"""Light straight from emitting surfaces to the elements, by patches as large as the distance allows.

Emitting elements are cut into small faces. These are joined again step by step, where they lie side by side and face about
the same way, into patches of twice the size. An element takes light from each patch that is at most `_WIDTH` times its
distance wide (compare hierarchical radiosity: Hanrahan, Salzman & Aupperle, SIGGRAPH 1991):

    E(x) = sum over patches of  L A <cos(theta) cos(theta') / r^2> T V.

The mean <> is over four points that have the patch's second moments; visibility V and transmittance T are those of one ray, to
a face of its middle. Where a solid comes nearer to that ray than the patch is wide, the patch's parts are looked at instead.

Public: `light_of_emitters`, `may_serve`.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from . import checks
from .arrays import stop_gradient, worked_out_now
from .directions import frames
from .emitters import CLEARANCE, SMALL, EmittingFaces, emitting_faces, share_that_emits
from .march import transmittance_unfolded
from .programs import program
from .scene import OPEN, Scene, Wall
from .surfaces import Surfaces, distance_to_solids, patch_points
from .trace import ROUNDS, Patch, go_on_looking, look_at_patch
from .unfolding import in_blocks, mirror_images, unfolded_axes

_WIDTH = 0.35  # of a patch, at most, for its distance
_FINER = 4.0  # times, where only a part of a curved patch can be seen
_ROUNDS = 5  # of taking parts instead, where not all of a patch may be seen
_RADIUS = 0.8  # of a curved patch, for its size
_FACES = 8  # along an element's side; half of it where there are many
_MANY = 4096
_NEXT = 2.0  # voxels: elements nearer to an emitter than this are looked at in more points than their middles
_CONSERVING = 0.8, 1.25  # times, at most
_POINTS = 3  # along their sides
_BLOCK = 1 << 11  # elements at once
_MINOR = 2e-3  # of an element's light: patches that send less are seen or not seen as a whole
_FAINT = 1e-6  # of an element's light: no ray for less
_SAMPLE = 256
_MOST = 0.5  # of the surfaces
_TOLERANCE = 3e-3  # rms over elements, of their mean: what the sweep's directions may be off
_CODES = 125  # of normals: what faces about the same way has the same


class _Patches(NamedTuple):
    """Patches of all sizes; lengths are in voxels, positions in unfolded voxel coordinates."""

    size: Float[np.ndarray, " n"]  # of the cells that they are in
    radius: Float[np.ndarray, " n"]  # around the centre
    center: Float[np.ndarray, "n 3"]
    normal: Float[np.ndarray, "n 3"]
    arms: Float[np.ndarray, "n 2 3"]  # from the centre to two of the four points
    area: Float[np.ndarray, " n"]  # of its projection along the normal
    turn: Float[np.ndarray, " n"]  # radians: how far its parts' normals are from its own, at most
    owner: Int[np.ndarray, " n"]
    target: Float[np.ndarray, "n 3"]  # where its ray ends
    first: Int[np.ndarray, " n"]  # its parts: rows first to first + count; none of the smallest
    count: Int[np.ndarray, " n"]
    topmost: Bool[np.ndarray, " n"]  # no parts of others


class _Pairs(NamedTuple):
    """Elements, numbered within a block, and patches they look at."""

    element: Int[np.ndarray, " p"]
    patch: Int[np.ndarray, " p"]
    geometry: Float[np.ndarray, " p"]  # A <cos cos' / r^2>

    def kept(self, chosen: np.ndarray) -> _Pairs:
        return _Pairs(*(values[chosen] for values in self))

    @staticmethod
    def joined(parts: list[_Pairs]) -> _Pairs:
        if not parts:
            return _Pairs(np.zeros(0, int), np.zeros(0, int), np.zeros(0))
        return _Pairs(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def may_serve(scene: Scene, surfaces: Surfaces) -> bool:
    """Whether patches could do better than the sweep.

    Not where most of the surfaces emit, and light is nearly even; nor where light goes around by mirrors or periodic sides
    without end.
    """
    endless = any(axis.endless for axis in unfolded_axes(scene))
    return not endless and 0 < share_that_emits(scene, surfaces) <= _MOST


def light_of_emitters(
    scene: Scene, surfaces: Surfaces, radiance: Float[Array, "C owners"], swept: Float[Array, "C E"], total: Float[Array, "C E"]
) -> Float[Array, "C E"] | None:
    """Irradiance of the elements by a `radiance` of the emitting solids and sides; None where the sweep will do.

    That is where its directions are good enough: where what was `swept` of the same is near enough, for the `total`, as some
    elements tell. While JAX stages a program none does; then emitters that cover more than a small part are left to the sweep.
    """
    share = share_that_emits(scene, surfaces)
    known = lax.stop_gradient((radiance, swept, total, scene.medium))
    if checks.is_traced(known) and share > SMALL:
        return None
    side = _FACES if share * len(surfaces) <= _MANY else _FACES // 2
    faces = emitting_faces(scene, surfaces, side)
    patches = _patches(scene, faces, side)
    if not checks.is_traced(known):
        rows = _sample(surfaces)
        exact, *_ = _arriving(stop_gradient(scene), patches, surfaces, rows, known[0])
        off = np.sqrt(np.mean((np.asarray(known[1])[:, rows] - np.asarray(exact)) ** 2, axis=1))
        if np.all(off <= _TOLERANCE * np.asarray(known[2])[:, rows].mean(1)):
            return None
    found, unattenuated, near = _arriving(scene, patches, surfaces, np.arange(len(surfaces)), radiance)
    return found * jnp.asarray(_conserving(scene, surfaces, faces, unattenuated, near), found.dtype)


def _sample(surfaces: Surfaces) -> np.ndarray:
    """Some elements, evenly by area."""
    share = np.cumsum(surfaces.area) / surfaces.area.sum()
    return np.unique(np.searchsorted(share, (np.arange(_SAMPLE) + 0.5) / _SAMPLE))


def _conserving(
    scene: Scene, surfaces: Surfaces, faces: EmittingFaces, unattenuated: np.ndarray, near: np.ndarray
) -> Float[np.ndarray, " E"]:
    """Factors by which all the power sent would arrive in vacuum: of the elements next to emitters, the least exact.

    Of all elements where none is: read at their middles, they have .2 % too much at 16^3.
    """
    factor, received = np.ones(len(surfaces)), unattenuated * surfaces.area
    least_exact = near if near.any() else np.ones(len(surfaces), bool)
    if received[least_exact].sum() > 0 and all(side is OPEN or isinstance(side, Wall) for side in scene.boundary.sides):
        missing = np.pi * faces.area.sum() - received.sum()
        factor[least_exact] = np.clip(1 + missing / received[least_exact].sum(), *_CONSERVING)
    return factor  # with mirrors, some of it leaves through them


# The patches


def _patches(scene: Scene, faces: EmittingFaces, side: int) -> _Patches:
    """From the smallest to the one or the few that nothing can be joined to."""
    spacing = scene.lattice.spacing
    faces = faces._replace(position=(faces.position - scene.lattice.lower) / spacing, area=faces.area / spacing**2)
    faces = _with_images(scene, faces)
    size, middle = 1 / side, np.asarray(scene.lattice.shape) / 2
    two = frames(faces.normal)[:, :2]
    moments = np.einsum("nki,nkj->nij", two, two) * (size**2 / 12) + faces.position[:, :, None] * faces.position[:, None]
    none = np.zeros(len(faces.area), int)
    flat = np.zeros(len(faces.area))
    steps = [_Patches(
        size=np.full(len(flat), size), radius=np.full(len(flat), size / np.sqrt(2)), center=faces.position, normal=faces.normal,
        arms=_arms(faces.position, faces.normal, moments), area=faces.area, turn=flat, owner=faces.owner,
        target=faces.position, first=none, count=none, topmost=none > 0,
    )]  # fmt: skip
    code, begin = (np.round(2 * faces.normal).astype(int) + 2) @ np.array([25, 5, 1]), 0
    while size < 2 * max(scene.lattice.shape) and len(steps[-1].area) > 1:
        size *= 2
        # Counted from the middle either way, so that a turned scene has the turned patches.
        away = np.round(steps[-1].center - middle, 6)
        cell = np.floor(np.abs(away) / size).astype(int)
        cell = np.where(away < 0, -1 - cell, cell)
        cell -= cell.min(0)
        key = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(0) + 1)) * _CODES + code
        key = key * (int(faces.owner.max()) + 1) + steps[-1].owner
        order = np.argsort(key, kind="stable")
        parts = steps[-1] = _Patches(*(values[order] for values in steps[-1]))
        first = np.nonzero(np.diff(key[order], prepend=-1))[0]
        moments, joined = _joined(parts, moments[order], first, size)
        # What has one part is that part, whose own parts it has.
        alone, begin = joined.count == 1, begin + len(parts.area)
        joined = joined._replace(first=joined.first + begin - len(parts.area))
        steps.append(_Patches(*(_where(alone, whole[first], new) for whole, new in zip(parts, joined, strict=True))))
        code = code[order][first]
    patches = _Patches(*(np.concatenate(values) for values in zip(*steps, strict=True)))
    return patches._replace(topmost=np.arange(len(patches.area)) >= begin)


def _where(chosen: np.ndarray, ones: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Rows of one or the other."""
    return np.where(chosen.reshape(-1, *[1] * (ones.ndim - 1)), ones, others)


def _joined(parts: _Patches, moments: np.ndarray, first: np.ndarray, size: float) -> tuple[np.ndarray, _Patches]:
    """Patches of the parts from each `first` on up to the next, and their moments."""
    count = np.diff(first, append=len(parts.area))
    total = np.add.reduceat(parts.area, first)
    like = lambda weights, values: weights.reshape(-1, *[1] * (values.ndim - 1))
    mean = lambda values: np.add.reduceat(values * like(parts.area, values), first) / like(total, values)
    center, moments, normal = mean(parts.center), mean(moments), mean(parts.normal)
    # A curved patch shows less of itself than its area, as a vector.
    shown = np.linalg.norm(normal, axis=1)
    normal, area = normal / shown[:, None], total * shown
    whole = np.repeat(np.arange(len(first)), count)
    off = ((parts.target - center[whole]) ** 2).sum(1)
    nearest = np.lexsort((off, whole))[first]
    turned = np.arccos(np.clip((parts.normal * normal[whole]).sum(1), -1, 1))
    turn = np.maximum.reduceat(parts.turn + np.where(turned > 1e-3, turned, 0.0), first)
    # Flat ones reach as far as their parts, which may lie apart.
    reach = np.maximum.reduceat(np.linalg.norm(parts.center - center[whole], axis=1) + parts.radius, first)
    return moments, _Patches(
        size=np.full(len(first), size), radius=np.where(turn > 0, _RADIUS * size, reach), center=center, normal=normal,
        arms=_arms(center, normal, moments), area=area, turn=turn, owner=parts.owner[first],
        target=np.where((turn > 0)[:, None], parts.target[nearest], center), first=first, count=count,
        topmost=np.zeros(len(first), bool),
    )  # fmt: skip


def _arms(center: np.ndarray, normal: np.ndarray, moments: np.ndarray) -> Float[np.ndarray, "n 2 3"]:
    """From the centre to two of the four points; `moments` are means of the products of coordinates."""
    two = frames(normal)[:, :2]
    spread = np.einsum("nki,nij,nlj->nkl", two, moments - center[:, :, None] * center[:, None], two)
    # Along their principal axes: a slender patch may lie askew.
    (one, mixed), (_, other) = spread.transpose(1, 2, 0)
    askew = np.abs(mixed) > 1e-9 * (one + other)
    angle = np.where(askew, np.arctan2(2 * mixed, one - other) / 2, 0.0)
    cos, sin = np.cos(angle), np.sin(angle)
    turned = np.array([[cos, sin], [-sin, cos]]).transpose(2, 0, 1)
    along = np.einsum("nki,nij,nkj->nk", turned, spread, turned)
    # At sqrt(2) times the deviations the four have the patch's second moments.
    return (turned @ two) * np.sqrt(2 * np.maximum(along, 0.0))[..., None]


def _with_images(scene: Scene, faces: EmittingFaces) -> EmittingFaces:
    """And what is seen of them behind mirrors; positions in unfolded voxel coordinates."""
    images = [
        faces._replace(position=faces.position * sign + shift, normal=faces.normal * sign)
        for sign, shift in mirror_images(scene)
    ]
    return EmittingFaces(*(np.concatenate(parts) for parts in zip(*images, strict=True)))


# Who looks at which


def _arriving(
    scene: Scene, patches: _Patches, surfaces: Surfaces, rows: np.ndarray, radiance: Float[Array, "C owners"]
) -> tuple[Float[Array, "C n"], Float[np.ndarray, " n"], Bool[np.ndarray, " n"]]:
    """The mean irradiance of some elements; what it would be without a medium, of radiance 1; which are next to emitters."""
    still, parts, unattenuated = _still(scene), [], []
    receiver, position, weight = _receivers(still, patches, surfaces, rows)
    normal, material = surfaces.normal[rows][receiver], surfaces.material[rows][receiver]
    for begin in range(0, len(receiver), _BLOCK):
        facing, share, solid = (values[begin : begin + _BLOCK] for values in (normal, weight, material))
        start = position[begin : begin + _BLOCK] + CLEARANCE * facing
        with worked_out_now():
            pairs = _seen(still, patches, start, facing, solid)
        unattenuated.append(share * np.bincount(pairs.element, pairs.geometry, len(start)))
        parts.append(_light(scene, patches, pairs, start, radiance) * jnp.asarray(share, radiance.dtype))
    found = jnp.zeros((radiance.shape[0], len(rows)), radiance.dtype).at[:, receiver].add(jnp.concatenate(parts, -1))
    near = np.bincount(receiver, minlength=len(rows)) > 1
    return found, np.bincount(receiver, np.concatenate(unattenuated), len(rows)), near


def _still(scene: Scene) -> Scene:
    """The scene without derivatives, and with 0 for what JAX stages: not its shapes, which are all that sight depends on."""
    zero = lambda a: np.zeros(a.shape, a.dtype) if checks.is_traced(a) else a
    return jax.tree.map(zero, stop_gradient(scene))


def _receivers(scene: Scene, patches: _Patches, surfaces: Surfaces, rows: np.ndarray) -> tuple[np.ndarray, ...]:
    """Points for the elements: which one's, where (in voxels), and its share. One each, more of those next to emitters."""
    from scipy.spatial import KDTree  # 0.2 s, for scenes with emitters

    position = (surfaces.position[rows] - scene.lattice.lower) / scene.lattice.spacing
    ends = patches.center[patches.count == 0]
    distance, nearest = (np.asarray(found) for found in KDTree(ends).query(position, distance_upper_bound=_NEXT))
    close = np.isfinite(distance)
    ahead = np.einsum("ni,ni->n", ends[nearest[close]] - position[close], surfaces.normal[rows[close]])
    close[close] = ahead > 0.1 * distance[close]  # not the emitter's own
    near, far = np.nonzero(close)[0], np.nonzero(~close)[0]
    normal = surfaces.normal[rows[near]]
    points, weight = patch_points(normal, surfaces.offset[rows[near]], _POINTS)
    points = points + (surfaces.voxel[rows[near]] + 0.5)[:, None]
    if scene.solids and len(near):  # what another solid covers of a face is none of it
        outside = scene.lattice.lower + (points + 0.02 * normal[:, None]) * scene.lattice.spacing
        weight = np.where(distance_to_solids(scene, outside) > 0, weight, 0.0)
    alone = ~weight.any(1)
    points[alone, 0], weight[alone, 0] = position[near[alone]], 1.0
    kept = weight > 0
    share = (weight / weight.sum(1, keepdims=True))[kept]
    receiver = np.concatenate([far, np.broadcast_to(near[:, None], kept.shape)[kept]])
    return receiver, np.concatenate([position[far], points[kept]]), np.concatenate([np.ones(len(far)), share])


def _seen(scene: Scene, patches: _Patches, start: np.ndarray, facing: np.ndarray, solid: np.ndarray) -> _Pairs:
    """Pairs of a block that see each other; `solid`: which one each row is of."""
    pairs = _narrow(patches, start, facing)
    if not scene.solids:
        return pairs
    total, found = np.bincount(pairs.element, pairs.geometry, len(start)), []
    for number in range(_ROUNDS + 1):
        if not len(pairs.element):
            break
        whole = (patches.count[pairs.patch] == 0) | (pairs.geometry < _MINOR * total[pairs.element]) | (number == _ROUNDS)
        seen, surely = _looked_at(scene, patches, start, solid, pairs, whole)
        found.append(pairs.kept(surely & seen))
        pairs = _bright(_faced(patches, start, facing, *_opened(patches, pairs.kept(~surely))), total)
    return _Pairs.joined(found)


def _looked_at(
    scene: Scene, patches: _Patches, start: np.ndarray, solid: np.ndarray, pairs: _Pairs, whole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which patches' targets are seen, and whether all of each is as its target, or is to be taken as a `whole`."""
    end = patches.target[pairs.patch] + CLEARANCE * patches.normal[pairs.patch]
    owner, solid = patches.owner[pairs.patch], solid[pairs.element]
    # Convex solids do not hide what is before them. A mirror's image of one may; and past a curved patch's horizon it does.
    plain = ((end > 0) & (end < scene.lattice.shape)).all(1) & (owner != solid)
    flat = patches.turn[pairs.patch] == 0
    radius = np.where(whole, 0.0, patches.radius[pairs.patch])
    rays = start[pairs.element], end, Patch(radius, np.where(plain & flat, owner, -1), np.where(plain, solid, -1))
    sight = jax.tree.map(np.array, in_blocks(look_at_patch, scene, rays))
    for _ in range(ROUNDS - 1):
        # Along a surface it takes ten times as many steps as the mean: those that do go on side by side, the longest first.
        late = np.argsort(-sight.effort)[: np.count_nonzero(sight.effort)]
        if not len(late):
            break
        rest = in_blocks(go_on_looking, scene, jax.tree.map(lambda values, late=late: values[late], (*rays, sight)))
        for values, found in zip(sight, rest, strict=True):
            values[late] = found
    return ~sight.blocked, whole | np.where(sight.blocked, sight.most > 0, sight.least > 0)


def _narrow(patches: _Patches, start: np.ndarray, facing: np.ndarray) -> _Pairs:
    """For each row the largest patches that are narrow enough, of those that lie before it and face it."""
    (top,) = np.nonzero(patches.topmost)
    pairs = np.repeat(np.arange(len(start)), len(top)), np.tile(top, len(start))
    found = []
    while len(pairs[0]):
        element, patch = pairs
        to = patches.center[patch] - start[element]
        size, distance = patches.size[patch], np.sqrt(np.einsum("ni,ni->n", to, to))
        ahead = np.einsum("ni,ni->n", to, facing[element]) > -size
        cosine = -np.einsum("ni,ni->n", to, patches.normal[patch]) / distance
        within = np.sin(np.minimum(patches.turn[patch], np.pi / 2)) + size / distance  # of its horizon
        ahead &= cosine > -within
        at_horizon = (patches.turn[patch] > 0) & (cosine < within)
        wide = size > np.where(at_horizon, _WIDTH / _FINER, _WIDTH) * distance
        wide &= patches.count[patch] > 0
        found.append(_faced(patches, start, facing, element[ahead & ~wide], patch[ahead & ~wide]))
        pairs = _opened(patches, _Pairs(element, patch, size).kept(ahead & wide))
    pairs = _Pairs.joined(found)
    return _bright(pairs, np.bincount(pairs.element, pairs.geometry, len(start)))


def _opened(patches: _Patches, pairs: _Pairs) -> tuple[np.ndarray, np.ndarray]:
    """The parts of each patch in its place."""
    count = patches.count[pairs.patch]
    within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    return np.repeat(pairs.element, count), np.repeat(patches.first[pairs.patch], count) + within


def _faced(patches: _Patches, start: np.ndarray, facing: np.ndarray, element: np.ndarray, patch: np.ndarray) -> _Pairs:
    dot = lambda a, b: np.einsum("ni,ni->n", a, b)
    middle, towards = patches.center[patch] - start[element], facing[element]
    apart, ahead, leaving = dot(middle, middle), dot(middle, towards), -dot(middle, patches.normal[patch])
    mean = 0.0
    for arm in (patches.arms[patch, 0], patches.arms[patch, 1]):  # across the normal: all four points are as far below
        along, rise, reach = dot(middle, arm), dot(arm, towards), dot(arm, arm)
        for sense in (1, -1):
            squared = np.maximum(apart + reach + 2 * sense * along, 0.05**2)
            mean = mean + np.maximum(ahead + sense * rise, 0) / squared**2 / 4
    return _Pairs(element, patch, patches.area[patch] * np.maximum(leaving, 0) * mean)


def _bright(pairs: _Pairs, total: np.ndarray) -> _Pairs:
    return pairs.kept(pairs.geometry > _FAINT * total[pairs.element])


def _light(scene: Scene, patches: _Patches, pairs: _Pairs, start: np.ndarray, radiance: Array) -> Float[Array, "C n"]:
    # In few sizes, each compiled once: there are never quite as many pairs.
    room = 1 << max(len(pairs.element) - 1, 1).bit_length()
    element, patch, geometry = (np.pad(np.asarray(values), (0, room - len(values))) for values in pairs)
    passed = None
    if scene.medium is not None:
        passed = in_blocks(transmittance_unfolded, scene, (start[element], patches.target[patch]))
    return _summed(geometry.astype(radiance.dtype), element, patches.owner[patch], passed, radiance, len(start))


@program
def _summed(geometry: Any, element: Any, owner: Any, passed: Array | None, radiance: Array, count: int) -> Array:
    sent = geometry * radiance[:, owner]
    sent = sent if passed is None else sent * passed.T
    return jnp.zeros((radiance.shape[0], count), radiance.dtype).at[:, element].add(sent)
