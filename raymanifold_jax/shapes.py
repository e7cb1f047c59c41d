"""Shapes of solids, as signed distances.

A shape answers one question: how far is a point x from its surface, negative inside, in scene units,

    d(x) = -/+ min over the surface's points y of |x - y|.

`Sphere`, `Box`, `Torus`, `Cylinder` and `HalfSpace` are exact. `Translated` and `Rotated` keep what they move.
`Union` is exact outside and a lower bound of the depth inside; `Intersection` and `Difference` are exact inside and a
lower bound of the distance outside (where what they combine is exact). All have the right sign and Lipschitz constant
1, so |d| can be marched by safely.

Parameters are float64 numpy arrays and leaves of the pytree: changing a radius does not compile anew. `distance`
computes in the dtype of its points, and has a finite gradient everywhere (of length 1 where the nearest surface point
is unique and shorter, down to 0, where it is not: at a sphere's centre, on an edge).

Public names: `Shape`, `Sphere`, `Box`, `Torus`, `Cylinder`, `HalfSpace`, `Union`, `Intersection`, `Difference`,
`Translated`, `Rotated`; for this package `safe_norm`, `corner_distance`, `dot`, `least`, `greatest`, `greatest_coordinate`,
`clamped`.
"""

import abc
import functools
import operator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from . import checks

Bounds = tuple[Float[np.ndarray, " 3"], Float[np.ndarray, " 3"]]


#: Numbers: where there are more, sums and extrema along an axis of three are taken coordinate by coordinate. XLA does not
#: vectorise their loops (five times as long); where there are few, the number of its operations counts.
_MANY = 1 << 14


def dot(
    one: Float[jax.Array, "*batch n"], other: Float[jax.Array, "*batch n"] | Float[np.ndarray, "*batch n"]
) -> Float[jax.Array, "*batch"]:
    """Scalar product along the last axis."""
    if one.size < _MANY:
        return jnp.sum(one * other, axis=-1)
    return functools.reduce(operator.add, (one[..., i] * other[..., i] for i in range(one.shape[-1])))


@jax.custom_jvp
def least(values: tuple[Float[jax.Array, "*batch"], ...]) -> Float[jax.Array, "*batch"]:
    """The least of some arrays; its gradient is the mean of theirs that are least."""
    return functools.reduce(jnp.minimum, values)


@least.defjvp
def _(primals, tangents):
    (values,), (rates,) = primals, tangents
    found, total, count = values[0], rates[0], 1.0
    # Each against the least so far, not against the least of all: that one may be rounded another way where XLA repeats it.
    for value, rate in zip(values[1:], rates[1:], strict=True):
        lower, upper = value < found, value > found
        total = jnp.where(lower, rate, jnp.where(upper, total, total + rate))
        count = jnp.where(lower, 1.0, jnp.where(upper, count, count + 1.0))
        found = jnp.minimum(found, value)
    return found, total / count


def greatest(values: tuple[Float[jax.Array, "*batch"], ...]) -> Float[jax.Array, "*batch"]:
    """The greatest of some arrays; its gradient is the mean of theirs that are greatest."""
    return -least(tuple(-value for value in values))


@jax.custom_jvp
def greatest_coordinate(vectors: Float[jax.Array, "*batch n"]) -> Float[jax.Array, "*batch"]:
    """The greatest number along the last axis; its gradient is as that of `greatest`, and not JAX's, which is infinite where
    XLA rounds a repeated value another way."""
    return jnp.max(vectors, axis=-1)


@greatest_coordinate.defjvp
def _(primals, tangents):
    values, rates = (tuple(jnp.moveaxis(array, -1, 0)) for (array,) in (primals, tangents))
    return jax.jvp(greatest, (values,), (rates,))


def clamped(value: jax.Array, low: Any, high: Any) -> jax.Array:
    """As `jnp.clip`, whose gradient may be 0 where XLA rounds a repeated value another way."""
    return jnp.where(value < low, low, jnp.where(value > high, high, value))


def safe_norm(vectors: Float[jax.Array, "*batch n"]) -> Float[jax.Array, "*batch"]:
    """Length along the last axis, with gradient 0 (not NaN) where it is 0."""
    square = dot(vectors, vectors)
    # The inner `where` keeps sqrt's infinite slope out of the branch that is not taken.
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)


class Shape(eqx.Module):
    """Abstract. A solid body, known by its signed distance."""

    @abc.abstractmethod
    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        """Signed distance of `points` to the surface, negative inside, in scene units, in the dtype of `points`.

        Written in `jax.numpy`. **Raises** `ValueError` if the last axis of `points` is not 3 long.
        """

    @abc.abstractmethod
    def bounds(self) -> Bounds:
        """Lower and upper corner, (3,) each, of a box with sides along the axes that encloses the shape.

        May be infinite, need not be tight, and may have lower > upper for an intersection of shapes that do not meet.
        """

    @property
    def convex(self) -> bool:
        """Whether it is known to be: then no part of it hides another from a point before that other's face."""
        return type(self) in (Sphere, Box, Cylinder, HalfSpace)  # not what is derived from them

    @property
    def roughness(self) -> Any:
        """How far the surface that rays find may be from the shape's own; 0.0 where it is known exactly."""
        parts = [part for value in vars(self).values() for part in (value if isinstance(value, tuple) else (value,))]
        rough = [part.roughness for part in parts if isinstance(part, Shape)]
        return functools.reduce(jnp.maximum, (r for r in rough if not isinstance(r, float)), 0.0) if rough else 0.0

    def union(self, *others: "Shape") -> "Union":
        """What lies in this shape or in any of `others`."""
        return Union(self, *others)

    def intersection(self, other: "Shape") -> "Intersection":
        """What lies both in this shape and in `other`."""
        return Intersection(self, other)

    def difference(self, other: "Shape") -> "Difference":
        """What lies in this shape and not in `other`."""
        return Difference(self, other)

    def translate(self, offset: Any) -> "Translated":
        """The shape moved by `offset` (3,), in scene units."""
        return Translated(self, offset)

    def rotate(self, axis: Any, angle: Any, center: Any = (0, 0, 0)) -> "Rotated":
        """The shape turned by `angle` radians, right-handed, about `axis` (3,) through `center` (3,)."""
        return Rotated(self, axis, angle, center)


class Sphere(Shape):
    """The ball of `radius` > 0 around `center` (3,). Exact."""

    center: Float[checks.Numbers, " 3"]
    radius: Float[checks.Numbers, ""]

    def __init__(self, center: Any, radius: Any):
        self.center = checks.vector3("center", center)
        self.radius = _length("radius", radius)

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points, center, radius = _cast(points, self.center, self.radius)
        return safe_norm(points - center) - radius

    def bounds(self) -> Bounds:
        return np.asarray(self.center - self.radius), np.asarray(self.center + self.radius)


class Box(Shape):
    """The box with sides along the axes between the corners `lower` and `upper`, (3,) each, lower < upper. Exact.

    For a box that stands askew use `rotate`.
    """

    lower: Float[checks.Numbers, " 3"]
    upper: Float[checks.Numbers, " 3"]

    def __init__(self, lower: Any, upper: Any):
        self.lower = checks.vector3("lower", lower)
        self.upper = checks.vector3("upper", upper)
        if not checks.is_traced((self.lower, self.upper)) and not np.all(self.lower < self.upper):
            got = f"lower {self.lower.tolist()} and upper {self.upper.tolist()}"
            checks.fail("Box", got, "lower < upper on every axis", "swap the corners, or give the box a thickness")

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points, lower, upper = _cast(points, self.lower, self.upper)
        return corner_distance(jnp.abs(points - (lower + upper) / 2) - (upper - lower) / 2)

    def bounds(self) -> Bounds:
        return np.asarray(self.lower), np.asarray(self.upper)


class Torus(Shape):
    """The ring around `axis` (3,): a tube of `minor_radius` around a circle of `major_radius` at `center` (3,). Exact.

    0 < minor_radius <= major_radius: the hole may close, but the tube does not overlap itself.
    """

    center: Float[checks.Numbers, " 3"]
    major_radius: Float[checks.Numbers, ""]
    minor_radius: Float[checks.Numbers, ""]
    axis: Float[checks.Numbers, " 3"]

    def __init__(self, center: Any, major_radius: Any, minor_radius: Any, axis: Any = (0, 0, 1)):
        self.center = checks.vector3("center", center)
        self.major_radius = _length("major_radius", major_radius)
        self.minor_radius = _length("minor_radius", minor_radius)
        self.axis = checks.unit_vector("axis", axis)
        radii = (self.major_radius, self.minor_radius)
        if not checks.is_traced(radii) and radii[1] > radii[0]:
            expected = f"at most major_radius = {float(radii[0])}"
            checks.fail("minor_radius", float(radii[1]), expected, "the major radius is that of the tube's centre line")

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points, center, major, minor, axis = _cast(points, self.center, self.major_radius, self.minor_radius, self.axis)
        radial, height = _cylindrical(points - center, axis)
        return safe_norm(jnp.stack([radial - major, height], axis=-1)) - minor

    def bounds(self) -> Bounds:
        reach = np.asarray(self.major_radius * _across(self.axis) + self.minor_radius)
        return np.asarray(self.center - reach), np.asarray(self.center + reach)


class Cylinder(Shape):
    """The solid cylinder of `radius` > 0 with flat ends at `start` and `end`, (3,) each, start != end. Exact."""

    start: Float[checks.Numbers, " 3"]
    end: Float[checks.Numbers, " 3"]
    radius: Float[checks.Numbers, ""]

    def __init__(self, start: Any, end: Any, radius: Any):
        self.start = checks.vector3("start", start)
        self.end = checks.vector3("end", end)
        self.radius = _length("radius", radius)
        if not checks.is_traced((self.start, self.end)) and np.array_equal(self.start, self.end):
            checks.fail("end", end, "a point other than start", "the two are the centres of the cylinder's flat ends")

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points, start, end, radius = _cast(points, self.start, self.end, self.radius)
        length = safe_norm(end - start)
        radial, height = _cylindrical(points - (start + end) / 2, (end - start) / length)
        return corner_distance(jnp.stack([radial - radius, jnp.abs(height) - length / 2], axis=-1))

    def bounds(self) -> Bounds:
        start, end = np.asarray(self.start), np.asarray(self.end)
        reach = np.asarray(self.radius) * _across((end - start) / np.linalg.norm(end - start))
        return np.minimum(start, end) - reach, np.maximum(start, end) + reach


class HalfSpace(Shape):
    """All points on the side of the plane through `point` (3,) that `normal` (3,) points away from. Exact."""

    point: Float[checks.Numbers, " 3"]
    normal: Float[checks.Numbers, " 3"]

    def __init__(self, point: Any, normal: Any):
        self.point = checks.vector3("point", point)
        self.normal = checks.unit_vector("normal", normal)

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points, point, normal = _cast(points, self.point, self.normal)
        return dot(points - point, normal)

    def bounds(self) -> Bounds:
        point, normal = np.asarray(self.point), np.asarray(self.normal)
        # Only a plane across an axis bounds anything: its normal then has a single component.
        across = (normal != 0) & (np.count_nonzero(normal) == 1)
        return (np.where(across & (normal < 0), point, -np.inf), np.where(across & (normal > 0), point, np.inf))


class Union(Shape):
    """What lies in any of `shapes`. Exact outside, a lower bound of the depth inside."""

    shapes: tuple[Shape, ...]

    def __init__(self, *shapes: Shape):
        self.shapes = _shapes("union", shapes)

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        return least(tuple(shape.distance(points) for shape in self.shapes))

    def bounds(self) -> Bounds:
        lower, upper = zip(*(shape.bounds() for shape in self.shapes), strict=True)
        return np.min(lower, axis=0), np.max(upper, axis=0)


class Intersection(Shape):
    """What lies in all of `shapes`. Exact inside, a lower bound of the distance outside."""

    shapes: tuple[Shape, ...]

    def __init__(self, *shapes: Shape):
        self.shapes = _shapes("intersection", shapes)

    @property
    def convex(self) -> bool:
        return all(shape.convex for shape in self.shapes)

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        return greatest(tuple(shape.distance(points) for shape in self.shapes))

    def bounds(self) -> Bounds:
        lower, upper = zip(*(shape.bounds() for shape in self.shapes), strict=True)
        return np.max(lower, axis=0), np.min(upper, axis=0)


class Difference(Shape):
    """What lies in `shape` and not in `removed`. Exact inside, a lower bound of the distance outside."""

    shape: Shape
    removed: Shape

    def __init__(self, shape: Shape, removed: Shape):
        self.shape, self.removed = _shapes("difference", (shape, removed))

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        return greatest((self.shape.distance(points), -self.removed.distance(points)))

    def bounds(self) -> Bounds:
        return self.shape.bounds()


class Translated(Shape):
    """`shape` moved by `offset` (3,). As exact as `shape`."""

    shape: Shape
    offset: Float[checks.Numbers, " 3"]

    def __init__(self, shape: Shape, offset: Any):
        (self.shape,) = _shapes("translate", (shape,))
        self.offset = checks.vector3("offset", offset)

    @property
    def convex(self) -> bool:
        return self.shape.convex

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points, offset = _cast(points, self.offset)
        return self.shape.distance(points - offset)

    def bounds(self) -> Bounds:
        lower, upper = self.shape.bounds()
        return lower + np.asarray(self.offset), upper + np.asarray(self.offset)


class Rotated(Shape):
    """`shape` turned by `angle` radians, right-handed, about `axis` (3,) through `center` (3,). As exact as `shape`."""

    shape: Shape
    axis: Float[checks.Numbers, " 3"]
    angle: Float[checks.Numbers, ""]
    center: Float[checks.Numbers, " 3"]

    def __init__(self, shape: Shape, axis: Any, angle: Any, center: Any = (0, 0, 0)):
        (self.shape,) = _shapes("rotate", (shape,))
        self.axis = checks.unit_vector("axis", axis)
        angle = checks.finite("angle", angle, ())
        self.angle = np.asarray(angle, np.float64) if isinstance(angle, np.ndarray) else angle
        self.center = checks.vector3("center", center)

    @property
    def convex(self) -> bool:
        return self.shape.convex

    def distance(self, points: Float[checks.Numbers, "*batch 3"]) -> Float[jax.Array, "*batch"]:
        points, axis, angle, center = _cast(points, self.axis, self.angle, self.center)
        # Rodrigues' formula with -angle: the points turn back, and the shape stays.
        arm = points - center
        along = axis * dot(arm, axis)[..., None]
        turned = along + (arm - along) * jnp.cos(angle) - jnp.cross(axis, arm) * jnp.sin(angle)
        return self.shape.distance(turned + center)

    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """The rotation: points turn by x -> matrix @ (x - center) + center."""
        cross = np.cross(np.eye(3), np.asarray(self.axis))  # cross @ v is axis x v
        angle = np.asarray(self.angle)
        return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)

    def bounds(self) -> Bounds:
        center, matrix = np.asarray(self.center), self.matrix()
        matrix = np.where(np.abs(matrix) < 1e-12, 0, matrix)  # a quarter turn keeps an infinite side to its axis
        lower, upper = self.shape.bounds()
        ends = np.stack([lower - center, upper - center])
        with np.errstate(invalid="ignore"):  # 0 * inf, replaced by what it means here
            reach = np.where(matrix == 0, 0, matrix * ends[:, None, :])
        return reach.min(axis=0).sum(axis=-1) + center, reach.max(axis=0).sum(axis=-1) + center


def _length(name: str, value: Any) -> checks.Numbers:
    length = checks.positive(name, value, ())
    return np.asarray(length, np.float64) if isinstance(length, np.ndarray) else length


def _shapes(name: str, shapes: tuple[Any, ...]) -> tuple[Shape, ...]:
    if not shapes:
        checks.fail(name, "no shapes", "at least one", "leave the solid out if there is nothing in it")
    for shape in shapes:
        checks.instance(name, shape, Shape, "combine shapes such as Sphere or Box first, then wrap the result in Solid")
    return shapes


def _cast(points: Any, *parameters: checks.Numbers) -> tuple[jax.Array, ...]:
    points = checks.coordinates("points", points)
    return points, *(jnp.asarray(parameter, points.dtype) for parameter in parameters)


def _cylindrical(arm: jax.Array, axis: jax.Array) -> tuple[jax.Array, jax.Array]:
    height = dot(arm, axis)
    return safe_norm(arm - height[..., None] * axis), height


def _across(axis: Any) -> np.ndarray:
    # Half the extent along x, y, z of the unit disc across `axis`.
    return np.sqrt(np.maximum(1 - np.asarray(axis) ** 2, 0))


def corner_distance(excess: jax.Array) -> jax.Array:
    # Distance to a convex corner of planes, from how far the point is beyond each plane.
    inside = greatest_coordinate(excess) if excess.size < _MANY else greatest(tuple(jnp.moveaxis(excess, -1, 0)))
    # Not the usual sum of an outside and an inside term: on a face that would halve the gradient.
    return jnp.where(inside > 0, safe_norm(jnp.where(excess > 0, excess, 0)), inside)
