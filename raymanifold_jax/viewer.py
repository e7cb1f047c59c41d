"""A solution to turn about in a notebook, by k3d (extra `plot`).

Public names: `view_solution`; `outlines` and `polygons` for this package.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from .io.png import to_srgb8
from .mesh_elements import clipped
from .solution import Solution
from .spectra import Bands

_BRIGHT = 0.8  # what the 99th percentile of radiosities is shown as
_OPACITY = 1.0  # k3d's factor on the fog's; the solids in it still show
_CLOSE = 0.95  # of the distance where a ball around the lattice would fill the view
_MARGIN = 2e-3  # voxels: the plane of a wall's element lies in a face of its voxel
_CORNERS = np.array([(-2.0, -2.0), (2.0, -2.0), (2.0, 2.0), (-2.0, 2.0)])  # voxels: beyond every corner of an element's own


def view_solution(solution: Solution, height: int = 512, bands: Bands | None = None, white: Any = None) -> Any:
    """A `k3d.Plot`: every surface element in the colour of its radiosity, seen from its lit side, and the fog's fluence.

    `height` in pixels. One or three bands have their colours; others are shown as `bands.to_rgb(radiosity, white)`, or without
    `bands` by the grey of their mean. `plot.get_snapshot()` is a web page.

    **Raises** `ImportError` without k3d; `ValueError` for `bands` that are not as many as the scene's.
    """
    try:
        import k3d
    except ImportError as error:
        raise ImportError("view needs k3d; pip install 'raymanifold-jax[plot]'") from error
    lattice, radiosity = solution.scene.lattice, np.asarray(solution.surfaces.radiosity, float)
    seen = radiosity if bands is None else bands.to_rgb(radiosity, white)
    look: dict[str, Any] = {"lighting": 0, "background_color": 0x202020, "camera_up_axis": "z", "grid_visible": False}
    plot = k3d.plot(height=height, camera_auto_fit=False, **look)  # pyright: ignore[reportCallIssue]
    bounds = np.stack([lattice.lower, lattice.upper], 1).ravel()
    # From -y, a little from the right and from above; k3d counts the pitch from the zenith.
    plot.camera = plot.get_auto_camera(_CLOSE, yaw=-80, pitch=72, bounds=bounds)
    if len(radiosity):
        corners, triangles, owner = outlines(solution)
        vertices = corners.astype(np.float32)
        plot += k3d.mesh(vertices, triangles, colors=_packed(seen)[owner].tolist(), side="front", name="radiosity")
    if solution.scene.medium is not None:
        fluence = np.asarray(solution.diffuse_fluence + solution.sun_fluence, np.float32).mean(0)
        top = float(np.percentile(fluence, 99)) or 1.0
        plot += k3d.volume(
            fluence.transpose(2, 1, 0), color_range=[0.0, top], alpha_coef=_OPACITY, bounds=bounds, name="fluence, W/m2"
        )
    return plot


def outlines(solution: Solution) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """`polygons` of the rows of `solution.surfaces`, in scene units."""
    lattice, elements = solution.scene.lattice, solution.elements
    # What solids cover of a side lies within them: there its elements need not be cut to leave no slits at their feet.
    area = np.where(elements.side < 0, elements.area / lattice.spacing**2, np.inf)
    shown = elements.voxel, elements.normal, area, (elements.position - lattice.lower) / lattice.spacing
    corners, triangles, owner = polygons(*(values[~elements.open] for values in shown))
    return lattice.lower + corners * lattice.spacing, triangles, owner


def polygons(
    voxel: np.ndarray, normal: np.ndarray, area: np.ndarray, position: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), triangles (T, 3) and each vertex's element: the part of the element's plane that lies in its voxel and
    beside the other elements there, scaled to its area if that is finite. All in voxels; anticlockwise seen from where the
    normals point."""
    axis = np.eye(3)[np.abs(normal).argmin(1)]
    first = np.cross(normal, axis)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    frame = np.stack([first, np.cross(normal, first)], 1)
    polygon = position[:, None] + np.einsum("ci,eid->ecd", _CORNERS, frame)
    count = np.full(len(area), len(_CORNERS))
    for i in range(3):
        polygon, count = clipped(polygon, count, polygon[..., i] - (voxel[:, i, None] - _MARGIN))
        polygon, count = clipped(polygon, count, (voxel[:, i, None] + 1 + _MARGIN) - polygon[..., i])
    for own, other in _neighbours(voxel):  # edges of solids: each keeps the side of the other's plane that its middle is on
        height = np.einsum("evd,ed->ev", polygon[own] - position[other][:, None], normal[other])
        side = np.sign(np.einsum("ed,ed->e", position[own] - position[other], normal[other]))
        scaled = np.ones(polygon.shape[:2])
        scaled[own] = height * side[:, None]
        polygon, count = clipped(polygon, count, scaled)
    number = np.arange(polygon.shape[1])
    fan = np.cross(polygon[:, 1:-1] - polygon[:, :1], polygon[:, 2:] - polygon[:, :1])
    inside = number[2:] < count[:, None]
    whole = np.maximum(np.einsum("evd,ed,ev->e", fan, normal, inside) / 2, 1e-12)
    scale = np.sqrt(np.where(np.isfinite(area), area / whole, 1.0))
    polygon = position[:, None] + scale[:, None, None] * (polygon - position[:, None])
    start = np.cumsum(count) - count
    valid = number < count[:, None]
    triangles = (start[:, None] + number[1:-1])[inside][:, None] + np.array([0, 0, 1])
    triangles[:, 0] = np.repeat(start, count - 2)
    return polygon[valid], triangles.astype(np.uint32), np.repeat(np.arange(len(area)), count)


def _neighbours(voxel: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Elements and another element in the voxel of each, until every two have met."""
    order = np.lexsort(voxel.T)
    for step in range(1, len(order)):
        same = (voxel[order[step:]] == voxel[order[:-step]]).all(1)
        if not same.any():
            return
        low, high = order[:-step][same], order[step:][same]
        yield low, high
        yield high, low


def _packed(radiosity: np.ndarray) -> np.ndarray:
    """0xRRGGBB for each element."""
    values = radiosity.reshape(len(radiosity), -1)
    values = values if values.shape[1] == 3 else np.repeat(values.mean(1, keepdims=True), 3, axis=1)
    bright = float(np.percentile(values, 99)) or 1.0
    red, green, blue = to_srgb8((values * _BRIGHT / bright)[None])[0].astype(np.uint32).T
    return red << 16 | green << 8 | blue
