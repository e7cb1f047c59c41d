"""The sweep itself: what it carries, how it fades, where it turns.

Symmetries are exact by construction (rounding only); a sun through a homogeneous absorber is exact too; what depends on
directions or on CUT voxels says its error budget.
"""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

import raymanifold_jax as rm
from raymanifold_jax.layout import make_layout
from raymanifold_jax.operator import Light, make_transport, materials
from raymanifold_jax.surfaces import find_surfaces

DIRECTIONS = rm.quadrature.fibonacci(60)
# A quarter turn about each axis, right-handed.
QUARTER_TURNS = {
    "x": np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]),
    "y": np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    "z": np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]),
}


def solve(scene: rm.Scene, quadrature: rm.quadrature.Quadrature = DIRECTIONS, **options) -> rm.Solution:
    solution = rm.solve(scene, quadrature, progress=False, **options)
    assert solution.converged, solution.result
    for values in (solution.fluence, solution.surfaces.irradiance, solution.surfaces.radiosity):
        assert np.isfinite(values).all() and (np.asarray(values) >= 0).all()  # radiance is never negative
    return solution


# The operator


@pytest.fixture(scope="module")
def transport():
    """A ball in a closed box of fog, 8 voxels a side."""
    scene = problems.furnace("ball", 0.5, rm.Medium(scattering=1.0, absorption=0.5)).scene
    surfaces = find_surfaces(scene)
    extinction = materials(scene, surfaces).extinction
    return make_transport(make_layout(scene, surfaces), DIRECTIONS, extinction, 1), surfaces


def random_light(transport, seed: int) -> Light:
    elements, voxels = jax.random.split(jax.random.key(seed))
    shape = transport.coverage.shape
    return Light(jax.random.uniform(elements, (1, transport.layout.elements)), jax.random.uniform(voxels, (1, *shape)))


def test_operator_sends_nothing_from_nothing(transport):
    nothing = jax.tree.map(jnp.zeros_like, random_light(transport[0], 0))
    arriving = transport[0](nothing)
    assert float(arriving.largest()) == 0


def test_operator_is_linear(transport):
    # Error budget: sums of some hundred float32 terms of order 1.
    k, (a, b) = transport[0], (random_light(transport[0], seed) for seed in (1, 2))
    together = k(jax.tree.map(lambda x, y: 2 * x + 3 * y, a, b))
    apart = jax.tree.map(lambda x, y: 2 * x + 3 * y, k(a), k(b))
    for ours, theirs in zip(jax.tree.leaves(together), jax.tree.leaves(apart), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-6)


def test_operator_takes_means(transport):
    # Means of what is sent: between 0 and its largest, and 1 where everything sends 1.
    k, light = transport[0], random_light(transport[0], 3)
    for values in jax.tree.leaves(k(light)):
        assert (np.asarray(values) >= 0).all() and (np.asarray(values) <= 1 + 1e-5).all()
    ones = k(jax.tree.map(jnp.ones_like, light))
    np.testing.assert_allclose(ones.elements, 1.0, rtol=2e-6)
    np.testing.assert_allclose(np.asarray(ones.voxels)[0][np.asarray(k.coverage) > 0], 1.0, rtol=2e-6)


def test_every_element_and_free_voxel_is_reached(transport):
    # The rays of one direction cover every voxel evenly: the weights of a voxel without surfaces add up to 4 pi exactly.
    k, surfaces = transport
    assert (np.asarray(k.element_sums) > 0).all()
    wholly_free = ~surfaces.solid
    wholly_free[tuple(surfaces.voxel[surfaces.side < 0].T)] = False
    sums = np.asarray(k.coverage)
    np.testing.assert_allclose(sums[wholly_free], 4 * np.pi, rtol=1e-6)
    assert (sums[surfaces.solid] == 0).all() and (sums <= 4 * np.pi * (1 + 1e-6)).all()


# Beer-Lambert

DEPTHS = [1e-6, 1e-3, 0.1, 0.8, 1.0, 10.0, 80.0, 1e3]
# Thin, usual and thick by default; the rest take longer than they tell.
SOME = [d if d in (1e-6, 0.8, 1e3) else pytest.param(d, marks=pytest.mark.slow) for d in DEPTHS]
SUNS = {"straight": (0.0, 0.0, -1.0), "oblique": (-0.3, 0.2, -1.0)}


def floor_irradiance(problem: problems.Problem, normal=(0, 0, 1)) -> np.ndarray:
    """Irradiance on the floor, (nx, ny)."""
    surfaces = solve(problem.scene, rm.quadrature.fibonacci(12)).surfaces
    floor = (np.asarray(surfaces.normals) == normal).all(axis=1)
    return np.asarray(surfaces.irradiance)[floor].reshape(problem.scene.lattice.shape[:2])


def assert_fades(depth: float, sun: str, rtol: float, smallest: float) -> None:
    problem = problems.beer_lambert(depth, SUNS[sun])
    expected, lit = problem.expected
    assert lit.any() and lit.all() == (sun == "straight")
    irradiance = floor_irradiance(problem)[lit]
    if expected < smallest:
        assert (irradiance <= smallest).all()
    else:
        np.testing.assert_allclose(irradiance, expected, rtol=rtol)


@pytest.mark.parametrize("sun", SUNS)
@pytest.mark.parametrize("depth", SOME)
def test_beer_lambert(depth, sun):
    # E0 mu exp(-tau / mu) at any depth. Error budget: one rounding (6e-8) in each of up to 22 segments; the exponents' own
    # rounding adds up to 1e-7 of the depth. Below float32's smallest normal number, 0 will do.
    assert_fades(depth, sun, 1e-6 + 1e-7 * depth, smallest=1.2e-38)


def _thin_series_is_short(depth: float, sun: str) -> bool:
    # Segments with 0 < tau < 0.05 use a series for (1 - exp(-tau)) / tau that ends at tau^3: 2e-9 a segment at the most.
    return depth in (0.1, 0.8, 1.0) and not (sun == "straight" and depth == 0.8)


@pytest.mark.parametrize("sun", SUNS)
@pytest.mark.parametrize("depth", [d if d == 0.8 else pytest.param(d, marks=pytest.mark.slow) for d in DEPTHS])
def test_beer_lambert_in_64_bits(depth, sun, x64):
    assert_fades(depth, sun, 1e-8 if _thin_series_is_short(depth, sun) else 1e-12, smallest=1e-300)


# Geometry of the exchange


def test_cube_view_factors():
    # Error budget: 0.5 % of each factor, for 800 directions and 32 voxels a side.
    problem = problems.cube_view_factors()
    surfaces = solve(problem.scene, rm.quadrature.fibonacci(800)).surfaces
    power = np.asarray(surfaces.irradiance) * np.asarray(surfaces.areas)
    normal = np.round(np.asarray(surfaces.normals)).astype(int)
    received = {tuple(n): power[(normal == n).all(axis=1)].sum() for n in np.unique(normal, axis=0)}
    opposite, adjacent = problem.expected
    assert received[0, 0, 1] == 0  # a plane does not see itself
    np.testing.assert_allclose(received[0, 0, -1], opposite, rtol=0.005)
    for side in [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0)]:
        np.testing.assert_allclose(received[side], adjacent, rtol=0.005)


def test_ball_under_half_a_sky():
    # Error budget: rms 0.4 % of pi at a radius of 8 voxels with 602 directions, which resolve the sky's edge to 0.3 %.
    problem = problems.ball_under_half_sky()
    surfaces = solve(problem.scene, rm.quadrature.fibonacci(602)).surfaces
    error = (np.asarray(surfaces.irradiance) - problem.expected(np.asarray(surfaces.normals))) / np.pi
    assert np.sqrt(np.average(error**2, weights=surfaces.areas)) < 0.004
    assert abs(np.average(error, weights=surfaces.areas)) < 0.001


# Symmetries


def assert_turns_along(lattice: rm.Lattice, turn: np.ndarray, rtol: float, solved_to: float = 1e-4, **parts) -> None:
    """The solution of the turned scene in turned directions is the solution turned."""
    before = solve(problems.asymmetric(lattice, np.eye(3), **parts), rtol=solved_to)
    after = solve(problems.asymmetric(lattice, turn, **parts), DIRECTIONS.rotate(turn), rtol=solved_to)
    field = problems.turned_field(np.asarray(before.fluence), turn)
    assert field.shape == after.fluence.shape
    np.testing.assert_allclose(after.fluence, field, rtol=rtol, atol=rtol * field.max())
    ours, theirs = after.surfaces, before.surfaces
    turned = (np.asarray(theirs.positions) - np.array(lattice.shape) / 2) @ turn.T + np.array(field.shape) / 2
    in_order = [np.lexsort(np.round(np.column_stack([p, n]) * 1e3).T) for p, n in (
        (np.asarray(ours.positions), np.asarray(ours.normals)), (turned, np.asarray(theirs.normals) @ turn.T),
    )]  # fmt: skip
    mine, other = (np.asarray(s.radiosity)[order] for s, order in zip((ours, theirs), in_order, strict=True))
    np.testing.assert_allclose(mine, other, rtol=rtol, atol=rtol * other.max())


@pytest.mark.parametrize("axis", QUARTER_TURNS)
def test_quarter_turns_turn_the_solution(axis):
    # Solids, a medium that differs by octant, half a sky, walls. Error budget: float32 sums taken in another order, over
    # some tens of sweeps.
    assert_turns_along(rm.Lattice((10, 10, 10)), QUARTER_TURNS[axis], rtol=2e-5, sun=False)


@pytest.mark.slow
def test_axes_of_unequal_length_may_be_exchanged(x64):
    # x -> y -> z -> x on a lattice of 8 x 12 x 10 with everything in it, a sun too. Error budget: the points of an emitter's
    # patch do not turn with the scene, which leaves 2e-7 of the brightest; what is left of the iteration is below that.
    cyclic = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]])
    assert_turns_along(rm.Lattice((8, 12, 10)), cyclic, rtol=2e-6, solved_to=1e-12)


# Sides


@pytest.mark.parametrize(
    ("side", "width"),
    [(rm.PERIODIC, 1), *(pytest.param(side, n, marks=pytest.mark.slow) for side, n in ((rm.PERIODIC, 4), (rm.MIRROR, 1)))],
)
@pytest.mark.parametrize("row", [r for r in problems.table("closed_enclosures.csv") if "plates" in r["case"]])
def test_infinite_grey_plates(row, side, width):
    # Exact: each plate sees nothing but the other, whatever the directions. Error budget: rtol = 1e-5 of the iteration.
    first, second = float(row["rho_or_eps1"]), float(row["param"])
    problem = problems.grey_plates(first, second, side, width)
    assert problem.expected == pytest.approx(float(row["value"]), rel=1e-12)
    surfaces = solve(problem.scene, rtol=1e-5).surfaces
    net = np.asarray(surfaces.radiosity - surfaces.irradiance) * np.asarray(surfaces.normals)[:, 2]
    np.testing.assert_allclose(net, problem.expected, atol=3e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("emission", "rtol"), [(0.0, 2e-5), (0.1, 1e-3)])
def test_mirror_is_half_of_the_doubled_scene(emission, rtol):
    # Half a box with a ball, a medium and a half sky, mirrored at x = 0, against both halves together. Directions: half
    # of a set and its mirror image. Error budget: float32 rounding; emitters are cut into patches from each scene's middle.
    half = DIRECTIONS.mirrored((0,))
    flip = np.array([-1, 1, 1])
    both = rm.quadrature.Quadrature(
        np.concatenate([half.directions, half.directions * flip]), np.tile(half.weights, 2), np.tile(half.offsets, (2, 1))
    )
    ball = lambda x: rm.Solid(rm.Sphere((x, 4.3, 3.8), 1.6), 0.8, 2 * emission)
    medium = rm.Medium(scattering=0.05, absorption=0.02)
    lights = [rm.Sky(1.0, hemisphere=(0, 0.3, 1))]
    wall, y, z = rm.Wall(0.6), rm.Wall(0.4, emission), (rm.Wall(0.7), rm.OPEN)
    single = solve(
        rm.Scene(rm.Lattice((4, 8, 8)), [ball(2.2)], medium, lights, rm.Boundary((rm.MIRROR, wall), y, z)), both, rtol=1e-4
    )
    doubled = solve(
        rm.Scene(rm.Lattice((8, 8, 8), origin=(-4, 0, 0)), [ball(2.2), ball(-2.2)], medium, lights, rm.Boundary(wall, y, z)),
        both,
        rtol=1e-4,
    )
    np.testing.assert_allclose(doubled.fluence[:4][::-1], doubled.fluence[4:], rtol=2e-5)
    np.testing.assert_allclose(single.fluence, doubled.fluence[4:], rtol=rtol)


@pytest.mark.slow
def test_bands_are_separate_solves():
    # An RGB scene is three grey ones, to float32 rounding (1e-6 a sweep): the bands share geometry and the stopping rule only.
    albedo, scattering, sky = np.array([[0.2, 0.5, 0.8], [0.5, 2.0, 1.0], [1.0, 0.3, 2.0]])

    def scene(band):
        solids = [rm.Solid(problems.BALL, albedo[band], 0.1)]
        medium = rm.Medium(scattering[band], 0.5)
        return rm.Scene(problems.cube(8), solids, medium, [rm.Sky(sky[band])], problems.walls(albedo[band], 0.0, rm.OPEN))

    rgb = solve(scene(slice(None)), rtol=1e-5)
    assert rgb.fluence.shape == (8, 8, 8, 3) and rgb.surfaces.radiosity.shape == (len(rgb.surfaces.areas), 3)
    for band in range(3):
        grey = solve(scene(band), rtol=1e-5)
        assert grey.fluence.shape == (8, 8, 8) and grey.surfaces.radiosity.ndim == 1
        np.testing.assert_allclose(rgb.fluence[..., band], grey.fluence, rtol=5e-5)
        np.testing.assert_allclose(rgb.surfaces.radiosity[:, band], grey.surfaces.radiosity, rtol=5e-5)


@pytest.mark.slow
def test_thin_lattices_work():
    # A beam down a shaft of one voxel: 1 x 1 x n, along any axis.
    for axis, sign in itertools.product(range(3), (1, -1)):
        shape, direction = [1, 1, 1], np.zeros(3)
        shape[axis], direction[axis] = 5, -sign
        sides = [rm.Wall(0.0)] * 6
        sides[2 * axis + (sign > 0)] = rm.OPEN
        boundary = rm.Boundary(*(tuple(sides[2 * a : 2 * a + 2]) for a in range(3)))
        scene = rm.Scene(rm.Lattice(shape), lights=[rm.Sun(direction)], boundary=boundary)
        surfaces = solve(scene, rm.quadrature.fibonacci(12)).surfaces
        end = (np.asarray(surfaces.normals) == -direction).all(axis=1)
        np.testing.assert_allclose(np.asarray(surfaces.irradiance)[end], 1.0, rtol=1e-6)
        assert end.sum() == 1 and float(surfaces.irradiance[~end].max()) == 0
