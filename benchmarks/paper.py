"""The paper's Figures 4 and 5 by both schemes, and a solve over virtual devices.

The paper's iterations are Jacobi's: the k-th carries light of k - 1 bounces. Figure 4 (the ring) took 12 and Figure 5 (three
balls in fog) 5, at N = 128 and M = 5; a MasPar of 2048 elements took 8 minutes an iteration. Ours are solved to a certified
1e-3. Errors of the fog are against Mitsuba's (`tests/data/README.md`); for the ring there is no reference, so there is only the
rms difference of the pictures, as a share of the mean of ours. Seconds are of the second run, without compilation; an
iteration's is the difference between solves of all iterations and of one, over their number.

Public names: `figures`, `montage`, `figures_table`, `scaling`, `scaling_table`, `ITERATIONS`.
"""

import statistics
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from .alone import alone
from .table import seconds_text

ITERATIONS = {"ring": 12, "three-balls": 5}
PAPER, OURS = "the paper's", "characteristic"


def figures(
    size: int, half_width: int, directions: int, pixels: int, tell: Callable[[str], None]
) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """A record and a picture for each figure and scheme; each in a process of its own."""
    for name in ITERATIONS:
        pictures = []
        for scheme in (PAPER, OURS):
            tell(f"{name}, {size} voxels, {scheme} scheme")
            record = alone(_figure, name, scheme, size, half_width, directions, pixels)
            pictures.append(record.pop("picture"))
            if scheme == OURS:
                record["difference"] = float(np.sqrt(np.mean((pictures[0] - pictures[1]) ** 2)) / np.mean(pictures[1]))
            yield record, pictures[-1]


def _figure(name: str, scheme: str, size: int, half_width: int, directions: int, pixels: int) -> dict[str, Any]:
    import jax

    import raymanifold_jax as rm
    from raymanifold_jax.scenes import cameras

    scene = rm.scenes.find(name).build(size)
    count = ITERATIONS[name]

    def solve(bounces: int | None) -> rm.Solution:
        if scheme == PAPER:
            solution = rm.solve(scene, scheme=rm.LightRayCube(half_width), bounces=bounces, progress=False)
        else:
            solution = rm.solve(scene, rm.quadrature.for_scene(scene, directions), rtol=1e-3, progress=False)
        return jax.block_until_ready(solution)

    record: dict[str, Any] = {"scene": name, "scheme": scheme, "size": size}
    if scheme == PAPER:
        solution, once = solve(count - 1), solve(0)
        (seconds, _), (least, _) = (_timed(lambda b=b: solve(b)) for b in (count - 1, 0))
        del once
        record |= {"half_width": half_width, "iterations": count, "iteration_seconds": (seconds - least) / (count - 1)}
    else:
        solution = solve(None)
        seconds = _timed(lambda: solve(None))[0]
        record |= {"directions": directions, "sweeps": solution.sweeps}
    record |= {"seconds": seconds, "result": solution.result, "errors": {}}
    if name == "three-balls":
        from problems.rendered import read_probes

        read = read_probes("C", solution)
        record["errors"] = {what: {"bias": r.bias(), "rms": r.rms()} for what, r in read.items()}
    view = next(iter(cameras(name, scene, (pixels, pixels)).values()))
    return record | {"picture": np.asarray(rm.render(solution, view, samples=4), float)}


def montage(pictures: list[np.ndarray]) -> np.ndarray:
    """Figures 4 and 5, one under the other: the paper's scheme on the left, ours on the right; a figure's exposure is one."""
    rows = []
    for left, right in zip(pictures[::2], pictures[1::2], strict=True):
        white = np.percentile(right, 99)
        rows.append(np.concatenate([left, np.full_like(left[:, :8], white), right], axis=1) / white)
    return np.concatenate([rows[0], np.ones_like(rows[0][:8]), rows[1]])


def figures_table(records: list[dict[str, Any]]) -> str:
    """One line for each figure and scheme."""
    rows = [
        (
            "scene",
            "scheme",
            "iterations",
            "s",
            "s an iteration",
            "irradiance bias, rms %",
            "fluence bias, rms %",
            "pictures differ %",
        )
    ]
    for r in records:
        error = lambda what, r=r: "{:.2f}, {:.2f}".format(*(100 * v for v in r["errors"][what].values())) if r["errors"] else ""
        each = seconds_text(r["iteration_seconds"]) if "iteration_seconds" in r else ""
        count = str(r.get("iterations", f"{r.get('sweeps')} sweeps"))
        differ = f"{100 * r['difference']:.1f}" if "difference" in r else ""
        errors = error("irradiance"), error("fluence")
        rows.append((r["scene"], r["scheme"], count, seconds_text(r["seconds"]), each, *errors, differ))
    return _aligned(rows)


def scaling(size: int, half_width: int, directions: int, repeats: int, tell: Callable[[str], None]) -> Iterator[dict[str, Any]]:
    """Seconds of a sweep of both schemes on one device, and on meshes of virtual devices of the same cores."""
    for scheme in (PAPER, OURS):
        for pe in (None, (1, 1), (2, 1)):
            tell(f"sweep, {scheme} scheme, {size} voxels, " + ("one device" if pe is None else "mesh {} x {}".format(*pe)))
            yield alone(_sweep, scheme, size, half_width, directions, pe, repeats)


def _sweep(
    scheme: str, size: int, half_width: int, directions: int, pe: tuple[int, int] | None, repeats: int
) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    import raymanifold_jax as rm

    mesh = None if pe is None else rm.pe_array(*pe)
    from raymanifold_jax.operator import Light, make_transport, materials
    from raymanifold_jax.placement import stored
    from raymanifold_jax.prepare import prepare
    from raymanifold_jax.transport.ray_cube_system import make_cube_system

    scene = rm.scenes.three_balls_in_fog(size)
    prepared = prepare(scene)
    if scheme == PAPER:
        cube = make_cube_system(scene, prepared.surfaces, rm.LightRayCube(half_width), mesh)
        transport, count = cube.system.transport, len(cube.nodes.cell)
        layout = transport.lattice
    else:
        layout = prepared.layout_on(mesh)
        extinction = stored(layout, materials(scene, prepared.surfaces).extinction)
        transport = make_transport(layout, rm.quadrature.fibonacci(directions), extinction, 1, area=prepared.surfaces.area)
        count = prepared.layout.elements
    light = stored(layout, Light(jnp.ones((1, count)), jnp.ones((1, *scene.lattice.shape))))
    run = lambda: jax.block_until_ready(transport(light))
    run()
    seconds = statistics.median(_timed(run)[0] for _ in range(repeats))
    return {"scheme": scheme, "size": size, "pe": pe, "seconds": seconds}


def scaling_table(records: list[dict[str, Any]]) -> str:
    """One line for each scheme and mesh, with the ratio to one device without a mesh."""
    rows, alone_on = [("scheme", "devices", "s a sweep", "times one device")], {}
    for r in records:
        alone_on.setdefault(r["scheme"], r["seconds"])
        mesh = "one" if r["pe"] is None else "{} x {}".format(*r["pe"])
        rows.append((r["scheme"], mesh, seconds_text(r["seconds"]), f"{r['seconds'] / alone_on[r['scheme']]:.2f}"))
    return _aligned(rows)


def _aligned(rows: list[tuple[str, ...]]) -> str:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows)


def _timed(function: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    result = function()
    return time.perf_counter() - began, result
