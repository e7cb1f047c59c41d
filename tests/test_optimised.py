"""Tests of shapes and askew surfaces once more, with programs optimised as users have them: others are not (see `conftest`).

How XLA rounds what it repeats depends on that, and slopes of distances, which compare numbers, might depend on how it rounds.
"""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.skipif(os.environ.get("XLA_FLAGS", "") == "", reason="all tests have optimised programs")
def test_shapes_and_askew_surfaces():
    tests = [str(Path(__file__).with_name(name)) for name in ("test_shapes.py", "test_surfaces.py")]
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")} | {"XLA_FLAGS": ""}
    options = ["-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-k", "test_shapes or askew"]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", *options, *tests], env=environment, capture_output=True, text=True, timeout=3600
    )
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
