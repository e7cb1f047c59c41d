"""Scenes: bands, boundaries, skies, distances, what is a leaf, and refusal of what does not fit together."""

# pyright: reportArgumentType=false
# (bad input is passed on purpose)

import copy
import pickle
import re

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from raymanifold_jax.lattice import Lattice
from raymanifold_jax.scene import (
    MIRROR,
    OPEN,
    PERIODIC,
    Boundary,
    Medium,
    PointLight,
    Scene,
    Sky,
    Solid,
    Sun,
    Wall,
)
from raymanifold_jax.shapes import Box, HalfSpace, Sphere
from raymanifold_jax.skies import cie
from raymanifold_jax.texture import Texture

LATTICE = Lattice((2, 3, 4))
BALL = Sphere((1, 1, 1), 0.5)
NAN = float("nan")


def full_scene(bands: int | None = 3) -> Scene:
    radiance = 1.0 if bands is None else np.ones(bands)
    return Scene(
        LATTICE,
        solids=[Solid(BALL, albedo=0.9), Solid(Box((0, 0, 3), (2, 3, 4)), emission=2.0)],
        medium=Medium(scattering=np.ones((2, 3, 4)), absorption=0.1),
        lights=[Sky(radiance, hemisphere=(0, 0, 2)), Sun((3, 0, -4), 2.0), PointLight((1, 1, 2))],
        boundary=Boundary(x=Wall(0.9), y=PERIODIC, z=(Wall(0.2), OPEN)),
    )


def random_directions(n: int = 500) -> np.ndarray:
    directions = np.random.default_rng(0).normal(size=(n, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


@pytest.mark.parametrize(
    ("parts", "bands"),
    [
        ({}, None),
        ({"solids": [Solid(BALL)], "medium": Medium(1.0), "lights": [Sky(), Sun((0, 0, 1))]}, None),
        ({"medium": Medium(np.ones((2, 3, 4)))}, None),
        ({"lights": [Sky(np.ones((4, 8)))]}, None),
        ({"lights": [Sky(lambda w: w[:, 2] ** 2)]}, None),
        ({"solids": [Solid(BALL, albedo=[0.5])]}, 1),
        ({"solids": [Solid(BALL, emission=[1, 2, 3])]}, 3),
        ({"boundary": Boundary(y=(OPEN, Wall([0.1, 0.2])))}, 2),
        ({"medium": Medium(absorption=[1, 2, 3, 4])}, 4),
        ({"medium": Medium(emission=np.ones((2, 3, 4, 5)))}, 5),
        ({"lights": [Sky([1, 2, 3])]}, 3),
        ({"lights": [Sky(np.ones((4, 8, 3)))]}, 3),
        ({"lights": [Sky(lambda w: w**2)]}, 3),
        ({"lights": [Sun((0, 0, 1), np.ones(7))]}, 7),
        ({"lights": [PointLight((0, 0, 1), np.ones(7))]}, 7),
    ],
)
def test_bands(parts, bands):
    """The band axis of any one value gives the scene its bands; an axis of length 1 is one too."""
    scene = Scene(LATTICE, **parts)
    assert scene.banded == (bands is not None)
    assert scene.bands == (bands or 1)


@pytest.mark.parametrize(
    "parts",
    [
        {"solids": [Solid(BALL, [0.1, 0.2])], "lights": [Sky([1, 2, 3])]},
        {"medium": Medium(np.ones((2, 3, 4, 2)), absorption=[1, 2, 3])},
        {"lights": [Sky(lambda w: w**2), Sun((0, 0, 1), [1, 2])]},
        {"boundary": Boundary(x=Wall([0.5])), "lights": [PointLight((0, 0, 0), [1, 2])]},
    ],
)
def test_bands_that_disagree(parts):
    """Two lengths of band axes are an error that names both values."""
    with pytest.raises(ValueError, match=r"bands: got .*: \d, .*: \d, expected one number of bands"):
        Scene(LATTICE, **parts)


def test_medium_that_does_not_fit():
    """An array for another lattice is an error that gives both shapes."""
    for shape in ((4, 3, 2), (2, 3, 5, 3)):
        with pytest.raises(ValueError, match=r"medium.absorption: got an array of shape .*, expected \(2, 3, 4\)"):
            Scene(LATTICE, medium=Medium(absorption=np.ones(shape)))


def test_medium_coefficients_broadcast():
    """Entries of every rank line up with (nx, ny, nz, bands); extinction is scattering plus absorption."""
    field = np.arange(24.0).reshape(2, 3, 4)
    medium = Medium(scattering=field, absorption=[1, 2, 3])
    assert all(entry.ndim == 4 for entry in medium.coefficients())
    extinction = medium.extinction
    assert extinction.shape == (2, 3, 4, 3)
    np.testing.assert_allclose(extinction, field[..., None] + np.array([1, 2, 3]), rtol=1e-6)
    full = np.broadcast_to(field[..., None], (2, 3, 4, 3))
    np.testing.assert_allclose(Medium(full).coefficients()[0], full)


def test_boundary_sides():
    """One side stands for both of its axis, a pair is lower and upper; the order is x-, x+, y-, y+, z-, z+."""
    wall, floor = Wall(0.9), Wall(0.1)
    boundary = Boundary(x=wall, y=PERIODIC, z=[floor, OPEN])
    expected = (wall, wall, PERIODIC, PERIODIC, floor, OPEN)
    assert all(side is given for side, given in zip(boundary.sides, expected, strict=True))
    assert boundary.periodic == (False, True, False)
    assert Boundary().sides == (OPEN,) * 6
    assert Boundary(z=(PERIODIC, PERIODIC)).periodic == (False, False, True)


def test_sentinels_are_static_singletons():
    """OPEN, MIRROR and PERIODIC stay themselves through pickle, copy and tree operations, and have no leaves."""
    for side, name in ((OPEN, "OPEN"), (MIRROR, "MIRROR"), (PERIODIC, "PERIODIC")):
        assert pickle.loads(pickle.dumps(side)) is side
        assert copy.copy(side) is side and copy.deepcopy(side) is side
        assert jax.tree.leaves(side) == []
        assert jax.tree.map(lambda leaf: leaf, side) is side
        assert repr(side) == name
    assert len({OPEN, MIRROR, PERIODIC, OPEN}) == 3


def test_constant_sky():
    """A constant sky is the same along every direction, with or without bands."""
    np.testing.assert_array_equal(Sky(2.5).radiance_along(random_directions(5)), np.full(5, 2.5))
    np.testing.assert_array_equal(Sky([1, 2]).radiance_along(random_directions(5)), [[1, 2]] * 5)


def test_hemisphere():
    """Light from the half around `hemisphere` only: it travels down from above; exactly half at the horizon."""
    sky = Sky([1, 2], hemisphere=(0, 0, 3))
    np.testing.assert_array_equal(sky.radiance_along([[0, 0, -1], [0, 0, 1], [1, 0, 0]]), [[1, 2], [0, 0], [0.5, 1]])
    travel = random_directions()
    np.testing.assert_array_equal(Sky(1.0, hemisphere=(1, 2, 2)).radiance_along(travel), -travel @ [1, 2, 2] > 0)


def test_sky_function_is_asked_where_light_comes_from():
    """A function gets the directions towards the sky, the opposite of the directions of travel."""
    towards = Sky(lambda w: jnp.maximum(w, 0)).radiance_along([[0, 0, -1.0], [1, 0, 0]])
    np.testing.assert_array_equal(towards, [[0, 0, 1], [0, 0, 0]])


def test_sky_image_orientation():
    """Row 0 is the zenith, column 0 begins at +x, azimuth grows towards +y: pixel centres return their pixels."""
    height, width = 4, 8
    image = np.random.default_rng(0).uniform(size=(height, width, 2)).astype(np.float32)
    polar = np.pi * (np.arange(height) + 0.5)[:, None] / height
    azimuth = np.pi * (np.arange(width) + 0.5) / height
    towards = np.stack(
        np.broadcast_arrays(np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)), axis=-1
    )
    seen = Sky(image).radiance_along(-towards.reshape(-1, 3))
    np.testing.assert_allclose(seen, image.reshape(-1, 2), atol=2e-6)
    np.testing.assert_allclose(Sky(image[..., 0]).radiance_along(-towards.reshape(-1, 3)), seen[:, 0], atol=1e-7)


def test_sky_image_is_continuous():
    """Across the seam (azimuth 0) and the poles the interpolated image does not jump, and stays within its range."""
    image = np.random.default_rng(0).uniform(size=(4, 8))
    sky = Sky(image)
    step = 1e-4
    for polar in (0.3, 1.1, 2.0, 2.9):
        either = [[np.sin(polar), sign * step, np.cos(polar)] for sign in (-1, 1)]
        above, below = sky.radiance_along(-np.array(either))
        assert above == pytest.approx(float(below), abs=10 * step)
    for azimuth in (0.4, 2.0, 4.0):
        for pole in (-1, 1):
            either = [[s * step * np.cos(azimuth), s * step * np.sin(azimuth), pole] for s in (-1, 1)]
            here, across = sky.radiance_along(-np.array(either))
            assert here == pytest.approx(float(across), abs=10 * step)
    seen = sky.radiance_along(random_directions())
    assert image.min() - 1e-6 <= float(seen.min()) and float(seen.max()) <= image.max() + 1e-6


def test_sky_image_interpolates_linearly():
    """An image of the polar angle gives the polar angle back, between the first and the last row's centres."""
    height = 64
    polar = np.pi * (np.arange(height) + 0.5) / height
    sky = Sky(np.repeat(polar[:, None], 2 * height, axis=1))
    towards = random_directions()
    angle = np.arccos(towards[:, 2])
    between = (angle > polar[0]) & (angle < polar[-1])
    np.testing.assert_allclose(sky.radiance_along(-towards[between]), angle[between], atol=1e-5)


def test_sun_and_hemisphere_are_normalised():
    """Directions are kept at length 1."""
    np.testing.assert_allclose(Sun((3, 0, -4)).direction, [0.6, 0, -0.8], rtol=1e-15)
    np.testing.assert_array_equal(np.asarray(Sky(1.0, (0, 5, 0)).hemisphere), [0, 1, 0])


def test_distance_and_nearest_solid():
    """The union of the solids, and which of them is nearest; far away from everything, and -1, where there are none."""
    scene = full_scene()
    points = np.array([[1, 1, 1], [1, 1, 3.5], [1, 1, 2.75]])
    np.testing.assert_allclose(scene.distance(points), [-0.5, -0.5, 0.25], atol=1e-6)
    assert scene.solid_at(points).tolist() == [0, 1, 1]
    empty = Scene(Lattice((2, 2, 2), spacing=0.1))
    np.testing.assert_allclose(empty.distance(np.zeros((4, 5, 3))), np.full((4, 5), 1e8), rtol=1e-6)
    assert np.all(np.asarray(empty.solid_at(np.zeros((4, 5, 3)))) == -1)


def test_physical_numbers_are_float_leaves():
    """Physical numbers are JAX arrays of the default dtype, geometry is float64, and there are no other leaves."""
    leaves = jax.tree.leaves(full_scene())
    geometry = [leaf for leaf in leaves if isinstance(leaf, np.ndarray)]
    assert all(leaf.dtype == np.float64 for leaf in geometry)
    assert len(geometry) == 2 + 2 + 3  # sphere, box; hemisphere, direction, position
    physical = [leaf for leaf in leaves if not isinstance(leaf, np.ndarray)]
    assert all(isinstance(leaf, jax.Array) and leaf.dtype == jnp.zeros(0).dtype for leaf in physical)
    assert len(physical) == 4 + 3 + 3 + 4  # solids, medium, lights, walls (one Wall for both x sides is one Wall)


def test_scene_survives_tree_operations():
    """Gradients reach every physical number, with tracers in the constructors too, and values can be replaced."""
    gradient = jax.grad(lambda s: s.solids[0].albedo * s.lights[1].irradiance)(jax.tree.map(jnp.asarray, full_scene()))
    assert gradient.solids[0].albedo == 2.0
    assert gradient.lights[1].irradiance == pytest.approx(0.9)
    assert gradient.medium.scattering.shape == (2, 3, 4)

    def built_inside(albedo, radius, direction):
        sun = Sun(direction, albedo)
        scene = Scene(LATTICE, [Solid(Sphere((1, 1, 1), radius), albedo)], lights=[sun])
        return scene.solids[0].albedo * scene.distance(jnp.zeros(3)) + sun.direction[0]

    by_albedo, by_radius, by_direction = jax.jit(jax.grad(built_inside, (0, 1, 2)))(0.5, 0.25, jnp.array([0.0, 2.0, 0]))
    assert by_albedo == pytest.approx(np.sqrt(3) - 0.25, rel=1e-6)
    assert by_radius == -0.5
    np.testing.assert_allclose(by_direction, [0.5, 0, 0], atol=1e-7)
    brighter = eqx.tree_at(lambda s: s.lights[0].radiance, full_scene(), jnp.full(3, 2.0))
    np.testing.assert_array_equal(brighter.lights[0].radiance, [2, 2, 2])
    assert brighter.boundary.y is PERIODIC
    assert jax.device_get(full_scene()).bands == 3
    assert eqx.filter_eval_shape(lambda s: s, full_scene()).bands == 3
    assert eqx.tree_equal(pickle.loads(pickle.dumps(full_scene())), full_scene())


def test_a_sky_module_keeps_its_leaves():
    """A callable module is differentiated by its own parameters; a plain function is static."""

    class Gradient(eqx.Module):
        zenith: jax.Array

        def __call__(self, towards):
            return self.zenith * (1 + towards[:, 2])

    scene = Scene(LATTICE, lights=[Sky(Gradient(jnp.asarray(3.0)))])
    gradient = jax.grad(lambda s: s.lights[0].radiance_along(jnp.array([[0.0, 0, -1]]))[0])(scene)
    assert gradient.lights[0].radiance.zenith == 2.0
    assert jax.tree.leaves(Sky(lambda w: jnp.ones(len(w)))) == []


def test_lists_become_tuples():
    """Parts are kept in tuples, so that scenes compare and flatten alike however they were made."""
    assert jax.tree.structure(Scene(LATTICE, [Solid(BALL)], lights=[Sky()])) == jax.tree.structure(
        Scene(LATTICE, (Solid(BALL),), lights=(Sky(),))
    )


def test_summary():
    """One line that names the size, the parts and the sides."""
    summary = full_scene().summary()
    assert "\n" not in summary
    for word in ("2 x 3 x 4", "2 solids", "medium", "Sky + Sun + PointLight", "3 bands", "y periodic", "z wall/open"):
        assert word in summary
    assert "vacuum" in Scene(LATTICE).summary() and "bands" not in Scene(LATTICE).summary()


def test_notebooks_show_every_part():
    """One row a part, with its numbers; whatever a value is, it is shown, and nothing in it is taken for HTML."""
    html = full_scene()._repr_html_()
    rows = dict(re.findall(r"<tr><th[^>]*>(.*?)</th><td[^>]*>(.*?)</td></tr>", html))
    parts = ("solids[0]", "solids[1]", "medium", "lights[0]", "lights[1]", "lights[2]")
    assert list(rows) == ["lattice", *parts, "x-", "x+", "y-", "y+", "z-", "z+", "bands"]
    assert rows["lights[1]"] == "Sun: direction 0.6, 0, -0.8; irradiance 2"
    assert (rows["y-"], rows["z+"], rows["bands"]) == ("periodic", "open", "3") and rows["z-"].startswith("wall: albedo 0")
    lights = [Sky(lambda w: w[:, 2] ** 2), Sky(np.ones((4, 8))), PointLight((1, 1, 2)), Sky(cie(12, (0, 0, -1), 2))]
    floor = Wall(Texture(np.full((3, 5), 0.5)))
    html = Scene(
        LATTICE, [Solid(HalfSpace((0, 0, 1), (0, 0, 1)))], lights=lights, boundary=Boundary(z=(floor, OPEN))
    )._repr_html_()
    for text in (
        "a DirectionFunction",
        "1 to 1 (4 x 8 numbers)",
        "a texture of 15 numbers",
        "vacuum",
        "HalfSpace, (-inf",
        "CIE sky 12, zenith 2",
    ):
        assert text in html
    assert html.count("<tr>") == html.count("</td></tr>") == 13


@pytest.mark.parametrize(
    ("make", "error", "message"),
    [
        (lambda: Solid(BALL, 1.5), ValueError, "albedo: got 1.5"),
        (lambda: Solid(BALL, -0.1), ValueError, "albedo: got -0.1"),
        (lambda: Solid(BALL, NAN), ValueError, "albedo: got nan"),
        (lambda: Solid(BALL, [0.5, 2.0]), ValueError, r"albedo: got 2.0 at index \(1,\)"),
        (lambda: Solid(BALL, np.zeros((2, 2))), ValueError, "albedo: got an array of shape"),
        (lambda: Solid(BALL, []), ValueError, "albedo: got an array of shape"),
        (lambda: Solid(BALL, "white"), TypeError, "albedo: got white"),
        (lambda: Solid(BALL, True), TypeError, "albedo: got True"),
        (lambda: Solid(BALL, emission=-1), ValueError, "emission: got -1"),
        (lambda: Solid((0, 0, 0), 0.5), TypeError, "shape: got"),
        (lambda: Wall(1.01), ValueError, "albedo: got 1.01"),
        (lambda: Wall(emission=float("inf")), ValueError, "emission: got inf"),
        (lambda: Medium(scattering=-1), ValueError, "scattering: got -1"),
        (lambda: Medium(absorption=[0, NAN]), ValueError, "absorption: got nan"),
        (lambda: Medium(emission=np.ones((2, 2))), ValueError, "emission: got an array of shape"),
        (lambda: Sky(-1), ValueError, "radiance: got -1"),
        (lambda: Sky(np.ones((4, 7))), ValueError, "radiance: got an image of shape"),
        (lambda: Sky(np.ones((1, 2))), ValueError, "radiance: got an image of shape"),
        (lambda: Sky(np.ones((4, 8, 3, 1))), ValueError, "radiance: got an array of shape"),
        (lambda: Sky(lambda w: w[:, 2]), ValueError, "radiance of a direction: got"),
        (lambda: Sky(lambda w: jnp.ones(3)), ValueError, "radiance: got a function"),
        (lambda: Sky(lambda w: np.abs(np.asarray(w))), TypeError, "radiance: got"),
        (lambda: Sky(1.0, hemisphere=(0, 0, 0)), ValueError, "hemisphere"),
        (lambda: Sky().radiance_along([0, 0, 1]), ValueError, "directions: got an array of shape"),
        (lambda: Sun((0, 0, 0)), ValueError, r"direction: got \(0, 0, 0\)"),
        (lambda: Sun((0, NAN, 1)), ValueError, "direction: got nan"),
        (lambda: Sun((0, 0, 1), -2.0), ValueError, "irradiance: got -2.0"),
        (lambda: PointLight((0, 0)), ValueError, "position"),
        (lambda: PointLight((0, 0, 0), NAN), ValueError, "intensity: got nan"),
        (lambda: Boundary(x=(PERIODIC, OPEN)), ValueError, r"x: got \(PERIODIC, OPEN\)"),
        (lambda: Boundary(y=(OPEN, OPEN, OPEN)), ValueError, "y: got 3 sides"),
        (lambda: Boundary(z=Wall), TypeError, "z: got the class Wall itself"),
        (lambda: Boundary(z=0.9), TypeError, "z: got 0.9"),
        (lambda: Scene((8, 8, 8)), TypeError, "lattice: got"),
        (lambda: Scene(LATTICE, [BALL]), TypeError, r"solids\[0\]: got .*; wrap it: Solid\(Sphere"),
        (lambda: Scene(LATTICE, Solid(BALL)), TypeError, r"solids: got a Solid, .*; put it in a list"),
        (lambda: Scene(LATTICE, [Sky()]), TypeError, r"solids\[0\]: got .*; a Sky goes in lights"),
        (
            lambda: Scene(LATTICE, lights=[Sky(), Solid(BALL)]),
            TypeError,
            r"lights\[1\]: got .*; a Solid goes in solids",
        ),
        (lambda: Scene(LATTICE, lights=[Sun]), TypeError, r"lights\[0\]: got the class Sun itself"),
        (lambda: Scene(LATTICE, medium=0.5), TypeError, "medium: got 0.5"),
        (lambda: Scene(LATTICE, boundary=OPEN), TypeError, "boundary: got OPEN"),
    ],
)
def test_bad_input(make, error, message):
    """A bad part is refused by name and value, with the way out after a semicolon."""
    with pytest.raises(error, match=message) as raised:
        make()
    assert ", expected " in str(raised.value) and "; " in str(raised.value)
