"""What a gradient costs: an image loss of the ring and its derivative in a floor texture, beside the solve alone.

Each of the three, solve, value (solve and picture) and value with gradient, is timed in a process of its own, so that peak
memory can be told apart: once with compilation, then warm; the median of the warm ones counts.

Public names: `measure`, `gradient_table`.
"""

import multiprocessing
import statistics
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any

WORKS = ("solve", "value", "gradient")


def measure(
    size: int, directions: int, cells: int, pixels: int, repeats: int, tell: Callable[[str], None] = lambda _: None
) -> list[dict[str, Any]]:
    """One record for each kind of work."""
    records = []
    for work in WORKS:
        tell(work)
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            records.append(pool.submit(_measure, work, size, directions, cells, pixels, repeats).result())
    return records


def _measure(work: str, size: int, directions: int, cells: int, pixels: int, repeats: int) -> dict[str, Any]:
    import jax
    import jax.numpy as jnp
    import numpy as np

    import raymanifold_jax as rm

    from .record import peak_memory

    base, quadrature = rm.scenes.ring(size), rm.quadrature.fibonacci(directions)
    wall = base.boundary.x
    camera = next(c for name, c in rm.scenes.cameras("ring", base, (pixels, pixels)).items() if name != "top")

    def solve(albedo):
        boundary = rm.Boundary(wall, wall, (rm.Wall(rm.Texture(albedo)), rm.OPEN))
        return rm.solve(rm.Scene(base.lattice, base.solids, lights=base.lights, boundary=boundary), quadrature, progress=False)

    loss = lambda albedo: jnp.mean(rm.render(solve(albedo), camera) ** 2)
    run = {"solve": lambda a: solve(a).diffuse_irradiance, "value": loss, "gradient": jax.value_and_grad(loss)}[work]
    imported, seconds = peak_memory(), []
    for i in range(repeats + 1):  # other albedos each time: nothing may be remembered
        albedo = jnp.asarray(np.random.default_rng(i).uniform(0.2, 0.8, (cells, cells)))
        begun = time.perf_counter()
        jax.block_until_ready(run(albedo))
        seconds.append(time.perf_counter() - begun)
    warm = seconds[1:]
    return {
        "work": work, "size": size, "directions": directions, "cells": cells, "pixels": pixels, "first": seconds[0],
        "warm": statistics.median(warm), "spread": max(warm) - min(warm), "memory": peak_memory(), "imports": imported,
    }  # fmt: skip


def gradient_table(records: list[dict[str, Any]]) -> str:
    alone = records[0]
    lines = [f"{'':10}{'first s':>10}{'warm s':>10}{'spread':>8}{'ratio':>8}{'peak MB':>10}{'ratio':>8}"]
    for r in records:
        lines.append(
            f"{r['work']:10}{r['first']:10.2f}{r['warm']:10.3f}{r['spread']:8.3f}{r['warm'] / alone['warm']:8.2f}"
            f"{r['memory'] / 1e6:10.0f}{r['memory'] / alone['memory']:8.2f}"
        )
    return "\n".join(lines)
