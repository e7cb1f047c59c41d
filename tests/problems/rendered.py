"""The two scenes that another program has solved: irradiance and fluence at probes, and a picture (`data/README.md`)."""

from functools import partial
from pathlib import Path

import numpy as np

import raymanifold_jax as rm

from .case import Case, Reader, Readings, Target, joined, readings
from .data import columns, probes, top_view

BLOCKS = 32  # a side of the picture


def read_probes(name: str, solution: rm.Solution) -> dict[str, Readings]:
    """Irradiance at the probes of scene "A" or "C", and fluence where the reference has it."""
    rows = probes(name)
    at = np.array([row["position"] for row in rows["probes"]])
    normals = np.array([row["normal"] for row in rows["probes"]])
    ours = rm.irradiance(solution, at, normals)
    read = {"irradiance": readings(ours, *columns(rows["probes"], "irradiance", "irradiance_se").T)}
    if "fluence" in rows:
        expected, error = 4 * np.pi * columns(rows["fluence"], "mean_radiance", "se").T
        ours = rm.fluence(solution, np.array([row["position"] for row in rows["fluence"]]))
        read["fluence"] = readings(ours, expected, error)
        read["all points"] = joined(read["irradiance"], read["fluence"])
    return read


def read_top_view(name: str, solution: rm.Solution) -> dict[str, Readings]:
    """The view from above, as means of 32 x 32 blocks."""
    return {"top view": readings(in_blocks(_picture(name, solution)), *top_view(name))}


def read_picture(name: str, halves: Path, solution: rm.Solution) -> dict[str, Readings]:
    """The same view pixel by pixel, against two independent renderings in a file, (2, pixels, pixels).

    Errors are relative to the mean of a pixel's block, whose noise is small. The renderings' own error is half of what they
    differ by, so that rms^2 - reference_error^2 is the mean of (ours - one) (ours - other): free of their noise.
    """
    one, other = np.load(halves)
    mean = (one + other) / 2
    ours = _picture(name, solution, len(one))
    return {"picture": readings(ours, mean, np.abs(one - other) / 2, spread_blocks(in_blocks(mean), len(one)))}


def in_blocks(picture: np.ndarray) -> np.ndarray:
    """Means of the blocks of a picture."""
    block = len(picture) // BLOCKS
    return picture.reshape(BLOCKS, block, BLOCKS, block).mean((1, 3))


def spread_blocks(means: np.ndarray, pixels: int) -> np.ndarray:
    """The mean of its block for each pixel of a picture."""
    return np.kron(means, np.ones((pixels // BLOCKS,) * 2))


def _picture(name: str, solution: rm.Solution, pixels: int = 256, samples: int = 1) -> np.ndarray:
    """What is seen from above, of scene "A" from just below its ceiling."""
    height = 1 - 1e-3 if name == "A" else 1.0
    camera = rm.OrthographicCamera(
        (0.5, 0.5, height), (0, 0, -1), (0, 1, 0), width=1.0, resolution=(pixels, pixels), row0="lower"
    )
    return np.asarray(rm.render(solution, camera, samples), float)


def _readers(name: str) -> dict[str, Reader]:
    return {"probes": partial(read_probes, name), "top view": partial(read_top_view, name)}


def _room_targets(n: int) -> dict[str, Target]:
    rms = 0.003 if n >= 64 else 0.005 if n >= 32 else 0.006
    return {"irradiance": Target(rms=rms, bias=rms / 2)}


def _fog_targets(n: int) -> dict[str, Target]:
    return {"all points": Target(rms=0.007, bias=0.003)}


CASES = (
    Case("room", "scene A, a closed room", rm.scenes.room, _readers("A"), (16, 32, 64), _room_targets),
    Case("fog", "scene C, three balls in fog", rm.scenes.three_balls_in_fog, _readers("C"), (16, 32, 64), _fog_targets),
)
