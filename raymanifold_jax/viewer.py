"""A solution to turn about in a notebook, by k3d (extra `plot`).

Public name: `view_solution`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from .io.png import to_srgb8
from .solution import Solution

_BRIGHT = 0.8  # what the 99th percentile of radiosities is shown as
_CORNERS = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])


def view_solution(solution: Solution, height: int = 512) -> Any:
    """A `k3d.Plot`: every surface element as a square of its radiosity, seen from its lit side, and the fog's fluence.

    `height` in pixels. One or three bands have their colours, others the mean of all. `plot.get_snapshot()` is a web page.

    **Raises** `ImportError` without k3d.
    """
    try:
        import k3d
    except ImportError as error:
        raise ImportError("view needs k3d; pip install 'raymanifold-jax[plot]'") from error
    look: dict[str, Any] = {"lighting": 0, "background_color": 0x202020, "camera_up_axis": "z", "grid_visible": False}
    plot = k3d.plot(height=height, **look)  # pyright: ignore[reportCallIssue]
    table = solution.surfaces
    if len(table.areas):
        vertices, triangles = _squares(*(np.asarray(a, float) for a in (table.positions, table.normals, table.areas)))
        colors = np.repeat(_packed(np.asarray(table.radiosity, float)), 4).tolist()
        plot += k3d.mesh(vertices, triangles, colors=colors, side="front", name="radiosity")
    if solution.scene.medium is not None:
        lattice = solution.scene.lattice
        fluence = np.asarray(solution.diffuse_fluence + solution.sun_fluence, np.float32).mean(0)
        bounds = np.stack([lattice.lower, lattice.upper], 1).ravel()
        top = float(np.percentile(fluence, 99)) or 1.0
        volume = k3d.volume(
            fluence.transpose(2, 1, 0), color_range=[0.0, top], alpha_coef=4, bounds=bounds, name="fluence, W/m2"
        )
        plot += volume
    return plot


def _squares(positions: np.ndarray, normals: np.ndarray, areas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (4 E, 3) and triangles (2 E, 3) of squares around elements, anticlockwise seen from where the normals point."""
    axis = np.eye(3)[np.abs(normals).argmin(1)]
    first = np.cross(normals, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([first, np.cross(normals, first)], 1) * np.sqrt(areas)[:, None, None]
    vertices = positions[:, None] + np.einsum("ci,eid->ecd", _CORNERS, frame)
    triangles = 4 * np.arange(len(areas))[:, None, None] + np.array([(0, 1, 2), (0, 2, 3)])
    return vertices.reshape(-1, 3).astype(np.float32), triangles.reshape(-1, 3).astype(np.uint32)


def _packed(radiosity: np.ndarray) -> np.ndarray:
    """0xRRGGBB for each element."""
    values = radiosity.reshape(len(radiosity), -1)
    values = values if values.shape[1] == 3 else np.repeat(values.mean(1, keepdims=True), 3, axis=1)
    bright = float(np.percentile(values, 99)) or 1.0
    red, green, blue = to_srgb8((values * _BRIGHT / bright)[None])[0].astype(np.uint32).T
    return red << 16 | green << 8 | blue
