"""The Cornell box: its published geometry, reflectances and light, in any bands of wavelength.

The data (`data/cornell_box.json`, in mm, y up, z away from the camera) are those of the Cornell University Program of Computer
Graphics. Here lengths are in metres, z is up and y points away from the camera, so that x runs from left to right:

    (x, y, z) = (0.556 - x', z', y').

Floor, ceiling and the green wall are sides of the lattice; the front is open and dark. The back wall and the red one, which
leans by up to 6 mm and is twisted by 1 mm (its plane is fitted), are solids, as are the blocks, each the prism under its top.
The light lies flush in the ceiling.

Public: `cornell_box`, `default_bands`, `light_values`, `camera_frame`.
"""

from __future__ import annotations

import json
import math
from functools import lru_cache
from importlib.resources import files
from typing import Any

import numpy as np
from jaxtyping import Float

from . import checks
from .camera import Vector
from .lattice import Lattice
from .scene import OPEN, Boundary, Scene, Solid, Wall
from .shapes import Box, HalfSpace, Shape
from .spectra import Bands

_RIGHT, _DEPTH, _HEIGHT = 0.556, 0.5592, 0.5488


def cornell_box(n: int = 64, bands: Bands | None = None) -> Scene:
    """The Cornell box with `n` voxels from floor to ceiling, in `bands` (default: 8 from 400 to 700 nm).

    Emission is relative, per nm. **Raises** `TypeError` or `ValueError` for an `n` below 4 and for anything that is no `Bands`.
    """
    n = checks.positive_int("n", n, at_least=4)
    bands = default_bands() if bands is None else bands
    checks.instance("bands", bands, Bands, "pass rm.spectra.Bands(edges=[400, 500, 600, 700])")
    data = _data()
    spacing = _HEIGHT / n
    shape = (math.ceil(_RIGHT / spacing), math.ceil(_DEPTH / spacing), n)
    lattice = Lattice(shape, spacing, (_RIGHT - shape[0] * spacing, 0.0, 0.0))
    paint = {name: bands.mean(data["wavelengths_nm"], data[name]) for name in ("white", "green", "red")}
    light = data["light"]
    lamp = _placed(light["quad"])
    emission = bands.mean(light["wavelengths_nm"], light["emission"])
    white, far = Wall(paint["white"]), 2 * max(lattice.extent)
    back = Box((-far, _DEPTH, -far), (far, far, far))
    lower, upper = lamp.min(0), lamp.max(0)
    return Scene(
        lattice,
        [
            Solid(_red_wall(), paint["red"]),
            Solid(back, paint["white"]),
            Solid(_block("short_block_top"), paint["white"]),
            Solid(_block("tall_block_top"), paint["white"]),
            Solid(Box(lower, (upper[0], upper[1], _HEIGHT + 2 * spacing)), light["reflectance"], emission),
        ],
        boundary=Boundary(x=(Wall(paint["red"]), Wall(paint["green"])), y=(OPEN, white), z=(white, white)),
    )


def default_bands() -> Bands:
    return Bands(edges=np.linspace(400, 700, 9))


def light_values(bands: Bands) -> Float[np.ndarray, " n"]:
    """The lamp's emission in `bands`: what looks white under it."""
    return bands.mean(_data()["light"]["wavelengths_nm"], _data()["light"]["emission"])


def camera_frame() -> tuple[Vector, Vector, float]:
    """Position, target and field of view (degrees) of the published camera: 35 mm behind a picture of 25 mm."""
    camera = _data()["camera"]
    x, y, z = (float(c) for c in _placed([camera["position"]])[0])
    view = 2 * math.degrees(math.atan(camera["width_height"] / 2 / camera["focal_length"]))
    return (x, y, z), (x, 0.0, z), view


@lru_cache
def _data() -> dict[str, Any]:
    return json.loads((files("raymanifold_jax") / "data" / "cornell_box.json").read_text())


def _placed(points: Any) -> Float[np.ndarray, "m 3"]:
    x, y, z = np.asarray(points, float).T / 1000
    return np.stack([_RIGHT - x, z, y], -1)


def _red_wall() -> Shape:
    corners = _placed(_data()["left_red"])
    middle = corners.mean(0)
    normal = np.linalg.svd(corners - middle)[2][-1]
    return HalfSpace(middle, normal * np.sign(normal[0]))


def _block(name: str) -> Shape:
    """The prism from the floor to a quadrilateral top."""
    top = _placed(_data()[name])
    middle = top.mean(0)
    block: Shape = Box((*top.min(0)[:2], -middle[2]), top.max(0))
    for a, b in zip(top, np.roll(top, -1, 0), strict=True):
        across = np.array([b[1] - a[1], a[0] - b[0], 0.0])
        block = block.intersection(HalfSpace(a, across * np.sign(across @ (a - middle))))
    return block
