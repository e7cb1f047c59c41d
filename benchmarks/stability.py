"""Stress: does a solve stay finite, non-negative and within its bound where numbers are extreme?

Each case is solved in float32 and compared with a float64 solve a million times as tight of the same scene on the same lattice.
Its row says sweeps, bound, true error (both relative to the largest radiosity or scattered radiance times pi), smallest value,
and energy imbalance. `verdict` is "ok", or what is wrong: "not finite", "negative", or "error above bound" (the bound, plus
what the solution says rounding may add).

Public names: `cases`, `measure`, `stability_table`.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np

import raymanifold_jax as rm

_SIDE = 6
_TINY = 1e-30


class Case(NamedTuple):
    name: str
    scene: Callable[[], rm.Scene]  # made anew for each float type
    quadrature: rm.quadrature.Quadrature


def _fog(depth: Any, scattering: float, surface: float, radiance: float = 1.0, shape=(_SIDE,) * 3, boundary=None, solids=()):
    """Fog of an optical depth per voxel in a box that is open above, lit by the sky."""
    depth = np.broadcast_to(depth, shape)
    wall = rm.Wall(surface)
    return rm.Scene(
        rm.Lattice(shape),
        solids,
        medium=rm.Medium(depth * scattering, depth * (1 - scattering)),
        lights=[rm.Sky(radiance)],
        boundary=boundary or rm.Boundary(wall, wall, (wall, rm.OPEN)),
    )


def cases(quick: bool = False) -> Iterator[Case]:
    """The grid of the stress test; `quick` takes a few of each kind."""
    usual = rm.quadrature.fibonacci(24)
    some = lambda values: values[:: max(1, len(values) - 1)] if quick else values
    case = lambda name, make, quadrature=usual: Case(name, make, quadrature)
    for depth in some([1e-6, 1e-4, 1e-2, 1.0, 1e2, 1e4]):
        for scattering in some([0.0, 0.9, 0.999, 1 - 1e-6, 1.0]):
            for surface in some([0.0, 0.9, 1 - 1e-6, 1.0]):
                yield case(
                    f"depth {depth:g}, scattering {scattering:.6g}, surface {surface:.6g}",
                    lambda d=depth, c=scattering, s=surface: _fog(d, c, s),
                )
    random = np.random.default_rng(0)
    checker = np.where(np.indices((_SIDE,) * 3).sum(0) % 2, 1e-4, 1e4)
    contrasts = {"checkerboard": checker, "random": 10 ** random.uniform(-4, 4, (_SIDE,) * 3)}
    for name, depth in contrasts.items():
        for scattering in some([0.9, 0.9999]):
            yield case(f"contrast 1e8, {name}, scattering {scattering:g}", lambda d=depth, c=scattering: _fog(d, c, 0.9))
    for radiance in some([1e-20, 1e-10, 1e10, 1e20]):
        yield case(f"radiance {radiance:g}", lambda r=radiance: _fog(0.3, 0.99, 0.9, r))
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    edges = np.array(
        [p for p in np.array(np.meshgrid([-1, 0, 1], [-1, 0, 1], [-1, 0, 1])).reshape(3, -1).T if (p == 0).sum() == 1]
    )
    for name, directions in {
        "axes": axes,
        "diagonals": corners,
        "edges": edges,
        "all": np.concatenate([axes, corners, edges]),
    }.items():
        for offset in some([1e-6, 0.5]):
            chosen = rm.quadrature.from_directions(directions, offsets=np.full((len(directions), 2), offset))
            yield case(f"directions on {name}, rays at {offset:g}", lambda: _fog(0.3, 0.9, 0.9), chosen)
    sheet = rm.Solid(rm.Box((0, 0, 3), (5, 6, 4)), 0.9)
    yield case("solid one voxel thin, fog", lambda: _fog(0.3, 0.9, 0.9, solids=[sheet]))
    leaf = rm.Solid(rm.Box((0, 0, 3.2), (5, 6, 3.6)), 0.9)
    yield case("solid thinner than a voxel, fog", lambda: _fog(0.3, 0.9, 0.9, solids=[leaf]))
    yield case("one voxel", lambda: _fog(0.3, 0.99, 0.9, shape=(1, 1, 1)))
    for shape in some([(1, 1, 12), (12, 1, 1), (1, 6, 6)]):
        yield case("x".join(map(str, shape)), lambda s=shape: _fog(0.3, 0.99, 0.9, shape=s))
    wall, wraps = (rm.Wall(0.9), rm.OPEN), rm.PERIODIC
    for count, sides in enumerate([(wraps, wall, wall), (wraps, wraps, wall), (wraps, wraps, wraps)], start=1):
        shape = (_SIDE,) * 3
        if count < 3:
            yield case(f"periodic in {count}", lambda b=sides: _fog(0.3, 0.99, 0.9, boundary=rm.Boundary(*b)))
        else:
            glow = lambda b=sides, s=shape: rm.Scene(
                rm.Lattice(s), medium=rm.Medium(0.27, 0.03, np.indices(s).sum(0) * 1.0), boundary=rm.Boundary(*b)
            )
            yield case("periodic in 3", glow)


def measure(case: Case, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """One row of the table."""
    tell(case.name)
    with jax.enable_x64(True):
        exact = rm.solve(case.scene(), case.quadrature, rtol=1e-10, progress=False)
        truth = _values(exact)
    solution = rm.solve(case.scene(), case.quadrature, progress=False)
    found = _values(solution)
    scale = max((np.abs(part).max(initial=0.0) for part in truth), default=0.0) or 1.0
    error = max((np.abs(a - b).max(initial=0.0) for a, b in zip(found, truth, strict=True)), default=0.0)
    raw = [np.asarray(x, np.float64) for x in (solution.fluence, solution.surfaces.irradiance)]
    allowed = solution.error_bound + solution.rounding + (exact.error_bound if np.isfinite(exact.error_bound) else 0.0)
    finite = all(np.isfinite(x).all() for x in (*raw, *found))
    least = min((x.min(initial=0.0) for x in raw), default=0.0)
    verdict = "not finite" if not finite else "negative" if least < 0 else "error above bound" if not error <= allowed else "ok"
    return {
        "case": case.name,
        "sweeps": solution.sweeps,
        "ending": solution.ending,
        "bound": float(solution.error_bound / scale),
        "rounding": float(solution.rounding / scale),
        "error": float(error / scale),
        "smallest": float(min((x.min(initial=np.inf) for x in raw), default=0.0)),
        "imbalance": float(solution.energy.imbalance),
        "exact": exact.ending,
        "verdict": verdict,
    }


def _values(solution: rm.Solution) -> list[np.ndarray]:
    """What the bound is about: radiosities, and the medium's scattered radiance times pi."""
    medium, values = solution.scene.medium, [np.asarray(solution.surfaces.radiosity, np.float64)]
    if medium is not None:
        scattering, absorption, _ = (np.asarray(c, np.float64) for c in medium.coefficients())
        albedo = scattering / np.maximum(scattering + absorption, _TINY)
        values.append(albedo[..., 0] * np.asarray(solution.fluence, np.float64) / 4)
    return values


def stability_table(rows: Iterable[dict[str, Any]]) -> str:
    """One line a case, and a last one that counts."""
    rows = list(rows)
    width = max(len(row["case"]) for row in rows)
    head = f"{'case':{width}}  sweeps  ending        bound    rounding  error     smallest  imbalance  verdict"
    lines = [
        f"{r['case']:{width}}  {r['sweeps']:6d}  {r['ending']:11}  {r['bound']:8.1e}  {r['rounding']:8.1e}  {r['error']:8.1e}  "
        f"{r['smallest']:8.1e}  {r['imbalance']:+9.1e}  {r['verdict']}"
        for r in rows
    ]
    wrong = sum(row["verdict"] != "ok" for row in rows)
    return "\n".join([head, *lines, f"{len(rows)} cases, {wrong} of them wrong"])
