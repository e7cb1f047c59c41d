"""The light-ray-cube scheme's picture of a scene: every node SOLID, SURFACE or FREE, and the SURFACE nodes' normals.

Nodes are the voxels' centres. With M the half-width of the light ray cube,

- SOLID: inside a solid; beyond a side of the domain that is a wall, every node is;
- SURFACE: not SOLID, and within distance M of a SOLID node;
- FREE: all others; beyond an open side, every node is.

Distance is the largest of |dx|, |dy|, |dz|, in which every hop of a ray has length M: so no hop leads from a FREE node past the
layer of SURFACE nodes around a solid. The normal of a SURFACE node points to the centre of mass of the FREE nodes among
the (2M + 1)^3 around it (Langer, Breton & Zucker 1995; this follows a description of the paper, whose wording was not at
hand: the metric of "distance M" and of the neighbourhood is this module's reading). Where there are none, in gaps narrower than
2M + 1, the nodes that are not SOLID take their place; where these balance exactly the node has no normal, and light goes by.

Public: `RayNodes`, `find_nodes`.
"""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np

from ..scene import OPEN, Scene, Wall
from ..surfaces import Surfaces
from ..unfolding import in_blocks

_TIE = 1e-4  # voxels: a solid this little further than a wall owns the surface: it is flush with the wall


@dataclasses.dataclass(frozen=True)
class RayNodes:
    """The kinds of all nodes, and the SURFACE nodes as a table of surface elements.

    `solid`, `surface`: (nx, ny, nz). `table`: a row for each SURFACE node that has a normal, in the order of its flat index
    `cell`; its area is a voxel face's, its plane goes through the node.
    """

    solid: np.ndarray
    surface: np.ndarray
    normal: np.ndarray  # (3, nx, ny, nz), 0 but at SURFACE nodes
    cell: np.ndarray
    table: Surfaces

    @property
    def free(self) -> np.ndarray:
        return ~self.solid & ~self.surface


def find_nodes(scene: Scene, half_width: int) -> RayNodes:
    """Classify the nodes of a scene for hops of `half_width` planes.

    **Raises** `ValueError` if no node is FREE: the lattice is too coarse for the half-width.
    """
    lattice = scene.lattice
    centers = lattice.centers()
    distance = np.full(lattice.shape, np.inf)
    if scene.solids:
        flat = in_blocks(Scene.distance, scene, (centers.reshape(-1, 3),))
        distance = np.asarray(flat, np.float64).reshape(lattice.shape) / lattice.spacing
    solid = distance < 0
    surface, normal = _surfaces(_surrounded(scene, solid, 2 * half_width), half_width)
    if not (~solid & ~surface).any():
        raise ValueError(
            f"half_width: got {half_width} for {' x '.join(map(str, lattice.shape))} voxels, expected one that leaves nodes "
            f"further than that from every solid and wall; use half_width={max(1, half_width // 2)}, or more voxels"
        )
    surface &= np.any(normal != 0, axis=0)
    cell = np.flatnonzero(surface)
    voxel = np.argwhere(surface)
    count = len(cell)
    table = Surfaces(
        voxel=voxel, normal=normal[:, surface].T, offset=np.zeros(count), area=np.full(count, lattice.spacing**2),
        position=centers[surface], material=_owners(scene, centers[surface], voxel), side=np.full(count, -1),
        open=np.zeros(count, bool), solid=solid,
    )  # fmt: skip
    return RayNodes(solid, surface, normal, cell, table)


def _surrounded(scene: Scene, solid: np.ndarray, depth: int) -> np.ndarray:
    """SOLID nodes, with `depth` nodes more beyond each side: SOLID beyond walls, wrapped where periodic."""
    around = solid
    sides = scene.boundary.sides
    for axis in range(3):
        width = [(0, 0)] * 3
        width[axis] = (depth, depth)
        if scene.boundary.periodic[axis]:
            around = np.pad(around, width, mode="wrap")
        else:
            around = np.pad(around, width, constant_values=False)
    # Walls last: beyond an edge between a wall and an open side the wall goes on, so that it ends in no rim.
    for side, kind in enumerate(sides):
        if isinstance(kind, Wall):
            beyond = [slice(None)] * 3
            beyond[side // 2] = slice(-depth, None) if side % 2 else slice(0, depth)
            around[tuple(beyond)] = True
    return around


def _surfaces(around: np.ndarray, m: int) -> tuple[np.ndarray, np.ndarray]:
    """SURFACE nodes and their normals in the lattice, from SOLID nodes with 2 m more on each side."""
    count = lambda field: _filtered(field.astype(np.int32), (np.ones(2 * m + 1, np.int32),) * 3)
    near = count(around) > 0  # one layer of m is used up, on each side
    inner = (slice(m, -m),) * 3
    free, outside = ~near, ~around[inner]
    normal = _unit(_moment(free, m))
    fallback = _unit(_moment(outside, m))
    normal = np.where(np.any(normal != 0, axis=0), normal, fallback)
    surface = near[inner] & outside[inner]
    return surface, np.where(surface, normal, 0.0)


def _moment(members: np.ndarray, m: int) -> np.ndarray:
    """Sum of the offsets to the members among the (2m + 1)^3 nodes around each: whole numbers, so exactly symmetric."""
    ones, ramp = np.ones(2 * m + 1, np.int32), np.arange(-m, m + 1, dtype=np.int32)
    members = members.astype(np.int32)
    kernels = [tuple(ramp if a == axis else ones for a in range(3)) for axis in range(3)]
    return np.stack([_filtered(members, kernel) for kernel in kernels])


def _filtered(field: np.ndarray, kernels: tuple[np.ndarray, ...]) -> np.ndarray:
    """Correlation with a separable kernel, where it fits."""
    for axis, kernel in enumerate(kernels):
        size = field.shape[axis] - len(kernel) + 1
        take = lambda i, field=field, axis=axis, size=size: np.take(field, np.arange(i, i + size), axis)
        field = sum(int(k) * take(i) for i, k in enumerate(kernel) if k)  # pyright: ignore[reportAssignmentType]
    return field


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.sqrt((vectors.astype(np.float64) ** 2).sum(0))
    return vectors / np.where(length > 0, length, 1.0)


def _owners(scene: Scene, position: np.ndarray, voxel: np.ndarray) -> np.ndarray:
    """The solid or side nearest to each SURFACE node, the first of equals: numbers as in `Surfaces.material`."""
    shape = np.array(scene.lattice.shape)
    distances = np.full((len(scene.solids) + 6, len(position)), np.inf)
    for number, solid in enumerate(scene.solids):
        away = np.asarray(in_blocks(_shape_distance, solid.shape, (position,)), np.float64) if len(position) else 0.0
        distances[number] = away / scene.lattice.spacing - _TIE
    for side, kind in enumerate(scene.boundary.sides):
        if isinstance(kind, Wall):
            axis = side // 2
            nodes = shape[axis] - 1 - voxel[:, axis] if side % 2 else voxel[:, axis]
            distances[len(scene.solids) + side] = nodes + 0.5
    return np.argmin(distances, axis=0) if len(position) else np.zeros(0, int)


def _shape_distance(shape, points):
    return jnp.asarray(shape.distance(points))


def open_sides(scene: Scene) -> tuple[bool, ...]:
    """Which of the six sides are OPEN."""
    return tuple(kind is OPEN for kind in scene.boundary.sides)
