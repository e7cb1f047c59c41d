"""Triangle meshes as shapes.

A `Mesh` keeps its triangles, and a signed distance sampled on a grid of nodes (`mesh_distance`), which a quadratic B-spline c
interpolates for rays and shadows:

    d(x) = h * sum over the 27 nearest nodes of  c_ijk b(u - i) b(v - j) b(w - k),     (u, v, w) = (x - origin) / h,

with h the grid's cell; continuous with its gradient, which is given at length 1. Edges are rounded over about one cell of that
grid. Surface elements do not depend on it where the mesh is closed: they are made of the triangles themselves
(`mesh_elements`).

Public names: `Mesh`, `MeshReport`; `read_triangles`, `has_area` for this package.
"""

from __future__ import annotations

import dataclasses
import os
import warnings
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from . import checks
from .mesh_distance import SampledDistance, sample_distance
from .shapes import Bounds, Shape, clamped, greatest, safe_norm

_MARGIN = 4  # cells around the mesh
_MOST_NODES = 1 << 28
_FORMATS = (".obj", ".ply", ".stl", ".glb", ".gltf", ".off", ".3mf")


@dataclasses.dataclass(frozen=True, eq=False)
class Triangles:
    """What jit does not look into: `vertices` (V, 3), `faces` (F, 3), and what is known of them."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    report: MeshReport

    @property
    def corners(self) -> Float[np.ndarray, "F 3 3"]:
        return self.vertices[self.faces]


@dataclasses.dataclass(frozen=True)
class MeshReport:
    """What is unusual about a mesh; `str()` says it in words, `problems` lists what may spoil a solution.

    - `faces`, `area`, `volume`, `components` (closed or open pieces that share no edge).
    - `holes`: edges with one face; `forks`: with more than two. A closed solid has none.
    - `turned`: edges whose two faces disagree on what is outside. `inverted`: the mesh was inside out, and was turned.
    - `degenerate`: faces without area, left out.
    - `overlap`: share of the inside that lies in more than one part (self-intersections; they count as a union).
    - `thin`: share of the area with less than `voxel` of solid behind it; None if no `voxel` was given.
    """

    faces: int
    area: float
    volume: float
    components: int
    holes: int
    forks: int
    turned: int
    inverted: bool
    degenerate: int
    overlap: float = 0.0
    voxel: float | None = None
    thin: float | None = None

    @property
    def closed(self) -> bool:
        return self.holes == 0 and self.turned == 0

    @property
    def problems(self) -> tuple[str, ...]:
        found = []
        if self.holes:
            found.append(
                f"{self.holes} edges of holes: what is inside is decided by a vote, and holes are closed roughly; mend it"
            )
        if self.turned:
            found.append(f"{self.turned} edges whose faces disagree on what is outside: make the normals agree")
        if self.overlap > 1e-3:
            found.append(f"{100 * self.overlap:.1f} % of the inside lies in more than one part: they count as a union")
        if self.thin is not None and self.thin > 1e-2:
            found.append(
                f"{100 * self.thin:.1f} % of the area is thinner than a voxel ({self.voxel:.3g}): use more, or light leaks"
            )
        return tuple(found)

    def __str__(self) -> str:
        what = f"{self.faces} triangles in {self.components} part{'s' * (self.components != 1)}, area {self.area:.4g}"
        what += f", volume {self.volume:.4g}"
        return "\n".join([what, *(f"- {problem}" for problem in self.problems)])


class Mesh(Shape):
    """The solid inside a closed triangle mesh.

    **Arguments:**

    - `vertices`: (V, 3), in scene units. `faces`: (F, 3), indices of vertices, counter-clockwise seen from outside.
    - `resolution`: cells of the signed distance's grid along the mesh's longest side, 8 to 512. Rays and shadows see edges
      rounded by about a cell: half a voxel or less is fine.

    A mesh that is inside out as a whole is turned. Parts that overlap count as their union. For holes see `report`; they also
    raise a `UserWarning`.

    **Raises** `ValueError` for arrays of another shape, indices out of range, values that are not finite, a mesh without any
    area or without an inside; `TypeError` for what is no array of numbers.
    """

    coefficients: Float[jax.Array, "X Y Z"]
    origin: Float[checks.Numbers, " 3"]
    cell: Float[checks.Numbers, ""]
    surface: Triangles = eqx.field(static=True)

    def __init__(self, vertices: Any, faces: Any, resolution: int = 128):
        vertices, faces, degenerate = _checked(vertices, faces)
        resolution = checks.positive_int("resolution", resolution, 8)
        if resolution > 512:
            checks.fail("resolution", resolution, "8 to 512", "split the mesh into parts, each a Solid")
        report = _topology(vertices, faces, degenerate)
        if report.inverted:
            faces = faces[:, ::-1].copy()
        lower, upper = vertices.min(0), vertices.max(0)
        cell = float((upper - lower).max()) / resolution
        shape = tuple(int(n) + 1 + 2 * _MARGIN for n in np.ceil((upper - lower) / cell))
        # Nodes half a cell off the box: flat sides along the axes then fall between nodes.
        origin = (lower + upper) / 2 - (np.array(shape) - 1) / 2 * cell
        sampled = sample_distance(vertices[faces], origin, cell, (shape[0], shape[1], shape[2]), report.turned == 0)
        inside = sampled.winding > 0.5
        if not inside.any():
            advice = "a sheet has none: give it a thickness; a thinner part than resolution shows wants a larger resolution"
            checks.fail("faces", f"{len(faces)} triangles without an inside", "a closed surface", advice)
        overlap = float((sampled.winding > 1.5).sum() / inside.sum())
        report = dataclasses.replace(report, overlap=overlap)
        self.coefficients = jnp.asarray(_spline(sampled), jnp.float32)
        self.origin, self.cell = origin, np.asarray(cell)
        self.surface = Triangles(vertices, faces, report)
        if report.holes or report.turned:
            warnings.warn(f"Mesh: {'; '.join(report.problems)}", stacklevel=2)

    @classmethod
    def load(
        cls, path: str | os.PathLike[str], scale: float = 1.0, offset: Any = (0, 0, 0), up: str = "z", resolution: int = 128
    ) -> Mesh:
        """Read OBJ, PLY, STL, GLB, glTF, OFF or 3MF through trimesh (extra `mesh`); all of a file's parts become one mesh.

        Points x become scale * x + offset. `up`: the file's axis that points up, "y" or "z"; "y" is turned to z.

        **Raises** `FileNotFoundError`; `ValueError` for a file that is damaged, of another kind, or without triangles;
        `ImportError` without trimesh; and what `Mesh` raises.
        """
        vertices, faces = _read(path)
        if up not in ("y", "z"):
            checks.fail("up", repr(up), '"y" or "z"', "turn other files with .rotate")
        if up == "y":
            vertices = vertices[:, [0, 2, 1]] * [1, -1, 1]
        factor = float(checks.positive("scale", scale, ()))
        return cls(vertices * factor + np.asarray(checks.vector3("offset", offset)), faces, resolution)

    def fit(self, lower: Any, upper: Any) -> Mesh:
        """The mesh scaled, alike along all axes, to be as large as fits into a box; it stands in the middle of its floor."""
        lower, upper = np.asarray(checks.vector3("lower", lower)), np.asarray(checks.vector3("upper", upper))
        if not (lower < upper).all():
            checks.fail("fit", f"lower {lower.tolist()} and upper {upper.tolist()}", "lower < upper on every axis", "swap them")
        own_lower, own_upper = self.bounds()
        scale = float(((upper - lower) / np.maximum(own_upper - own_lower, 1e-300)).min())
        anchor = np.array([*(own_lower + own_upper)[:2] / 2, own_lower[2]])
        offset = np.array([*(lower + upper)[:2] / 2, lower[2]]) - scale * anchor
        surface = dataclasses.replace(
            self.surface,
            vertices=self.surface.vertices * scale + offset,
            report=dataclasses.replace(
                self.surface.report, area=self.surface.report.area * scale**2, volume=self.surface.report.volume * scale**3
            ),
        )
        moved = object.__new__(Mesh)
        fields = {"coefficients": self.coefficients, "origin": self.origin * scale + offset, "cell": self.cell * scale}
        for name, value in (fields | {"surface": surface}).items():
            object.__setattr__(moved, name, value)
        return moved

    @property
    def vertices(self) -> Float[np.ndarray, "V 3"]:
        return self.surface.vertices

    @property
    def faces(self) -> Int[np.ndarray, "F 3"]:
        return self.surface.faces

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points = checks.coordinates("points", points)
        origin, cell = (jnp.asarray(a, points.dtype) for a in (self.origin, self.cell))
        nodes = (points - origin) / cell
        last = jnp.asarray(self.coefficients.shape, points.dtype) - 2
        inner = clamped(nodes, 1.0, last)
        # Off the grid: the solid is at least so far from the grid's sides, and what the nearest side says less the way there.
        away = safe_norm(nodes - inner)
        at_side = _interpolate(self.coefficients, inner)
        apart = greatest((away + (_MARGIN - 1), at_side - away))
        return cell * jnp.where(away > 0, apart, at_side)

    @property
    def roughness(self) -> Any:
        """Edges are rounded, and where parts of the mesh overlap its inside is not known well: over half a cell or so."""
        return 0.6 * jnp.asarray(self.cell)

    def bounds(self) -> Bounds:
        return self.surface.vertices.min(0), self.surface.vertices.max(0)

    def report(self, voxel: float | None = None) -> MeshReport:
        """What is unusual about the mesh; given the side of a `voxel` in scene units, also how much of it is thinner."""
        report = self.surface.report
        if voxel is None:
            return report
        size = float(checks.positive("voxel", voxel, ()))
        corners = self.surface.corners
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=1)
        # Points spread over the area; a ray inwards from each must stay inside for one voxel.
        share = (np.arange(4096) + 0.5) / 4096
        face = np.searchsorted(np.cumsum(area) / area.sum(), share)
        start = corners[face].mean(1)
        steps = np.linspace(0.1, 0.95, 18) * size
        depth = start[:, None] - steps[:, None] * (normal / np.maximum(area, 1e-300)[:, None])[face][:, None]
        out = np.asarray(self.distance(jnp.asarray(depth, jnp.float32))) > 0.02 * float(self.cell)
        return dataclasses.replace(report, voxel=size, thin=float(out.any(1).mean()))


def _spline(sampled: SampledDistance) -> np.ndarray:
    from scipy.ndimage import spline_filter

    return spline_filter(sampled.distance / sampled.cell, order=2)


@jax.custom_jvp
def _interpolate(coefficients: jax.Array, nodes: jax.Array) -> jax.Array:
    return _value_and_slope(coefficients, nodes)[0]


@_interpolate.defjvp
def _(primals, tangents):
    value, slope = _value_and_slope(*primals)
    length = safe_norm(slope)[..., None]
    # Of length 1 near edges too, where the interpolated distance flattens; not where sides of the solid meet in its middle.
    unit = slope / jnp.where(length > 0.3, length, 1)
    return value, jnp.sum(unit * tangents[1], -1)


def _value_and_slope(coefficients: jax.Array, nodes: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The spline and its gradient at points in units of nodes, at least one node from the grid's sides."""
    i = jnp.round(nodes)
    t = nodes - i
    weight = jnp.stack([0.5 * (0.5 - t) ** 2, 0.75 - t**2, 0.5 * (0.5 + t) ** 2], -1)  # (..., axis, 3)
    rate = jnp.stack([t - 0.5, -2 * t, t + 0.5], -1)
    strides = np.array([coefficients.shape[1] * coefficients.shape[2], coefficients.shape[2], 1], np.int32)
    steps = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), -1).reshape(-1, 3) @ strides
    index = (i.astype(int) * strides).sum(-1)[..., None] + steps
    c = coefficients.reshape(-1)[index].astype(nodes.dtype).reshape(*nodes.shape[:-1], 3, 3, 3)
    along_z, slope_z = (jnp.sum(c * w[..., None, None, 2, :], -1) for w in (weight, rate))
    along_y = lambda a, w: jnp.sum(a * w[..., None, 1, :], -1)
    along_x = lambda a, w: jnp.sum(a * w[..., 0, :], -1)
    yz = along_y(along_z, weight)
    slope = [along_x(yz, rate), along_x(along_y(along_z, rate), weight), along_x(along_y(slope_z, weight), weight)]
    return along_x(yz, weight), jnp.stack(slope, -1)


def _checked(vertices: Any, faces: Any) -> tuple[np.ndarray, np.ndarray, int]:
    """Vertices in float64, faces with area, and how many had none."""
    vertices = checks.points("vertices", vertices)
    if not isinstance(vertices, np.ndarray):
        checks.fail("vertices", "traced values", "known numbers", "a mesh is made outside jit and grad", TypeError)
    index = np.asarray(checks.array("faces", faces))
    if index.ndim != 2 or index.shape[1] != 3 or not len(index):
        checks.fail("faces", f"an array of shape {index.shape}", "shape (F, 3), F >= 1", "cut polygons into triangles")
    if not np.issubdtype(index.dtype, np.integer):
        checks.fail("faces", f"numbers of type {index.dtype}", "whole numbers", "they are indices of vertices", TypeError)
    if index.min() < 0 or index.max() >= len(vertices):
        got = f"indices from {index.min()} to {index.max()}"
        checks.fail("faces", got, f"0 to {len(vertices) - 1}, the vertices' numbers", "count from 0; OBJ files count from 1")
    # Vertices at one place are one vertex: files such as STL repeat them.
    vertices, number = np.unique(vertices, axis=0, return_inverse=True)
    index = number.reshape(-1)[index].astype(np.int64)
    kept = index[has_area(vertices, index)]
    if not len(kept):
        checks.fail("faces", f"{len(index)} triangles without any area", "a surface", "check scale and indices")
    return vertices, kept, int(len(index) - len(kept))


def has_area(vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> Bool[np.ndarray, " F"]:
    """Which triangles a `Mesh` keeps."""
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    size = float(np.ptp(vertices, axis=0).max())
    distinct = (corners != np.roll(corners, 1, axis=1)).any(-1).all(1)
    return (np.linalg.norm(normal, axis=1) > 1e-24 * size**2) & distinct


def _topology(vertices: np.ndarray, faces: np.ndarray, degenerate: int) -> MeshReport:
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    start, end = faces.reshape(-1), np.roll(faces, -1, axis=1).reshape(-1)
    face = np.repeat(np.arange(len(faces)), 3)
    key = np.minimum(start, end) * len(vertices) + np.maximum(start, end)
    edge, number, count = np.unique(key, return_inverse=True, return_counts=True)
    number = number.reshape(-1)
    forward = np.bincount(number, start < end, len(edge))
    # Both senses equally often, or the faces at the edge do not agree.
    turned = int(((count % 2 == 0) & (2 * forward != count)).sum())
    joined = coo_array((np.ones(len(face)), (face, len(faces) + number)), shape=(len(faces) + len(edge),) * 2)
    parts = connected_components(joined, directed=False, return_labels=False)
    corners = vertices[faces] - vertices.mean(0)
    volume = float(np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6)
    area = float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2)
    return MeshReport(
        faces=len(faces), area=area, volume=abs(volume), components=int(parts), holes=int((count % 2 == 1).sum()),
        forks=int((count > 2).sum()), turned=turned, inverted=volume < 0 and turned == 0, degenerate=degenerate,
    )  # fmt: skip


def _read(path: str | os.PathLike[str]) -> tuple[np.ndarray, np.ndarray]:
    loaded = read_triangles(path)
    return np.asarray(loaded.vertices, float), np.asarray(loaded.faces)


def read_triangles(path: str | os.PathLike[str]) -> Any:
    """A file as a `trimesh.Trimesh`. **Raises** as `Mesh.load` does."""
    path = Path(path)
    if not path.is_file():
        checks.fail("path", repr(str(path)), "a file that exists", "check its spelling", FileNotFoundError)
    if path.suffix.lower() not in _FORMATS:
        checks.fail("path", repr(str(path)), f"a name ending in {', '.join(_FORMATS)}", "convert it to PLY or OBJ first")
    try:
        import trimesh
    except ImportError as error:
        raise ImportError("Mesh.load needs trimesh; pip install 'raymanifold-jax[mesh]'") from error
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
        faces = np.asarray(loaded.faces)  # pyright: ignore[reportAttributeAccessIssue]
    except Exception as error:  # each of its readers fails in its own ways
        raise ValueError(
            f"path: got {str(path)!r}, which cannot be read ({type(error).__name__}: {error}), expected a whole "
            f"{path.suffix[1:].upper()} file with triangles; export it again"
        ) from error
    if not len(faces):
        checks.fail("path", f"{str(path)!r} without triangles", "a surface", "point clouds have none: make a mesh of it first")
    return loaded
