"""What a benchmark's record says about the machine and the software, and peak memory.

Public names: `environment`, `write`, `peak_memory`.
"""

import functools
import json
import os
import platform
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from . import ROOT
from .alone import alone


@functools.cache
def environment(*packages: str) -> dict[str, Any]:
    """Processor, cores, device, versions and commit; no name of the machine."""
    # In another process: JAX, started here, would keep most of a GPU's memory from those that measure.
    return alone(_environment, *packages)


def _environment(*packages: str) -> dict[str, Any]:
    import jax

    import raymanifold_jax as rm

    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "device": str(jax.devices()[0].device_kind),
        "float": str(jax.numpy.zeros(0).dtype),
        "python": sys.version.split()[0],
        "raymanifold-jax": rm.__version__,
        "commit": _commit(),
        **{name: _version(name) for name in ("jax", "jaxlib", "numpy", *packages)},
    }


def write(path: Path | None, question: str, records: list[dict[str, Any]], **more: Any) -> None:
    """Write a record, if a path is given."""
    if path is not None:
        path.write_text(json.dumps({"question": question, **more, "records": records}, indent=1) + "\n")


def peak_memory() -> int:
    """The most memory this process has held so far, in bytes, an accelerator's included."""
    import jax

    host = _high_water_mark()
    stats = [device.memory_stats() for device in jax.local_devices()]
    return host + sum(s.get("peak_bytes_in_use", 0) for s in stats if s)


def _high_water_mark() -> int:
    try:
        # Not getrusage, which on Linux remembers the parent's memory.
        for line in Path("/proc/self/status").read_text().splitlines():
            if line.startswith("VmHWM:"):
                return int(line.split()[1]) * 1024
    except OSError:
        pass
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _commit() -> str:
    git = lambda *arguments: subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    try:
        changed = "+changes" if git("status", "--porcelain", "--untracked-files=no").strip() else ""
        return git("rev-parse", "--short", "HEAD").strip() + changed
    except (OSError, subprocess.CalledProcessError):
        return "unknown"


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "absent"
