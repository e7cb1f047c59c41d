"""Loops as machine code that is kept on disk: compiled by numba once, then loaded without it.

numba takes 0.8 s of every process to import and to get ready; what it has compiled needs a few milliseconds of llvmlite. A loop
is found by what it is made from: the sources of this folder and what they take from elsewhere, the versions of numba, LLVM and
numpy, the processor, and the types of its arguments.

It is called by numba's own convention: pointers to the result and to an exception, of which there is none here, and then all
arguments, tuples and arrays taken apart. An array of n dimensions is two pointers that are not used, its number of elements and
their size, a pointer to the first, n lengths and n strides.

As those of programs (`program_files`), the files are code: they lie beside the sources, or in a folder that is the user's own.

What a solve will need can be compiled ahead, by processes of their own: one compiles a single loop at a time.

Public: `Loop`, `get_ready`, `compile_aside`, `form_of`.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import hashlib
import importlib
import os
import pickle
import platform
import subprocess
import sys
import threading
import zlib
from collections.abc import Callable, Hashable, Iterable, Iterator
from importlib.metadata import version
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from jaxtyping import AbstractArray, Float, Shaped

from ...program_files import is_own, user_cache, write_whole
from ...threads import count_cores

try:
    import fcntl
except ImportError:  # Windows, where each process compiles
    fcntl = None

_HERE = Path(__file__).parent
_SOURCES = *sorted(_HERE.glob("*.py")), _HERE.parent / "reading.py", _HERE.parent / "slopes.py"
_C = {"ptr": ctypes.c_void_p, "i64": ctypes.c_int64, "i32": ctypes.c_uint32, "i8": ctypes.c_uint8}
_C |= {"double": ctypes.c_double, "float": ctypes.c_float}
_SCALARS: dict[type, str] = {bool: "i8", int: "i64", float: "double", np.int64: "i64", np.float64: "double", np.uint32: "i32"}


class Loop:
    """The function `name` of a module of this folder. Arrays that it takes lie in memory as C has them; it returns a number or
    nothing, and other threads of Python go on meanwhile.

    `takes` are the types of its arguments; `carried` what rays carry (see `arguments`), the fields' own type if None.
    """

    def __init__(self, module: str, name: str, *takes: Any, carried: np.dtype | None = None):
        self.name = name
        self._module = module
        self._takes = takes
        self._carried = carried
        self._ready: dict[Hashable, Callable[[list], int]] = {}
        self._lock = threading.Lock()

    def __call__(self, *arguments: Any) -> int:
        numbers: list[Any] = []
        form = tuple(_take_apart(argument, numbers) for argument in arguments)
        run = self._ready.get(form)
        if run is None:
            with self._lock:
                run = self._ready.get(form) or self._find(form, arguments)
                self._ready[form] = run
        return run(numbers)

    def file(self, *arguments: Any) -> Path:
        """Where the loop is kept for such arguments."""
        return _folder() / f"{self.name}-{_circumstances()}-{_digest(repr(form_of(arguments)))}.loop"

    def examples(self, real: np.dtype) -> tuple:
        """Arguments of its types for fields of the type `real`, with nothing in them."""
        return tuple(_example(kind, real, self._carried or real) for kind in self._takes)

    def compile_ahead(self, real: np.dtype) -> None:
        """Have it kept for such fields, unless somebody else is about to."""
        arguments = self.examples(real)
        file = self.file(*arguments)
        with _alone(file, wait=False) as alone:
            if alone and _read(file) is None:
                self._make(file, form_of(arguments), arguments)

    def _find(self, form: Hashable, arguments: tuple) -> Callable[[list], int]:
        file = self.file(*arguments)
        found = _read(file)
        if found is None:
            with _alone(file):
                found = _read(file) or self._make(file, form, arguments)
        return _loaded(*found)

    def _make(self, file: Path, form: Any, arguments: tuple) -> tuple[str, list[str], bytes]:
        made = self._compiled(form, arguments)
        with contextlib.suppress(OSError):  # a full disk: the next process compiles as well
            write_whole(file, zlib.compress(pickle.dumps(made), 1))
        return made

    def _compiled(self, form: Any, arguments: tuple) -> tuple[str, list[str], bytes]:
        """Its name in the machine code, the types of what it takes, and the code."""
        from .compiling import compile_loop

        function = getattr(importlib.import_module(f".{self._module}", __package__), self.name)
        return compile_loop(function, arguments, [kind for part in form for kind in _kinds(part)])


def get_ready() -> None:
    """Have at hand what loops need: llvmlite; where nothing is kept yet, numba, tried with a small loop.

    **Raises** `ImportError` or `RuntimeError` where they cannot be used.
    """
    importlib.import_module("llvmlite.binding")
    if not any(_folder().glob(f"*-{_circumstances()}-*.loop")):
        Loop("vacuum", "tally")(np.zeros(1, np.int32), np.zeros(1, np.int32))


def compile_aside(real: np.dtype, *groups: Iterable[Loop]) -> None:
    """Have the loops of each group compiled, one after the other, by a process of its own, and go on meanwhile.

    What is needed before it is ready is waited for. Such a process may live on for a minute after this one. None is begun on a
    single core, where nothing can be kept or locked, and where this is a program that only holds a Python.
    """
    is_python = Path(sys.executable or "").name.lower().startswith("python") and not getattr(sys, "frozen", False)
    if count_cores() < 2 or fcntl is None or not is_python or not (os.access(_folder(), os.W_OK) and _is_trusted(_folder())):
        return
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    for group in groups:
        missing = [loop.name for loop in group if not loop.file(*loop.examples(real)).exists()]
        code = f"import sys; sys.path[:] = {sys.path}; from {__name__} import _compile; _compile({real.str!r}, {missing})"
        if missing:
            with contextlib.suppress(OSError):
                process = subprocess.Popen([sys.executable, "-c", code], **quiet)
                threading.Thread(target=process.wait, daemon=True).start()  # so that nothing is left of it in the end


def _compile(real: str, names: list[str]) -> None:
    loops = sys.modules[__name__.rpartition(".")[0]]
    for name in names:
        getattr(loops, name).compile_ahead(np.dtype(real))


def _example(kind: Any, real: np.dtype, carried: np.dtype) -> Any:
    if get_origin(kind) is tuple:
        return tuple(_example(part, real, carried) for part in get_args(kind))
    if hasattr(kind, "_fields"):
        return kind(*(_example(part, real, carried) for part in get_type_hints(kind).values()))
    if issubclass(kind, AbstractArray):
        own = real if kind.dtype is Float else carried if kind.dtype is Shaped else np.dtype(kind.dtypes[0])
        return np.zeros((0,) * len(kind.dims), own)
    return kind(0)


def form_of(arguments: tuple) -> tuple:
    """The types of arguments, by which a loop is found."""
    return tuple(_take_apart(argument, []) for argument in arguments)


def _take_apart(value: Any, numbers: list[Any]) -> Any:
    """Append what is handed over of an argument to `numbers`, and return its type."""
    if isinstance(value, tuple):
        return (type(value).__name__, *[_take_apart(part, numbers) for part in value])
    if isinstance(value, np.ndarray):
        if not value.flags.c_contiguous:
            raise ValueError("machine code: got an array with gaps, expected one as C has it; use numpy.ascontiguousarray")
        address = value.__array_interface__["data"][0]
        numbers += (None, None, value.size, value.itemsize, address, *value.shape, *value.strides)
        return value.dtype.str, value.ndim
    numbers.append(value.item() if isinstance(value, np.generic) else value)
    return _SCALARS[type(value)]


def _kinds(form: Any) -> Iterator[str]:
    """What numba makes of a type, as LLVM calls it."""
    if isinstance(form, str):
        yield form
    elif isinstance(form[-1], int):
        yield from ("ptr", "ptr", "i64", "i64", "ptr", *["i64"] * (2 * form[-1]))
    else:
        for part in form[1:]:
            yield from _kinds(part)


def _digest(*made_from: str | bytes) -> str:
    digest = hashlib.sha256()
    for part in made_from:
        digest.update(part.encode() if isinstance(part, str) else part)
    return digest.hexdigest()[:20]


@functools.cache
def _circumstances() -> str:
    """A digest of what all loops depend on."""
    import llvmlite.binding as llvm

    versions = [platform.python_version(), *map(version, ("numba", "llvmlite", "numpy"))]
    processor = llvm.get_host_cpu_name(), llvm.get_host_cpu_features().flatten(), llvm.get_process_triple()
    return _digest(repr((versions, processor)), *(source.read_bytes() for source in _SOURCES))


@functools.cache
def _folder() -> Path:
    """Beside the sources where that can be written to, else in the user's cache directory."""
    beside = _HERE / "__pycache__"
    with contextlib.suppress(OSError):
        beside.mkdir(exist_ok=True)
        if os.access(beside, os.W_OK):
            return beside
    own = user_cache(os.environ) / "loops"
    with contextlib.suppress(OSError):
        own.mkdir(mode=0o700, parents=True, exist_ok=True)
    return own


def _read(file: Path) -> tuple[str, list[str], bytes] | None:
    """What is kept in a file; None if there is nothing that can be trusted, or used."""
    try:
        if not _is_trusted(file.parent):
            return None
        return pickle.loads(zlib.decompress(file.read_bytes()))  # with a checksum
    except (OSError, zlib.error):
        return None


def _is_trusted(folder: Path) -> bool:
    return folder == _HERE / "__pycache__" or is_own(folder)


def _loaded(name: str, kinds: list[str], code: bytes) -> Callable[[list], int]:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    host, features = llvm.Target.from_default_triple(), llvm.get_host_cpu_features().flatten()
    # One for each engine, which owns it.
    machine = host.create_target_machine(cpu=llvm.get_host_cpu_name(), features=features, jit=True)
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), machine)
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    pointer = ctypes.POINTER(ctypes.c_int64)
    types = ctypes.CFUNCTYPE(ctypes.c_int32, pointer, pointer, *(_C[kind] for kind in kinds))
    function = types(engine.get_function_address(name))

    def run(numbers: list) -> int:
        result, problem = ctypes.c_int64(), ctypes.c_int64()
        if function(result, problem, *numbers) not in (0, -2):  # numba's codes for a result, and for none
            raise RuntimeError(f"{name}: got an error in machine code, expected none; please report the scene")
        return result.value

    run.engine = engine  # pyright: ignore[reportFunctionMemberAccess]  # it owns the code
    return run


@contextlib.contextmanager
def _alone(file: Path, wait: bool = True) -> Iterator[bool]:
    """Hold a file's lock, which the system takes back from processes that die; none where files cannot be written or locked.

    Processes that start at once would each compile the same loops: so one of them does, and the others take what it has made.
    False where another has it and this one does not `wait`.
    """
    with contextlib.ExitStack() as held:
        alone = True
        with contextlib.suppress(OSError):
            lock = held.enter_context(file.with_suffix(".lock").open("a"))
            if fcntl is not None:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
                except BlockingIOError:
                    alone = False
        yield alone
