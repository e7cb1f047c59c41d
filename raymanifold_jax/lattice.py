"""The voxel lattice: where things are.

Voxel (i, j, k) is the cube of side `spacing` whose lower corner lies at origin + spacing * (i, j, k); axes 0, 1, 2 of
every voxel array are x, y, z. *Voxel coordinates* are (position - origin) / spacing: voxel i covers [i, i + 1] and its
centre is at i + 1/2.

Public name: `Lattice`.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from . import checks


class Lattice(eqx.Module):
    """A box of cubic voxels, with any number of voxels along each axis.

    **Arguments:**

    - `shape`: voxels along x, y and z, three ints >= 1.
    - `spacing`: the side of a voxel, in scene units, > 0.
    - `origin`: the lower corner of the box, in scene units.

    All three are static: changing one compiles anew. **Raises** `TypeError` or `ValueError` for anything else.
    """

    shape: tuple[int, int, int] = eqx.field(static=True)
    spacing: float = eqx.field(static=True)
    origin: tuple[float, float, float] = eqx.field(static=True)

    def __init__(self, shape: Any, spacing: Any = 1.0, origin: Any = (0, 0, 0)):
        advice = "pass three ints, as in (64, 64, 64)"
        try:
            sizes = () if isinstance(shape, str) else tuple(shape)
        except TypeError:  # nothing to go through
            sizes = ()
        if len(sizes) != 3:
            checks.fail("shape", shape, "the numbers of voxels along x, y and z", advice)
        nx, ny, nz = (checks.positive_int(f"shape[{axis}]", n) for axis, n in enumerate(sizes))
        self.shape = (nx, ny, nz)
        for name, value in (("spacing", spacing), ("origin", origin)):
            if checks.is_traced(value):
                checks.fail(name, value, "known numbers", "a lattice is static: make it outside jit and grad", TypeError)
        self.spacing = float(checks.positive("spacing", spacing, ()))
        x, y, z = (float(c) for c in checks.vector3("origin", origin))
        self.origin = (x, y, z)

    @property
    def lower(self) -> Float[np.ndarray, " 3"]:
        """The lower corner of the box, in scene units."""
        return np.asarray(self.origin)

    @property
    def upper(self) -> Float[np.ndarray, " 3"]:
        """The upper corner of the box, in scene units."""
        return self.lower + self.extent

    @property
    def extent(self) -> Float[np.ndarray, " 3"]:
        """The sides of the box, in scene units."""
        return np.asarray(self.shape) * self.spacing

    @property
    def box(self) -> str:
        """The box in words, for messages."""
        return f"{self.lower.tolist()} to {self.upper.tolist()}"

    @property
    def size(self) -> int:
        """The number of voxels."""
        nx, ny, nz = self.shape
        return nx * ny * nz

    def centers(self) -> Float[np.ndarray, "nx ny nz 3"]:
        """The centres of all voxels, in scene units."""
        axes = [o + self.spacing * (np.arange(n) + 0.5) for o, n in zip(self.origin, self.shape, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)

    def contains(self, points: Any) -> Bool[np.ndarray | jax.Array, "..."]:
        """Whether each of `points` (..., 3), in scene units, lies in the box, its surface included."""
        voxel = self.to_voxel(points)
        xp = jnp if isinstance(voxel, jax.Array) else np
        return xp.asarray(((voxel >= 0) & (voxel <= np.asarray(self.shape))).all(axis=-1))

    def to_voxel(self, points: Any) -> Float[np.ndarray | jax.Array, "... 3"]:
        """Voxel coordinates of `points` (..., 3) in scene units; a JAX array gives a JAX array."""
        if isinstance(points, jax.Array):
            points = checks.coordinates("points", points)
            return (points - jnp.asarray(self.lower, points.dtype)) / self.spacing
        numbers = checks.array("points", points)
        if numbers.ndim == 0 or numbers.shape[-1] != 3:
            checks.fail("points", f"an array of shape {numbers.shape}", "shape (..., 3)", "put x, y and z on the last axis")
        return (numbers - self.lower) / self.spacing
