"""Sets of directions with weights, to integrate over the sphere.

Sum over m of weights[m] f(directions[m]) stands for the integral of f(w) over all directions w. The sets made here
satisfy, to rounding,

    sum a = 4 pi,    sum a w = 0,    sum a w w' = (4 pi / 3) I        (a a weight, w its direction),

so that uniform and linear fields have their exact fluence, flux and pressure. Where the plain weights miss this they
are changed as little as possible, in the sense of least squares of the relative change.

Each direction also has an `offsets` entry, the fractional position in its voxel at which its lattice of rays starts:
the first component belongs to the larger of the two slopes. By default they follow Roberts' R2 sequence, frac(1/2 + i
(1/r, 1/r^2)) with r^3 = r + 1 and i = 1, 2, ..., which keeps rays off edges and corners.

Which to take (`for_scene` does): at equal numbers `fibonacci` and `cube` do about as well as each other in rooms and in fog,
`product` a little worse. Next to mirrors `cube` is several times better, because the part of it on one side of them is as
regular as the whole: Kobayashi's cube in a cube (three mirrors; flux at 20 points, 20 voxels, against 12800 directions) is
off by rms 0.8 % with cube(6) and 0.2 % with cube(8), by 3.8 % and 2.0 % with fibonacci(200) and (400), by 2.5 % and 1.2 %
with product(10, 20) and (14, 28).

Public names: `Quadrature`, `fibonacci`, `cube`, `light_ray_cube`, `cube_points`, `product`, `for_scene`, `from_directions`.
"""

from collections.abc import Iterable
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from . import checks
from .scene import MIRROR, Scene

_SPHERE = 4 * np.pi
_FIBONACCI_MINIMUM = 9  # from here on the nine moments can be met, with weights within 30 % of equal
_R2 = np.array([0.7548776662466927, 0.5698402909980532])


class Quadrature(eqx.Module):
    """Directions and weights, in float64 numpy arrays.

    **Arguments:**

    - `directions`: (n, 3), of length 1 to 1e-6.
    - `weights`: (n,), > 0, in steradians.
    - `offsets`: (n, 2), in (0, 1).
    - `name`: for reports.

    **Raises** `ValueError` otherwise. The weights need not add up to 4 pi (see `mirrored`).
    """

    directions: Float[np.ndarray, "n 3"]
    weights: Float[np.ndarray, " n"]
    offsets: Float[np.ndarray, "n 2"]
    name: str = eqx.field(static=True)

    def __init__(self, directions: Any, weights: Any, offsets: Any = None, name: str = "custom"):
        for label, value in (("directions", directions), ("weights", weights), ("offsets", offsets)):
            if checks.is_traced(value):
                checks.fail(label, value, "known numbers", "make the quadrature outside jit and grad", TypeError)
        self.directions = np.asarray(checks.points("directions", directions))
        n = len(self.directions)
        _not_empty(self.directions)
        error = np.abs(np.linalg.norm(self.directions, axis=1) - 1)
        if error.max() > 1e-6:
            got = f"{self.directions[error.argmax()].tolist()} at index {error.argmax()}"
            checks.fail("directions", got, "vectors of length 1", "from_directions scales them for you")
        self.weights = np.array(checks.positive("weights", weights, (n,)), np.float64)
        offsets = r2_offsets(n) if offsets is None else checks.finite("offsets", offsets, (n, 2))
        self.offsets = np.array(offsets, np.float64)
        outside = np.any((self.offsets <= 0) | (self.offsets >= 1), axis=1)
        if outside.any():
            got = f"{self.offsets[outside.argmax()].tolist()} at index {outside.argmax()}"
            checks.fail("offsets", got, "numbers in (0, 1), both ends left out", "leave offsets out for a good default")
        self.name = name

    def __len__(self) -> int:
        return len(self.weights)

    def __repr__(self) -> str:
        return f"Quadrature({self.name}: {len(self)} directions)"

    def moments(self) -> tuple[float, Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """The sums of a, a w and a w w' over the set; exact are 4 pi, 0 and (4 pi / 3) I."""
        weighted = self.weights[:, None] * self.directions
        return float(self.weights.sum()), weighted.sum(axis=0), weighted.T @ self.directions

    def rotate(self, matrix: Any) -> "Quadrature":
        """The set with directions `matrix` @ w, `matrix` (3, 3) orthogonal. Weights and offsets stay."""
        matrix = np.asarray(checks.finite("matrix", matrix, (3, 3)), np.float64)
        if np.abs(matrix @ matrix.T - np.eye(3)).max() > 1e-6:
            checks.fail("matrix", matrix.tolist(), "an orthogonal matrix", "take q from numpy.linalg.qr(matrix)")
        return Quadrature(self.directions @ matrix.T, self.weights, self.offsets, f"{self.name}, rotated")

    def mirrored(self, axes: Iterable[int]) -> "Quadrature":
        """The directions with w >= 0 along each of `axes` (out of 0, 1, 2), to be used with their mirror images.

        Weights are changed so that over the part of the sphere that is left all moments up to the second are exact, the
        fluxes to the mirrors among them; if that would take changes by more than a half, they are only scaled to add up to
        their share of 4 pi. A direction with w = 0 exactly is its own image, and counts half.
        """
        axes = sorted(set(axes))
        if any(axis not in (0, 1, 2) for axis in axes):
            checks.fail("axes", axes, "axes out of 0, 1, 2", "use axes=(2,) for mirrors at the z sides")
        along = self.directions[:, axes]
        kept = np.all(along >= 0, axis=1)
        if not kept.any():
            checks.fail(
                "axes", axes, f"axes along which some of the {len(self)} directions are positive", "use more directions"
            )
        weights = self.weights[kept] * 0.5 ** np.sum(along[kept] == 0, axis=1)
        weights *= _SPHERE / 2 ** len(axes) / weights.sum()
        exact = _solved(self.directions[kept], weights, _part_moments(axes))
        weights = weights if exact is None or np.abs(exact / weights - 1).max() > 0.5 else exact
        return Quadrature(self.directions[kept], weights, self.offsets[kept], f"{self.name}, mirrored in {axes}")


def fibonacci(n: int) -> Quadrature:
    """`n` >= 1 directions on a Fibonacci spiral: z in equal steps, azimuth by the golden angle.

    Exact moments as stated above for n >= 9; below that the weights are equal, and only their sum is exact.
    """
    n = checks.positive_int("n", n)
    i = np.arange(n) + 0.5
    z = 1 - 2 * i / n
    azimuth = np.pi * (3 - np.sqrt(5)) * i
    radius = np.sqrt(1 - z**2)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], axis=-1)
    weights = np.full(n, _SPHERE / n)
    if n >= _FIBONACCI_MINIMUM:
        weights = _correct(directions, weights)
    return Quadrature(directions, weights, name=f"fibonacci({n})")


def cube(side: int) -> Quadrature:
    """6 `side`^2 directions, one to each cell of a cube whose faces are cut by equal angles; `side` even.

    A direction points to the centre of gravity of its cell on the sphere, its weight is the cell's solid angle. The set is as
    symmetric as a cube, and no direction lies in a plane of its mirrors: each half, quarter and octant of it is regular.
    """
    side = checks.positive_int("side", side, at_least=2)
    if side % 2:
        checks.fail("side", side, "an even number", f"use {side + 1}")
    fine = 8  # samples of a cell along each edge, for its centre of gravity
    edges = np.tan(np.pi / 4 * np.linspace(-1, 1, side + 1))
    low, high = (np.stack(np.meshgrid(e, e, indexing="ij"), -1).reshape(-1, 2) for e in (edges[:-1], edges[1:]))
    weights = np.tile(_rectangle(low, high, 1.0), 6)
    x = np.tan(np.pi / 4 * (2 * (np.arange(side * fine) + 0.5) / (side * fine) - 1))
    x, y = np.meshgrid(x, x, indexing="ij")
    points = np.stack([x, y, np.ones_like(x)], -1)
    # The samples' shares of solid angle, with the points made unit vectors.
    points *= ((1 + x**2) * (1 + y**2) / (1 + x**2 + y**2) ** 2)[..., None]
    centers = points.reshape(side, fine, side, fine, 3).sum((1, 3)).reshape(-1, 3)
    centers /= np.linalg.norm(centers, axis=1, keepdims=True)
    faces = [np.roll(centers * [1, 1, sign], axis, axis=1) for axis in range(3) for sign in (1, -1)]
    directions = np.concatenate(faces)
    return Quadrature(directions, _correct(directions, weights), name=f"cube({side})")


def cube_points(half_width: int) -> Int[np.ndarray, "n 3"]:
    """The integer points (p, q, r) on the surface of the cube of half-width M = `half_width`: max(|p|, |q|, |r|) = M.

    There are 24 M^2 + 2 of them, in lexicographic order.
    """
    m = checks.positive_int("half_width", half_width)
    side = np.arange(-m, m + 1)
    grid = np.stack(np.meshgrid(side, side, side, indexing="ij"), axis=-1).reshape(-1, 3)
    return grid[np.abs(grid).max(axis=1) == m]


def light_ray_cube(half_width: int) -> Quadrature:
    """The directions of the paper's light ray cube (section 2): through `cube_points(half_width)`, 602 for M = 5.

    A point's weight is the solid angle of its cell, the unit square around it on the cube's surface. Points on edges
    and corners own parts of the squares on two or three faces.
    """
    points = cube_points(half_width)
    m = np.abs(points).max()
    weights = np.zeros(len(points))
    for axis in range(3):
        on_face = np.abs(points[:, axis]) == m
        across = np.delete(points[on_face], axis, axis=1)
        lower, upper = np.maximum(across - 0.5, -m), np.minimum(across + 0.5, m)
        weights[on_face] += _rectangle(lower, upper, m)
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    return Quadrature(directions, _correct(directions, weights), name=f"light_ray_cube({m})")


def product(polar: int, azimuthal: int) -> Quadrature:
    """`polar` Gauss-Legendre nodes in cos(polar angle) times `azimuthal` equally spaced azimuths.

    polar >= 2 and azimuthal >= 3, with which the moments are exact. Azimuths are shifted by 1/3 or 2/3 of a step,
    alternately from the poles inwards: no direction has x = 0, y = 0 or |x| = |y|, and z = 0 occurs for odd `polar`
    only. The set is symmetric under z -> -z.
    """
    polar = checks.positive_int("polar", polar, at_least=2)
    azimuthal = checks.positive_int("azimuthal", azimuthal, at_least=3)
    z, polar_weights = np.polynomial.legendre.leggauss(polar)
    row = np.arange(polar)
    shift = (1 + np.minimum(row, polar - 1 - row) % 2) / 3
    azimuth = 2 * np.pi / azimuthal * (np.arange(azimuthal) + shift[:, None])
    radius = np.sqrt(1 - z**2)[:, None]
    height = np.broadcast_to(z[:, None], azimuth.shape)
    directions = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=-1).reshape(-1, 3)
    weights = np.repeat(polar_weights * 2 * np.pi / azimuthal, azimuthal)
    return Quadrature(directions, _correct(directions, weights), name=f"product({polar}, {azimuthal})")


def for_scene(scene: Scene, count: int = 200) -> Quadrature:
    """What `rm.solve` takes: about `count` directions, of a `cube` next to mirrors, else of a `fibonacci` spiral."""
    count = checks.positive_int("count", count)
    if MIRROR not in scene.boundary.sides:
        return fibonacci(count)
    return cube(2 * max(1, round(np.sqrt(count / 24))))


def from_directions(directions: Any, weights: Any = None, offsets: Any = None) -> Quadrature:
    """A set of your own: `directions` (n, 3) of any length but 0, `weights` (n,) > 0, by default equal.

    The weights are scaled to add up to 4 pi and otherwise kept: how well the set integrates is yours to see to.
    """
    vectors = checks.points("directions", directions)
    if checks.is_traced(vectors):
        checks.fail("directions", vectors, "known numbers", "make the quadrature outside jit and grad", TypeError)
    _not_empty(vectors)
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    if not length.all():
        got = f"a vector of length 0 at index {int(length.argmin())}"
        checks.fail("directions", got, "directions of non-zero length", "leave it out")
    n = len(length)
    given = np.ones(n) if weights is None else checks.positive("weights", weights, (n,))
    return Quadrature(vectors / length, _SPHERE / np.sum(given) * given, offsets, f"{n} directions")


def r2_offsets(n: int) -> Float[np.ndarray, "n 2"]:
    """The first `n` points of the R2 sequence (module docstring), in (0, 1)."""
    return (0.5 + np.arange(1, n + 1)[:, None] * _R2) % 1


def _not_empty(directions: Any) -> None:
    if len(directions) == 0:
        checks.fail("directions", "none", "at least one direction", "use fibonacci(200)")


def _rectangle(lower: np.ndarray, upper: np.ndarray, distance: float) -> np.ndarray:
    """Solid angle of rectangles between corners `lower` and `upper`, (n, 2) each, in a plane at `distance`."""

    def from_foot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.arctan(x * y / (distance * np.sqrt(x**2 + y**2 + distance**2)))

    (x0, y0), (x1, y1) = lower.T, upper.T
    return from_foot(x1, y1) - from_foot(x0, y1) - from_foot(x1, y0) + from_foot(x0, y0)


def _part_moments(axes: list[int]) -> np.ndarray:
    """Integrals of x x, y y, z z, x, y, z, x y, y z, z x over the part of the sphere where w > 0 along each of `axes`."""
    share = 0.5 ** len(axes)
    halves = [2.0 * np.pi * share if a in axes else 0.0 for a in range(3)]
    both = [8 / 3 * share if a in axes and b in axes else 0.0 for a, b in ((0, 1), (1, 2), (2, 0))]
    return np.array([_SPHERE / 3 * share] * 3 + halves + both)


def _correct(directions: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """`weights` changed as little as possible (least squares, relative) to have the exact moments 0, 1 and 2."""
    exact = _solved(directions, weights, _part_moments([]))
    if exact is None or exact.min() <= 0:
        got = f"{len(weights)} directions"
        checks.fail("quadrature", got, "enough to make the moments exact with positive weights", "use more directions")
    return exact


def _solved(directions: np.ndarray, weights: np.ndarray, target: np.ndarray) -> np.ndarray | None:
    """Weights with the moments of `target`, which imply the sum; None if no such weights are found."""
    x, y, z = directions.T
    functions = np.stack([x * x, y * y, z * z, x, y, z, x * y, y * z, z * x])  # the sum is that of the first three
    for _ in range(2):  # a second step takes off the first one's rounding
        missing = target - functions @ weights
        weights = weights * (1 + np.linalg.lstsq(functions * weights, missing, rcond=1e-10)[0])
    return weights if np.abs(functions @ weights - target).max() <= 1e-10 else None
