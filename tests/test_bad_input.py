"""What cannot be solved or looked up is refused before any work: the value, what was expected, and the way out."""

import jax
import numpy as np
import problems
import pytest

import raymanifold_jax as rm

SCENE = rm.Scene(problems.cube(8), [rm.Solid(problems.BALL, 0.0, 1.0)], boundary=problems.walls(0.0, top=rm.OPEN))
UNEVEN = rm.quadrature.Quadrature([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]], [1.0, 1.0])


@pytest.mark.parametrize(
    ("scene", "options", "error", "message"),
    [
        (None, {}, TypeError, r"scene: got None.*expected Scene; make one with rm\.Scene"),
        (rm.Scene, {}, TypeError, r"scene: got the class Scene itself"),
        (problems.cube(8), {}, TypeError, r"scene: got .*Lattice"),
        (SCENE, {"quadrature": 200}, TypeError, r"quadrature: got 200.*expected Quadrature; use rm\.quadrature\.fibonacci"),
        (SCENE, {"quadrature": np.eye(3)}, TypeError, r"quadrature: got "),
        (SCENE, {"quadrature": UNEVEN}, ValueError, r"quadrature: got weights that add up to 2, expected 4 pi"),
        (SCENE, {"scheme": "characteristic"}, TypeError, r"scheme: got characteristic.*use rm\.Characteristic\(\)"),
        (SCENE, {"scheme": rm.Characteristic}, TypeError, r"scheme: got the class Characteristic itself"),
        (
            SCENE,
            {"solver": "gmres"},
            ValueError,
            r"solver: got 'gmres', expected rm\.Krylov\(\), rm\.Anderson\(\), .* or \"auto\"",
        ),
        (SCENE, {"solver": None}, ValueError, r"solver: got None"),
        (SCENE, {"mesh": 4}, TypeError, r"mesh: got 4 \(int\), expected Mesh"),
        (SCENE, {"max_sweeps": 0}, ValueError, r"max_sweeps: got 0, expected a whole number >= 1"),
        (SCENE, {"max_sweeps": -3}, ValueError, r"max_sweeps: got -3"),
        (SCENE, {"max_sweeps": 2.5}, TypeError, r"max_sweeps: got 2\.5, expected a whole number"),
        (SCENE, {"max_sweeps": True}, TypeError, r"max_sweeps: got True"),
    ],
)
def test_solve_refuses(scene, options, error, message):
    with pytest.raises(error, match=message):
        rm.solve(scene, **options)


@pytest.mark.parametrize(("solver", "name"), [(rm.Krylov, "restart"), (rm.Anderson, "history")])
def test_solvers_refuse(solver, name):
    with pytest.raises(ValueError, match=f"{name}: got 0, expected a whole number >= 1"):
        solver(**{name: 0})
    with pytest.raises(TypeError, match=f"{name}: got 2.5, expected a whole number"):
        solver(**{name: 2.5})


def scene_with(*lights, solid=None, sides=None):
    solids = [rm.Solid(rm.Sphere((1, 1, 1), 0.5))] + ([] if solid is None else [solid])
    return rm.Scene(rm.Lattice((8, 8, 8), 0.25), solids, lights=lights, boundary=sides or rm.Boundary())


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        (
            scene_with(rm.PointLight((1, 1, 1))),
            r"lights\[0\]: position: got \[1.*, 2 voxels inside a solid.*give it an emission",
        ),
        (
            scene_with(rm.Sky(), rm.PointLight((5, 1, 1))),
            r"lights\[1\]: position: got .*expected a point of the lattice.*rm\.Sun",
        ),
        (scene_with(rm.Sun((0, 0, -1)), sides=rm.Boundary(z=rm.Wall(0.5))), r"lights\[0\]: .*enters by \(z\+\); open one"),
        (scene_with(rm.Sun((0, 1, -1)), sides=rm.Boundary(rm.OPEN, rm.MIRROR, rm.PERIODIC)), r"enters by \(y-, z\+\)"),
        (
            scene_with(solid=rm.Solid(rm.Sphere((9, 9, 9), 0.5), 0.5, 1.0)),
            r"solids\[1\]: got an emitter \(Sphere\).*move it into",
        ),
        (
            scene_with(solid=rm.Solid(rm.Sphere((0.4, 0.4, 0.4), 0.01), 0.5, 1.0)),
            r"solids\[1\].*larger than 0\.25, or use rm\.Po",
        ),
    ],
)
def test_sources_without_light(scene, message):
    with pytest.raises(ValueError, match=message):
        rm.solve(scene)


@pytest.mark.parametrize("rtol", [0, -1e-3, 1, 1.5, np.nan, np.inf, 1e-7, "1e-4", None])
def test_rtol_out_of_range(rtol):
    with pytest.raises(ValueError, match=r"rtol: got .*expected a number from 1\.9e-06 \(what float32 can hold\) to 1"):
        rm.solve(SCENE, rtol=rtol)


def test_rtol_may_be_smaller_in_64_bits(x64):
    with pytest.raises(ValueError, match=r"rtol: got 1e-16, expected a number from 3\.6e-15 \(what float64 can hold\)"):
        rm.solve(SCENE, rtol=1e-16)


def test_light_that_goes_round_for_ever():
    # Nothing stops a ray in an empty lattice that is periodic along every axis.
    scene = rm.Scene(rm.Lattice((1, 1, 1)), boundary=rm.Boundary(rm.PERIODIC, rm.PERIODIC, rm.PERIODIC))
    with pytest.raises(ValueError, match=r"laps of a periodic axis.*close or open another side, or add absorption"):
        rm.solve(scene, rm.quadrature.fibonacci(12), progress=False)


@pytest.fixture(scope="module")
def solution():
    return rm.solve(SCENE, rm.quadrature.fibonacci(60), progress=False)


UP = [0.0, 0.0, 1.0]
ON_FLOOR = [0.1, 0.1, 0.0]
IN_BALL = list(problems.BALL.center)


@pytest.mark.parametrize(
    ("points", "normals", "message"),
    [
        (ON_FLOOR, UP, r"points: got an array of shape \(3,\), expected shape \(n, 3\); a single point p is \[p\]"),
        ([ON_FLOOR], UP, r"normals: got an array of shape \(3,\)"),
        ([ON_FLOOR] * 2, [UP], r"points and normals: got shapes \(2, 3\) and \(1, 3\)"),
        ([[0.1, 0.1]], [UP], r"points: got an array of shape \(1, 2\)"),
        ([[0.1, np.nan, 0.0]], [UP], r"points: got nan at index"),
        ([ON_FLOOR], [[0.0, 0.0, np.inf]], r"normals: got inf"),
        ([ON_FLOOR], [[0, 0, 0]], r"normals\[0\]: got .*expected a vector of non-zero length"),
        ([ON_FLOOR, IN_BALL], [UP, UP], r"points\[1\]: got .*voxels inside solids\[0\]"),
        ([ON_FLOOR, [0.1, 0.1, -3.0]], [UP, UP], r"points\[1\]: got .*expected a point of the lattice"),
    ],
)
def test_irradiance_refuses(solution, points, normals, message):
    with pytest.raises(ValueError, match=message):
        rm.irradiance(solution, points, normals)


@pytest.mark.parametrize(("directions", "error"), [(0, ValueError), (-1, ValueError), (10.5, TypeError), ("many", TypeError)])
def test_irradiance_refuses_directions(solution, directions, error):
    with pytest.raises(error, match="directions: got "):
        rm.irradiance(solution, [ON_FLOOR], [UP], directions=directions)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([0.1, 0.1, 0.1], r"points: got an array of shape \(3,\)"),
        ([[0.1, 0.1, 0.1], [0.1, 0.1, 1.5]], r"points\[1\]: got \[0\.1, 0\.1, 1\.5\], expected a point of the lattice"),
        ([IN_BALL], r"points\[0\]: got .*inside solids\[0\].*move it out"),
        ([[np.nan, 0, 0]], r"points: got nan"),
    ],
)
def test_fluence_refuses(solution, points, message):
    with pytest.raises(ValueError, match=message):
        rm.fluence(solution, points)


@pytest.mark.parametrize(
    ("origins", "directions", "message"),
    [
        ([0.1, 0.1, 0.1], [UP], r"origins: got an array of shape \(3,\)"),
        ([[0.1, 0.1, 0.1]], [[0, 0, 0]], r"directions\[0\]: .*non-zero length"),
        ([[0.1, 0.1, 0.1]], [UP, UP], r"origins and directions: got shapes"),
        ([IN_BALL], [UP], r"origins\[0\]: got .*inside solids\[0\]"),
    ],
)
def test_radiance_refuses(solution, origins, directions, message):
    with pytest.raises(ValueError, match=message):
        rm.radiance(solution, origins, directions)


@pytest.mark.parametrize(
    ("side", "message"),
    [
        ("top", r"side: got 'top', expected one of x-, x\+, y-, y\+, z-, z\+"),
        (5, r"side: got 5, expected one of"),
        ("x-", r"side: got x-, which is '?a Wall'?, expected an OPEN side"),
    ],
)
def test_outgoing_flux_refuses(solution, side, message):
    with pytest.raises(ValueError, match=message):
        rm.outgoing_flux(solution, side)


@pytest.mark.parametrize("look_up", [lambda s: rm.fluence(s, [[0.1] * 3]), lambda s: rm.radiance(s, [[0.1] * 3], [UP])])
def test_look_up_needs_a_solution(look_up):
    with pytest.raises((TypeError, AttributeError)):
        look_up(SCENE)


def test_render_refuses_a_camera_inside_a_solid(solution):
    camera = rm.PerspectiveCamera(IN_BALL, (2, 2, 2), resolution=(4, 4))
    with pytest.raises(ValueError, match=r"inside solids\[0\]"):
        rm.render(solution, camera)


def test_refusals_come_before_any_compilation(solution):
    # Nothing is traced on the way to an error, so that it costs no waiting.
    del solution
    with jax.no_tracing(), pytest.raises(ValueError, match="rtol"):
        rm.solve(SCENE, rtol=2.0)
