"""The same image loss and its gradient in Mitsuba 3: the ring from above, a textured floor, path replay backpropagation.

Its gradients are noisy; the noise is the spread over runs with other seeds, and their mean is what ours is compared with.

Public name: `measure_mitsuba`.
"""

import statistics
import time
from typing import Any

import numpy as np

from .mitsuba_scenes import open_box, rectangle, start

_ALBEDO = 0.9
_AROUND, _ACROSS = 128, 64  # quadrilaterals of the torus


def measure_mitsuba(cells: int, pixels: int, samples: int, repeats: int) -> dict[str, Any]:
    """Seconds and noise of one value with gradient at `samples` a pixel, and the mean gradient of `repeats` runs."""
    mi, variant = start()
    if variant.startswith("scalar"):
        raise RuntimeError("mitsuba: got a scalar variant, expected llvm_ad_mono for derivatives; install LLVM 19 or newer")
    import drjit as dr

    scene = mi.load_dict(_ring(mi, cells), optimize=False)
    sensor = mi.load_dict(_from_above(mi, pixels))
    integrator = mi.load_dict({"type": "prb", "max_depth": -1})
    params = mi.traverse(scene)
    key = "floor.bsdf.reflectance.data"

    def gradient(seed: int) -> np.ndarray:
        # Rows of a bitmap are along v, columns along u; ours are (x, y).
        params[key] = mi.TensorXf(albedo(cells).T[:, :, None].astype(np.float32))
        dr.enable_grad(params[key])
        params.update()
        image = mi.render(
            scene, params, sensor=sensor, integrator=integrator, spp=samples, seed=2 * seed, seed_grad=2 * seed + 1
        )
        dr.backward(dr.mean(dr.square(image), axis=None))
        return np.array(dr.grad(params[key]), float)[:, :, 0].T

    seconds, found = [], []
    for seed in range(repeats + 1):
        begun = time.perf_counter()
        found.append(gradient(seed))
        seconds.append(time.perf_counter() - begun)
    warm, runs = seconds[1:], np.array(found)
    scale = np.sqrt(np.mean(runs.mean(0) ** 2))
    return {
        "work": "prb", "variant": variant, "mitsuba": mi.__version__, "samples": samples, "first": seconds[0],
        "warm": statistics.median(warm), "spread": max(warm) - min(warm),
        "noise": float(np.sqrt(np.mean(runs.var(0, ddof=1))) / scale), "runs": len(runs), "mean": runs.mean(0).tolist(),
    }  # fmt: skip


def albedo(cells: int) -> np.ndarray:
    """The floor that gradients are compared on: (cells, cells) along x and y."""
    return np.random.default_rng(0).uniform(0.2, 0.8, (cells, cells))


def _ring(mi: Any, cells: int) -> dict[str, Any]:
    bitmap = {"type": "bitmap", "data": mi.TensorXf(np.full((cells, cells, 1), 0.5, np.float32)), "raw": True}
    paint = {"type": "diffuse", "reflectance": {**bitmap, "filter_type": "nearest", "wrap_mode": "clamp"}}
    floor = rectangle(mi, (0.5, 0.5, 0), (0.5, 0, 0), (0, 0.5, 0), bsdf=paint)
    sun = {"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": {"type": "uniform", "value": 4.0}}
    sky = {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}
    return {"type": "scene", **open_box(mi, _ALBEDO), "floor": floor, "torus": _torus(mi), "sun": sun, "sky": sky}


def _torus(mi: Any) -> Any:
    """The ring's torus as triangles with their corners on it."""
    axis = np.array([-0.4, 0.25, 1]) / np.linalg.norm([-0.4, 0.25, 1])
    first = np.cross(axis, [1.0, 0, 0])
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    turn, tilt = np.meshgrid(*(2 * np.pi * np.arange(n) / n for n in (_AROUND, _ACROSS)), indexing="ij")
    out = np.cos(turn)[..., None] * first + np.sin(turn)[..., None] * second
    corners = np.array([0.5, 0.5, 0.36]) + (0.22 + 0.08 * np.cos(tilt))[..., None] * out + 0.08 * np.sin(tilt)[..., None] * axis
    number = np.arange(_AROUND * _ACROSS).reshape(_AROUND, _ACROSS)
    right, up = np.roll(number, -1, 0), np.roll(number, -1, 1)
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((number, right, np.roll(right, -1, 1)),
                                                                    (number, np.roll(right, -1, 1), up))])  # fmt: skip
    bsdf = {"type": "diffuse", "reflectance": {"type": "uniform", "value": _ALBEDO}}
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh("torus", vertex_count=number.size, face_count=len(faces), props=properties)
    values = mi.traverse(mesh)
    values["vertex_positions"] = corners.reshape(-1).astype(np.float32)
    values["faces"] = faces.reshape(-1).astype(np.uint32)
    values.update()
    return mesh


def _from_above(mi: Any, pixels: int) -> dict[str, Any]:
    columns = np.array([[-0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, -1, 1.5], [0, 0, 0, 1]])
    film = {"type": "hdrfilm", "width": pixels, "height": pixels, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
    return {
        "type": "orthographic",
        "to_world": mi.ScalarTransform4f(columns),
        "near_clip": 1e-4,
        "far_clip": 10.0,
        "film": film,
    }
