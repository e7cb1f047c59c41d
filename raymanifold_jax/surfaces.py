"""Where the surfaces are: CUT voxels and the surface elements they hold.

The scene's signed distance f (in voxels here) is sampled once, on the host, in float64. A voxel that the surface crosses
is CUT and gets one *element* per distinct face in it: the plane n . (x - c) + offset = 0 through the voxel with centre c, with
the outward unit normal n, its area inside the voxel, and a material. Faces that lie exactly between two voxels belong to
the voxel on the solid side (offset = -1/2). Every side of the domain that is closed or open holds elements of the same kind
in a layer of ghost voxels around the lattice: a wall reflects, an open side is black and lets the light of the sky in.

Public: `Surfaces`, `find_surfaces`, `patch_points`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .lattice import Lattice
from .mesh_elements import mesh_elements, triangles_of
from .scene import OPEN, Scene, Wall

#: Cosine between the normals of neighbouring points of one face: a sharper edge parts two faces, each an element of its own.
_SAME_FACE = 0.9
_FACES = 6  # faces told apart in a voxel, at most
#: Points this far behind a face (voxels) decide which voxel owns it: the one on the solid side.
_INWARD = 1e-3
_NEAR = 0.5 * np.sqrt(3) + 0.1  # voxels: centres this near to a surface may have it in their voxel
_PATCH = 8  # samples a side on an element's plane
_SLIVER = 0.1  # voxel faces: patches smaller than this
_BATCH = 1 << 15  # voxels analysed at once


@dataclasses.dataclass(frozen=True)
class Surfaces:
    """Surface elements of a scene, one row each, and the voxels inside solids.

    `voxel` (E, 3) counts from 0; -1 and n are the ghost layers of the domain's sides. `offset` is the signed distance in voxels
    of the voxel's centre from the element's plane. `material` indexes the solids, then the six sides. `side` is 0..5
    (x-, x+, y-, y+, z-, z+) for elements of the domain's sides, else -1.
    """

    voxel: np.ndarray
    normal: np.ndarray
    offset: np.ndarray
    area: np.ndarray  # scene units squared
    position: np.ndarray  # scene units
    material: np.ndarray
    side: np.ndarray
    open: np.ndarray
    solid: np.ndarray  # (nx, ny, nz): wholly inside a solid

    def __len__(self) -> int:
        return len(self.area)

    @property
    def probe(self) -> np.ndarray:
        """(E, 3) the voxel that stands in where no ray hits: the element's own if its centre is outside the solid."""
        size = np.abs(self.normal)
        # Along the dominant axis, or all of them on a diagonal: so that a turned scene has the turned probes.
        step = np.sign(self.normal).astype(int) * (size > size.max(1, keepdims=True, initial=0) - 1e-6)
        return self.voxel + np.where(self.offset > 0, 0, 1)[:, None] * step


def find_surfaces(scene: Scene) -> Surfaces:
    """Sample the scene's signed distance and return its surface elements."""
    with jax.enable_x64(True):
        field = _DistanceField(scene)
        lattice = scene.lattice
        far = np.full(lattice.shape, np.inf)
        distance = field.distance(lattice.centers()) if scene.solids else far
        parts = [_solid_elements(scene, field, distance)] if scene.solids else []
        cut = np.zeros(lattice.shape, bool)
        for part in parts:
            cut[tuple(part["voxel"].T)] = True
        solid = (distance < 0) & ~cut
        parts += [p for side in range(6) if (p := _side_elements(scene, field, side)) is not None]
    if not parts:
        parts = [_no_elements()]
    joined = {key: np.concatenate([p[key] for p in parts]) for key in parts[0]}
    return Surfaces(**joined, solid=solid)


def _elements(rows: dict[str, np.ndarray], side: int, is_open: bool) -> dict[str, np.ndarray]:
    count = len(rows["area"])
    return {**rows, "side": np.full(count, side), "open": np.full(count, is_open)}


def _no_elements() -> dict[str, np.ndarray]:
    rows = {"voxel": np.zeros((0, 3), int), "material": np.zeros(0, int)}
    rows |= {key: np.zeros((0, 3)) for key in ("normal", "position")} | {key: np.zeros(0) for key in ("offset", "area")}
    return _elements(rows, -1, False)


class _DistanceField:
    """The solids' signed distance and its gradient in voxels, at points in scene units, in batches."""

    def __init__(self, scene: Scene, which: Sequence[int] | None = None):
        self.spacing = scene.lattice.spacing
        # The shapes alone: albedos may be traced while a scene is being fitted, its geometry never is.
        self._shapes = tuple(scene.solids[i].shape for i in (range(len(scene.solids)) if which is None else which))

    def distance(self, points: np.ndarray) -> np.ndarray:
        return self._batched(lambda x: _least(self._shapes, x), points) / self.spacing

    def gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slope = self._batched(lambda x: _slope(self._shapes, x), points)
        return value / self.spacing, slope

    def nearest(self, points: np.ndarray) -> np.ndarray:
        return self._batched(lambda x: _nearest(self._shapes, x), points)

    @staticmethod
    def _batched(function: Callable, points: np.ndarray, size: int = 1 << 18):
        shape = points.shape[:-1]
        flat = points.reshape(-1, 3)
        # One padded batch size keeps this to one compilation, two where the scene is small.
        size = min(size, max(1024, 1 << (max(len(flat), 1) - 1).bit_length()))
        parts = []
        for start in range(0, max(len(flat), 1), size):
            block = flat[start : start + size]
            padded = np.zeros((size, 3)) if len(block) < size else block
            padded[: len(block)] = block
            parts.append(jax.tree.map(lambda a: np.asarray(a), function(jnp.asarray(padded))))
        return jax.tree.map(lambda *a: np.concatenate(a)[: len(flat)].reshape(*shape, *a[0].shape[1:]), *parts)


# Programs that scenes of like shapes share.


def _distances(shapes: tuple, points: jax.Array) -> jax.Array:
    return jnp.stack([shape.distance(points) for shape in shapes])


@eqx.filter_jit
def _least(shapes: tuple, points: jax.Array) -> jax.Array:
    return _distances(shapes, points).min(0)


@eqx.filter_jit
def _slope(shapes: tuple, points: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(jax.value_and_grad(lambda x: _distances(shapes, x[None]).min()))(points)


@eqx.filter_jit
def _nearest(shapes: tuple, points: jax.Array) -> jax.Array:
    return jnp.argmin(_distances(shapes, points), 0)


def _solid_elements(scene: Scene, field: _DistanceField, distance: np.ndarray) -> dict[str, np.ndarray]:
    """Elements of the solids' surfaces in the lattice's voxels."""
    lattice = scene.lattice
    near = np.abs(distance) < _NEAR
    meshes = {i: corners for i, solid in enumerate(scene.solids) if (corners := triangles_of(solid.shape)) is not None}
    if meshes:  # closed meshes bring their own elements
        others = [i for i in range(len(scene.solids)) if i not in meshes]
        near &= np.abs(_DistanceField(scene, others).distance(lattice.centers())) < _NEAR if others else False
    candidates = np.argwhere(near)
    found = [
        _faces(scene, field, candidates[i : i + _BATCH], distance[tuple(candidates[i : i + _BATCH].T)])
        for i in range(0, len(candidates), _BATCH)
    ]
    for rows in found:
        rows["material"] = field.nearest(_position(lattice, rows)).astype(int)
    if meshes:
        found = [{key: value[~np.isin(f["material"], [*meshes])] for key, value in f.items()} for f in found]
    for number, corners in meshes.items():
        others = [i for i in range(len(scene.solids)) if i != number]
        rows = mesh_elements(lattice, corners, _DistanceField(scene, others).distance if others else None)
        found.append({**rows, "material": np.full(len(rows["area"]), number)})
    if not found:
        return _no_elements()
    joined = {key: np.concatenate([f[key] for f in found]) for key in found[0]}
    position = _position(lattice, joined)
    del joined["centroid"]
    joined["area"] = joined["area"] * lattice.spacing**2
    # The underside of a solid that stands on a side of the domain faces out of it: no surface of this scene.
    ahead = position + 0.02 * lattice.spacing * joined["normal"]
    beyond = ((ahead < lattice.lower) | (ahead > lattice.upper)) & ~np.array(scene.boundary.periodic)
    rows = {**joined, "position": position}
    return _elements({key: value[~beyond.any(1)] for key, value in rows.items()}, side=-1, is_open=False)


def _position(lattice: Lattice, rows: dict[str, np.ndarray]) -> np.ndarray:
    """Middles of elements in scene units."""
    return lattice.lower + (rows["voxel"] + 0.5 + rows["centroid"]) * lattice.spacing


def _faces(scene: Scene, field: _DistanceField, voxels: np.ndarray, distance: np.ndarray) -> dict[str, np.ndarray]:
    """The faces in some voxels: one where the surface is smooth, one for each side of a crease."""
    spacing = scene.lattice.spacing
    center = scene.lattice.lower + (voxels + 0.5) * spacing
    normals, has_face = _distinct_normals(field, center, spacing)
    # Where the surface is smooth the distance at the centre gives the plane itself.
    own_distance, own_normal = field.gradient(center)
    foot = center - (own_distance * spacing)[:, None] * own_normal
    smooth = (np.linalg.norm(own_normal, axis=1) > 1 - 1e-3) & (has_face.sum(1) <= 1)
    smooth &= _slopes(field, foot, own_normal, spacing)[1]
    has_face[smooth, 0] = True
    normals[smooth, 0] = own_normal[smooth]
    rows, which = np.nonzero(has_face)
    normal = normals[rows, which]
    on_plane = np.where(smooth[rows], own_distance[rows], np.nan)
    creased = ~smooth[rows]
    on_plane[creased] = _plane_offset(field, center[rows[creased]], normal[creased], spacing)
    # Planes through the middle of their patch: the tangent at the point nearest the centre would stand proud of a ball.
    rounded = ~creased
    normal[rounded], on_plane[rounded] = _refit(field, center[rows[rounded]], normal[rounded], on_plane[rounded], spacing)
    patch, weight = patch_points(normal, on_plane)
    # The plane is the face as far as the distance's slope is its normal: past an edge it is not.
    error, slope = field.gradient(center[rows, None] + patch * spacing)
    there = (np.abs(error) < np.where(creased, 0.1, 0.5)[:, None]) & (np.einsum("msi,mi->ms", slope, normal) > 0.7)
    real = weight * there
    covered, whole = real.sum(1), weight.sum(1)
    area = plane_area_in_voxel(normal, on_plane)
    # Corners that a smooth surface cuts off may be too small for the grid of points.
    corner = _on_plane_in_voxel(normal, on_plane)
    sliver = rounded & (whole < _SLIVER) & _on_face(field, center[rows] + corner * spacing, normal)
    covered, whole = (np.where(sliver, area, x) for x in (covered, whole))
    area = area * covered / np.maximum(whole, 1e-9)
    curved = np.nonzero(~sliver & ((np.abs(error) * real).max(1, initial=0.0) > 1e-6))[0]
    parts = (center[rows], normal, patch, error, slope)
    area[curved] = _curved_area(field, *(part[curved] for part in parts))
    half_width = 0.5 * np.abs(normal).sum(1)
    owned = (on_plane < half_width - 1e-6) & (on_plane >= -half_width - 1e-6)
    keep = owned & (covered > np.where(sliver, 0.0, 0.02)) & (area > 1e-3) & np.isfinite(on_plane)
    middle = (patch * real[..., None]).sum(1) / np.maximum(covered, 1e-9)[:, None]
    centroid = np.where(sliver[:, None], corner, middle)
    return {
        "voxel": voxels[rows][keep], "normal": normal[keep], "offset": on_plane[keep], "area": area[keep],
        "centroid": centroid[keep],
    }  # fmt: skip


def _refit(field: _DistanceField, center, normal, offset, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Move planes so that over their patches in the voxel the signed distance averages 0 and its slope is theirs."""
    patch, weight = patch_points(normal, offset)
    value, slope = field.gradient(center[:, None] + patch * spacing)
    weight = weight * (np.einsum("msi,mi->ms", slope, normal) > 0.7)  # not past an edge
    area = weight.sum(1)
    share = weight / np.maximum(area, 1e-9)[:, None]
    mean_value = (value * share).sum(1)
    mean_slope = (slope * share[..., None]).sum(1)
    length = np.linalg.norm(mean_slope, axis=1)
    middle = (patch * share[..., None]).sum(1)
    usable = (area > 0) & (length > 0.9) & (np.abs(mean_value) < 0.3)
    refitted = mean_slope / np.maximum(length, 1e-12)[:, None]
    through = mean_value - np.einsum("mi,mi->m", refitted, middle)
    return np.where(usable[:, None], refitted, normal), np.where(usable, through, offset)


def _distinct_normals(field: _DistanceField, center: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """Distinct surface normals in each voxel: (M, faces, 3) and which of them exist (M, faces)."""
    side = (np.arange(4) + 0.5) / 4 - 0.5
    samples = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    points = center[:, None] + samples * spacing
    for _ in range(2):  # project the samples on the surface
        value, slope = field.gradient(points)
        points = points - (value * spacing)[..., None] * slope
    value, _ = field.gradient(points)
    slope, clear = _slopes(field, points, slope, spacing)
    behind = (points - center[:, None]) / spacing - _INWARD * slope
    valid = (np.abs(behind).max(-1) <= 0.5) & (np.abs(value) < 0.02)
    valid &= clear
    label = _label_faces(valid, slope)
    member = label[:, None] == np.arange(_FACES)[:, None]
    mean = np.einsum("mfs,msi->mfi", member.astype(float), slope)
    length = np.linalg.norm(mean, axis=2, keepdims=True)
    return mean / np.maximum(length, 1e-12), member.any(2) & (length[..., 0] > 1e-6)


def _slopes(field: _DistanceField, points: np.ndarray, outward: np.ndarray, spacing: float) -> tuple[np.ndarray, np.ndarray]:
    """The distance's slope just outside the surface at some points on it, and whether it is a face's.

    On an edge it is not: the two sides of the surface disagree there.
    """
    step = 1e-4 * spacing * outward
    slope, below = (field.gradient(points + s)[1] for s in (step, -step))
    unit = np.abs(np.linalg.norm(slope, axis=-1) - 1) < 1e-3
    return slope, unit & (np.sum(slope * below, axis=-1) > 0.999)


def _label_faces(valid: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Which face each sample of a voxel lies on, 0.. (M, S); -1: none, or past the last face told apart.

    Samples are on one face if steps between similar normals join them: a curved face stays one, whichever way it is turned.
    """
    label = np.where(valid, 0, -1)
    mean = (slope * valid[..., None]).sum(1, keepdims=True)
    mean /= np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-12)
    unlike = valid & (np.einsum("msi,mti->ms", slope, mean) < _SAME_FACE)
    creased = np.nonzero(unlike.any(1))[0]
    for rows in np.array_split(creased, max(1, -(-len(creased) // 4096))):
        label[rows] = _join(valid[rows], slope[rows])
    return label


def _join(valid: np.ndarray, slope: np.ndarray) -> np.ndarray:
    count = valid.shape[1]
    alike = np.einsum("msi,mti->mst", slope, slope) > _SAME_FACE
    alike &= valid[:, :, None] & valid[:, None]
    first = np.where(valid, np.arange(count), count)  # the first sample of each sample's face
    while True:
        joined = np.minimum(first, np.where(alike, first[:, None], count).min(2))
        if np.array_equal(joined, first):
            break
        first = joined
    mean = np.einsum("mst,mti->msi", (first[:, :, None] == first[:, None]).astype(float), slope * valid[..., None])
    mean /= np.maximum(np.linalg.norm(mean, axis=2, keepdims=True), 1e-12)
    # A face that turns right round in the voxel is parted by the axes its normals point along.
    apart = valid & (np.einsum("msi,msi->ms", slope, mean) < 0.3)
    turned = np.any((first[:, :, None] == first[:, None]) & apart[:, None], axis=2)
    axis = np.argmax(np.abs(slope), axis=2)
    sense = np.take_along_axis(slope, axis[..., None], 2)[..., 0] > 0
    first = np.where(turned & valid, count + 1 + 2 * axis + sense, first)
    names = np.arange(count + 7)
    present = (first[:, :, None] == names).any(1) & (names != count)
    rank = np.cumsum(present, axis=1) - 1
    label = np.take_along_axis(rank, first, 1)
    return np.where(valid & (label < _FACES), label, -1)


def _plane_offset(field: _DistanceField, center: np.ndarray, normal: np.ndarray, spacing: float) -> np.ndarray:
    """Signed distance of a voxel's centre from the face with this normal: march along the normal to the surface.

    NaN where that face is not met within the voxel's reach.
    """
    if not len(center):
        return np.zeros(0)
    steps = np.linspace(-0.9, 0.9, 37)
    # Sampling f on the normal's line through several points of the voxel finds the face even off-centre.
    side = np.array([-0.375, -0.125, 0.125, 0.375])
    starts = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    starts = starts - np.einsum("si,mi->ms", starts, normal)[..., None] * normal[:, None]
    points = center[:, None, None] + (starts[:, :, None] + steps[:, None] * normal[:, None, None]) * spacing
    value, slope = field.gradient(points.reshape(len(center), -1, 3))
    aligned = np.einsum("msi,mi->ms", slope, normal) > 0.999
    height = np.broadcast_to(steps, (len(center), starts.shape[1], len(steps))).reshape(len(center), -1)
    estimate = np.where(aligned & (np.abs(value) < 0.2), height - value, np.nan)
    met = np.isfinite(estimate).any(1)
    offset = np.full(len(center), np.nan)
    offset[met] = -np.nanmedian(estimate[met], axis=1)
    return offset


def patch_points(normal: np.ndarray, offset: np.ndarray, count: int = _PATCH) -> tuple[np.ndarray, np.ndarray]:
    """Points on each plane, (M, 3 n^2, 3) from the voxel's centre, and the area each stands for: 0 outside the voxel.

    There is one grid along each axis; their shares n_x^2 + n_y^2 + n_z^2 = 1 treat all axes alike.
    """
    grid = (np.arange(count) + 0.5) / count - 0.5
    a, b = (g.ravel() for g in np.meshgrid(grid, grid, indexing="ij"))
    points, weights = np.zeros((len(normal), 3, count**2, 3)), np.zeros((len(normal), 3, count**2))
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        along = normal[:, axis, None]
        slope = np.where(along >= 0, 1, -1) * np.maximum(np.abs(along), 1e-6)
        height = np.nan_to_num(-(offset[:, None] + normal[:, u, None] * a + normal[:, v, None] * b) / slope, nan=9.0)
        points[:, axis, :, u], points[:, axis, :, v], points[:, axis, :, axis] = a, b, np.clip(height, -9, 9)
        weights[:, axis] = (np.abs(height) <= 0.5 + 1e-6) * np.where(np.abs(along) > 1e-3, np.abs(along), 0.0) / count**2
    return points.reshape(len(normal), -1, 3), weights.reshape(len(normal), -1)


def _on_plane_in_voxel(normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The point of each plane in its voxel that is nearest to the centre, (M, 3) from there; a corner if there is none."""
    # It lies back along the normal, as far as the voxel's faces let each coordinate go.
    point = lambda back: np.clip(-back[:, None] * normal, -0.5, 0.5)
    low, high = np.full(len(normal), -1e4), np.full(len(normal), 1e4)
    for _ in range(50):
        back = (low + high) / 2
        ahead = np.einsum("mi,mi->m", normal, point(back)) > -offset
        low, high = np.where(ahead, back, low), np.where(ahead, high, back)
    return point(high)


def _on_face(field: _DistanceField, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Whether points are on, or nearly on, a face with this normal."""
    distance, slope = field.gradient(points)
    return (np.abs(distance) < 0.1) & (np.einsum("mi,mi->m", slope, normal) > 0.9)


def _curved_area(field: _DistanceField, center, normal, patch, distance, slope) -> np.ndarray:
    """The area of curved surfaces in their voxels, from the `patch_points` of planes near them.

    Points go to the surface along their grid's axis, and stand for the area that the surface's slope there gives them. The
    planes alone would lack 0.3 % of the area of a ball 7 voxels in radius, and 3 % of a torus whose tube is 3 voxels thick.
    """
    count = patch.shape[1] // 3
    grid = np.repeat(np.eye(3), count, axis=0)  # the axis that each point's grid looks along
    along = np.einsum("msi,si->ms", slope, grid)
    move = distance / np.copysign(np.maximum(np.abs(along), 1e-6), along)
    patch = patch - np.clip(move, -0.5, 0.5)[..., None] * grid
    distance, slope = field.gradient(center[:, None] + patch * field.spacing)
    size = np.abs(np.einsum("msi,si->ms", slope, grid))
    # The part of a point's cell, over which the surface rises as it slopes there, that is in the voxel.
    rise = (np.abs(slope).sum(2) - size) / np.maximum(size, 1e-6) / np.sqrt(count)
    below = 0.5 - np.abs(np.einsum("msi,si->ms", patch, grid))
    inside = np.clip(0.5 + (below + 1e-6) / np.maximum(rise, 1e-6), 0.0, 1.0)
    same = (np.abs(distance) < 0.02) & (np.einsum("msi,mi->ms", slope, normal) > 0.7)
    return np.where(same, inside * size, 0.0).sum(1) / count


def plane_area_in_voxel(normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Area of the plane n . x + offset = 0 inside the unit cube around the origin: (M, 3), (M,) -> (M,).

    The second derivative of the cube's corner-sum formula for the volume below a plane; exact for any orientation.
    """
    n = np.sort(np.abs(normal), axis=1)[:, ::-1]
    n = np.maximum(n / np.linalg.norm(n, axis=1, keepdims=True), [[0.0, 1e-5, 1e-5]])
    # Distance past the first corner (the area is symmetric in the offset's sign); a plane that is a face counts in full.
    depth = np.maximum(0.5 * n.sum(1) - np.abs(offset), 2e-4)
    total = np.zeros(len(n))
    for corner in np.ndindex(2, 2, 2):
        sign = (-1) ** sum(corner)
        total += sign * np.maximum(depth - n @ np.array(corner, float), 0.0) ** 2
    return np.maximum(total / (2 * n.prod(1)), 0.0)


def _side_elements(scene: Scene, field: _DistanceField, side: int) -> dict[str, np.ndarray] | None:
    """Elements of one side of the domain: the faces of its boundary voxels that no solid covers."""
    kind = scene.boundary.sides[side]
    if not (kind is OPEN or isinstance(kind, Wall)):
        return None
    lattice = scene.lattice
    axis, upper = side // 2, side % 2
    u, v = (axis + 1) % 3, (axis + 2) % 3
    inward = np.zeros(3)
    inward[axis] = -1.0 if upper else 1.0
    i, j = (g.ravel() for g in np.meshgrid(np.arange(lattice.shape[u]), np.arange(lattice.shape[v]), indexing="ij"))
    voxel = np.zeros((len(i), 3), int)
    voxel[:, axis] = lattice.shape[axis] if upper else -1
    voxel[:, u], voxel[:, v] = i, j
    grid = (np.arange(4) + 0.5) / 4 - 0.5
    offsets = np.zeros((16, 3))
    offsets[:, u], offsets[:, v] = (g.ravel() for g in np.meshgrid(grid, grid, indexing="ij"))
    face = voxel + 0.5 + 0.5 * inward
    points = face[:, None] + offsets
    at = lambda depth: lattice.lower + (points + depth * inward) * lattice.spacing
    if scene.solids:
        exposed = field.distance(at(0.01)) > 0
        # A solid that lies just behind the side shows through it, flush: a lamp in a ceiling.
        flush = exposed & (field.distance(at(-0.01)) < 0)
    else:
        exposed, flush = np.ones(points.shape[:2], bool), np.zeros(points.shape[:2], bool)
    parts = []
    for member, material, is_open in (
        (exposed & ~flush, len(scene.solids) + side, kind is OPEN),
        (flush, None, False),
    ):
        fraction = member.mean(1)
        keep = fraction > 0
        if not keep.any():
            continue
        centroid = (points[keep] * member[keep][..., None]).sum(1) / member[keep].sum(1)[:, None]
        position = lattice.lower + centroid * lattice.spacing
        if material is None:
            index = field.nearest(position - 0.01 * inward * lattice.spacing).astype(int)
        else:
            index = np.full(keep.sum(), material)
        rows = {
            "voxel": voxel[keep], "normal": np.tile(inward, (keep.sum(), 1)), "offset": np.full(keep.sum(), -0.5),
            "area": fraction[keep] * lattice.spacing**2, "position": position, "material": index,
        }  # fmt: skip
        parts.append(_elements(rows, side, is_open))
    if not parts:
        return None
    return {key: np.concatenate([p[key] for p in parts]) for key in parts[0]}
