"""Points on emitting surfaces and point lights, and light straight from them.

    E(x) = sum over points of  L A cos(theta) cos(theta') T V / r^2,

with visibility V by sphere tracing and transmittance T. Behind a mirror lies an image of an emitter; light that mirrors or
periodic sides send around without end is left to the sweeps.

For readings there is a fixed number of points on emitters that cover little of the surfaces; `patches` serves the elements.

Public: `EmitterPoints`, `small_emitters`, `emitter_light`, `point_light`; for `patches` `EmittingFaces`, `emitting_faces`,
`emitted_by`, `brighter_than`, `emitting_elements`, `share_that_emits`, `SMALL`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from . import checks
from .march import transmittance
from .programs import program
from .scene import MIRROR, PERIODIC, PointLight, Scene
from .surfaces import Surfaces, distance_to_solids, patch_points
from .texture import Texture
from .trace import share_that_passes, visible
from .unfolding import in_blocks, mirror_images

_POINTS = 576
#: Emitters that cover less of the surfaces than this are sampled by points.
SMALL = 0.1
_NEAR = 6  # widths of an emitter point's area
_PAIRS = 1 << 18  # receiver-point pairs at once
#: Voxels: how far off a surface rays start and end.
CLEARANCE = 2e-3


class EmittingFaces(NamedTuple):
    """Parts of emitting elements, one row each."""

    position: Float[np.ndarray, "m 3"]
    normal: Float[np.ndarray, "m 3"]
    area: Float[np.ndarray, " m"]
    owner: np.ndarray  # (m,): solids, then sides


class EmitterPoints(eqx.Module):
    """Points on emitting surfaces: where they are, their normals, and L A of each."""

    position: Float[np.ndarray, "m 3"]
    normal: Float[np.ndarray, "m 3"]
    power: Float[Array, "C m"]  # radiance times area
    width: float = eqx.field(static=True)  # of the area that a point stands for

    def near(self, points: Float[np.ndarray, "n 3"]) -> Bool[np.ndarray, " n"]:
        """Whether some points are so near to an emitter that its points are seen one by one."""
        nearest = [((self.position - p) ** 2).sum(-1).min() for p in np.asarray(points)]
        return np.array(nearest) < (_NEAR * self.width) ** 2


def emitting_elements(scene: Scene, surfaces: Surfaces) -> np.ndarray:
    """Numbers of the elements whose solids or sides emit, or may."""
    owners = [*scene.solids, *scene.boundary.sides]
    emits = np.array([checks.may_differ_from_zero(getattr(o, "emission", 0.0)) for o in owners], bool)
    return np.nonzero(emits[surfaces.material])[0] if len(surfaces) else np.zeros(0, int)


def emitted_by(scene: Scene) -> Float[Array, "C owners"]:
    """Radiance that the solids, then the sides, emit."""
    owners = [*scene.solids, *scene.boundary.sides]
    return jnp.stack([jnp.broadcast_to(getattr(o, "emission", jnp.zeros(())), (scene.bands,)) for o in owners], 1)


def brighter_than(scene: Scene, sky: Float[Array, " C"]) -> Float[Array, "C owners"]:
    """What they emit, less what they would if they could not be told from a sky of that radiance all around; 0 if less.

    What a dark one hides of the sky is left to the sweep, which knows how much of it comes there, through fog.
    """
    owners = [*scene.solids, *scene.boundary.sides]
    reflected = [0.0 if isinstance(albedo := getattr(o, "albedo", 0.0), Texture) else albedo for o in owners]
    absorbed = jnp.stack([1 - jnp.broadcast_to(albedo, sky.shape) for albedo in reflected], 1)
    emitted = emitted_by(scene)
    return jnp.clip(emitted - sky[:, None] * absorbed, 0.0, emitted)


def emitting_faces(scene: Scene, surfaces: Surfaces, side: int) -> EmittingFaces:
    """`side` x `side` parts of each emitting element."""
    emitters = emitting_elements(scene, surfaces)
    spacing = scene.lattice.spacing
    patch, weight = patch_points(surfaces.normal[emitters], surfaces.offset[emitters], side)
    center = scene.lattice.lower + (surfaces.voxel[emitters] + 0.5) * spacing
    position = center[:, None] + patch * spacing
    normal = np.broadcast_to(surfaces.normal[emitters][:, None], position.shape)
    # Of a face that is only partly the emitter's, keep that part.
    flush = (surfaces.side[emitters] >= 0) & (surfaces.material[emitters] < len(scene.solids))
    behind = np.ones(weight.shape, bool)
    if flush.any():
        inside = position[flush] - 0.02 * spacing * normal[flush]
        behind[flush] = distance_to_solids(scene, inside) < 0
    weight = np.where(behind, weight, 0.0)
    alone = ~weight.any(1)  # with so small a face that none of its points is in the voxel
    position[alone, 0], weight[alone, 0] = surfaces.position[emitters[alone]], 1.0
    keep = weight > 0
    area = surfaces.area[emitters][:, None] * weight / weight.sum(1, keepdims=True)
    of_each = lambda values: np.broadcast_to(values[:, None], keep.shape)[keep]
    return EmittingFaces(position[keep], normal[keep], area[keep], of_each(surfaces.material[emitters]))


def share_that_emits(scene: Scene, surfaces: Surfaces) -> float:
    """Of the area of all surfaces."""
    return float(surfaces.area[emitting_elements(scene, surfaces)].sum() / max(surfaces.area.sum(), 1e-300))


def small_emitters(scene: Scene, surfaces: Surfaces) -> EmitterPoints | None:
    """Points on the emitting surfaces, if these are a small part of all surfaces and have no images; else None."""
    count = len(emitting_elements(scene, surfaces))
    if not count or share_that_emits(scene, surfaces) > SMALL or any(s in (MIRROR, PERIODIC) for s in scene.boundary.sides):
        return None
    faces = emitting_faces(scene, surfaces, math.ceil(math.sqrt(_POINTS / count)))
    radiance = emitted_by(scene)
    power = radiance[:, faces.owner] * jnp.asarray(faces.area, radiance.dtype)
    return EmitterPoints(faces.position, faces.normal, power, float(np.sqrt(faces.area.max())))


def emitter_light(
    scene: Scene, points: EmitterPoints, position: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"] | None
) -> Float[Array, "C n"]:
    """Irradiance at surface points from emitter points, or fluence, with exact visibility and transmittance."""
    normal = np.zeros_like(position) if normal is None else normal
    real = points.power.dtype
    block = max(1, _PAIRS // len(points.position))
    count = len(position)
    padded = -(-count // block) * block
    spread = lambda a: jnp.asarray(np.concatenate([a, np.repeat(a[-1:], padded - count, 0)]), real).reshape(-1, block, 3)
    parts = [_pairs(scene, points, p, n) for p, n in zip(spread(position), spread(normal), strict=True)]
    return jnp.concatenate(parts, axis=-1)[..., :count]


def point_light(
    scene: Scene,
    light: PointLight,
    position: Float[np.ndarray, "n 3"],
    normal: Float[np.ndarray, "n 3"] | None,
    nearest: float = 1e-15,
) -> Float[Array, "C n"]:
    """Irradiance I cos(theta) T V / r^2 at points just off surfaces, without normals fluence; also by mirrors, as from images.

    `nearest`: the least distance that counts.
    """
    spacing, lower = scene.lattice.spacing, np.asarray(scene.lattice.lower)
    u = (position - lower) / spacing
    total = jnp.zeros((scene.bands, len(u)))
    for sign, shift in mirror_images(scene):
        image = sign * (np.asarray(light.position, float) - lower) / spacing + shift
        to = image - u
        distance = np.maximum(np.sqrt((to**2).sum(-1)), nearest / spacing)
        cosine = 1.0 if normal is None else np.maximum((to * normal).sum(-1), 0.0) / distance
        reach = in_blocks(share_that_passes, scene, (u, np.broadcast_to(image, u.shape)))
        total = total + reach.T * jnp.asarray(cosine / (distance * spacing) ** 2, total.dtype)
    return jnp.broadcast_to(light.intensity, (scene.bands,))[:, None] * total


@program
def _pairs(scene: Scene, points: EmitterPoints, position, normal) -> Float[Array, "C n"]:
    real = position.dtype
    clearance = CLEARANCE * scene.lattice.spacing
    start = position + clearance * normal
    end = jnp.asarray(points.position, real)
    towards = jnp.asarray(points.normal, real)
    to = end[None] - start[:, None]
    squared = jnp.maximum(jnp.sum(to**2, -1), (0.05 * scene.lattice.spacing) ** 2)
    leaving = -jnp.einsum("nmi,mi->nm", to, towards)
    arriving = jnp.einsum("nmi,ni->nm", to, normal)
    arriving = jnp.where(jnp.any(normal != 0, -1)[:, None], arriving, jnp.sqrt(squared))  # no normal: fluence
    geometry = jnp.maximum(leaving, 0.0) * jnp.maximum(arriving, 0.0) / squared**2
    starts = jnp.broadcast_to(start[:, None], to.shape).reshape(-1, 3)
    # Points that face away need no ray: beside a flush lamp it would creep along it.
    ends = jnp.where((geometry > 0)[..., None], (end + clearance * towards)[None], start[:, None]).reshape(-1, 3)
    passed = geometry.reshape(-1) * visible(scene, starts, ends) * transmittance(scene, starts, ends)
    return jnp.einsum("cnm,cm->cn", passed.reshape(-1, *geometry.shape), points.power)
