"""View factors, and enclosures with closed forms.

View factors are read as power: what a body of power 1 sends to a surface is gathered at points of it and integrated.
Numbers are those of `view_factors.csv`, `closed_enclosures.csv` and `fds_box_configuration_factor.csv`.
"""

import math
from functools import partial

import numpy as np

import raymanifold_jax as rm

from .case import Case, Readings, Target, readings, same
from .closed_form import (
    SPHERICAL_CAVITY,
    UNIT_EXITANCE,
    cube,
    cube_view_factors,
    filled_sphere,
    furnace,
    grey_plates,
)
from .data import columns, table

BLACK = rm.Wall(0.0)
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)


def _factor(howell: str, configuration: str) -> float:
    """A view factor, by Howell's number and the beginning of its description."""
    for row in table("view_factors.csv"):
        if row["howell_id"] == howell and row["configuration"].startswith(configuration):
            return float(row["value_formula"])
    raise KeyError(f"{howell}, {configuration}")


def _gathered(solution: rm.Solution, points: np.ndarray, normal: tuple[float, float, float]) -> np.ndarray:
    return np.asarray(rm.irradiance(solution, points, np.tile(normal, (len(points), 1))), float)


def _gauss(lower: float, upper: float, count: int) -> tuple[np.ndarray, np.ndarray]:
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return lower + (upper - lower) * (nodes + 1) / 2, weights * (upper - lower) / 2


def _on_disc(x: float, y: float, z: float, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (96, 3) of a disc across z, and the area of each."""
    squared, weights = _gauss(0, radius**2, 6)
    azimuth = 2 * np.pi * (np.arange(16) + 0.25) / 16
    r = np.sqrt(squared)[:, None]
    points = np.stack([x + r * np.cos(azimuth), y + r * np.sin(azimuth), np.full((6, 16), z)], -1)
    return points.reshape(-1, 3), np.repeat(weights * np.pi / 16, 16)


def fds_box(n: int) -> rm.Scene:
    """A black unit cube, transparent, whose wall x = 0 has exitance 1."""
    return rm.Scene(cube(n), boundary=rm.Boundary((rm.Wall(0.0, UNIT_EXITANCE), BLACK), BLACK, BLACK))


def _read_fds_box(solution: rm.Solution) -> dict[str, Readings]:
    rows = table("fds_box_configuration_factor.csv")
    y, expected = columns(rows, "y_eq_z"), columns(rows, "phi_exact")
    points = np.stack([np.ones_like(y), y, y], -1)
    read = {"gathered": readings(_gathered(solution, points, (-1.0, 0.0, 0.0)), expected)}
    # Where centres of faces lie on the points, the elements themselves can be compared.
    surfaces = solution.surfaces
    apart = np.linalg.norm(np.asarray(surfaces.positions)[None] - points[:, None], axis=-1)
    if (apart.min(1) < 1e-3 * solution.scene.lattice.spacing).all():
        read["elements"] = readings(np.asarray(surfaces.irradiance)[apart.argmin(1)], expected)
    return read


def _read_cube_faces(solution: rm.Solution) -> dict[str, Readings]:
    """Power on the opposite face, and on the four adjacent ones, of the floor's 1: of the elements, and gathered."""
    surfaces = solution.surfaces
    power = np.asarray(surfaces.irradiance, float) * np.asarray(surfaces.areas)
    facing = np.rint(np.asarray(surfaces.normals)) @ [1, 2, 3]
    expected = [_factor("C-11", "identical parallel unit squares, gap 1 ")] + [_factor("C-14", "perpendicular unit")] * 4
    nodes, weights = _gauss(0, 1, 8)
    u, v = (g.ravel() for g in np.meshgrid(nodes, nodes))
    area = np.outer(weights, weights).ravel()
    faces = {-3: (u, v, u * 0 + 1), 1: (u * 0, u, v), -1: (u * 0 + 1, u, v), 2: (u, u * 0, v), -2: (u, u * 0 + 1, v)}
    normal = lambda face: tuple(np.sign(face) * np.eye(3)[abs(face) - 1])
    gathered = [_gathered(solution, np.stack(at, -1), normal(face)) @ area for face, at in faces.items()]
    return {
        "elements": readings([power[facing == face].sum() for face in faces], expected),
        "gathered": readings(gathered, expected),
    }


_MARGIN = 0.2  # around discs of radius 1


def discs(gap: int, n: int) -> rm.Scene:
    """Black coaxial discs of radius 1, the lower one of exitance 1, let into black planes; sides open; n voxels along 2.4."""
    _check_multiple(n, 12)
    side = 2 * (1 + _MARGIN)
    middle = side / 2
    solid = rm.Solid(rm.Cylinder((middle, middle, -1), (middle, middle, 0), 1.0), 0.0, UNIT_EXITANCE)
    lattice = rm.Lattice((n, n, round(gap * n / side)), side / n)
    return rm.Scene(lattice, [solid], boundary=rm.Boundary(rm.OPEN, rm.OPEN, (BLACK, BLACK)))


def _read_discs(gap: int, solution: rm.Solution) -> dict[str, Readings]:
    middle = 1 + _MARGIN
    points, area = _on_disc(middle, middle, gap, 1.0)
    factor = _gathered(solution, points, DOWN) @ area / np.pi
    return {"gathered": readings(factor, _factor("C-41", f"coaxial equal discs r=1 gap {gap}"))}


def sphere_over_floor(n: int) -> rm.Scene:
    """A black sphere of power 1 and radius 0.35 at height 1 over a black floor, n voxels along 2.4; open elsewhere."""
    _check_multiple(n, 12)
    spacing = 2 * (1 + _MARGIN) / n
    exitance = 1 / (4 * np.pi * 0.35**2)
    ball = rm.Solid(rm.Sphere((1.2, 1.2, 1.0), 0.35), 0.0, exitance / np.pi)
    return rm.Scene(rm.Lattice((n, n, n * 2 // 3), spacing), [ball], boundary=rm.Boundary(z=(BLACK, rm.OPEN)))


def _read_sphere_to_disc(solution: rm.Solution) -> dict[str, Readings]:
    points, area = _on_disc(1.2, 1.2, 0.0, 1.0)
    expected = _factor("C-47", "sphere (any radius<gap) to coaxial disc r=1, centre distance 1")
    return {"gathered": readings(_gathered(solution, points, UP) @ area, expected)}


def sphere_and_rectangle(n: int) -> rm.Scene:
    """A black sphere of power 1 and radius 0.3 at (0.5, 0.5, 0.5), over a black floor, n voxels along 3; open elsewhere.

    The rectangle is [0.5, 1.5] x [0.5, 2.5] on the floor.
    """
    _check_multiple(n, 6)
    exitance = 1 / (4 * np.pi * 0.3**2)
    ball = rm.Solid(rm.Sphere((0.5, 0.5, 0.5), 0.3), 0.0, exitance / np.pi)
    return rm.Scene(rm.Lattice((n * 2 // 3, n, n // 3), 3 / n), [ball], boundary=rm.Boundary(z=(BLACK, rm.OPEN)))


def _read_sphere_to_rectangle(solution: rm.Solution) -> dict[str, Readings]:
    expected = _factor("B-106/C-", "small sphere to rectangle")
    (x, of_x), (y, of_y) = _gauss(0.5, 1.5, 12), _gauss(0.5, 2.5, 16)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((12, 16))], -1).reshape(-1, 3)
    gathered = _gathered(solution, points, UP) @ np.outer(of_x, of_y).ravel()
    surfaces = solution.surfaces
    at = np.asarray(surfaces.positions)
    on = (np.asarray(surfaces.normals)[:, 2] > 0.99) & (at[:, 2] < 1e-3)
    on &= (at[:, 0] > 0.5) & (at[:, 0] < 1.5) & (at[:, 1] > 0.5) & (at[:, 1] < 2.5)
    elements = np.sum(np.asarray(surfaces.irradiance, float)[on] * np.asarray(surfaces.areas)[on])
    return {"elements": readings(elements, expected), "gathered": readings(gathered, expected)}


_RADIUS, _LAMP = 0.4, np.array([0.5, 0.5, 0.6])  # of the spherical cavity, and a lamp off its centre
_SPHERE_ALBEDO = 0.9


def integrating_sphere(port: float, n: int) -> rm.Scene:
    """A spherical cavity of albedo 0.9, of which a cap, this share of its area, is black; a point light of intensity 1."""
    light = [rm.PointLight(_LAMP, 1.0)]
    if port == 0:
        return rm.Scene(cube(n), [rm.Solid(SPHERICAL_CAVITY, _SPHERE_ALBEDO)], lights=light)
    below = rm.HalfSpace((0.5, 0.5, _rim(port)), (0, 0, 1))
    above = rm.HalfSpace((0.5, 0.5, _rim(port)), (0, 0, -1))
    wall = rm.Solid(SPHERICAL_CAVITY.intersection(above), _SPHERE_ALBEDO)
    return rm.Scene(cube(n), [wall, rm.Solid(SPHERICAL_CAVITY.intersection(below), 0.0)], lights=light)


def _rim(port: float) -> float:
    return 0.5 - _RADIUS + 2 * port * _RADIUS


def _read_integrating_sphere(port: float, solution: rm.Solution) -> dict[str, Readings]:
    """Irradiance on the sphere: the lamp's own, and evenly what was reflected, Phi rho / (1 - rho (1 - f)) / A."""
    height = _LAMP[2] - _rim(port)
    rim = math.sqrt(max(0.0, _RADIUS**2 - (0.5 - _rim(port)) ** 2))
    on_wall = 2 * np.pi * (1 + height / math.hypot(height, rim))  # power that the lamp sends to the wall
    reflected = on_wall * _SPHERE_ALBEDO / (1 - _SPHERE_ALBEDO * (1 - port)) / (4 * np.pi * _RADIUS**2)

    def expected(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        to = _LAMP - points
        return reflected + (to * normals).sum(-1) / (to**2).sum(-1) ** 1.5

    i = np.arange(60)
    z = 1 - 2 * (i + 0.5) / 60
    angle = np.pi * (3 - np.sqrt(5)) * i
    inward = -np.stack([np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z], -1)
    points = 0.5 - _RADIUS * inward
    gathered = np.asarray(rm.irradiance(solution, points, inward), float)
    surfaces = solution.surfaces
    at, normals = np.asarray(surfaces.positions, float), np.asarray(surfaces.normals, float)
    return {
        "gathered": readings(gathered, expected(points, inward)),
        "elements": readings(surfaces.irradiance, expected(at, normals)),
    }


def _read_furnace(expected: float, solution: rm.Solution) -> dict[str, Readings]:
    free = np.asarray(solution.free) > 0
    return {
        "radiosity": readings(solution.surfaces.radiosity, expected),
        "fluence": readings(np.asarray(solution.fluence)[free], 4 * expected),
    }


def _read_plates(expected: float, solution: rm.Solution) -> dict[str, Readings]:
    """Net flux: radiosity less irradiance of the floor's elements."""
    surfaces = solution.surfaces
    floor = np.asarray(surfaces.normals)[:, 2] > 0
    net = np.asarray(surfaces.radiosity, float) - np.asarray(surfaces.irradiance)
    return {"net flux": readings(net[floor], expected)}


def _read_wall_radiance(expected: float, solution: rm.Solution) -> dict[str, Readings]:
    return {"wall radiance": readings(np.asarray(solution.surfaces.radiosity, float) / np.pi, expected)}


def _check_multiple(n: int, of: int) -> None:
    if n % of:
        raise ValueError(f"size: got {n}, expected a multiple of {of}, so that the problem's edges lie on voxel faces")


_EXACT = Target(worst=1e-5)
_FACTOR = Target(worst=0.003)


def _furnace_scene(n: int) -> rm.Scene:
    return furnace("ball", 0.9, rm.Medium(scattering=2.0), n).scene


CASES = (
    Case(
        name="fds-box",
        title="FDS box configuration factors",
        build=fds_box,
        readers={"values": _read_fds_box},
        sizes=(20, 60),
        targets=same(gathered=_FACTOR, elements=_FACTOR),
    ),
    Case(
        name="cube-faces",
        title="view factors between faces of a cube",
        build=lambda n: cube_view_factors(n).scene,
        readers={"values": _read_cube_faces},
        sizes=(16, 32, 64),
        targets=same(elements=_FACTOR, gathered=_FACTOR),
    ),
    *(
        Case(
            name=f"discs-{gap}",
            title=f"coaxial discs of radius 1, {gap} apart",
            build=partial(discs, gap),
            readers={"values": partial(_read_discs, gap)},
            sizes=(24, 48),
            targets=same(gathered=_FACTOR),
        )
        for gap in (1, 2)
    ),
    Case(
        name="sphere-to-disc",
        title="sphere to coaxial disc",
        build=sphere_over_floor,
        readers={"values": _read_sphere_to_disc},
        sizes=(24, 48),
        targets=same(gathered=_FACTOR),
    ),
    Case(
        name="sphere-to-rectangle",
        title="sphere to rectangle",
        build=sphere_and_rectangle,
        readers={"values": _read_sphere_to_rectangle},
        sizes=(30, 60),
        targets=same(elements=_FACTOR, gathered=_FACTOR),
    ),
    Case(
        name="furnace",
        title="furnace: a ball in a box, white fog, albedo 0.9",
        build=_furnace_scene,
        readers={"values": partial(_read_furnace, 10.0)},
        sizes=(8, 16, 32),
        targets=same(radiosity=_EXACT, fluence=_EXACT),
        rtol=2e-6,
    ),
    *(
        Case(
            name=f"integrating-sphere-{name}",
            title=f"integrating sphere, port {port:g} of its area, albedo {_SPHERE_ALBEDO:g}",
            build=partial(integrating_sphere, port),
            readers={"values": partial(_read_integrating_sphere, port)},
            sizes=(16, 32, 64),
            rtol=1e-5,
        )
        for name, port in (("closed", 0.0), ("port", 0.05))
    ),
    *(
        Case(
            name=f"plates-{side.name.lower()}",
            title=f"grey plates of emissivity 0.8 and 0.5, {side.name.lower()} sides",
            build=lambda n, side=side: grey_plates(0.8, 0.5, side, 2, n).scene,
            readers={"values": partial(_read_plates, grey_plates(0.8, 0.5, side).expected)},
            sizes=(8, 16, 32),
            targets=same(net_flux=_EXACT),
            rtol=2e-6,
        )
        for side in (rm.PERIODIC, rm.MIRROR)
    ),
    Case(
        name="absorbing-sphere",
        title="sphere full of absorbing gas, kappa r = 1, albedo 0.8",
        build=lambda n: filled_sphere(0.8, 1.0, n).scene,
        readers={"values": partial(_read_wall_radiance, filled_sphere(0.8, 1.0).expected)},
        sizes=(16, 32, 64),
        rtol=1e-5,
    ),
)
