"""Signed distance of a triangle mesh on a regular grid of nodes, made once on the host.

Near the surface the distance to the nearest triangle is exact; further off it is the distance to a triangle that is nearly
the nearest, less half a cell. The sign comes from a winding number counted along the six axes' rays from each node: a ray adds
1 where it comes out of the solid and takes 1 off where it goes in, so that for a closed mesh all six agree (overlapping parts
count twice), and where a mesh has holes the mean of the six decides. Meshes whose faces do not agree on what is outside fall
back on parity (in or out after an even or odd number of crossings), three axes voting.

Public for this package: `SampledDistance`, `sample_distance`, `triangle_distance`.
"""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

_BAND = 3.0  # cells: nearer to a triangle the distance is exact
_NEAR = 0.9  # cells: every point of the surface has a node this near (half a cell's diagonal is 0.87)
_LONGEST = 8.0  # cells: triangles with longer edges are cut
_PAIRS = 1 << 20  # point-triangle pairs at once
_JITTER = (3.1e-6, 7.3e-6)  # cells: columns miss vertices and edges by this


@dataclasses.dataclass(frozen=True)
class SampledDistance:
    """`distance` (X, Y, Z) at `origin` + `cell` * (i, j, k), negative inside; and the mean `winding` number there."""

    origin: Float[np.ndarray, " 3"]
    cell: float
    distance: Float[np.ndarray, "X Y Z"]
    winding: Float[np.ndarray, "X Y Z"]


def sample_distance(
    triangles: Float[np.ndarray, "F 3 3"],
    origin: Float[np.ndarray, " 3"],
    cell: float,
    shape: tuple[int, int, int],
    oriented: bool,
) -> SampledDistance:
    """The signed distance of `triangles` (their corners) on a grid of nodes; `oriented`: normals agree and point outwards."""
    corners = (triangles - origin) / cell
    winding = _winding(corners, shape, oriented)
    small = _cut_long(corners)
    distance = _unsigned(small, shape)
    distance = np.where(winding > 0.5, -distance, distance)
    return SampledDistance(origin, cell, distance * cell, winding)


@jax.jit
def triangle_distance(points: Float[Array, "3 n"], corners: Float[Array, "3 3 n"]) -> Float[Array, " n"]:
    """Distance of each point to its own triangle: to the face where the point is above it, else to the nearest edge.

    Axes of `corners`: corner, coordinate, triangle.
    """
    a, b, c = corners
    dot = lambda x, y: x[0] * y[0] + x[1] * y[1] + x[2] * y[2]
    cross = lambda x, y: (x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0])
    normal = cross(b - a, c - a)
    double = dot(normal, normal)
    nearest = jnp.full(points.shape[1:], jnp.inf, points.dtype)
    above = double > 0
    for start, end in ((a, b), (b, c), (c, a)):
        along, arm = end - start, points - start
        share = jnp.clip(dot(arm, along) / jnp.maximum(dot(along, along), 1e-30), 0.0, 1.0)
        off = arm - share * along
        nearest = jnp.minimum(nearest, dot(off, off))
        above = above & (dot(cross(along, arm), normal) >= 0)
    height = dot(points - a, normal) ** 2 / jnp.maximum(double, 1e-30)
    return jnp.sqrt(jnp.where(above, jnp.minimum(height, nearest), nearest))


def _distances(points: Int[np.ndarray, "3 n"], corners: Float[np.ndarray, "3 3 F"], row: Int[np.ndarray, " n"]) -> np.ndarray:
    """`triangle_distance` to the triangles of `row`, in blocks of one size so that it compiles once."""
    size = _PAIRS if len(row) > _PAIRS // 16 else _PAIRS // 16
    out = np.empty(len(row), np.float32)
    for i in range(0, len(row), size):
        block = slice(i, min(i + size, len(row)))
        p, t = np.zeros((3, size), np.float32), np.zeros((3, 3, size), np.float32)
        p[:, : block.stop - i], t[..., : block.stop - i] = points[:, block], corners[..., row[block]]
        out[block] = np.asarray(triangle_distance(jnp.asarray(p), jnp.asarray(t)))[: block.stop - i]
    return out


def _cut_long(corners: np.ndarray) -> np.ndarray:
    """Triangles halved across their longest edge until none is longer than `_LONGEST`: the same surface."""
    done = []
    while len(corners):
        edges = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
        keep = edges.max(1) <= _LONGEST
        done.append(corners[keep])
        corners, longest = corners[~keep], edges[~keep].argmax(1)
        if not len(corners):
            break
        order = (longest[:, None] + np.arange(3)) % 3
        a, b, c = np.moveaxis(np.take_along_axis(corners, order[..., None], 1), 1, 0)
        middle = (a + b) / 2
        corners = np.concatenate([np.stack([a, middle, c], 1), np.stack([middle, b, c], 1)])
    return np.concatenate(done) if done else np.zeros((0, 3, 3))


def _boxes(low: np.ndarray, high: np.ndarray):
    """Blocks of (row, index) for all integer points of boxes low..high (n, d), both included."""
    size = np.maximum(high - low + 1, 0)
    count = size.prod(1)
    start = 0
    ends = np.cumsum(count)
    while start < len(low):
        stop = max(start + 1, int(np.searchsorted(ends, (ends[start - 1] if start else 0) + _PAIRS, "right")))
        row = np.repeat(np.arange(start, stop), count[start:stop])
        rank = np.arange(len(row)) - np.repeat(
            ends[start:stop] - count[start:stop] - (ends[start - 1] if start else 0), count[start:stop]
        )
        index = np.empty((len(row), low.shape[1]), int)
        for axis in reversed(range(low.shape[1])):
            rank, index[:, axis] = np.divmod(rank, size[row, axis])
        yield row, index + low[row]
        start = stop


def _unsigned(corners: np.ndarray, shape: tuple[int, int, int]) -> Float[np.ndarray, "X Y Z"]:
    """Distance in cells at all nodes."""
    from scipy.ndimage import distance_transform_edt

    limit = np.array(shape) - 1
    low = np.clip(np.ceil(corners.min(1) - _BAND).astype(int), 0, limit)
    high = np.clip(np.floor(corners.max(1) + _BAND).astype(int), 0, limit)
    by_axis = np.ascontiguousarray(np.moveaxis(corners, 0, -1), np.float32)
    best = np.full(int(np.prod(shape)), np.inf, np.float32)
    owner = np.full(best.shape, -1)
    for row, node in _boxes(low, high):
        distance = _distances(node.T, by_axis, row)
        close = distance < _BAND
        flat = np.asarray(np.ravel_multi_index(tuple(node[close].T), shape))
        distance, row = distance[close], row[close]
        np.minimum.at(best, flat, distance)
        nearest = distance == best[flat]
        owner[flat[nearest]] = row[nearest]
    # Far nodes take the triangle of the node by the surface that is nearest to them.
    near = (best <= _NEAR).reshape(shape)
    found = distance_transform_edt(~near, return_distances=False, return_indices=True)
    assert isinstance(found, np.ndarray)
    far = np.nonzero(~np.isfinite(best))[0]
    there = np.asarray(np.ravel_multi_index(tuple(axis.ravel()[far] for axis in found), shape))
    nodes = np.stack(np.unravel_index(far, shape))
    best[far] = np.maximum(_distances(nodes, by_axis, owner[there]) - 0.5, _BAND)
    return best.reshape(shape).astype(float)


def _winding(corners: np.ndarray, shape: tuple[int, int, int], oriented: bool) -> Float[np.ndarray, "X Y Z"]:
    """The mean winding number over the rays along the axes; by parity, the share of axes that say inside."""
    total = np.zeros(shape)
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        below, through = _crossings(corners[..., [axis, u, v]], (shape[axis], shape[u], shape[v]), oriented)
        # The mean of a ray upwards from the node and one downwards, which differ where a column goes through a hole.
        inside = below + 0.5 * through[None] if oriented else (below % 2).astype(float)
        total += np.moveaxis(inside, (0, 1, 2), (axis, u, v)) / 3
    return total


def _crossings(corners: np.ndarray, shape: tuple[int, int, int], oriented: bool) -> tuple[Int[np.ndarray, "X Y Z"], np.ndarray]:
    """Signed faces below each node along the first axis (in counts 1, out -1), and minus their sum over each column."""
    limit = np.array(shape[1:]) - 1
    flat_corners = corners[..., 1:] - np.array(_JITTER)
    a, b, c = (flat_corners[:, i] for i in range(3))
    cross = lambda x, y: x[..., 0] * y[..., 1] - x[..., 1] * y[..., 0]
    area = cross(b - a, c - a)
    low = np.clip(np.ceil(flat_corners.min(1)).astype(int), 0, limit + 1)
    high = np.clip(np.floor(flat_corners.max(1)).astype(int), -1, limit)
    counts = np.zeros((shape[0] + 1, shape[1] * shape[2]), np.int32)
    for row, column in _boxes(low, high):
        # Shares of the corners at the column: all of one sign inside the triangle.
        p, whole = column.astype(float), area[row]
        shares = np.stack(
            [cross(c[row] - b[row], p - b[row]), cross(a[row] - c[row], p - c[row]), cross(b[row] - a[row], p - a[row])]
        )
        inside = ((shares > 0).all(0) | (shares < 0).all(0)) & (whole != 0)
        row, column, shares, whole = row[inside], column[inside], shares[:, inside], whole[inside]
        height = (shares.T * corners[row, :, 0]).sum(1) / whole
        index = np.clip(np.ceil(height).astype(int), 0, shape[0])
        np.add.at(counts, (index, column[:, 0] * shape[2] + column[:, 1]), np.where(whole > 0, -1, 1) if oriented else 1)
    below = np.cumsum(counts, 0)
    return below[:-1].reshape(shape), -below[-1].reshape(shape[1:])
