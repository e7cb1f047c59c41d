"""Sweeps to a certified error of 1e-4 in a foggy room, by the default solver and by Jacobi; and Jacobi's false convergence.

The room is a closed cube of one albedo, full of fog, lit by its ceiling. Everything is in float64: in the hardest rooms float32
cannot hold a certified 1e-4. Jacobi is stopped early and its sweeps extrapolated from the rate at which its residual falls.

Public names: `Room`, `rooms`, `measure`, `convergence_table`, `false_convergence`.
"""

import math
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import raymanifold_jax as rm

_RTOL = 1e-4


class Room(NamedTuple):
    surface: float
    scattering: float
    depth: float

    def scene(self, size: int) -> rm.Scene:
        wall = lambda emission: rm.Wall(self.surface, emission)
        return rm.Scene(
            rm.Lattice((size,) * 3, 1 / size),
            medium=rm.Medium(self.depth * self.scattering, self.depth * (1 - self.scattering)),
            boundary=rm.Boundary(wall(0.0), wall(0.0), (wall(0.0), wall(1.0))),
        )


def rooms(quick: bool = False) -> list[Room]:
    """The table's rows; `quick` takes the ends of each range."""
    some = lambda values: values[:: len(values) - 1] if quick else values
    return [
        Room(surface, scattering, depth)
        for depth in some([1.0, 10.0, 100.0, 1000.0])
        for surface in some([0.5, 0.9, 0.99, 0.999])
        for scattering in some([0.9, 0.99, 0.999, 0.9999])
    ]


def measure(
    room: Room, size: int, directions: int, jacobi: int, tell: Callable[[str], None] = lambda _: None
) -> dict[str, Any]:
    """Sweeps and seconds; those of Jacobi, after `jacobi` sweeps, extrapolated to the same bound from its last rate."""
    tell(str(room))
    with jax.enable_x64(True):
        quadrature = rm.quadrature.fibonacci(directions)
        solve = lambda **options: rm.solve(room.scene(size), quadrature, rtol=_RTOL, progress=False, **options)
        solution, seconds = _timed(solve)
        row = {**room._asdict(), "sweeps": solution.sweeps, "seconds": seconds, "ending": solution.ending}
        row["bound"] = solution.error_bound / solution.target * _RTOL
        if jacobi:
            other, seconds = _timed(lambda: solve(solver=rm.Jacobi(), max_sweeps=jacobi))
            last = other.history
            rate = (last[-1] / last[-6]) ** 0.2 if len(last) > 6 else last[-1] / last[0]
            # Its target is relative to what it has found so far, which is too dark: the default's counts.
            more = max(math.log(solution.target / other.error_bound) / math.log(rate), 0.0)
            row |= {"jacobi": len(last) + more, "jacobi seconds": seconds * (1 + more / other.sweeps)}
    return row


def _timed(solve: Callable[[], rm.Solution]) -> tuple[rm.Solution, float]:
    """The second of two solves: the first compiles."""
    solve()
    begun = time.perf_counter()
    return solve(), time.perf_counter() - begun


def convergence_table(rows: Iterable[dict[str, Any]]) -> str:
    """One line a room, and the most sweeps of any."""
    rows = list(rows)
    lines = ["surface  scattering  depth  sweeps  seconds  ending      Jacobi  its seconds over these"]
    for r in rows:
        text = f"{r['surface']:7g}  {r['scattering']:10g}  {r['depth']:5g}  "
        text += f"{r['sweeps']:6d}  {r['seconds']:7.2f}  {r['ending']:10}"
        if "jacobi" in r:
            text += f"  {r['jacobi']:6.0f}  {r['jacobi seconds'] / r['seconds']:8.1f}"
        lines.append(text)
    return "\n".join([*lines, f"most sweeps: {max(r['sweeps'] for r in rows)}"])


def false_convergence(out: Path, size: int = 8, directions: int = 60, sweeps: int = 1000) -> None:
    """Jacobi in a white room: its last change, its true error, and its bound, at each sweep, and the default's bound."""
    from .plot import check_matplotlib

    check_matplotlib()
    from matplotlib.figure import Figure

    wall = rm.Wall(0.99)
    scene = rm.Scene(rm.Lattice((size,) * 3, 1 / size), boundary=rm.Boundary(wall, wall, (wall, rm.Wall(0.99, 1.0))))
    with jax.enable_x64(True):
        quadrature = rm.quadrature.fibonacci(directions)
        solve = lambda **options: rm.solve(scene, quadrature, progress=False, **options)
        radiosity = lambda s: np.asarray(s.surfaces.radiosity)
        exact = radiosity(solve(rtol=1e-12))
        counts = np.unique(np.geomspace(1, sweeps, 14).astype(int))
        runs = [solve(solver=rm.Jacobi(), rtol=1e-12, max_sweeps=int(k)) for k in counts]
        errors = [np.abs(radiosity(run) - exact).max() for run in runs]
        best = solve()
    scale = exact.max()
    figure = Figure(figsize=(6, 4), layout="constrained")
    axis = figure.subplots()
    axis.loglog(counts, [r.error_bound / scale for r in runs], "k--", label="certified bound")
    axis.loglog(counts, np.array(errors) / scale, "C3o-", label="true error")
    axis.loglog(counts, [r.history[-1] / scale for r in runs], "C0s-", label="last change")
    axis.plot(best.sweeps, best.error_bound / scale, "C2*", ms=12, label=f"bound of {best.solver}")
    axis.set(xlabel="sweeps", ylabel="relative to the largest radiosity", title="Jacobi in a room of albedo 0.99")
    axis.grid(True, which="major", alpha=0.3)
    axis.legend()
    figure.savefig(out, dpi=120)
