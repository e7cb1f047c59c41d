"""Published problems of radiation in participating media.

- Kobayashi, Sugimura & Nagaya, Prog. Nucl. Energy 39 (2001): a source in a void in a shield, and a bent duct.
- Burns & Christon, Numer. Heat Transfer B 31 (1997): a cube of hot inhomogeneous gas.
- Crosbie & Schrenker, JQSRT 31 (1984): a square of white fog, one side of which shines.
- DISORT's test problems 1, 8 and 9 with isotropic scattering: layers under a diffuse sky.

What is in the files of `data/` stands in their first lines.
"""

import math
from functools import partial

import numpy as np

import raymanifold_jax as rm

from .case import Case, Readings, Target, readings, same
from .data import columns, disort, table

BLACK = rm.Wall(0.0)

# Kobayashi: boxes in cm, (lower, upper); the source is [0, 10]^3, mirrors are at x = 0, y = 0 and z = 0.
_DOMAIN = {1: (100, 100, 100), 3: (60, 100, 60)}
_VOIDS = {
    1: [((0, 0, 0), (50, 50, 50))],
    3: [
        ((0, 10, 0), (10, 60, 10)),
        ((10, 50, 0), (40, 60, 10)),
        ((30, 50, 10), (40, 60, 40)),
        ((30, 60, 30), (40, 100, 40)),
    ],
}
_SHIELD, _VOID = 0.1, 1e-4  # extinction, 1 / cm


def kobayashi(number: int, scattering: float, n: int) -> rm.Scene:
    """Kobayashi's problem 1 (cube in cube with void) or 3 (dog-leg duct), n voxels along 100 cm.

    A cube that emits 1 / (cm^3 s) in void and shield; everything, the void included, has the scattering albedo `scattering`
    (0: case i, 1/2: case ii).
    """
    if n % 10:
        raise ValueError(f"size: got {n}, expected a multiple of 10, so that boxes end on voxel faces; 50 makes voxels of 2 cm")
    spacing = 100 / n
    domain = _DOMAIN[number]
    lattice = rm.Lattice([round(side / spacing) for side in domain], spacing)
    inside = lambda lower, upper: ((lattice.centers() > lower) & (lattice.centers() < upper)).all(-1)
    source = inside((0, 0, 0), (10, 10, 10))
    void = np.any([inside(*box) for box in _VOIDS[number]], axis=0) & ~source
    extinction = np.where(void, _VOID, _SHIELD)
    medium = rm.Medium(scattering * extinction, (1 - scattering) * extinction, source / (4 * np.pi))
    return rm.Scene(lattice, medium=medium, boundary=rm.Boundary(*[(rm.MIRROR, rm.OPEN)] * 3))


def _read_kobayashi(number: int, case: str, solution: rm.Solution) -> dict[str, Readings]:
    rows = [row for row in table(f"kobayashi_case_{case}.csv") if row["problem"] == str(number)]
    expected = columns(rows, "phi_ref")
    share = columns(rows, "rel_err_ref") if case == "ii" else 1.4e-5
    return {"fluence": readings(rm.fluence(solution, columns(rows, "x_cm", "y_cm", "z_cm")), expected, share * expected)}


def _kobayashi_case(number: int, case: str) -> Case:
    scattering, target = {"i": (0.0, Target(worst=0.005)), "ii": (0.5, Target(worst=0.03, rms=0.01))}[case]
    shape = {1: "cube in cube with void", 3: "dog-leg duct"}[number]
    return Case(
        name=f"kobayashi-{number}{case}",
        title=f"Kobayashi {number} ({shape}), scattering albedo {scattering:g}",
        build=partial(kobayashi, number, scattering),
        readers={"values": partial(_read_kobayashi, number, case)},
        sizes=(10, 30, 50),
        targets=same(fluence=target),
        directions=200 if case == "i" else 400,
        rtol=5e-6,  # of the source, which is some 10^4 times as bright as the far end of the duct
    )


def burns_christon(n: int) -> rm.Scene:
    """A unit cube with cold black walls, full of gas of emissive power 1 that absorbs

        kappa = 0.9 (1 - 2 |x - 1/2|) (1 - 2 |y - 1/2|) (1 - 2 |z - 1/2|) + 0.1.

    A voxel holds the mean of kappa over it.
    """
    edges = np.linspace(0, 1, n + 1)
    # The integral of 1 - 2 |t - 1/2| from 0 to t.
    integral = np.where(edges < 0.5, edges**2, 0.5 - (1 - edges) ** 2)
    mean = np.diff(integral) * n
    absorption = 0.9 * mean[:, None, None] * mean[:, None] * mean + 0.1
    return rm.Scene(rm.Lattice((n, n, n), 1 / n), medium=rm.Medium(0.0, absorption, absorption / np.pi), boundary=_box(BLACK))


def _box(wall: rm.Wall) -> rm.Boundary:
    return rm.Boundary(wall, wall, wall)


def _read_burns_christon(solution: rm.Solution) -> dict[str, Readings]:
    """div q = kappa (4 - fluence) on the line (x, 1/2, 1/2)."""
    rows = table("burns_christon_divq.csv")
    points = columns(rows, "x_m", "y_m", "z_m")
    absorption = 0.9 * (1 - 2 * np.abs(points[:, 0] - 0.5)) + 0.1
    ours = absorption * (4 - np.asarray(rm.fluence(solution, points), float))
    expected = columns(rows, "divq_exact")
    inside = points[:, 0] < 1
    pick = lambda kept: readings(ours[kept], expected[kept], 1e-6)
    return {"div q": pick(slice(None)), "div q inside": pick(inside)}


def crosbie_schrenker(n: int, width: int = 2) -> rm.Scene:
    """An infinite prism (along y) of white fog, optical side 1 x 1, black but for its floor, which emits radiance 1."""
    walls = rm.Boundary(BLACK, rm.PERIODIC, (rm.Wall(0.0, 1.0), BLACK))
    return rm.Scene(rm.Lattice((n, width, n), 1 / n), medium=rm.Medium(scattering=1.0), boundary=walls)


def _read_crosbie_schrenker(solution: rm.Solution) -> dict[str, Readings]:
    """Source function fluence / 4 pi on the centre line, with and without its ends on the walls."""
    rows = table("crosbie_schrenker_square_tau1.csv")
    height = columns(rows, "tau_z")
    middle = float(solution.scene.lattice.extent[1]) / 2
    points = np.stack([np.full_like(height, 0.5), np.full_like(height, middle), height], -1)
    ours = np.asarray(rm.fluence(solution, points), float) / (4 * np.pi)
    inside = (height > 0) & (height < 1)
    expected = columns(rows, "S_ref")
    pick = lambda kept: readings(ours[kept], expected[kept], 3e-5, scale=1.0)
    return {"source": pick(slice(None)), "source inside": pick(inside)}


def layers(name: str, n: int, width: int = 1) -> rm.Scene:
    """DISORT's layers (their optical thicknesses and scattering albedos) under a diffuse sky, vacuum below; n voxels high."""
    thickness, albedo, radiance = _layers(name)
    depth = sum(thickness)
    step = _step(thickness)
    if n % round(depth / step):
        raise ValueError(f"size: got {n}, expected a multiple of {round(depth / step)}, so that layers end on voxel faces")
    spacing = depth / n
    # Layers are counted from the top, voxels from the bottom.
    of_voxel = np.searchsorted(np.cumsum(thickness), depth - spacing * (np.arange(n) + 0.5))
    scattering = np.array(albedo)[of_voxel][None, None]
    shape = (width, width, n)
    medium = rm.Medium(np.broadcast_to(scattering, shape), np.broadcast_to(1 - scattering, shape))
    sky = rm.Sky(radiance, hemisphere=(0, 0, 1))
    return rm.Scene(rm.Lattice(shape, spacing), medium=medium, lights=[sky], boundary=rm.Boundary(rm.PERIODIC, rm.PERIODIC))


def _layers(name: str) -> tuple[list[float], list[float], float]:
    given = disort(name)["published_DISORT_8_or_16_stream"]
    thickness, albedo = given.get("layers_tau", [given.get("tau")]), given.get("layers_omega", [given.get("omega")])
    return thickness, albedo, given["iso_radiance"]


def _step(thickness: list[float]) -> float:
    """The largest optical thickness of which all layers are multiples."""
    return math.gcd(*(round(t * 2**10) for t in thickness)) / 2**10


def _read_layers(name: str, solution: rm.Solution) -> dict[str, Readings]:
    """Diffuse fluxes up and down, of which 0 and the sky's own are left out: by gathering at every level, and leaving."""
    thickness, _, radiance = _layers(name)
    depth, incident = sum(thickness), math.pi * radiance
    levels = np.array(disort(name)["published_DISORT_8_or_16_stream"]["utau"])
    converged = disort(name)["converged"]
    middle = solution.scene.lattice.extent[:2] / 2
    points = np.array([(*middle, depth - level) for level in levels])
    flux = lambda normal: np.asarray(rm.irradiance(solution, points, np.tile(normal, (len(points), 1))))
    down, up = levels > 0, levels < depth
    gathered = np.concatenate([flux((0.0, 0.0, 1.0))[down], flux((0.0, 0.0, -1.0))[up]])
    expected = np.concatenate([np.array(converged["dn"])[down], np.array(converged["up"])[up]])
    leaving = [float(np.mean(rm.outgoing_flux(solution, side))) for side in ("z-", "z+")]
    return {
        "leaving": readings(leaving, [converged["dn"][-1], converged["up"][0]], 1e-7, incident),
        "all levels": readings(gathered, expected, 1e-7, incident),
    }


def _layers_case(name: str) -> Case:
    thickness, _, _ = _layers(name)
    least = round(sum(thickness) / _step(thickness))
    quick = least * -(-16 // least)
    return Case(
        name=f"disort-{name}",
        title=f"DISORT {name}, layers of optical thickness {', '.join(f'{t:g}' for t in thickness)}",
        build=partial(layers, name),
        readers={"values": partial(_read_layers, name)},
        sizes=(quick, 2 * quick, 4 * quick),
        targets=same(leaving=Target(worst=0.002), all_levels=Target(worst=0.002)),
        errors_of="the incident flux",
    )


CASES = (
    *(_kobayashi_case(number, case) for number in (1, 3) for case in ("i", "ii")),
    Case(
        name="burns-christon",
        title="Burns-Christon cube of hot gas",
        build=burns_christon,
        readers={"values": _read_burns_christon},
        sizes=(11, 21, 41),
        targets=same(div_q=Target(worst=0.002)),
    ),
    Case(
        name="crosbie-schrenker",
        title="Crosbie-Schrenker square of white fog",
        build=crosbie_schrenker,
        readers={"values": _read_crosbie_schrenker},
        sizes=(16, 32, 64),
        targets=same(source=Target(worst=0.001)),
        errors_of="the floor's radiance",
        rtol=1e-5,
    ),
    *(_layers_case(name) for name in ("1c", "1f", "8a", "8b", "8c", "9a")),
)
