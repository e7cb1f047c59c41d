"""What the medium adds to light along rays, and what it takes.

With extinction s, scattering z, emission e and fluence phi, a segment of length l turns the radiance L behind it into

    L' = L exp(-s l) + (z phi / 4 pi + e) l (1 - exp(-s l)) / (s l)                    (s = 0 is allowed)

Where a coefficient differs between voxels a segment ends at every voxel's faces, and each voxel's own values hold;
else segments are equal and at most a voxel's side long. The fluence is interpolated, at the centre of what a segment sends.

Public: `transmittance`, `march`, `fill`, `interpolate`; for blocks of rays `transmittance_unfolded`,
`transmittance_between`, `march_between`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .adjoint import with_adjoint
from .programs import program
from .scene import Scene
from .unfolding import Axis, box_span, in_blocks, sloped, to_voxel, unfolded_axes


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
    radiance, passed = in_blocks(march_between, (scene, filled), arrays)
    return radiance.T, passed.T


def fill(field: Float[Array, "C nx ny nz"], free: Float[Array, "nx ny nz"]) -> Float[Array, "C nx ny nz"]:
    """`field` with values where `free` is 0: means over the neighbours that have one, two voxels deep."""
    return _fill(jnp.asarray(field), jnp.asarray(free))


@program
def _fill(field: Array, free: Array) -> Array:
    known = (free > 0).astype(field.dtype)
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
    """Trilinear interpolation of a field without gaps, at unfolded voxel coordinates; straight on to the sides."""
    return _interpolate(unfolded_axes(scene), _rimmed(filled), tuple(u.T)).T


def _rimmed(field: Float[Array, "C nx ny nz"]) -> Float[Array, "C V"]:
    """A field with a layer of voxels around it that goes on in a straight line, though not past 0 or twice as much; flat."""
    for axis in (1, 2, 3):
        n = field.shape[axis]
        at = lambda i, field=field, axis=axis: lax.slice_in_dim(field, i, i + 1, axis=axis)
        beyond = lambda i, j, at=at: jnp.clip(2 * at(i) - at(j), 0.0, 2 * jnp.maximum(at(i), 0.0))
        inner = min(1, n - 1)
        field = jnp.concatenate([beyond(0, inner), field, beyond(n - 1, n - 1 - inner)], axis)
    return field.reshape(field.shape[0], -1)


def _interpolate(axes: tuple[Axis, ...], rimmed: Array, u: tuple[Array, ...]) -> Array:
    """`rimmed` is what `_rimmed` makes of a field."""
    total = jnp.zeros((rimmed.shape[0], *u[0].shape), rimmed.dtype)
    for weight, voxel in _corners(axes, u):
        total = total + weight * rimmed.at[:, voxel].get(mode="promise_in_bounds")
    return total


def _corners(axes: tuple[Axis, ...], u: tuple[Array, ...]) -> Iterator[tuple[Array, Array]]:
    """The eight voxels of a rimmed field around points, with their weights."""
    corners = []
    for axis, x in zip(axes, u, strict=True):
        floor = jnp.floor(x - 0.5)
        after = x - 0.5 - floor
        index = floor.astype(jnp.int32)
        corners.append(((1 - after, axis.fold_index(index, 1) + 1), (after, axis.fold_index(index + 1, 1) + 1)))
    ny, nz = axes[1].count + 2, axes[2].count + 2
    for a, i in corners[0]:
        for b, j in corners[1]:
            for c, k in corners[2]:
                yield a * b * c, (i * ny + j) * nz + k


def _coefficients(scene: Scene) -> list[Array]:
    """Scattering, absorption and emission, each (b, V) with b of 1 or C, and V of 1 if it is the same everywhere."""
    assert scene.medium is not None
    return [v.reshape(-1, v.shape[-1]).T for v in scene.medium.coefficients()]


def _share(depth: Array) -> Array:
    """(1 - exp(-depth)) / depth."""
    small = depth < 1e-3
    safe = jnp.where(small, 1.0, depth)
    return jnp.where(small, 1 - depth / 2 + depth**2 / 6, -jnp.expm1(-safe) / safe)


def _center(depth: Array) -> Array:
    """Where in a segment of this optical depth, as a share of it, lies the centre of what reaches its near end."""
    small = depth < 0.1
    safe = jnp.where(small, 1.0, depth)
    return jnp.where(small, 0.5 - depth / 12 + depth**3 / 720, 1 / safe - 1 / jnp.expm1(jnp.minimum(safe, 80.0)))


def _transmittance(scene: Scene, start: Array, end: Array) -> Array:
    o, e = to_voxel(scene, start), to_voxel(scene, end)
    length = jnp.sqrt(jnp.sum((e - o) ** 2, -1))
    w = sloped((e - o) / jnp.where(length > 0, length, 1.0)[:, None])
    into, out_of = box_span(scene, o, w)
    into = jnp.clip(into, 0.0, length)
    return transmittance_between(scene, o, w, into, jnp.clip(out_of, into, length))


def transmittance_unfolded(scene: Scene, o: Float[Array, "n 3"], e: Float[Array, "n 3"]) -> Float[Array, "n C"]:
    """Transmittance between points in unfolded voxel coordinates, for one block."""
    length = jnp.sqrt(jnp.sum((e - o) ** 2, -1))
    w = sloped((e - o) / jnp.where(length > 0, length, 1.0)[:, None])
    return transmittance_between(scene, o, w, jnp.zeros_like(length), length)


def transmittance_between(scene: Scene, o: Array, w: Array, start: Array, stop: Array) -> Float[Array, "n C"]:
    """Transmittance between two distances along unfolded rays."""
    spacing = scene.lattice.spacing
    if scene.medium is None:
        return jnp.ones((len(o), scene.bands), o.dtype)
    scattering, absorption, _ = _coefficients(scene)
    extinction = scattering + absorption
    if extinction.shape[1] == 1:
        depth = extinction * ((stop - start) * spacing)
    else:
        axes = unfolded_axes(scene)
        depth = with_adjoint(_Depth(axes), _DepthAdjoint(axes))(extinction, o, w, start, stop) * spacing
    return jnp.broadcast_to(jnp.exp(-depth), (scene.bands, len(o))).T


def march_between(
    context: tuple[Scene, Array | None], origins: Array, directions: Array, start: Array, stop: Array
) -> tuple[Float[Array, "n C"], Float[Array, "n C"]]:
    """`march` for one block, from fluence without gaps; None: nothing is scattered."""
    scene, filled = context
    shape = (scene.bands, len(origins))
    if scene.medium is None:
        return jnp.zeros(shape, origins.dtype).T, jnp.ones(shape, origins.dtype).T
    axes, spacing = unfolded_axes(scene), scene.lattice.spacing
    rimmed = None if filled is None else _rimmed(filled).astype(origins.dtype)
    # From the near end on, so that a far eye costs no precision.
    start, stop = (jnp.where(jnp.isfinite(t), t, 0.0) for t in (start, stop))
    w = sloped(directions)
    o = to_voxel(scene, origins + start[:, None] * directions)
    length = jnp.maximum(stop - start, 0.0) / spacing
    coefficients = tuple(c * spacing for c in _coefficients(scene))
    uniform = all(c.shape[1] == 1 for c in coefficients)
    how = _March(axes, scene.bands, uniform), _MarchAdjoint(axes, scene.bands, uniform)
    radiance, depth = with_adjoint(*how)(coefficients, rimmed, o, w, length)
    return radiance.T, jnp.exp(-depth).T


@dataclasses.dataclass(frozen=True)
class _Depth:
    """Sums of a coefficient (b, V) over the lengths of rays in voxels: (b, n)."""

    axes: tuple[Axis, ...]

    def __call__(self, extinction: Array, o: Array, w: Array, start: Array, stop: Array) -> Array:
        add = lambda depth, point, voxel, length: depth + _at(extinction, voxel) * length
        return _walk(self.axes, o, w, start, stop, add, jnp.zeros((len(extinction), len(o)), o.dtype))


@dataclasses.dataclass(frozen=True)
class _DepthAdjoint:
    axes: tuple[Axis, ...]

    def __call__(self, arguments, wanted, weights: Array):
        extinction, o, w, start, stop = arguments
        add = lambda total, point, voxel, length: total.at[:, voxel].add(weights * length)
        return _walk(self.axes, o, w, start, stop, add, jnp.zeros_like(extinction)), None, None, None, None


@dataclasses.dataclass(frozen=True)
class _March:
    """Radiance added along rays and their optical depths, (C, n) each, of coefficients (b, V) per voxel's side."""

    axes: tuple[Axis, ...]
    bands: int
    uniform: bool

    def __call__(self, coefficients: tuple[Array, ...], rimmed: Array | None, o: Array, w: Array, length: Array):
        def add(state, point, voxel, step):
            radiance, depth = state
            values = tuple(_at(c, voxel) for c in coefficients)
            fluence = None if rimmed is None else _interpolate(self.axes, rimmed, _seen_from(values, point, step))
            added, own = _added(values, fluence, depth, step)
            return radiance + added, depth + own

        nothing = jnp.zeros((self.bands, len(o)), o.dtype)
        return self.advance(o, w, length, add, (nothing, nothing))

    def advance(self, o: Array, w: Array, length: Array, add: Callable, state: Any) -> Any:
        return (_stride if self.uniform else _walk)(self.axes, o, w, jnp.zeros_like(length), length, add, state)


def _seen_from(coefficients: tuple[Array, ...], point: Callable, step: Array) -> tuple[Array, ...]:
    """The centre of what a segment sends."""
    scattering, absorption, _ = coefficients
    return point(step * _center(((scattering + absorption) * step).mean(0)))


def _added(coefficients: tuple[Array, ...], fluence: Array | None, depth: Array, step: Array) -> tuple[Array, Array]:
    """The radiance that one segment sends through the depth before it, and its own depth."""
    scattering, absorption, source = coefficients
    if fluence is not None:
        source = source + scattering / (4 * jnp.pi) * fluence
    own = (scattering + absorption) * step
    return jnp.exp(-depth) * source * step * _share(own), jnp.broadcast_to(own, depth.shape)


@dataclasses.dataclass(frozen=True)
class _MarchAdjoint:
    """By a second march: of all that lies behind a segment, the total radiance minus that so far, its depth takes a share."""

    axes: tuple[Axis, ...]
    bands: int
    uniform: bool

    def __call__(self, arguments, wanted, weights: tuple[Array, Array]):
        coefficients, rimmed, o, w, length = arguments
        march = _March(self.axes, self.bands, self.uniform)
        total, _ = march(*arguments)

        def add(state, point, voxel, step):
            radiance, depth, sums, spread = state
            values = tuple(_at(c, voxel) for c in coefficients)
            corners = lambda values: [*_corners(self.axes, _seen_from(values, point, step))]
            places, around = [], []
            if rimmed is not None:
                places = [place for _, place in corners(values)]
                around = [rimmed.at[:, place].get(mode="promise_in_bounds") for place in places]

            def one(values, around):
                fluence = None
                if around:
                    fluence = sum((w * f for (w, _), f in zip(corners(values), around, strict=True)), start=jnp.zeros(()))
                return _added(values, fluence, depth, step)

            (added, own), back = jax.vjp(one, values, around)
            radiance = radiance + added
            to_values, to_around = back((weights[0], weights[1] - (total - radiance) * weights[0]))
            sums = tuple(_put(s, voxel, v) for s, v in zip(sums, to_values, strict=True))
            for place, value in zip(places, to_around, strict=True):
                spread = spread.at[:, place].add(value)
            return radiance, depth + own, sums, spread

        nothing = jnp.zeros((self.bands, len(o)), o.dtype)
        state = (nothing, nothing, *jax.tree.map(jnp.zeros_like, (coefficients, rimmed)))
        _, _, sums, spread = march.advance(o, w, length, add, state)
        return sums, spread, None, None, None


def _put(total: Array, voxel: Array | None, values: Array) -> Array:
    """The transpose of `_at`."""
    if total.shape[1] == 1 or voxel is None:
        return total + values.sum(1, keepdims=True)
    return total.at[:, voxel].add(values)


def _at(coefficient: Array, voxel: Array | None) -> Array:
    if coefficient.shape[1] == 1 or voxel is None:
        return coefficient
    return coefficient.at[:, voxel].get(mode="promise_in_bounds")


def _walk(axes: tuple[Axis, ...], o: Array, w: Array, start: Array, stop: Array, add: Callable, state: Any) -> Any:
    """state = add(state, point, voxel, length) for every voxel that rays cross between two distances; point(distance in it)."""
    (ny, nz), xs, ws = (axes[1].count, axes[2].count), tuple(o.T), tuple(w.T)
    index = tuple(jnp.floor(x + start * v).astype(jnp.int32) for x, v in zip(xs, ws, strict=True))

    def step(carry):
        t, index, state = carry
        # Times of crossing from the indices, not by adding up: no drift.
        planes = [(i + (v > 0) - x) / v for i, x, v in zip(index, xs, ws, strict=True)]
        crossing = jnp.minimum(jnp.minimum(planes[0], planes[1]), planes[2])
        after = jnp.clip(crossing, t, jnp.maximum(stop, t))
        point = lambda s: tuple(x + (t + s) * v for x, v in zip(xs, ws, strict=True))
        i, j, k = (axis.fold_index(n) for axis, n in zip(axes, index, strict=True))
        state = add(state, point, (i * ny + j) * nz + k, after - t)
        going = after < stop
        index = tuple(
            n + jnp.where(going & (p <= crossing), jnp.where(v > 0, 1, -1), 0)
            for n, p, v in zip(index, planes, ws, strict=True)
        )
        return after, index, state

    return lax.while_loop(lambda carry: (carry[0] < stop).any(), step, (start, index, state))[2]


def _stride(axes: tuple[Axis, ...], o: Array, w: Array, start: Array, stop: Array, add: Callable, state: Any) -> Any:
    """The same in equal steps of at most a voxel's side, where the medium is the same everywhere."""
    xs, ws = tuple(o.T), tuple(w.T)
    count = jnp.ceil(stop - start)
    length = (stop - start) / jnp.maximum(count, 1.0)

    def step(carry):
        number, state = carry
        point = lambda s: tuple(x + (start + number * length + s) * v for x, v in zip(xs, ws, strict=True))
        return number + 1, add(state, point, None, jnp.where(number < count, length, 0.0))

    most = jnp.max(count, initial=0.0)
    return lax.while_loop(lambda carry: carry[0] < most, step, (jnp.zeros((), o.dtype), state))[1]
