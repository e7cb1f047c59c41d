"""How the loops are compiled, by numba: what they are made of, and each as a whole.

Imported when there is something to compile; else see `kept`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.extending import register_jitable

# Without numba's reference counts, which would take longer than the work: what is allocated comes from outside. Without ways in
# from Python or C, which take apart all the tuples and take longest to compile.
_OPTIONS: Any = dict(
    fastmath={"contract", "nsz"}, error_model="numpy", _nrt=False, no_cpython_wrapper=True, no_cfunc_wrapper=True
)

# Not `inlined`, as they otherwise would be where they are called by what is.
compiled: Any = numba.njit(forceinline=False, **_OPTIONS)  # pyright: ignore[reportCallIssue]

# Where LLVM would leave a function of its own, loops around it would not be vectorised, and what it takes would go through the
# stack in every call: for tuples of arrays that is hundreds of numbers.
inlined: Any = register_jitable(forceinline=True)


def compile_loop(function: Callable, arguments: tuple, kinds: list[str]) -> tuple[str, list[str], bytes]:
    """The name of `function` in its machine code for such arguments, the types of what it takes there, and the code.

    **Raises** `RuntimeError` if numba would have other than these `kinds` of arguments handed over, or does not tell.
    """
    program: Any = numba.njit(**_OPTIONS)(function)
    signature = tuple(map(_type_of, arguments))
    program.compile(signature)
    try:
        library, name = program.overloads[signature].library, program.overloads[signature].fndesc.llvm_func_name
        code = library.serialize_using_object_code()[2][0]
        found = [_kind_of(str(argument.type)) for argument in library._final_module.get_function(name).arguments]
    except AttributeError as problem:
        raise RuntimeError(f"numba {numba.__version__}: {problem}; use another version") from problem
    if found[2:] != kinds:
        got, expected = " ".join(found[2:]), " ".join(kinds)
        raise RuntimeError(f"numba {numba.__version__}: got arguments {got}, expected {expected}; use another version")
    return name, kinds, code


def _kind_of(type_of_llvm: str) -> str:
    return "ptr" if type_of_llvm.endswith("*") else type_of_llvm


def _type_of(value: Any) -> Any:
    """numba's type, the same for arrays that can and cannot be written to."""
    if isinstance(value, np.ndarray):
        return types.Array(numba.from_dtype(value.dtype), value.ndim, "C")
    if isinstance(value, tuple):
        parts = tuple(map(_type_of, value))
        kind = type(value) if hasattr(value, "_fields") else None
        return types.BaseTuple.from_types(parts, kind)
    return numba.typeof(value)
