"""Mitsuba 3 and this package on the same scenes, on the same cores, one after the other.

For ours, every size and number of directions is one point: the seconds of a solve and of reading the quantity out, without
compilation, against the rms error. Mitsuba's error falls as one over the root of its time; the time to the goal is read off
its own curve. From the errors of both the reference's own is taken out. One solve of ours serves all quantities (and any view);
Mitsuba starts anew for each.

The quantities: "irradiance" at some 100 probes, "top view", the view from above as 32 x 32 means, and "picture", its 256 x 256
pixels. For the last Mitsuba's own renderings of this run are the reference.

Public names: `compare`, `Comparison`.
"""

import math
import multiprocessing
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from .measure import Job, run
from .mitsuba_scenes import error_curve, picture_curve
from .table import seconds_text

PROBLEMS = {"A": "room", "C": "fog"}
READERS = {"irradiance": "probes", "top view": "top view", "picture": "picture"}  # quantity: who reads it


@dataclass(frozen=True)
class Comparison:
    """Our records, Mitsuba's curves, and for each scene and quantity who needs how long for the goal."""

    ours: list[dict[str, Any]]
    curves: list[dict[str, Any]]
    summary: list[dict[str, Any]]

    def table(self) -> str:
        """What the goal takes; "first" times include compilation."""
        rows: list[tuple[str, ...]] = [
            ("scene", "quantity", "goal %", "ours s", "first s", "setting", "rms %", "Mitsuba s", "first pass s", "ratio")
        ]
        for line in self.summary:
            ours = line["ours"]
            cells = ["not reached", "", "", "", ""]
            if ours is not None:
                setting = f"{ours['size']} voxels, {ours['directions']} directions"
                ratio = f"{line['mitsuba_seconds'] / ours['seconds']:.2g}"
                times = seconds_text(ours["seconds"]), seconds_text(ours["first"])
                cells = [*times, setting, f"{100 * ours['rms']:.2f}", ratio]
            mitsuba = seconds_text(line["mitsuba_seconds"]) + ("" if line["mitsuba_reached"] else " (extrapolated)")
            first = seconds_text(line["mitsuba_first"])
            goal = f"{100 * line['goal']:g}"
            rows.append((line["scene"], line["quantity"], goal, *cells[:4], mitsuba, first, cells[4]))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        text = ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        variants = ", ".join({curve["variant"] for curve in self.curves})
        return "\n".join([*text, f"Mitsuba {self.curves[0]['mitsuba']}, variant {variants}"])


def compare(
    scenes: Sequence[str],
    sizes: Sequence[int],
    counts: Sequence[int],
    seconds: float,
    goal: float,
    tell: Callable[[str], None],
) -> Comparison:
    """Measure both. **Raises** `RuntimeError` if Mitsuba is not there."""
    import problems

    curves = []
    with tempfile.TemporaryDirectory() as folder:
        more: dict[str, dict[str, Any]] = {}
        for scene in scenes:
            halves = Path(folder, f"{scene}.npy")
            more[PROBLEMS[scene]] = {"picture": partial(problems.read_picture, scene, halves)}
            for quantity in READERS:
                tell(f"Mitsuba, scene {scene}, {quantity}")
                single = quantity == "picture"
                curve = partial(picture_curve, scene, halves) if single else partial(error_curve, scene, quantity)
                with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
                    curves.append(pool.submit(curve, seconds, goal).result())
        of = lambda scene, size, count: Job(PROBLEMS[scene], size, count, repeats=len(READERS))
        jobs = [of(scene, size, count) for scene in scenes for size in sizes for count in counts]
        ours = list(run(jobs, tell, more))
    return Comparison(ours, curves, [_summary(curve, ours, goal) for curve in curves])


def _summary(curve: dict[str, Any], ours: list[dict[str, Any]], goal: float) -> dict[str, Any]:
    """The fastest of our settings that reaches the goal, next to Mitsuba's time."""
    points = [point(r, curve["quantity"]) for r in ours if r["problem"] == PROBLEMS[curve["scene"]] and "error" not in r]
    enough = sorted((p for p in points if p["rms"] <= goal), key=lambda p: p["seconds"])
    return {
        "scene": curve["scene"],
        "quantity": curve["quantity"],
        "goal": goal,
        "ours": enough[0] if enough else None,
        "mitsuba_seconds": curve["seconds_to_goal"],
        "mitsuba_first": curve["first_pass_seconds"],
        "mitsuba_reached": curve["reached"],
    }


def point(record: dict[str, Any], quantity: str) -> dict[str, Any]:
    """Seconds of one record, and the rms error of one quantity, less the reference's own."""
    seconds, errors = record["seconds"], record["quantities"][quantity]
    read = seconds["read"][READERS.get(quantity, "probes")]
    solve = seconds["first"] if seconds["warm"] is None else seconds["warm"]
    return {
        "seconds": solve + read,
        "first": seconds["first"] + read,
        "rms": math.sqrt(max(errors["rms"] ** 2 - errors["reference_error"] ** 2, 0.0)),
        "size": record["size"],
        "directions": record["directions"],
        "quadrature": record["quadrature"],
    }
