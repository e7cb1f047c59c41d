"""Values that vary over surfaces: textures on an axis-aligned rectangle, and values of the triangles of a mesh.

A texture is a grid of values looked at along one axis of the scene: a surface point x takes the value of the cell it projects
into. Cells are constant inside, so that a value is what a fit of one cell means; points off the rectangle take the nearest
cell. `Texture.on_faces` gives each triangle of a mesh a value instead. A surface element has the mean over its face, by area.

Public: `Texture`; `value_at`, `mean_values` for this package.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from . import checks
from .lattice import Lattice
from .shapes import Shape

if TYPE_CHECKING:
    from .mesh_faces import FaceMap

_AXES = ("x", "y", "z")


class Texture(eqx.Module):
    """A grid of values, projected on surfaces along an axis.

    **Arguments:**

    - `values`: (nu, nv) or (nu, nv, bands). Axes u, v are the other two in increasing order: with `axis="z"`, `values[i, j]`
      is the i-th cell along x and the j-th along y.
    - `axis`: "x", "y" or "z".
    - `lower`, `upper`: (2,) corners of the rectangle in u and v, in scene units; the lattice's if left out.

    **Raises** `ValueError` for values that are no grid, an unknown axis, or an empty rectangle.
    """

    values: Float[jax.Array, "nu nv *bands"]
    lower: Float[np.ndarray, " 2"] | None
    upper: Float[np.ndarray, " 2"] | None
    faces: FaceMap | None
    axis: str = eqx.field(static=True)

    def __init__(self, values: Any, axis: str = "z", lower: Any = None, upper: Any = None):
        numbers = checks.non_negative("values", values)
        if numbers.ndim not in (2, 3) or 0 in numbers.shape:
            expected = "shape (nu, nv) or (nu, nv, bands)"
            checks.fail("values", f"an array of shape {numbers.shape}", expected, "for a uniform value pass a number")
        if axis not in _AXES:
            checks.fail("axis", repr(axis), 'one of "x", "y", "z"', 'use "z" for a floor')
        given = (("lower", lower), ("upper", upper))
        corners = [None if c is None else np.array(checks.finite(n, c, (2,)), float) for n, c in given]
        if corners[0] is not None and corners[1] is not None and not np.all(corners[0] < corners[1]):
            checks.fail("upper", upper, f"more than lower, {corners[0].tolist()}, along both axes", "swap them")
        self.values = jnp.asarray(numbers, float)
        self.lower, self.upper = corners
        self.faces = None
        self.axis = axis

    @classmethod
    def on_faces(cls, mesh: Shape, values: Any) -> Texture:
        """A value for each triangle of a mesh: (F,) or (F, bands), in the order of `mesh.faces`.

        `mesh`: an `rm.Mesh` as it stands in the scene, also moved or turned. The texture has `values` (F, 1[, bands]).

        **Raises** `ValueError` for another number of values, `TypeError` for another shape.
        """
        from .mesh_faces import face_map

        faces = face_map(mesh)
        numbers, count = checks.non_negative("values", values), len(faces.corners)
        if numbers.ndim not in (1, 2) or len(numbers) != count or 0 in numbers.shape:
            expected = f"({count},) or ({count}, bands), one value for each row of mesh.faces"
            checks.fail(
                "values", f"an array of shape {numbers.shape}", expected, "triangles without area are no part of a mesh"
            )
        return eqx.tree_at(lambda t: t.faces, cls(numbers[:, None]), faces, is_leaf=lambda x: x is None)

    @property
    def ndim(self) -> int:
        """Of one value: 1 with bands, else 0."""
        return self.values.ndim - 2

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one value."""
        return self.values.shape[2:]

    def cell(self, lattice: Lattice, points: Any) -> tuple[Int[Any, " n"], Int[Any, " n"]]:
        """The cells (i, j) that points (n, 3) in scene units project into, or (face, 0)."""
        if self.faces is not None:
            face = self.faces(points)
            return face, 0 * face
        along = [k for k in range(3) if k != _AXES.index(self.axis)]
        lower = lattice.lower[along] if self.lower is None else self.lower
        upper = lattice.upper[along] if self.upper is None else self.upper
        xp = np if isinstance(points, np.ndarray) else jnp
        place = (points[..., along] - xp.asarray(lower, points.dtype)) / xp.asarray(upper - lower, points.dtype)
        i, j = (xp.clip(xp.floor(place[..., k] * n), 0, n - 1).astype(np.int32) for k, n in enumerate(self.values.shape[:2]))
        return i, j


def value_at(value: Array | Texture, lattice: Lattice, points: Float[Array, "n 3"], bands: int) -> Float[Array, "n C"]:
    """A surface's value at points on it."""
    if not isinstance(value, Texture):
        return jnp.broadcast_to(jnp.asarray(value, points.dtype), (*points.shape[:-1], bands))
    found = value.values[value.cell(lattice, points)]
    found = found if value.ndim else found[..., None]
    return jnp.broadcast_to(found, (*points.shape[:-1], bands)).astype(points.dtype)


def mean_values(value: Texture, lattice: Lattice, points: np.ndarray, weight: np.ndarray, bands: int) -> Float[Array, "C m"]:
    """Means over some points on each of m faces, (m, s, 3), with weights (m, s) by area."""
    i, j = value.cell(lattice, points)
    total = weight.sum(1, keepdims=True)
    share = np.where(total > 0, weight / np.maximum(total, 1e-30), 1 / weight.shape[1])
    found = value.values[i, j] if value.ndim else value.values[i, j][..., None]
    mean = jnp.einsum("ms,msc->cm", jnp.asarray(share, found.dtype), found)
    return jnp.broadcast_to(mean, (bands, len(points)))
