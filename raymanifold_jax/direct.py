"""First-flight light: what arrives straight from the sources, before any bounce.

- Suns: sweeps along their exact direction on a grid of ray offsets, so that partly lit voxels and elements count in part.
- Skies and emitting media, and surfaces that emit over much of the scene: one sweep in the solve's own directions.
- Small emitting surfaces and point lights: straight to the elements from points on them,

      E(x) = sum over points of  L A cos(theta) cos(theta') T V / r^2       (a point light: I cos(theta) T V / r^2),

  with visibility V by sphere tracing and transmittance T. Their light in the medium's voxels comes by the sweep (point lights:
  from the points as well).
- Compact emitting parts of the medium: straight to elements and voxels (see `volume_sources`).

Public: `Direct`, `first_flight`, `emitter_light`, `small_emitters`.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from . import checks
from .layout import Layout
from .march import fill, transmittance
from .operator import Light, Materials, Transport, make_transport
from .partition import Partition
from .placement import stored
from .prepare import Prepared
from .quadrature import Quadrature
from .scene import OPEN, PointLight, Scene, Sky, Sun, Wall
from .surfaces import Surfaces, patch_points
from .trace import visible
from .transport.characteristic import Inflow
from .volume_sources import VolumeSources, compact_sources, volume_light

_SUN_OFFSETS = 4  # rays a voxel, a side
_EMITTER_POINTS = 576  # for readings
_FEWER_POINTS = 256  # for elements: what bounces is smooth
_SMALL = 0.1  # emitters that cover less of the surfaces than this are sampled by points
_NEAR = 6  # widths of an emitter point's area
_PAIRS = 1 << 18  # receiver-point pairs at once


class Direct(eqx.Module):
    """First-flight mean radiance (irradiance / pi; fluence / 4 pi): from the suns, and from everything else."""

    sun: Light
    rest: Light
    brightest: Float[Array, ""]  # radiance sent into the lattice by skies, and irradiance of suns, at most


def first_flight(
    scene: Scene,
    surfaces: Surfaces,
    transport: Transport,
    quadrature: Quadrature,
    materials: Materials,
    prepared: Prepared | None = None,
    key: tuple = (),
) -> Direct:
    """All light that arrives straight from sources; `key` tells the transport among those of the same `prepared`."""
    layout = transport.layout
    dark = _dark(materials)
    sky = sky_inflow(scene, layout, quadrature)
    compact = compact_sources(scene, surfaces)
    glow = materials.medium_source
    if compact is not None and glow is not None:
        glow = jnp.where(stored(layout, jnp.asarray(compact.emits)), 0.0, glow)

    def of_surfaces_and_skies() -> Light:
        swept = _swept(transport, Light(materials.emission, glow), sky)
        if (points := small_emitters(scene, surfaces, _FEWER_POINTS)) is not None:
            # The elements' share of the emitters' light is taken exactly; the sweep's share of it is taken out.
            others = _swept(transport, Light(dark.elements, glow), sky).elements
            swept = Light(others + stored(layout, _conserved(scene, surfaces, points) / jnp.pi), swept.voxels)
        return swept

    values = materials.emission, glow, sky, materials.extinction, materials.scattering_albedo
    make = of_surfaces_and_skies
    swept = make() if prepared is None else prepared.reuse(("surfaces and skies", *key), values, make, quadrature)
    if compact is not None:
        swept = swept + stored(layout, _from_volumes(scene, surfaces, compact))
    for light in scene.lights:
        if isinstance(light, PointLight):
            swept = swept + stored(layout, _from_point(scene, surfaces, light))
    zero = jax.tree.map(jnp.zeros_like, swept)
    suns = [_from_sun(scene, surfaces, layout, light, materials, prepared) for light in scene.lights if isinstance(light, Sun)]
    return Direct(sun=sum(suns, start=zero), rest=swept, brightest=brightest(scene, None if sky is None else sky.radiance))


def brightest(scene: Scene, sky: Array | None) -> Float[Array, ""]:
    """The largest of the radiances of the sky and of the irradiances of suns."""
    sent = [light.irradiance for light in scene.lights if isinstance(light, Sun)] + ([] if sky is None else [sky])
    return jnp.stack([jnp.zeros(()), *(jnp.max(jnp.asarray(value, float)) for value in sent)]).max()


def _swept(transport: Transport, leaving: Light, sky: Inflow | None) -> Light:
    """One sweep of what leaves surfaces and medium and of the sky; none if all are dark."""
    if sky is None and not checks.may_differ_from_zero(leaving):
        shape = (leaving.elements.shape[0], *transport.layout.shape)
        return Light(jnp.zeros_like(leaving.elements), jnp.zeros(shape, leaving.elements.dtype))
    return transport(leaving, sky)


def sky_inflow(scene: Scene, layout: Layout | Partition, quadrature: Quadrature) -> Inflow | None:
    """Radiance of all skies along the swept directions, as each mirror image of an open side sees it."""
    skies = [light for light in scene.lights if isinstance(light, Sky)]
    if not skies:
        return None
    if layout.unfolding.axes:
        quadrature = quadrature.mirrored(layout.unfolding.axes)
    images = []
    for _, signs in layout.unfolding.images():
        images.append(sky_radiance(scene, quadrature.directions * signs).T)
    return Inflow(jnp.stack(images))


def sky_radiance(scene: Scene, directions: Float[Array, "n 3"] | Float[np.ndarray, "n 3"]) -> Float[Array, "C n"]:
    """Radiance of all skies along directions of travel."""
    total = jnp.zeros((scene.bands, len(directions)))
    for light in scene.lights:
        if isinstance(light, Sky):
            radiance = jnp.asarray(light.radiance_along(jnp.asarray(directions, total.dtype)))
            total = total + (radiance.T if radiance.ndim == 2 else radiance[None])
    return total


def _dark(materials: Materials) -> Light:
    """Nothing leaves anywhere."""
    voxels = None if materials.extinction is None else jnp.zeros_like(materials.extinction)
    return Light(jnp.zeros_like(materials.emission), voxels)


def _from_sun(
    scene: Scene,
    surfaces: Surfaces,
    layout: Layout | Partition,
    sun: Sun,
    materials: Materials,
    prepared: Prepared | None = None,
) -> Light:
    side = (np.arange(_SUN_OFFSETS) + 0.5) / _SUN_OFFSETS
    offsets = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    count = len(offsets)
    direction = np.asarray(sun.direction)
    beam = Quadrature(np.tile(direction, (count, 1)), np.full(count, 1 / count), offsets, "sun")
    make = lambda: _beam_transport(layout, beam, materials.extinction, scene.bands)
    key = ("sun", *direction.tolist(), scene.bands, layout.shapes.mesh if isinstance(layout, Partition) else None)
    transport = make() if prepared is None else prepared.reuse(key, materials.extinction, make)
    images = layout.unfolding.images()
    irradiance = jnp.broadcast_to(sun.irradiance, (scene.bands,))
    # Only the scene itself is lit; a mirror image of it gets what mirrors reflect.
    here = jnp.array([float(np.all(signs > 0)) for _, signs in images])
    radiance = here[:, None, None] * jnp.broadcast_to(irradiance, (len(images), count, scene.bands))
    mean = transport(_dark(materials), Inflow(radiance))
    assert mean.voxels is not None
    cosines = sum(np.maximum(-(surfaces.normal * signs) @ direction, 0) for _, signs in images)
    return Light(mean.elements * jnp.asarray(cosines, radiance.dtype) / jnp.pi, mean.voxels * (len(images) / (4 * np.pi)))


def _beam_transport(layout: Layout | Partition, beam: Quadrature, extinction, bands: int) -> Transport:
    # A beam is no quadrature of the sphere: it is swept as it is, not reduced to one side of the mirrors.
    return make_transport(layout, beam, extinction, bands, beam=True)


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


def small_emitters(scene: Scene, surfaces: Surfaces, count: int = _EMITTER_POINTS) -> EmitterPoints | None:
    """`count` points or more on the emitting surfaces, if these are a small part of all surfaces; else None."""
    owners = [*scene.solids, *scene.boundary.sides]
    emits = np.array([checks.may_differ_from_zero(getattr(o, "emission", 0.0)) for o in owners], bool)
    emitters = np.nonzero(emits[surfaces.material])[0] if len(surfaces) else []
    if not len(emitters) or surfaces.area[emitters].sum() > _SMALL * surfaces.area.sum():
        return None
    side = int(np.ceil(np.sqrt(count / len(emitters))))
    spacing = scene.lattice.spacing
    patch, weight = patch_points(surfaces.normal[emitters], surfaces.offset[emitters], side)
    center = scene.lattice.lower + (surfaces.voxel[emitters] + 0.5) * spacing
    position = center[:, None] + patch * spacing
    normal = np.broadcast_to(surfaces.normal[emitters][:, None], position.shape)
    # Of a face that is only partly the emitter's, keep that part.
    behind = np.asarray(scene.distance(jnp.asarray(position - 0.02 * spacing * normal))) < 0
    flush = (surfaces.side[emitters] >= 0) & (surfaces.material[emitters] < len(scene.solids))
    weight = np.where(behind | ~flush[:, None], weight, 0.0)
    weight[~weight.any(1), 0] = 1.0
    keep = weight > 0
    share = weight / weight.sum(1, keepdims=True)
    area = (surfaces.area[emitters][:, None] * share)[keep]
    owner = np.broadcast_to(surfaces.material[emitters][:, None], keep.shape)[keep]
    radiance = jnp.stack([jnp.broadcast_to(getattr(o, "emission", jnp.zeros(())), (scene.bands,)) for o in owners], 1)
    power = radiance[:, owner] * jnp.asarray(area, radiance.dtype)
    return EmitterPoints(position[keep], normal[keep], power, float(np.sqrt(area.max())))


def emitter_light(
    scene: Scene, points: EmitterPoints, position: Float[np.ndarray, "n 3"], normal: Float[np.ndarray, "n 3"] | None
) -> Float[Array, "C n"]:
    """Irradiance at surface points from emitter points, or fluence, with exact visibility and transmittance."""
    return _all_pairs(scene, points, position, np.zeros_like(position) if normal is None else normal)[0]


def _all_pairs(scene: Scene, points: EmitterPoints, position: np.ndarray, normal: np.ndarray) -> Float[Array, "2 C n"]:
    real = points.power.dtype
    block = max(1, _PAIRS // len(points.position))
    count = len(position)
    padded = -(-count // block) * block
    spread = lambda a: jnp.asarray(np.concatenate([a, np.repeat(a[-1:], padded - count, 0)]), real).reshape(-1, block, 3)
    parts = [_pairs(scene, points, p, n) for p, n in zip(spread(position), spread(normal), strict=True)]
    return jnp.concatenate(parts, axis=-1)[..., :count]


def _conserved(scene: Scene, surfaces: Surfaces, points: EmitterPoints) -> Float[Array, "C E"]:
    """Irradiance of the elements from emitter points, scaled so that all the power sent arrives (by about 0.2 % at 16^3).

    Elements are read at their middles, which counts a little too much where the light is near.
    """
    found = _all_pairs(scene, points, surfaces.position, surfaces.normal)
    if not all(side is OPEN or isinstance(side, Wall) for side in scene.boundary.sides):
        return found[0]  # some of it leaves through mirrors and periodic sides
    sent = jnp.pi * jnp.sum(points.power, axis=1)
    received = found[1] @ jnp.asarray(surfaces.area, sent.dtype)
    return found[0] * jnp.where(received > 0, jnp.clip(sent / jnp.maximum(received, 1e-30), 0.95, 1.05), 1.0)[:, None]


@eqx.filter_jit
def _pairs(scene: Scene, points: EmitterPoints, position, normal) -> Float[Array, "2 C n"]:
    """The irradiance, and what it would be without a medium."""
    real = position.dtype
    clearance = 2e-3 * scene.lattice.spacing
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
    seen = geometry.reshape(-1) * visible(scene, starts, ends)
    passed = seen * transmittance(scene, starts, ends)
    irradiance = jnp.einsum("cnm,cm->cn", passed.reshape(-1, *geometry.shape), points.power)
    unattenuated = jnp.einsum("nm,cm->cn", seen.reshape(geometry.shape), points.power)
    return jnp.stack([irradiance, unattenuated])


def _from_volumes(scene: Scene, surfaces: Surfaces, sources: VolumeSources) -> Light:
    """First-flight light of compact volume sources, at the elements and at the voxels' centres."""
    at_elements = volume_light(scene, sources, surfaces.position, surfaces.normal)
    known = ~surfaces.solid
    known[tuple(surfaces.voxel[surfaces.side < 0].T)] = False  # whose centres may lie in a solid
    (where,) = np.nonzero(known.ravel())
    found = volume_light(scene, sources, scene.lattice.centers().reshape(-1, 3)[where])
    in_voxels = jnp.zeros((scene.bands, known.size), found.dtype).at[:, where].set(found).reshape(-1, *known.shape)
    in_voxels = fill(in_voxels, jnp.asarray(known, found.dtype)) * jnp.asarray(~surfaces.solid)
    return Light(at_elements / jnp.pi, in_voxels / (4 * jnp.pi))


def _from_point(scene: Scene, surfaces: Surfaces, light: PointLight) -> Light:
    """First-flight light of a point light, at the elements and at the voxels' centres."""
    spacing = scene.lattice.spacing
    clearance = 2e-3 * spacing
    normal = jnp.asarray(surfaces.normal, float)
    start = jnp.asarray(surfaces.position, float) + clearance * normal
    flux, to = _point_flux(scene, light, start)
    cosine = jnp.einsum("ni,ni->n", to, normal) / jnp.maximum(jnp.linalg.norm(to, axis=1), 1e-30)
    centers = jnp.asarray(scene.lattice.centers().reshape(-1, 3), float)
    in_voxels, _ = _point_flux(scene, light, centers)
    in_voxels = in_voxels.reshape(-1, *scene.lattice.shape) * jnp.asarray(~surfaces.solid)
    return Light(flux * jnp.maximum(cosine, 0.0) / jnp.pi, in_voxels / (4 * jnp.pi))


def _point_flux(scene: Scene, light: PointLight, start: Float[Array, "n 3"]):
    """I T V / r^2 at some points, and the vectors to the light."""
    position = jnp.asarray(light.position, start.dtype)
    to = position - start
    ends = jnp.broadcast_to(position, start.shape)
    squared = jnp.maximum(jnp.sum(to**2, -1), (0.5 * scene.lattice.spacing) ** 2)
    reach = visible(scene, start, ends) * transmittance(scene, start, ends)
    intensity = jnp.broadcast_to(light.intensity, (scene.bands,))
    return intensity[:, None] * reach / squared, to
