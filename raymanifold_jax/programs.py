"""Compiled programs that are kept whole, so that a second start loads them and traces nothing.

JAX's own cache keeps what XLA makes of a program; to find it there, JAX traces and lowers the program again in every process,
which takes 10 to 400 ms each. Here a program is found by what it is made from:

- the function's name, and the sources of this package;
- the arguments: shapes and dtypes of arrays, everything else by value;
- the versions of Python, JAX, Equinox and numpy, the processor, and what JAX and XLA read from the environment.

Arguments that hold functions or classes of anybody else's, whose sources are not known, have their program compiled as ever;
so have those that JAX traces, and all of them on GPUs and on several devices.

Like those in JAX's cache, the files are code: they are only kept in a folder that is the user's own.

For this package: `program` in place of `equinox.filter_jit`; `keep_in`; `user_cache`, `is_own` and `write_whole` for
other files of code.
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
import threading
import types
import zlib
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
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
_NAMELESS = pickle.PicklingError, TypeError, AttributeError  # what pickle raises for what has no name
_FAST = 1  # of zlib's levels
_MOST_LISTED = 300  # programs of a task: more than one start uses

_folder: _Folder | None = None
_finding = threading.RLock()  # held while a program is looked for or made: threads may ask for the same one


def keep_in(directory: str | os.PathLike[str] | None, task: str = "") -> None:
    """Keep the programs of this process in a folder in this directory, or nowhere. The command line does.

    What processes with this `task` came to use is loaded ahead, beside what else there is to do.
    """
    global _folder
    _folder = None
    if directory is not None and _on_one_cpu():
        path = Path(directory) / "programs"
        try:
            path.mkdir(mode=0o700, parents=True, exist_ok=True)
            _folder = _Folder(path, task) if is_own(path) else None
        except OSError:  # then JAX has no cache there either
            return


def _on_one_cpu() -> bool:
    return [device.platform for device in jax.devices()] == ["cpu"]


def is_own(path: Path) -> bool:
    """Whether nobody else can write there."""
    status = path.stat()
    return not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & (stat.S_IWGRP | stat.S_IWOTH))


def user_cache(environment: Mapping[str, str]) -> Path:
    """The package's own folder in the user's cache directory."""
    user = environment.get("XDG_CACHE_HOME", "")
    # A relative path has no meaning there (XDG base directory specification).
    base = Path(user) if os.path.isabs(user) else Path("~/.cache").expanduser()
    return base / "raymanifold"


def program(function: Callable[..., R]) -> Callable[..., R]:
    """`equinox.filter_jit(function)`, for a function of a module; what is compiled is kept where `keep_in` says."""
    compiling = eqx.filter_jit(function)
    ready: dict[Hashable, Callable[[Sequence], Any] | None] = {}

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> R:
        if _folder is None:
            return compiling(*arguments, **named)
        leaves, tree = jax.tree.flatten((arguments, named))
        if checks.is_traced(leaves):
            return compiling(*arguments, **named)
        key = tree, tuple(map(_kind, leaves)), real_dtype()
        with _finding:
            if key not in ready:
                known = [_Array.like(leaf) if eqx.is_array(leaf) else leaf for leaf in leaves]
                ready[key] = _find(_folder, function, tree, known)
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


def _find(folder: _Folder, function: Callable, tree: Any, known: list) -> Callable[[Sequence], Any] | None:
    """The program for these arguments, from the folder or made now; None if it cannot be kept."""
    name = f"{function.__module__}.{function.__qualname__}"
    try:
        made_from = _pickled((name, tree.unflatten(known), str(real_dtype())))
    except _NAMELESS:
        return None
    file = folder.path / f"{name}-{_digest(made_from)}"
    loaded = folder.load(file)
    return _make(file, function, tree, known) if loaded is None else _runner(loaded[0], pickle.loads(loaded[1]))


def _digest(made_from: bytes) -> str:
    return hashlib.sha256(_circumstances() + made_from).hexdigest()


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


def _load(file: Path) -> tuple[Callable, bytes] | None:
    """The program in a file, and the form of its results; None if there is none that can be used."""
    try:
        arguments, arrays, results, executable = pickle.loads(zlib.decompress(file.read_bytes()))  # with a checksum
        trees = jax.tree.structure(((0,) * arguments, {})), jax.tree.structure([0] * arrays)
        return serialize_executable.deserialize_and_load(executable, *trees), results
    except (OSError, zlib.error, jax.errors.JaxRuntimeError):
        return None


class _Folder:
    """Files of programs. A list tells which ones a task uses, in the order of their first use: a thread loads them ahead."""

    def __init__(self, path: Path, task: str):
        self.path = path
        self._list = path / f"task-{_digest(task.encode())}"
        names = self._list.read_text(errors="replace").split() if self._list.exists() else []
        if len(names) > _MOST_LISTED:  # of what the task was before: begin anew
            names = []
            with suppress(OSError):
                self._list.unlink()
        pool = ThreadPoolExecutor(1, "programs")
        self._coming = {name: pool.submit(_load, path / name) for name in dict.fromkeys(names)}

    def load(self, file: Path) -> tuple[Callable, bytes] | None:
        coming = self._coming.pop(file.name, None)
        if coming is not None:
            return coming.result()
        with suppress(OSError), self._list.open("a") as names:
            names.write(f"{file.name}\n")
        return _load(file)


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
        whole = *counts, pickle.dumps(results), serialize_executable.serialize(compiled)[0]
        write_whole(file, zlib.compress(pickle.dumps(whole), _FAST))
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


def write_whole(file: Path, content: bytes) -> None:
    """Under a temporary name first, so that a file is whole or is not there."""
    temporary = file.with_name(f".{secrets.token_hex(8)}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)


def _runner(compiled: Callable, results: Any) -> Callable[[Sequence], Any]:
    leaves, form = jax.tree.flatten(results)

    def run(arrays: Sequence) -> Any:
        found = iter(compiled(*arrays))
        return form.unflatten([next(found) if isinstance(leaf, _Result) else leaf for leaf in leaves])

    return run
