"""What all tests share: a cache of compiled programs, and 64-bit numbers for the tests that ask for them."""

import os
from collections.abc import Iterator

import jax
import pytest


def pytest_configure(config: pytest.Config) -> None:
    # Environment variables, because pytest-xdist's workers and the command line's subprocesses inherit them. The cache
    # lies in pytest's own (`pytest --cache-clear` empties it) and outlives the run.
    cache = getattr(config, "cache", None)  # none with `-p no:cacheprovider`
    if cache is None or hasattr(config, "workerinput"):
        return
    os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache.mkdir("jax")))
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
    # JAX, imported above, has read its environment already.
    jax.config.update("jax_compilation_cache_dir", os.environ["JAX_COMPILATION_CACHE_DIR"])
    jax.config.update(
        "jax_persistent_cache_min_compile_time_secs", float(os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"])
    )


@pytest.fixture
def x64() -> Iterator[None]:
    """JAX with 64-bit numbers, for this test only."""
    with jax.enable_x64(True):
        yield
