"""The command line: quick help, every bad value refused in one line before any work, and pictures that say their settings."""

import dataclasses
import io
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

import raymanifold_jax as rm
from raymanifold_jax import cli, memory, scenes
from raymanifold_jax.io import read_exr
from raymanifold_jax.solution import Energy


@dataclasses.dataclass
class FakeSolution:
    scene: rm.Scene
    converged: bool = True
    error_bound: float = 0.01
    target: float = 0.02
    sweeps: int = 7
    diffuse_fluence: float = 0.0

    @property
    def energy(self) -> Energy:
        return Energy(*jnp.array([1, 2, 0.5, 0.5, 1.97]))

    @property
    def result(self) -> str:
        return "converged" if self.converged else "not converged: raise max_sweeps"


class Library:
    """Stands in for `rm.solve` and `rm.render`, and notes what it is asked."""

    def __init__(self):
        self.asked: list[dict] = []
        self.views: list = []
        self.converged = True
        self.error: BaseException | None = None

    def solve(self, scene, **settings):
        self.asked.append(settings)
        if self.error is not None:
            raise self.error
        return FakeSolution(scene, self.converged)

    def render(self, solution, camera, samples, progress=None):
        if progress is not None:
            progress(1.0)
        self.views.append((camera, samples))
        width, height = camera.resolution
        return np.linspace(0, 2, width * height, dtype=np.float32).reshape(height, width)


@pytest.fixture
def library(monkeypatch, tmp_path) -> Library:
    fake = Library()
    monkeypatch.setitem(vars(rm), "solve", fake.solve)
    monkeypatch.setitem(vars(rm), "render", fake.render)
    monkeypatch.setattr(cli, "_use_cache", lambda task="": None)
    monkeypatch.chdir(tmp_path)
    return fake


def run(*arguments: str) -> Result:
    return CliRunner().invoke(cli.main, list(arguments))


def test_help_loads_nothing_heavy():
    code = (
        "import sys; from raymanifold_jax import cli\n"
        "try: cli.main(['render', '--help'])\n"
        "except SystemExit: pass\n"
        "heavy = {'jax', 'numpy', 'equinox', 'rich', 'OpenEXR', 'PIL'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for name in scenes.SCENES:
        assert name in done.stdout


def test_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "raymanifold_jax.cli", "--version"], capture_output=True, text=True)
    assert done.stdout == f"raymanifold, version {rm.__version__}\n"


bad_values = [
    (["rign"], "did you mean 'ring'?"),
    (["ring", "--size", "3"], "got 3, expected a whole number >= 4"),
    (["ring", "--size", "many"], "'many' is not a valid integer"),
    (["ring", "--size", "100000"], "voxels, which need about"),
    (["ring", "--directions", "23"], "got 23, expected a whole number from 24"),
    (["ring", "--rtol", "0"], "got 0.0, expected a number between 0 and 1"),
    (["ring", "--rtol", "1"], "got 1.0, expected"),
    (["ring", "--rtol", "nan"], "got nan, expected"),
    (["ring", "--max-sweeps", "0"], "got 0, expected"),
]
bad_render_values = [
    *bad_values,
    (["ring", "--out", "missing/a.exr"], "expected a directory that exists"),
    (["ring", "--out", "a.png"], "expected a name that ends in .exr; write 'a.png.exr'"),
    (["ring", "--out", "folder.exr"], "expected a file; something else has that name"),
    (["ring", "--out", "x" * 300 + ".exr"], "choose another name"),
    (["ring", "--camera", "front"], "got 'front', expected one of south, east, north, west, top"),
    (["ring", "--camera", "top", "--all-views"], "exclude each other"),
    (["ring", "--turntable", "4", "--all-views"], "exclude each other"),
    (["ring", "--turntable", "0"], "0 is not in the range"),
    (["ring", "--resolution", "0"], "got '0', expected pixels from 1 to 16384"),
    (["ring", "--resolution", "64x"], "got '64x', expected"),
    (["ring", "--resolution", "1x2x3"], "got '1x2x3', expected"),
    (["ring", "--resolution", "99999"], "got '99999', expected"),
    (["ring", "--samples", "5"], "got 5, expected a square number"),
    (["ring", "--samples", "0"], "got 0, expected a square number"),
    (["ring", "--exposure", "bright"], "got 'bright', expected stops"),
    (["ring", "--exposure", "nan"], "got 'nan', expected stops"),
]
commands = [("solve", *case) for case in bad_values] + [("render", *case) for case in bad_render_values]


@pytest.mark.parametrize("command, arguments, message", commands)
def test_bad_values(library, monkeypatch, tmp_path, command, arguments, message):
    (tmp_path / "folder.exr").mkdir()
    monkeypatch.setattr(memory, "available_memory", lambda: 16 * 10**9)
    result = run(command, *arguments)
    assert result.exit_code == 2
    (error,) = (line for line in result.stderr.splitlines() if line.startswith("Error: "))
    assert message in error and result.stderr.endswith(error + "\n")
    assert not library.asked and os.listdir(tmp_path) == ["folder.exr"] and not result.stdout


def test_unwritable_directory(library, monkeypatch):
    # Stands in for a directory without permission, in which root may write all the same.
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    result = run("render", "ring", "--out", "a.exr")
    assert result.exit_code == 2 and "expected a directory you may write in" in result.stderr
    assert not library.asked


def test_render_writes_a_picture_and_its_settings(library, tmp_path):
    options = "--size 8 --directions 50 --rtol 0.01 --resolution 6x4 --samples 9 --exposure -1 --out a.exr"
    result = run("render", "three_balls", *options.split())
    assert result.exit_code == 0, result.output
    assert sorted(os.listdir(tmp_path)) == ["a.exr", "a.png"]
    (asked,) = library.asked
    assert len(asked["quadrature"]) == 50 and asked["rtol"] == 0.01 and asked["max_sweeps"] == 1000
    ((camera, samples),) = library.views
    assert camera.resolution == (6, 4) and samples == 9
    image, channels, header = read_exr("a.exr")
    assert image.shape == (4, 6, 1) and channels == ["Y"] and image.max() == 2
    expected = {"scene": "three-balls", "size": 8, "directions": 50, "camera": "front", "samples": 9, "exposure": -1.0}
    expected |= {"version": rm.__version__, "sweeps": 7, "result": "converged"}
    assert {key: header[f"raymanifold.{key}"] for key in expected} == expected
    assert header["raymanifold.rtol"] == np.float32(0.01)
    assert np.asarray(Image.open("a.png")).max() == 255
    for part in ("8 x 8 x 8", "7", "0.01", "+1.000 %", "solve", "render", "peak memory", "a.exr, a.png"):
        assert part in result.stdout


def test_defaults(library, tmp_path):
    assert run("render", "room", "--quiet").stdout == ""
    assert sorted(os.listdir(tmp_path)) == ["room.exr", "room.png"]
    image, _, header = read_exr("room.exr")
    assert header["raymanifold.size"] == scenes.SCENES["room"].default_size and image.shape == (512, 512, 1)
    assert header["raymanifold.camera"] == "front"
    (asked,) = library.asked
    assert asked["progress"] is False and len(asked["quadrature"]) == 200 and asked["rtol"] == 1e-3


@pytest.mark.parametrize("options, progress", [([], True), (["--no-progress"], False), (["--quiet"], False)])
def test_progress(library, options, progress):
    assert run("solve", "ring", "--size", "8", *options).exit_code == 0
    assert library.asked[0]["progress"] is progress


def test_a_bar_while_pictures_are_made(library, monkeypatch):
    monkeypatch.setattr(cli.sys, "stderr", terminal := Terminal())
    with cli._rendering(2, shown=True) as picture:
        for _ in range(2):
            done = picture()
            assert done is not None
            done(0.5)
            done(1.0)
    assert re.findall(r"(\d+)%", terminal.getvalue())[-1] == "100" and "50%" in terminal.getvalue()
    with cli._rendering(2, shown=False) as picture:
        assert picture() is None


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_warnings_take_one_line(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(2, radius=0.3)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export(tmp_path / "ball.ply")
    text = "format = 1\n[lattice]\nshape = [8, 8, 8]\nspacing = 0.125\n[[solids]]\nshape = 'mesh'\nfile = 'ball.ply'\n"
    (tmp_path / "a.toml").write_text(text + "fit_lower = [0.2, 0.2, 0.2]\nfit_upper = [0.8, 0.8, 0.8]\n")
    before = warnings.showwarning
    result = CliRunner().invoke(cli.main, ["info", str(tmp_path / "a.toml")])
    assert result.exit_code == 0, result.output
    (line,) = (line for line in result.stderr.splitlines() if "3 edges of holes" in line)
    assert line.startswith("Warning: Mesh: 3 edges") and ".py" not in result.stderr
    assert warnings.showwarning is before


def test_all_views_share_one_exposure(library, tmp_path):
    result = run("render", "ring", "--size", "8", "--resolution", "8", "--all-views", "--half", "--out", "r.exr")
    assert result.exit_code == 0, result.output
    files = {f"r-{view}.{kind}" for view in scenes.SCENES["ring"].views for kind in ("exr", "png")}
    assert set(os.listdir(tmp_path)) == files
    headers = [read_exr(path)[2] for path in tmp_path.glob("*.exr")]
    assert len({header["raymanifold.exposure"] for header in headers}) == 1
    assert {header["raymanifold.camera"] for header in headers} == set(scenes.SCENES["ring"].views)


def test_turntable(library, tmp_path):
    result = run("render", "ring", "--size", "8", "--resolution", "8", "--turntable", "3", "--out", "r.exr")
    assert result.exit_code == 0, result.output
    assert set(os.listdir(tmp_path)) == {f"r-{i:03d}.{kind}" for i in range(3) for kind in ("exr", "png")}
    assert len(library.asked) == 1  # one solve


def test_auto_exposure():
    # The 99th percentile becomes 0.9; black pictures are left alone.
    picture = np.concatenate([np.full(980, 3.0), np.full(20, 450.0)])
    assert 450 * 2 ** cli._auto_exposure([picture]) == pytest.approx(0.9)
    assert 3 * 2 ** cli._auto_exposure([picture, np.full(10_000, 3.0)]) == pytest.approx(0.9)
    assert cli._auto_exposure([np.zeros((4, 4))]) == 0


@pytest.mark.parametrize("command", ["render", "solve"])
def test_not_converged(library, tmp_path, command):
    # The work is not lost, but nobody can miss what is wrong with it.
    library.converged = False
    options = ["--resolution", "8"] if command == "render" else []
    result = run(command, "ring", "--size", "8", *options)
    assert result.exit_code == 1
    assert "Warning: not converged" in result.stderr
    assert sorted(os.listdir(tmp_path)) == (["ring.exr", "ring.png"] if command == "render" else [])


errors = [
    (ValueError("rtol: got 1e-9,\nexpected more"), 2, "Error: rtol: got 1e-9, expected more\n"),
    (MemoryError(), 1, "Error: MemoryError\n"),
    (OSError(28, "No space left on device"), 1, "Error: [Errno 28] No space left on device\n"),
    (RuntimeError("RESOURCE_EXHAUSTED: out of memory"), 1, "Error: RESOURCE_EXHAUSTED: out of memory\n"),
]


@pytest.mark.parametrize("error, code, message", errors)
def test_errors_of_the_library_take_one_line(library, error, code, message):
    library.error = error
    result = run("render", "ring", "--size", "8")
    assert (result.exit_code, result.stderr) == (code, message)


def test_faults_of_the_library_keep_their_traceback(library):
    library.error = RuntimeError("a fault")
    assert run("solve", "ring", "--size", "8").exception is library.error


def test_solve_prints_the_energy(library):
    result = run("solve", "ring", "--size", "8")
    assert result.exit_code == 0
    for name in Energy._fields:
        assert name.replace("_", " ") in result.stdout


def test_scenes_are_listed():
    result = run("scenes")
    for entry in scenes.SCENES.values():
        assert entry.name in result.stdout and entry.description in result.stdout
        assert all(view in result.stdout for view in entry.views)


def test_info_names_versions_devices_and_memory(library, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 16 * 10**9)
    result = run("info")
    assert result.exit_code == 0, result.output
    for part in ("python", "jaxlib", "numpy", "OpenEXR", "devices", "16.00 GB", *scenes.SCENES):
        assert part in result.stdout
    result = run("info", "ring", "--size", "100000")
    assert result.exit_code == 0 and "more than there is" in result.stdout and "room" not in result.stdout


def test_cache_directory():
    home = str(Path("~/.cache/raymanifold").expanduser())
    assert cli._cache_directory({}) == home
    assert cli._cache_directory({"XDG_CACHE_HOME": "relative"}) == home
    xdg = {"XDG_CACHE_HOME": os.path.abspath("/x")}
    assert cli._cache_directory(xdg) == os.path.join(xdg["XDG_CACHE_HOME"], "raymanifold")
    assert cli._cache_directory(xdg | {"JAX_COMPILATION_CACHE_DIR": "j"}) == "j"
    assert cli._cache_directory(xdg | {"JAX_COMPILATION_CACHE_DIR": "j", "RAYMANIFOLD_CACHE": "r"}) == "r"
    assert cli._cache_directory(xdg | {"RAYMANIFOLD_CACHE": ""}) is None


@pytest.mark.slow
def test_a_real_picture(tmp_path):
    options = ["--size", "16", "--resolution", "32", "--out", str(tmp_path / "x.exr"), "--directions", "48"]
    command = [sys.executable, "-m", "raymanifold_jax.cli", "render", "three-balls", *options]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    image, _, header = read_exr(tmp_path / "x.exr")
    assert image.shape == (32, 32, 1) and image.max() > 0 and (image >= 0).all()
    assert "converged" in str(header["raymanifold.result"])
    assert (tmp_path / "x.png").is_file()
    # Fog fills the middle of the picture; its corners lie outside the box, where nothing shines.
    assert image[16, 16, 0] > 0 and image[0, 0, 0] == 0


def test_layers_and_bands_of_wavelength(tmp_path):
    """The Cornell box, small: an RGB preview, its bands and the layers in one file, and a picture in colour."""
    out = tmp_path / "box.exr"
    arguments = ["render", "cornell-box", "--size", "4", "--directions", "24", "--resolution", "8", "--samples", "1"]
    done = CliRunner().invoke(cli.main, [*arguments, "--layers", "--quiet", "--out", str(out)])
    assert done.exit_code == 0, done.output
    image, names, header = rm.io.read_exr(out)
    bands = [name for name in names if name.startswith("S0.")]
    assert image.shape == (8, 8, len(names)) and len(bands) == 8 and names[:3] == ["R", "G", "B"]
    assert {"depth.Z", "normal.X", "normal.Y", "normal.Z"} <= set(names) and header["raymanifold.scene"] == "cornell-box"
    assert sum(name.startswith("albedo.") for name in names) == sum(name.startswith("irradiance.") for name in names) == 8
    assert image[..., names.index("depth.Z")].max() > 0.8  # metres: the eye is that far in front of the box
    with Image.open(out.with_suffix(".png")) as png:
        assert png.mode == "RGB"
