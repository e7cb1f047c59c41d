"""The tests of meshes, `test_sharding.py`, in a process that has the devices for them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize("which, devices", [("not slow", "8"), pytest.param("slow", "32", marks=pytest.mark.slow)])
def test_on_virtual_devices(which, devices):
    tests = str(Path(__file__).with_name("test_sharding.py"))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", "-p", "no:cacheprovider", "-m", which, tests]
    # Set aside: this process's own workers and options.
    environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTEST_")}
    environment["RAYMANIFOLD_TEST_DEVICES"] = devices
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=3600)
    assert run.returncode == 0, run.stdout[-4000:] + run.stderr[-2000:]
