"""The benchmarks' command line, run as a user would, and the parts of it that can be wrong by themselves."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import problems
import pytest
from click.testing import CliRunner
from PIL import Image
from problems.case import Target, joined, readings

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.skipif(not (ROOT / "benchmarks").is_dir(), reason="benchmarks come with a checkout only")


if str(ROOT) not in sys.path:  # last, so that an installed package stays the one that is tested
    sys.path.append(str(ROOT))


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "benchmarks", *arguments]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)


@pytest.mark.slow
def test_accuracy(tmp_path):
    # A problem whose answer is exact at any size; the record says what was run, on what, and how it went.
    record = tmp_path / "record.json"
    few = ("--size", "4", "--directions", "24", "--repeats", "1")
    done = run("accuracy", "--only", "plates-mirror", *few, "--json", str(record))
    assert done.returncode == 0, done.stderr
    line = next(line for line in done.stdout.splitlines() if line.startswith("plates-mirror"))
    assert line.split()[1:5] == ["net", "flux", "4", "24"] and line.endswith("yes")
    written = json.loads(record.read_text())
    assert {"processor", "cores", "device", "jax", "commit"} <= set(written["environment"])
    (measured,) = written["records"]
    assert measured["quantities"]["net flux"]["worst"] < 1e-5
    assert measured["memory"] > 1e7
    seconds = measured["seconds"]
    assert seconds["first"] == pytest.approx(seconds["compile"] + seconds["warm"])


def test_a_problem_that_fails_has_a_line_of_its_own():
    done = run("accuracy", "--only", "discs-1", "--size", "7", "--directions", "24")
    assert done.returncode == 1
    assert "discs-1" in done.stdout and "expected a multiple of 12" in done.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("accuracy", "--only", "kobayashi"), "expected one of kobayashi-1i"),
        (("accuracy", "--quick", "--size", "8"), "exclude one another"),
        (("accuracy", "--quadrature", "lebedev"), "expected default, paper (its whole scheme) or one of fibonacci"),
        (("error-vs-time", "--json", "nowhere/record.json"), "expected a directory that exists"),
    ],
)
def test_bad_options(arguments, message):
    from benchmarks.cli import main

    done = CliRunner().invoke(main, arguments)
    assert done.exit_code == 2 and message in " ".join(done.output.split())


def test_plot(tmp_path):
    # Made-up records, as `measure` and `error_curve` write them.
    pytest.importorskip("matplotlib")
    from benchmarks.plot import work_precision

    errors = {"rms": 0.01, "reference_error": 0.001}
    records = [
        {
            "problem": "room",
            "size": size,
            "directions": count,
            "quadrature": "fibonacci",
            "seconds": {"first": 3.0, "warm": size * count / 1e3, "read": {"probes": 0.1, "top view": 0.2}},
            "quantities": {"irradiance": errors, "top view": errors},
        }
        for size in (8, 16)
        for count in (50, 100)
    ]
    curve = {"scene": "A", "quantity": "top view", "mitsuba": "3", "variant": "scalar_rgb", "points": [(1, 0.1), (4, 0.05)]}
    work_precision(records, tmp_path / "plot.png", {"mitsuba": [curve | {"seconds_to_goal": 100.0}]})
    assert (tmp_path / "plot.png").stat().st_size > 10_000


def _is_installed(package: str) -> None:
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")


@pytest.mark.slow
@pytest.mark.parametrize("quantity", ["irradiance", "top view"])
@pytest.mark.parametrize("scene", ["A", "C"])
def test_peer_solves_the_same_scenes(scene, quantity):
    # Against the reference, which is by the same program with more samples. The noise of a pass is uncorrelated between 96 to
    # 1024 points, so that their mean has to be right within 1 %; a picture turned the wrong way has an rms error over 16 %.
    # In a process of its own: in one with JAX's, Mitsuba's LLVM aborts.
    _is_installed("mitsuba")
    from benchmarks.alone import alone
    from benchmarks.mitsuba_scenes import error_curve

    curve = alone(error_curve, scene, quantity, 2.0, 0.02)
    if curve["variant"] != "llvm_ad_mono":
        pytest.skip("no LLVM")
    assert abs(curve["bias"]) < 0.01 and curve["points"][-1][1] < 0.1


@pytest.mark.slow
def test_pictures_of_the_peer_are_of_the_same_scene(tmp_path):
    # Means over blocks are the reference's, with 1 or 2 % of noise; a picture turned the wrong way is 16 % off.
    _is_installed("mitsuba")
    from benchmarks.alone import alone
    from benchmarks.mitsuba_scenes import picture_curve

    curve = alone(picture_curve, "A", tmp_path / "halves.npy", 3.0, 0.02)
    one, other = np.load(tmp_path / "halves.npy")
    expected, _ = problems.top_view("A")
    relative = problems.in_blocks((one + other) / 2) / expected - 1
    assert np.sqrt(np.mean(relative**2)) < 0.04 and abs(relative.mean()) < 0.01
    # What half of their difference says is their noise: it falls as one over the root of the time.
    (early, first), (late, last) = curve["points"][1], curve["points"][-1]
    assert last / first == pytest.approx(np.sqrt(early / late), rel=0.25)


def test_noise_of_a_reference_in_two_halves_is_taken_out(tmp_path):
    # A picture that is off by 1 % everywhere, beside two renderings with a noise of 5 % each.
    from benchmarks.peer import point

    noise = np.random.default_rng(1).normal(1, 0.05, (2, 64, 64))
    one, other = 2.0 * noise
    got = readings(np.full((64, 64), 2.02), (one + other) / 2, np.abs(one - other) / 2, np.full((64, 64), 2.0))
    errors = {"rms": got.rms(), "reference_error": got.reference_error()}
    record = {"seconds": {"first": 2.0, "warm": 1.0, "read": {"picture": 0.5}}, "quantities": {"picture": errors}}
    found = point(record | {"size": 8, "directions": 50, "quadrature": "default"}, "picture")
    assert found["rms"] == pytest.approx(0.01, rel=0.15) and got.rms() > 0.03
    assert found["seconds"] == 1.5 and found["first"] == 2.5


def test_readings():
    # Errors are relative to the scale; the reference's error likewise.
    one = readings([1.1, 1.8], [1.0, 2.0], uncertainty=0.02)
    np.testing.assert_allclose(one.errors(), [0.1, -0.1])
    assert one.bias() == pytest.approx(0) and one.rms() == pytest.approx(0.1) and one.worst() == pytest.approx(0.1)
    assert one.reference_error() == pytest.approx(np.sqrt((0.02**2 + 0.01**2) / 2))
    both = joined(one, readings(3.0, 2.0, scale=10.0))
    np.testing.assert_allclose(both.errors(), [0.1, -0.1, 0.1])
    assert Target(worst=0.11, rms=0.11).met(both) and not Target(bias=0.01).met(both)
    with pytest.raises(ValueError, match="expected finite numbers"):
        readings([np.nan], [1.0])


def test_catalogue():
    # Every problem can be built at each of its sizes, and its targets are of quantities with known names.
    for case in problems.CASES.values():
        for size in case.sizes[:2]:
            scene = case.build(size)
            assert max(scene.lattice.shape) == size
            assert all(isinstance(target, Target) for target in case.targets(size).values())


@pytest.mark.slow
def test_gradients_are_those_of_path_replay():
    """The gradient of an image loss in a floor's albedos, against the mean of Mitsuba's: voxels and directions leave 3 %."""
    pytest.importorskip("mitsuba")
    from benchmarks.gradient import measure

    *_, ours, theirs = measure(16, 200, cells=4, pixels=32, repeats=1, samples=64)
    mean, expected = np.array(ours["mean"]), np.array(theirs["mean"])
    assert mean.shape == (4, 4) and theirs["runs"] >= 32
    assert np.sqrt(np.mean((mean - expected) ** 2) / np.mean(expected**2)) < 0.04


@pytest.mark.slow
def test_the_papers_figures(tmp_path):
    """At 12 voxels, where surfaces are thick: the schemes differ, and ours is near the path tracer's numbers."""
    out, record = tmp_path / "figures.png", tmp_path / "paper.json"
    arguments = ["--size", "12", "--half-width", "1", "--directions", "48", "--pixels", "24", "--repeats", "1"]
    done = run("paper", *arguments, "--out", str(out), "--json", str(record))
    assert done.returncode == 0, done.stderr
    assert "2 x 1" in done.stdout
    paper, ours = json.loads(record.read_text())["records"][2:4]
    assert paper["iterations"] == 5 and ours["sweeps"] > 5
    assert ours["errors"]["fluence"]["rms"] < 0.03 < paper["errors"]["fluence"]["rms"]
    with Image.open(out) as picture:
        assert picture.size == (2 * 24 + 8, 2 * 24 + 8)
