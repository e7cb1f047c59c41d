"""A solution at a glance: the fluence in three planes, the light on surfaces, and the convergence (extra `plot`).

Public name: `plot_solution`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from . import checks
from .solution import Solution
from .viewer import outlines

_EDGE_ON = 0.02  # cosine with the line of sight: surfaces further from it do not show


def plot_solution(solution: Solution, at: Any = None) -> Any:
    """A matplotlib figure of six parts: fluence in the planes x, y and z through `at` (the box's middle if None), irradiance on
    the surfaces seen from above and from the side, and residuals against the target.

    Values are means over the bands, in W m^-2. **Raises** `ImportError` without matplotlib; `ValueError` for a point outside
    the lattice.
    """
    try:
        from matplotlib.collections import PolyCollection
        from matplotlib.figure import Figure

        if not isinstance(Figure, type):  # a stand-in that colour-science leaves where there is no matplotlib
            raise ImportError("no matplotlib")
    except ImportError as error:
        raise ImportError("plot needs matplotlib; pip install 'raymanifold-jax[plot]'") from error
    lattice = solution.scene.lattice
    lower, upper = lattice.lower, lattice.upper
    point = (lower + upper) / 2 if at is None else np.asarray(checks.vector3("at", at))
    if not bool(lattice.contains(point)):
        expected = f"a point of the lattice, {lower.tolist()} to {upper.tolist()}"
        checks.fail("at", point.tolist(), expected, "leave it out for the middle")
    index = np.minimum(((point - lower) / lattice.spacing).astype(int), np.array(lattice.shape) - 1)
    fluence = np.asarray(solution.diffuse_fluence + solution.sun_fluence, float).mean(0)
    fluence = np.where(np.asarray(solution.free) > 0, fluence, np.nan)
    figure = Figure(figsize=(12, 7.5), layout="constrained")
    axes = figure.subplots(2, 3)
    largest = float(np.nanmax(fluence, initial=0.0))
    for axis in range(3):
        u, v = (a for a in range(3) if a != axis)
        picture = axes[0, axis].imshow(
            fluence.take(index[axis], axis).T,
            origin="lower",
            extent=(lower[u], upper[u], lower[v], upper[v]),
            vmin=0,
            vmax=largest,
        )
        _label(axes[0, axis], f"fluence at {'xyz'[axis]} = {point[axis]:.3g}, W m$^{{-2}}$", u, v)
    figure.colorbar(picture, ax=axes[0], shrink=0.8)
    table = solution.surfaces
    irradiance = np.asarray(table.irradiance, float).reshape(len(table.areas), -1).mean(1)
    corners, _, owner = outlines(solution)
    pieces = np.split(corners, np.flatnonzero(np.diff(owner)) + 1) if len(owner) else []
    most = float(irradiance.max(initial=0.0))
    # Seen along -z and along +y: elements that face the eye, the nearest drawn last.
    for part, (u, v), axis, towards, seen in zip(axes[1], ((0, 1), (0, 2)), (2, 1), (1, -1), ("above", "-y"), strict=False):
        facing = np.flatnonzero(towards * np.asarray(table.normals)[:, axis] > _EDGE_ON)
        order = facing[np.argsort(towards * np.asarray(table.positions)[facing, axis], kind="stable")]
        picture = PolyCollection(
            [pieces[i][:, (u, v)] for i in order], array=irradiance[order], edgecolors="face", linewidths=0.2
        )
        picture.set_clim(0, most)
        part.add_collection(picture)
        part.set(xlim=(lower[u], upper[u]), ylim=(lower[v], upper[v]), aspect="equal")
        _label(part, f"irradiance from {seen}, W m$^{{-2}}$", u, v)
    figure.colorbar(picture, ax=axes[1, :2], shrink=0.8)
    _convergence(axes[1, 2], solution)
    figure.suptitle(solution.result)
    return figure


def _label(part: Any, title: str, u: int, v: int) -> None:
    part.set(title=title, xlabel="xyz"[u], ylabel="xyz"[v])


def _convergence(part: Any, solution: Solution) -> None:
    history = np.maximum(np.asarray(solution.history, float), np.finfo(float).tiny)
    part.semilogy(np.arange(1, len(history) + 1), history, "o-", ms=3, label="largest residual")
    part.axhline(max(solution.target, 1e-300), ls="--", color="0.4", label="target of the bound")
    if math.isfinite(solution.error_bound) and solution.error_bound > 0:
        part.axhline(solution.error_bound, ls=":", color="C1", label="certified bound")
    part.set(title="convergence, W m$^{-2}$", xlabel="iteration")
    part.legend()
