"""The host's cores, and work on several of them at once.

XLA works on what one thread asks for in turn, and splits little of it over the cores.

Public: `count_cores`, `on_threads`.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any


@functools.cache
def count_cores() -> int:
    """How many this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_threads(pool: ThreadPoolExecutor, function: Callable, *arguments: Iterable, device: Any = None) -> list[Any]:
    """function(*each) for each of the arguments side by side, in order, with JAX's numbers and device as they are here."""
    import jax

    from .arrays import real_dtype

    # Contexts hold for one thread only.
    x64 = real_dtype() == "float64"
    device = jax.config.jax_default_device if device is None else device  # pyright: ignore[reportAttributeAccessIssue]

    def as_here(*each: Any) -> Any:
        with jax.enable_x64(x64), jax.default_device(device):
            return jax.block_until_ready(function(*each))

    return list(pool.map(as_here, *arguments))
