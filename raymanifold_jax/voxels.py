"""Solids made of voxels.

A `Voxels` solid is the union of the cubes of a mask that are True. From a point in a free cube the distance to the 26 cubes
around it is exact; further off a bound is used,

    d >= max(1, c - sqrt(3))   voxels,      c: distance of the cube's centre from the nearest full cube's centre,

and inside the solid the same holds for the free cubes. Cubes on the mask's sides have free space beyond them.

Public names: `Voxels`, `voxel_solids`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from . import checks
from .lattice import Lattice
from .scene import Solid
from .shapes import Bounds, Shape, clamped, corner_distance, greatest, greatest_coordinate, least, safe_norm

_MARGIN = 2  # free cubes around the mask
# In 32 bits, because JAX keeps constants between 32- and 64-bit modes.
_AROUND = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3).astype(np.int32)


class Voxels(Shape):
    """The union of the cubes of `mask` (nx, ny, nz), True where they are solid.

    **Arguments:**

    - `mask`: bool, or whole numbers, of which all but 0 are solid.
    - `lattice`: where the cubes are; its shape is the mask's. The scene's own lattice, so that faces of cubes are faces of its
      voxels, is the most accurate; cubes of a coarser one are boxes like any other.

    **Raises** `ValueError` for a mask of another shape, or one without any solid cube; `TypeError` for other things.
    """

    full: Bool[jax.Array, "X Y Z"]
    clearance: Float[jax.Array, "X Y Z"]
    lower: Float[checks.Numbers, " 3"]
    spacing: Float[checks.Numbers, ""]

    def __init__(self, mask: Any, lattice: Lattice):
        from scipy.ndimage import distance_transform_edt

        checks.instance("lattice", lattice, Lattice, "pass the scene's lattice")
        values = _labels("mask", mask, lattice)
        if not values.any():
            checks.fail(
                "mask", "an array without a True", "at least one solid cube", "leave the solid out if there is nothing in it"
            )
        full = np.pad(values != 0, _MARGIN)
        apart = np.where(full, *(np.asarray(distance_transform_edt(cubes)) for cubes in (full, ~full)))
        self.full = jnp.asarray(full)
        self.clearance = jnp.asarray(np.maximum(apart - np.sqrt(3), 1.0), jnp.float32)
        self.lower, self.spacing = np.array(lattice.lower), np.asarray(lattice.spacing)

    @property
    def mask(self) -> Bool[np.ndarray, "nx ny nz"]:
        """Where the solid is, on its own lattice."""
        inner = slice(_MARGIN, -_MARGIN)
        return np.asarray(self.full)[inner, inner, inner]

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points = checks.coordinates("points", points)
        lower, spacing = (jnp.asarray(a, points.dtype) for a in (self.lower, self.spacing))
        u = (points - lower) / spacing + _MARGIN
        shape = np.array(self.full.shape)
        # Off the mask: the solid lies within its box, one margin further in than the cube asked.
        inner = clamped(u, 1.0, jnp.asarray(shape - 1, u.dtype))
        away = safe_norm(u - inner)
        cube = jnp.clip(jnp.floor(inner).astype(int), 1, jnp.asarray(shape - 2))
        strides = np.array([shape[1] * shape[2], shape[2], 1], np.int32)
        around = (cube * strides).sum(-1)[..., None] + _AROUND @ strides
        is_full = self.full.reshape(-1)[around]
        inside = is_full[..., len(_AROUND) // 2]
        # Distance to each of the cubes around.
        beyond = jnp.abs(u[..., None, :] - (cube[..., None, :] + _AROUND + 0.5)) - 0.5
        to_cube = corner_distance(beyond)
        nearest = -greatest_coordinate(jnp.where(is_full != inside[..., None], -to_cube, -jnp.inf))
        bound = self.clearance.reshape(-1)[(cube * strides).sum(-1)].astype(u.dtype)
        outside = least((nearest, bound))
        apart = greatest((away + (_MARGIN - 1), bound - away))
        return spacing * jnp.where(away > 0, apart, jnp.where(inside, -outside, outside))

    def bounds(self) -> Bounds:
        index = np.argwhere(np.asarray(self.full)) - _MARGIN
        lower, spacing = np.asarray(self.lower), float(self.spacing)
        return lower + index.min(0) * spacing, lower + (index.max(0) + 1) * spacing


def voxel_solids(labels: Any, lattice: Lattice, materials: Mapping[int, Mapping[str, Any]]) -> list[Solid]:
    """One `Solid` for each label of a voxel model.

    **Arguments:**

    - `labels`: (nx, ny, nz) whole numbers, 0 where space is free.
    - `lattice`: as for `Voxels`.
    - `materials`: for each label what `Solid` takes, as in `{1: {"albedo": 0.5}, 2: {"albedo": 0.8, "emission": 1.0}}`. Labels
      that do not occur are left out.

    **Raises** `ValueError` for labels without a material, and what `Voxels` and `Solid` raise.
    """
    values = _labels("labels", labels, lattice)
    used = sorted(int(label) for label in np.unique(values) if label != 0)
    missing = [label for label in used if label not in materials]
    if missing:
        got = f"labels {missing} without a material"
        checks.fail("materials", got, f"one for each of {used}", f"add {{{missing[0]}: {{'albedo': 0.5}}}}")
    return [Solid(Voxels(values == label, lattice), **materials[label]) for label in used]


def _labels(name: str, values: Any, lattice: Lattice) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype != bool and not np.issubdtype(array.dtype, np.integer):
        checks.fail(name, f"an array of {array.dtype}", "bool or whole numbers", "compare it first: density > 0.5", TypeError)
    if array.shape != lattice.shape:
        checks.fail(name, f"an array of shape {array.shape}", f"{lattice.shape}, the lattice's", "give it a lattice of its own")
    return array
