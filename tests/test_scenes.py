"""The ready-made scenes are what their sources say, and their views show them whole, upright and from outside solids."""

import os
from pathlib import Path

import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax import OPEN, Lattice, OrthographicCamera, Sun, Wall, memory, scenes

names = pytest.mark.parametrize("name", scenes.SCENES)
UNIT = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)


in_unit_cube = pytest.mark.parametrize("name", ["ring", "three-balls", "room"])


@in_unit_cube
def test_fills_the_unit_cube_at_any_size(name):
    for n in (4, 7, 8):
        lattice = scenes.SCENES[name].build(n).lattice
        assert lattice.shape == (n, n, n)
        np.testing.assert_allclose(lattice.upper, 1, rtol=1e-15)
        np.testing.assert_array_equal(lattice.lower, 0)


@names
@pytest.mark.parametrize("n, error", [(3, ValueError), (-1, ValueError), (8.5, TypeError), ("8", TypeError)])
def test_bad_sizes(name, n, error):
    with pytest.raises(error, match="n: got"):
        scenes.SCENES[name].build(n)


def test_ring_floats_in_its_open_box():
    scene = scenes.ring(8)
    assert all(isinstance(side, Wall) and float(side.albedo) == np.float32(0.9) for side in scene.boundary.sides[:5])
    assert scene.boundary.sides[5] is OPEN and scene.medium is None
    lower, upper = scene.solids[0].shape.bounds()
    assert (lower > 0).all() and (upper < 1).all()


def test_three_balls_are_the_reference():
    scene = scenes.three_balls_in_fog(8)
    # On each ball's surface, at its top, the distance is 0; fog and sun as stated.
    tops = np.array([[0.3, 0.35, 0.87], [0.65, 0.3, 0.62], [0.5, 0.7, 0.37]])
    np.testing.assert_allclose(scene.distance(tops), 0, atol=1e-6)
    assert scene.medium is not None
    np.testing.assert_allclose([float(scene.medium.scattering), float(scene.medium.absorption)], [3, 0.3], rtol=1e-6)
    (sun,) = scene.lights
    assert isinstance(sun, Sun)
    np.testing.assert_allclose(sun.direction, np.array([0.2, 0.1, -1]) / np.sqrt(1.05), rtol=1e-15)
    assert sun.irradiance == 3


@pytest.mark.parametrize("black", [False, True])
def test_room_light_is_flush_with_the_ceiling(black):
    scene = scenes.room(16, black_light=black)
    block, light = scene.solids
    below = np.array([[0.5, 0.5, 1 - 1e-3], [0.376, 0.624, 1 - 1e-3]])
    np.testing.assert_allclose(light.shape.distance(below), 1e-3, atol=1e-6)
    assert float(light.emission) == 1 and float(light.albedo) == (0 if black else 0.75)
    np.testing.assert_array_equal(block.shape.bounds(), [[0.25, 0.25, 0], [0.5, 0.5, 0.5]])
    assert all(isinstance(side, Wall) for side in scene.boundary.sides) and not scene.lights
    with pytest.raises(TypeError, match="black_light: got"):
        scenes.room(16, black_light="yes")  # pyright: ignore[reportArgumentType]


@pytest.mark.parametrize("name", ["ring", "RING", "three-balls", "three_balls", "three_balls_in_fog", "room"])
def test_names(name):
    assert scenes.find(name).name == scenes.find(name.lower()).name in scenes.SCENES


def test_unknown_names():
    with pytest.raises(
        ValueError, match=r"'rign', expected one of ring, three-balls, room, cornell-box; did you mean 'ring'\?"
    ):
        scenes.find("rign")
    with pytest.raises(ValueError, match="three-balls'\\?"):
        scenes.find("3balls_in_fog")
    with pytest.raises(ValueError, match="pass one of these names"):
        scenes.find("")
    with pytest.raises(TypeError, match="scene: got"):
        scenes.find(3)  # pyright: ignore[reportArgumentType]


@names
@pytest.mark.parametrize("resolution", [(64, 64), (96, 32), (32, 96)])
def test_views_show_the_whole_scene_upright(name, resolution):
    scene = scenes.SCENES[name].build(8)
    views = scenes.cameras(name, scene, resolution)
    lattice = scene.lattice
    # The Cornell box's lattice goes on behind its red and back walls.
    corners = np.clip(lattice.lower + UNIT * lattice.extent, 0, [np.inf, 0.5592, np.inf] if name == "cornell-box" else np.inf)
    assert list(views) == list(scenes.SCENES[name].views)
    for camera in views.values():
        assert camera.row0 == "upper" and camera.resolution == resolution
        origins, directions = (ray[:, :, 0] for ray in camera.rays())
        right, upward, forward = camera.frame
        # Where the box's corners appear, in the coordinates the rays of the picture's edge span.
        if isinstance(camera, OrthographicCamera):
            edge = [(origins - camera.center) @ axis for axis in (right, upward)]
            seen = [(corners - camera.center) @ axis for axis in (right, upward)]
            eye, slack = np.array(camera.center), 0.02  # the rays go through the middles of pixels
        else:
            eye, slack = origins[0, 0], 0.02
            edge = [(directions @ axis) / (directions @ forward) for axis in (right, upward)]
            seen = [((corners - eye) @ axis) / ((corners - eye) @ forward) for axis in (right, upward)]
        for shown, needed in zip(edge, seen, strict=True):
            assert shown.min() - slack <= needed.min() and needed.max() <= shown.max() + slack
        pixel = edge[0][0, 1] - edge[0][0, 0], edge[1][0, 0] - edge[1][1, 0]
        np.testing.assert_allclose(*pixel, rtol=1e-9)
        assert float(scene.distance(eye)) > 0


def test_ring_is_seen_from_four_sides():
    views = scenes.cameras("ring", scenes.ring(8))
    forward = {name: camera.frame.forward for name, camera in views.items()}
    for side, towards in {"south": [0, 1], "north": [0, -1], "east": [-1, 0], "west": [1, 0]}.items():
        horizontal = forward[side][:2] / np.linalg.norm(forward[side][:2])
        np.testing.assert_allclose(horizontal, towards, atol=1e-12)
        np.testing.assert_allclose(forward[side][2], -np.sin(np.radians(50)), rtol=1e-12)


@pytest.mark.parametrize("resolution", [(0, 5), (5,), 5, (5, -1)])
def test_bad_resolutions(resolution):
    with pytest.raises(ValueError, match="resolution"):
        scenes.cameras("room", scenes.room(8), resolution)


def test_memory_is_estimated_and_checked(monkeypatch):
    shape = (128, 128, 128)
    vacuum = memory.estimate_memory(shape, 1, 200, medium=False)
    assert vacuum < memory.estimate_memory(shape, 3, 200, medium=False)
    assert memory.estimate_memory(shape, 1, 200, medium=True) < memory.estimate_memory(shape, 3, 200, True)
    monkeypatch.setattr(memory, "available_memory", lambda: vacuum)
    memory.check_memory(shape, 1, 200, medium=False)
    with pytest.raises(ValueError, match=r"size: got 129 x 128 x 128 .* at most the .* available; 12\d voxels"):
        memory.check_memory((129, 128, 128), 1, 200, medium=False)
    monkeypatch.setattr(memory, "available_memory", lambda: 1000)
    with pytest.raises(ValueError, match="free some memory"):
        memory.check_memory(shape, 1, 200, medium=False)
    monkeypatch.setattr(memory, "available_memory", lambda: None)
    memory.check_memory((10**6, 10**6, 10**6), 1, 200, medium=False)


def test_suggested_size_fits(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 2_000_000_000)
    with pytest.raises(ValueError) as caught:
        memory.check_memory((2048, 2048, 2048), 1, 200, medium=True)
    side = int(str(caught.value).split("; ")[1].split()[0])
    memory.check_memory((side, side, side), 1, 200, medium=True)
    with pytest.raises(ValueError, match="size: got"):
        memory.check_memory((side + 1, side + 1, side + 1), 1, 200, medium=True)


@pytest.mark.skipif(memory._trim() is None, reason="glibc")
def test_freed_memory_is_given_back():
    resident = lambda: int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    blocks = [np.ones(100_000, np.uint8) for _ in range(2000)]
    del blocks[::2]  # every other one: what lies between those in use stays with the process
    before = resident()
    memory.give_back_freed(memory.LARGE - 1)
    assert resident() > before - 10_000_000
    memory.give_back_freed(memory.LARGE)
    assert resident() < before - 60_000_000


@pytest.mark.parametrize("version", [1, 2])
def test_control_groups_limit_memory(tmp_path, version):
    top = tmp_path if version == 2 else tmp_path / "memory"
    limit, usage = ("memory.max", "memory.current") if version == 2 else ("memory.limit_in_bytes", "memory.usage_in_bytes")
    group = top / "outer" / "inner"
    group.mkdir(parents=True)
    for folder, values in ((group, ("max", "40")), (group.parent, ("100", "40"))):
        for name, value in zip((limit, usage), values, strict=True):
            (folder / name).write_text(f"{value}\n")
    (group.parent / "memory.stat").write_text("anon 30\ninactive_file 5\n")
    own = tmp_path / "own"
    own.write_text("0::/outer/inner\n" if version == 2 else "5:cpu:/outer\n4:memory:/outer/inner\n")
    assert memory._control_groups(tmp_path, own) == [65]
    assert memory._control_groups(tmp_path, tmp_path / "missing") == []


def test_turntable_goes_once_around_and_keeps_the_scene_in_view():
    lattice = Lattice((8, 6, 4))
    cameras = [make(lattice, (40, 30)) for make in scenes.turntable(4, elevation=20.0).values()]
    towards = np.array([camera.direction for camera in cameras])
    np.testing.assert_allclose(towards[:, :2], np.cos(np.radians(20)) * np.array([[0, 1], [-1, 0], [0, -1], [1, 0]]), atol=1e-6)
    corners = np.array([[x, y, z] for x in (0, 8) for y in (0, 6) for z in (0, 4)])
    for camera in cameras:
        frame = camera.frame
        across = (corners - camera.center) @ np.asarray(frame.right)
        upward = (corners - camera.center) @ np.asarray(frame.upward)
        assert np.abs(across).max() <= camera.width / 2
        assert np.abs(upward).max() <= camera.width * 30 / 40 / 2


@pytest.mark.parametrize(("frames", "elevation"), [(0, 35.0), (2.5, 35.0), (4, 91.0), (4, "high")])
def test_turntable_refuses(frames, elevation):
    with pytest.raises((TypeError, ValueError), match="expected"):
        scenes.turntable(frames, elevation)


def test_a_flight_goes_through_the_views():
    lattice = rm.Lattice((8, 8, 8), 1 / 8)
    eyes = [(0.5, -2.0, 0.5), (2.0, 0.5, 1.0), (0.5, 3.0, 0.5)]
    views = {
        f"v{i}": lambda _, r, eye=eye: rm.PerspectiveCamera(eye, (0.5, 0.5, 0.4), resolution=r) for i, eye in enumerate(eyes)
    }
    frames = scenes.fly_through(views, 9)
    assert list(frames) == [f"{i:03d}" for i in range(9)]
    cameras = [make(lattice, (12, 8)) for make in frames.values()]
    for i, eye in zip((0, 4, 8), eyes, strict=True):
        np.testing.assert_allclose(cameras[i].position, eye, atol=1e-12)
    np.testing.assert_allclose([c.target for c in cameras], np.broadcast_to((0.5, 0.5, 0.4), (9, 3)), atol=1e-12)
    steps = np.linalg.norm(np.diff([c.position for c in cameras], axis=0), axis=1)
    assert steps.max() < 1.5 * steps.min()
    with pytest.raises(ValueError, match="views: got 1 of them, expected at least two"):
        scenes.fly_through({"one": views["v0"]}, 9)
    with pytest.raises(ValueError, match="expected perspective cameras"):
        scenes.fly_through(scenes.find("ring").views, 3)["000"](lattice, (8, 8))
