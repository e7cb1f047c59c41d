"""Pictures of a solution.

A pixel is the mean radiance along the camera's rays through it: Q = sum over samples of L / samples.

Public names: `render`, `render_layers`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import checks
from .camera import AbstractCamera, PerspectiveCamera
from .gather import LightField, check_outside, light_field, radiance_along, surface_light
from .solution import Solution
from .trace import trace_rays
from .unfolding import in_blocks

_RAYS = 1 << 18  # at once


def render(
    solution: Solution, camera: AbstractCamera, samples: int = 4, progress: Callable[[float], object] | None = None
) -> Float[np.ndarray, "height width *bands"]:
    """The picture of a solution that `camera` takes: radiance in W m^-2 sr^-1, float32, row 0 as the camera says.

    Where JAX differentiates the solution, the picture is a JAX array of its dtype.

    `samples` rays a pixel, a square number: 1 is quick, 4 has smooth edges, 16 is fine. `progress`, if given, is called
    with the share that is done, in (0, 1], from time to time.

    **Raises** `ValueError` if the eye (of a parallel projection: the picture's centre) is inside a solid or `samples` is no
    square, `TypeError` for anything that is not a solution or a camera.
    """
    _check(solution, camera)
    width, height = camera.resolution
    field, bands = light_field(solution), solution.scene.bands
    traced, parts = checks.is_traced(solution), []
    rows = max(1, _RAYS // (width * samples))
    for start in range(0, height, rows):
        stop = min(start + rows, height)
        origins, directions = camera.rays(samples, (start, stop))
        seen = in_blocks(radiance_along, field, (origins.reshape(-1, 3), directions.reshape(-1, 3)))
        shape = (stop - start, width, samples, bands)
        parts.append(seen.reshape(shape).mean(2) if traced else np.asarray(seen).reshape(shape).mean(2).astype(np.float32))
        if progress is not None:
            progress(stop / height)
    picture: Any = jnp.concatenate(parts) if traced else np.concatenate(parts)
    return picture if solution.scene.banded else picture[..., 0]


def render_layers(solution: Solution, camera: AbstractCamera) -> dict[str, Float[np.ndarray, "height width *channels"]]:
    """What `camera` sees through the middle of each pixel, behind the fog, for compositing and for fits: by name

    - "depth": along the ray from the eye (of a parallel projection: from its plane), in scene units; (height, width);
    - "normal": of the surface, towards the light; (height, width, 3);
    - "albedo", "irradiance": of the surface; (height, width[, bands]); float32 all of them.

    All are 0 where a ray meets no surface. **Raises** as `render` does, and `TypeError` under JAX's transformations.
    """
    _check(solution, camera)
    if checks.is_traced(solution):
        checks.fail("solution", "one that JAX traces", "known values", "layers have no derivatives; use render", TypeError)
    width, height = camera.resolution
    field, scene = light_field(solution), solution.scene
    parts = []
    rows = max(1, _RAYS // width)
    for start in range(0, height, rows):
        origins, directions = (np.asarray(a).reshape(-1, 3) for a in camera.rays(1, (start, min(start + rows, height))))
        parts.append([np.asarray(part) for part in in_blocks(_layers, field, (origins, directions))])
    depth, normal, albedo, arriving = (
        np.concatenate(p).reshape(height, width, -1).astype(np.float32) for p in zip(*parts, strict=True)
    )
    banded = (lambda a: a) if scene.banded else (lambda a: a[..., 0])
    return {"depth": depth[..., 0], "normal": normal, "albedo": banded(albedo), "irradiance": banded(arriving)}


def _layers(field: LightField, origins: Array, directions: Array) -> tuple[Array, Array, Array, Array]:
    hit = trace_rays(field.scene, origins, directions)
    arriving, albedo = surface_light(field, hit)
    there = hit.material >= 0
    return jnp.where(there, hit.distance, 0.0), jnp.where(there[:, None], hit.normal, 0.0), albedo, arriving


def _check(solution: Solution, camera: AbstractCamera) -> None:
    checks.instance("solution", solution, Solution, "pass what rm.solve(scene) returns")
    checks.instance("camera", camera, AbstractCamera, "pass rm.PerspectiveCamera(...) or rm.OrthographicCamera(...)")
    eye = camera.position if isinstance(camera, PerspectiveCamera) else getattr(camera, "center", None)
    if eye is not None:
        check_outside(solution.scene, "camera", np.asarray([eye]))
