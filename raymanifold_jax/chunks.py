"""Rows of arrays worked on a chunk at a time, in programs of one size for any number of rows.

For this package: `padded`, `of_first_chunks`, `of_chunks`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax


def padded(rows: Any, size: int, xp: Any = np) -> Any:
    """With rows like the last one up to whole chunks of this size, at least one: they take no longer than the rest."""
    short = -len(rows) % size if len(rows) else size
    if not short:
        return rows
    last = rows[-1:] if len(rows) else xp.ones((1, *rows.shape[1:]), rows.dtype)
    return xp.concatenate([rows, xp.broadcast_to(last, (short, *rows.shape[1:]))])


def of_first_chunks(function: Callable, arrays: Any, size: int, used: Any) -> Any:
    """function(*arrays) of the first `used` chunks of (n, ...) arrays, and 0 of the rest; has no derivative backwards.

    `arrays` is a tuple of trees; a chunk has `size` rows, of which n is a multiple unless there is only one.
    """
    count = _count(arrays)
    if count <= size:
        return function(*arrays)
    chunks = _parted(arrays, size)
    one = lambda number: function(*jax.tree.map(lambda a: a[number], chunks))
    nothing = jax.tree.map(lambda r: jnp.zeros((count // size, *r.shape), r.dtype), jax.eval_shape(one, 0))
    put = lambda number, found: jax.tree.map(lambda r, new: r.at[number].set(new), found, one(number))
    return _as_rows(lax.fori_loop(0, jnp.minimum(used, count // size), put, nothing))


def of_chunks(function: Callable, arrays: Any, size: int) -> Any:
    """function(*arrays) by chunks, of any number of rows."""
    count = _count(arrays)
    if count <= size:
        return function(*arrays)
    chunks = _parted(jax.tree.map(lambda a: padded(a, size, jnp), arrays), size)
    found = lax.map(lambda chunk: function(*chunk), chunks)
    return jax.tree.map(lambda r: r[:count], _as_rows(found))


def _count(arrays: Any) -> int:
    return len(jax.tree.leaves(arrays)[0])


def _parted(arrays: Any, size: int) -> Any:
    return jax.tree.map(lambda a: a.reshape(-1, size, *a.shape[1:]), arrays)


def _as_rows(found: Any) -> Any:
    return jax.tree.map(lambda r: r.reshape(-1, *r.shape[2:]), found)
