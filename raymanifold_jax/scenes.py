"""Ready-made scenes, and the cameras that show them.

These fill the unit cube, z up, with n voxels a side:

- `ring`: a ring in an open box under sky and sun, vacuum (Langer, Breton & Zucker 1995, figure 4);
- `three_balls_in_fog`: three balls in an open box filled with fog, under the sun (figure 5);
- `room`: a closed room with a block, lit by a square in its ceiling.

`cornell_box` has its own size, in metres (see its module).

`SCENES` lists them by name, with a size to start from and their views; `cameras` makes a scene's views at a resolution,
`turntable` views of any scene from all around.
Walls are seen from inside only, so a camera outside looks through the wall in front of it.

Public names: `ring`, `three_balls_in_fog`, `room`, `cornell_box`, `SCENES`, `SceneEntry`, `find`, `cameras`, `turntable`,
`STANDARD_VIEWS`.
"""

import difflib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np

from . import checks
from .camera import AbstractCamera, OrthographicCamera, PerspectiveCamera, Vector
from .cornell_box import camera_frame, cornell_box, default_bands, light_values
from .lattice import Lattice
from .scene import OPEN, Boundary, Medium, Scene, Sky, Solid, Sun, Wall
from .shapes import Box, Sphere, Torus
from .spectra import Bands

Resolution: TypeAlias = tuple[int, int]
View: TypeAlias = Callable[[Lattice, Resolution], AbstractCamera]

_SMALLEST = 4  # voxels a side: with fewer, nothing is left of the solids


def ring(n: int = 128) -> Scene:
    """A ring, askew above the floor of an open box: albedo 0.9 throughout, sky of radiance 1 and an oblique sun.

    The ring's shadow falls on the floor, and is lit by the sky and by what ring and walls reflect.

    **Arguments:** `n`: voxels a side, >= 4. **Raises** `TypeError` or `ValueError` for anything else.
    """
    torus = Torus((0.5, 0.5, 0.36), major_radius=0.22, minor_radius=0.08, axis=(-0.4, 0.25, 1))
    return Scene(
        _unit_cube(n),
        solids=[Solid(torus, albedo=0.9)],
        lights=[Sky(radiance=1.0), Sun(direction=(0.3, 0.2, -1), irradiance=4.0)],
        boundary=_open_box(albedo=0.9),
    )


def three_balls_in_fog(n: int = 128) -> Scene:
    """Three balls in an open box full of fog, under a sun alone: surfaces of albedo 0.9, scattering 3, absorption 0.3.

    The balls, of radius 0.12, hang at heights 0.75, 0.5 and 0.25; the sun's irradiance across its beam is 3.

    **Arguments:** `n`: voxels a side, >= 4. **Raises** `TypeError` or `ValueError` for anything else.
    """
    centers = ((0.3, 0.35, 0.75), (0.65, 0.3, 0.5), (0.5, 0.7, 0.25))
    return Scene(
        _unit_cube(n),
        solids=[Solid(Sphere(center, 0.12), albedo=0.9) for center in centers],
        medium=Medium(scattering=3.0, absorption=0.3),
        lights=[Sun(direction=(0.2, 0.1, -1), irradiance=3.0)],
        boundary=_open_box(albedo=0.9),
    )


def room(n: int = 64, black_light: bool = False) -> Scene:
    """A closed room of albedo 0.75 with a block of the same on its floor, lit by a square in its ceiling.

    The block is [0.25, 0.5]² × [0, 0.5]; the light, [0.375, 0.625]² at z = 1, emits radiance 1. Multiples of 8 put all
    faces on faces of voxels, which is the most accurate; other sizes work too.

    **Arguments:** `n`: voxels a side, >= 4. `black_light`: the light has albedo 0, not 0.75.
    **Raises** `TypeError` or `ValueError` for anything else.
    """
    lattice = _unit_cube(n)
    checks.instance("black_light", black_light, bool, "pass True or False")
    wall = Wall(albedo=0.75)
    # Behind the ceiling and flush with it: the part of it that shines is this box's lower face.
    light = Box((0.375, 0.375, 1), (0.625, 0.625, 1.125))
    return Scene(
        lattice,
        solids=[
            Solid(Box((0.25, 0.25, 0), (0.5, 0.5, 0.5)), albedo=0.75),
            Solid(light, albedo=0.0 if black_light else 0.75, emission=1.0),
        ],
        boundary=Boundary(x=wall, y=wall, z=wall),
    )


@dataclass(frozen=True)
class SceneEntry:
    """A scene that has a name: `build(n)` makes it with n voxels a side, `views` are its cameras, the default first.

    `bands` are those of its wavelengths, if it has any, and `white` the band values that pictures show as white.
    """

    name: str
    build: Callable[[int], Scene]
    description: str
    default_size: int
    views: Mapping[str, View] = field(repr=False)
    bands: Bands | None = None
    white: Any = field(default=None, repr=False)


def find(name: str) -> SceneEntry:
    """The entry of `SCENES` with this name, in any case, with - or _; `three_balls_in_fog` is known as well.

    **Raises** `ValueError` for any other name, `TypeError` if it is not a string.
    """
    checks.instance("scene", name, str, 'pass a name, as in "ring"')
    wanted = name.lower().replace("_", "-")
    wanted = _ALIASES.get(wanted, wanted)
    if wanted in SCENES:
        return SCENES[wanted]
    near = difflib.get_close_matches(wanted, [*SCENES, *_ALIASES], n=1, cutoff=0.5)
    advice = f"did you mean {_ALIASES.get(near[0], near[0])!r}?" if near else "pass one of these names"
    checks.fail("scene", repr(name), f"one of {', '.join(SCENES)}", advice)


def cameras(name: str, scene: Scene, resolution: Resolution = (512, 512)) -> dict[str, AbstractCamera]:
    """The views of the scene `name`, by name, the default first; row 0 of their pictures is the top.

    **Arguments:** `scene`: what `SCENES[name].build` made. `resolution`: (width, height) in pixels; whatever its
    proportions, the whole scene is in the picture and pixels are square.

    **Raises** `ValueError` for an unknown name, `ValueError` or `TypeError` for a resolution that is not two positive
    ints.
    """
    checks.instance("scene", scene, Scene, "pass the scene itself, as in cameras('ring', ring(64))")
    return {view: make(scene.lattice, resolution) for view, make in find(name).views.items()}


def _unit_cube(n: int) -> Lattice:
    n = checks.positive_int("n", n, at_least=_SMALLEST)
    return Lattice((n, n, n), spacing=1 / n)


def _open_box(albedo: float) -> Boundary:
    wall = Wall(albedo=albedo)
    return Boundary(x=wall, y=wall, z=(wall, OPEN))


def _parallel(
    center: Vector, direction: Vector, up: Vector, extent: tuple[float, float], resolution: Resolution
) -> OrthographicCamera:
    """A parallel projection with `extent` (across, up) in the picture."""
    # Made once with any width, because the camera checks the resolution.
    camera = OrthographicCamera(center, direction, up, width=extent[0], resolution=resolution)
    width = max(extent[0], extent[1] * camera.resolution[0] / camera.resolution[1])
    return OrthographicCamera(center, direction, up, width=width, resolution=resolution)


def _top(lattice: Lattice, resolution: Resolution, depth: float = 0.0) -> OrthographicCamera:
    """The view down from `depth` below the upper side."""
    x, y, _ = (lattice.lower + lattice.upper) / 2
    across, upward, _ = lattice.extent
    return _parallel((x, y, lattice.upper[2] - depth), (0, 0, -1), (0, 1, 0), (across, upward), resolution)


def turntable(frames: int, elevation: float = 35.0) -> dict[str, View]:
    """Views once around any scene, from `elevation` degrees above its floor: as many as `frames`, "000" the one from -y.

    **Raises** `TypeError` or `ValueError` for anything but a whole number of frames, at least 1, and 0 to 90 degrees.
    """
    frames = checks.positive_int("frames", frames)
    if not (isinstance(elevation, int | float) and 0 <= elevation <= 90):
        checks.fail("elevation", repr(elevation), "degrees from 0 to 90", "35 looks down into an open box")
    digits = max(3, len(str(frames - 1)))
    return {f"{i:0{digits}d}": partial(_oblique, 360 * i / frames - 90, elevation, turning=True) for i in range(frames)}


def fly_through(views: Mapping[str, View], frames: int) -> dict[str, View]:
    """Views along a smooth path through the perspective `views`, in their order, "000" the first of them.

    Places, targets, what is up and fields of view follow cubic splines, in equal times from view to view.

    **Raises** `TypeError` or `ValueError` for fewer than two views or frames; a view's camera that is no perspective is found
    when it is made.
    """
    frames = checks.positive_int("frames", frames, at_least=2)
    if len(views) < 2:
        checks.fail("views", f"{len(views)} of them", "at least two to fly between", "add perspective cameras to the scene")
    digits = max(3, len(str(frames - 1)))
    made = tuple(views.items())
    return {f"{i:0{digits}d}": partial(_on_the_way, made, i / (frames - 1)) for i in range(frames)}


def _on_the_way(
    views: tuple[tuple[str, View], ...], share: float, lattice: Lattice, resolution: Resolution
) -> PerspectiveCamera:
    """The camera at a share of the path through some views."""
    from scipy.interpolate import CubicSpline

    stops = []
    for name, make in views:
        camera = make(lattice, resolution)
        if not isinstance(camera, PerspectiveCamera):
            checks.fail("views", f"{name!r}, a {type(camera).__name__}", "perspective cameras", "leave it out of the flight")
        stops.append([*camera.position, *camera.target, *camera.up, camera.field_of_view])
    at = CubicSpline(np.arange(len(stops)), np.array(stops), bc_type="natural")(share * (len(stops) - 1))
    return PerspectiveCamera(at[:3], at[3:6], at[6:9], float(np.clip(at[9], 1.0, 170.0)), resolution)


def _oblique(
    azimuth: float, elevation: float, lattice: Lattice, resolution: Resolution, turning: bool = False
) -> OrthographicCamera:
    """A parallel projection from a side, `azimuth` (degrees from +x), looking down on the middle of the box.

    `turning`: at the scale at which the box fits into the picture from any side.
    """
    a, e = math.radians(azimuth), math.radians(elevation)
    x, y, z = (lattice.lower + lattice.upper) / 2
    side = max(lattice.extent)
    towards = (math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e))
    # Two sides away the picture plane is outside the box everywhere.
    center = (x + 2 * side * towards[0], y + 2 * side * towards[1], z + 2 * side * towards[2])
    # The floor's depth and the walls' height, foreshortened, and a margin.
    margin = 1.03 * side * (math.sqrt(2) if turning else 1.0)
    extent = (margin, margin * (math.sin(e) + math.cos(e)))
    return _parallel(center, (-towards[0], -towards[1], -towards[2]), (0, 0, 1), extent, resolution)


def _front(
    position: Vector, target: Vector, field_of_view: float, lattice: Lattice, resolution: Resolution
) -> PerspectiveCamera:
    """A perspective from the front (-y), with `field_of_view` in degrees across the smaller side of the picture."""
    camera = PerspectiveCamera(position, target, field_of_view=field_of_view, resolution=resolution)
    narrow = camera.resolution[1] / min(camera.resolution)
    height = 2 * math.degrees(math.atan(narrow * math.tan(math.radians(field_of_view) / 2)))
    return PerspectiveCamera(position, target, field_of_view=height, resolution=resolution)


def _published(lattice: Lattice, resolution: Resolution) -> PerspectiveCamera:
    position, target, view = camera_frame()
    return _front(position, target, view, lattice, resolution)


_FROM_FOUR_SIDES: dict[str, View] = {
    side: partial(_oblique, azimuth, 50.0)
    for side, azimuth in {"south": -90.0, "east": 0.0, "north": 90.0, "west": 180.0}.items()
}

#: Views of any scene: from four sides and from above.
STANDARD_VIEWS: Mapping[str, View] = MappingProxyType({**_FROM_FOUR_SIDES, "top": _top})

#: The scenes by name.
SCENES: Mapping[str, SceneEntry] = MappingProxyType(
    {
        entry.name: entry
        for entry in (
            SceneEntry(
                "ring",
                ring,
                "a ring in an open box under sky and sun (the paper's figure 4)",
                128,
                {**_FROM_FOUR_SIDES, "top": _top},
            ),
            SceneEntry(
                "three-balls",
                three_balls_in_fog,
                "three balls in an open box full of fog, under the sun (figure 5)",
                96,
                {"front": partial(_front, (0.5, -1.9, 0.95), (0.5, 0.5, 0.47), 34.0), "top": _top},
            ),
            SceneEntry(
                "room",
                room,
                "a closed room with a block, lit by a square in its ceiling",
                64,
                # From below the ceiling: on it, the eye would touch the light.
                {"front": partial(_front, (0.5, -1.75, 0.5), (0.5, 0.5, 0.5), 34.0), "top": partial(_top, depth=1e-3)},
            ),
            SceneEntry(
                "cornell-box",
                cornell_box,
                "the Cornell box with its published spectra, in 8 bands from 400 to 700 nm",
                64,
                {"front": _published},
                default_bands(),
                light_values(default_bands()),
            ),
        )
    }
)
_ALIASES = {"three-balls-in-fog": "three-balls"}
