"""The files of `tests/data`: tables with comments on top, and two scenes solved by another program (`data/README.md`)."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np

DATA = Path(__file__).parent.parent / "data"


def table(name: str) -> list[dict[str, str]]:
    """Rows of a CSV file; lines that start with # are comments."""
    with (DATA / name).open() as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def columns(rows: list[dict[str, Any]], *names: str) -> np.ndarray:
    """Some columns of such rows as numbers: (rows,) for one name, (rows, names) for several."""
    values = np.array([[row[name] for name in names] for row in rows], float)
    return values[:, 0] if len(names) == 1 else values


def probes(name: str) -> dict[str, Any]:
    """The probes of scene "A" or "C"."""
    return json.loads((DATA / f"{name}_probes.json").read_text())


def top_view(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of scene "A" or "C" seen from above, and its standard error: means of 32 x 32 blocks, [y, x]."""
    mean, error = np.load(DATA / f"{name}_top_blocks.npy").astype(float)
    return mean, error


def disort(name: str) -> dict[str, Any]:
    """A test problem of DISORT: its layers, and the converged columns."""
    return json.loads((DATA / "disort_isotropic.json").read_text())["cases"][name]
