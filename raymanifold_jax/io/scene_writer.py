"""Writing a scene and its cameras as a scene file, and the commented example of `raymanifold init`.

Arrays and meshes are written beside the file, under its name: `NAME-scattering.npy`, `NAME-sky0.npy`, `NAME-mesh0.obj`,
`NAME-solid0-albedo.npy`.

Public names: `save_scene`, `EXAMPLE`.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from .. import checks
from ..camera import AbstractCamera, OrthographicCamera, PerspectiveCamera
from ..lattice import Lattice
from ..mesh import Mesh
from ..scene import Medium, PointLight, Scene, Sky, Sun, Wall
from ..shapes import Difference, Intersection, Rotated, Shape, Translated, Union
from ..skies import CieSky
from ..spectra import Bands
from ..texture import Texture
from ..voxels import Voxels
from .exr import written_atomically
from .scene_file import FORMAT, SHAPES, SIDES

EXAMPLE = """\
# A scene for raymanifold:   raymanifold render scene.toml --out picture.exr
# Lengths are numbers in lattice.length_unit, or text such as "25 cm"; angles are in degrees.
# Any albedo, emission, radiance, irradiance or coefficient may be a list: one number a band, three bands are R, G, B.

format = 1
description = "two balls in thin fog under a sky"

# [bands]                        # of wavelength, for other than R, G, B: values are then lists, one number a band, or spectra:
#   edges = [400, 450, 500, 550, 600, 650, 700]  # nm; or centres      albedo = { reflectance = "moderate red" }
#   white = { illuminant = "D65" } # what pictures show as white       irradiance = { temperature = 5800, scale = 3.0 }
#                                # measured ones: scattering = { wavelengths = [400, 700], values = [2.0, 1.2] }

[lattice]                        # the box, cut into cubes
shape = [48, 48, 48]             # cubes along x, y, z; z is up
spacing = "2.5 cm"               # side of a cube
origin = [0, 0, 0]               # lower corner
length_unit = "m"                # km, m, cm, mm, um, in or ft

[boundary]                       # each side is "open", "mirror", "periodic" or a wall; or [lower, upper]
x = { albedo = [0.7, 0.2, 0.15] }
y = [{ albedo = 0.7 }, { albedo = 0.7 }]
z = [{ albedo = 0.6 }, "open"]    # or { albedo = { texture = "floor.npy", axis = "z" } }: an array (nx, ny[, bands])

[[solids]]
shape = "sphere"                 # or box, torus, cylinder, half-space, mesh, voxels
center = [0.4, 0.5, 0.3]
radius = "20 cm"
albedo = [0.8, 0.6, 0.3]
# emission = 0.0                 # radiance the surface sends out, W m^-2 sr^-1
# translate = [0, 0, 0]
# rotate = { axis = [0, 0, 1], angle = 30, center = [0.6, 0.6, 0.6] }
# difference = [{ shape = "box", lower = [0, 0, 0], upper = [0.4, 1.2, 1.2] }]   # union and intersection likewise

[[solids]]
shape = "sphere"
center = [0.8, 0.7, 0.5]
radius = 0.25
albedo = 0.8

# [[solids]]
# shape = "mesh"                 # needs trimesh: pip install 'raymanifold-jax[mesh]'
# file = "model.ply"             # OBJ, PLY, STL, GLB, ... beside this file
# up = "y"                       # the file's axis that points up, "y" or "z": if it lies on its side, the other
# fit_lower = [0.2, 0.2, 0.0]    # scale it to fit between these corners, standing on the lower one; or scale = 0.01
# fit_upper = [1.0, 1.0, 0.8]
# resolution = 256               # finer edges and thin parts (128 along its longest side, if left out)
# albedo = 0.6                   # or { faces = "colors" }, those of the file; or { faces = "albedo.npy" }, (faces[, bands])

[medium]                         # leave it out for vacuum
scattering = "0.6 /m"
absorption = "0.05 /m"
# density = "smoke.npy"          # .npy, .npz, .zarr, .vdb: the coefficients are then those of density 1

[[lights]]
kind = "sky"
radiance = [0.35, 0.5, 0.8]      # W m^-2 sr^-1
# image = "sky.exr"              # latitude-longitude, twice as wide as high; times radiance
# cie = 12                       # or a CIE standard sky: 1 overcast, 5 even, 12 clear; then radiance is that at the zenith,
# elevation = 55                 # and the sun's place sets the pattern (1, 3, 5 and 16 need none; the sun's own light is below)
# azimuth = 200
# ground = 0.1                   # radiance from below the horizon

[[lights]]
kind = "sun"
elevation = 55                   # or direction = [x, y, z], that of travel
azimuth = 200                    # of where it stands, from +x towards +y
irradiance = [3.0, 2.7, 2.2]     # across the beam, W m^-2

# [[lights]]
# kind = "point"
# position = [0.6, 0.6, 1.0]
# intensity = 0.2                # W sr^-1

[[cameras]]                      # without any, the box is seen from four sides and from above
name = "front"
position = [0.6, -2.2, 1.1]
target = [0.6, 0.6, 0.55]
field_of_view = 34

# [[cameras]]
# name = "above"
# kind = "orthographic"
# center = [0.6, 0.6, 1.2]
# direction = [0, 0, -1]
# up = [0, 1, 0]
# width = 1.2
"""


def save_scene(
    path: str | os.PathLike[str],
    scene: Scene,
    cameras: Mapping[str, AbstractCamera] | None = None,
    description: str = "",
    bands: Bands | None = None,
    white: Any = None,
) -> None:
    """Write `scene` and `cameras` as a scene file that `load_scene` reads back to the same scene; lengths are in metres.

    `bands`: the wavelengths of the scene's bands; with them `white`, the band values that pictures show as white, D65 if None.

    **Raises** `ValueError` for what a file cannot hold (skies and shapes of one's own); `FileNotFoundError` if the directory is
    missing.
    """
    checks.instance("scene", scene, Scene, "pass an rm.Scene")
    path = Path(path)
    if path.suffix.lower() != ".toml":
        checks.fail("path", repr(str(path)), "a name that ends in .toml", f"write {str(path) + '.toml'!r}")
    if bands is not None and len(bands) != scene.bands:
        checks.fail("bands", f"{len(bands)} of them", f"the scene's {scene.bands}", "leave them out for R, G, B")
    lattice = scene.lattice
    writer = _Writer(path, lattice)
    out = [f"format = {FORMAT}"] + ([f"description = {_value(description)}"] if description else [])
    if bands is not None:
        shown = {"illuminant": "D65"} if white is None else np.asarray(white, float).tolist()
        out += _block("[bands]", {"edges": list(bands.edges), "white": shown})
    out += _block("[lattice]", {"shape": list(lattice.shape), "spacing": lattice.spacing, "origin": list(lattice.origin)})
    sides = [
        {"albedo": writer.albedo(side.albedo, f"wall-{'xyz'[n // 2]}{n % 2}"), "emission": _plain(side.emission)}
        if isinstance(side, Wall)
        else next(name for name, known in SIDES.items() if known is side)
        for n, side in enumerate(scene.boundary.sides)
    ]
    out += _block("[boundary]", {axis: sides[2 * i : 2 * i + 2] for i, axis in enumerate("xyz")})
    for number, solid in enumerate(scene.solids):
        rows = writer.shape(solid.shape, f"solids[{number}]")
        out += _block(
            "[[solids]]", {**rows, "albedo": writer.albedo(solid.albedo, f"solid{number}"), "emission": _plain(solid.emission)}
        )
    if scene.medium is not None:
        out += _block("[medium]", writer.medium(scene.medium))
    for number, light in enumerate(scene.lights):
        out += _block("[[lights]]", writer.light(light, number))
    for name, camera in (cameras or {}).items():
        out += _block("[[cameras]]", _camera(name, camera))
    with written_atomically(path) as temporary:
        temporary.write_text("\n".join(out) + "\n", encoding="utf-8")


class _Writer:
    def __init__(self, path: Path, lattice: Lattice):
        self.path, self.lattice, self.meshes, self.arrays = path, lattice, 0, 0

    def beside(self, name: str) -> Path:
        return self.path.with_name(f"{self.path.stem}-{name}")

    def shape(self, shape: Shape, name: str) -> dict[str, Any]:
        if isinstance(shape, Mesh):
            file = self.beside(f"mesh{self.meshes}.obj")
            self.meshes += 1
            lines = ["v " + " ".join(repr(float(x)) for x in vertex) for vertex in shape.vertices]
            lines += ["f " + " ".join(str(int(i) + 1) for i in face) for face in shape.faces]
            with written_atomically(file) as temporary:
                temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")
            longest = float((shape.bounds()[1] - shape.bounds()[0]).max())
            return {"shape": "mesh", "file": file.name, "resolution": round(longest / float(shape.cell))}
        if isinstance(shape, Voxels):
            own = (shape.mask.shape, float(shape.spacing), tuple(float(x) for x in shape.lower))
            if own != (self.lattice.shape, self.lattice.spacing, self.lattice.origin):
                checks.fail(name, "voxels of another lattice than the scene's", "the scene's lattice", "make them with it")
            self.arrays += 1
            return {"shape": "voxels", "file": self.array(shape.mask.astype(np.uint8), f"voxels{self.arrays}.npy")}
        if isinstance(shape, Translated):
            return self._moved(shape.shape, name, {"translate": _plain(shape.offset)})
        if isinstance(shape, Rotated):
            turn = {"axis": _plain(shape.axis), "angle": math.degrees(float(shape.angle)), "center": _plain(shape.center)}
            return self._moved(shape.shape, name, {"rotate": turn})
        if isinstance(shape, Union | Intersection | Difference):
            parts = (shape.shape, shape.removed) if isinstance(shape, Difference) else shape.shapes
            first, *others = (self.shape(part, name) for part in parts)
            if set(first) & {"union", "intersection", "difference", "rotate", "translate"}:
                first = _group(first)
            return {**first, type(shape).__name__.lower(): others} if others else first
        for kind, (make, needed, optional) in SHAPES.items():
            if type(shape) is make:
                return {"shape": kind, **{key: _plain(getattr(shape, key)) for key in (*needed, *optional)}}
        checks.fail(name, type(shape).__name__, f"one of {', '.join(SHAPES)}, mesh", "files know no other shapes")

    def _moved(self, shape: Shape, name: str, move: dict[str, Any]) -> dict[str, Any]:
        rows = self.shape(shape, name)
        # In a file combinations come first, then the rotation, then the translation.
        late = {"rotate": {"rotate", "translate"}, "translate": {"translate"}}[next(iter(move))]
        return {**(_group(rows) if set(rows) & late else rows), **move}

    def medium(self, medium: Medium) -> dict[str, Any]:
        rows = {}
        for key in ("scattering", "absorption", "emission"):
            value = np.asarray(getattr(medium, key))
            rows[key] = _plain(value) if value.ndim < 3 else self.array(value, f"{key}.npy")
        return rows

    def albedo(self, value: Any, name: str) -> Any:
        if not isinstance(value, Texture):
            return _plain(value)
        values = np.asarray(value.values)
        if value.faces is not None:
            return {"faces": self.array(values[:, 0], f"{name}-albedo.npy")}
        corners = {
            key: _plain(corner) for key, corner in (("lower", value.lower), ("upper", value.upper)) if corner is not None
        }
        return {"texture": self.array(values, f"{name}-albedo.npy"), "axis": value.axis, **corners}

    def array(self, value: np.ndarray, name: str) -> str:
        file = self.beside(name)
        with written_atomically(file) as temporary:
            np.save(temporary, value, allow_pickle=False)
        return file.name

    def light(self, light: Sky | Sun | PointLight, number: int) -> dict[str, Any]:
        if isinstance(light, Sun):
            return {"kind": "sun", "direction": _plain(light.direction), "irradiance": _plain(light.irradiance)}
        if isinstance(light, PointLight):
            return {"kind": "point", "position": _plain(light.position), "intensity": _plain(light.intensity)}
        half = {} if light.hemisphere is None else {"hemisphere": _plain(light.hemisphere)}
        if isinstance(light.radiance, CieSky):
            sky = light.radiance
            sun = {} if sky.sun_direction is None else {"direction": _plain(sky.sun_direction)}
            rows = {"kind": "sky", "cie": sky.kind, **sun, "radiance": _plain(sky.zenith)}
            return rows | {"ground": _plain(sky.ground), "up": _plain(sky.up), **half}
        if callable(light.radiance):
            advice = "sample it as a latitude-longitude image first"
            checks.fail(f"lights[{number}].radiance", "a function", "numbers or an image", advice)
        radiance = np.asarray(light.radiance)
        if radiance.ndim < 2:
            return {"kind": "sky", "radiance": _plain(radiance), **half}
        return {"kind": "sky", "image": self.array(radiance, f"sky{number}.npy"), **half}


def _group(rows: dict[str, Any]) -> dict[str, Any]:
    """A shape as a part, so that what is done to it comes before what is done to the whole."""
    return {"shape": "group", "parts": [rows]}


def _camera(name: str, camera: AbstractCamera) -> dict[str, Any]:
    rows: dict[str, Any] = {"name": name}
    if isinstance(camera, PerspectiveCamera):
        keys = ("position", "target", "up", "field_of_view")
        return rows | {key: _plain(getattr(camera, key)) for key in keys}
    checks.instance(f"cameras[{name!r}]", camera, OrthographicCamera, "other cameras have no place in a file")
    return (
        rows | {"kind": "orthographic"} | {key: _plain(getattr(camera, key)) for key in ("center", "direction", "up", "width")}
    )


def _plain(value: Any) -> Any:
    array = np.asarray(value)
    if array.dtype == np.float32:
        return [_shortest(x) for x in array] if array.ndim else _shortest(array[()])
    return array.astype(float).tolist()


def _shortest(value: Any) -> float:
    """The shortest decimals that come back as the same number in single precision."""
    # Not str(value), which numpy's print options may cut short.
    tries = (float(f"{value:.{digits}g}") for digits in range(6, 10))
    return next((t for t in tries if np.float32(t) == value), float(value))


def _block(header: str, rows: Mapping[str, Any]) -> list[str]:
    return ["", header, *(f"{key} = {_value(value)}" for key, value in rows.items())]


def _value(value: Any) -> str:
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_value(item) for item in value) + "]"
    return repr(value)
