"""Fits: known values found again, and what is said where they cannot be."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax.lattice import Lattice
from raymanifold_jax.texture import Texture, mean_values, value_at

QUADRATURE = rm.quadrature.fibonacci(30)
FLOOR = np.array([[x, y, 0.0] for x in (0.2, 0.7) for y in (0.3, 0.9)])
UP = np.tile([0.0, 0.0, 1.0], (len(FLOOR), 1))
TOP = rm.OrthographicCamera((0.5, 0.5, 1.0), (0, 0, -1), (0, 1, 0), 1.0, resolution=(8, 8))


def box(walls: Any = 0.5, floor: Any = 0.5) -> rm.Scene:
    side = rm.Wall(0.5)
    bottom = rm.Wall(floor)
    return rm.Scene(
        Lattice((6, 6, 6), 1 / 6), lights=[rm.Sky(2.0)], boundary=rm.Boundary(rm.Wall(walls), side, (bottom, rm.OPEN))
    )


def solved(scene):
    return rm.solve(scene, QUADRATURE, rtol=1e-5, progress=False)


NAMES = ["boundary.z[0].albedo", "boundary.x.albedo"]


def irradiances(solution, factor=1.0):
    values = factor * rm.irradiance(solution, FLOOR, UP, directions=64)
    return rm.IrradianceTarget(FLOOR, UP, values, directions=64)


@pytest.mark.slow
def test_albedos_from_a_picture_and_irradiances():
    # Without noise a fit is as good as its own solves, to rtol 1e-4 and in float32; here it found 5 digits.
    truth = solved(box(0.7, 0.3))
    picture = rm.PictureTarget(TOP, rm.render(truth, TOP, samples=1), samples=1)
    found = rm.fit(box(), [picture, irradiances(truth)], NAMES, QUADRATURE, rtol=1e-4, progress=False)
    assert found.converged, found.reason
    np.testing.assert_allclose([found.values[name] for name in NAMES], [0.3, 0.7], rtol=1e-3)
    assert found.uncertainty is not None
    assert max(float(found.uncertainty[name]) for name in NAMES) < 1e-3
    assert found.history[-1] < 1e-3 * found.history[0]
    assert not found.unseen


@pytest.mark.slow
def test_contradictory_targets_leave_a_residual():
    # Two meters that differ by 20 % agree on nothing better than the middle: each is left 10 % off.
    middle = [[0.5, 0.5, 0.5], [0.2, 0.8, 0.3]]
    truth = rm.fluence(solved(box()), middle, directions=0)
    targets = [rm.FluenceTarget(middle, factor * truth, directions=0) for factor in (0.9, 1.1)]
    found = rm.fit(box(0.6), targets, NAMES[1], QUADRATURE, progress=False)
    expected = 0.1 * np.sqrt(np.mean(np.square(targets[0].values / 0.9)))
    np.testing.assert_allclose(found.residual, expected, rtol=0.05)
    np.testing.assert_allclose(found.values[NAMES[1]], 0.5, atol=0.02)


@pytest.mark.slow
def test_what_no_target_sees_is_reported():
    # Half of the texture lies outside the box.
    floor = rm.Texture([[0.5], [0.5]], lower=(0, 0), upper=(2, 1))
    target = irradiances(solved(box(0.6)))
    with pytest.warns(UserWarning, match=r"no target depends on boundary.z\[0\].albedo in 1 of 2 entries"):
        found = rm.fit(box(0.5, floor), target, NAMES[0], QUADRATURE, progress=False, method="l-bfgs", max_evaluations=3)
    np.testing.assert_array_equal(found.unseen[NAMES[0]], [[False], [True]])
    assert found.values[NAMES[0]][1, 0] == 0.5
    assert found.reason


@pytest.mark.slow
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_floor_of_the_ring_scene_from_four_views(noise):
    # A 16 x 16 texture from four pictures of 32 x 32 pixels. Noise-free, 1 % rms is asked. With noise of 1 % of the mean
    # pixel a cell has some 7 pixels in all, fewer where the ring hides it: 1.1 % rms was found, and 2 % is asked.
    base = rm.scenes.ring(16)
    rng = np.random.default_rng(0)
    i, j = np.mgrid[:16, :16]
    truth = np.clip(np.where((i // 4 + j // 4) % 2, 0.8, 0.3) + 0.05 * rng.standard_normal((16, 16)), 0.05, 0.95)
    wall = base.boundary.x
    scene = lambda values: rm.Scene(
        base.lattice, base.solids, None, base.lights, rm.Boundary(wall, wall, (rm.Wall(rm.Texture(values)), rm.OPEN))
    )
    cameras = [camera for name, camera in rm.scenes.cameras("ring", base, (32, 32)).items() if name != "top"]
    solution = solved(scene(truth))
    pictures = [rm.render(solution, camera) for camera in cameras]
    sigma = noise * float(np.mean(pictures))
    targets = [
        rm.PictureTarget(c, p + sigma * rng.standard_normal(p.shape), 1 / sigma**2 if noise else 1.0)
        for c, p in zip(cameras, pictures, strict=True)
    ]
    start = scene(np.full((16, 16), 0.5))
    found = rm.fit(start, targets, NAMES[0], QUADRATURE, target_rms=1.0 if noise else 0.0, progress=False)
    values = found.values[NAMES[0]]
    assert values.min() >= 0
    assert values.max() <= 1
    assert np.sqrt(np.mean((values - truth) ** 2)) < (0.02 if noise else 0.01), found


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parameters": "solids[0].albedo"}, r"parameters: got 'solids\[0\].albedo', expected a value that the scene has"),
        ({"parameters": "boundary.x"}, "expected a value that can be fitted"),
        ({"parameters": "boundary..x"}, "expected a name of a value"),
        ({"parameters": []}, "parameters: got none"),
        ({"parameters": rm.Parameter(NAMES[1], lower=0.6)}, "expected a start within the bounds"),
        ({"parameters": rm.Parameter(NAMES[1], start=[0.5])}, "got one of start and expand"),
        ({"parameters": rm.Parameter(NAMES[1], start=[0.5], expand=lambda v: v)}, r"expand: got an array of shape \(1,\)"),
        ({"targets": []}, "targets: got none"),
        ({"targets": [3]}, r"targets\[0\]: got 3"),
        ({"targets": rm.FluenceTarget([[0.5, 0.5, 0.5]], [[1.0, 2.0]])}, "expected no band axis, as the scene"),
        ({"method": "newton"}, "method: got 'newton'"),
    ],
)
def test_bad_input_to_fit(change, message):
    usual = {"scene": box(), "targets": rm.FluenceTarget([[0.5, 0.5, 0.5]], [1.0]), "parameters": NAMES}
    with pytest.raises((ValueError, TypeError), match=message):
        rm.fit(**(usual | change))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rm.PictureTarget(TOP, np.zeros((8, 9))), r"picture: got an array of shape \(8, 9\), expected shape \(8, 8\)"),
        (lambda: rm.PictureTarget(TOP, np.full((8, 8), np.nan)), "picture: got nan"),
        (lambda: rm.PictureTarget(TOP, np.zeros((8, 8)), mask=np.zeros((8, 8), bool)), "expected some value that counts"),
        (lambda: rm.PictureTarget(TOP, np.zeros((8, 8)), weight=np.ones(3)), "expected a number, or what broadcasts"),
        (lambda: rm.FluenceTarget([[0.5, 0.5, 0.5]], [1.0, 2.0]), "one row for each point"),
        (lambda: rm.Texture([1.0]), r"expected shape \(nu, nv\)"),
        (lambda: rm.Texture([[1.0]], axis="w"), "axis: got 'w'"),
        (lambda: rm.Texture([[1.0]], lower=(0, 0), upper=(1, 0)), "upper: got"),
        (lambda: rm.Wall(rm.Texture([[1.5]])), "albedo.values: got 1.5"),
    ],
)
def test_bad_targets_and_textures(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_texture_lookups_and_means():
    # Cells of 0.5 x 0.25 on [0, 1]^2, seen along y: u is x and v is z. Points outside take the nearest cell.
    values = np.arange(8.0).reshape(2, 4) / 10
    texture, lattice = Texture(values, axis="y"), Lattice((4, 4, 4), 0.25)
    points = jnp.array([[0.1, 0.9, 0.1], [0.6, 0.0, 0.3], [0.9, 0.5, 5.0], [-1.0, 0.5, 0.6]])
    np.testing.assert_allclose(value_at(texture, lattice, points, 1)[:, 0], [0.0, 0.5, 0.7, 0.2], rtol=1e-6)
    across = np.array([[[0.1, 0, 0.2], [0.1, 0, 0.3]]])
    np.testing.assert_allclose(mean_values(texture, lattice, across, np.array([[3.0, 1.0]]), 1), [[0.025]], rtol=1e-6)


def test_a_texture_of_equal_values_is_that_value():
    # To rounding, in radiosities and in a picture.
    plain, textured = solved(box(0.5, 0.3)), solved(box(0.5, rm.Texture(np.full((3, 5), 0.3))))
    np.testing.assert_allclose(textured.surfaces.radiosity, plain.surfaces.radiosity, rtol=1e-5)
    np.testing.assert_allclose(rm.render(textured, TOP), rm.render(plain, TOP), rtol=1e-5)


@pytest.mark.slow
def test_values_that_expand_to_the_scenes():
    # One albedo for both walls along x, through a function: the same optimum as fitting the wall that stands on both sides.
    truth = solved(box(0.7, 0.5))
    lone = rm.Parameter(NAMES[1], start=[0.4], expand=lambda v: v[0])
    found = rm.fit(box(), irradiances(truth), lone, QUADRATURE, rtol=1e-4, progress=False)
    np.testing.assert_allclose(found.values[NAMES[1]], [0.7], rtol=2e-3)


@pytest.mark.slow
def test_a_fit_that_wants_to_leave_the_range_stays_in_it():
    # Readings ten times too bright for any albedo: walls end at 1 or below, finite, with a reason and a large residual.
    bright = irradiances(solved(box(0.9, 0.9)), factor=10.0)
    for method in ("gauss-newton", "l-bfgs"):
        found = rm.fit(box(), bright, NAMES, QUADRATURE, method=method, max_evaluations=8, progress=False)
        values = np.array([found.values[name] for name in NAMES])
        assert np.isfinite(values).all()
        assert ((values >= 0) & (values <= 1)).all()
        assert np.isfinite(found.history).all()
        assert found.reason
        assert found.history[-1] > 0.5 * float(np.sqrt(np.mean(bright.values**2)))
