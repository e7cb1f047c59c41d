"""Shapes: closed forms, the properties that make a function a signed distance, and refusal of bad shapes.

A function f with f = 0 exactly on a surface is its distance where (a) its Lipschitz constant is 1, so |f| is at most
the distance, and (b) x - f grad f lies on the surface and |grad f| = 1, so |f| is at least the distance.
"""

# pyright: reportArgumentType=false
# (bad input is passed on purpose)

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from raymanifold_jax.shapes import Box, Cylinder, Difference, HalfSpace, Shape, Sphere, Torus, Union

SPHERE = Sphere((0.1, -0.2, 0.3), 0.7)
BOX = Box((-0.5, -0.4, -0.3), (0.4, 0.6, 0.2))
TORUS = Torus((0.1, 0, -0.1), 0.6, 0.25, axis=(1, 2, 2))
CYLINDER = Cylinder((-0.3, -0.4, 0.1), (0.3, 0.5, 0.4), 0.3)
HALF_SPACE = HalfSpace((0.1, 0.2, 0.3), (1, -1, 2))
EXACT = {
    "sphere": SPHERE,
    "box": BOX,
    "torus": TORUS,
    "cylinder": CYLINDER,
    "half space": HALF_SPACE,
    "translated": BOX.translate((0.2, -0.1, 0.3)),
    "rotated": BOX.rotate((1, 1, 0), 0.7, center=(0.1, 0.2, 0.3)),
}
COMPOSITE = {
    "union": SPHERE.union(BOX, CYLINDER),
    "intersection": SPHERE.intersection(BOX),
    "difference": BOX.difference(SPHERE).rotate((0, 0, 1), 0.3),
    "half ball": SPHERE.difference(HALF_SPACE),
}
ALL = EXACT | COMPOSITE


def cases(shapes: dict[str, Shape]):
    return pytest.mark.parametrize("shape", list(shapes.values()), ids=list(shapes))


def random_points(n: int = 2000, side: float = 1.5) -> np.ndarray:
    return np.random.default_rng(0).uniform(-side, side, (n, 3)).astype(np.float32)


def gradients(shape: Shape, points: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(jax.grad(shape.distance))(jnp.asarray(points)))


@pytest.mark.parametrize(
    ("shape", "point", "distance"),
    [
        (Sphere((1, 0, 0), 2), (1, 0, 0), -2),
        (Sphere((1, 0, 0), 2), (4, 4, 0), 3),
        (Box((0, 0, 0), (2, 4, 6)), (1, 2, 3), -1),
        (Box((0, 0, 0), (2, 4, 6)), (5, 8, 3), 5),  # an edge, legs 3 and 4
        (Box((0, 0, 0), (2, 4, 6)), (-2, -3, -6), 7),  # a corner, 2, 3, 6
        (Box((0, 0, 0), (2, 4, 6)), (1, 2, 6), 0),
        (Torus((0, 0, 0), 5, 1), (0, 0, 0), 4),
        (Torus((0, 0, 0), 5, 1), (5, 0, 0), -1),
        (Torus((0, 0, 0), 5, 1), (0, 8, 4), 4),
        (Torus((0, 0, 0), 5, 1, axis=(2, 0, 0)), (4, 0, 8), 4),
        (Cylinder((0, 0, -2), (0, 0, 2), 3), (0, 0, 0), -2),
        (Cylinder((0, 0, -2), (0, 0, 2), 3), (6, 0, 6), 5),  # the rim, legs 3 and 4
        (Cylinder((1, 0, 0), (9, 0, 0), 1), (5, 3, 4), 4),
        (HalfSpace((0, 0, 1), (0, 0, 10)), (7, 8, 3), 2),
        (HalfSpace((0, 0, 1), (0, 0, -1)), (7, 8, 3), -2),
        (Sphere((0, 0, 0), 2).difference(Sphere((0, 0, 0), 1)), (0, 0, 0), 1),
        (Sphere((0, 0, 0), 1).union(Sphere((4, 0, 0), 1), Sphere((0, 9, 0), 1)), (0, 6, 0), 2),
        (Box((0, 0, 0), (2, 2, 2)).intersection(Box((1, 1, 1), (3, 3, 3))), (1.5, 1.5, 1.75), -0.25),
    ],
)
def test_closed_forms(shape, point, distance):
    """Distances worked out by hand, inside, outside, beyond edges and corners."""
    assert shape.distance(jnp.asarray(point, jnp.float32)) == pytest.approx(distance, rel=1e-6, abs=1e-6)


@cases(ALL)
def test_lipschitz_constant_is_one(shape):
    """No distance changes faster than the point moves, so |distance| is a safe step for marching."""
    a, b = random_points(), random_points() + np.random.default_rng(1).normal(0, 0.2, (2000, 3)).astype(np.float32)
    change = np.abs(shape.distance(a) - shape.distance(b))
    assert np.all(change <= np.linalg.norm(a - b, axis=1) + 1e-5)


@cases(EXACT)
def test_exact_shapes_reach_their_surface(shape):
    """Going the distance against the gradient ends on the surface, for the shapes that are said to be exact."""
    points = random_points()
    distance = np.asarray(shape.distance(points))
    assert (distance < 0).any() and (distance > 0).any()
    landed = shape.distance(points - distance[:, None] * gradients(shape, points))
    np.testing.assert_allclose(landed, 0, atol=3e-6)


@cases(ALL)
def test_gradients_near_surfaces_have_unit_length(shape):
    """Within 0.05 of its surface a shape's gradient has length 1: normals need no care with their length."""
    points = random_points(20000)
    points = points[np.abs(shape.distance(points)) < 0.05]
    assert len(points) > 100
    # Composites are measured from one of their parts' surfaces, so this holds on their edges too.
    np.testing.assert_allclose(np.linalg.norm(gradients(shape, points), axis=1), 1, atol=1e-5)


def test_gradient_on_a_box_face_is_the_face_normal():
    """Exactly on a face, where voxel centres like to be, the gradient is the whole normal, not half of it."""
    box = Box((0, 0, 0), (1, 1, 1))
    for axis in range(3):
        for side in (0.0, 1.0):
            point = np.array([0.3, 0.4, 0.6], np.float32)
            point[axis] = side
            expected = np.zeros(3)
            expected[axis] = 2 * side - 1
            np.testing.assert_allclose(gradients(box, point[None])[0], expected, atol=1e-6)


AWKWARD = {
    "sphere centre": (Sphere((0, 0, 0), 1), (0, 0, 0)),
    "box centre": (Box((-1, -1, -1), (1, 1, 1)), (0, 0, 0)),
    "box edge": (Box((-1, -1, -1), (1, 1, 1)), (1, 1, 0)),
    "box corner": (Box((-1, -1, -1), (1, 1, 1)), (1, 1, 1)),
    "torus axis": (Torus((0, 0, 0), 1, 0.3), (0, 0, 0.5)),
    "torus centre line": (Torus((0, 0, 0), 1, 0.3), (1, 0, 0)),
    "cylinder axis": (Cylinder((0, 0, -1), (0, 0, 1), 0.5), (0, 0, 0.9)),
    "cylinder rim": (Cylinder((0, 0, -1), (0, 0, 1), 0.5), (0.5, 0, 1)),
    "where two balls touch": (Sphere((-1, 0, 0), 1).union(Sphere((1, 0, 0), 1)), (0, 0, 0)),
    "rotated about itself": (Sphere((0, 0, 0), 1).rotate((0, 0, 1), 0.0), (0, 0, 0)),
}


@pytest.mark.parametrize(("shape", "point"), list(AWKWARD.values()), ids=list(AWKWARD))
def test_gradients_are_finite_at_awkward_points(shape, point):
    """Where the distance has no gradient, JAX's is finite and at most 1 long; that by the parameters is finite."""
    point = jnp.asarray(point, jnp.float32)
    gradient = jax.grad(shape.distance)(point)
    assert np.isfinite(gradient).all()
    assert np.linalg.norm(gradient) <= 1 + 1e-6
    by_parameters = jax.grad(lambda s: s.distance(point))(jax.tree.map(jnp.asarray, shape))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(by_parameters))


def test_rotation_is_right_handed():
    """A quarter turn about z takes a box along x to one along y, about any centre."""
    turned = Box((1, 0, 0), (3, 1, 1)).rotate((0, 0, 5), np.pi / 2)
    np.testing.assert_allclose(
        turned.distance(random_points(side=4)), Box((-1, 1, 0), (0, 3, 1)).distance(random_points(side=4)), atol=2e-6
    )
    turned = Box((1, 0, 0), (3, 1, 1)).rotate((0, 0, 1), np.pi / 2, center=(1, 0, 0))
    np.testing.assert_allclose(
        turned.distance(random_points(side=4)), Box((0, 0, 0), (1, 2, 1)).distance(random_points(side=4)), atol=2e-6
    )


def test_rotation_and_translation_move_with_their_points():
    """A moved point is as far from the moved shape as the point was from the shape, for a turn about a skew axis."""
    points, axis, angle = random_points(), np.array([1.0, -2.0, 2.0]) / 3, 0.8
    # The exponential of angle * [axis], summed until it stops changing: another way than the package's formula.
    generator = angle * np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    matrix, term = np.eye(3), np.eye(3)
    for k in range(1, 25):
        term = term @ generator / k
        matrix = matrix + term
    moved = CYLINDER.rotate(axis, angle).translate((0.3, 0.2, -0.5))
    moved_points = (points @ matrix.T + [0.3, 0.2, -0.5]).astype(np.float32)
    np.testing.assert_allclose(moved.distance(moved_points), CYLINDER.distance(points), atol=3e-6)


def test_sets():
    """Union, intersection and difference contain what set theory says."""
    points = random_points()
    sphere, box = SPHERE.distance(points) < 0, BOX.distance(points) < 0
    np.testing.assert_array_equal(SPHERE.union(BOX).distance(points) < 0, sphere | box)
    np.testing.assert_array_equal(SPHERE.intersection(BOX).distance(points) < 0, sphere & box)
    np.testing.assert_array_equal(BOX.difference(SPHERE).distance(points) < 0, box & ~sphere)
    assert (box & ~sphere).any() and (box & sphere).any()


@cases({k: v for k, v in ALL.items() if k != "half space"})
def test_bounds_enclose(shape):
    """Every point inside lies within the bounds, and the bounds are finite where the shape is."""
    lower, upper = shape.bounds()
    assert lower.shape == upper.shape == (3,)
    assert np.isfinite([lower, upper]).all()
    points = random_points(40000)
    inside = points[np.asarray(shape.distance(points)) < 0]
    assert len(inside) > 50
    assert np.all(inside >= lower - 1e-6) and np.all(inside <= upper + 1e-6)


@cases({"sphere": SPHERE, "box": BOX, "torus": TORUS, "cylinder": CYLINDER})
def test_bounds_of_simple_shapes_are_tight(shape):
    """Each face of the box touches the shape: a plane just within it meets the inside (on a fine grid)."""
    lower, upper = shape.bounds()
    for axis in range(3):
        for face, inwards in ((lower[axis], 1), (upper[axis], -1)):
            grids = [np.linspace(lo, up, 200) for lo, up in zip(lower, upper, strict=True)]
            grids[axis] = np.array([face + inwards * 0.01])
            plane = np.stack(np.meshgrid(*grids), axis=-1)
            assert float(jnp.min(shape.distance(plane))) < 0


def test_bounds_of_half_spaces():
    """A half space is bounded on one side if its plane is across an axis, else not at all; quarter turns too."""
    inf = np.inf
    np.testing.assert_array_equal(HalfSpace((1, 2, 3), (0, 0, 1)).bounds(), [[-inf] * 3, [inf, inf, 3]])
    np.testing.assert_array_equal(HalfSpace((1, 2, 3), (0, -2, 0)).bounds(), [[-inf, 2, -inf], [inf] * 3])
    np.testing.assert_array_equal(HALF_SPACE.bounds(), [[-inf] * 3, [inf] * 3])
    turned = HalfSpace((1, 2, 3), (0, 0, 1)).rotate((1, 0, 0), np.pi / 2)  # z to -y
    np.testing.assert_allclose(turned.bounds(), [[-inf, -3, -inf], [inf] * 3], rtol=1e-12)


def test_parameters_are_leaves():
    """A new radius does not compile anew, distances differentiate by parameters and have the dtype of points."""
    traces = []

    @jax.jit
    def distance(shape, points):
        traces.append(1)
        return shape.distance(points)

    point = jnp.asarray([2.0, 0, 0])
    assert distance(Sphere((0, 0, 0), 0.5), point) == 1.5
    assert distance(Sphere((1, 0, 0), 0.25), point) == 0.75
    assert len(traces) == 1
    assert jax.grad(lambda r: Sphere((0, 0, 0), r).distance(point))(0.5) == -1
    # The plane y = 0, turned about z by a, is -sin(a) x + cos(a) y away: at a = 0 this changes by -x.
    plane = HalfSpace((0, 0, 0), (0, 1, 0))
    assert jax.grad(lambda a: plane.rotate((0, 0, 1), a).distance(point))(0.0) == pytest.approx(-2, rel=1e-6)
    assert SPHERE.distance(jnp.zeros((4, 5, 3), jnp.bfloat16)).dtype == jnp.bfloat16
    assert SPHERE.distance(np.zeros((4, 5, 3), int)).shape == (4, 5)
    assert all(leaf.dtype == np.float64 for leaf in jax.tree.leaves(Sphere(jnp.zeros(3), jnp.float32(1))))


NAN = float("nan")


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Sphere((0, 0), 1), ValueError, "center"),
        (lambda: Sphere((0, 0, NAN), 1), ValueError, r"center: got nan at index \(2,\)"),
        (lambda: Sphere("here", 1), TypeError, "center: got here"),
        (lambda: Sphere((0, 0, [1, 2]), 1), ValueError, "center"),
        (lambda: Sphere((0, 0, 1j), 1), TypeError, "center"),
        (lambda: Sphere((0, 0, 0), 0), ValueError, "radius: got 0"),
        (lambda: Sphere((0, 0, 0), -1.5), ValueError, "radius: got -1.5"),
        (lambda: Sphere((0, 0, 0), (1, 2, 3)), ValueError, "radius"),
        (lambda: Sphere((0, 0, 0), None), TypeError, "radius: got None"),
        (lambda: Box((0, 0, 0), (1, 1, 0)), ValueError, "Box: got lower"),
        (lambda: Box((0, 2, 0), (1, 1, 1)), ValueError, "Box: got lower"),
        (lambda: Torus((0, 0, 0), 1, 1.5), ValueError, "minor_radius: got 1.5"),
        (lambda: Torus((0, 0, 0), 1, 0.5, axis=(0, 0, 0)), ValueError, r"axis: got \(0, 0, 0\)"),
        (lambda: Cylinder((0, 0, 1), (0, 0, 1), 1), ValueError, "end"),
        (lambda: Cylinder((0, 0, 0), (0, 0, 1), NAN), ValueError, "radius: got nan"),
        (lambda: HalfSpace((0, 0, 0), (0, 0, 0)), ValueError, "normal"),
        (lambda: Union(), ValueError, "union: got no shapes"),
        (lambda: SPHERE.union("box"), TypeError, "union: got box"),
        (lambda: SPHERE.difference(Sphere), TypeError, "difference: got the class Sphere itself"),
        (lambda: Difference(SPHERE, None), TypeError, "difference: got None"),
        (lambda: SPHERE.translate((1, NAN, 0)), ValueError, "offset"),
        (lambda: SPHERE.rotate((0, 0, 0), 1), ValueError, "axis"),
        (lambda: SPHERE.rotate((0, 0, 1), NAN), ValueError, "angle"),
        (lambda: SPHERE.rotate((0, 0, 1), "right"), TypeError, "angle: got right"),
        (lambda: SPHERE.distance(np.zeros((3, 2))), ValueError, r"points: got an array of shape \(3, 2\)"),
    ],
)
def test_bad_input(make, error, message):
    """A bad parameter is refused by name and value, with the way out after a semicolon."""
    with pytest.raises(error, match=message + ".*, expected .*; "):
        make()


def test_directions_of_any_size_are_scaled():
    """Directions keep their sense from the smallest to the largest length a float can hold."""
    for length in (1e-200, 1.0, 1e200):
        np.testing.assert_allclose(HalfSpace((0, 0, 0), (0, 3 * length, 4 * length)).normal, [0, 0.6, 0.8], rtol=1e-14)
