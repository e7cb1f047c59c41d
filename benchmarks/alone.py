"""Work in a process of its own, which has all memory and devices to itself and leaves nothing behind.

Public name: `alone`.
"""

import multiprocessing
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from typing import Any


def alone(function: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """function(*arguments) in a process of its own."""
    # Spawned, because a fork of a process in which JAX runs can hang.
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(function, *arguments).result()
