"""Rays in voxel units and *unfolded* coordinates, and working on many of them.

A ray is straight: behind a MIRROR or PERIODIC side lies another image of the lattice, and a point or voxel is folded
back where the scene is asked about it. With n voxels along an axis,

    PERIODIC: u -> u mod n,      MIRROR at 0: u -> |u|,      MIRROR at n: u -> n - |n - u|,

and mirrors on both sides repeat after 2 n.

For this package: `Axis`, `unfolded_axes`, `mirror_images`, `fold`, `to_voxel`, `to_scene`, `sloped`, `box_span`, `in_blocks`.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import checks
from .arrays import on_accelerator, real_dtype
from .chunks import of_chunks, of_first_chunks, padded
from .programs import program
from .scene import MIRROR, PERIODIC, Scene
from .threads import count_cores, on_threads

_BLOCK = 1 << 14  # rays a call
_BUNDLE = 1 << 10  # rays that step together: neighbours end at about the same time
_FEW = 1 << 7  # rays: no more are a call of their own


class Axis(NamedTuple):
    """One axis of the unfolded lattice: its voxels, how it goes on, and where it ends."""

    count: int
    kind: str  # plain, periodic, mirrors, or a mirror at the lower or upper side
    lower: float
    upper: float

    def fold_index(self, index: Array, beyond: int = 0) -> Array:
        """The voxel in the lattice; behind a side that ends it, at most `beyond` past the last."""
        n = self.count
        if self.kind == "periodic":
            return index % n
        if self.kind == "mirrors":
            index = index % (2 * n)
        if self.kind == "lower":
            index = jnp.where(index < 0, -1 - index, index)
        elif self.kind != "plain":
            index = jnp.where(index >= n, 2 * n - 1 - index, index)
        return jnp.clip(index, -beyond, n - 1 + beyond)

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

    @property
    def mirror(self) -> int | None:
        """Where the one mirror is, behind which everything has one image."""
        return {"lower": 0, "upper": self.count}.get(self.kind)

    @property
    def endless(self) -> bool:
        return math.isinf(self.upper)

    def to_fold(self, u: Array, w: Array) -> Array:
        """Distance to the next plane between images, along a ray with component w."""
        plane = jnp.where(w > 0, jnp.floor(u / self.count) + 1, jnp.ceil(u / self.count) - 1) * self.count
        return (plane - u) / w


def unfolded_axes(scene: Scene) -> tuple[Axis, ...]:
    sides, axes = scene.boundary.sides, []
    for axis, n in enumerate(scene.lattice.shape):
        below, above = (side is MIRROR for side in sides[2 * axis : 2 * axis + 2])
        if sides[2 * axis] is PERIODIC:
            axes.append(Axis(n, "periodic", -math.inf, math.inf))
        elif below and above:
            axes.append(Axis(n, "mirrors", -math.inf, math.inf))
        else:
            kind = "lower" if below else "upper" if above else "plain"
            axes.append(Axis(n, kind, -n if below else 0, 2 * n if above else n))
    return tuple(axes)


def mirror_images(scene: Scene) -> list[tuple[np.ndarray, np.ndarray]]:
    """Where mirrors show what is at u, in unfolded voxel coordinates: at sign * u + shift; itself first."""
    images = [(np.ones(3), np.zeros(3))]
    for number, axis in enumerate(unfolded_axes(scene)):
        if axis.mirror is not None:
            here = np.arange(3) == number
            images += [(np.where(here, -1, sign), np.where(here, 2 * axis.mirror, shift)) for sign, shift in images]
    return images


def fold(axes: tuple[Axis, ...], u: Float[Array, "n 3"]) -> tuple[Array, Array]:
    folded = [axis.fold(u[:, i]) for i, axis in enumerate(axes)]
    return jnp.stack([f[0] for f in folded], -1), jnp.stack([f[1] for f in folded], -1)


def to_voxel(scene: Scene, points: Array) -> Array:
    return (points - jnp.asarray(scene.lattice.lower, points.dtype)) / scene.lattice.spacing


def to_scene(scene: Scene, u: Array) -> Array:
    return jnp.asarray(scene.lattice.lower, u.dtype) + u * scene.lattice.spacing


def sloped(directions: Array) -> Array:
    # No component is 0, so that distances to planes are large and not NaN.
    return jnp.where(jnp.abs(directions) < 1e-20, 1e-20, directions)


def box_span(scene: Scene, u: Array, w: Array) -> tuple[Array, Array]:
    """Distances at which lines enter and leave the lattice's box."""
    shape = jnp.asarray(scene.lattice.shape, u.dtype)
    first, second = -u / w, (shape - u) / w
    return jnp.minimum(first, second).max(-1), jnp.maximum(first, second).min(-1)


def in_blocks(function: Callable, scene: Any, arrays: tuple[Any, ...]) -> Any:
    """function(scene, *arrays) some rays at a time, for arrays (n, ...) or trees of them; results have n as their first axis.

    All arrays but of truth values are made real.
    """
    if checks.is_traced(arrays):
        return _in_bundles(function, scene, _real(arrays, jnp))
    arrays = _real(arrays, np)
    count, known = len(jax.tree.leaves(arrays)[0]), not checks.is_traced(scene)
    # Few sizes, each compiled once. Derivatives cannot leave bundles out.
    block = (_FEW if count <= _FEW else _BLOCK) if known else _power_of_two(count)
    begins = range(0, max(count, 1), block)
    arrays = jax.tree.map(lambda a: padded(a, block), arrays)
    blocks = [jax.tree.map(lambda a, i=i: a[i : i + block], arrays) for i in begins]

    def run(begin: int, rays: tuple[Any, ...]) -> Any:
        if not known:
            return _jitted_again(function, scene, rays)
        return _jitted(function, scene, rays, np.array(-(-(count - begin) // _BUNDLE), np.int32))

    if len(blocks) > 2 and known and not on_accelerator():
        # The first block alone, for the program to be compiled once.
        parts = [run(0, blocks[0]), *on_threads(_pool(), run, begins[1:], blocks[1:])]
    else:
        parts = [*map(run, begins, blocks)]
    return parts[0] if count == block else _joined(parts, count)


def _real(arrays: tuple[Any, ...], xp: Any) -> tuple[Any, ...]:
    real = lambda a: a if a.dtype in (bool, real_dtype()) else a.astype(real_dtype())
    numbers = lambda a: isinstance(a, list) or (isinstance(a, tuple) and not hasattr(a, "_fields"))  # as Python has them
    return tuple(jax.tree.map(lambda a: real(xp.asarray(a)), array, is_leaf=numbers) for array in arrays)


def _power_of_two(count: int) -> int:
    return min(_BLOCK, max(64, 1 << (max(count, 1) - 1).bit_length()))


@functools.cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count_cores(), "rays")


def _joined(parts: list[Any], count: int) -> Any:
    if checks.is_traced(parts) or on_accelerator():
        return _concatenated(parts, count)
    # Not by JAX, which would make a program for every count.
    return jax.device_put(jax.tree.map(lambda *r: np.concatenate(r)[:count], *parts))


@program
def _concatenated(parts: list[Any], count: int) -> Any:
    return jax.tree.map(lambda *r: jnp.concatenate(r)[:count], *parts)


@program
def _jitted(function: Callable, scene: Any, arrays: tuple[Any, ...], used: Any) -> Any:
    """Of the bundles of a block those that are used."""
    return of_first_chunks(functools.partial(function, scene), arrays, _BUNDLE, used)


@program
def _jitted_again(function: Callable, scene: Any, arrays: tuple[Any, ...]) -> Any:
    """The same for derivatives: what rays meet is worked out again backwards, not kept."""
    return _in_bundles(jax.checkpoint(function), scene, arrays)  # pyright: ignore[reportPrivateImportUsage]


def _in_bundles(function: Callable, scene: Any, arrays: tuple[Any, ...]) -> Any:
    return of_chunks(functools.partial(function, scene), arrays, _BUNDLE)
