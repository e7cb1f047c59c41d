"""One problem, one size, one quadrature: errors, seconds and memory, measured in a process of its own.

The first solve compiles; those that follow do not. "compile" is the difference between the first and the median of the
others. Reading values out of a solution (final gathers, pictures) is timed apart, for each reader, likewise without its
compilation.

Public names: `Job`, `measure`, `run`, `QUADRATURES`, `DEFAULT`, `PAPER`.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures.process import BrokenProcessPool
from dataclasses import asdict, dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from .alone import alone
from .record import peak_memory

if TYPE_CHECKING:
    from problems.case import Reader

    from raymanifold_jax.quadrature import Quadrature


def _half_width(count: int) -> int:
    """Of a light ray cube with about as many points."""
    return max(1, round(math.sqrt((count - 2) / 24)))


def _light_ray_cube(count: int) -> "Quadrature":
    import raymanifold_jax as rm

    return rm.quadrature.light_ray_cube(_half_width(count))


def _product(count: int) -> "Quadrature":
    import raymanifold_jax as rm

    polar = max(2, round(math.sqrt(count / 2)))
    return rm.quadrature.product(polar, 2 * polar)


def _fibonacci(count: int) -> "Quadrature":
    import raymanifold_jax as rm

    return rm.quadrature.fibonacci(count)


def _cube(count: int) -> "Quadrature":
    import raymanifold_jax as rm

    return rm.quadrature.cube(2 * max(1, round(math.sqrt(count / 24))))


#: By name: a number of directions to the quadrature whose own number is nearest.
QUADRATURES: Mapping[str, Callable[[int], "Quadrature"]] = MappingProxyType(
    {"fibonacci": _fibonacci, "cube": _cube, "light-ray-cube": _light_ray_cube, "product": _product}
)
DEFAULT = "default"  # what `rm.solve` takes
_NONE: Mapping[str, Any] = MappingProxyType({})
PAPER = "paper"  # the paper's scheme, which has its own directions


@dataclass(frozen=True)
class Job:
    """What to measure: a problem of the catalogue, its size, and the directions; `repeats` solves after the first."""

    problem: str
    size: int
    directions: int
    quadrature: str = DEFAULT
    repeats: int = 1


def measure(job: Job, more: Mapping[str, "Reader"] = _NONE) -> dict[str, Any]:
    """Solve and read, in this process, with the problem's readers and `more`. The record has no arrays."""
    import jax
    import problems

    import raymanifold_jax as rm

    case = problems.CASES[job.problem]
    scene = case.build(job.size)
    chosen = QUADRATURES.get(job.quadrature, lambda count: rm.quadrature.for_scene(scene, count))
    options: dict[str, Any] = {"quadrature": chosen(job.directions)}
    directions = len(options["quadrature"])
    if job.quadrature == PAPER:
        cube = rm.LightRayCube(half_width=_half_width(job.directions))
        options, directions = {"scheme": cube}, 24 * cube.half_width**2 + 2

    def solve() -> rm.Solution:
        solution = rm.solve(scene, **options, rtol=case.rtol, progress=False)
        jax.block_until_ready(solution.diffuse_fluence)
        return solution

    first, solution = _timed(solve)
    again = [_timed(solve) for _ in range(job.repeats)]
    warm = [seconds for seconds, _ in again]
    read, quantities, targets = {}, {}, case.targets(job.size)
    for number, (name, reader) in enumerate({**case.readers, **more}.items()):
        read[name], values = _timed(lambda reader=reader: reader(solution))
        if again:  # another solution, for which nothing is ready; with as many repeats as readers one for each
            fresh = again[number % len(again)][1]
            read[name] = _timed(lambda reader=reader, fresh=fresh: reader(fresh))[0]
        quantities |= {quantity: _errors(r, targets.get(quantity)) for quantity, r in values.items()}
    usual = statistics.median(warm) if warm else None
    return asdict(job) | {
        "title": case.title,
        "errors_of": case.errors_of,
        "directions": directions,
        "voxels": scene.lattice.size,
        "seconds": {
            "first": first,
            "warm": usual,
            "spread": max(warm) - min(warm) if warm else None,
            "compile": None if usual is None else first - usual,
            "read": read,
        },
        "memory": peak_memory(),
        "sweeps": solution.sweeps,
        "converged": solution.converged,
        "error_bound": float(solution.error_bound),
        "imbalance": float(solution.energy.imbalance),
        "quantities": quantities,
    }


def run(
    jobs: Iterable[Job], tell: Callable[[str], None], more: Mapping[str, Mapping[str, "Reader"]] = _NONE
) -> Iterator[dict[str, Any]]:
    """Records of jobs, one after the other, each from a fresh process; a job that fails gives a record with "error".

    `more`: further readers, by the name of the problem.
    """
    for job in jobs:
        tell(f"{job.problem}, {job.size} voxels, {job.directions} directions ({job.quadrature})")
        try:
            record = alone(measure, job, dict(more.get(job.problem, {})))
        except BrokenProcessPool:
            record = asdict(job) | {"error": "the process died: out of memory?"}
        except (ValueError, RuntimeError, MemoryError) as error:
            record = asdict(job) | {"error": str(error)}
        yield record


def _timed(function: Callable[[], Any]) -> tuple[float, Any]:
    began = time.perf_counter()
    result = function()
    return time.perf_counter() - began, result


def _errors(readings: Any, target: Any) -> dict[str, Any]:
    return {
        "points": len(readings.ours),
        "bias": readings.bias(),
        "rms": readings.rms(),
        "worst": readings.worst(),
        "reference_error": readings.reference_error(),
        "target": None if target is None else target._asdict(),
        "met": None if target is None else target.met(readings),
    }
