"""What a fit looks at: pictures and measured readings.

A target says what the solution of a scene should show, with a weight for each value: residuals are

    r = sqrt(weight) (predicted - measured),

so weights of 1 / sigma^2 make residuals multiples of the noise. Values where a mask is False, or of weight 0, do not count.

Public: `Target`, `PictureTarget`, `IrradianceTarget`, `FluenceTarget`.
"""

from __future__ import annotations

import abc
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from . import checks
from .camera import AbstractCamera
from .gather import fluence, irradiance
from .render import render
from .scene import Scene
from .solution import Solution


class Target(eqx.Module):
    """Measured values, and how a solution predicts them."""

    rank: eqx.AbstractClassVar[int]  # axes of the values, without that of the bands
    values: eqx.AbstractVar[Float[np.ndarray, "..."]]
    weight: eqx.AbstractVar[Float[np.ndarray, "..."]]

    @abc.abstractmethod
    def predicted(self, solution: Solution) -> Float[jax.Array, "..."]:
        """The values that a solution gives, in the shape of `values`."""

    def check(self, name: str, scene: Scene) -> None:
        """Raise `ValueError` if the values do not have the bands that this scene's solutions have."""
        found = self.values.shape[self.rank] if self.values.ndim > self.rank else None
        expected = scene.bands if scene.banded else None
        if found != expected:
            word = lambda bands: "no band axis" if bands is None else f"{bands} bands"
            advice = "convert the picture to the scene's bands"
            checks.fail(name, f"values with {word(found)}", f"{word(expected)}, as the scene", advice)

    def residuals(self, solution: Solution) -> Float[jax.Array, " n"]:
        """sqrt(weight) (predicted - measured), flat."""
        predicted = self.predicted(solution)
        real = predicted.dtype
        return (jnp.sqrt(jnp.asarray(self.weight, real)) * (predicted - jnp.asarray(self.values, real))).ravel()


class PictureTarget(Target):
    """A picture that `camera` took: radiance, (height, width[, bands]), rows in the camera's order.

    **Arguments:** `weight`: a number, or anything that broadcasts to the picture. `mask`: (height, width), False where the
    picture does not count. `samples`: rays a pixel, as for `render`.
    """

    rank: ClassVar[int] = 2
    camera: AbstractCamera
    values: Float[np.ndarray, "height width *bands"]
    weight: Float[np.ndarray, "height width *bands"]
    samples: int = eqx.field(static=True)

    def __init__(self, camera: AbstractCamera, picture: Any, weight: Any = 1.0, mask: Any = None, samples: int = 4):
        checks.instance("camera", camera, AbstractCamera, "pass the camera that took the picture")
        width, height = camera.resolution
        values = np.array(checks.finite("picture", picture), float)
        if values.ndim not in (2, 3) or values.shape[:2] != (height, width):
            expected = f"shape ({height}, {width}) or ({height}, {width}, bands), the camera's"
            checks.fail(
                "picture", f"an array of shape {values.shape}", expected, "resample it, or change the camera's resolution"
            )
        self.camera, self.values, self.samples = camera, values, checks.positive_int("samples", samples)
        if mask is not None:
            kept = np.asarray(mask, bool)
            if kept.shape != (height, width):
                checks.fail("mask", f"an array of shape {kept.shape}", f"shape ({height}, {width})", "one bool a pixel")
            mask = kept.reshape(kept.shape + (1,) * (values.ndim - 2))
        self.weight = _weight(weight, mask, values)

    def predicted(self, solution: Solution) -> Float[jax.Array, "height width *bands"]:
        return jnp.asarray(render(solution, self.camera, self.samples))


class IrradianceTarget(Target):
    """Irradiance measured at surface points, (n[, bands]); `points` and `normals` as for `irradiance`."""

    rank: ClassVar[int] = 1
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    values: Float[np.ndarray, "n *bands"]
    weight: Float[np.ndarray, "n *bands"]
    directions: int = eqx.field(static=True)

    def __init__(self, points: Any, normals: Any, values: Any, weight: Any = 1.0, directions: int = 1024):
        self.points, self.normals = (np.asarray(checks.points(n, v)) for n, v in (("points", points), ("normals", normals)))
        self.values = _one_each(values, self.points)
        self.weight = _weight(weight, None, self.values)
        self.directions = checks.positive_int("directions", directions)

    def predicted(self, solution: Solution) -> Float[jax.Array, "n *bands"]:
        return irradiance(solution, self.points, self.normals, self.directions)


class FluenceTarget(Target):
    """Fluence measured at points in space, (n[, bands]); `directions` as for `fluence`."""

    rank: ClassVar[int] = 1
    points: Float[np.ndarray, "n 3"]
    values: Float[np.ndarray, "n *bands"]
    weight: Float[np.ndarray, "n *bands"]
    directions: int = eqx.field(static=True)

    def __init__(self, points: Any, values: Any, weight: Any = 1.0, directions: int = 2048):
        self.points = np.asarray(checks.points("points", points))
        self.values = _one_each(values, self.points)
        self.weight = _weight(weight, None, self.values)
        self.directions = checks.positive_int("directions", directions, at_least=0)

    def predicted(self, solution: Solution) -> Float[jax.Array, "n *bands"]:
        return fluence(solution, self.points, self.directions)


def _one_each(values: Any, points: np.ndarray) -> np.ndarray:
    numbers = np.array(checks.finite("values", values), float)
    if numbers.ndim not in (1, 2) or len(numbers) != len(points):
        expected = f"shape ({len(points)},) or ({len(points)}, bands), one row for each point"
        checks.fail("values", f"an array of shape {numbers.shape}", expected, "leave out points without a value")
    return numbers


def _weight(weight: Any, mask: Any, values: np.ndarray) -> np.ndarray:
    numbers = np.asarray(checks.non_negative("weight", weight), float)
    try:
        full = np.broadcast_to(numbers if mask is None else numbers * mask, values.shape).copy()
    except ValueError:
        expected = f"a number, or what broadcasts to {values.shape}"
        checks.fail("weight", f"an array of shape {numbers.shape}", expected, "give one weight for each value")
    if not full.any():
        checks.fail("weight", "zeros, or a mask that leaves nothing", "some value that counts", "leave the target out")
    return full
