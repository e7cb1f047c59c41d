"""Quadratures: what they integrate exactly, the light ray cube's cells, symmetric halves, refusal of bad sets."""

# pyright: reportArgumentType=false
# (bad input is passed on purpose)

import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax import quadrature
from raymanifold_jax.quadrature import Quadrature

SPHERE = 4 * np.pi
SETS = {
    "fibonacci(9)": quadrature.fibonacci(9),
    "fibonacci(50)": quadrature.fibonacci(50),
    "fibonacci(201)": quadrature.fibonacci(201),
    "light_ray_cube(1)": quadrature.light_ray_cube(1),
    "light_ray_cube(5)": quadrature.light_ray_cube(5),
    "product(2, 3)": quadrature.product(2, 3),
    "product(5, 8)": quadrature.product(5, 8),
    "product(8, 12)": quadrature.product(8, 12),
    "cube(2)": quadrature.cube(2),
    "cube(6)": quadrature.cube(6),
}
sets = pytest.mark.parametrize("directions", list(SETS.values()), ids=list(SETS))


def assert_exact_moments(directions: Quadrature):
    zeroth, first, second = directions.moments()
    assert zeroth == pytest.approx(SPHERE, rel=1e-14)
    np.testing.assert_allclose(first, 0, atol=1e-13)
    np.testing.assert_allclose(second, SPHERE / 3 * np.eye(3), rtol=1e-13, atol=1e-13)


@sets
def test_integrates_one_w_and_ww(directions):
    """1, w_i and w_i w_j are integrated to rounding with positive weights, which is 4 pi, 0 and 4 pi/3 (i = j)."""
    assert_exact_moments(directions)
    assert directions.weights.min() > 0
    np.testing.assert_allclose(np.linalg.norm(directions.directions, axis=1), 1, rtol=1e-14)


@sets
def test_offsets_are_spread_and_off_the_edges(directions):
    """No ray lattice starts on a voxel's edge; no two of a set are closer than 0.4 / sqrt(n), modulo 1.

    Random offsets would come as close as 0.5 / n.
    """
    offsets, n = directions.offsets, len(directions)
    assert offsets.shape == (n, 2)
    assert offsets.min() > 0 and offsets.max() < 1
    apart = (offsets[:, None] - offsets + 0.5) % 1 - 0.5
    assert (np.linalg.norm(apart, axis=-1) + np.eye(n)).min() > 0.4 / np.sqrt(n)


def test_the_correction_of_weights_is_small():
    """A Fibonacci sphere's weights differ from equal ones by 1 % at most for 100 directions, and less for more."""
    spread = [np.abs(quadrature.fibonacci(n).weights * n / SPHERE - 1).max() for n in (25, 100, 400)]
    assert spread[1] < 0.01
    assert spread[0] > spread[1] > spread[2] > 0


def test_small_fibonacci_sets_have_an_exact_sum():
    """Below nine directions the second moment cannot be met with positive weights: equal ones, and an exact sum."""
    for n in range(1, 9):
        directions = quadrature.fibonacci(n)
        assert len(directions) == n
        np.testing.assert_allclose(directions.weights, SPHERE / n, rtol=1e-15)


def test_fibonacci_converges_on_a_smooth_function():
    """The integral of exp(w_x), 4 pi sinh(1), is found to 1e-4 by 400 directions; 16 times as many gain 16 times."""
    exact = SPHERE * np.sinh(1)
    error = []
    for n in (400, 6400):
        directions = quadrature.fibonacci(n)
        error.append(abs(directions.weights @ np.exp(directions.directions[:, 0]) / exact - 1))
    assert error[0] < 1e-4
    assert error[1] < error[0] / 16 + 1e-13


def test_product_is_exact_for_polynomials():
    """Five polar nodes and eight azimuths are exact to degree 7: w_z^6 gives 4 pi/7, w_x^4 w_z^2 4 pi/35."""
    directions = quadrature.product(5, 8)
    x, _, z = directions.directions.T
    assert directions.weights @ z**6 == pytest.approx(SPHERE / 7, rel=1e-13)
    assert directions.weights @ (x**4 * z**2) == pytest.approx(SPHERE / 35, rel=1e-13)
    assert directions.weights @ (x**3 * z**4) == pytest.approx(0, abs=1e-13)


@pytest.mark.parametrize(("polar", "azimuthal"), [(2, 3), (4, 4), (6, 8), (4, 12), (3, 6), (8, 5)])
def test_product_keeps_off_coordinate_planes(polar, azimuthal):
    """No direction in a coordinate plane or on |x| = |y|, but for the equator of an odd number of polar nodes."""
    x, y, z = np.abs(quadrature.product(polar, azimuthal).directions.T)
    off_equator = z > 1e-12
    assert off_equator.sum() == azimuthal * (polar - polar % 2)
    assert min(x.min(), y.min(), np.abs(x - y).min()) > 1e-3


@pytest.mark.parametrize("m", [1, 2, 5, 8])
def test_light_ray_cube_counts(m):
    """24 M^2 + 2 points on the cube's surface: 602 for M = 5; each is a direction with integer slopes."""
    directions = quadrature.light_ray_cube(m)
    assert len(directions) == 24 * m**2 + 2 == (602 if m == 5 else 24 * m**2 + 2)
    points = directions.directions / np.abs(directions.directions).max(axis=1, keepdims=True) * m
    np.testing.assert_allclose(points, quadrature.cube_points(m), atol=1e-13)
    assert len(np.unique(quadrature.cube_points(m), axis=0)) == len(directions)
    assert np.all(np.abs(quadrature.cube_points(m)).max(axis=1) == m)


def test_light_ray_cube_weights_are_solid_angles():
    """A cell's solid angle is the integral of M / |x|^3 over it, here by 200^2 midpoints to 1e-5.

    A face point owns one square, an edge point half squares on two faces, a corner point quarters on three.
    """
    m = 5
    directions = quadrature.light_ray_cube(m)
    points = quadrature.cube_points(m)

    def solid_angle(u0, u1, v0, v1):
        u = u0 + (u1 - u0) * (np.arange(200) + 0.5) / 200
        v = v0 + (v1 - v0) * (np.arange(200) + 0.5) / 200
        r2 = u[:, None] ** 2 + v**2 + m**2
        return np.mean(m / r2**1.5) * (u1 - u0) * (v1 - v0)

    def weight(*point):
        return directions.weights[np.all(points == point, axis=1)].item()

    assert weight(0, 0, 5) == pytest.approx(solid_angle(-0.5, 0.5, -0.5, 0.5), rel=1e-5)
    assert weight(2, -5, 3) == pytest.approx(solid_angle(1.5, 2.5, 2.5, 3.5), rel=1e-5)
    assert weight(-5, 1, 5) == pytest.approx(2 * solid_angle(4.5, 5, 0.5, 1.5), rel=1e-5)
    assert weight(5, -5, 5) == pytest.approx(3 * solid_angle(4.5, 5, 4.5, 5), rel=1e-5)


def test_light_ray_cube_has_the_cubes_symmetry():
    """A quarter turn about any axis (four-fold) and a cycle of the axes carry points to ones of equal solid angle."""
    directions = quadrature.light_ray_cube(5)
    table = {tuple(p): w for p, w in zip(quadrature.cube_points(5).tolist(), directions.weights, strict=True)}
    quarter_turns = (lambda p, q, r: (-q, p, r), lambda p, q, r: (p, -r, q), lambda p, q, r: (r, q, -p))
    for turn in (*quarter_turns, lambda p, q, r: (q, r, p)):
        turned = [table[turn(*point)] for point in table]
        np.testing.assert_allclose(turned, list(table.values()), rtol=1e-12)
    # One sixth of the sphere for each face: cells across its rim counted with the part on this face.
    share = [w / (np.abs(p) == 5).sum() for p, w in table.items() if p[2] == 5]
    assert len(share) == 121
    assert sum(share) == pytest.approx(SPHERE / 6, rel=1e-13)


def test_rotate_turns_directions_only():
    """Directions turn by the matrix; weights and offsets stay; moments stay exact."""
    q, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))
    directions = quadrature.fibonacci(50)
    turned = directions.rotate(q)
    np.testing.assert_allclose(turned.directions[7], q @ directions.directions[7], rtol=1e-13, atol=1e-15)
    np.testing.assert_array_equal(turned.weights, directions.weights)
    np.testing.assert_array_equal(turned.offsets, directions.offsets)
    assert_exact_moments(turned)
    quarter = directions.rotate([[0, -1, 0], [1, 0, 0], [0, 0, 1]]).directions
    np.testing.assert_array_equal(quarter, directions.directions[:, [1, 0, 2]] * [-1, 1, 1])


@pytest.mark.parametrize("axes", [(), (0,), (2,), (0, 2), (0, 1, 2)])
@pytest.mark.parametrize("name", ["fibonacci(201)", "light_ray_cube(5)", "product(5, 8)", "cube(6)"])
def test_mirrored_sets_with_their_images_fill_the_sphere(name, axes):
    """The kept directions and all their images add up to 4 pi, also where w = 0 makes image and direction coincide."""
    directions = SETS[name]
    half = directions.mirrored(axes)
    assert np.all(half.directions[:, list(axes)] >= 0)
    images, weights = half.directions, half.weights
    for axis in axes:
        images = np.concatenate([images, images * np.where(np.arange(3) == axis, -1, 1)])
        weights = np.concatenate([weights, weights])
    assert weights.sum() == pytest.approx(SPHERE, rel=1e-14)
    flow = weights @ images
    np.testing.assert_allclose(flow[list(axes)], 0, atol=1e-13)
    if name in ("light_ray_cube(5)", "cube(6)"):  # the set is its own mirror image: little is changed by unfolding it
        assert_exact_moments(quadrature.from_directions(images, weights))
        for axis in axes:  # and the flux to each mirror is exact
            assert half.weights @ half.directions[:, axis] == pytest.approx(2 * np.pi * 0.5 ** len(axes), rel=1e-12)
        interior = np.all(half.directions[:, list(axes)] > 0, axis=1)
        kept = np.all(directions.directions[:, list(axes)] > 0, axis=1)
        np.testing.assert_allclose(half.weights[interior], directions.weights[kept], rtol=0.35)
        np.testing.assert_array_equal(half.offsets[interior], directions.offsets[kept])


def test_from_directions():
    """Directions of any length are scaled to 1 and weights to a sum of 4 pi, in the ratios given."""
    octahedron = np.concatenate([np.eye(3), -np.eye(3)]) * np.arange(1, 7)[:, None]
    assert_exact_moments(quadrature.from_directions(octahedron))
    weighted = quadrature.from_directions(octahedron, weights=[1, 2, 3, 1, 2, 3], offsets=np.full((6, 2), 0.25))
    np.testing.assert_allclose(weighted.weights, SPHERE / 12 * np.array([1, 2, 3, 1, 2, 3]), rtol=1e-14)
    np.testing.assert_array_equal(weighted.offsets, 0.25)


UP = [[0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: quadrature.fibonacci(0), ValueError, "n: got 0"),
        (lambda: quadrature.fibonacci(20.0), TypeError, "n: got 20.0"),
        (lambda: quadrature.light_ray_cube(0), ValueError, "half_width: got 0"),
        (lambda: quadrature.product(1, 8), ValueError, "polar: got 1"),
        (lambda: quadrature.product(4, 2), ValueError, "azimuthal: got 2"),
        (lambda: quadrature.from_directions([[0, 0, 0]]), ValueError, "directions: got a vector of length 0"),
        (lambda: quadrature.from_directions([0, 0, 1]), ValueError, "directions: got an array of shape"),
        (lambda: quadrature.from_directions([[0, 0, float("nan")]]), ValueError, "directions: got nan"),
        (lambda: quadrature.from_directions(np.zeros((0, 3))), ValueError, "directions"),
        (lambda: quadrature.from_directions(UP, weights=[0]), ValueError, r"weights: got 0 at index \(0,\)"),
        (lambda: quadrature.from_directions(UP, weights=[1, 2]), ValueError, "weights"),
        (lambda: Quadrature([[0, 0, 1.01]], [1.0]), ValueError, "directions"),
        (lambda: Quadrature(UP, [-1.0]), ValueError, "weights: got -1.0"),
        (lambda: Quadrature(UP, [1.0], [[0.0, 0.5]]), ValueError, "offsets"),
        (lambda: Quadrature(UP, [1.0], [[0.5, 1.0]]), ValueError, "offsets"),
        (lambda: Quadrature(UP, [1.0], [[0.5]]), ValueError, "offsets"),
        (lambda: Quadrature(UP, [1.0]).rotate(2 * np.eye(3)), ValueError, "matrix"),
        (lambda: Quadrature(UP, [1.0]).rotate(np.eye(2)), ValueError, "matrix"),
        (lambda: quadrature.fibonacci(9).mirrored((3,)), ValueError, r"axes: got \[3\]"),
        (lambda: Quadrature([[0, 0, -1.0]], [1.0]).mirrored((2,)), ValueError, r"axes: got \[2\]"),
    ],
)
def test_bad_input(make, error, message):
    """A bad set is refused by name and value, with the way out after a semicolon."""
    with pytest.raises(error, match=message + ".*, expected .*; "):
        make()


def test_cube_has_the_symmetry_of_a_cube():
    """Every quarter turn and reflection maps the set onto itself; no direction lies in a plane between mirror images."""
    directions = quadrature.cube(6)
    assert len(directions) == 216 and np.abs(directions.directions).min() > 0.05
    rows = lambda values, weights: sorted(map(tuple, np.round(np.column_stack([values, weights]), 9).tolist()))
    itself = rows(directions.directions, directions.weights)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    for matrix in (turn, np.roll(np.eye(3), 1, axis=0), np.diag([1, 1, -1])):
        assert rows(directions.directions @ matrix.T + 0.0, directions.weights) == itself
    with pytest.raises(ValueError, match=r"side: got 5, expected an even number"):
        quadrature.cube(5)


def test_for_scene_takes_the_cube_next_to_mirrors():
    """About as many directions as asked for, of the kind the module recommends."""
    lattice = rm.Lattice((4, 4, 4))
    assert quadrature.for_scene(rm.Scene(lattice)).name == "fibonacci(200)"
    mirrored = rm.Scene(lattice, boundary=rm.Boundary((rm.MIRROR, rm.OPEN)))
    assert quadrature.for_scene(mirrored).name == "cube(6)" and len(quadrature.for_scene(mirrored, 400)) == 384
