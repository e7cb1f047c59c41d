"""Arrays of JAX from numbers of the host.

`jnp.asarray` makes a program for every shape that it copies or converts, which takes JAX some milliseconds each at the start
of every process; here numpy converts. So does every other operation outside of `jit`: numpy does them where numbers are known.

Public: `as_jax`, `zeros_like`, `ones_like`, `real_dtype`, `numpy_or_jax`, `numpy_or_jax_of`, `is_staging`, `worked_out_now`,
`stop_gradient`, `on_accelerator`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from types import ModuleType
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array

from . import checks

T = TypeVar("T")


def as_jax(values: Any, dtype: Any = None) -> Array:
    """As `jnp.asarray`."""
    if isinstance(values, jax.Array) or checks.is_traced(values):
        return jnp.asarray(values, dtype)
    return jax.device_put(np.asarray(values, None if dtype is None else jax.dtypes.canonicalize_dtype(dtype)))


def on_accelerator() -> bool:
    """Whether JAX works on something else than a CPU."""
    return jax.default_backend() != "cpu"


def zeros_like(tree: T) -> T:
    """As `jnp.zeros_like` of each array."""
    return jax.tree.map(lambda array: _filled_like(array, np.zeros, jnp.zeros_like), tree)


def ones_like(tree: T) -> T:
    """As `jnp.ones_like` of each array."""
    return jax.tree.map(lambda array: _filled_like(array, np.ones, jnp.ones_like), tree)


def _filled_like(array: Array, filled: Callable, like: Callable) -> Array:
    if checks.is_traced(array) or on_accelerator() or (isinstance(array, jax.Array) and len(array.devices()) > 1):
        return like(array)
    return jax.device_put(filled(array.shape, array.dtype))


def real_dtype() -> np.dtype:
    """Of real numbers as JAX is set up: float32, or float64 with its `enable_x64`."""
    return np.dtype(jax.dtypes.canonicalize_dtype(float))


def numpy_or_jax(*values: Any) -> ModuleType:
    """`numpy` where all of these are known, `jax.numpy` where JAX traces some."""
    return jnp if checks.is_traced(values) else np


def numpy_or_jax_of(array: Any) -> ModuleType:
    """The one that this array is of."""
    return np if isinstance(array, np.ndarray) else jnp


def is_staging() -> bool:
    """Whether JAX stages what is done now, with known numbers too."""
    return checks.is_traced(jax.device_put(np.zeros(())))


def worked_out_now() -> AbstractContextManager:
    """For what no parameter moves: it is known even while JAX stages the rest."""
    return jax.ensure_compile_time_eval() if is_staging() else nullcontext()


def stop_gradient(tree: T) -> T:
    """The same numbers without derivatives: known ones, unless `jit` or `vmap` traces them."""
    # What is known stays as it is: while JAX stages, it would become part of the program.
    return jax.tree.map(lambda a: lax.stop_gradient(a) if eqx.is_inexact_array(a) and checks.is_traced(a) else a, tree)
