"""Which triangle of a mesh a point on its surface lies on: for values that are given face by face.

Nodes of a grid over the mesh know the triangle next to them; a point asks the eight nodes around it, and takes the nearest of
their triangles by its exact distance.

Public for this package: `FaceMap`, `face_map`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from . import checks
from .mesh import Mesh
from .shapes import Rotated, Shape, Translated

_CORNERS = np.stack(np.meshgrid(*[[0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3)
_FINEST = 128  # cells along the longest side: the exact distance sees finer
_SAMPLES = 1 << 26


class FaceMap(eqx.Module):
    """The triangles of a mesh, (F, 3, 3), and a grid (X, Y, Z) of the one nearest to each node."""

    corners: Float[checks.Numbers, "F 3 3"]
    nearest: Int[checks.Numbers, "X Y Z"]
    origin: Float[checks.Numbers, " 3"]
    cell: Float[checks.Numbers, ""]

    def __call__(self, points: Float[Any, "*batch 3"]) -> Int[Any, "*batch"]:
        """The triangle of each of some points near the surface."""
        xp: Any = np if all(isinstance(a, np.ndarray) for a in (points, self.corners)) else jnp
        origin, cell = (xp.asarray(a, points.dtype) for a in (self.origin, self.cell))
        last = xp.asarray(self.nearest.shape) - 2
        node = xp.clip(xp.floor((points - origin) / cell).astype(int), 0, last)[..., None, :] + _CORNERS
        candidates = xp.asarray(self.nearest)[node[..., 0], node[..., 1], node[..., 2]]
        corners = xp.asarray(self.corners, points.dtype)[candidates]
        best = xp.argmin(_square_distance(xp, corners, points[..., None, :]), -1)
        return xp.take_along_axis(candidates, best[..., None], -1)[..., 0]


def face_map(shape: Shape) -> FaceMap:
    """Of a mesh, also one that was moved or turned. **Raises** `TypeError` for other shapes."""
    from scipy.spatial import KDTree

    mesh, corners = _mesh(shape), _corners(shape)
    lower, upper = corners.min((0, 1)), corners.max((0, 1))
    cell = max(float(mesh.cell), float((upper - lower).max()) / _FINEST)
    count = np.ceil((upper - lower) / cell).astype(int) + 3
    origin = lower - cell
    sample, face = _samples(corners, cell / 2)
    nearest = np.zeros(count, np.int32)
    nodes = _around(np.floor((sample - origin) / cell).astype(int), count)
    nearest[tuple(nodes.T)] = face[KDTree(sample).query(origin + nodes * cell)[1]]
    return FaceMap(corners, nearest, origin, np.asarray(cell))


def _mesh(shape: Shape) -> Mesh:
    while isinstance(shape, Translated | Rotated):
        shape = shape.shape
    checks.instance("mesh", shape, Mesh, "values by face are for meshes; use rm.Texture(values, axis) for other shapes")
    assert isinstance(shape, Mesh)
    return shape


def _corners(shape: Shape) -> Float[np.ndarray, "F 3 3"]:
    if isinstance(shape, Translated):
        return _corners(shape.shape) + np.asarray(shape.offset)
    if isinstance(shape, Rotated):
        center = np.asarray(shape.center)
        return (_corners(shape.shape) - center) @ np.asarray(shape.matrix()).T + center
    return _mesh(shape).surface.corners


def _samples(corners: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Points all over the triangles, at most about `step` apart, and the triangle of each."""
    edge = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(edge, axis=-1)
    first = length.argmax(1)
    row = np.arange(len(corners))
    a, b, c = (corners[row, (first + k) % 3] for k in range(3))
    base = np.maximum(length.max(1), 1e-300)
    height = np.linalg.norm(np.cross(b - a, c - a), axis=1) / base
    along, across = (np.maximum(np.ceil(x / step), 1).astype(np.int64) for x in (base, height))
    number = along * across
    if number.sum() > _SAMPLES:
        checks.fail("mesh", f"{number.sum()} points of its grid", f"{_SAMPLES} at most", "make it with a smaller resolution")
    face = np.repeat(row, number)
    place = np.arange(len(face)) - np.repeat(np.cumsum(number) - number, number)
    s, t = (place % along[face] + 0.5) / along[face], (place // along[face] + 0.5) / across[face]
    points = (1 - t[:, None]) * (a[face] + s[:, None] * (b - a)[face]) + t[:, None] * c[face]
    return points, face


def _around(voxel: Int[np.ndarray, "n 3"], count: np.ndarray) -> Int[np.ndarray, "m 3"]:
    """The nodes of voxels and of their neighbours: a point of the surface may be rounded into one of those."""
    near = np.zeros(count, bool)
    near[tuple(voxel.T)] = True
    for axis in range(3):
        along = np.moveaxis(near, axis, 0)
        before = along.copy()
        along[:-1] |= before[1:]
        along[1:] |= before[:-1]
        along[2:] |= before[:-2]
    return np.argwhere(near)


def _square_distance(xp: Any, corners: Any, points: Any) -> Any:
    """Of points (..., 3) to triangles (..., 3, 3), squared."""
    edge = xp.roll(corners, -1, axis=-2) - corners
    to = points[..., None, :] - corners
    dot = lambda u, v: xp.sum(u * v, -1)
    tiny = xp.asarray(1e-30, corners.dtype)
    share = xp.clip(dot(to, edge) / xp.maximum(dot(edge, edge), tiny), 0, 1)
    rim = to - share[..., None] * edge
    at_rim = xp.min(dot(rim, rim), -1)
    normal = xp.cross(edge[..., 0, :], edge[..., 1, :])
    inside = xp.all(dot(xp.cross(edge, to), normal[..., None, :]) >= 0, -1)
    at_plane = dot(to[..., 0, :], normal) ** 2 / xp.maximum(dot(normal, normal), tiny)
    return xp.where(inside, at_plane, at_rim)
