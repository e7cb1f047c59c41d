"""Checks of what a user passes in, made where it enters.

Every helper takes the name the user knows the value by and the value (Python numbers, sequences, numpy or JAX arrays),
and returns it as an array. A wrong kind of thing raises `TypeError`, a wrong number or array shape `ValueError`; the
message reads

    name: got <value>, expected <what>; <way out>

Values that JAX is tracing have no numbers to look at: for those only the shape and the dtype are checked. Physical
numbers keep their dtype; geometry (`vector3`, `unit_vector`, `points`) becomes float64 in numpy, unless it is traced.

Public names: `array`, `finite`, `non_negative`, `positive`, `in_unit_interval`, `vector3`, `unit_vector`, `points`,
`coordinates`, `positive_int`, `instance`, `is_traced`, `surely`, `may_differ_from_zero`, `fail`.
"""

import operator
from typing import Any, NoReturn, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer

Numbers: TypeAlias = np.ndarray | jax.Array


def fail(name: str, got: object, expected: str, advice: str, error: type[Exception] = ValueError) -> NoReturn:
    """Raise `error` with the house's message. `got` is shortened where it is a long array."""
    raise error(f"{name}: got {_show(got)}, expected {expected}; {advice}")


def is_traced(value: object) -> bool:
    """Whether any part of `value` is a JAX tracer, so that its numbers are not known yet."""
    return any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(value))


def surely(flag: Any) -> bool:
    """Whether a flag is true; False where JAX traces it and does not know yet."""
    try:
        return bool(flag)
    except jax.errors.ConcretizationTypeError:
        return False


def may_differ_from_zero(value: Any) -> bool:
    """Whether any part of `value` is traced, and so may become anything, or is above 0."""
    return is_traced(value) or any(bool(np.any(np.asarray(leaf) > 0)) for leaf in jax.tree.leaves(value))


def array(name: str, value: Any, shape: tuple[int, ...] | None = None, *, advice: str = "") -> Numbers:
    """`value` as an array of real numbers, in its own dtype.

    **Raises:** `TypeError` if it is not made of real numbers, `ValueError` if `shape` is given and differs.
    """
    expected = "real numbers" if shape is None else "a real number" if shape == () else f"numbers of shape {shape}"
    advice = advice or f"pass {expected} for {name}"
    if is_traced(value):
        result = jnp.asarray(value)
    else:
        try:
            result = np.asarray(value)
        except ValueError:  # numpy's answer to a ragged list
            fail(name, value, expected, advice)
    # Asked of JAX, because numpy does not count bfloat16 among its numbers.
    if not jnp.issubdtype(result.dtype, jnp.number) or jnp.issubdtype(result.dtype, jnp.complexfloating):
        fail(name, value, expected, advice, TypeError)
    if shape is not None and result.shape != shape:
        fail(name, f"{_show(value)} of shape {result.shape}", expected, advice)
    return result


def _check(name: str, value: Any, shape: tuple[int, ...] | None, valid: Any, expected: str, advice: str) -> Numbers:
    numbers = array(name, value, shape)
    if not isinstance(numbers, np.ndarray):
        return numbers
    bad = ~valid(numbers)
    if bad.any():
        if numbers.ndim == 0:
            fail(name, numbers, expected, advice)
        at = tuple(int(i) for i in np.argwhere(bad)[0])
        fail(name, f"{numbers[at]} at index {at} of an array of shape {numbers.shape}", expected, advice)
    return numbers


def finite(name: str, value: Any, shape: tuple[int, ...] | None = None) -> Numbers:
    """`value` with no NaN and no infinity in it."""
    return _check(name, value, shape, np.isfinite, "finite numbers", "look for a division by zero where it was made")


def non_negative(name: str, value: Any, shape: tuple[int, ...] | None = None) -> Numbers:
    """`value`, finite and >= 0."""
    return _check(name, value, shape, lambda v: np.isfinite(v) & (v >= 0), "finite numbers >= 0", "use 0 to switch it off")


def positive(name: str, value: Any, shape: tuple[int, ...] | None = None) -> Numbers:
    """`value`, finite and > 0."""
    return _check(name, value, shape, lambda v: np.isfinite(v) & (v > 0), "finite numbers > 0", "check its sign and its unit")


def in_unit_interval(name: str, value: Any, shape: tuple[int, ...] | None = None) -> Numbers:
    """`value` in [0, 1]."""
    return _check(
        name,
        value,
        shape,
        lambda v: (v >= 0) & (v <= 1),
        "numbers in [0, 1]",
        "it is a fraction of the arriving light: divide percentages by 100",
    )


def vector3(name: str, value: Any) -> Numbers:
    """`value` as three finite numbers, shape (3,), float64 in numpy unless traced."""
    return _float64(finite(name, array(name, value, (3,), advice="pass x, y and z, as in (0.0, 0.0, 1.0)")))


def unit_vector(name: str, value: Any) -> Numbers:
    """`value` as a vector scaled to length 1, shape (3,). A vector of length 0 raises `ValueError`."""
    vector = vector3(name, value)
    if not isinstance(vector, np.ndarray):
        return vector / jnp.sqrt(jnp.sum(vector**2))
    largest = np.abs(vector).max()
    if largest == 0:
        fail(name, value, "a direction of non-zero length", "pass any vector that points the way you mean")
    scaled = vector / largest  # so that its square neither over- nor underflows
    return scaled / np.linalg.norm(scaled)


def points(name: str, value: Any) -> Numbers:
    """`value` as finite points or directions, shape (n, 3), float64 in numpy unless traced."""
    numbers = array(name, value)
    if numbers.ndim != 2 or numbers.shape[1] != 3:
        fail(
            name,
            f"an array of shape {numbers.shape}",
            "shape (n, 3)",
            "a single point p is [p]; a grid g is g.reshape(-1, 3)",
        )
    return _float64(finite(name, numbers))


def coordinates(name: str, value: Any) -> jax.Array:
    """`value` as a JAX array of a floating dtype and shape (..., 3). Its values are not looked at."""
    result = jnp.asarray(value)
    if result.ndim == 0 or result.shape[-1] != 3:
        fail(name, f"an array of shape {result.shape}", "shape (..., 3)", "put x, y and z on the last axis")
    return result if jnp.issubdtype(result.dtype, jnp.floating) else result.astype(float)


def positive_int(name: str, value: Any, at_least: int = 1) -> int:
    """`value` as an int >= `at_least`."""
    try:
        number = operator.index(value)
    except TypeError:
        fail(name, value, "a whole number", f"pass an int, as in {name}={at_least}", TypeError)
    if isinstance(value, bool | np.bool_):
        fail(name, value, "a whole number", f"pass an int, as in {name}={at_least}", TypeError)
    if number < at_least:
        fail(name, number, f"a whole number >= {at_least}", f"use {name}={at_least} or more")
    return number


def instance(name: str, value: Any, types: type | tuple[type, ...], advice: str) -> None:
    """Raise `TypeError` unless `value` is an instance of one of `types`."""
    types = types if isinstance(types, tuple) else (types,)
    if not isinstance(value, types):
        got = f"the class {value.__name__} itself" if isinstance(value, type) else f"{_show(value)} ({type(value).__name__})"
        fail(name, got, " or ".join(t.__name__ for t in types), advice, TypeError)


def _float64(numbers: Numbers) -> Numbers:
    # A copy, so that a later change of the user's array does not reach into the scene.
    return np.array(numbers, dtype=np.float64) if isinstance(numbers, np.ndarray) else numbers


def _show(value: object) -> str:
    if isinstance(value, str):
        return value
    text = repr(value.item()) if isinstance(value, np.ndarray) and value.ndim == 0 else repr(value)
    text = " ".join(text.split())
    return text if len(text) <= 80 else text[:77] + "..."
