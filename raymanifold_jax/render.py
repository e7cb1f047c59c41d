"""Pictures of a solution.

A pixel is the mean radiance along the camera's rays through it: Q = sum over samples of L / samples.

Public name: `render`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from . import checks
from .camera import AbstractCamera, PerspectiveCamera
from .gather import check_outside, light_field, radiance_along
from .solution import Solution
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
    checks.instance("solution", solution, Solution, "pass what rm.solve(scene) returns")
    checks.instance("camera", camera, AbstractCamera, "pass rm.PerspectiveCamera(...) or rm.OrthographicCamera(...)")
    width, height = camera.resolution
    eye = camera.position if isinstance(camera, PerspectiveCamera) else getattr(camera, "center", None)
    if eye is not None:
        check_outside(solution.scene, "camera", np.asarray([eye]))
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
