"""Problems with known answers: each function returns a scene and what must come out of it.

The closed form and its source stand in the docstrings. Lengths are in units of the lattice's longest side unless said; 1/pi is
the radiance that makes a surface's own exitance 1.
"""

from typing import Any, NamedTuple

import numpy as np

import raymanifold_jax as rm

from .data import table

UNIT_EXITANCE = 1 / np.pi


class Problem(NamedTuple):
    """A scene, and the expected value of whatever the function's docstring says."""

    scene: rm.Scene
    expected: Any


def cube(n: int) -> rm.Lattice:
    return rm.Lattice((n, n, n), spacing=1 / n)


def walls(albedo: Any, emission: Any = 0.0, top: Any = None) -> rm.Boundary:
    """Six equal walls, or five and another `top`."""
    wall = rm.Wall(albedo, emission)
    return rm.Boundary(wall, wall, (wall, wall if top is None else top))


BALL = rm.Sphere((0.45, 0.52, 0.4), 0.27)
BLOCK = rm.Box((0.25, 0.25, 0), (0.75, 0.5, 0.5))
SPHERICAL_CAVITY = rm.Box((-1, -1, -1), (2, 2, 2)).difference(rm.Sphere((0.5, 0.5, 0.5), 0.4))


def furnace(cavity: str, albedo: float, medium: rm.Medium | None = None, n: int = 8) -> Problem:
    """White furnace: in a closed cavity of any shape whose surfaces have albedo rho and exitance 1, the radiosity is

        B = 1 / (1 - rho)

    everywhere, as is pi times the radiance, whatever medium of scattering albedo 1 fills it (`closed_enclosures.csv`). In
    voxels the expected fluence is 4 B. `cavity`: "box", "ball" (a box with a ball in it), "block" (a box with a block on its
    floor) or "sphere".
    """
    shapes = {"box": [], "ball": [BALL], "block": [BLOCK], "sphere": [SPHERICAL_CAVITY]}[cavity]
    solids = [rm.Solid(shape, albedo, UNIT_EXITANCE) for shape in shapes]
    scene = rm.Scene(cube(n), solids, medium, boundary=walls(albedo, UNIT_EXITANCE))
    return Problem(scene, 1 / (1 - albedo))


def white_sky(albedo: float, medium: rm.Medium | None = None, n: int = 8) -> Problem:
    """White furnace without walls: a sky of radiance 1 around bodies of albedo rho that emit 1 - rho, so that all they send is

        rho + (1 - rho) = 1

    and radiance is 1 everywhere: irradiance and radiosity are pi, fluence is 4 pi, in any medium of scattering albedo 1.
    """
    return Problem(rm.Scene(cube(n), [rm.Solid(BALL, albedo, 1 - albedo)], medium, [rm.Sky(1.0)]), np.pi)


def lone_ball(albedo: float, n: int = 8) -> Problem:
    """A ball, which is convex and so sees nothing of itself, in a sky of radiance 1: irradiance is pi for any albedo."""
    return Problem(rm.Scene(cube(n), [rm.Solid(BALL, albedo)], lights=[rm.Sky(1.0)]), np.pi)


def beer_lambert(depth: float, direction: Any = (0, 0, -1), n: int = 8) -> Problem:
    """A sun above a black box without a roof, filled with an absorbing medium of optical depth tau from top to floor:

        E = E0 mu exp(-tau / mu),        mu = -direction_z,

    on the part of the floor that no wall shades (Beer-Lambert). The expected value is (irradiance, mask over the floor's
    voxels), E0 = 2.
    """
    travel = np.asarray(direction, float) / np.linalg.norm(direction)
    scene = rm.Scene(
        cube(n),
        medium=rm.Medium(absorption=depth),
        lights=[rm.Sun(travel, 2.0)],
        boundary=walls(0.0, top=rm.OPEN),
    )
    # Voxel i of the floor is lit through the roof if its light entered at i - shift >= 0 everywhere in the voxel.
    shift = travel[:2] / -travel[2] * n
    i = np.arange(n)
    lit = [(i - s >= 0) & (i + 1 - s <= n) for s in shift]
    return Problem(scene, (2 * -travel[2] * np.exp(-depth / -travel[2]), lit[0][:, None] & lit[1]))


def cube_view_factors(n: int = 32) -> Problem:
    """A black cube whose floor emits: the shares of its power that the opposite and each adjacent face get are the view factors

        0.1998249 and 0.2000438

    (`view_factors.csv`: Howell's catalogue C-11, C-14). The floor's power is 1.
    """
    rows = {row["howell_id"]: row for row in reversed(table("view_factors.csv"))}
    expected = tuple(float(rows[name]["value_published"]) for name in ("C-11", "C-14"))
    black = rm.Wall(0.0)
    boundary = rm.Boundary(black, black, (rm.Wall(0.0, UNIT_EXITANCE), black))
    return Problem(rm.Scene(cube(n), boundary=boundary), expected)


def ball_under_half_sky(n: int = 24) -> Problem:
    """A black ball of radius n / 3 voxels under the upper half of a sky of radiance 1: with the normal's height n_z

        E = pi (1 + n_z) / 2

    (the sky's view factor from a tilted plane: Liu & Jordan, Solar Energy 4, 1960). The expected value is a function of
    normals.
    """
    scene = rm.Scene(cube(n), [rm.Solid(rm.Sphere((0.5, 0.5, 0.5), 1 / 3), 0.0)], lights=[rm.Sky(1.0, hemisphere=(0, 0, 1))])
    return Problem(scene, lambda normals: np.pi * (1 + normals[:, 2]) / 2)


def grey_plates(first: float, second: float, side: Any, width: int = 1, height: int = 8) -> Problem:
    """Two infinite grey plates of emissivity e1, e2, black-body emissive powers 1 (floor) and 0: the net flux upwards is

        q = 1 / (1 / e1 + 1 / e2 - 1)

    (`closed_enclosures.csv`). The plates go on to infinity because the sides are PERIODIC or MIRROR.
    """
    scene = rm.Scene(
        rm.Lattice((width, width, height), spacing=1 / height),
        boundary=rm.Boundary(side, side, (rm.Wall(1 - first, first * UNIT_EXITANCE), rm.Wall(1 - second))),
    )
    return Problem(scene, 1 / (1 / first + 1 / second - 1))


def filled_sphere(albedo: float, depth: float, n: int = 16) -> Problem:
    """A sphere of radius r filled with a medium that absorbs kappa, wall of albedo a, emitted radiance 1: wall radiance is

        L = 1 / (1 - a t),    t = 2 (1 - (1 + 2 kappa r) exp(-2 kappa r)) / (2 kappa r)^2

    (`closed_enclosures.csv`; t is the wall-to-wall mean transmittance). `depth` = kappa r. The expected value is L.
    """
    t = 2 * (1 - (1 + 2 * depth) * np.exp(-2 * depth)) / (2 * depth) ** 2
    solid = rm.Solid(SPHERICAL_CAVITY, albedo, 1.0)
    scene = rm.Scene(cube(n), [solid], rm.Medium(absorption=depth / 0.4), boundary=walls(albedo, 1.0))
    return Problem(scene, 1 / (1 - albedo * t))


def asymmetric(lattice: rm.Lattice, turn: np.ndarray, medium: bool = True, sun: bool = True) -> rm.Scene:
    """A scene without any symmetry, turned by the rotation matrix `turn`, a signed permutation.

    `lattice` is the one before turning, in voxels, its origin at 0. A ball and a box off the centre, a medium that differs
    in every octant, half a sky, a sun, walls on three sides with different albedos and open sides elsewhere.
    """
    shape = np.array(lattice.shape)
    turned = np.abs(turn) @ shape
    # Points turn about the middle: x -> turn (x - shape / 2) + turned / 2.
    at = lambda x: turn @ (np.asarray(x) * shape - shape / 2) + turned / 2
    corners = np.sort([at((0.55, 0.5, 0.0)), at((0.8, 0.9, 0.4))], axis=0)
    corners = np.round(corners)
    solids = [
        rm.Solid(rm.Sphere(at((0.33, 0.36, 0.6)), 2.2), 0.8, 0.1),
        rm.Solid(rm.Box(corners[0], corners[1]), 0.5, 0.0),
    ]
    sides: list[Any] = [rm.Wall(0.6), rm.OPEN, rm.OPEN, rm.Wall(0.3, 0.2), rm.Wall(0.9), rm.OPEN]
    turned_sides: list[Any] = [None] * 6
    for side, kind in enumerate(sides):
        outward = np.eye(3)[side // 2] * (1 if side % 2 else -1)
        axis = int(np.argmax(np.abs(turn @ outward)))
        turned_sides[2 * axis + int((turn @ outward)[axis] > 0)] = kind
    lights: list[Any] = [rm.Sky(1.0, hemisphere=turn @ (0.3, 0.2, 1.0))]
    if sun:
        lights.append(rm.Sun(turn @ (-0.5, 0.23, -1.0), 2.0))
    return rm.Scene(
        rm.Lattice(tuple(int(n) for n in turned)),
        solids,
        _octants(lattice.shape, turn) if medium else None,
        lights,
        rm.Boundary(*(tuple(turned_sides[2 * a : 2 * a + 2]) for a in range(3))),
    )


def turned_field(field: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """A field (nx, ny, nz) of the lattice, turned by a signed permutation matrix."""
    axes = np.argmax(np.abs(turn), axis=1)
    reversed_axes = [new for new, old in enumerate(axes) if turn[new, old] < 0]
    return np.flip(field.transpose(axes), tuple(reversed_axes))


def _octants(shape: tuple[int, int, int], turn: np.ndarray) -> rm.Medium:
    upper = np.stack(np.meshgrid(*[np.arange(n) >= n // 2 for n in shape], indexing="ij"), axis=-1)
    number = upper @ np.array([1, 2, 4])
    fields = (0.02 + 0.03 * number, 0.01 * (7 - number), 0.002 * (number % 3))
    scattering, absorption, emission = (turned_field(field, turn) for field in fields)
    return rm.Medium(scattering, absorption, emission)
