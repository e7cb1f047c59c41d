"""Rays through a scene: what they hit first, and whether two points see each other.

Solids are found by sphere tracing: from a point whose signed distance is d, no solid is nearer than d along the ray. Sides
of the domain are found analytically. Distances inside are in voxels, coordinates unfolded (see `unfolding`).

Sides are one-sided: a ray that starts outside the box enters through whatever side it meets, so that a closed room can
be looked at from outside through its near walls. A solid that touches a side from behind shows through it, flush.

The functions take arrays in scene units, compute in JAX's default float type, and work on any number of rays. They are not
made to be differentiated: what is in front of what has no gradient here.

Public: `Hit`, `first_hit`, `visible`; for blocks of rays `trace_rays`, `visible_unfolded`,
`share_that_passes`, `look_at_patch`, `go_on_looking`; and `march`, `transmittance` from `march`.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .march import march as march
from .march import transmittance as transmittance
from .march import transmittance_unfolded
from .scene import OPEN, Scene
from .unfolding import Axis, box_span, fold, in_blocks, sloped, to_scene, to_voxel, unfolded_axes

_PASSES = 64  # images of the lattice that a ray crosses at most
_STEPS = 1024  # of sphere tracing
_ROUND = 64  # steps after which lines of sight are sorted by how long they will take; a whole number of rounds
#: Rounds after which one that goes on counts as free.
ROUNDS = _STEPS // _ROUND
_TOUCH = 1e-4  # voxels: nearer is a hit
_NEAR = 0.02  # voxels: a ray that ends undecided this near is a hit too
_CRAWL = 1e-3  # voxels: the least step
_BEHIND = 0.01  # voxels behind a side where a flush solid is looked for


class Hit(NamedTuple):
    """Where rays end.

    - `distance` (n,): along the ray to the hit, or to where it leaves the lattice; inf if it misses the lattice.
    - `point`, `normal` (n, 3): of the surface, the normal on the side the light is on: out of a solid, into the domain.
    - `material` (n,): which of the solids, then of the six sides; -1 if the ray leaves through an open side or misses.
    - `enter` (n,): distance at which the ray enters the lattice, 0 if it starts inside, inf if it misses.
    - `direction` (n, 3): of travel at the end, after any mirrors.
    """

    distance: Float[Array, " n"]
    point: Float[Array, "n 3"]
    normal: Float[Array, "n 3"]
    material: Int[Array, " n"]
    enter: Float[Array, " n"]
    direction: Float[Array, "n 3"]


def first_hit(scene: Scene, origins: Float[Any, "n 3"], directions: Float[Any, "n 3"]) -> Hit:
    """What rays meet first: a solid, a wall, or nothing. `directions` have length 1.

    A start on a surface wants to be moved off it by about 1e-3 voxel. Rays that are still going after 64 images of a
    mirrored or periodic lattice count as leaving.
    """
    return in_blocks(trace_rays, scene, (origins, directions))


def visible(scene: Scene, start: Float[Any, "n 3"], end: Float[Any, "n 3"]) -> Float[Array, " n"]:
    """1 where no solid lies between `start` and `end`, else 0. Either end may lie on a surface. Sides do not block."""
    return in_blocks(_visible, scene, (start, end))


def _distance(scene: Scene, u: Array) -> Array:
    """Signed distance to the solids in voxels, at points in voxel coordinates."""
    return scene.distance(to_scene(scene, u)) / scene.lattice.spacing


def _distance_to_others(scene: Scene, u: Array, ends: tuple[Array, Array]) -> Array:
    """The same, but for solids that are convex and lie at an end of the line of sight, whose numbers `ends` has."""
    points = to_scene(scene, u)
    far = jnp.full(u.shape[:1], max(scene.lattice.shape) * 2.0, u.dtype)
    parts = []
    for number, solid in enumerate(scene.solids):
        apart = solid.shape.distance(points) / scene.lattice.spacing
        own = (ends[0] == number) | (ends[1] == number)
        parts.append(jnp.where(own, far, apart) if solid.shape.convex else apart)
    return functools.reduce(jnp.minimum, parts)


def trace_rays(scene: Scene, origins: Array, directions: Array) -> Hit:
    """`first_hit` for one block of rays."""
    axes = unfolded_axes(scene)
    o, w = to_voxel(scene, origins), sloped(directions)
    into, out_of = box_span(scene, o, w)
    enter = jnp.maximum(into, 0.0)
    misses = (into > out_of) | (out_of < 0)
    # From the point of entry on, so that a far eye costs no precision.
    start = o + enter[:, None] * w
    lower = jnp.asarray([axis.lower for axis in axes], o.dtype)
    upper = jnp.asarray([axis.upper for axis in axes], o.dtype)
    to_side = jnp.where(w > 0, upper - start, lower - start) / w
    leave = jnp.maximum(jnp.min(to_side, -1), 0.0)
    leave = jnp.minimum(leave, float(_PASSES * max(scene.lattice.shape)))
    leave = jnp.where(misses, 0.0, leave)
    t, hit = _sphere_trace(scene, axes, start, w, leave) if scene.solids else (leave, jnp.zeros_like(misses))
    hit = hit & ~misses
    end, sign = fold(axes, start + t[:, None] * w)
    side, axis, inward = _side(scene, to_side, w * sign)
    face = jnp.asarray(scene.lattice.shape, o.dtype)[axis] * (side % 2)
    on_axis = jax.nn.one_hot(axis, 3, dtype=bool)
    reaches = ~misses & (jnp.min(to_side, -1) <= leave)
    end = jnp.where(on_axis & (reaches & ~hit)[:, None], face[:, None], end)
    material = jnp.where(reaches & ~_are_open(scene)[side], len(scene.solids) + side, -1)
    normal = inward
    if scene.solids:
        behind = end - _BEHIND * inward
        flush = reaches & (_distance(scene, behind) < 0)
        solid = scene.solid_at(to_scene(scene, jnp.where(hit[:, None], end, behind)))
        material = jnp.where(hit | flush, solid, material)
        normal = jnp.where(hit[:, None], _solid_normal(scene, end), normal)
    spacing = scene.lattice.spacing
    far = jnp.asarray(jnp.inf, o.dtype)
    return Hit(
        distance=jnp.where(misses, far, (enter + t) * spacing),
        point=to_scene(scene, end),
        normal=normal,
        material=jnp.where(misses, -1, material),
        enter=jnp.where(misses, far, enter * spacing),
        direction=directions * jnp.where(misses[:, None], 1.0, sign),
    )


def _sphere_trace(scene: Scene, axes: tuple[Axis, ...], start: Array, w: Array, leave: Array) -> tuple[Array, Array]:
    """How far rays get, and whether a solid stopped them there."""
    folds = [i for i, axis in enumerate(axes) if axis.kind != "plain"]
    precision = float(jnp.finfo(start.dtype).eps) * max(scene.lattice.shape)
    touch = max(_TOUCH, 4 * precision)
    # Just past a plane between images, which side a point folds to must not be left to rounding.
    nudge = max(_TOUCH, 4 * precision * _PASSES)

    bumps = _bumps(scene, start.dtype)

    def step(state):
        t, near, done, free, count = state
        u = start + t[:, None] * w
        near = jnp.where(done, near, _distance(scene, fold(axes, u)[0] if folds else u))
        ahead, surface = jnp.maximum(near, _CRAWL), touch
        if bumps is not None:
            ahead, surface = jnp.maximum(jnp.abs(near), _CRAWL), jnp.where(free, touch, -bumps)
            free = free | (near > bumps)
        for i in folds:
            ahead = jnp.minimum(ahead, axes[i].to_fold(u[:, i], w[:, i]) + nudge)
        stopped = done | (near < surface)
        t = jnp.where(stopped, t, jnp.minimum(t + ahead, leave))
        return t, near, stopped | (t >= leave), free, count + 1

    # A start on a surface is past it: seen from behind, a flush solid does not stop the ray.
    first = jnp.full_like(leave, 2 * _CRAWL + (nudge if folds else 0.0))
    free = jnp.zeros(leave.shape, bool)
    state = (jnp.minimum(first, leave), jnp.full_like(leave, jnp.inf), leave <= 0, free, 0)
    most = _STEPS * (8 if folds else 1)
    t, near, done, free, _ = lax.while_loop(lambda s: ~s[2].all() & (s[4] < most), step, state)
    surface = touch if bumps is None else jnp.where(free, touch, -bumps)
    # The least step may have led a little into the solid.
    t = t + jnp.clip(jnp.where(done, near, 0.0), -_CRAWL, 0.0)
    return t, jnp.where(done, near < surface, near < _NEAR)


def _bumps(scene: Scene, dtype: Any) -> Array | None:
    """In voxels, the depth to which a ray may cut through a solid until it is once as far from all solids: bumps of rough
    surfaces (`Shape.roughness`) throw no shadows on what is between them. None: all surfaces are exact.
    """
    rough = [r for r in (solid.shape.roughness for solid in scene.solids) if not isinstance(r, float)]
    return functools.reduce(jnp.maximum, rough).astype(dtype) / scene.lattice.spacing if rough else None


def _side(scene: Scene, to_side: Array, direction: Array) -> tuple[Array, Array, Array]:
    """The side that a ray ends at, its axis, and its inward normal."""
    axis = jnp.argmin(to_side, -1)
    upper = jnp.take_along_axis(direction, axis[:, None], -1)[:, 0] > 0
    inward = jax.nn.one_hot(axis, 3, dtype=direction.dtype) * jnp.where(upper, -1.0, 1.0)[:, None]
    return 2 * axis + upper, axis, inward


def _are_open(scene: Scene) -> Array:
    return jnp.asarray([side is OPEN for side in scene.boundary.sides])


def _solid_normal(scene: Scene, u: Array) -> Array:
    distance, pull_back = jax.vjp(lambda x: _distance(scene, x), u)
    (slope,) = pull_back(jnp.ones_like(distance))
    length = jnp.sqrt(jnp.sum(slope**2, -1, keepdims=True))
    return slope / jnp.where(length > 0, length, 1.0)


def _visible(scene: Scene, start: Array, end: Array) -> Array:
    return visible_unfolded(scene, to_voxel(scene, start), to_voxel(scene, end))


def visible_unfolded(scene: Scene, o: Float[Array, "n 3"], e: Float[Array, "n 3"]) -> Float[Array, " n"]:
    """`visible` for one block, between points in unfolded voxel coordinates."""
    if not scene.solids:
        return jnp.ones(o.shape[:1], o.dtype)
    return jnp.where(_look(scene, o, e, None, _nothing_seen(o), _STEPS).blocked, 0.0, 1.0).astype(o.dtype)


def share_that_passes(scene: Scene, o: Float[Array, "n 3"], e: Float[Array, "n 3"]) -> Float[Array, "n C"]:
    """Transmittance, and 0 behind solids, between points in unfolded voxel coordinates; for one block."""
    return transmittance_unfolded(scene, o, e) * visible_unfolded(scene, o, e)[:, None]


class Sight(NamedTuple):
    """Lines of sight under way, (n,) each: how far they are, in voxels, and what they met."""

    t: Float[Array, " n"]
    blocked: Bool[Array, " n"]
    free: Bool[Array, " n"]  # once away from rough surfaces
    least: Float[Array, " n"]  # of the distances to solids, less the radius of the cone to a patch
    most: Float[Array, " n"]  # of the depths in solids, less that
    effort: Float[Array, " n"]  # about how many steps are left; 0 where it is over


class Patch(NamedTuple):
    """What lines of sight lead to, and from where: which solids these points are on, or -1, if they face each other there."""

    radius: Float[Any, " n"]
    solid: Float[Any, " n"]
    from_solid: Float[Any, " n"]


def look_at_patch(scene: Scene, o: Float[Array, "n 3"], e: Float[Array, "n 3"], patch: Patch) -> Sight:
    """The first steps from `o` to a patch around `e`, in unfolded voxel coordinates; for one block.

    A convex solid does not hide what is before it from its own points.
    """
    return _look(scene, o, e, patch, _nothing_seen(o), _ROUND)


def go_on_looking(scene: Scene, o: Float[Array, "n 3"], e: Float[Array, "n 3"], patch: Patch, sight: Sight) -> Sight:
    """The rest of the way. A block takes as long as its longest: best are those together that have as much before them."""
    return _look(scene, o, e, patch, sight, _ROUND)


def _nothing_seen(o: Array) -> Sight:
    zero, none = jnp.zeros(o.shape[:1], o.dtype), jnp.zeros(o.shape[:1], bool)
    return Sight(zero, none, none, zero + jnp.inf, zero - jnp.inf, zero)


def _look(scene: Scene, o: Array, e: Array, patch: Patch | None, sight: Sight, steps: int) -> Sight:
    """So many steps more, at most, along lines of sight that are not over."""
    axes = unfolded_axes(scene)
    folds = any(axis.kind != "plain" for axis in axes)
    radius = None if patch is None else patch.radius

    def distance(u: Array) -> Array:
        u = fold(axes, u)[0] if folds else u
        return _distance(scene, u) if patch is None else _distance_to_others(scene, u, (patch.solid, patch.from_solid))

    length = jnp.sqrt(jnp.sum((e - o) ** 2, -1))
    w = (e - o) / jnp.where(length > 0, length, 1.0)[:, None]
    stop = length - _CRAWL
    # Points of elements may lie a little inside a curved solid: deeper than its ends a ray must not go.
    ends = jnp.minimum(distance(o), distance(e))
    deepest = jnp.clip(ends, -10 * _BEHIND, 0.0) - _CRAWL
    bumps = _bumps(scene, o.dtype)

    def goes_on(sight: Sight):
        done = sight.blocked if radius is None else sight.blocked & (sight.most > 0)
        return ~done & (sight.t < stop)

    def step(state):
        (t, blocked, free, least, most, _), _, count = state
        near = distance(o + t[:, None] * w)
        going = goes_on(state[0])
        blocks = near < (deepest if bumps is None else jnp.where(free, deepest, deepest - bumps))
        free = free if bumps is None else free | (near > bumps)
        if radius is not None:
            # The patch is the base of a cone; close to it, its own surface is no obstacle.
            cone = radius * jnp.maximum(t, _CRAWL) / jnp.maximum(length, _CRAWL)
            counts = going & (t < length - 2 * radius)
            least = jnp.where(counts, jnp.minimum(least, near - cone), least)
            most = jnp.where(counts, jnp.maximum(most, -near - cone), most)
        ahead = jnp.maximum(jnp.abs(near), _BEHIND)
        t = jnp.where(going, t + ahead, t)
        return Sight(t, blocked | (going & blocks), free, least, most, sight.effort), ahead, count + 1

    begun = (sight, jnp.ones_like(stop), 0)
    found, ahead, _ = lax.while_loop(lambda s: goes_on(s[0]).any() & (s[2] < steps), step, begun)
    return found._replace(effort=jnp.where(goes_on(found), (stop - found.t) / ahead, 0.0))
