"""How the loops are compiled: as entries, which Python calls, and as what these are made of.

numba keeps entries on disk. But processes that start at once would each compile the same ones, and could mix up what they
write there: so one of them compiles, and the others wait and take what it has made.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
from numba.extending import register_jitable

try:
    import fcntl
except ImportError:  # Windows, where each process compiles
    fcntl = None

# Without numba's reference counts, which would take longer than the work: what is allocated comes from outside.
_OPTIONS: Any = dict(fastmath={"contract", "nsz"}, error_model="numpy", _nrt=False, no_cfunc_wrapper=True)

# Called by entries only. Numba would compile a way in from Python for each, which takes apart all the tuples.
# Not `inlined`, as they otherwise would be where they are called by what is.
compiled: Any = numba.njit(no_cpython_wrapper=True, forceinline=False, **_OPTIONS)  # pyright: ignore[reportCallIssue]

# Where LLVM would leave a function of its own, loops around it would not be vectorised, and what it takes would go through the
# stack in every call: for tuples of arrays that is hundreds of numbers.
inlined: Any = register_jitable(forceinline=True)


def entry(function: Callable) -> Any:
    program: Any = numba.njit(nogil=True, cache=True, **_OPTIONS)(function)
    look_up_or_compile = program.compile

    def compile_alone(signature):
        with _alone(lock_of(program)):
            return look_up_or_compile(signature)

    program.compile = compile_alone
    return program


def lock_of(program: Any) -> Path:
    return Path(program.stats.cache_path) / f"{program.__name__}.lock"


@contextlib.contextmanager
def _alone(path: Path) -> Iterator[None]:
    """Hold a lock, which the system takes back from processes that die; none where files cannot be written or locked."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            file = held.enter_context(path.open("a"))
            if fcntl is not None:
                fcntl.flock(file, fcntl.LOCK_EX)
        yield
