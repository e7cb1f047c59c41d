"""Where the surfaces are: CUT voxels and the surface elements they hold.

The scene's signed distance f (in voxels here) is sampled once, on the host, in float64. A voxel that the surface crosses
is CUT and gets one *element* per distinct face in it: the plane n . (x - c) + offset = 0 through the voxel with centre c, with
the outward unit normal n, its area inside the voxel, and a material. Faces that lie exactly between two voxels belong to
the voxel on the solid side (offset = -1/2). Every side of the domain that is closed or open holds elements of the same kind
in a layer of ghost voxels around the lattice: a wall reflects, an open side is black and lets the light of the sky in.

Public: `Surfaces`, `find_surfaces`, `distance_to_solids`, `patch_points`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Container

import jax
import numpy as np
from jaxtyping import Float

from .arrays import worked_out_now
from .faces import NEAR, DistanceField, find_faces
from .faces import patch_points as patch_points
from .lattice import Lattice
from .mesh_elements import mesh_elements, triangles_of
from .scene import OPEN, Scene, Wall

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
        # The shapes alone: albedos may be traced while a scene is being fitted, its geometry never is.
        field = DistanceField(scene.lattice, [solid.shape for solid in scene.solids])
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


def distance_to_solids(scene: Scene, points: Float[np.ndarray, "*batch 3"]) -> Float[np.ndarray, " *batch"]:
    """Signed distance of known points to the solids, in voxels, also while JAX traces values; far if there are no solids."""
    if not scene.solids:
        return np.full(points.shape[:-1], 1e9)
    with worked_out_now(), jax.enable_x64(True):
        return DistanceField(scene.lattice, [solid.shape for solid in scene.solids]).distance(points)


def _elements(rows: dict[str, np.ndarray], side: int, is_open: bool) -> dict[str, np.ndarray]:
    count = len(rows["area"])
    return {**rows, "side": np.full(count, side), "open": np.full(count, is_open)}


def _no_elements() -> dict[str, np.ndarray]:
    rows = {"voxel": np.zeros((0, 3), int), "material": np.zeros(0, int)}
    rows |= {key: np.zeros((0, 3)) for key in ("normal", "position")} | {key: np.zeros(0) for key in ("offset", "area")}
    return _elements(rows, -1, False)


def _solid_elements(scene: Scene, field: DistanceField, distance: np.ndarray) -> dict[str, np.ndarray]:
    """Elements of the solids' surfaces in the lattice's voxels."""
    lattice = scene.lattice
    near = np.abs(distance) < NEAR
    meshes = {i: corners for i, solid in enumerate(scene.solids) if (corners := triangles_of(solid.shape)) is not None}
    if meshes:  # closed meshes bring their own elements
        others = _without(scene, meshes)
        near &= np.abs(others.distance(lattice.centers())) < NEAR if others else False
    candidates = np.argwhere(near)
    found = [find_faces(field, candidates[i : i + _BATCH]) for i in range(0, len(candidates), _BATCH)]
    for rows in found:
        rows["material"] = field.nearest(_position(lattice, rows)).astype(int)
    if meshes:
        found = [{key: value[~np.isin(f["material"], [*meshes])] for key, value in f.items()} for f in found]
    for number, corners in meshes.items():
        others = _without(scene, [number])
        rows = mesh_elements(lattice, corners, others.distance if others else None)
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


def _without(scene: Scene, left_out: Container[int]) -> DistanceField | None:
    """The distance of the other solids, if there are any."""
    others = [solid.shape for i, solid in enumerate(scene.solids) if i not in left_out]
    return DistanceField(scene.lattice, others) if others else None


def _position(lattice: Lattice, rows: dict[str, np.ndarray]) -> np.ndarray:
    """Middles of elements in scene units."""
    return lattice.lower + (rows["voxel"] + 0.5 + rows["centroid"]) * lattice.spacing


def _side_elements(scene: Scene, field: DistanceField, side: int) -> dict[str, np.ndarray] | None:
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
    exposed, flush = np.ones((len(face), 16), bool), np.zeros((len(face), 16), bool)
    if scene.solids:
        distance = field.distance(lattice.lower + face * lattice.spacing)
        exposed &= distance[:, None] > 0
        # No sample of a face is further from its middle.
        near = np.abs(distance) < 0.75
        at = lambda depth: lattice.lower + (face[near, None] + (offsets + depth * inward)) * lattice.spacing
        exposed[near] = field.distance(at(0.01)) > 0
        # A solid that lies just behind the side shows through it, flush: a lamp in a ceiling.
        flush[near] = exposed[near] & (field.distance(at(-0.01)) < 0)
    parts = []
    for member, material, is_open in (
        (exposed & ~flush, len(scene.solids) + side, kind is OPEN),
        (flush, None, False),
    ):
        fraction = member.mean(1)
        keep = fraction > 0
        if not keep.any():
            continue
        centroid = face[keep] + member[keep] @ offsets / member[keep].sum(1)[:, None]
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
