"""Light straight from compact emitting parts of a medium, such as the glow of a lamp in a shield.

A part's light at a point x is the integral over its volume of

    e T / r^2                      (fluence; e is emitted radiance per length, T transmittance, r the distance),
    e T max(cos(theta), 0) / r^2   (irradiance; theta from the normal).

Far from a part, points stand for its volume: it is cut into at most two blocks along each axis, with 2 x 2 x 2 Gauss points
each, weighted so that the block keeps its power and the centre of it. Near a part and in it the integral is taken over
directions instead, of the radiance that rays from x collect in it: nothing is singular there. Behind a mirror lies an image
of a part; coordinates are unfolded (see `unfolding`).

A part is a set of emitting voxels that touch. Large ones are left to the sweeps, which have rays enough through them; so are
those next to surfaces of solids, or between two mirrors or periodic sides, with images without end. JAX differentiates their
light in the values of a medium; which voxels emit has no derivative.

Public: `VolumeSources`, `compact_sources`, `volume_light`, `emission_of`, `with_emission`.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from . import checks
from .arrays import real_dtype
from .directions import gathering
from .march import march_between
from .programs import program
from .scene import Scene
from .surfaces import Surfaces
from .trace import share_that_passes, trace_rays
from .unfolding import Axis, in_blocks, to_scene, unfolded_axes

Numbers = np.ndarray | Array

_PARTS = 16
_GAUSS = 0.5 / math.sqrt(3)  # of a block's side, from its middle
_RAYS = 1024
_MOST_RAYS = 200  # a voxel, both kinds together: as long as some sweeps take
_PAIRS = 1 << 18
_OFF = 2e-3  # voxels: how far off a surface rays start


class Part(NamedTuple):
    """Emitting voxels that touch, with their images; positions in unfolded voxel coordinates."""

    emission: Numbers  # theirs alone, W m^-3 sr^-1: (C, nx, ny, nz)
    lower: Float[np.ndarray, "images 3"]
    upper: Float[np.ndarray, "images 3"]
    reach: float  # voxels: what is nearer to a box than this is near
    points: Float[np.ndarray, "m 3"]
    power: Numbers  # (C, m): emission times volume, in voxels' sides cubed

    def near(self, u: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        outside = np.maximum(self.lower - u[:, None], u[:, None] - self.upper).max(-1)
        return outside.min(1) < self.reach


class VolumeSources(NamedTuple):
    """The compact emitting parts of a scene's medium."""

    parts: tuple[Part, ...]
    emits: Bool[np.ndarray, "nx ny nz"]  # theirs; what other voxels may emit is left to the sweeps


def compact_sources(scene: Scene, surfaces: Surfaces, blocks: int = 1) -> VolumeSources | None:
    """The compact parts, cut into up to `blocks` blocks for every one that they are cut into for whole lattices of points.

    None if there are none, or if emission is not known while JAX stages a program (the sweeps carry it then).
    """
    if scene.medium is None:
        return None
    values, axes = emission_of(scene), unfolded_axes(scene)
    known = lax.stop_gradient(values)
    if checks.is_traced(known) or any(axis.endless for axis in axes):
        return None
    emission = np.where(surfaces.solid, 0.0, np.asarray(known, np.float64))
    if not emission.any():
        return None
    from scipy import ndimage  # which takes its time

    at_solids = np.zeros(scene.lattice.shape, bool)
    at_solids[tuple(surfaces.voxel[surfaces.side < 0].T)] = True
    label = np.zeros(scene.lattice.shape, np.int32)
    count = int(ndimage.label(emission.any(0), output=label))  # pyright: ignore
    if count > _PARTS or (at_solids & (label > 0)).any():
        return None
    values = values if checks.is_traced(values) else emission
    xp = _numpy(values)
    boxes = ndimage.find_objects(label)
    parts = tuple(_part(axes, xp.where(label == i + 1, values, 0.0), box, blocks) for i, box in enumerate(boxes))
    u = np.moveaxis(np.indices(scene.lattice.shape), 0, -1).reshape(-1, 3) + 0.5
    near = np.stack([part.near(u) for part in parts], 1)
    rays = near.any(1).mean() * _RAYS + (1 - near.mean(0)) @ [len(part.points) for part in parts] / blocks**3
    return VolumeSources(parts, label > 0) if rays <= _MOST_RAYS else None


def _numpy(values: Any) -> Any:
    """JAX's for what it differentiates; known numbers stay in numpy, in double precision."""
    return jnp if checks.is_traced(values) else np


def _part(axes: tuple[Axis, ...], emission: Numbers, box: tuple[slice, ...], blocks: int) -> Part:
    ends = [(s.start, s.stop) for s in box]
    mirrors = [axis.mirror for axis in axes]
    touches = [m is not None and m in e for m, e in zip(mirrors, ends, strict=True)]
    whole = [(1 + t) * (b - a) for t, (a, b) in zip(touches, ends, strict=True)]
    # Two blocks along the whole of it, of which one is an image's where it touches a mirror.
    side = max(whole) / 2
    number = [max(1, round(blocks * (b - a) / side)) for a, b in ends]
    # Voxels are cut where blocks are smaller.
    fine = max(math.ceil(n / (b - a)) for n, (a, b) in zip(number, ends, strict=True))
    inside = emission[(slice(None), *box)]
    for axis in range(3):
        inside = inside.repeat(fine, axis + 1)
    cuts = [
        np.unique(np.linspace(0, fine * (b - a), n + 1).round().astype(int)) for n, (a, b) in zip(number, ends, strict=True)
    ]
    lowest = np.array([a for a, _ in ends])
    points, power = [], []
    for corner in itertools.product(*(range(len(c) - 1) for c in cuts)):
        block = tuple(slice(c[i], c[i + 1]) for c, i in zip(cuts, corner, strict=True))
        found = _block_points(inside[(slice(None), *block)], block)
        points.append(lowest + found[0] / fine)
        power.append(found[1] / fine**3)
    xp = _numpy(emission)
    position, strength = np.concatenate(points), xp.concatenate(power, -1)
    lower, upper = (np.array([e[i] for e in ends], float)[None] for i in range(2))
    for axis, mirror in enumerate(mirrors):
        if mirror is not None:
            flip = lambda u, axis=axis, mirror=mirror: np.where(np.arange(3) == axis, 2 * mirror - u, u)
            swapped = np.minimum(flip(lower), flip(upper)), np.maximum(flip(lower), flip(upper))
            lower, upper = np.concatenate([lower, swapped[0]]), np.concatenate([upper, swapped[1]])
            position, strength = np.concatenate([position, flip(position)]), xp.concatenate([strength, strength], -1)
    return Part(emission, lower, upper, side, position, strength)


def _block_points(emission: Numbers, block: tuple[slice, ...]) -> tuple[np.ndarray, Numbers]:
    """Gauss points of one block (8, 3), and their powers (C, 8), which keep the block's power and the centre of it."""
    middle = np.array([(s.start + s.stop) / 2 for s in block])
    side = np.array([s.stop - s.start for s in block])
    signs = np.array(list(itertools.product((-1, 1), repeat=3)))
    u = np.stack(np.meshgrid(*(np.arange(s.start, s.stop) + 0.5 for s in block), indexing="ij"), -1)
    xp = _numpy(emission)
    total = emission.sum((1, 2, 3))
    center = xp.einsum("cxyz,xyzi->ci", emission, u - middle) / xp.where(total > 0, total, 1.0)[:, None]
    lean = xp.clip(center / (_GAUSS * side), -1, 1)
    share = xp.prod(1 + lean[:, None] * signs, -1) / len(signs)
    return middle + _GAUSS * side * signs, total[:, None] * share


def volume_light(
    scene: Scene,
    sources: VolumeSources,
    positions: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"] | None = None,
    rays: int = _RAYS,
) -> Float[Array, "C n"]:
    """Irradiance from the sources at surface points, or without normals fluence: straight, attenuated and shadowed."""
    real = real_dtype()
    positions = np.asarray(positions, np.float64)
    u = (positions - scene.lattice.lower) / scene.lattice.spacing
    u = u if normals is None else u + _OFF * normals
    near = np.stack([part.near(u) for part in sources.parts], 1)
    total = jnp.zeros((scene.bands, len(u)), real)
    for part, is_near in zip(sources.parts, near.T, strict=True):
        (far,) = np.nonzero(~is_near)
        total = total.at[:, far].add(_from_points(scene, part, u[far], None if normals is None else normals[far]))
    for pattern in np.unique(near, axis=0):
        (chosen,) = np.nonzero((near == pattern).all(1))
        if pattern.any():
            emission = sum(p.emission for p, kept in zip(sources.parts, pattern, strict=True) if kept)
            found = _from_directions(scene, emission, u[chosen], None if normals is None else normals[chosen], rays)
            total = total.at[:, chosen].add(found)
    return total


def _from_points(scene: Scene, part: Part, u: np.ndarray, normal: np.ndarray | None) -> Float[Array, "C n"]:
    count, each = len(u), len(part.points)
    block = max(1, min(_PAIRS // each, 1 << max(count - 1, 0).bit_length()))
    found = []
    for i in range(0, count, block):
        here = u[i : i + block]
        to = part.points - here[:, None]
        squared = (to**2).sum(-1)
        geometry = scene.lattice.spacing / squared  # spacing^3 over the distance in scene units, squared
        if normal is not None:
            geometry *= np.maximum(np.einsum("nmi,ni->nm", to, normal[i : i + block]), 0) / np.sqrt(squared)
        starts = np.broadcast_to(here[:, None], to.shape).reshape(-1, 3)
        passed = in_blocks(share_that_passes, scene, (starts, np.broadcast_to(part.points, to.shape).reshape(-1, 3)))
        found.append(_summed(passed.reshape(*to.shape[:2], -1), jnp.asarray(geometry, passed.dtype), part.power))
    return jnp.concatenate(found, -1) if found else jnp.zeros((scene.bands, 0))


@program
def _summed(passed: Array, geometry: Array, power: Numbers) -> Array:
    return jnp.einsum("nmc,nm,cm->cn", passed, geometry, jnp.asarray(power, passed.dtype))


def _from_directions(scene: Scene, emission: Any, u: np.ndarray, normal: np.ndarray | None, rays: int) -> Float[Array, "C n"]:
    """4 pi, or with a normal pi, times the mean of the radiance that rays collect."""
    spread = gathering(rays, len(u), normal)
    glowing = with_emission(scene, emission)
    found, block = [], max(1, _PAIRS // rays)
    for i in range(0, len(u), block):
        here = spread[i : i + block]
        seen = in_blocks(_collected, glowing, (np.repeat(u[i : i + block], rays, 0), here.reshape(-1, 3)))
        found.append(seen.reshape(*here.shape[:2], -1).mean(1).T)
    return jnp.concatenate(found, -1) * (4 * jnp.pi if normal is None else jnp.pi)


def _collected(scene: Scene, u: Array, direction: Array) -> Float[Array, "n C"]:
    origin = to_scene(scene, u)
    hit = trace_rays(scene, origin, direction)
    return march_between((scene, None), origin, direction, hit.enter, hit.distance)[0]


def emission_of(scene: Scene) -> Float[Array, "C nx ny nz"]:
    """The medium's emission in each voxel."""
    assert scene.medium is not None
    xp = _numpy(scene.medium)
    emission = jax.tree.map(xp.asarray, scene.medium).coefficients()[2]
    return xp.moveaxis(xp.broadcast_to(emission, (*scene.lattice.shape, scene.bands)), -1, 0)


def with_emission(scene: Scene, emission: Numbers) -> Scene:
    """The scene with another emission of its medium."""
    field = jnp.moveaxis(jnp.asarray(emission), 0, -1)
    return eqx.tree_at(lambda s: s.medium.emission, scene, field if scene.banded else field[..., 0])
