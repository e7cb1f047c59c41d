"""The faces that surfaces have in voxels: which there are, their planes, and their areas.

A surface that is smooth in a voxel has one face there: the plane through the middle of its patch. Past a crease there is one
for each side of it. In voxels, from the voxel's centre c, a face is the plane n . (x - c) + offset = 0. Samples of the voxel,
moved to the surface by x <- x - f(x) grad f(x), tell how many normals it has, where its corners leave that open; points on the
planes tell how much of them is surface.

Distances and slopes are what takes time. They are evaluated many points at once, of the points that count, by one program each.

Public for this package: `DistanceField`, `find_faces`, `patch_points`, `NEAR`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from .arrays import on_accelerator
from .chunks import of_first_chunks, padded
from .lattice import Lattice
from .programs import program
from .shapes import Shape, dot, greatest, least
from .threads import count_cores, on_threads

#: Voxels: centres this near to a surface may have it in their voxel.
NEAR = 0.5 * np.sqrt(3) + 0.1
#: Cosine between the normals of neighbouring points of one face: a sharper edge parts two faces, each an element of its own.
_SAME_FACE = 0.9
_FACES = 6  # faces told apart in a voxel, at most
#: Points this far behind a face (voxels) decide which voxel owns it: the one on the solid side.
_INWARD = 1e-3
_PATCH = 8  # samples a side on an element's plane
_AT_SURFACE = 0.02  # voxels: points that were moved to the surface are on it
_NEARLY_FLAT = 0.1  # voxels: how far a plane's distance may be off at the corners of a voxel without creases
_CURVED = 1e-6  # voxels: surfaces further from their planes than this
_SLIVER = 0.1  # voxel faces: patches smaller than this
_POINTS = 1 << 16  # evaluated by one call: one size, for one compilation
_CHUNK = 1 << 10  # at once: their arrays fit a core's cache
_VOXELS = _POINTS // 64  # voxels with as many samples
_PLANES = 960  # planes with a few less in their voxels: on average each has 64
_STEPS = np.linspace(-0.9, 0.9, 37)  # voxels: where a face is looked for along its normal


class DistanceField:
    """The signed distance of some shapes in voxels, and its gradient, at points in scene units."""

    def __init__(self, lattice: Lattice, shapes: Sequence[Shape]):
        self.lattice, self.spacing = lattice, np.float64(lattice.spacing)  # to programs, one of their numbers
        self._shapes = tuple(shapes)

    def distance(self, points: np.ndarray) -> np.ndarray:
        return self._batched(_least, points) / self.spacing

    def gradient(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        value, slope = self._batched(_slope, points)
        return value / self.spacing, slope

    def nearest(self, points: np.ndarray) -> np.ndarray:
        return self._batched(_nearest, points)

    def raw_distance(self, points: Float[Array, "n 3"], used: int) -> Float[Array, " n"]:
        """Of the first so many of `_POINTS` points, in scene units."""
        return _least(self._shapes, points, _chunks(used))

    def raw_gradient(self, points: Float[Array, "n 3"], used: int) -> tuple[Float[Array, " n"], Float[Array, "n 3"]]:
        """Of the first so many of `_POINTS` points, with the distance in scene units."""
        return _slope(self._shapes, points, _chunks(used))

    def _batched(self, function: Callable, points: np.ndarray) -> Any:
        shape = points.shape[:-1]
        flat = points.reshape(-1, 3)
        # Each core its part, of whole chunks.
        part = _POINTS if on_accelerator() else min(_POINTS, _CHUNK * max(1, -(-len(flat) // (_CHUNK * count_cores()))))

        def read(rows: np.ndarray) -> Any:
            found = function(self._shapes, padded(rows, _POINTS), _chunks(len(rows)))
            return jax.tree.map(lambda a: np.asarray(a)[: len(rows)], found)

        blocks = [flat[i : i + part] for i in range(0, max(len(flat), 1), part)]
        parts = on_threads(_readers(), read, blocks) if len(blocks) > 1 else [read(flat)]
        return jax.tree.map(lambda *a: np.concatenate(a).reshape(*shape, *a[0].shape[1:]), *parts)


def _chunks(used: int) -> np.ndarray:
    return np.array(-(-used // _CHUNK), np.int32)


def _in_blocks(function: Callable, rows: tuple[np.ndarray, ...], size: int) -> list[Any]:
    """function(*block) for blocks of rows, some at once: the host works on one while a program runs for another."""
    blocks = [tuple(a[i : i + size] for a in rows) for i in range(0, max(len(rows[0]), 1), size)]
    if len(blocks) < 2:
        return [function(*block) for block in blocks]
    # The first one alone, for its programs to be compiled once.
    return [function(*blocks[0]), *on_threads(_workers(), function, *zip(*blocks[1:], strict=True))]


@functools.cache
def _workers() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(2, "surfaces")


@functools.cache
def _readers() -> ThreadPoolExecutor:
    """For what workers wait for."""
    return ThreadPoolExecutor(count_cores(), "distances")


# Programs that scenes of like shapes share.


@program
def _least(shapes: tuple, points: Array, chunks: Array) -> Array:
    return _of_chunks(lambda points: least(tuple(shape.distance(points) for shape in shapes)), points, chunks)


@program
def _slope(shapes: tuple, points: Array, chunks: Array) -> tuple[Array, Array]:
    return _of_chunks(functools.partial(_slope_of_all, shapes), points, chunks)


@program
def _nearest(shapes: tuple, points: Array, chunks: Array) -> Array:
    return _of_chunks(lambda points: jnp.argmin(jnp.stack([s.distance(points) for s in shapes]), 0), points, chunks)


def _of_chunks(function: Callable, points: Array, chunks: Array) -> Any:
    """function(points) of the first so many chunks; each of what a core's nearest cache holds."""
    return function(points) if on_accelerator() else of_first_chunks(function, (points,), _CHUNK, chunks)


def _slope_of_all(shapes: tuple, points: Array) -> tuple[Array, Array]:
    # One by one, so that XLA does not work each out anew wherever their least is asked for.
    parts = [lax.optimization_barrier(_slope_of(shape, points)) for shape in shapes]
    values = tuple(value for value, _ in parts)
    along = [jax.jvp(least, (values,), (tuple(rates[axis] for _, rates in parts),))[1] for axis in range(3)]
    return least(values), jnp.stack(along, -1)


def _slope_of(shape: Shape, points: Array) -> tuple[Array, list[Array]]:
    # Forwards along each coordinate: quicker here than backwards.
    axes = [jnp.broadcast_to(np.eye(3, dtype=points.dtype)[axis], points.shape) for axis in range(3)]
    found = [jax.jvp(shape.distance, (points,), (axis,)) for axis in axes]
    return found[0][0], [rate for _, rate in found]


def find_faces(field: DistanceField, voxels: Int[np.ndarray, "V 3"]) -> dict[str, np.ndarray]:
    """Rows `voxel`, `normal`, `offset`, `area` (voxels squared), `centroid` (voxels, from the voxel's centre) of faces."""
    spacing = field.spacing
    center = field.lattice.lower + (voxels + 0.5) * spacing
    # Where the surface is smooth the distance at the centre gives the plane itself.
    own_distance, own_normal = field.gradient(center)
    foot = center - (own_distance * spacing)[:, None] * own_normal
    smooth = (np.linalg.norm(own_normal, axis=1) > 1 - 1e-3) & _slopes(field, foot, own_normal)[1]
    normals, has_face = np.zeros((len(center), _FACES, 3)), np.zeros((len(center), _FACES), bool)
    plain = smooth.copy()
    plain[smooth] = _are_plain(field, center[smooth], own_distance[smooth], own_normal[smooth])
    normals[~plain], has_face[~plain] = _distinct_normals(field, center[~plain])
    smooth &= has_face.sum(1) <= 1
    # A plane that passes its voxel by has no patch to be moved to.
    has_face[smooth, 0] = (np.abs(own_distance) < 0.5 * np.abs(own_normal).sum(1) + 1e-5)[smooth]
    normals[smooth, 0] = own_normal[smooth]
    rows, which = np.nonzero(has_face)
    normal, creased = normals[rows, which], ~smooth[rows]
    offset = own_distance[rows]
    offset[creased] = _plane_offset(field, center[rows[creased]], normal[creased])
    met = np.isfinite(offset)
    planes = center[rows[met]], normal[met], offset[met], creased[met]
    parts = _in_blocks(lambda *block: _patches(field, *block), planes, _PLANES)
    found = {"voxel": voxels[rows[met]]} | {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    keep = found.pop("keep")
    return {key: value[keep] for key, value in found.items()}


def _are_plain(field: DistanceField, center: np.ndarray, distance: np.ndarray, normal: np.ndarray) -> Bool[np.ndarray, " V"]:
    """Whether at a voxel's corners the distance has nearly the slope of the plane at its centre, and its values: no crease is
    near."""
    corner = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3, indexing="ij"), -1).reshape(-1, 3)
    there, slope = field.gradient(center[:, None] + corner * field.spacing)
    alike = np.einsum("vci,vi->vc", slope, normal) > _SAME_FACE
    unit = np.abs(np.linalg.norm(slope, axis=-1) - 1) < 1e-3
    near = np.abs(there - distance[:, None] - normal @ corner.T) < _NEARLY_FLAT
    return (alike & unit & near).all(1)


def _distinct_normals(field: DistanceField, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distinct surface normals in each voxel: (V, faces, 3) and which of them exist (V, faces)."""
    spacing, index = field.spacing, np.arange(len(center))

    def near_samples(block: np.ndarray, index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        centers, used = padded(block, _VOXELS), 64 * len(block)
        points = slope = _samples(centers, spacing)
        for _ in range(2):  # project the samples on the surface
            value, slope = field.raw_gradient(points, used)
            points = _projected(points, value, slope)
        near = _is_near(centers, points, field.raw_distance(points, used), spacing)
        (chosen,) = np.nonzero(np.asarray(near)[: 64 * len(block)])
        return 64 * index[chosen // 64] + chosen % 64, np.asarray(points)[chosen], np.asarray(slope)[chosen]

    parts = _in_blocks(near_samples, (center, index), _VOXELS)
    number, points, outward = (np.concatenate(part) for part in zip(*parts, strict=True))
    slope, clear = _slopes(field, points, outward)
    behind = (points - center[number // 64]) / spacing - _INWARD * slope
    valid = clear & (np.abs(behind).max(-1) <= 0.5)
    number, slope = number[valid], slope[valid]
    return _group(number // 64, number % 64, slope, len(center))


def _group(voxel: np.ndarray, sample: np.ndarray, slope: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The normals of the faces that samples of `count` voxels lie on, and which exist."""
    total = np.stack([np.bincount(voxel, slope[:, axis], count) for axis in range(3)], -1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    mean = total / np.maximum(length, 1e-12)
    normals, has_face = np.zeros((count, _FACES, 3)), np.zeros((count, _FACES), bool)
    normals[:, 0], has_face[:, 0] = mean, length[:, 0] > 1e-6
    unlike = np.einsum("pi,pi->p", slope, mean[voxel]) < _SAME_FACE
    creased = np.unique(voxel[unlike])
    for rows in np.array_split(creased, max(1, -(-len(creased) // 4096))):
        own = np.isin(voxel, rows)
        at = np.searchsorted(rows, voxel[own]), sample[own]
        valid, slopes = np.zeros((len(rows), 64), bool), np.zeros((len(rows), 64, 3))
        valid[at], slopes[at] = True, slope[own]
        member = _label_faces(valid, slopes)[:, None] == np.arange(_FACES)[:, None]
        total = np.einsum("mfs,msi->mfi", member.astype(float), slopes)
        length = np.linalg.norm(total, axis=2)
        normals[rows] = total / np.maximum(length, 1e-12)[..., None]
        has_face[rows] = member.any(2) & (length > 1e-6)
    return normals, has_face


@program
def _samples(center: Array, spacing: float) -> Array:
    """Of each voxel, 4 x 4 x 4 points."""
    side = (np.arange(4) + 0.5) / 4 - 0.5
    samples = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    return (center[:, None] + samples * spacing).reshape(-1, 3)


@program
def _projected(points: Array, value: Array, slope: Array) -> Array:
    return points - value[:, None] * slope


@program
def _is_near(center: Array, points: Array, value: Array, spacing: float) -> Array:
    """Whether projected samples are on the surface, and in their voxels or nearly so."""
    apart = jnp.abs(points.reshape(len(center), -1, 3) - center[:, None]) / spacing
    # A face is owned by a point that is inwards of it.
    return (greatest(tuple(apart[..., axis] for axis in range(3))) <= 0.5 + 1.1 * _INWARD).ravel() & (
        jnp.abs(value / spacing) < _AT_SURFACE
    )


def _slopes(field: DistanceField, points: np.ndarray, outward: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distance's slope just outside the surface at some points on it, and whether it is a face's.

    On an edge it is not: the two sides of the surface disagree there.
    """
    step = 1e-4 * field.spacing * outward
    slope, below = (field.gradient(points + s)[1] for s in (step, -step))
    unit = np.abs(np.linalg.norm(slope, axis=-1) - 1) < 1e-3
    return slope, unit & (np.einsum("pi,pi->p", slope, below) > 0.999)


def _label_faces(valid: np.ndarray, slope: np.ndarray) -> np.ndarray:
    """Which face each sample of a voxel lies on, 0.. (M, S); -1: none, or past the last face told apart.

    Samples are on one face if steps between similar normals join them: a curved face stays one, whichever way it is turned.
    """
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


def _plane_offset(field: DistanceField, center: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Signed distance of a voxel's centre from the face with this normal: march along the normal to the surface.

    NaN where that face is not met within the voxel's reach.
    """
    offset, parts = np.full(len(center), np.nan), []
    size = _POINTS // (64 * len(_STEPS))
    for i in range(0, len(center), size):
        rows = center[i : i + size], normal[i : i + size]
        points = _along_normals(*(padded(a, size) for a in rows), field.spacing)
        used = len(rows[0]) * 64 * len(_STEPS)
        value = np.asarray(field.raw_distance(points, used)) / field.spacing
        (chosen,) = np.nonzero(np.abs(value[:used]) < 0.2)
        parts.append((chosen + i * 64 * len(_STEPS), np.asarray(points)[chosen], value[chosen]))
    if not parts:
        return offset
    number, points, value = (np.concatenate(part) for part in zip(*parts, strict=True))
    row = number // (64 * len(_STEPS))
    aligned = np.einsum("pi,pi->p", field.gradient(points)[1], normal[row]) > 0.999
    row, estimate = row[aligned], (_STEPS[number % len(_STEPS)] - value)[aligned]
    # Medians of each row's.
    estimate = estimate[np.lexsort((estimate, row))]
    count = np.bincount(row, minlength=len(center))
    met = count > 0
    first, count = (np.cumsum(count) - count)[met], count[met]
    offset[met] = -(estimate[first + (count - 1) // 2] + estimate[first + count // 2]) / 2
    return offset


@program
def _along_normals(center: Array, normal: Array, spacing: float) -> Array:
    """Points on lines along the normals through several points of each voxel: some meet a face that is off-centre."""
    side = np.array([-0.375, -0.125, 0.125, 0.375])
    starts = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    starts = starts - jnp.einsum("si,mi->ms", starts, normal)[..., None] * normal[:, None]
    points = center[:, None, None] + (starts[:, :, None] + _STEPS[:, None] * normal[:, None, None]) * spacing
    points = points.reshape(-1, 3)
    return jnp.concatenate([points, jnp.broadcast_to(points[-1], (_POINTS - len(points), 3))])


def _patches(
    field: DistanceField, center: np.ndarray, normal: np.ndarray, offset: np.ndarray, creased: np.ndarray
) -> dict[str, np.ndarray]:
    """What there is of the faces on at most `_PLANES` planes: moved to the middle of their patches where not `creased`."""
    spacing, count = field.spacing, len(center)
    here = lambda a: np.asarray(a)[:count]
    centers, normals, offsets, creases = (padded(a, _PLANES) for a in (center, normal, offset, creased))
    # Planes through the middle of their patch: the tangent at the point nearest the centre would stand proud of a ball.
    points, patch, weight = _on_planes(centers, normals, offsets, spacing)
    read = _Readings(field, points)
    read.add(np.asarray(weight) > 0)
    off = np.abs(read.value).max(1) > _CURVED
    normals, offsets = _refitted(normals, offsets, creases, patch, weight, read.value, read.slope)
    points, patch, weight = _on_planes(centers, normals, offsets, spacing)
    counts = np.asarray(weight) > 0
    read = _Readings(field, points)
    read.add(counts | off[:, None])  # the rest of their points will be wanted too, most likely
    covered, whole, middle, curved = map(here, _measured(normals, creases, patch, weight, read.value, read.slope))
    normal, offset = here(normals), here(offsets)
    area = plane_area_in_voxel(normal, offset)
    # Corners that a smooth surface cuts off may be too small for the grid of points.
    sliver, corner = ~creased & (whole < _SLIVER), np.zeros((count, 3))
    corner[sliver] = _nearest_in_voxel(normal[sliver], offset[sliver])
    sliver[sliver] = _on_face(field, center[sliver] + corner[sliver] * spacing, normal[sliver])
    covered, whole = (np.where(sliver, area, x) for x in (covered, whole))
    area = area * covered / np.maximum(whole, 1e-9)
    curved = curved & ~sliver
    if curved.any():
        wanted = np.zeros(counts.shape, bool)
        wanted[:count][curved] = True
        if (missing := wanted & ~counts & ~off[:, None]).any():
            read.add(missing)
        points, patch = _moved(centers, patch, read.value, read.slope, spacing)
        read = _Readings(field, points)
        read.add(wanted | (curved.mean() > 0.8))
        area = np.where(curved, here(_curved_area(normals, patch, read.value, read.slope)), area)
    half_width = 0.5 * np.abs(normal).sum(1)
    owned = (offset < half_width - 1e-6) & (offset >= -half_width - 1e-6)
    keep = owned & (covered > np.where(sliver, 0.0, 0.02)) & (area > 1e-3)
    centroid = np.where(sliver[:, None], corner, middle)
    return {"normal": normal, "offset": offset, "area": area, "centroid": centroid, "keep": keep}


def patch_points(normal: Any, offset: Any, count: int = _PATCH, xp: Any = np) -> tuple[Any, Any]:
    """Points on each plane, (M, 3 n^2, 3) from the voxel's centre, and the area each stands for: 0 outside the voxel.

    There is one grid along each axis; their shares n_x^2 + n_y^2 + n_z^2 = 1 treat all axes alike. `xp`: numpy, or JAX's.
    """
    grid = (np.arange(count) + 0.5) / count - 0.5
    a, b = (g.ravel() for g in np.meshgrid(grid, grid, indexing="ij"))
    points, weights = [], []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        along = normal[:, axis, None]
        slope = xp.where(along >= 0, 1, -1) * xp.maximum(xp.abs(along), 1e-6)
        height = xp.nan_to_num(-(offset[:, None] + normal[:, u, None] * a + normal[:, v, None] * b) / slope, nan=9.0)
        place = {u: xp.broadcast_to(a, height.shape), v: xp.broadcast_to(b, height.shape), axis: xp.clip(height, -9, 9)}
        points.append(xp.stack([place[i] for i in range(3)], -1))
        weights.append((xp.abs(height) <= 0.5 + 1e-6) * xp.where(xp.abs(along) > 1e-3, xp.abs(along), 0.0) / count**2)
    return xp.concatenate(points, 1), xp.concatenate(weights, 1)


class _Readings:
    """The signed distance and its slope at points (M, S, 3), as far as they were asked for."""

    def __init__(self, field: DistanceField, points: Array):
        self._field, self._points = field, np.asarray(points)
        self.value, self.slope = np.zeros(points.shape[:-1]), np.zeros(points.shape)

    def add(self, chosen: Bool[np.ndarray, "M S"]) -> None:
        """Read these points."""
        if chosen.all():
            self.value, self.slope = self._field.gradient(self._points)
            return
        where = np.flatnonzero(chosen)
        found = self._field.gradient(np.take(self._points.reshape(-1, 3), where, axis=0))
        self.value.reshape(-1)[where], self.slope.reshape(-1, 3)[where] = found


# Steps of `_patches`, which have the points of each plane's patch in a row.


@program
def _on_planes(center: Array, normal: Array, offset: Array, spacing: float) -> tuple[Array, Array, Array]:
    patch, weight = patch_points(normal, offset, xp=jnp)
    return center[:, None] + patch * spacing, patch, weight


@program
def _refitted(normal, offset, creased, patch: Array, weight: Array, value: Array, slope: Array):
    """Planes moved so that over their patches in the voxel the signed distance averages 0 and its slope is theirs."""
    value = jnp.where(weight > 0, value, 0.0)
    weight = weight * (dot(slope, normal[:, None]) > 0.7)  # not past an edge
    area = weight.sum(1)
    share = weight / jnp.maximum(area, 1e-9)[:, None]
    mean_value, mean_slope, middle = (value * share).sum(1), _mean(slope, share), _mean(patch, share)
    length = jnp.sqrt(dot(mean_slope, mean_slope))
    usable = ~creased & (area > 0) & (length > 0.9) & (jnp.abs(mean_value) < 0.3)
    refitted = mean_slope / jnp.maximum(length, 1e-12)[:, None]
    through = mean_value - dot(refitted, middle)
    return jnp.where(usable[:, None], refitted, normal), jnp.where(usable, through, offset)


@program
def _measured(normal, creased, patch: Array, weight: Array, value: Array, slope: Array) -> tuple[Array, ...]:
    """How much of the planes in the voxel is surface, and is there of them; its middle; and whether the surface is curved."""
    error = jnp.where(weight > 0, value, 0.0)
    # The plane is the face as far as the distance's slope is its normal: past an edge it is not.
    there = (jnp.abs(error) < jnp.where(creased, 0.1, 0.5)[:, None]) & (dot(slope, normal[:, None]) > 0.7)
    real = weight * there
    covered = real.sum(1)
    curved = (jnp.abs(error) * real).max(1) > _CURVED
    return covered, weight.sum(1), _mean(patch, real) / jnp.maximum(covered, 1e-9)[:, None], curved


def _mean(vectors: Array, share: Array) -> Array:
    return jnp.stack([(vectors[..., axis] * share).sum(1) for axis in range(3)], -1)


@program
def _moved(center, patch: Array, value: Array, slope: Array, spacing: float) -> tuple[Array, Array]:
    """Points on planes moved to the surface along their grid's axis."""
    grid = _grid_axes(patch)
    along = dot(slope, grid)
    move = value / (jnp.where(along >= 0, 1, -1) * jnp.maximum(jnp.abs(along), 1e-6))
    patch = patch - jnp.clip(move, -0.5, 0.5)[..., None] * grid
    return center[:, None] + patch * spacing, patch


def _grid_axes(patch: Array) -> np.ndarray:
    """The axis that each point's grid looks along."""
    return np.repeat(np.eye(3), patch.shape[1] // 3, axis=0)


@program
def _curved_area(normal, patch: Array, value: Array, slope: Array) -> Array:
    """The area of curved surfaces in their voxels, from points on planes near them that were `_moved` to them.

    They stand for the area that the surface's slope there gives them. The planes alone would lack 0.3 % of the area of a ball 7
    voxels in radius, and 3 % of a torus whose tube is 3 voxels thick.
    """
    grid, count = _grid_axes(patch), patch.shape[1] // 3
    size = jnp.abs(dot(slope, grid))
    # The part of a point's cell, over which the surface rises as it slopes there, that is in the voxel.
    rise = (dot(jnp.abs(slope), np.ones(3)) - size) / jnp.maximum(size, 1e-6) / np.sqrt(count)
    below = 0.5 - jnp.abs(dot(patch, grid))
    inside = jnp.clip(0.5 + (below + 1e-6) / jnp.maximum(rise, 1e-6), 0.0, 1.0)
    same = (jnp.abs(value) < _AT_SURFACE) & (dot(slope, normal[:, None]) > 0.7)
    return jnp.where(same, inside * size, 0.0).sum(1) / count


def _nearest_in_voxel(normal: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """The point of each plane in its voxel that is nearest to the centre, (M, 3) from there; a corner if there is none."""
    # It lies back along the normal, as far as the voxel's faces let each coordinate go.
    point = lambda back: np.clip(-back[:, None] * normal, -0.5, 0.5)
    low, high = np.full(len(normal), -1e4), np.full(len(normal), 1e4)
    for _ in range(50):
        back = (low + high) / 2
        ahead = np.einsum("mi,mi->m", normal, point(back)) > -offset
        low, high = np.where(ahead, back, low), np.where(ahead, high, back)
    return point(high)


def _on_face(field: DistanceField, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Whether points are on, or nearly on, a face with this normal."""
    distance, slope = field.gradient(points)
    return (np.abs(distance) < 0.1) & (np.einsum("mi,mi->m", slope, normal) > 0.9)


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
