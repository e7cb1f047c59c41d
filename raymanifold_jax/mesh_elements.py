"""Surface elements of closed triangle meshes, from the triangles themselves.

Triangles are cut by the planes between voxels. The pieces in one voxel that face about the same way make one element, with

    A n = sum of a_i n_i,        x = sum of a_i x_i / sum of a_i        (piece i: area a_i, normal n_i, middle x_i),

so that the vector areas of a closed mesh still add up to 0. Pieces inside other solids are left out.

Public for this package: `triangles_of`, `mesh_elements`, `clipped`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from .lattice import Lattice
from .mesh import Mesh
from .shapes import Rotated, Shape, Translated

_INWARD = 1e-3  # voxels: points this far behind a face decide which voxel owns it
_SAME_FACE = 0.8  # cosine between normals of pieces of one element
_FACES = 6  # elements of a voxel, at most
_SLIVER = 1e-3  # voxels squared: smaller elements are left out
_TRIANGLES = 1 << 15  # cut at once


def triangles_of(shape: Shape) -> Float[np.ndarray, "F 3 3"] | None:
    """Corners of the triangles of a closed mesh, also one that was moved or turned; None for other shapes."""
    if isinstance(shape, Mesh):
        return shape.surface.corners if shape.surface.report.closed else None
    if isinstance(shape, Translated):
        corners = triangles_of(shape.shape)
        return None if corners is None else corners + np.asarray(shape.offset)
    if isinstance(shape, Rotated):
        corners = triangles_of(shape.shape)
        if corners is None:
            return None
        center = np.asarray(shape.center)
        return (corners - center) @ shape.matrix().T + center
    return None


def mesh_elements(
    lattice: Lattice, corners: Float[np.ndarray, "F 3 3"], others: Callable[[np.ndarray], np.ndarray] | None
) -> dict[str, np.ndarray]:
    """Rows `voxel`, `normal`, `offset`, `area` (voxels squared), `centroid` (voxels, from the voxel's centre) of the elements.

    `others`: signed distance (voxels) to the other solids at points in scene units; None if there are none.
    """
    local = (corners - lattice.lower) / lattice.spacing
    parts = [_pieces(local[i : i + _TRIANGLES], np.array(lattice.shape)) for i in range(0, len(local), _TRIANGLES)]
    voxel, normal, area, middle = (np.concatenate([part[k] for part in parts]) for k in range(4))
    if others is not None and len(area):
        shown = others(lattice.lower + (middle + 0.02 * normal) * lattice.spacing) > 0
        voxel, normal, area, middle = voxel[shown], normal[shown], area[shown], middle[shown]
    return _joined(voxel, normal, area, middle, lattice.shape)


def _pieces(corners: np.ndarray, shape: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Voxel, normal, area and middle of the parts of triangles (voxel coordinates) in each voxel of the lattice."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    corners, normal = corners[length > 0], normal[length > 0] / length[length > 0, None]
    polygon = corners - _INWARD * normal[:, None]
    count = np.full(len(polygon), 3)
    voxel = np.zeros((len(polygon), 0), int)
    for axis in range(3):
        valid = np.arange(polygon.shape[1]) < count[:, None]
        along = polygon[..., axis]
        low = np.floor(np.where(valid, along, np.inf).min(1))
        high = np.floor(np.where(valid, along, -np.inf).max(1))
        low, high = np.maximum(low, 0).astype(int), np.minimum(high, shape[axis] - 1).astype(int)
        number = np.maximum(high - low + 1, 0)
        row = np.repeat(np.arange(len(polygon)), number)
        cell = low[row] + np.arange(len(row)) - np.repeat(np.cumsum(number) - number, number)
        polygon, count, normal, voxel = polygon[row], count[row], normal[row], voxel[row]
        polygon, count = clipped(polygon, count, polygon[..., axis] - cell[:, None])
        polygon, count = clipped(polygon, count, cell[:, None] + 1 - polygon[..., axis])
        keep = count >= 3
        polygon, count, normal = polygon[keep], count[keep], normal[keep]
        voxel = np.column_stack([voxel, cell])[keep]
    # A fan of triangles around the first corner.
    first = polygon[:, :1]
    valid = np.arange(2, polygon.shape[1]) < count[:, None]
    double = np.einsum("pvi,pi->pv", np.cross(polygon[:, 1:-1] - first, polygon[:, 2:] - first), normal) * valid
    area = double.sum(1) / 2
    keep = area > 1e-12
    middles = (first + polygon[:, 1:-1] + polygon[:, 2:]) / 3
    middle = (middles * double[..., None]).sum(1)[keep] / (2 * area[keep, None])
    return voxel[keep], normal[keep], area[keep], middle + _INWARD * normal[keep]


def clipped(polygon: np.ndarray, count: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Convex polygons (P, V, 3), with `count` corners each, where `height` (P, V) >= 0 (Sutherland & Hodgman 1974)."""
    size = polygon.shape[1]
    number = np.arange(size)
    following = np.where(number + 1 < count[:, None], number + 1, 0)
    after = np.take_along_axis(polygon, following[..., None], 1)
    height_after = np.take_along_axis(height, following, 1)
    valid = number < count[:, None]
    inside = (height >= 0) & valid
    crossed = ((height >= 0) != (height_after >= 0)) & valid
    share = height / np.where(crossed, height - height_after, 1.0)
    point = polygon + share[..., None] * (after - polygon)
    both = np.stack([polygon, point], 2).reshape(len(polygon), 2 * size, 3)
    kept = np.stack([inside, crossed], 2).reshape(len(polygon), 2 * size)
    order = np.argsort(~kept, axis=1, kind="stable")[:, : size + 1]
    return np.take_along_axis(both, order[..., None], 1), kept.sum(1)


def _joined(
    voxel: Int[np.ndarray, "P 3"], normal: np.ndarray, area: np.ndarray, middle: np.ndarray, shape: tuple[int, int, int]
) -> dict[str, np.ndarray]:
    """Pieces of one voxel that face the same way as its largest one make an element; then what is left over, and so on."""
    found = []
    flat = np.asarray(np.ravel_multi_index(tuple(voxel.T), shape)) if len(voxel) else np.zeros(0, int)
    for _ in range(_FACES):
        if not len(flat):
            break
        cell, number = np.unique(flat, return_inverse=True)
        order = np.lexsort((area, number))
        largest = order[np.cumsum(np.bincount(number)) - 1]
        member = np.einsum("pi,pi->p", normal, normal[largest][number]) > _SAME_FACE
        whose, part = number[member], area[member]
        vector = np.stack([np.bincount(whose, part * normal[member, i], len(cell)) for i in range(3)], 1)
        center = (
            np.stack([np.bincount(whose, part * middle[member, i], len(cell)) for i in range(3)], 1)
            / np.bincount(whose, part, len(cell))[:, None]
        )
        size = np.linalg.norm(vector, axis=1)
        unit = vector / size[:, None]
        index = np.stack(np.unravel_index(cell, shape), 1)
        centroid = center - index - 0.5
        keep = size > _SLIVER
        rows = {"voxel": index, "normal": unit, "offset": -(unit * centroid).sum(1), "area": size, "centroid": centroid}
        found.append({key: value[keep] for key, value in rows.items()})
        rest = ~member
        flat, normal, area, middle = flat[rest], normal[rest], area[rest], middle[rest]
    if not found:
        nothing = {key: np.zeros((0, 3)) for key in ("normal", "centroid")} | {key: np.zeros(0) for key in ("offset", "area")}
        return {"voxel": np.zeros((0, 3), int), **nothing}
    return {key: np.concatenate([f[key] for f in found]) for key in found[0]}
