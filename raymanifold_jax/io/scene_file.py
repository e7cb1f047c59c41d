"""Scene files: a scene and its cameras in TOML, read with an eye for mistakes.

`raymanifold init` writes an example that says what there is. Lengths are numbers in the scene's unit, `lattice.length_unit`, or
text with a unit of its own ("25 cm"); coefficients of media likewise ("0.3 /m"); angles are in degrees. With a table [bands]
values may be spectra: of colour science, or measured ones. Files named in a scene file are looked for beside it. Every error
names the file, the line, the key, what was expected and the way out.

Public names: `load_scene`, `SceneFile`, `SceneFileError`, `read_sky`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from ..camera import AbstractCamera, OrthographicCamera, PerspectiveCamera
from ..lattice import Lattice
from ..mesh import Mesh
from ..scene import MIRROR, OPEN, PERIODIC, Boundary, Medium, PointLight, Scene, Sky, Solid, Sun, Wall
from ..shapes import Box, Cylinder, HalfSpace, Shape, Sphere, Torus
from ..skies import KINDS, SUNLESS, cie
from ..spectra import Bands
from ..texture import Texture
from ..voxels import Voxels
from .exr import read_exr
from .mesh_colors import read_face_colors
from .toml_table import LENGTHS, SceneFileError, Table, read_toml
from .volume import medium_from_density, read_volume, resampled

FORMAT = 1

#: Shapes by name: the class, and how each of its arguments is read; those in brackets may be left out.
SHAPES: dict[str, tuple[type[Shape], dict[str, Callable], dict[str, Callable]]] = {
    "sphere": (Sphere, {"center": Table.place, "radius": Table.length}, {}),
    "box": (Box, {"lower": Table.place, "upper": Table.place}, {}),
    "torus": (
        Torus,
        {"center": Table.place, "major_radius": Table.length, "minor_radius": Table.length},
        {"axis": Table.vector},
    ),
    "cylinder": (Cylinder, {"start": Table.place, "end": Table.place, "radius": Table.length}, {}),
    "half-space": (HalfSpace, {"point": Table.place, "normal": Table.vector}, {}),
}
SIDES = {"open": OPEN, "mirror": MIRROR, "periodic": PERIODIC}

Camera = Callable[[Lattice, tuple[int, int]], AbstractCamera]


@dataclass(frozen=True)
class SceneFile:
    """What a scene file says: `scene`, and `cameras` by name as functions of (lattice, resolution).

    `bands`: the wavelengths of the scene's bands, if the file tells, and `white`, the band values that pictures show as white.
    """

    path: Path
    scene: Scene
    cameras: Mapping[str, Camera] = field(repr=False)
    description: str = ""
    bands: Bands | None = None
    white: Any = field(default=None, repr=False)


def load_scene(path: str | os.PathLike[str], size: int | None = None) -> SceneFile:
    """Read a scene file.

    **Arguments:** `size`: voxels along the longest side, in place of the file's; the box stays the same.

    **Raises** `FileNotFoundError`, or `SceneFileError` (a `ValueError`) whose message starts with the file and the line.
    """
    top = read_toml(path)
    version = top.take("format", read=Table.whole)
    if version != FORMAT:
        raise top.fail("format", version, str(FORMAT), "newer files need a newer raymanifold")
    description = top.take("description", "", Table.text)
    bands, white = _bands(top.table("bands")) if top.has("bands") else top.take("bands", (None, None))
    top.source.bands = bands
    drawn, lattice = _lattice(top.table("lattice"), size)
    solids = [_solid(table, drawn) for table in top.tables("solids")]
    medium = _medium(top.table("medium"), lattice) if top.has("medium") else top.take("medium", None)
    lights = [_light(table) for table in top.tables("lights")]
    boundary = _boundary(top.table("boundary"))
    cameras: dict[str, Camera] = {}
    for table in top.tables("cameras"):
        name, camera = _camera(table, len(cameras))
        if name in cameras:
            raise table.fail("name", name, "a name of its own", "two cameras have it")
        cameras[name] = camera
    top.done()
    with top.checked():
        scene = Scene(lattice, solids, medium, lights, boundary)
    if bands is not None and scene.bands != len(bands):
        got = f"values of {scene.bands} band" + "s" * (scene.bands > 1)
        raise top.fail(
            "bands", got, f"some of {len(bands)}, as many as there are wavelengths", "give a spectrum, or leave it out"
        )
    return SceneFile(Path(path), scene, cameras, description, bands, white)


def _bands(table: Table) -> tuple[Bands, Any]:
    """The wavelengths, and the band values of white."""
    edges, centres = table.take("edges", None, Table.numbers), table.take("centres", None, Table.numbers)
    with table.checked():
        bands = table.source.bands = Bands(edges=edges, centres=centres)
    white = table.take("white", None, Table.numbers)
    table.done()
    with table.checked():
        white = bands.illuminant("D65").tolist() if white is None else white
        bands.rgb_matrix(white)  # what is wrong shows now
    return bands, white


def _lattice(table: Table, size: int | None) -> tuple[Lattice, Lattice]:
    """The file's lattice, and the one asked for."""
    unit = table.take("length_unit", "m", Table.text)
    if unit not in LENGTHS:
        raise table.fail("length_unit", unit, f"one of {', '.join(LENGTHS)}", 'leave it out for "m"')
    table.source.unit = LENGTHS[unit]
    shape = table.take("shape")
    if not (isinstance(shape, list) and len(shape) == 3 and all(type(n) is int and 0 < n <= 1 << 14 for n in shape)):
        raise table.fail("shape", shape, "three whole numbers of voxels, 1 to 16384", "write shape = [64, 64, 64]")
    spacing = table.take("spacing", read=Table.length)
    origin = table.take("origin", [0.0, 0.0, 0.0], Table.place)
    table.done()
    with table.checked():
        drawn = Lattice(shape, spacing, origin)
    if size is None or size == max(shape):
        return drawn, drawn
    factor = size / max(shape)
    return drawn, Lattice([max(1, round(n * factor)) for n in shape], spacing / factor, origin)


def _solid(table: Table, lattice: Lattice) -> Solid:
    shape = _shape(table, lattice)
    albedo = table.take("albedo", 0.5, _albedo_of(shape))
    emission = table.take("emission", 0.0, Table.numbers)
    table.done()
    with table.checked():
        return Solid(shape, albedo, emission)


def _albedo_of(shape: Shape | None) -> Callable:
    """Reads numbers, a texture, or (of a mesh) a value for each face."""

    def read(table: Table, key: str, value: Any) -> Any:
        if not (isinstance(value, dict) and ("texture" in value or "faces" in value)):
            return Table.numbers(table, key, value)
        inner = Table(value, (*table.path, key), table.source)
        if inner.has("texture"):
            values = _numbers(inner, "texture")
            axis = inner.take("axis", "z", Table.text)
            lower, upper = (inner.take(name, None, Table.places) for name in ("lower", "upper"))
            inner.done()
            with inner.checked():
                return Texture(values, axis, lower, upper)
        if shape is None:
            raise inner.fail("faces", "a wall", "a mesh", "walls take { texture = ... }")
        colors = inner.take("faces", read=Table.text) == "colors"
        if colors and table.source.bands is not None:
            raise inner.fail(
                "faces", "colors", "values in the bands of wavelength", "give a file (F, bands), or leave out [bands]"
            )
        if colors and "file" not in table.values:
            raise inner.fail("faces", "colors", "a mesh, whose file has them", 'write shape = "mesh" and file = "..."')
        if colors:
            with table.checked():
                values = read_face_colors(table.source.folder / table.values["file"])
        else:
            values = _numbers(inner, "faces")
        inner.done()
        with inner.checked():
            return Texture.on_faces(shape, values)

    return read


def _shape(table: Table, lattice: Lattice) -> Shape:
    kind = table.take("shape", read=Table.text)
    if kind in SHAPES:
        make, needed, optional = SHAPES[kind]
        values = {key: table.take(key, read=read) for key, read in needed.items()}
        values |= {key: table.take(key, read=read) for key, read in optional.items() if table.has(key)}
        table.known += optional
        with table.checked():
            shape = make(**values)
    elif kind == "group":
        tables = table.tables("parts")
        parts = [_shape(part, lattice) for part in tables]
        if not parts:
            raise table.fail("parts", "none", "a list of shapes", 'write parts = [{ shape = "sphere", ... }]')
        for part in tables:
            part.done()
        shape = parts[0].union(*parts[1:]) if len(parts) > 1 else parts[0]
    elif kind == "mesh":
        shape = _mesh(table)
    elif kind == "voxels":
        labels = _array(table, "file", "array")
        label = table.take("label", None, Table.whole)
        with table.checked():
            if np.issubdtype(labels.dtype, np.floating) and (labels == np.round(labels)).all():
                labels = labels.astype(int)
            shape = Voxels(labels if label is None else labels == label, lattice)
    else:
        expected = ", ".join([*SHAPES, "mesh", "voxels", "group"])
        raise table.fail("shape", kind, f"one of {expected}", 'write shape = "sphere"')
    for key in ("union", "intersection", "difference"):
        for part in table.tables(key):
            other = _shape(part, lattice)
            part.done()
            shape = getattr(shape, key)(other)
    if table.has("rotate"):
        turn = table.table("rotate")
        axis, angle = turn.take("axis", read=Table.vector), turn.take("angle", read=Table.angle)
        center = turn.take("center", [0.0, 0.0, 0.0], Table.place)
        turn.done()
        with turn.checked():
            shape = shape.rotate(axis, angle, center)
    table.known.append("rotate")
    offset = table.take("translate", None, Table.place)
    return shape if offset is None else shape.translate(offset)


def _mesh(table: Table) -> Shape:
    file = table.source.folder / table.take("file", read=Table.text)
    scale, up = table.take("scale", 1.0, Table.number), table.take("up", "z", Table.text)
    resolution = table.take("resolution", 128, Table.whole)
    lower, upper = table.take("fit_lower", None, Table.place), table.take("fit_upper", None, Table.place)
    if (lower is None) != (upper is None):
        raise table.fail(None, "one of fit_lower and fit_upper", "both or none", "they are the corners of a box")
    with table.checked():
        mesh = Mesh.load(file, scale, up=up, resolution=resolution)
        return mesh if lower is None else mesh.fit(lower, upper)


def _array(table: Table, key: str, name_key: str) -> np.ndarray:
    file = table.source.folder / table.take(key, read=Table.text)
    name = table.take(name_key, None, Table.text)
    with table.checked():
        return read_volume(file, name)


def _numbers(table: Table, key: str) -> np.ndarray:
    """An array of any shape from a .npy file."""
    file = table.source.folder / table.take(key, read=Table.text)
    if file.suffix.lower() != ".npy":
        raise table.fail(key, file.name, "a file .npy", "np.save writes one")
    if not file.is_file():
        raise table.fail(key, file.name, "a file that exists", "files are looked for beside the scene's")
    try:
        return np.load(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise table.fail(key, file.name, f"an array of numbers ({error})", "write it again with np.save") from error


def _or_array(read: Callable, lattice: Lattice) -> Callable:
    def either(table: Table, key: str, value: Any) -> Any:
        if not (isinstance(value, str) and value.lower().endswith((".npy", ".npz", ".zarr", ".vdb"))):
            return read(table, key, value)
        with table.checked():
            return resampled(read_volume(table.source.folder / value), lattice.shape)

    return either


def _medium(table: Table, lattice: Lattice) -> Medium:
    read = {"scattering": Table.per_length, "absorption": Table.per_length, "emission": Table.numbers}
    parts = {key: table.take(key, 0.0, _or_array(how, lattice)) for key, how in read.items()}
    scale = table.take("density_scale", 1.0, Table.number)
    table.known += ["density", "density_array"]
    if table.has("density"):
        density = _array(table, "density", "density_array")
        table.done()
        with table.checked():
            return medium_from_density(density, lattice, **parts, scale=scale)
    table.done()
    with table.checked():
        return Medium(**parts)


def _light(table: Table) -> Sky | Sun | PointLight:
    kind = table.take("kind", read=Table.text)
    if kind == "sky":
        return _sky(table)
    if kind == "sun":
        travel = _travel(table)
        irradiance = table.take("irradiance", 1.0, Table.numbers)
        table.done()
        if travel is None:
            raise table.fail(None, "neither of direction and elevation, azimuth", "one of them", _TRAVEL)
        with table.checked():
            return Sun(travel, irradiance)
    if kind == "point":
        position, intensity = table.take("position", read=Table.place), table.take("intensity", 1.0, Table.numbers)
        table.done()
        with table.checked():
            return PointLight(position, intensity)
    raise table.fail("kind", kind, "one of sky, sun, point", 'write kind = "sky"')


_TRAVEL = "direction is that of travel; azimuth is counted from +x towards +y"


def _travel(table: Table) -> list[float] | None:
    """The direction in which sunlight travels, if the table tells where the sun is."""
    travel = table.take("direction", None, Table.vector)
    height, azimuth = table.take("elevation", None, Table.angle), table.take("azimuth", None, Table.angle)
    if travel is not None and not (height is None and azimuth is None):
        raise table.fail(None, "both of direction and elevation, azimuth", "one of them", _TRAVEL)
    if (height is None) != (azimuth is None):
        raise table.fail(None, "one of elevation and azimuth", "both", _TRAVEL)
    if height is None or azimuth is None:
        return travel
    return [-math.cos(height) * math.cos(azimuth), -math.cos(height) * math.sin(azimuth), -math.sin(height)]


def _sky(table: Table) -> Sky:
    hemisphere = table.take("hemisphere", None, Table.vector)
    image, kind = table.take("image", None, Table.text), table.take("cie", None, Table.whole)
    if kind is not None:
        if image is not None:
            raise table.fail("cie", kind, "one of cie and image", "leave one out")
        travel = _travel(table)
        values = {key: table.take(key, None, Table.numbers) for key in ("radiance", "irradiance")}
        up, ground = table.take("up", [0.0, 0.0, 1.0], Table.vector), table.take("ground", 0.0, Table.numbers)
        table.done()
        if None not in values.values():
            raise table.fail(
                "irradiance", values["irradiance"], "one of radiance (at the zenith) and irradiance", "leave one out"
            )
        if travel is None and kind in KINDS and kind not in SUNLESS:
            raise table.fail(None, "no sun", "elevation and azimuth of the sun, or direction", _TRAVEL)
        with table.checked(kind="cie", zenith="radiance", sun_direction="elevation" if table.has("elevation") else "direction"):
            return Sky(cie(kind, travel, values["radiance"], values["irradiance"], up, ground), hemisphere)
    radiance = table.take("radiance", 1.0, Table.numbers)
    table.known += ["elevation", "azimuth", "direction", "irradiance", "up", "ground"]
    for key in ("elevation", "azimuth", "direction", "irradiance", "up", "ground"):
        if table.has(key):
            raise table.fail(key, table.values[key], "nothing, without cie", "add a line cie = 12, or leave it out")
    table.done()
    with table.checked():
        if image is not None:
            factor = np.atleast_1d(np.asarray(radiance, float))
            path = table.source.folder / image
            if path.suffix.lower() == ".npy":
                radiance = np.load(path, allow_pickle=False) * (factor if factor.size > 1 else factor[0])
            else:
                radiance = read_sky(path) * factor
        return Sky(radiance, hemisphere)


def read_sky(path: str | os.PathLike[str]) -> np.ndarray:
    """A latitude-longitude OpenEXR image as `rm.Sky` takes it: (h, 2h) or (h, 2h, bands), an alpha channel left out.

    Pictures of the sky have azimuth growing to the right as seen from inside, clockwise from above; `rm.Sky` counts it
    anticlockwise, so columns are turned around.
    """
    image, names, _ = read_exr(path)
    image = image[:, ::-1, [i for i, name in enumerate(names) if name != "A"]]
    return image[..., 0] if image.shape[2] == 1 else image


def _boundary(table: Table) -> Boundary:
    axes = {axis: table.take(axis, OPEN, _axis) for axis in "xyz"}
    table.done()
    with table.checked():
        return Boundary(**axes)


def _axis(table: Table, key: str, value: Any) -> Any:
    if isinstance(value, list):
        if len(value) != 2:
            raise table.fail(key, f"{len(value)} sides", "one for both, or [lower, upper]", f'write {key} = ["open", "open"]')
        return tuple(_side(table, key, side) for side in value)
    return _side(table, key, value)


def _side(table: Table, key: str, value: Any) -> Any:
    if isinstance(value, dict):
        wall = Table(value, (*table.path, key), table.source)
        albedo, emission = wall.take("albedo", 0.5, _albedo_of(None)), wall.take("emission", 0.0, Table.numbers)
        wall.done()
        with wall.checked():
            return Wall(albedo, emission)
    if isinstance(value, str) and value in SIDES:
        return SIDES[value]
    raise table.fail(key, value, "open, mirror, periodic or a wall", f"write {key} = {{ albedo = 0.5 }}")


def _camera(table: Table, number: int) -> tuple[str, Camera]:
    name = table.take("name", f"camera{number + 1}", Table.text)
    if not name or not all(c.isalnum() or c in "-_" for c in name):
        raise table.fail("name", name, "letters, digits, - and _", "it becomes part of a file's name")
    kind = table.take("kind", "perspective", Table.text)
    up = table.take("up", [0.0, 0.0, 1.0], Table.vector)
    if kind == "perspective":
        position, target = table.take("position", read=Table.place), table.take("target", read=Table.place)
        view = math.degrees(table.take("field_of_view", math.radians(40.0), Table.angle))
        make = lambda _, resolution: PerspectiveCamera(position, target, up, view, resolution)
    elif kind == "orthographic":
        center, travel = table.take("center", read=Table.place), table.take("direction", read=Table.vector)
        width = table.take("width", read=Table.length)
        make = lambda _, resolution: OrthographicCamera(center, travel, up, width, resolution=resolution)
    else:
        raise table.fail("kind", kind, "perspective or orthographic", 'write kind = "perspective"')
    table.done()
    with table.checked():
        make(None, (8, 8))  # what is wrong shows now
    return name, make


__all__ = ["SceneFile", "SceneFileError", "load_scene", "read_sky"]
