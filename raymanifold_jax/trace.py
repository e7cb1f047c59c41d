"""Rays through a scene: what they hit, what they can see, and what the medium adds and takes on the way.

Solids are found by sphere tracing their exact signed distance, sides of the domain analytically, and the medium is
walked through segment by segment. With extinction s, scattering z, emission e and fluence phi, a segment of length l
turns the radiance behind it into

    L' = L exp(-s l) + (z phi / 4 pi + e) l (1 - exp(-s l)) / (s l)                    (s = 0 is allowed)

Everything inside is in voxel units and in *unfolded* coordinates: a ray is straight, and behind a MIRROR or PERIODIC
side lies another image of the lattice; a point or voxel is folded back where the scene is asked about it.

Sides are one-sided: a ray that starts outside the box enters through whatever side it meets, so that a closed room can
be looked at from outside through its near walls. A solid that touches a side from behind shows through it, flush.

All functions take arrays in scene units, compute in JAX's default float type, and work on any number of rays in blocks.

Public: `Hit`, `first_hit`, `visible`, `transmittance`, `march`, `fill`, `interpolate`, `in_blocks`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from . import checks
from .scene import MIRROR, OPEN, PERIODIC, Scene

_BLOCK = 1 << 14  # rays a call
_BUNDLE = 1 << 10  # rays that step together: neighbours end at about the same time
_PASSES = 64  # images of the lattice that a ray crosses at most
_STEPS = 1024  # of sphere tracing
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
    return in_blocks(_first_hit, scene, (origins, directions))


def visible(scene: Scene, start: Float[Any, "n 3"], end: Float[Any, "n 3"]) -> Float[Array, " n"]:
    """1 where no solid lies between `start` and `end`, else 0. Either end may lie on a surface. Sides do not block."""
    return in_blocks(_visible, scene, (start, end))


def transmittance(scene: Scene, start: Float[Any, "n 3"], end: Float[Any, "n 3"]) -> Float[Array, "C n"]:
    """exp(-optical depth) of the medium between `start` and `end`, as if there were no solids. Exact.

    Outside the lattice there is no medium.
    """
    return in_blocks(_transmittance, scene, (start, end)).T


def march(
    scene: Scene,
    fluence: Float[Array, "C nx ny nz"],
    free: Float[Array, "nx ny nz"],
    origins: Float[Any, "n 3"],
    directions: Float[Any, "n 3"],
    start: Float[Any, " n"],
    stop: Float[Any, " n"],
) -> tuple[Float[Array, "C n"], Float[Array, "C n"]]:
    """What the medium sends back along rays between two distances, and how much of what lies behind it lets through.

    `fluence` is interpolated between the voxels with `free` > 0; emission, scattering and absorption are each voxel's
    own. Segments lie within the lattice (or its images), as those of `first_hit` do.
    """
    filled = fill(jnp.asarray(fluence), jnp.asarray(free))
    arrays = (origins, directions, start, stop)
    radiance, passed = in_blocks(_march, (scene, filled), arrays)
    return radiance.T, passed.T


def in_blocks(function: Callable, scene: Any, arrays: tuple[Any, ...]) -> Any:
    """function(scene, *arrays) for arrays (n, ...), some rays at a time; results have n as their first axis."""
    real = jnp.zeros(0).dtype
    if checks.is_traced((scene, arrays)):
        return _in_bundles(function, scene, tuple(jnp.asarray(a, real) for a in arrays))
    count = len(arrays[0])
    # Few sizes, each compiled once: powers of two, then whole blocks.
    block = min(_BLOCK, max(64, 1 << (max(count, 1) - 1).bit_length()))
    arrays = tuple(_padded(np.asarray(a, real), block, np) for a in arrays)
    parts = [_jitted(function, scene, tuple(a[i : i + block] for a in arrays)) for i in range(0, len(arrays[0]), block)]
    return jax.tree.map(lambda *r: jnp.concatenate(r)[:count], *parts)


@eqx.filter_jit
def _jitted(function: Callable, scene: Any, arrays: tuple[Any, ...]) -> Any:
    return _in_bundles(function, scene, arrays)


def _in_bundles(function: Callable, scene: Any, arrays: tuple[Array, ...]) -> Any:
    count = len(arrays[0])
    if count <= _BUNDLE:
        return function(scene, *arrays)
    bundles = tuple(_padded(a, _BUNDLE, jnp).reshape(-1, _BUNDLE, *a.shape[1:]) for a in arrays)
    results = lax.map(lambda parts: function(scene, *parts), bundles)
    return jax.tree.map(lambda r: r.reshape(-1, *r.shape[2:])[:count], results)


def _padded(values: Any, block: int, xp: Any) -> Any:
    short = -len(values) % block if len(values) else block
    if not short:
        return values
    # Rays like the last one: no longer to trace than the rest.
    last = values[-1:] if len(values) else xp.ones((1, *values.shape[1:]), values.dtype)
    return xp.concatenate([values, xp.broadcast_to(last, (short, *values.shape[1:]))])


# Unfolding


class _Axis(NamedTuple):
    """One axis of the unfolded lattice: its voxels, how it goes on, and where it ends."""

    count: int
    kind: str  # plain, periodic, mirrors, or a mirror at the lower or upper side
    lower: float
    upper: float

    def fold_index(self, index: Array) -> Array:
        n = self.count
        if self.kind == "periodic":
            return index % n
        if self.kind == "mirrors":
            index = index % (2 * n)
        if self.kind == "lower":
            index = jnp.where(index < 0, -1 - index, index)
        elif self.kind != "plain":
            index = jnp.where(index >= n, 2 * n - 1 - index, index)
        return jnp.clip(index, 0, n - 1)

    def fold(self, u: Array) -> tuple[Array, Array]:
        """Coordinate in the lattice, and the sign that a direction gets."""
        n = self.count
        if self.kind == "periodic":
            return u - n * jnp.floor(u / n), jnp.ones_like(u)
        if self.kind == "mirrors":
            u = u - 2 * n * jnp.floor(u / (2 * n))
        if self.kind == "lower":
            return jnp.abs(u), jnp.where(u < 0, -1.0, 1.0).astype(u.dtype)
        if self.kind == "plain":
            return u, jnp.ones_like(u)
        return n - jnp.abs(n - u), jnp.where(u > n, -1.0, 1.0).astype(u.dtype)

    def to_fold(self, u: Array, w: Array) -> Array:
        """Distance to the next plane between images, along a ray with component w."""
        plane = jnp.where(w > 0, jnp.floor(u / self.count) + 1, jnp.ceil(u / self.count) - 1) * self.count
        return (plane - u) / w


def _axes(scene: Scene) -> tuple[_Axis, ...]:
    sides, axes = scene.boundary.sides, []
    for axis, n in enumerate(scene.lattice.shape):
        below, above = (side is MIRROR for side in sides[2 * axis : 2 * axis + 2])
        if sides[2 * axis] is PERIODIC:
            axes.append(_Axis(n, "periodic", -math.inf, math.inf))
        elif below and above:
            axes.append(_Axis(n, "mirrors", -math.inf, math.inf))
        else:
            kind = "lower" if below else "upper" if above else "plain"
            axes.append(_Axis(n, kind, -n if below else 0, 2 * n if above else n))
    return tuple(axes)


def _fold(axes: tuple[_Axis, ...], u: Float[Array, "n 3"]) -> tuple[Array, Array]:
    folded = [axis.fold(u[:, i]) for i, axis in enumerate(axes)]
    return jnp.stack([f[0] for f in folded], -1), jnp.stack([f[1] for f in folded], -1)


def _to_voxel(scene: Scene, points: Array) -> Array:
    return (points - jnp.asarray(scene.lattice.lower, points.dtype)) / scene.lattice.spacing


def _to_scene(scene: Scene, u: Array) -> Array:
    return jnp.asarray(scene.lattice.lower, u.dtype) + u * scene.lattice.spacing


def _distance(scene: Scene, u: Array) -> Array:
    """Signed distance to the solids in voxels, at points in voxel coordinates."""
    return scene.distance(_to_scene(scene, u)) / scene.lattice.spacing


def _sloped(directions: Array) -> Array:
    # No component is 0, so that distances to planes are large and not NaN.
    return jnp.where(jnp.abs(directions) < 1e-20, 1e-20, directions)


def _box_span(scene: Scene, u: Array, w: Array) -> tuple[Array, Array]:
    """Distances at which lines enter and leave the lattice's box."""
    shape = jnp.asarray(scene.lattice.shape, u.dtype)
    first, second = -u / w, (shape - u) / w
    return jnp.minimum(first, second).max(-1), jnp.maximum(first, second).min(-1)


# Solids and sides


def _first_hit(scene: Scene, origins: Array, directions: Array) -> Hit:
    axes = _axes(scene)
    o, w = _to_voxel(scene, origins), _sloped(directions)
    into, out_of = _box_span(scene, o, w)
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
    end, sign = _fold(axes, start + t[:, None] * w)
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
        solid = scene.solid_at(_to_scene(scene, jnp.where(hit[:, None], end, behind)))
        material = jnp.where(hit | flush, solid, material)
        normal = jnp.where(hit[:, None], _solid_normal(scene, end), normal)
    spacing = scene.lattice.spacing
    far = jnp.asarray(jnp.inf, o.dtype)
    return Hit(
        distance=jnp.where(misses, far, (enter + t) * spacing),
        point=_to_scene(scene, end),
        normal=normal,
        material=jnp.where(misses, -1, material),
        enter=jnp.where(misses, far, enter * spacing),
        direction=directions * jnp.where(misses[:, None], 1.0, sign),
    )


def _sphere_trace(scene: Scene, axes: tuple[_Axis, ...], start: Array, w: Array, leave: Array) -> tuple[Array, Array]:
    """How far rays get, and whether a solid stopped them there."""
    folds = [i for i, axis in enumerate(axes) if axis.kind != "plain"]
    precision = float(jnp.finfo(start.dtype).eps) * max(scene.lattice.shape)
    touch = max(_TOUCH, 4 * precision)
    # Just past a plane between images, which side a point folds to must not be left to rounding.
    nudge = max(_TOUCH, 4 * precision * _PASSES)

    def step(state):
        t, near, done, count = state
        u = start + t[:, None] * w
        near = jnp.where(done, near, _distance(scene, _fold(axes, u)[0] if folds else u))
        ahead = jnp.maximum(near, _CRAWL)
        for i in folds:
            ahead = jnp.minimum(ahead, axes[i].to_fold(u[:, i], w[:, i]) + nudge)
        stopped = done | (near < touch)
        t = jnp.where(stopped, t, jnp.minimum(t + ahead, leave))
        return t, near, stopped | (t >= leave), count + 1

    # A start on a surface is past it: seen from behind, a flush solid does not stop the ray.
    first = jnp.full_like(leave, 2 * _CRAWL + (nudge if folds else 0.0))
    state = (jnp.minimum(first, leave), jnp.full_like(leave, jnp.inf), leave <= 0, 0)
    most = _STEPS * (8 if folds else 1)
    t, near, done, _ = lax.while_loop(lambda s: ~s[2].all() & (s[3] < most), step, state)
    return t, jnp.where(done, near < touch, near < _NEAR)


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
    if not scene.solids:
        return jnp.ones(start.shape[:1], start.dtype)
    o, e = _to_voxel(scene, start), _to_voxel(scene, end)
    length = jnp.sqrt(jnp.sum((e - o) ** 2, -1))
    w = (e - o) / jnp.where(length > 0, length, 1.0)[:, None]
    stop = length - _CRAWL
    # Points of elements may lie a little inside a curved solid: deeper than its ends a ray must not go.
    ends = jnp.minimum(_distance(scene, o), _distance(scene, e))
    deepest = jnp.clip(ends, -10 * _BEHIND, 0.0) - _CRAWL

    def step(state):
        t, blocked, count = state
        near = _distance(scene, o + t[:, None] * w)
        going = ~blocked & (t < stop)
        return jnp.where(going, t + jnp.maximum(jnp.abs(near), _BEHIND), t), blocked | (going & (near < deepest)), count + 1

    def goes_on(state):
        t, blocked, count = state
        return (~blocked & (t < stop)).any() & (count < _STEPS)

    _, blocked, _ = lax.while_loop(goes_on, step, (jnp.zeros_like(stop), jnp.zeros(stop.shape, bool), 0))
    return jnp.where(blocked, 0.0, 1.0).astype(start.dtype)


# The medium


def fill(field: Float[Array, "C nx ny nz"], free: Float[Array, "nx ny nz"]) -> Float[Array, "C nx ny nz"]:
    """`field` with values where `free` is 0: means over the neighbours that have one, two voxels deep."""
    field, free = jnp.asarray(field), jnp.asarray(free)
    return _fill(field, (free > 0).astype(field.dtype))


@jax.jit
def _fill(field: Array, known: Array) -> Array:
    for _ in range(2):
        total, count = field * known, known
        for axis in (-3, -2, -1):
            total, count = _three(total, axis), _three(count, axis)
        field = jnp.where(known > 0, field, total / jnp.maximum(count, 1.0))
        known = (count > 0).astype(field.dtype)
    return field


def _three(values: Array, axis: int) -> Array:
    """Sums of neighbours along an axis."""
    width = [(0, 0)] * values.ndim
    width[axis] = (1, 1)
    padded = jnp.pad(values, width)
    n = values.shape[axis]
    return sum(lax.slice_in_dim(padded, i, i + n, axis=axis % values.ndim) for i in range(3))  # pyright: ignore


def interpolate(scene: Scene, filled: Float[Array, "C nx ny nz"], u: Float[Array, "n 3"]) -> Float[Array, "n C"]:
    """Trilinear interpolation of a field without gaps, at unfolded voxel coordinates; level within half a voxel of a side."""
    return _interpolate(_axes(scene), filled.reshape(filled.shape[0], -1), tuple(u.T)).T


def _interpolate(axes: tuple[_Axis, ...], flat: Array, u: tuple[Array, ...]) -> Array:
    corners = []
    for axis, x in zip(axes, u, strict=True):
        floor = jnp.floor(x - 0.5)
        after = x - 0.5 - floor
        index = floor.astype(jnp.int32)
        corners.append(((1 - after, axis.fold_index(index)), (after, axis.fold_index(index + 1))))
    ny, nz = axes[1].count, axes[2].count
    total = jnp.zeros((flat.shape[0], *u[0].shape), flat.dtype)
    for a, i in corners[0]:
        for b, j in corners[1]:
            for c, k in corners[2]:
                total = total + (a * b * c) * flat.at[:, (i * ny + j) * nz + k].get(mode="promise_in_bounds")
    return total


def _coefficients(scene: Scene) -> list[Array]:
    """Scattering, absorption and emission, each (b, V) with b of 1 or C, and V of 1 if it is the same everywhere."""
    assert scene.medium is not None
    return [v.reshape(-1, v.shape[-1]).T for v in scene.medium.coefficients()]


def _share(depth: Array) -> Array:
    """(1 - exp(-depth)) / depth."""
    small = depth < 1e-3
    safe = jnp.where(small, 1.0, depth)
    return jnp.where(small, 1 - depth / 2 + depth**2 / 6, -jnp.expm1(-safe) / safe)


def _transmittance(scene: Scene, start: Array, end: Array) -> Array:
    o, e = _to_voxel(scene, start), _to_voxel(scene, end)
    length = jnp.sqrt(jnp.sum((e - o) ** 2, -1))
    w = _sloped((e - o) / jnp.where(length > 0, length, 1.0)[:, None])
    into, out_of = _box_span(scene, o, w)
    into = jnp.clip(into, 0.0, length)
    return _passed(scene, o, w, into, jnp.clip(out_of, into, length))


def _passed(scene: Scene, o: Array, w: Array, start: Array, stop: Array) -> Float[Array, "n C"]:
    """Transmittance between two distances along unfolded rays."""
    spacing = scene.lattice.spacing
    if scene.medium is None:
        return jnp.ones((len(o), scene.bands), o.dtype)
    scattering, absorption, _ = _coefficients(scene)
    extinction = scattering + absorption
    if extinction.shape[1] == 1:
        depth = extinction * ((stop - start) * spacing)
    else:
        add = lambda depth, middle, voxel, length: depth + _at(extinction, voxel) * (length * spacing)
        depth = _walk(_axes(scene), o, w, start, stop, add, jnp.zeros((len(extinction), len(o)), o.dtype))
    return jnp.broadcast_to(jnp.exp(-depth), (scene.bands, len(o))).T


def _march(context: tuple[Scene, Array], origins: Array, directions: Array, start: Array, stop: Array):
    """`march` for one block, from fluence without gaps."""
    scene, filled = context
    shape = (scene.bands, len(origins))
    if scene.medium is None:
        return jnp.zeros(shape, origins.dtype).T, jnp.ones(shape, origins.dtype).T
    axes, spacing = _axes(scene), scene.lattice.spacing
    flat = filled.reshape(filled.shape[0], -1).astype(origins.dtype)
    # From the near end on, so that a far eye costs no precision.
    start, stop = (jnp.where(jnp.isfinite(t), t, 0.0) for t in (start, stop))
    w = _sloped(directions)
    o = _to_voxel(scene, origins + start[:, None] * directions)
    length = jnp.maximum(stop - start, 0.0) / spacing
    coefficients = _coefficients(scene)
    uniform = all(c.shape[1] == 1 for c in coefficients)

    def add(state, middle, voxel, step):
        radiance, depth = state
        scattering, absorption, emission = (_at(c, voxel) for c in coefficients)
        source = scattering / (4 * jnp.pi) * _interpolate(axes, flat, middle) + emission
        own = (scattering + absorption) * (step * spacing)
        return radiance + jnp.exp(-depth) * source * (step * spacing) * _share(own), depth + own

    state = (jnp.zeros(shape, o.dtype), jnp.zeros(shape, o.dtype))
    advance = _stride if uniform else _walk
    radiance, depth = advance(axes, o, w, jnp.zeros_like(length), length, add, state)
    return radiance.T, jnp.exp(-depth).T


def _at(coefficient: Array, voxel: Array | None) -> Array:
    if coefficient.shape[1] == 1 or voxel is None:
        return coefficient
    return coefficient.at[:, voxel].get(mode="promise_in_bounds")


def _walk(axes: tuple[_Axis, ...], o: Array, w: Array, start: Array, stop: Array, add: Callable, state: Any) -> Any:
    """state = add(state, middle, voxel, length) for every voxel that rays cross between two distances."""
    (ny, nz), xs, ws = (axes[1].count, axes[2].count), tuple(o.T), tuple(w.T)
    index = tuple(jnp.floor(x + start * v).astype(jnp.int32) for x, v in zip(xs, ws, strict=True))

    def step(carry):
        t, index, state = carry
        # Times of crossing from the indices, not by adding up: no drift.
        planes = [(i + (v > 0) - x) / v for i, x, v in zip(index, xs, ws, strict=True)]
        crossing = jnp.minimum(jnp.minimum(planes[0], planes[1]), planes[2])
        after = jnp.clip(crossing, t, jnp.maximum(stop, t))
        middle = tuple(x + 0.5 * (t + after) * v for x, v in zip(xs, ws, strict=True))
        i, j, k = (axis.fold_index(n) for axis, n in zip(axes, index, strict=True))
        state = add(state, middle, (i * ny + j) * nz + k, after - t)
        going = after < stop
        index = tuple(
            n + jnp.where(going & (p <= crossing), jnp.where(v > 0, 1, -1), 0)
            for n, p, v in zip(index, planes, ws, strict=True)
        )
        return after, index, state

    return lax.while_loop(lambda carry: (carry[0] < stop).any(), step, (start, index, state))[2]


def _stride(axes: tuple[_Axis, ...], o: Array, w: Array, start: Array, stop: Array, add: Callable, state: Any) -> Any:
    """The same in equal steps of at most a voxel's side, where the medium is the same everywhere."""
    xs, ws = tuple(o.T), tuple(w.T)
    count = jnp.ceil(stop - start)
    length = (stop - start) / jnp.maximum(count, 1.0)

    def step(carry):
        number, state = carry
        t = start + (number + 0.5) * length
        middle = tuple(x + t * v for x, v in zip(xs, ws, strict=True))
        return number + 1, add(state, middle, None, jnp.where(number < count, length, 0.0))

    most = jnp.max(count, initial=0.0)
    return lax.while_loop(lambda carry: carry[0] < most, step, (jnp.zeros((), o.dtype), state))[1]
