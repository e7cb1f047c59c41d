"""Cameras: which rays make a picture.

A camera has a right-handed frame of unit vectors

    forward = direction / |direction|,   right = forward × up / |forward × up|,   upward = right × forward

so a picture is never mirrored: with `up` at the top, `right` is on the right, as the scene would be seen by eye. With
s, t in (−1/2, 1/2) across the width and up the height of the picture,

    orthographic:  origin = center + s·width·right + t·height·upward,   direction = forward
    perspective:   origin = position,   direction ∝ forward + 2 tan(fov/2)·(s·w/h·right + t·upward)

Row 0 of a picture is its top, as in every picture file. `row0="lower"` turns the order of the rows around: row 0 is
the bottom, as in an array indexed [y, x] (`matplotlib.pyplot.imshow(..., origin="lower")`). The view is the same; only
a file written from it unflipped would be mirrored (`image[::-1]` is the picture).

Cameras are static: geometry is plain Python numbers, and rays are made with numpy, in float64.

Public names: `OrthographicCamera`, `PerspectiveCamera`, and `AbstractCamera`, what they have in common.
"""

import abc
import math
from typing import Any, Literal, NamedTuple, TypeAlias

import equinox as eqx
import numpy as np
from jaxtyping import Float

from . import checks
from .lattice import Lattice

Vector: TypeAlias = tuple[float, float, float]
Row0: TypeAlias = Literal["upper", "lower"]
Rays: TypeAlias = Float[np.ndarray, "rows width samples 3"]


class Frame(NamedTuple):
    """The unit vectors of a picture, (3,) each: to its right, to its top, and into it."""

    right: Float[np.ndarray, " 3"]
    upward: Float[np.ndarray, " 3"]
    forward: Float[np.ndarray, " 3"]


class AbstractCamera(eqx.Module):
    """A picture of `resolution` (width, height) pixels, and the rays that see it."""

    resolution: eqx.AbstractVar[tuple[int, int]]
    row0: eqx.AbstractVar[Row0]

    @property
    @abc.abstractmethod
    def frame(self) -> Frame:
        """The right-handed frame of the picture: right × upward = −forward."""

    @abc.abstractmethod
    def rays(self, samples: int = 1, rows: tuple[int, int] | None = None) -> tuple[Rays, Rays]:
        """The rays of the picture, or of some of its rows.

        **Arguments:**

        - `samples`: rays a pixel, a square number. 1 is the pixel's centre, 4 the rotated grid; k² rays lie in the
          k × k cells of the pixel, no two in the same of k² rows or columns. The same in every pixel and every call.
        - `rows`: (start, stop) for the rows start <= row < stop only, so that a big picture can be made in parts.

        **Returns:** origins and unit directions, float64, each (rows, width, samples, 3).

        **Raises:** `ValueError` if `samples` is no square or `rows` is empty or outside the picture.
        """


class OrthographicCamera(AbstractCamera):
    """A parallel projection.

    **Arguments:**

    - `center`: (3,) a point in the middle of the picture plane; the rays start on the plane through it.
    - `direction`: (3,) where the rays go; any length but 0.
    - `up`: (3,) what is up in the picture; any length, but not along `direction`.
    - `width`: of the picture, in scene units. `height`: the same; left out, pixels are square.
    - `resolution`: (width, height) in pixels.
    - `row0`: "upper" or "lower": whether row 0 is the top or the bottom of the picture.

    **Raises:** `ValueError` or `TypeError` for values outside those.
    """

    center: Vector = eqx.field(static=True)
    direction: Vector = eqx.field(static=True)
    up: Vector = eqx.field(static=True)
    width: float = eqx.field(static=True)
    height: float = eqx.field(static=True)
    resolution: tuple[int, int] = eqx.field(static=True)
    row0: Row0 = eqx.field(static=True)

    def __init__(
        self,
        center: Any,
        direction: Any,
        up: Any,
        width: Any,
        height: Any = None,
        resolution: Any = (512, 512),
        row0: Row0 = "upper",
    ):
        self.center = _vector("center", center)
        self.direction = _vector("direction", direction)
        self.up = _vector("up", up)
        self.resolution = _resolution(resolution)
        self.width = _positive("width", width)
        square = self.width * self.resolution[1] / self.resolution[0]
        self.height = square if height is None else _positive("height", height)
        self.row0 = _row0(row0)
        _frame("direction", direction, up)

    @classmethod
    def top(cls, lattice: Lattice, resolution: Any = None, row0: Row0 = "lower") -> "OrthographicCamera":
        """The view down, along −z, on exactly the lattice's extent in x and y, from its upper side; right is +x, up +y.

        As `row0` is "lower", picture[iy, ix] is at x = origin_x + (ix + 1/2)·extent_x/width, and likewise y: row 0 is
        at the *smallest* y. For a picture file, where the largest y belongs on top, pass `row0="upper"`.
        `resolution` is (width, height) in pixels; left out, it is one pixel a voxel.
        """
        x, y, _ = (lattice.lower + lattice.upper) / 2
        width, height, _ = lattice.extent
        return cls(
            center=(x, y, lattice.upper[2]),
            direction=(0, 0, -1),
            up=(0, 1, 0),
            width=width,
            height=height,
            resolution=lattice.shape[:2] if resolution is None else resolution,
            row0=row0,
        )

    @property
    def frame(self) -> Frame:
        return _frame("direction", self.direction, self.up)

    def rays(self, samples: int = 1, rows: tuple[int, int] | None = None) -> tuple[Rays, Rays]:
        right, upward, forward = self.frame
        s, t = _picture_coordinates(self.resolution, samples, rows, self.row0)
        origins = np.asarray(self.center) + s * self.width * right + t * self.height * upward
        return origins, np.broadcast_to(forward, origins.shape).copy()


class PerspectiveCamera(AbstractCamera):
    """A pinhole camera with square pixels.

    **Arguments:**

    - `position`: (3,) the eye. `target`: (3,) the point in the middle of the picture, anywhere but at `position`.
    - `up`: (3,) what is up in the picture; any length, but not along the line of sight.
    - `field_of_view`: from the bottom to the top of the picture, in degrees, between 0 and 180.
    - `resolution`: (width, height) in pixels.
    - `row0`: "upper" or "lower": whether row 0 is the top or the bottom of the picture.

    **Raises:** `ValueError` or `TypeError` for values outside those.
    """

    position: Vector = eqx.field(static=True)
    target: Vector = eqx.field(static=True)
    up: Vector = eqx.field(static=True)
    field_of_view: float = eqx.field(static=True)
    resolution: tuple[int, int] = eqx.field(static=True)
    row0: Row0 = eqx.field(static=True)

    def __init__(
        self,
        position: Any,
        target: Any,
        up: Any = (0, 0, 1),
        field_of_view: Any = 40.0,
        resolution: Any = (512, 512),
        row0: Row0 = "upper",
    ):
        self.position = _vector("position", position)
        self.target = _vector("target", target)
        self.up = _vector("up", up)
        self.field_of_view = _positive("field_of_view", field_of_view)
        if self.field_of_view >= 180:
            advice = "40 is a usual lens; pass a larger resolution, not a wider field, for a larger picture"
            checks.fail("field_of_view", field_of_view, "degrees between 0 and 180", advice)
        self.resolution = _resolution(resolution)
        self.row0 = _row0(row0)
        if self.position == self.target:
            checks.fail("target", target, "a point away from position", "pass any point that lies ahead of the eye")
        _ = self.frame

    @property
    def frame(self) -> Frame:
        return _frame("target - position", np.subtract(self.target, self.position), self.up)

    def rays(self, samples: int = 1, rows: tuple[int, int] | None = None) -> tuple[Rays, Rays]:
        right, upward, forward = self.frame
        width, height = self.resolution
        s, t = _picture_coordinates(self.resolution, samples, rows, self.row0)
        size = 2 * math.tan(math.radians(self.field_of_view) / 2)
        directions = forward + size * (s * (width / height) * right + t * upward)
        directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
        return np.broadcast_to(np.asarray(self.position), directions.shape).copy(), directions


def _picture_coordinates(
    resolution: tuple[int, int], samples: int, rows: tuple[int, int] | None, row0: Row0
) -> tuple[np.ndarray, np.ndarray]:
    """s and t in (−1/2, 1/2), which broadcast to (rows, width, samples, 1): across and up the picture."""
    width, height = resolution
    start, stop = _rows(rows, height)
    x, y = _sub_pixels(samples)
    s = (np.arange(width)[None, :, None] + x) / width - 0.5
    # y counts downwards in the picture for both orders of the rows, so that both have the same rays.
    down = np.arange(start, stop) if row0 == "upper" else height - 1 - np.arange(start, stop)
    t = 0.5 - (down[:, None, None] + y) / height
    return s[..., None], t[..., None]


def _sub_pixels(samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions in the unit pixel, (samples,) each: ((i + (j + ½)/k)/k, (j + 1 − (i + ½)/k)/k) for cell (i, j)."""
    samples = checks.positive_int("samples", samples)
    k = math.isqrt(samples)
    if k * k != samples:
        checks.fail("samples", samples, "a square number", f"use {k**2} or {(k + 1) ** 2}")
    i, j = (index.ravel() for index in np.meshgrid(np.arange(k), np.arange(k), indexing="ij"))
    return (i + (j + 0.5) / k) / k, (j + 1 - (i + 0.5) / k) / k


def _rows(rows: tuple[int, int] | None, height: int) -> tuple[int, int]:
    if rows is None:
        return 0, height
    try:
        start, stop = rows
        valid = 0 <= int(start) < int(stop) <= height
    except (TypeError, ValueError):
        valid = False
    if not valid:
        checks.fail("rows", rows, f"(start, stop) with 0 <= start < stop <= {height}", "leave it out for all rows")
    return int(rows[0]), int(rows[1])


def _frame(name: str, direction: Any, up: Any) -> Frame:
    forward = np.asarray(checks.unit_vector(name, direction))
    across = np.cross(forward, np.asarray(checks.unit_vector("up", up)))
    # Rounding alone gives parallel vectors a product of about 1e-16.
    if np.linalg.norm(across) < 1e-9:
        checks.fail("up", up, f"a vector not along {name}", "for a view straight down or up pass up=(0, 1, 0)")
    right = across / np.linalg.norm(across)
    return Frame(right, np.cross(right, forward), forward)


def _vector(name: str, value: Any) -> Vector:
    x, y, z = (float(c) for c in checks.vector3(name, _known(name, value)))
    return x, y, z


def _positive(name: str, value: Any) -> float:
    return float(checks.positive(name, _known(name, value), ()))


def _resolution(resolution: Any) -> tuple[int, int]:
    if np.ndim(resolution) != 1 or len(resolution) != 2:
        checks.fail("resolution", resolution, "(width, height) in pixels", "pass two ints, as in (512, 512)")
    return checks.positive_int("resolution[0]", resolution[0]), checks.positive_int("resolution[1]", resolution[1])


def _row0(row0: Row0) -> Row0:
    if row0 not in ("upper", "lower"):
        checks.fail("row0", row0, '"upper" or "lower"', 'use "upper" for a picture file')
    return row0


def _known(name: str, value: Any) -> Any:
    if checks.is_traced(value):
        checks.fail(name, value, "known numbers", "a camera is static: make it outside jit and grad", TypeError)
    return value
