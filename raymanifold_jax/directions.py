"""Directions to gather light along: even over the sphere, or with the density cos / pi around a normal."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

_GOLDEN = np.pi * (3 - np.sqrt(5))


def whole_sphere(number: int) -> Float[np.ndarray, "number 3"]:
    """Directions of equal share of the sphere: a Fibonacci spiral."""
    i = np.arange(number)
    z = 1 - (2 * i + 1) / number
    radius, angle = np.sqrt(1 - z**2), i * _GOLDEN
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], -1)


def cosine_hemisphere(number: int) -> Float[np.ndarray, "number 3"]:
    """Directions around +z whose density is cos / pi: a sunflower's seeds on the disc, lifted to the sphere."""
    i = np.arange(number)
    squared = (i + 0.5) / number
    radius, angle = np.sqrt(squared), i * _GOLDEN
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - squared)], -1)


def frames(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3 3"]:
    """Three rows for each normal: two unit vectors across it, and itself."""
    helper = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    first = np.cross(helper, normals)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return np.stack([first, np.cross(normals, first), normals], axis=1)


def gathering(number: int, count: int, normals: Float[np.ndarray, "n 3"] | None) -> Float[np.ndarray, "n number 3"]:
    """Directions to gather along from `count` points: around their normals, or without normals over the sphere."""
    if normals is None:
        return np.broadcast_to(whole_sphere(number), (count, number, 3))
    return np.einsum("dj,nji->ndi", cosine_hemisphere(number), frames(normals))
