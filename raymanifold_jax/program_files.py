"""Where compiled programs are kept, and how they come from there: `programs` says which ones.

Nothing heavier than JAX is imported here, so that a command can have its programs loaded while it still imports the rest.

Like those in JAX's cache, the files are code: they are only kept in a folder that is the user's own.

For this package: `keep_in`, `folder`, `serialized`; `digest`; `user_cache`, `is_own` and `write_whole` for other files of code.
"""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import platform
import secrets
import stat
import zlib
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path

import jax
from jax.experimental import serialize_executable

#: The packages that programs depend on.
VERSIONED = ("jax", "jaxlib", "equinox", "numpy")
_FAST = 1  # of zlib's levels
_MOST_LISTED = 300  # programs of a task: more than one start uses

_folder: Folder | None = None


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
            _folder = Folder(path, task) if is_own(path) else None
        except OSError:  # then JAX has no cache there either
            return


def folder() -> Folder | None:
    """The one that `keep_in` chose."""
    return _folder


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


def digest(made_from: bytes) -> str:
    """Of what a program is made from, and of what all of them depend on."""
    return hashlib.sha256(_circumstances() + made_from).hexdigest()


@functools.cache
def _circumstances() -> bytes:
    """A digest of what all programs depend on."""
    versions = [platform.python_version(), *map(version, VERSIONED)]
    settings = sorted(item for item in os.environ.items() if item[0].startswith(("JAX_", "XLA_")))
    found = hashlib.sha256(repr((versions, settings, _processor(), os.cpu_count())).encode())
    package = Path(__file__).parent
    for source in sorted(package.rglob("*.py")):
        found.update(repr(source.relative_to(package)).encode() + source.read_bytes())
    return found.digest()


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


def serialized(compiled: jax.stages.Compiled, arguments: int, arrays: int, results: bytes) -> bytes:
    """A program as `Folder.load` reads it: how many arrays it takes and gives, and the form of its results."""
    whole = arguments, arrays, results, serialize_executable.serialize(compiled)[0]
    return zlib.compress(pickle.dumps(whole), _FAST)


class Folder:
    """Files of programs. A list tells which ones a task uses, in the order of their first use: a thread loads them ahead."""

    def __init__(self, path: Path, task: str):
        self.path = path
        self._list = path / f"task-{digest(task.encode())}"
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


def write_whole(file: Path, content: bytes) -> None:
    """Under a temporary name first, so that a file is whole or is not there."""
    temporary = file.with_name(f".{secrets.token_hex(8)}")
    try:
        temporary.write_bytes(content)
        os.replace(temporary, file)
    finally:
        temporary.unlink(missing_ok=True)
