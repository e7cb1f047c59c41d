"""Checkpoints: the state of an iteration on disk, from which it goes on to the same result.

A state is the arriving light so far, the residual, what Kahan's sum lost, and the history; the right-hand side is worked out
anew, and its bits must be those of the checkpoint's (a fingerprint of them is kept). Jacobi saves after a sweep, Krylov after a
restart; a run that goes on from there makes the same sweeps as one that was never stopped.

Public names: `Checkpoint`.
"""

from __future__ import annotations

import hashlib
import os
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from . import checks


class Checkpoint:
    """Where a solve keeps its state.

    **Arguments:** `path`: the file. `every`: seconds between two savings, >= 0. `resume`: go on from the file if it is there.

    **Raises** `ValueError` for a negative interval; with `resume`, when the solve starts, also for a file that is damaged or
    of another solve.
    """

    def __init__(self, path: str | os.PathLike[str], every: float = 60.0, resume: bool = False):
        self.path = Path(path)
        self.every = float(checks.non_negative("every", every, ()))
        self.resume = resume
        self._last = time.monotonic()
        self._fingerprint = ""

    def restore(self, problem: Any, state: Any) -> Any | None:
        """The saved state, in the form of `state`; None to start from the beginning. `problem`: what must not have changed."""
        digest = hashlib.sha256()
        for leaf in jax.tree.leaves(problem):
            values = np.asarray(leaf)
            digest.update(f"{values.dtype} {values.shape} ".encode() + np.ascontiguousarray(values).tobytes())
        self._fingerprint = digest.hexdigest()
        if not (self.resume and self.path.exists()):
            return None
        from .io.archive import read_archive

        manifest, arrays = read_archive(self.path, "checkpoint")
        if manifest.get("fingerprint") != self._fingerprint:
            got = f"{str(self.path)!r}, which belongs to another solve"
            checks.fail("checkpoint", got, "the same scene, directions and options", "start afresh without resume")
        leaves, form = jax.tree.flatten(state)
        return jax.tree.unflatten(form, [arrays[f"s{i}"] for i in range(len(leaves))])

    def keep(self, state: Any, at_once: bool = False) -> None:
        """Save the state, if the interval is over."""
        if not at_once and time.monotonic() - self._last < self.every:
            return
        from .io.archive import write_archive

        arrays = {f"s{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state))}
        write_archive(self.path, "checkpoint", {"fingerprint": self._fingerprint}, arrays)
        self._last = time.monotonic()
