"""Compiled programs that are kept whole, so that a second start loads them and traces nothing.

JAX's own cache keeps what XLA makes of a program; to find it there, JAX traces and lowers the program again in every process,
which takes 10 to 400 ms each. Here a program is found by what it is made from:

- the function's name, and the sources of this package;
- the arguments: shapes and dtypes of arrays, everything else by value;
- the versions of Python, JAX, Equinox and numpy, the processor, and what JAX and XLA read from the environment.

Arguments that hold functions or classes of anybody else's, whose sources are not known, have their program compiled as ever;
so have those that JAX traces, and all of them on GPUs and on several devices.

For this package: `program` in place of `equinox.filter_jit`. Where programs are kept, `program_files.keep_in` says.
"""

from __future__ import annotations

import functools
import io
import math
import pickle
import secrets
import sys
import threading
import types
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax

from . import checks, program_files
from .arrays import real_dtype
from .program_files import Folder

R = TypeVar("R")

#: The packages whose functions and classes are known by their names.
_KNOWN = {__name__.partition(".")[0], *program_files.VERSIONED, *sys.stdlib_module_names}
_NAMELESS = pickle.PicklingError, TypeError, AttributeError  # what pickle raises for what has no name

_finding = threading.RLock()  # held while a program is looked for or made: threads may ask for the same one


def program(function: Callable[..., R]) -> Callable[..., R]:
    """`equinox.filter_jit(function)`, for a function of a module; what is compiled is kept where `program_files` says."""
    compiling = eqx.filter_jit(function)
    ready: dict[Hashable, Callable[[Sequence], Any] | None] = {}

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> R:
        folder = program_files.folder()
        if folder is None:
            return compiling(*arguments, **named)
        leaves, tree = jax.tree.flatten((arguments, named))
        if checks.is_traced(leaves):
            return compiling(*arguments, **named)
        key = tree, tuple(map(_kind, leaves)), real_dtype()
        with _finding:
            if key not in ready:
                known = [_Array.like(leaf) if eqx.is_array(leaf) else leaf for leaf in leaves]
                ready[key] = _find(folder, function, tree, known)
        run = ready[key]
        return compiling(*arguments, **named) if run is None else run([leaf for leaf in leaves if eqx.is_array(leaf)])

    return call


def _kind(leaf: Any) -> Hashable:
    """What is looked at in every call."""
    return (leaf.shape, leaf.dtype, getattr(leaf, "weak_type", False)) if eqx.is_array(leaf) else (type(leaf), leaf)


@dataclass(frozen=True)
class _Array:
    """What a program knows of an array."""

    shape: tuple[int, ...]
    dtype: str
    weak: bool

    @classmethod
    def like(cls, array: Any) -> _Array:
        return cls(array.shape, jax.dtypes.canonicalize_dtype(array.dtype).name, getattr(array, "weak_type", False))

    @property
    def abstract(self) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(self.shape, self.dtype, weak_type=self.weak)


class _Result:
    """Stands for an array in what a function returns."""


def _find(folder: Folder, function: Callable, tree: Any, known: list) -> Callable[[Sequence], Any] | None:
    """The program for these arguments, from the folder or made now; None if it cannot be kept."""
    name = f"{function.__module__}.{function.__qualname__}"
    try:
        made_from = _pickled((name, tree.unflatten(known), str(real_dtype())))
    except _NAMELESS:
        return None
    file = folder.path / f"{name}-{program_files.digest(made_from)}"
    loaded = folder.load(file)
    return _make(file, function, tree, known) if loaded is None else _runner(loaded[0], pickle.loads(loaded[1]))


class _Pickler(pickle.Pickler):
    """Refuses to name what may change under the same name."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, type | types.FunctionType | types.BuiltinFunctionType):
            module = value.__module__ or "builtins"
            if module.partition(".")[0] not in _KNOWN:
                raise pickle.PicklingError(f"{value} is not of this package")
        return NotImplemented


def _pickled(value: Any) -> bytes:
    file = io.BytesIO()
    _Pickler(file, protocol=5).dump(value)
    return file.getvalue()


def _make(file: Path, function: Callable, tree: Any, known: list) -> Callable[[Sequence], Any]:
    """The program, compiled, and kept in a file where that is possible."""
    returned = []

    def flat(*arrays: Any) -> list:
        given = iter(arrays)
        arguments, named = tree.unflatten([next(given) if isinstance(k, _Array) else k for k in known])
        leaves, form = jax.tree.flatten(function(*arguments, **named))
        returned.append(form.unflatten([_Result() if eqx.is_array(leaf) else leaf for leaf in leaves]))
        return [leaf for leaf in leaves if eqx.is_array(leaf)]

    flat.__name__ = f"{function.__name__}_{secrets.token_hex(8)}"
    lowered = jax.jit(flat).lower(*(k.abstract for k in known if isinstance(k, _Array)))
    with _past_the_cache():
        compiled = lowered.compile()
    results = returned[-1]
    try:
        counts = sum(isinstance(k, _Array) for k in known), sum(isinstance(leaf, _Result) for leaf in jax.tree.leaves(results))
        program_files.write_whole(file, program_files.serialized(compiled, *counts, pickle.dumps(results)))
    except (OSError, ValueError, NotImplementedError, jax.errors.JaxRuntimeError, *_NAMELESS):  # a full disk, or callbacks
        pass
    return _runner(compiled, results)


@contextmanager
def _past_the_cache() -> Iterator[None]:
    """Without JAX's cache, which has nothing under a name that is new: what is loaded from there cannot be stored again."""
    setting = "jax_persistent_cache_min_compile_time_secs"
    before = jax.config.values[setting]
    jax.config.update(setting, math.inf)
    try:
        yield
    finally:
        jax.config.update(setting, before)


def _runner(compiled: Callable, results: Any) -> Callable[[Sequence], Any]:
    leaves, form = jax.tree.flatten(results)

    def run(arrays: Sequence) -> Any:
        found = iter(compiled(*arrays))
        return form.unflatten([next(found) if isinstance(leaf, _Result) else leaf for leaf in leaves])

    return run
