"""What all tests share: a cache of compiled programs, and 64-bit numbers for the tests that ask for them."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import pytest

DEVICES = os.environ.get("RAYMANIFOLD_TEST_DEVICES")  # virtual ones, for tests of meshes; they make all else slower
collect_ignore = [] if DEVICES else ["test_sharding.py"]
_MAPS = Path("/proc/self/maps")
_MANY = 30_000  # of the 65 530 regions of memory that Linux grants a process


def pytest_configure(config: pytest.Config) -> None:
    if DEVICES:
        jax.config.update("jax_num_cpu_devices", int(DEVICES))
    # Most of what tests that are not slow take is compiling programs that run once: not optimised, that takes half as long,
    # and rounding is as strict. `XLA_FLAGS= pytest` runs programs as users do.
    if config.option.markexpr == "not slow":
        os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """First those that compile loops for 64-bit numbers, while another worker waits for those of 32."""
    items.sort(key=lambda item: item.path.stem != "test_native")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Whole files go to a worker: their tests share compiled programs. In their order, as those of few tests may be long."""
    from xdist.scheduler import LoadFileScheduling

    config.option.loadscopereorder = False
    return LoadFileScheduling(config, log)


@pytest.fixture(autouse=True)
def few_programs() -> Iterator[None]:
    """Forget compiled programs before they are too many: each holds memory regions, and without any left XLA crashes."""
    yield
    if _MAPS.exists() and len(_MAPS.read_bytes().splitlines()) > _MANY:
        jax.clear_caches()


@pytest.fixture
def x64() -> Iterator[None]:
    """JAX with 64-bit numbers, for this test only."""
    with jax.enable_x64(True):
        yield
