"""Benchmarks: how accurate the solver is on problems with known answers, and what that costs.

    python -m benchmarks accuracy         errors, time and memory on the catalogue of problems (`tests/problems`)
    python -m benchmarks error-vs-time    the same over sizes, numbers of directions and quadratures, and a plot
    python -m benchmarks stability        extreme numbers of every kind: float32 against float64 and the bound
    python -m benchmarks convergence      sweeps to a certified 1e-4 over albedos and optical depths, against Jacobi
    python -m benchmarks peer             Mitsuba 3 on two of the scenes, side by side

Run from a checkout's root. Each writes a record with `--json FILE`: what was run, with which versions, on which device.
"""

import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
if str(ROOT / "tests") not in sys.path:  # the catalogue is the tests'
    sys.path.append(str(ROOT / "tests"))
