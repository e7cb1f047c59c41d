"""Reading saved solutions.

Public name: `load`.
"""

from __future__ import annotations

import os

from .solution import Solution


def load(path: str | os.PathLike[str]) -> Solution:
    """The solution that `Solution.save` wrote to `path`, its scene included.

    **Raises** `FileNotFoundError`; `ValueError` for a file that is damaged, of another kind, or of a newer version.
    """
    from .io.archive import load_solution

    return load_solution(path)
