"""What a scene does not need, and is not done: solves of pairs of scenes that differ in that alone, side by side.

The left one of each pair lacks something, and the right one has it, or has to do without what was kept. Every pair is measured
in a process of its own, its two in turn; medians of warm runs.

Public names: `skipped`, `skipped_table`, `PAIRS`.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

from .alone import alone

PAIRS = {
    "no medium: bounces along links": "a trace of one: bounces are sweeps",
    "an even medium: exponentials once a plane": "an uneven one",
    "a medium in the lower half": "everywhere",
    "black surfaces, pure absorber: one flight": "grey surfaces, scattering",
    "a sky above alone: a flight of half the directions": "all around",
    "one band for grey": "three equal bands",
    "sun moved: resolve": "solve",
    "albedo changed: resolve": "solve",
}


def skipped(size: int, count: int, rtol: float, repeats: int, tell: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """One record for each pair."""
    for name in PAIRS:
        tell(f"skipped, {name}, {size} voxels")
        yield alone(_pair, name, size, count, rtol, repeats)


def skipped_table(records: list[dict[str, Any]]) -> str:
    """Sweeps (with links: bounces) and seconds of both, and how many times less the left one takes."""
    lines = [f"{'skipped':44}{'sweeps':>7}{'s':>8}   {'else':38}{'sweeps':>7}{'s':>8}{'ratio':>7}"]
    for r in (r for r in records if r["kind"] == "skip"):
        (less, more), (few, many) = r["seconds"], r["sweeps"]
        lines.append(f"{r['name']:44}{few:7}{less:8.2f}   {PAIRS[r['name']]:38}{many:7}{more:8.2f}{more / less:7.1f}")
    return "\n".join(lines)


def _pair(name: str, size: int, count: int, rtol: float, repeats: int) -> dict[str, Any]:
    import jax

    import raymanifold_jax as rm

    left, right = _works(name, size, rm.quadrature.fibonacci(count), rtol)
    seconds: list[list[float]] = [[], []]
    sweeps = [0, 0]
    for turn in range(repeats + 1):
        for side, work in enumerate((left, right)):
            begun = time.perf_counter()
            solution = work(turn)
            jax.block_until_ready(solution.fluence)
            sweeps[side] = solution.sweeps
            if turn > 0:
                seconds[side].append(time.perf_counter() - begun)
    return {
        "kind": "skip", "name": name, "size": size, "directions": count, "rtol": rtol, "sweeps": sweeps,
        "seconds": [statistics.median(s) for s in seconds], "spread": [max(s) - min(s) for s in seconds],
    }  # fmt: skip


def _works(name: str, size: int, quadrature: Any, rtol: float) -> tuple[Callable, Callable]:
    """What is timed of a pair; takes the number of the turn."""
    import numpy as np

    import raymanifold_jax as rm

    ring, fog = rm.scenes.ring(size), rm.scenes.three_balls_in_fog(size)
    shape = fog.lattice.shape
    options: dict[str, Any] = {"rtol": rtol, "progress": False}
    solve = lambda scene: rm.solve(scene, quadrature, **options)
    always = lambda scene: lambda _: solve(scene)

    def of(scene: Any, medium: Any = None, albedo: Any = None, sun: float = 0.0) -> Any:
        wall = lambda side: rm.Wall(albedo) if albedo is not None and isinstance(side, rm.Wall) else side
        solids = [rm.Solid(s.shape, s.albedo if albedo is None else albedo) for s in scene.solids]
        lights = [
            rm.Sun(np.asarray(light.direction) + np.array([sun, 0.0, 0.0]), light.irradiance)
            if isinstance(light, rm.Sun)
            else light
            for light in scene.lights
        ]
        sides = [wall(side) for side in scene.boundary.sides]
        boundary = rm.Boundary(*((sides[2 * a], sides[2 * a + 1]) for a in range(3)))
        return rm.Scene(scene.lattice, solids, scene.medium if medium is None else medium, lights, boundary)

    if name.startswith("no medium"):
        return always(ring), always(of(ring, rm.Medium(0.0, 1e-6)))
    if name.startswith("an even"):
        uneven = 3 * np.random.default_rng(0).uniform(0.5, 1.5, shape)
        return always(fog), always(of(fog, rm.Medium(uneven, uneven / 10)))
    if name.startswith("a medium in"):
        below = np.broadcast_to(np.arange(size) < size // 2, shape)
        return always(of(fog, rm.Medium(3.0 * below, 0.3 * below))), always(fog)
    if name.startswith("black"):
        return always(of(fog, rm.Medium(0.0, 3.3), 0.0)), always(of(fog, rm.Medium(3.0, 0.3), 0.5))
    if name.startswith("a sky"):
        black = [rm.Solid(s.shape, 0.0) for s in fog.solids]
        under = lambda sky: rm.Scene(fog.lattice, black, rm.Medium(0.0, 3.3), [sky])
        return always(under(rm.Sky(1.0, hemisphere=(0, 0, 1)))), always(under(rm.Sky(1.0)))
    if name.startswith("one band"):
        return always(fog), always(of(fog, rm.Medium([3.0] * 3, 0.3)))
    turned = name.startswith("sun")
    change = (lambda turn: of(ring, sun=0.02 * turn)) if turned else (lambda turn: of(ring, albedo=0.5 + 0.02 * turn))
    before = [solve(ring)]

    def again(turn: int) -> Any:
        before[0] = before[0].resolve(change(turn), **options)
        return before[0]

    return again, lambda turn: solve(change(turn))
