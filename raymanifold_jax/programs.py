"""Compiled programs that are kept whole, so that a second start loads them and traces nothing.

JAX's own cache keeps what XLA makes of a program; to find it there, JAX traces and lowers the program again in every process,
which takes 10 to 400 ms each. Here a program is found by what it is made from:

- the function's name, and the sources of this package;
- the arguments: shapes and dtypes of arrays, everything else by value;
- the versions of Python, JAX, Equinox and numpy, the processor, and what JAX and XLA read from the environment.

Arguments that hold functions or classes of anybody else's, whose sources are not known, have their program compiled as ever;
so have those that JAX traces, and all of them on GPUs and on several devices.

Like those in JAX's cache, the files are code: they are only kept in a folder that is the user's own.

For this package: `program` in place of `equinox.filter_jit`; `keep_in`.
"""

from __future__ import annotations

import functools
import hashlib
import io
import math
import os
import pickle
import platform
import secrets
import stat
import sys
import types
import zlib
from collections.abc import Callable, Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jaxlib
import numpy as np
from jax.experimental import serialize_executable

from . import checks
from .arrays import real_dtype

R = TypeVar("R")

_VERSIONED = (jax, jaxlib, eqx, np)
#: The packages whose functions and classes are known by their names.
_KNOWN = {__name__.partition(".")[0], *(package.__name__ for package in _VERSIONED), *sys.stdlib_module_names}
_FAST = 1  # of zlib's levels

_folder: Path | None = None


def keep_in(directory: str | os.PathLike[str] | None) -> None:
    """Keep the programs of this process in a folder in this directory, or nowhere. The command line does."""
    global _folder
    _folder = None
    if directory is not None:
        folder = Path(directory) / "programs"
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _folder = folder if _is_own(folder) else None
        except OSError:  # then JAX has no cache there either
            pass


def _is_own(folder: Path) -> bool:
    """Whether nobody else can write there."""
    status = folder.stat()
    return not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def program(function: Callable[..., R]) -> Callable[..., R]:
    """`equinox.filter_jit(function)`, for a function of a module; what is compiled is kept where `keep_in` says."""
    compiling = eqx.filter_jit(function)
    ready: dict[Hashable, Callable[[Sequence], Any] | None] = {}

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> R:
        if _folder is None or not _on_one_cpu():
            return compiling(*arguments, **named)
        leaves, tree = jax.tree.flatten((arguments, named))
        if checks.is_traced(leaves):
            return compiling(*arguments, **named)
        known = [_Array.like(leaf) if eqx.is_array(leaf) else leaf for leaf in leaves]
        key = tree, tuple((type(leaf), leaf) for leaf in known), real_dtype()
        if key not in ready:
            ready[key] = _find(_folder, function, tree, known)
        run = ready[key]
        return compiling(*arguments, **named) if run is None else run([leaf for leaf in leaves if eqx.is_array(leaf)])

    return call


@functools.cache
def _on_one_cpu() -> bool:
    return [device.platform for device in jax.devices()] == ["cpu"]


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


def _find(folder: Path, function: Callable, tree: Any, known: list) -> Callable[[Sequence], Any] | None:
    """The program for these arguments, from the folder or made now; None if it cannot be kept."""
    name = f"{function.__module__}.{function.__qualname__}"
    try:
        made_from = _pickled((name, tree.unflatten(known), str(real_dtype())))
    except (pickle.PicklingError, TypeError, AttributeError):  # pickle has several for what has no name
        return None
    file = folder / f"{name}-{hashlib.sha256(_circumstances() + made_from).hexdigest()}"
    return _load(file, sum(isinstance(k, _Array) for k in known)) or _make(file, function, tree, known)


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


@functools.cache
def _circumstances() -> bytes:
    """A digest of what all programs depend on."""
    versions = [platform.python_version(), *(package.__version__ for package in _VERSIONED)]
    settings = sorted(item for item in os.environ.items() if item[0].startswith(("JAX_", "XLA_")))
    digest = hashlib.sha256(repr((versions, settings, _processor(), os.cpu_count())).encode())
    package = Path(__file__).parent
    for source in sorted(package.rglob("*.py")):
        digest.update(repr(source.relative_to(package)).encode() + source.read_bytes())
    return digest.digest()


def _processor() -> list[str]:
    described = Path("/proc/cpuinfo")
    if not described.exists():
        return [platform.platform(), platform.processor(), platform.node()]
    kinds = ("model name", "flags", "Features", "CPU implementer", "CPU part")
    return sorted({line for line in described.read_text().splitlines() if line.startswith(kinds)})


def _load(file: Path, arguments: int) -> Callable[[Sequence], Any] | None:
    """The program in a file; None if there is none that can be used."""
    try:
        results, executable = pickle.loads(zlib.decompress(file.read_bytes()))  # with a checksum
        trees = jax.tree.structure(((0,) * arguments, {})), jax.tree.structure([0] * _count(results))
        return _runner(serialize_executable.deserialize_and_load(executable, *trees), results)
    except (OSError, zlib.error, jax.errors.JaxRuntimeError):
        return None


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
        content = zlib.compress(pickle.dumps((results, serialize_executable.serialize(compiled)[0])), _FAST)
        _write(file, content)
    except (OSError, ValueError, NotImplementedError, jax.errors.JaxRuntimeError):  # a full disk, or callbacks
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


def _write(file: Path, content: bytes) -> None:
    temporary = file.with_name(f".{secrets.token_hex(8)}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def _count(results: Any) -> int:
    return sum(isinstance(leaf, _Result) for leaf in jax.tree.leaves(results))


def _runner(compiled: Callable, results: Any) -> Callable[[Sequence], Any]:
    leaves, form = jax.tree.flatten(results)

    def run(arrays: Sequence) -> Any:
        found = iter(compiled(*arrays))
        return form.unflatten([next(found) if isinstance(leaf, _Result) else leaf for leaf in leaves])

    return run
