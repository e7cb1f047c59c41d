"""Light at points and along rays, from solutions whose fields are known in closed form: nothing is solved here.

`stand_in` fills in irradiance and fluence by hand, so that a test sees the gathering alone.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax import gather
from raymanifold_jax.gather import light_field
from raymanifold_jax.interpolation import element_table, interpolate_irradiance, slopes
from raymanifold_jax.solution import Energy, Solution, _Hidden
from raymanifold_jax.surfaces import find_surfaces

N = 16
LATTICE = rm.Lattice((N, N, N), spacing=1 / N)
VOXEL = LATTICE.spacing
CENTER, RADIUS = np.array([0.5, 0.47, 0.52]), 0.25
BALL = rm.Sphere(CENTER, RADIUS)


def stand_in(scene: rm.Scene, irradiance: Any = 0.0, fluence: Any = 0.0) -> Solution:
    """A solution with this diffuse irradiance, a number, (C, 1) or a function of positions, and this diffuse fluence."""
    surfaces = find_surfaces(scene)
    bands, count = scene.bands, len(surfaces)
    values: Any = irradiance(surfaces.position) if callable(irradiance) else irradiance
    free = jnp.asarray(~surfaces.solid, float)
    light: Any = fluence(scene.lattice.centers()) if callable(fluence) else fluence
    field = jnp.broadcast_to(light, (bands, *free.shape)) * free
    owners: list[Any] = [*scene.solids, *(s if isinstance(s, rm.Wall) else None for s in scene.boundary.sides)]
    of = lambda name: jnp.stack([jnp.broadcast_to(getattr(o, name, 0.0), (bands,)) for o in owners], 1)[:, surfaces.material]
    return Solution(
        scene=scene,
        diffuse_irradiance=jnp.broadcast_to(jnp.asarray(values, float), (bands, count)),
        sun_irradiance=jnp.zeros((bands, count)),
        diffuse_fluence=field,
        sun_fluence=jnp.zeros_like(field),
        free=free,
        albedo=of("albedo"),
        emission=of("emission"),
        energy=Energy(*[jnp.zeros(())] * 5),
        error_bound=0.0,
        target=0.0,
        history=np.zeros(0),
        sweeps=0,
        ending="converged",
        solver="none",
        rounding=0.0,
        no_bound="",
        _hidden=_Hidden(surfaces),
    )


def on_ball(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    normals = np.random.default_rng(seed).normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return CENTER + RADIUS * normals, normals


def assert_close(value, expected, **tolerance):
    np.testing.assert_allclose(np.asarray(value), expected, **tolerance)


def closed(albedo: Any = 0.5, emission: Any = 0.0, top: Any = None) -> rm.Boundary:
    wall = rm.Wall(albedo, emission)
    return rm.Boundary(wall, wall, (wall, wall if top is None else top))


# Irradiance between the elements


def interpolated(scene: rm.Scene, function: Callable, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    surfaces = find_surfaces(scene)
    table = element_table(scene, surfaces)
    values = jnp.asarray(function(surfaces.position)[:, None], float)
    slope = slopes(scene, table, values)
    u = jnp.asarray(points / VOXEL, float)
    return np.asarray(interpolate_irradiance(scene, table, values, slope, u, jnp.asarray(normals, float)))[:, 0]


@pytest.mark.parametrize("tilt", [(0.0, 0.0, 1.0), (0.3, 0.4, 0.866)])
def test_linear_irradiance_on_a_plane_is_exact(tilt):
    """A wall on faces of voxels, up to its very edges, and an oblique plane a voxel away from them."""
    rng = np.random.default_rng(0)
    normal = np.array(tilt) / np.linalg.norm(tilt)
    points = rng.uniform(0, 1, (2000, 3))
    scene = rm.Scene(LATTICE, boundary=closed())
    if normal[2] == 1:
        points[:, 2] = 0
    else:
        middle = np.array([0.5, 0.5, 0.4])
        scene = rm.Scene(LATTICE, [rm.Solid(rm.HalfSpace(middle, normal))], boundary=closed())
        points -= ((points - middle) @ normal)[:, None] * normal
        points = points[(np.abs(points - 0.5) < 0.5 - 1.2 * VOXEL).all(1)]
    linear = lambda x: 1 + x[:, 0] - 0.5 * x[:, 1]
    # The slopes' ridge, 5e-4 of what a voxel spreads, costs about as much.
    assert_close(interpolated(scene, linear, points, np.tile(normal, (len(points), 1))), linear(points), rtol=1e-3)


def test_irradiance_on_a_ball_of_four_voxels():
    """E = 1.2 + n . v: within 1.6 % (rms 0.6 %) of exact at any point."""
    scene = rm.Scene(LATTICE, [rm.Solid(BALL)], boundary=closed())
    function = lambda x: 1.2 + (x - CENTER) / np.linalg.norm(x - CENTER, axis=-1, keepdims=True) @ [0.3, 0.2, 0.9]
    points, normals = on_ball(3000)
    error = interpolated(scene, function, points, normals) / 1.2 - function(points) / 1.2
    assert np.abs(error).max() < 0.016
    assert np.sqrt((error**2).mean()) < 0.006


def test_faces_do_not_mix_at_an_edge():
    """Floor and walls of different irradiance: each keeps its own up to the edge between them."""
    scene = rm.Scene(LATTICE, boundary=closed())
    step = lambda x: np.where(x[:, 2] < 1e-6, 2.0, 1.0)
    points = np.array([[1e-3, 0.4, 0.0], [0.0, 0.4, 1e-3]])
    assert_close(interpolated(scene, step, points, np.eye(3)[[2, 0]]), [2, 1], rtol=1e-4)


def test_periodic_neighbours_are_found():
    """A cosine of one period along a periodic x: as exact at the seam as in the middle."""
    scene = rm.Scene(LATTICE, boundary=rm.Boundary(rm.PERIODIC, rm.PERIODIC, (rm.Wall(), rm.OPEN)))
    wave = lambda x: 2 + np.cos(2 * np.pi * x[:, 0])
    x = np.linspace(0, 1, 400, endpoint=False)
    points = np.stack([x, 0 * x + 0.4, 0 * x], 1)
    error = np.abs(interpolated(scene, wave, points, np.tile([0, 0, 1.0], (400, 1))) - wave(points))
    seam = (x < VOXEL) | (x > 1 - VOXEL)
    assert error.max() < 0.02
    assert error[seam].max() < 1.2 * error.max()


# Radiance


@pytest.mark.parametrize("scattering", [0.0, 2.0])
def test_furnace_is_the_same_everywhere(scattering):
    """Uniform light of radiance L: whatever is in it, every ray sees L, if surfaces and medium lose nothing."""
    light = 1.7
    medium = rm.Medium(scattering) if scattering else None
    albedo = 0.4
    scene = rm.Scene(LATTICE, [rm.Solid(BALL, albedo, (1 - albedo) * light)], medium, boundary=closed(0.8, 0.2 * light))
    solution = stand_in(scene, np.pi * light, 4 * np.pi * light)
    origins = np.random.default_rng(0).uniform(0.02, 0.2, (3000, 3))
    directions = np.random.default_rng(1).normal(size=(3000, 3))
    assert_close(rm.radiance(solution, origins, directions), light, rtol=1e-5)
    assert_close(rm.irradiance(solution, *on_ball(20), directions=64), np.pi * light, rtol=1e-5)
    assert_close(rm.fluence(solution, origins[:40], directions=64), 4 * np.pi * light, rtol=1e-5)


def test_bands_and_materials():
    """Albedo and emission are those of what the ray hits, band by band; a value without bands holds for all."""
    scene = rm.Scene(LATTICE, [rm.Solid(BALL, albedo=[0.2, 0.4, 0.6])], boundary=closed(0.5, emission=[1.0, 2.0, 3.0]))
    solution = stand_in(scene, np.pi * np.array([[1.0], [10.0], [100.0]]))
    seen = rm.radiance(solution, [[0.5, 0.5, 0.95]] * 2, [[0, 0, -1], [0, 0, 3]])
    assert_close(seen, [[0.2, 4, 60], [1.5, 7, 53]], rtol=1e-5)


def test_sky_through_open_sides_and_past_the_lattice():
    """A ray sees the sky it travels towards, dimmed by the medium it crosses."""
    sky = rm.Sky(lambda w: 2 + w[:, 2])
    scene = rm.Scene(LATTICE, medium=rm.Medium(absorption=0.7), lights=[sky])
    seen = rm.radiance(stand_in(scene), [[0.5, 0.5, 0.4], [0.5, 0.5, -1], [5, 5, 5]], [[0, 0, 1], [0, 0, 1], [0, 0, -1]])
    assert_close(seen, [3 * np.exp(-0.42), 3 * np.exp(-0.7), 1], rtol=1e-5)


def test_half_plane_shadow_is_sharp():
    """A slab from x = 0.5 on, at heights 0.6 to 0.7, under a sun along (1, 0, -2): the beam past its lower edge lands at

        x = 0.5 + 0.6 / 2 = 0.8,

    where the shadow begins, to a hundredth of a voxel. Irradiance beside it is I |w_z|.
    """
    slab = rm.Solid(rm.Box((0.5, -1, 0.6), (3, 2, 0.7)), albedo=0.0)
    direction = np.array([1.0, 0, -2]) / np.sqrt(5)
    scene = rm.Scene(LATTICE, [slab], lights=[rm.Sun(direction, 3.0)], boundary=closed(0.5, top=rm.OPEN))
    x = np.array([0.8 - 0.01 * VOXEL, 0.8 + 0.01 * VOXEL, 0.6, 0.95])
    points = np.stack([x, 0 * x + 0.5, 0 * x], 1)
    above = np.array([0, 0, 0.01])
    lit = 3.0 * 2 / np.sqrt(5)
    up = np.tile([0, 0, 1.0], (4, 1))
    assert_close(rm.irradiance(stand_in(scene), points, up, directions=16), [lit, 0, lit, 0], atol=0.2 * lit)
    # As radiance, seen from just above, the sun alone is left: the slab is black and nothing else shines.
    seen = rm.radiance(stand_in(scene), points + above, -up)
    assert_close(seen, np.array([lit, 0, lit, 0]) * 0.5 / np.pi, rtol=1e-5, atol=1e-7)
    assert_close(rm.fluence(stand_in(scene), points + 1e-5 * above, directions=0), [3, 0, 3, 0], rtol=1e-5, atol=1e-7)


def test_sun_comes_in_by_open_sides_only_and_is_attenuated():
    """I exp(-s l) |w_z| at depth l on the floor; dark where the beam would have come through a wall."""
    direction = np.array([1.0, 0, -1]) / np.sqrt(2)
    medium = rm.Medium(absorption=2.0)
    scene = rm.Scene(LATTICE, medium=medium, lights=[rm.Sun(direction, 1.0)], boundary=closed(0.0, top=rm.OPEN))
    points = np.array([[0.999, 0.5, 0.2], [0.5, 0.5, 0.2]])
    assert_close(rm.fluence(stand_in(scene), points, directions=0), [np.exp(-2 * 0.8 * np.sqrt(2)), 0], rtol=1e-4)
    walls = rm.irradiance(stand_in(scene), [[1.0, 0.5, 0.2], [0.0, 0.5, 0.2]], [[-1, 0, 0], [1, 0, 0]], 16)
    assert_close(walls, [np.exp(-2 * 0.8 * np.sqrt(2)) / np.sqrt(2), 0], rtol=1e-3, atol=1e-6)


def test_sun_by_way_of_a_mirror():
    """A mirror at x = 1: a point gets the beam itself, and where x > z the beam that came in above and was reflected."""
    direction = np.array([1.0, 0, -1]) / np.sqrt(2)
    boundary = rm.Boundary(x=(rm.OPEN, rm.MIRROR), y=rm.OPEN, z=(rm.Wall(0.0), rm.OPEN))
    scene = rm.Scene(LATTICE, lights=[rm.Sun(direction, 1.0)], boundary=boundary)
    points = np.array([[0.7, 0.5, 0.01], [0.2, 0.5, 0.5]])
    assert_close(rm.fluence(stand_in(scene), points, directions=0), [2, 1], rtol=1e-5)
    across = rm.Scene(LATTICE, lights=[rm.Sun((0, 0, -1), 1.0)], boundary=boundary)
    assert_close(rm.fluence(stand_in(across), points, directions=0), [1, 1], rtol=1e-5)


def test_sun_round_a_periodic_side():
    """The slab's shadow falls on the floor of the next cell, which is this one."""
    slab = rm.Solid(rm.Box((0.6, -1, 0.4), (0.9, 2, 0.5)))
    boundary = rm.Boundary(rm.PERIODIC, rm.PERIODIC, (rm.Wall(0.5), rm.OPEN))
    direction = np.array([1.0, 0, -1]) / np.sqrt(2)
    scene = rm.Scene(LATTICE, [slab], lights=[rm.Sun(direction, 1.0)], boundary=boundary)
    # Shaded: from 0.6 + 0.4 to 0.9 + 0.5, less a period.
    x = np.array([0.03, 0.38, 0.43, 0.97])
    points = np.stack([x, 0 * x + 0.5, 0 * x + 1e-6], 1)
    assert_close(rm.fluence(stand_in(scene), points, directions=0), [0, 0, 1, 1], atol=1e-5)


def test_mirrors_reflect_what_an_eye_sees():
    """Through a mirror the far wall is seen, at the angle of reflection; between two, a lossless eye sees the floor at last."""
    wall = rm.Wall(0.5)
    boundary = rm.Boundary(x=(wall, rm.MIRROR), y=rm.MIRROR, z=wall)
    solution = stand_in(rm.Scene(LATTICE, boundary=boundary), lambda x: 1 + x[:, 1] + 2 * x[:, 2])
    seen = rm.radiance(solution, [[0.5, 0.5, 0.5]], [[1, 0.3, 0.1]])
    y, z = 0.5 + 0.45, 0.5 + 0.15
    assert_close(seen, 0.5 / np.pi * (1 + y + 2 * z), rtol=2e-3)
    seen = rm.radiance(solution, [[0.5, 0.5, 0.5]], [[0, 1, -0.1]])  # the floor after 5: y folds to 0.5 twice over
    assert_close(seen, 0.5 / np.pi * 1.5, rtol=2e-3)


# Irradiance by a final gather


def test_irradiance_under_half_a_sky():
    """A ball, black, in a sky whose upper half has radiance 1: E = pi (1 + n_z) / 2, by 1024 directions."""
    scene = rm.Scene(LATTICE, [rm.Solid(BALL, albedo=0.0)], lights=[rm.Sky(1.0, hemisphere=(0, 0, 1))])
    points, normals = on_ball(200)
    assert_close(rm.irradiance(stand_in(scene), points, normals), np.pi * (1 + normals[:, 2]) / 2, atol=0.006 * np.pi)


def test_small_lamp_and_point_light_are_exact():
    """Irradiance below a small square lamp, L A cos^2 / r^2 nearly, and below a point light, I cos / r^2."""
    lamp = rm.Solid(rm.Box((0.4375, 0.4375, 1), (0.5625, 0.5625, 1.1)), albedo=0.0, emission=7.0)
    scene = rm.Scene(LATTICE, [lamp], boundary=closed(0.0))
    # Two rectangles' corners: the form factor of a differential floor element to a parallel square of half-side a at height 1.
    a = 0.0625
    factor = 4 / (2 * np.pi) * 2 * a / np.sqrt(1 + a**2) * np.arctan(a / np.sqrt(1 + a**2))
    below = ([[0.5, 0.5, 0.0]], [[0, 0, 1.0]])
    assert_close(rm.irradiance(stand_in(scene), *below, directions=16), np.pi * 7 * factor, rtol=2e-3)
    point = rm.Scene(LATTICE, lights=[rm.PointLight((0.5, 0.5, 0.5), 3.0)], boundary=closed(0.0))
    points = [[0.5, 0.5, 0.0], [0.9, 0.5, 0.0]]
    expected = [3 / 0.25, 3 * 0.5 / (0.25 + 0.16) ** 1.5]
    assert_close(rm.irradiance(stand_in(point), points, [[0, 0, 2.0]] * 2, directions=16), expected, rtol=1e-3)


def test_points_a_little_off_the_surface_are_on_it():
    """Half a voxel inside a ball, or outside a wall, gives the irradiance of the surface."""
    scene = rm.Scene(LATTICE, [rm.Solid(BALL, 0.5)], boundary=closed(0.5, 0.25))
    points, normals = on_ball(10)
    solution = stand_in(scene, np.pi / 2)
    exact = rm.irradiance(solution, points, normals, directions=64)
    assert_close(rm.irradiance(solution, points - 0.4 * VOXEL * normals, normals, directions=64), exact, rtol=1e-3)
    on, below = rm.irradiance(solution, [[0.1, 0.1, 0], [0.1, 0.1, -0.4 * VOXEL]], [[0, 0, 1]] * 2, directions=64)
    assert_close(below, on, rtol=1e-5)


# Fluence, flux, pictures


def test_fluence_is_linear_between_centres_and_skips_solids():
    scene = rm.Scene(LATTICE, [rm.Solid(rm.HalfSpace((0.5, 0.5, 0.5), (0, 0, 1)))], boundary=closed())
    solution = stand_in(scene, fluence=lambda x: 3 + x[..., 0])
    points = np.random.default_rng(0).uniform((0.05, 0.05, 0.5), 0.95, (200, 3))
    assert_close(rm.fluence(solution, points, directions=0), 3 + points[:, 0], rtol=1e-5)


def test_outgoing_flux_lies_as_the_lattice_does():
    """Axes in increasing order, one value for each face, and none where a solid covers it."""
    lattice = rm.Lattice((3, 4, 5))
    post = rm.Solid(rm.Box((1, 0, -1), (2, 1, 6)))
    scene = rm.Scene(lattice, [post], boundary=rm.Boundary(rm.Wall(), rm.OPEN, rm.OPEN))
    solution = stand_in(scene, lambda x: x @ [1.0, 10.0, 100.0])
    flux = np.asarray(rm.outgoing_flux(solution, "z+"))
    x, y = np.meshgrid(np.arange(3) + 0.5, np.arange(4) + 0.5, indexing="ij")
    expected = x + 10 * y + 500
    expected[1, 0] = 0
    assert_close(flux, expected, rtol=1e-6)
    assert rm.outgoing_flux(solution, "y-").shape == (3, 5)


def test_render_is_the_mean_of_its_rays():
    """Row blocks, samples and bands are put together as the camera's rays lie."""
    scene = rm.Scene(LATTICE, [rm.Solid(BALL, [0.3, 0.6])], boundary=closed())
    solution = stand_in(scene, lambda x: 1 + x[:, 2])
    camera = rm.PerspectiveCamera((0.5, -1, 0.6), (0.5, 0.5, 0.5), resolution=(24, 16))
    done = []
    picture = rm.render(solution, camera, samples=4, progress=done.append)
    origins, directions = camera.rays(4)
    seen = rm.radiance(solution, origins.reshape(-1, 3), directions.reshape(-1, 3))
    assert picture.dtype == np.float32
    assert_close(picture, np.asarray(seen).reshape(16, 24, 4, 2).mean(2), rtol=1e-5)
    assert done[-1] == 1


def test_silhouettes_show_no_voxels():
    """A ball of four voxels against a black sky: its area in a picture is pi r^2 to a part in a thousand."""
    scene = rm.Scene(LATTICE, [rm.Solid(BALL, 0.0, emission=1.0)], boundary=rm.Boundary())
    camera = rm.OrthographicCamera((0.5, 0.5, 2), (0, 0, -1), (0, 1, 0), width=1, resolution=(128, 128))
    assert_close(rm.render(stand_in(scene), camera).mean(), np.pi * RADIUS**2, rtol=1e-3)


def test_light_field_is_made_once():
    solution = stand_in(rm.Scene(LATTICE, boundary=closed()))
    assert light_field(solution) is light_field(solution)


def test_sun_on_a_ball_that_stands_out_of_the_roof():
    """Outside the lattice there is no fog on the way to the sun: transmittance 1, not NaN."""
    scene = rm.Scene(
        LATTICE, [rm.Solid(rm.Sphere((0.5, 0.5, 1.0), 0.2))], rm.Medium(3.0, 0.1), [rm.Sun((0, 0, -1))],
        rm.Boundary(rm.Wall(), rm.Wall(), (rm.Wall(), rm.OPEN)),
    )  # fmt: skip
    above, below = jnp.array([[0.5, 0.5, 1.21]]), jnp.array([[0.5, 0.1, 0.5]])
    up = jnp.array([[0.0, 0.0, 1.0]])
    assert_close(gather._sunlit(scene, above, up, up), [[1]], rtol=1e-6)
    assert_close(gather._sunlit(scene, below, up, up), [[np.exp(-3.1 * 0.5)]], rtol=1e-5)
