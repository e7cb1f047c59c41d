"""Saved solutions come back bit for bit, a killed solve goes on to the same bits, and damaged files are refused."""

import contextlib
import os
import signal
import subprocess
import sys
import textwrap
import time

import jax
import numpy as np
import problems
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import raymanifold_jax as rm
from raymanifold_jax.surfaces import find_surfaces
from raymanifold_jax.viewer import polygons

WALL = rm.Wall(0.9)
LATTICE = problems.cube(6)
SCENE = rm.Scene(
    LATTICE,
    [
        rm.Solid(rm.Sphere((0.5, 0.5, 0.5), 0.25), (0.9, 0.5)),
        rm.Solid(rm.Voxels(np.indices((6, 6, 6)).sum(0) == 0, LATTICE), 0.3),
    ],
    rm.Medium(1.0, 0.1),
    [rm.Sun((0.2, 0.1, -1)), rm.Sky(np.ones((2, 4, 2)), (0, 0, 1))],
    rm.Boundary(WALL, WALL, (WALL, rm.OPEN)),
)
DIRECTIONS = rm.quadrature.fibonacci(30)


@pytest.fixture(scope="module")
def solution():
    return rm.solve(SCENE, DIRECTIONS, progress=False)


@pytest.fixture(scope="module")
def saved(solution, tmp_path_factory):
    path = tmp_path_factory.mktemp("archive") / "solution.npz"
    solution.save(path)
    return path


def assert_same_bits(a, b):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(np.asarray(x), np.asarray(y))
        assert np.asarray(x).dtype == np.asarray(y).dtype


def test_a_solution_comes_back(solution, saved):
    back = rm.load(saved)
    assert_same_bits(back, solution)
    assert (back.result, back.sweeps, back.error_bound) == (solution.result, solution.sweeps, solution.error_bound)
    assert_same_bits(list(vars(back.elements).values()), list(vars(solution.elements).values()))
    points, normals = [[0.5, 0.5, 0.0], [0.9, 0.1, 0.0]], [[0, 0, 1], [0, 0, 1]]
    np.testing.assert_array_equal(rm.irradiance(back, points, normals, 64), rm.irradiance(solution, points, normals, 64))
    assert back.scene.summary() == solution.scene.summary()
    assert back.resolve(back.scene).sweeps < solution.sweeps


def test_what_cannot_be_saved(solution, tmp_path):
    import equinox as eqx

    sky = rm.Sky(lambda w: w[:, 2] ** 2)
    other = eqx.tree_at(lambda s: s.scene.lights, solution, (sky,))
    path = tmp_path / "a.npz"
    with pytest.raises(ValueError, match=r"solution\.scene\.lights\[0\]\.radiance: got a DirectionFunction"):
        other.save(path)
    assert not list(tmp_path.iterdir())
    with pytest.raises(FileNotFoundError):
        solution.save(tmp_path / "no" / "a.npz")
    with pytest.raises(FileNotFoundError, match=r"path: got .*a\.npz"):
        rm.load(path)


def test_other_archives(tmp_path):
    np.savez(tmp_path / "a.npz", x=np.zeros(3))
    with pytest.raises(ValueError, match="damaged or of another kind"):
        rm.load(tmp_path / "a.npz")
    np.save(tmp_path / "b.npy", np.zeros(3))
    with pytest.raises(ValueError, match="damaged or of another kind"):
        rm.load(tmp_path / "b.npy")


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_damage_is_noticed(saved, tmp_path_factory, data):
    whole = saved.read_bytes()
    at = data.draw(st.integers(0, len(whole) - 1))
    broken = whole[:at]
    if data.draw(st.booleans()):
        broken += bytes([whole[at] ^ data.draw(st.integers(1, 255))]) + whole[at + 1 :]
    path = tmp_path_factory.getbasetemp() / "damaged.npz"
    path.write_bytes(broken)
    # Bytes that nobody reads (times of files, say) may change; then the solution is the same.
    with contextlib.suppress(ValueError):
        np.testing.assert_array_equal(rm.load(path).fluence, rm.load(saved).fluence)


def test_plot_and_notebook_display(solution, tmp_path):
    pytest.importorskip("matplotlib")
    figure = solution.plot(at=(0.2, 0.5, 0.5))
    figure.savefig(tmp_path / "a.png", dpi=40)
    titles = [axes.get_title() for axes in figure.axes]
    assert titles[0].startswith("fluence at x = 0.2") and "convergence" in " ".join(titles)
    # The first plane is the one that holds the point.
    shown = np.asarray(figure.axes[0].images[0].get_array())
    expected = np.asarray(solution.fluence).mean(-1)[1].T
    np.testing.assert_allclose(shown[shown > 0], expected[expected > 0], rtol=1e-6)
    # From above: the elements that face up, in the colours of their irradiance, the highest last.
    seen = figure.axes[3].collections[0]
    up = np.asarray(solution.surfaces.normals)[:, 2] > 0.02
    irradiance = np.asarray(solution.surfaces.irradiance, float).mean(-1)[up]
    height = np.asarray(solution.surfaces.positions)[up, 2]
    assert len(seen.get_paths()) == len(irradiance)
    np.testing.assert_allclose(sorted(seen.get_array()), sorted(irradiance), rtol=1e-6)
    assert np.isclose(seen.get_array()[-1], irradiance[height == height.max()], rtol=1e-6).any()
    with pytest.raises(ValueError, match=r"at: got \[2\.0, 0\.0, 0\.0\], expected a point of the lattice"):
        solution.plot(at=(2, 0, 0))
    html = solution._repr_html_()
    assert "imbalance" in html and "converged" in html and html.count("<tr>") == html.count("</tr>")


# Checkpoints


class Stop(Exception):
    pass


class StopAfter(rm.Checkpoint):
    """Stands for a process that dies after so many savings."""

    def __init__(self, path, count):
        super().__init__(path, every=0)
        self.count = count

    def keep(self, state, at_once=False):
        super().keep(state, at_once)
        self.count -= 1
        if not self.count:
            raise Stop


@pytest.mark.parametrize("solver", [rm.Jacobi(), rm.Krylov(restart=3)])
def test_a_stopped_solve_goes_on_to_the_same_bits(tmp_path, solver):
    path, options = tmp_path / "run.npz", {"solver": solver, "progress": False, "rtol": 1e-4}
    straight = rm.solve(SCENE, DIRECTIONS, **options)
    with pytest.raises(Stop):
        rm.solve(SCENE, DIRECTIONS, checkpoint=StopAfter(path, 2), **options)
    resumed = rm.solve(SCENE, DIRECTIONS, checkpoint=rm.Checkpoint(path, resume=True), **options)
    assert_same_bits(resumed, straight)
    assert resumed.sweeps == straight.sweeps


def test_checkpoints_of_another_solve(tmp_path):
    path = tmp_path / "run.npz"
    with pytest.raises(Stop):
        rm.solve(SCENE, DIRECTIONS, progress=False, checkpoint=StopAfter(path, 1))
    checkpoint = rm.Checkpoint(path, resume=True)
    with pytest.raises(ValueError, match=r"checkpoint: got .*which belongs to another solve"):
        rm.solve(SCENE, DIRECTIONS, rtol=1e-3, progress=False, checkpoint=checkpoint)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match="damaged or of another kind"):
        rm.solve(SCENE, DIRECTIONS, progress=False, checkpoint=checkpoint)
    with pytest.raises(TypeError, match="checkpoint: got"):
        rm.solve(SCENE, checkpoint="run.npz")  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="every: got -1"):
        rm.Checkpoint(path, every=-1)


@pytest.mark.slow
def test_on_the_command_line(tmp_path, monkeypatch):
    from click.testing import CliRunner

    from raymanifold_jax import cli

    monkeypatch.setattr(cli, "_use_cache", lambda task="": None)
    options = ["--size", "4", "--directions", "24", "--quiet"]
    run = lambda *more: CliRunner().invoke(cli.main, ["solve", "room", *options, *map(str, more)])
    state, kept = tmp_path / "run.npz", tmp_path / "solution.npz"
    done = run("--checkpoint", state, "--save", kept)
    assert done.exit_code == 0, done.output
    assert rm.load(kept).converged
    alone = run("--resume")
    assert alone.exit_code == 2 and "expected --checkpoint FILE as well" in alone.output
    state.write_bytes(b"junk")
    damaged = run("--checkpoint", state, "--resume")
    assert damaged.exit_code == 2 and "damaged or of another kind" in damaged.output
    assert run("--save", tmp_path / "solution.exr").exit_code == 2
    assert run("--checkpoint", tmp_path / "no" / "run.npz").exit_code == 2


@pytest.mark.slow
def test_kill_and_resume(tmp_path):
    code = """
        import sys, numpy as np, raymanifold_jax as rm
        wall = rm.Wall(0.98)
        scene = rm.Scene(rm.Lattice((16, 16, 16), 1 / 16), medium=rm.Medium(4.0, 0.01),
                         lights=[rm.PointLight((0.5, 0.5, 0.5))], boundary=rm.Boundary(wall, wall, wall))
        checkpoint = None if sys.argv[1] == "-" else rm.Checkpoint(sys.argv[1], every=0, resume=True)
        options = {"solver": rm.Jacobi(), "rtol": 1e-3, "progress": False, "checkpoint": checkpoint}
        solution = rm.solve(scene, rm.quadrature.fibonacci(100), **options)
        np.save(sys.argv[2], solution.fluence)
    """
    run = lambda *args: subprocess.Popen([sys.executable, "-c", textwrap.dedent(code), *map(str, args)])
    checkpoint = tmp_path / "run.npz"
    killed = run(checkpoint, tmp_path / "killed.npy")
    for _ in range(3000):
        if checkpoint.exists():
            break
        time.sleep(0.1)
    os.kill(killed.pid, signal.SIGKILL)
    assert killed.wait() == -signal.SIGKILL
    assert run(checkpoint, tmp_path / "resumed.npy").wait() == 0
    assert run("-", tmp_path / "straight.npy").wait() == 0
    np.testing.assert_array_equal(np.load(tmp_path / "resumed.npy"), np.load(tmp_path / "straight.npy"))


def drawn(plot, solution):
    """Corners (T, 3, 3) of the triangles of a view's mesh, their colours, and the element of each."""
    mesh = next(o for o in plot.objects if o.type == "Mesh")
    vertices, triangles = np.asarray(mesh.vertices, float).reshape(-1, 3), np.asarray(mesh.indices).reshape(-1, 3)
    first = triangles[:, 0]  # which an element's triangles share
    element = np.cumsum(np.diff(first, prepend=first[0]) != 0)
    assert element[-1] + 1 == len(solution.surfaces.areas)
    return vertices[triangles], np.asarray(mesh.colors)[triangles[:, 0]], element


def test_view_shows_every_element_from_its_lit_side(solution):
    pytest.importorskip("k3d")
    plot = solution.view(height=300)
    table = solution.surfaces
    corners, colors, element = drawn(plot, solution)
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area, side = np.bincount(element, np.linalg.norm(cross, axis=1) / 2), solution.elements.side[~solution.elements.open]
    np.testing.assert_allclose(area[side < 0], np.asarray(table.areas)[side < 0], rtol=1e-3)
    np.testing.assert_allclose(area[side >= 0], LATTICE.spacing**2, rtol=0.01)
    assert (np.einsum("td,td->t", cross, np.asarray(table.normals)[element]) > -1e-6 * np.max(table.areas)).all()
    brightest = int(np.argmax(np.asarray(table.radiosity).reshape(len(table.areas), -1).sum(1)))
    assert colors[element == brightest].min() & 0xFF00 >= (colors & 0xFF00).max() * 0.9
    assert any(o.type == "Volume" for o in plot.objects) == (solution.scene.medium is not None)
    assert "<html" in plot.get_snapshot().lower()


def test_view_has_the_colours_of_bands(solution):
    pytest.importorskip("k3d")
    grey = drawn(solution.view(), solution)[1]
    assert np.array_equal(grey & 0xFF, grey >> 16)
    colors = drawn(solution.view(bands=rm.spectra.Bands(edges=[400, 550, 700])), solution)[1]
    assert np.mean((colors & 0xFF) > (colors >> 16)) > 0.3  # the ball's albedo is 0.9 in the blue half, 0.5 in the red
    with pytest.raises(ValueError, match="3 bands on its last axis"):
        solution.view(bands=rm.spectra.Bands(edges=[400, 500, 600, 700]))


def test_view_leaves_no_slits_in_a_turned_box():
    # A point on its side lies in one triangle of that side, but for what the elements' areas, sampled at edges, leave open.
    middle, half, angle = np.array([0.5, 0.5, 0.5]), 0.26, 0.52
    box = rm.Box(middle - half, middle + half).rotate((0, 0, 1), angle, middle)
    lattice = problems.cube(10)
    elements = find_surfaces(rm.Scene(lattice, [rm.Solid(box, 0.5)]))
    kept = elements.side < 0
    voxel, normal, area, position = (a[kept] for a in (elements.voxel, elements.normal, elements.area, elements.position))
    vertices, triangles, _ = polygons(voxel, normal, area / lattice.spacing**2, position / lattice.spacing)
    corners = vertices[triangles] * lattice.spacing - middle
    outward, along = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    corners = corners[(np.abs(corners @ outward - half) < 0.01 * half).all(1)]
    flat = np.stack([corners @ along, corners[..., 2]], -1)
    points = np.random.default_rng(1).uniform(-half, half, (1000, 1, 1, 2))
    edge, to = np.roll(flat, -1, 1) - flat, points - flat
    covers = (edge[..., 0] * to[..., 1] >= edge[..., 1] * to[..., 0]).all(-1)
    assert np.mean(covers.sum(1) == 1) > 0.97
