"""Scenes A and C for Mitsuba 3, and its error as a function of time.

The scenes are those of `tests/data/README.md`, which the package has as `rm.scenes.room` and `rm.scenes.three_balls_in_fog`.
They are loaded with `optimize=False`: with the default, Mitsuba 3.9.1 stops shadow rays short and reads 0.7 % high in open
scenes. Mitsuba runs in its fastest mode for one channel, `llvm_ad_mono`, on all cores; without LLVM 19 or newer, in
`scalar_rgb`, which is slower and cannot be asked for single probes.

Public names: `error_curve`, `picture_curve`; `start`, `open_box` and `rectangle` for other scenes.
"""

import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

_BLOCKS = 32
_PIXELS = 256  # a side of the picture
# Samples of a probe, of a block and of a pixel in a pass: few, so that the time to an error is resolved, but enough for full
# speed.
_SAMPLES = {"A": (512, 64, 4), "C": (4096, 1024, 16)}
_PASSES = 100_000
_OFF = 5e-5


def start() -> tuple[Any, str]:
    """Mitsuba with a variant set, and the variant's name."""
    if "DRJIT_LIBLLVM_PATH" not in os.environ:
        # Where the wheel of LLVM in the extra `peer` has its library; otherwise Dr.Jit looks for one of the system's.
        found = sorted(Path(sys.prefix, "lib").glob("libLLVM.so.[0-9]*"))
        if found:
            os.environ["DRJIT_LIBLLVM_PATH"] = str(found[-1])
    try:
        import mitsuba as mi
    except ImportError as error:
        raise RuntimeError("mitsuba: not installed, expected Mitsuba 3; install the extra `peer` of this package") from error
    for variant in ("llvm_ad_mono", "scalar_rgb"):
        try:
            mi.set_variant(variant)
            mi.set_log_level(mi.LogLevel.Error)
            return mi, variant
        except ImportError:
            continue
    raise RuntimeError(f"mitsuba: got variants {mi.variants()}, expected llvm_ad_mono or scalar_rgb; install the PyPI wheel")


def rectangle(mi: Any, center: tuple, across: tuple, up: tuple, **more: Any) -> dict[str, Any]:
    """A rectangle with half-edges `across` and `up`; its normal is across x up."""
    normal = np.cross(across, up)
    columns = np.stack([across, up, normal / np.linalg.norm(normal), center], axis=1)
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f(np.vstack([columns, [0, 0, 0, 1]])), **more}


def _diffuse(albedo: float) -> dict[str, Any]:
    return {"type": "diffuse", "reflectance": {"type": "uniform", "value": albedo}}


def _value(value: float) -> dict[str, Any]:
    return {"type": "uniform", "value": value}


def open_box(mi: Any, albedo: float) -> dict[str, Any]:
    """Floor and four walls of the unit cube, normals inward."""
    h, x, y, z = 0.5, (0.5, 0, 0), (0, 0.5, 0), (0, 0, 0.5)
    sides = {
        "floor": ((h, h, 0), x, y),
        "x-": ((0, h, h), y, z),
        "x+": ((1, h, h), z, y),
        "y-": ((h, 0, h), z, x),
        "y+": ((h, 1, h), x, z),
    }
    name = {"x-": "west", "x+": "east", "y-": "south", "y+": "north"}
    return {name.get(side, side): rectangle(mi, *where, bsdf=_diffuse(albedo)) for side, where in sides.items()}


def _room(mi: Any) -> dict[str, Any]:
    scene = {"type": "scene", **open_box(mi, 0.75)}
    down = lambda x0, x1, y0, y1: (((x0 + x1) / 2, (y0 + y1) / 2, 1), (0, (y1 - y0) / 2, 0), ((x1 - x0) / 2, 0, 0))
    around = [(0, 1, 0, 0.375), (0, 1, 0.625, 1), (0, 0.375, 0.375, 0.625), (0.625, 1, 0.375, 0.625)]
    for number, part in enumerate(around):
        scene[f"ceiling{number}"] = rectangle(mi, *down(*part), bsdf=_diffuse(0.75))
    light = {"type": "area", "radiance": _value(1.0)}
    scene["light"] = rectangle(mi, *down(0.375, 0.625, 0.375, 0.625), bsdf=_diffuse(0.75), emitter=light)
    place = mi.ScalarTransform4f().translate([0.375, 0.375, 0.25]).scale([0.125, 0.125, 0.25])
    scene["block"] = {"type": "cube", "to_world": place, "bsdf": _diffuse(0.75)}
    scene["integrator"] = {"type": "path", "max_depth": -1}
    return scene


def _fog(mi: Any) -> dict[str, Any]:
    extinction, albedo = 3.3, 3.0 / 3.3
    medium = {"type": "homogeneous", "albedo": _value(albedo), "sigma_t": _value(extinction), "phase": {"type": "isotropic"}}
    medium = mi.load_dict(medium)
    scene = {"type": "scene", **open_box(mi, 0.9), "fog": medium}
    roof = ((0.5, 0.5, 1), (0.5, 0, 0), (0, 0.5, 0))
    scene["roof"] = rectangle(mi, *roof, bsdf={"type": "null"}, interior=medium)
    for number, center in enumerate(((0.3, 0.35, 0.75), (0.65, 0.3, 0.5), (0.5, 0.7, 0.25))):
        scene[f"ball{number}"] = {"type": "sphere", "center": list(center), "radius": 0.12, "bsdf": _diffuse(0.9)}
    scene["sun"] = {"type": "directional", "direction": [0.2, 0.1, -1], "irradiance": _value(3.0)}
    scene["integrator"] = {"type": "volpath", "max_depth": -1}
    return scene


def _sensor(mi: Any, height: float, pixels: int) -> dict[str, Any]:
    """From above over exactly the unit square."""
    columns = np.array([[0.5, 0, 0, 0.5], [0, -0.5, 0, 0.5], [0, 0, -1, height], [0, 0, 0, 1]])
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    place = mi.ScalarTransform4f(columns)
    return {"type": "orthographic", "to_world": place, "near_clip": 1e-4, "far_clip": 10.0, "film": film}


def error_curve(scene: str, quantity: str, seconds: float, goal: float) -> dict[str, Any]:
    """Render pass after pass until the rms error is below `goal`, or for `seconds`; what is left then is extrapolated.

    `quantity`: "irradiance" at the probes of scene "A" or "C", or the means over blocks of the "top view". The first pass,
    which compiles, is timed apart. Returns the variant, the (seconds, rms) of the passes, and the seconds to the goal, from

        rms^2 = c / t + (the reference's own error)^2,

    c being the mean over the last half of the passes.
    """
    import problems

    mi, variant, loaded = _loaded(scene)
    if quantity == "top view":
        expected, error = problems.top_view(scene)
        render = _top_view(mi, loaded, scene, _BLOCKS, _SAMPLES[scene][1])
    else:
        rows = problems.probes(scene)["probes"]
        expected, error = (np.array([row[key] for row in rows]) for key in ("irradiance", "irradiance_se"))
        render = _probes(mi, loaded, rows, _SAMPLES[scene][0])
    reference = float(np.sqrt(np.mean((error / expected) ** 2)))
    first, _ = _timed(lambda: render(_PASSES))
    total, spent, points = np.zeros_like(expected), 0.0, []
    for number in range(_PASSES):
        passed, values = _timed(lambda seed=number: render(seed))
        total, spent = total + values, spent + passed
        relative = total / (number + 1) / expected - 1
        points.append((spent, float(np.sqrt(np.mean(relative**2))), float(np.mean(relative))))
        if spent >= seconds or (points[-1][1] <= goal and number >= 9):
            break
    about = {"scene": scene, "quantity": quantity, "variant": variant, "mitsuba": mi.__version__, "bias": points[-1][2]}
    return about | _curve(first, reference, [point[:2] for point in points], goal)


def picture_curve(scene: str, halves: Path, seconds: float, goal: float) -> dict[str, Any]:
    """The same for single pixels of the view from above, of which no reference is good enough.

    Passes are rendered in pairs. The mean of the first of each and the mean of the second are independent, and half of what
    they differ by has the error of both together: that is its rms, relative to the means of blocks. They are written to the
    file `halves`, (2, pixels, pixels), for others to be compared with.
    """
    import problems

    mi, variant, loaded = _loaded(scene)
    render = _top_view(mi, loaded, scene, _PIXELS, _SAMPLES[scene][2])
    first, _ = _timed(lambda: render(_PASSES))
    total, spent, points = np.zeros((2, _PIXELS, _PIXELS)), 0.0, []
    for number in range(_PASSES // 2):
        for half in range(2):
            passed, values = _timed(lambda seed=2 * number + half: render(seed))
            total[half] += values
            spent += passed
        one, other = total / (number + 1)
        scale = problems.spread_blocks(problems.in_blocks((one + other) / 2), _PIXELS)
        points.append((spent, float(np.sqrt(np.mean(((one - other) / 2 / scale) ** 2)))))
        if spent >= seconds or (points[-1][1] <= goal and number >= 9):
            break
    np.save(halves, np.stack([one, other]))
    about = {"scene": scene, "quantity": "picture", "variant": variant, "mitsuba": mi.__version__}
    return about | _curve(first, 0.0, points, goal)


def _loaded(scene: str) -> tuple[Any, str, Any]:
    mi, variant = start()
    return mi, variant, mi.load_dict({"A": _room, "C": _fog}[scene](mi), optimize=False)


def _curve(first: float, reference: float, points: list[tuple[float, float]], goal: float) -> dict[str, Any]:
    half = np.array(points[len(points) // 2 :])
    constant = float(np.mean(np.maximum(half[:, 1] ** 2 - reference**2, 0) * half[:, 0]))
    return {
        "first_pass_seconds": first,
        "reference_error": reference,
        "points": points[:: max(1, len(points) // 50)],
        "seconds_to_goal": constant / goal**2,
        "reached": points[-1][1] <= goal,
    }


def _top_view(mi: Any, scene: Any, name: str, pixels: int, samples: int) -> Callable[[int], np.ndarray]:
    sensor = mi.load_dict(_sensor(mi, 1 - 1e-3 if name == "A" else 1.5, pixels))
    # Its x axis runs the other way.
    return lambda seed: np.array(mi.render(scene, sensor=sensor, spp=samples, seed=seed), float)[:, ::-1, 0]


def _probes(mi: Any, scene: Any, rows: list[dict[str, Any]], samples: int) -> Callable[[int], np.ndarray]:
    """E = pi (L - L_emitted) / albedo, L along rays that look at the probes from close by."""
    if mi.variant().startswith("scalar"):
        raise RuntimeError("mitsuba: got a scalar variant, expected llvm_ad_mono for single probes; install LLVM 19 or newer")
    position = np.array([row["position"] for row in rows])
    normal = np.array([row["normal"] for row in rows])
    albedo = np.array([row["albedo"] for row in rows])
    emitted = np.array([row["emitted_radiance"] for row in rows])
    spread = lambda values: mi.Vector3f(*np.repeat(values, samples, 0).T.astype(np.float32))
    ray = mi.Ray3f(mi.Point3f(spread(position + _OFF * normal)), spread(-normal))
    sampler = mi.load_dict({"type": "independent"})
    medium = next((shape.interior_medium() for shape in scene.shapes() if shape.interior_medium() is not None), None)

    def render(seed: int) -> np.ndarray:
        sampler.seed(seed, len(rows) * samples)
        radiance = scene.integrator().sample(scene, sampler, ray, medium)[0]
        mean = np.array(radiance, float).reshape(len(rows), samples).mean(1)
        return np.pi * (mean - emitted) / albedo

    return render


def _timed(function: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    result = function()
    return time.perf_counter() - began, result
