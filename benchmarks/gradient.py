"""What a gradient costs: an image loss of the ring and its derivative in a floor texture, beside the solve alone.

Each of the three, solve, value (solve and picture) and value with gradient, is timed in a process of its own, so that peak
memory can be told apart: once with compilation, then warm; the median of the warm ones counts. With Mitsuba 3 beside it, its
value and gradient of the same loss are timed in one more process, and the two gradients compared.

Public names: `measure`, `gradient_table`.
"""

import statistics
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from .alone import alone
from .mitsuba_gradient import albedo as compared_albedo
from .mitsuba_gradient import measure_mitsuba

WORKS = ("solve", "value", "gradient")
_SEEDS = 32  # runs of Mitsuba, whose mean gradient is compared


def measure(
    size: int,
    directions: int,
    cells: int,
    pixels: int,
    repeats: int,
    tell: Callable[[str], None] = lambda _: None,
    samples: int = 0,
) -> list[dict[str, Any]]:
    """One record for each kind of work, and with `samples` > 0 one for Mitsuba's `prb` with so many a pixel.

    **Raises** `RuntimeError` if Mitsuba is asked for and not there.
    """
    records = []
    for work in WORKS:
        tell(work)
        records.append(alone(_measure, work, size, directions, cells, pixels, repeats))
    if samples:
        tell("prb")
        records.append(alone(measure_mitsuba, cells, pixels, samples, max(repeats, _SEEDS)))
    return records


def _measure(work: str, size: int, directions: int, cells: int, pixels: int, repeats: int) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp

    import raymanifold_jax as rm

    from .record import peak_memory

    base, quadrature = rm.scenes.ring(size), rm.quadrature.fibonacci(directions)
    wall = base.boundary.x
    camera = rm.scenes.cameras("ring", base, (pixels, pixels))["top"]

    def solve(albedo):
        boundary = rm.Boundary(wall, wall, (rm.Wall(rm.Texture(albedo)), rm.OPEN))
        return rm.solve(rm.Scene(base.lattice, base.solids, lights=base.lights, boundary=boundary), quadrature, progress=False)

    loss = lambda albedo: jnp.mean(rm.render(solve(albedo), camera) ** 2)
    run = {"solve": lambda a: solve(a).diffuse_irradiance, "value": loss, "gradient": jax.value_and_grad(loss)}[work]
    imported, seconds, found = peak_memory(), [], None
    for i in range(repeats + 1):  # other albedos each time: nothing may be remembered
        albedo = compared_albedo(cells) if i == repeats else np.random.default_rng(i + 1).uniform(0.2, 0.8, (cells, cells))
        begun = time.perf_counter()
        found = jax.block_until_ready(run(jnp.asarray(albedo)))
        seconds.append(time.perf_counter() - begun)
    warm = seconds[1:]
    return {
        "work": work, "size": size, "directions": directions, "cells": cells, "pixels": pixels, "first": seconds[0],
        "warm": statistics.median(warm), "spread": max(warm) - min(warm), "memory": peak_memory(), "imports": imported,
        **({"mean": np.asarray(found[1]).tolist()} if work == "gradient" else {}),
    }  # fmt: skip


def gradient_table(records: list[dict[str, Any]]) -> str:
    alone = records[0]
    lines = [f"{'':10}{'first s':>10}{'warm s':>10}{'spread':>8}{'ratio':>8}{'peak MB':>10}{'ratio':>8}"]
    for r in records[: len(WORKS)]:
        lines.append(
            f"{r['work']:10}{r['first']:10.2f}{r['warm']:10.3f}{r['spread']:8.3f}{r['warm'] / alone['warm']:8.2f}"
            f"{r['memory'] / 1e6:10.0f}{r['memory'] / alone['memory']:8.2f}"
        )
    for theirs in records[len(WORKS) :]:
        (ours,) = (r for r in records if r["work"] == "gradient")
        mean, expected = np.array(ours["mean"]), np.array(theirs["mean"])
        apart = np.sqrt(np.mean((mean - expected) ** 2) / np.mean(expected**2))
        noise = theirs["noise"]
        lines += [
            f"{'prb':10}{theirs['first']:10.2f}{theirs['warm']:10.3f}{theirs['spread']:8.3f}"
            f"{theirs['warm'] / ours['warm']:8.2f}  of our gradient's time, with {theirs['samples']} samples a pixel",
            f"noise of a prb gradient {100 * noise:.1f} %; ours is {100 * apart:.2f} % rms from the mean of {theirs['runs']},"
            f" whose noise is {100 * noise / theirs['runs'] ** 0.5:.2f} %",
            f"prb needs {theirs['warm'] * (noise / max(apart, 1e-9)) ** 2:.1f} s for as much noise"
            f" (Mitsuba {theirs['mitsuba']}, {theirs['variant']})",
        ]
    return "\n".join(lines)
