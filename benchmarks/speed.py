"""How fast a sweep, a bounce and a whole solve are, and how their time grows.

Times of sweeps are given in nanoseconds for each voxel and direction, all bands together. In vacuum a bounce needs no sweep:
its links tell who sees whom, found once at the price given. "by XLA" is the same sweep without the loops of our own that numba
compiles, where there are any. Every row is measured in a process of its own, alternating the variants; medians of warm runs.

The roofline is the time in which memory copies a ray once a plane: no sweep that keeps its rays there takes less. A cache does.

Public names: `roofline`, `sweeps`, `solves`, `speed_table`, `CASES`, `SCENES`.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

from .alone import alone
from .record import peak_memory

CASES = ("vacuum", "homogeneous", "heterogeneous")
SCENES = ("ring", "three-balls", "room")


def roofline(repeats: int, tell: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """One record: bytes read and written a second, where a copy is far larger than any cache."""
    tell("roofline")
    yield alone(_roofline, repeats)


def sweeps(
    cases: Iterable[str],
    sizes: Iterable[int],
    counts: Iterable[int],
    bands: Iterable[int],
    repeats: int,
    tell: Callable[[str], None],
) -> Iterator[dict[str, Any]]:
    """One record for each case, size, number of directions and number of bands."""
    cases, counts, bands = list(cases), list(counts), list(bands)
    for size in sizes:
        for case in cases:
            for count in counts:
                for number in bands:
                    tell(f"sweep, {case}, {size} voxels, {count} directions, bands: {number}")
                    yield alone(_sweep, case, size, count, number, repeats)


def solves(
    scenes: Iterable[str], sizes: Iterable[int], count: int, rtol: float, repeats: int, tell: Callable[[str], None]
) -> Iterator[dict[str, Any]]:
    """One record for each scene and size: whole solves, light from sources included."""
    scenes = list(scenes)
    for size in sizes:
        for name in scenes:
            tell(f"solve, {name}, {size} voxels")
            yield alone(_solve, name, size, count, rtol, repeats)


def _roofline(repeats: int) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    field, seconds = jnp.ones(1 << (26 if jax.default_backend() == "cpu" else 29), jnp.float32), []
    copied = jax.jit(lambda a: a + 1)
    for _ in range(repeats + 1):
        began = time.perf_counter()
        jax.block_until_ready(copied(field))
        seconds.append(time.perf_counter() - began)
    return {"kind": "roofline", "bytes_a_second": 2 * field.nbytes / statistics.median(seconds[1:])}


def _sweep(case: str, size: int, count: int, bands: int, repeats: int) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp
    import numpy as np

    import raymanifold_jax as rm
    from raymanifold_jax.operator import Light, make_transport, materials
    from raymanifold_jax.prepare import prepare
    from raymanifold_jax.transport import native

    scene = rm.scenes.ring(size) if case == "vacuum" else rm.scenes.three_balls_in_fog(size)
    if case == "heterogeneous":
        density = np.random.default_rng(0).uniform(0.5, 1.5, scene.lattice.shape)
        scene = rm.Scene(scene.lattice, scene.solids, rm.Medium(3 * density, 0.3 * density), scene.lights, scene.boundary)
    prepared = prepare(scene)
    stuff = materials(scene, prepared.surfaces)
    extinction = None
    if stuff.extinction is not None:
        extinction = jnp.broadcast_to(stuff.extinction, (bands, *scene.lattice.shape))
    quadrature = rm.quadrature.fibonacci(count)
    transport = make_transport(prepared.layout, quadrature, extinction, bands, area=prepared.surfaces.area)
    light = Light(
        jnp.ones((bands, prepared.layout.elements)), None if extinction is None else jnp.ones((bands, *scene.lattice.shape))
    )
    serves = native.serves

    def by_xla():
        native.serves = lambda *_: False
        try:
            return transport(light)
        finally:
            native.serves = serves

    works = {"sweep": lambda: transport(light)}
    if native.serves(transport.layout, transport.ordinates, light):
        works["by XLA"] = by_xla
    if transport.links is not None:
        works["bounce"] = lambda: transport(light, fluence=False)
    asked = Light(light.elements) if transport.links is not None else light
    works["transposed"] = lambda: transport.transposed(asked)
    if transport.links is not None:
        from raymanifold_jax.transport.links import find_links

        works["finding links"] = lambda: find_links(prepared.layout, transport.ordinates)
    seconds: dict[str, list[float]] = {name: [] for name in works}
    for turn in range(repeats + 2):  # the second turn of a program is its first on all cores
        for name, work in works.items():
            began = time.perf_counter()
            found = work()
            jax.block_until_ready([leaf for leaf in jax.tree.leaves(found) if isinstance(leaf, jax.Array)])
            if turn > 1:
                seconds[name].append(time.perf_counter() - began)
    steps = scene.lattice.size * count
    return {
        "kind": "sweep", "case": case, "size": size, "directions": count, "bands": bands,
        "nanoseconds": {name: 1e9 * statistics.median(values) / steps for name, values in seconds.items()},
        "spread": {name: 1e9 * (max(values) - min(values)) / steps for name, values in seconds.items()},
        "memory": peak_memory(),
    }  # fmt: skip


def _solve(name: str, size: int, count: int, rtol: float, repeats: int) -> dict[str, Any]:
    import jax

    import raymanifold_jax as rm

    imported = peak_memory()
    scene, quadrature = rm.scenes.SCENES[name].build(size), rm.quadrature.fibonacci(count)
    seconds, solution = [], None
    for _ in range(repeats + 1):
        began = time.perf_counter()
        solution = rm.solve(scene, quadrature, rtol=rtol, progress=False)
        jax.block_until_ready(solution.fluence)
        seconds.append(time.perf_counter() - began)
    assert solution is not None
    warm = statistics.median(seconds[1:])
    return {
        "kind": "solve", "scene": name, "size": size, "directions": count, "rtol": rtol, "warm": warm,
        "spread": max(seconds[1:]) - min(seconds[1:]), "compile": seconds[0] - warm, "sweeps": solution.sweeps,
        "bound": float(solution.error_bound / solution.target * rtol), "memory": peak_memory(), "imports": imported,
    }  # fmt: skip


def speed_table(records: list[dict[str, Any]]) -> str:
    """Sweeps, then solves, then how their time grows."""
    lines = []
    for r in (r for r in records if r["kind"] == "roofline"):
        rate = r["bytes_a_second"]
        lines += [f"memory copies at {rate / 1e9:.0f} GB/s: a ray of one band once a plane in {8e9 / rate:.4f} ns", ""]
    swept = [r for r in records if r["kind"] == "sweep"]
    solved = [r for r in records if r["kind"] == "solve"]
    names = ("sweep", "by XLA", "bounce", "transposed", "finding links")
    lines += [f"{'ns a voxel-direction':22}{'size':>5}{'dirs':>6}{'bands':>6}" + "".join(f"{n:>15}" for n in names)]
    for r in swept:
        cells = "".join(f"{_figures(r['nanoseconds'][n]):>15}" if n in r["nanoseconds"] else f"{'':15}" for n in names)
        lines.append(f"{r['case']:22}{r['size']:5}{r['directions']:6}{r['bands']:6}{cells}")
    lines += [
        "",
        f"{'whole solves':22}{'size':>5}{'dirs':>6}{'sweeps':>8}{'warm s':>9}{'compile s':>11}{'peak MB':>9}{'bound':>9}",
    ]
    lines += [
        f"{r['scene']:22}{r['size']:5}{r['directions']:6}{r['sweeps']:8}{r['warm']:9.2f}{r['compile']:11.1f}"
        f"{r['memory'] / 1e6:9.0f}{r['bound']:9.1e}"
        for r in solved
    ]
    return "\n".join([*lines, "", *_growth(swept), *_growth_of_solves(solved)])


def _figures(value: float) -> str:
    return f"{value:.2f}" if value >= 0.1 else f"{value:.4f}"


def _growth(swept: list[dict[str, Any]]) -> list[str]:
    lines = []
    for case in CASES:
        rows = [r for r in swept if r["case"] == case and r["bands"] == 1]
        if len({r["size"] for r in rows}) > 1:
            points = [
                (r["size"] ** 3 * r["directions"], r["nanoseconds"]["sweep"] * r["size"] ** 3 * r["directions"]) for r in rows
            ]
            lines.append(f"sweep, {case}: time grows as (voxels x directions)^{_power(points):.2f}")
    return lines


def _growth_of_solves(solved: list[dict[str, Any]]) -> list[str]:
    lines = []
    for name in SCENES:
        points = [(r["size"] ** 3, r["warm"]) for r in solved if r["scene"] == name]
        if len(points) > 1:
            lines.append(f"solve, {name}: time grows as voxels^{_power(points):.2f}")
    return lines


def _power(points: list[tuple[float, float]]) -> float:
    """The slope of the least-squares line through the logarithms."""
    x, y = ([math.log(p[i]) for p in points] for i in (0, 1))
    return statistics.linear_regression(x, y).slope
