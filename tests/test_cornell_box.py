"""The Cornell box: published geometry, spectra and light, in bands."""

import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax.cornell_box import light_values
from raymanifold_jax.spectra import Bands
from raymanifold_jax.surfaces import find_surfaces


def test_areas_are_those_of_the_data():
    """Blocks by their published corners: tops and four sides above the floor; the lamp in the ceiling."""
    scene = rm.scenes.cornell_box(48)
    surfaces = find_surfaces(scene)
    area = np.bincount(surfaces.material, surfaces.area, len(scene.solids) + 6)
    short = np.array([[130, 65], [82, 225], [240, 272], [290, 114]]) / 1000
    tall = np.array([[423, 247], [265, 296], [314, 456], [472, 406]]) / 1000
    for number, (corners, height) in {2: (short, 0.165), 3: (tall, 0.330)}.items():
        edges = np.roll(corners, -1, 0) - corners
        top = 0.5 * abs(np.sum(corners[:, 0] * np.roll(corners[:, 1], -1) - corners[:, 1] * np.roll(corners[:, 0], -1)))
        expected = top + height * np.linalg.norm(edges, axis=1).sum()
        assert area[number] == pytest.approx(expected, rel=0.01)
    assert area[4] == pytest.approx(0.130 * 0.105, rel=0.01)


def test_bands_are_means_of_the_spectra():
    scene = rm.scenes.cornell_box(8, Bands(edges=[400, 500, 600, 700]))
    assert scene.bands == 3
    # The lamp's spectrum is linear between 0, 8, 15.6 and 18.4 at 400 to 700 nm.
    np.testing.assert_allclose(scene.solids[4].emission, [4.0, 11.8, 17.0], rtol=1e-4)
    np.testing.assert_allclose(light_values(Bands(edges=[400, 500, 600, 700])), [4.0, 11.8, 17.0], rtol=1e-4)
    red, green = np.asarray(scene.solids[0].albedo), np.asarray(scene.boundary.x[1].albedo)
    assert red[2] > 5 * red[1] and green[1] > 2 * green[2]


def test_bad_arguments():
    with pytest.raises(ValueError, match="n: got 3, expected"):
        rm.scenes.cornell_box(3)
    with pytest.raises(TypeError, match="bands"):
        rm.scenes.cornell_box(8, [400, 500])


@pytest.mark.slow
def test_eight_bands_have_the_colours_of_sixteen():
    """Colour differences (CIE 2000) of 8 x 8-pixel means in the lamp's light; white is the brightest of them without the lamp.

    Measured: median 0.9, largest 2.1; with 3 bands 3.4 and 5.1.
    """
    colour = pytest.importorskip("colour")
    xyz = {}
    for count in (3, 8, 16):
        bands = Bands(edges=np.linspace(400, 700, count + 1))
        solution = rm.solve(rm.scenes.cornell_box(16, bands), rm.quadrature.fibonacci(100), progress=False)
        camera = rm.scenes.cameras("cornell-box", solution.scene, (128, 128))["front"]
        means = np.asarray(rm.render(solution, camera, 1)).reshape(16, 8, 16, 8, count).mean((1, 3))
        xyz[count] = means @ bands.xyz_matrix(light_values(bands)).T
    bright = xyz[16][..., 1]
    seen = (bright > 0) & (bright < 2 * np.percentile(bright, 95))  # without frame and lamp, which is ten times as bright
    lab = {count: colour.XYZ_to_Lab(np.clip(v[seen] / bright[seen].max(), 0, None)) for count, v in xyz.items()}
    apart = {count: colour.difference.delta_E_CIE2000(lab[count], lab[16]) for count in (3, 8)}
    assert np.median(apart[8]) < 1.0 < 3.0 < np.median(apart[3]) < 4.0
    assert np.max(apart[8]) < 2.5 < np.max(apart[3])
