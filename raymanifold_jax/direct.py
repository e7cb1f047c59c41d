"""First-flight light: what arrives straight from the sources, before any bounce.

- Suns: sweeps along their exact direction on a grid of ray offsets, so that partly lit voxels and elements count in part.
- Skies and emitting media: one sweep in the solve's own directions.
- Emitting surfaces: one sweep as well; unless it is good enough for the elements, their light is taken from patches of the
  emitters instead (see `patches`). In the medium's voxels it is the sweep's.
- Point lights: straight to elements and voxels,  E(x) = I cos(theta) T V / r^2,  with visibility V by sphere tracing and
  transmittance T.
- Compact emitting parts of the medium: straight to elements and voxels (see `volume_sources`).

Public: `Direct`, `first_flight`.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import checks
from .arrays import as_jax, numpy_or_jax, real_dtype, zeros_like
from .emitters import CLEARANCE, brighter_than, emitting_elements, point_light
from .layout import Layout
from .march import fill
from .operator import Light, Materials, Transport, make_transport
from .partition import Partition
from .patches import light_of_emitters, may_serve
from .placement import stored
from .prepare import Prepared
from .programs import program
from .quadrature import Quadrature
from .scene import PointLight, Scene, Sky, Sun
from .surfaces import Surfaces
from .transport.characteristic import Inflow
from .volume_sources import VolumeSources, compact_sources, volume_light

_SUN_OFFSETS = 4  # rays a voxel, a side


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
        glow = jnp.where(stored(layout, as_jax(compact.emits)), 0.0, glow)

    def of_surfaces_and_skies() -> Light:
        swept = _swept(transport, Light(materials.emission, glow), sky)
        if not may_serve(scene, surfaces):
            return swept
        # Where emitters are as bright as the sky, one hides as much as it adds: what they are brighter counts.
        around = jnp.zeros(scene.bands) if sky is None else jnp.mean(sky_radiance(scene, quadrature.directions), axis=1)
        excess = brighter_than(scene, around)
        if not checks.may_differ_from_zero(excess):
            return swept
        emits = np.isin(np.arange(len(surfaces)), emitting_elements(scene, surfaces))
        alone = sky is None and (glow is None or not checks.may_differ_from_zero(glow))
        sent = Light(excess[:, surfaces.material] * emits, dark.voxels)
        by_sweep = swept.elements if alone else _swept(transport, sent, None).elements
        found = light_of_emitters(scene, surfaces, excess, jnp.pi * by_sweep, jnp.pi * swept.elements)
        if found is None:
            return swept
        return Light(swept.elements + stored(layout, found / jnp.pi) - by_sweep, swept.voxels)

    values = materials.emission, glow, sky, materials.extinction, materials.scattering_albedo
    make = of_surfaces_and_skies
    swept = make() if prepared is None else prepared.reuse(("surfaces and skies", *key), values, make, quadrature)
    if compact is not None:
        swept = swept + stored(layout, _from_volumes(scene, surfaces, compact))
    for light in scene.lights:
        if isinstance(light, PointLight):
            swept = swept + stored(layout, _from_point(scene, surfaces, light))
    zero = zeros_like(swept)
    suns = [light for light in scene.lights if isinstance(light, Sun)]
    beams = [_from_sun(scene, surfaces, layout, sun, materials, prepared, number) for number, sun in enumerate(suns)]
    return Direct(sun=sum(beams, start=zero), rest=swept, brightest=brightest(scene, None if sky is None else sky.radiance))


def brightest(scene: Scene, sky: Array | None) -> Float[Array, ""]:
    """The largest of the radiances of the sky and of the irradiances of suns."""
    sent = [light.irradiance for light in scene.lights if isinstance(light, Sun)] + ([] if sky is None else [sky])
    xp = numpy_or_jax(sent)
    return as_jax(xp.stack([np.zeros(()), *(xp.max(xp.asarray(value)) for value in sent)]).max(), real_dtype())


def _swept(transport: Transport, leaving: Light, sky: Inflow | None) -> Light:
    """One sweep of what leaves surfaces and medium and of the sky; none if all are dark."""
    if sky is None and not checks.may_differ_from_zero(leaving):
        shape = (leaving.elements.shape[0], *transport.layout.shape)
        return Light(zeros_like(leaving.elements), as_jax(np.zeros(shape), leaving.elements.dtype))
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
    total = as_jax(np.zeros((scene.bands, len(directions))), real_dtype())
    for light in scene.lights:
        if isinstance(light, Sky):
            radiance = jnp.asarray(light.radiance_along(jnp.asarray(directions, total.dtype)))
            total = total + (radiance.T if radiance.ndim == 2 else radiance[None])
    return total


def _dark(materials: Materials) -> Light:
    """Nothing leaves anywhere."""
    return jax.tree.map(lambda a: as_jax(np.zeros(a.shape, a.dtype)), Light(materials.emission, materials.extinction))


def _from_sun(
    scene: Scene,
    surfaces: Surfaces,
    layout: Layout | Partition,
    sun: Sun,
    materials: Materials,
    prepared: Prepared | None = None,
    number: int = 0,
) -> Light:
    side = (np.arange(_SUN_OFFSETS) + 0.5) / _SUN_OFFSETS
    offsets = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    count = len(offsets)
    direction = np.asarray(sun.direction)
    beam = Quadrature(np.tile(direction, (count, 1)), np.full(count, 1 / count), offsets, "sun")
    make = lambda: _beam_transport(layout, beam, materials.extinction, scene.bands)
    key = ("sun", number, scene.bands, layout.shapes.mesh if isinstance(layout, Partition) else None)
    # Of many suns a solve that may be the only one keeps one.
    if prepared is None or (number > 0 and not prepared.for_good):
        transport = make()
    else:
        transport = prepared.reuse(key, (direction, materials.extinction), make)
    images = layout.unfolding.images()
    # Only the scene itself is lit; a mirror image of it gets what mirrors reflect.
    here = np.array([float(np.all(signs > 0)) for _, signs in images], real_dtype())
    xp = numpy_or_jax(sun)
    radiance = here[:, None, None] * xp.broadcast_to(xp.asarray(sun.irradiance), (len(images), count, scene.bands))
    mean = transport(_dark(materials), Inflow(as_jax(radiance, real_dtype())))
    cosines = sum(np.maximum(-(surfaces.normal * signs) @ direction, 0) for _, signs in images)
    return _of_beam(mean, as_jax(cosines, real_dtype()), as_jax(len(images), real_dtype()))


@program
def _of_beam(mean: Light, cosines: Float[Array, " E"], images: Array) -> Light:
    assert mean.voxels is not None
    return Light(mean.elements * cosines / jnp.pi, mean.voxels * (images / (4 * jnp.pi)))


def _beam_transport(layout: Layout | Partition, beam: Quadrature, extinction, bands: int) -> Transport:
    # A beam is no quadrature of the sphere: it is swept as it is, not reduced to one side of the mirrors.
    return make_transport(layout, beam, extinction, bands, beam=True)


def _from_volumes(scene: Scene, surfaces: Surfaces, sources: VolumeSources) -> Light:
    """First-flight light of compact volume sources, at the elements and at the voxels' centres."""
    at_elements = volume_light(scene, sources, surfaces.position, surfaces.normal)
    known = ~surfaces.solid
    known[tuple(surfaces.voxel[surfaces.side < 0].T)] = False  # whose centres may lie in a solid
    (where,) = np.nonzero(known.ravel())
    found = volume_light(scene, sources, scene.lattice.centers().reshape(-1, 3)[where])
    in_voxels = jnp.zeros((scene.bands, known.size), found.dtype).at[:, where].set(found).reshape(-1, *known.shape)
    in_voxels = fill(in_voxels, jnp.asarray(known, found.dtype)) * as_jax(~surfaces.solid)
    return Light(at_elements / jnp.pi, in_voxels / (4 * jnp.pi))


def _from_point(scene: Scene, surfaces: Surfaces, light: PointLight) -> Light:
    """First-flight light of a point light, at the elements and at the voxels' centres."""
    start = surfaces.position + CLEARANCE * scene.lattice.spacing * surfaces.normal
    at_elements = point_light(scene, light, start, surfaces.normal)
    centers = scene.lattice.centers().reshape(-1, 3)
    in_voxels = point_light(scene, light, centers, None, 0.5 * scene.lattice.spacing)
    in_voxels = in_voxels.reshape(-1, *scene.lattice.shape) * as_jax(~surfaces.solid)
    return Light(at_elements / jnp.pi, in_voxels / (4 * jnp.pi))
