"""Cameras look where they say, are not mirrored, and make the same rays whole or in parts."""

import jax
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax.camera import OrthographicCamera, PerspectiveCamera
from raymanifold_jax.lattice import Lattice

orthographic = OrthographicCamera((1, 2, 3), (1, -2, -3), (0, 0, 2), width=3, resolution=(6, 4))
perspective = PerspectiveCamera((4, -3, 5), (0, 0, 0), field_of_view=50, resolution=(6, 4))
cameras = pytest.mark.parametrize("camera", [orthographic, perspective], ids=["orthographic", "perspective"])


@cameras
def test_frame_is_orthonormal_and_right_handed(camera):
    right, upward, forward = camera.frame
    np.testing.assert_allclose(np.array(camera.frame) @ np.array(camera.frame).T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(np.cross(right, upward), -forward, atol=1e-15)
    assert upward @ camera.up > 0


def test_picture_is_not_mirrored():
    # Seen from -y towards +y with z up, x grows to the right and z to the top, that is towards row 0.
    origins, directions = OrthographicCamera((0, -5, 0), (0, 1, 0), (0, 0, 1), 4, resolution=(4, 4)).rays()
    np.testing.assert_allclose(origins[0, :, 0, 0], [-1.5, -0.5, 0.5, 1.5])
    np.testing.assert_allclose(origins[:, 0, 0, 2], [1.5, 0.5, -0.5, -1.5])
    np.testing.assert_array_equal(directions, np.broadcast_to([0.0, 1.0, 0.0], (4, 4, 1, 3)))
    _, directions = PerspectiveCamera((0, -5, 0), (0, 0, 0), resolution=(4, 4)).rays()
    assert (np.diff(directions[..., 0, 0], axis=1) > 0).all() and (np.diff(directions[..., 0, 2], axis=0) < 0).all()


def test_top_view_is_indexed_by_y_and_x():
    lattice = Lattice((8, 4, 2), spacing=0.5, origin=(-1, 2, 3))
    origins, directions = OrthographicCamera.top(lattice).rays()
    assert origins.shape == (4, 8, 1, 3)
    y, x = np.meshgrid(2 + 0.5 * (np.arange(4) + 0.5), -1 + 0.5 * (np.arange(8) + 0.5), indexing="ij")
    np.testing.assert_allclose(origins[..., 0, :], np.stack([x, y, np.full_like(x, 4)], -1), rtol=0, atol=1e-15)
    np.testing.assert_array_equal(directions[..., 0, :], np.broadcast_to([0.0, 0.0, -1.0], (4, 8, 3)))


@cameras
def test_row0_only_reverses_the_rows(camera):
    geometry = {name: getattr(camera, name) for name in camera.__dataclass_fields__}
    lower = type(camera)(**geometry | {"row0": "lower"})
    for ours, theirs in zip(camera.rays(4), lower.rays(4), strict=True):
        np.testing.assert_array_equal(ours, theirs[::-1])


def test_perspective_angles():
    # The middle of the top edge lies half the field of view above the axis; a 2:1 picture has square pixels.
    camera = PerspectiveCamera((0, 0, 0), (0, 1, 0), field_of_view=60, resolution=(200, 100))
    origins, directions = camera.rays(1)
    assert not origins.any()
    np.testing.assert_allclose(np.linalg.norm(directions, axis=-1), 1, rtol=1e-15)
    slopes = directions[..., 0, :] / directions[..., 0, 1:2]
    np.testing.assert_allclose(slopes[0, 0, 2], np.tan(np.pi / 6) * 0.99)
    np.testing.assert_allclose(slopes[0, 1, 0] - slopes[0, 0, 0], slopes[0, 0, 2] - slopes[1, 0, 2])


@cameras
def test_rows_are_parts_of_the_whole(camera):
    for i, whole in enumerate(camera.rays(4)):
        assert whole.dtype == np.float64 and whole.shape == (4, 6, 4, 3)
        parts = [camera.rays(4, rows=(start, stop))[i] for start, stop in ((0, 1), (1, 3), (3, 4))]
        np.testing.assert_array_equal(np.concatenate(parts), whole)


@pytest.mark.parametrize("k", [1, 2, 3, 4])
def test_samples_are_stratified(k):
    camera = OrthographicCamera((0, 0, 0), (0, 0, -1), (0, 1, 0), 1, resolution=(1, 1))
    xy = camera.rays(k * k)[0][0, 0, :, :2]
    np.testing.assert_allclose(xy.mean(axis=0), 0, atol=1e-15)
    for column in xy.T:  # one sample in each of the k² rows, and columns
        np.testing.assert_array_equal(np.sort(np.floor((column + 0.5) * k * k)), np.arange(k * k))
    assert len({tuple(cell) for cell in np.floor((xy + 0.5) * k).astype(int)}) == k * k
    if k == 2:
        assert {tuple(p) for p in xy * 8} == {(-3, 1), (-1, -3), (1, 3), (3, -1)}


def test_cameras_are_static():
    assert jax.tree.leaves(orthographic) == []
    assert hash(perspective) == hash(PerspectiveCamera((4, -3, 5), [0, 0, 0], field_of_view=50.0, resolution=(6, 4)))
    with pytest.raises(TypeError, match="outside jit"):
        jax.jit(lambda x: PerspectiveCamera((x, 0, 0), (1, 0, 0)).rays()[0])(1.0)


flat = {"center": (0, 0, 0), "direction": (0, 0, -1), "up": (0, 1, 0), "width": 1}
eye = {"position": (0, 0, 1), "target": (1, 0, 0)}
bad_cameras = [
    (OrthographicCamera, flat | {"direction": (0, 0, 0)}, ValueError, "direction.*non-zero length"),
    (OrthographicCamera, flat | {"direction": (0, np.nan, 0)}, ValueError, "direction.*nan"),
    (OrthographicCamera, flat | {"center": (0, 0)}, ValueError, "center"),
    (OrthographicCamera, flat | {"up": (0, 0, 3)}, ValueError, r"up: got \(0, 0, 3\).*not along direction"),
    (OrthographicCamera, flat | {"up": (0, 0, 0)}, ValueError, "up"),
    (OrthographicCamera, flat | {"width": 0}, ValueError, "width"),
    (OrthographicCamera, flat | {"height": -1.0}, ValueError, "height"),
    (OrthographicCamera, flat | {"width": np.nan}, ValueError, "width"),
    (OrthographicCamera, flat | {"resolution": (0, 4)}, ValueError, r"resolution\[0\]"),
    (OrthographicCamera, flat | {"resolution": (4, 4.5)}, TypeError, r"resolution\[1\]"),
    (OrthographicCamera, flat | {"resolution": 64}, ValueError, "resolution"),
    (OrthographicCamera, flat | {"row0": "bottom"}, ValueError, "row0: got bottom"),
    (PerspectiveCamera, eye | {"target": (0, 0, 1)}, ValueError, "target.*away from position"),
    (PerspectiveCamera, eye | {"target": (0, 0, -1)}, ValueError, "up"),
    (PerspectiveCamera, eye | {"field_of_view": 180}, ValueError, "field_of_view: got 180"),
    (PerspectiveCamera, eye | {"field_of_view": 0}, ValueError, "field_of_view"),
    (PerspectiveCamera, eye | {"position": (0, np.inf, 0)}, ValueError, "position"),
]


@pytest.mark.parametrize("camera, options, error, message", bad_cameras)
def test_bad_cameras(camera, options, error, message):
    with pytest.raises(error, match=message):
        camera(**options)


@pytest.mark.parametrize("rows", [(0, 0), (-1, 2), (2, 5), (3,), "ab", 2])
def test_bad_rows(rows):
    with pytest.raises(ValueError, match="rows"):
        perspective.rays(rows=rows)


@pytest.mark.parametrize("samples, error", [(0, ValueError), (2, ValueError), (1.0, TypeError)])
def test_bad_samples(samples, error):
    with pytest.raises(error, match="samples"):
        perspective.rays(samples)


def test_layers_of_a_ball():
    """Depth, normal and albedo of a ball seen along y are those of the sphere; 0 where the ray goes through an open side."""
    ball, wall = rm.Solid(rm.Sphere((4, 4, 4), 2.5), albedo=0.3), rm.Wall(0.8)
    scene = rm.Scene(rm.Lattice((8, 8, 8)), [ball], lights=[rm.Sky(1.0)], boundary=rm.Boundary(wall, rm.OPEN, wall))
    solution = rm.solve(scene, rm.quadrature.fibonacci(40), progress=False)
    camera = rm.OrthographicCamera((4, -3, 4), (0, 1, 0), (0, 0, 1), width=8, resolution=(16, 16))
    layers = rm.render_layers(solution, camera)
    x, z = np.meshgrid((np.arange(16) + 0.5) / 2 - 4, 4 - (np.arange(16) + 0.5) / 2)
    on = np.hypot(x, z) < 2.4
    y = -np.sqrt(np.maximum(2.5**2 - x**2 - z**2, 0))
    np.testing.assert_allclose(layers["depth"][on], (7 + y)[on], atol=2e-3)
    np.testing.assert_allclose(layers["normal"][on], np.stack([x, y, z], -1)[on] / 2.5, atol=5e-3)
    np.testing.assert_allclose(layers["albedo"][on], 0.3, rtol=1e-6)
    off = np.hypot(x, z) > 2.6
    assert all(np.all(layers[name][off] == 0) for name in layers)
    # Of the light that leaves, without a medium, irradiance tells all.
    picture = rm.render(solution, camera, 1)
    np.testing.assert_allclose(picture[on], (0.3 / np.pi * layers["irradiance"])[on], rtol=1e-5)
