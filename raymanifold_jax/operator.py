"""The transport operator of a scene: from the light that leaves surfaces and medium to the light that arrives.

With the mean arriving radiance E/pi at an element and the mean radiance J = fluence/(4 pi) in a voxel, one coordinate evolution
is linear in the exitant radiance of the elements and in the source function of the voxels. The unknowns of the solve are
what surfaces reflect and the medium scatters,

    x = (albedo E / pi,  (scattering / extinction) J),        x = K x + b,

both radiances. Every row of K adds up to at most the largest albedo: arriving radiance is a mean of what was sent.

Public: `Light`, `Transport`, `make_transport`, `Materials`, `materials`.
"""

from __future__ import annotations

import dataclasses
from contextlib import nullcontext
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from . import checks
from .arrays import as_jax, numpy_or_jax, ones_like, real_dtype, worked_out_now
from .lattice import Lattice
from .layout import Layout, Ordinates, make_ordinates
from .partition import Partition
from .placement import stored
from .programs import program
from .quadrature import Quadrature
from .scene import Scene, Wall
from .surfaces import Surfaces, patch_points
from .texture import Texture, mean_values
from .transport import native
from .transport.characteristic import Inflow
from .transport.derivative import Manner, swept, unswept
from .transport.links import Links, find_links, worth_linking
from .transport.sharded import laps_over, mark_over, plane_size, slopes_over
from .transport.slopes import THIN
from .transport.step import thin_limit

_MOST_LAPS = 1 << 16
#: Rounds of Sinkhorn's iteration, over-relaxed; each costs about three sweeps. In vacuum one leaves 0 to .28 of what was off;
#: two with Chebyshev's factors for that leave .014. With a medium a second gains nothing: CUT voxels are what is off there.
_ROUNDS_IN_VACUUM, _ROUNDS_IN_MEDIUM = (1.31, 1.04), (1.0,)
_TRACE = 1e-7  # optical depth a voxel


class Light(eqx.Module):
    """Radiance at the surface elements and in the voxels: what leaves or what arrives, by context.

    `voxels` is None where nobody asks for it (no medium).
    """

    elements: Float[Array, "C E"]
    voxels: Float[Array, "C nx ny nz"] | None = None

    def __add__(self, other: Light) -> Light:
        return _sum(self, other)

    def largest(self) -> Float[Array, ""]:
        """The largest magnitude anywhere."""
        return _largest(self)


@program
def _sum(one: Light, other: Light) -> Light:
    voxels = other.voxels if one.voxels is None else one.voxels
    if one.voxels is not None and other.voxels is not None:
        voxels = one.voxels + other.voxels
    return Light(one.elements + other.elements, voxels)


@program
def _largest(light: Light) -> Float[Array, ""]:
    parts = [light.elements] if light.voxels is None else [light.elements, light.voxels]
    return jnp.stack([jnp.max(jnp.abs(p), initial=0.0) for p in parts]).max()


class Materials(eqx.Module):
    """Albedo and emitted radiance of the elements, scattering albedo and emission source of the voxels."""

    albedo: Float[Array, "C E"]
    emission: Float[Array, "C E"]
    scattering_albedo: Float[Array, "C nx ny nz"] | None
    medium_source: Float[Array, "C nx ny nz"] | None  # emission / extinction
    extinction: Float[Array, "C nx ny nz"] | None
    absorption: Float[Array, "C nx ny nz"] | None

    def reflected(self, arriving: Light) -> Light:
        """What surfaces reflect and the medium scatters of the light that arrives."""
        scatters = self.scattering_albedo is not None and arriving.voxels is not None
        by = Light(self.albedo, self.scattering_albedo if scatters else None)
        return _times(by, Light(arriving.elements, arriving.voxels if scatters else None))


@program
def _times(one: Any, other: Any) -> Any:
    return jax.tree.map(jnp.multiply, one, other)


def materials(scene: Scene, surfaces: Surfaces) -> Materials:
    """The scene's materials on its elements and voxels; differentiable in every value."""
    bands = scene.bands
    real = real_dtype()
    xp = numpy_or_jax(scene)
    spread = lambda value: xp.broadcast_to(xp.asarray(value, real), (bands,))
    none = np.zeros((bands,), real)
    owners = [*scene.solids, *(side if isinstance(side, Wall) else None for side in scene.boundary.sides)]
    plain = [none if o is None or isinstance(o.albedo, Texture) else spread(o.albedo) for o in owners]
    emission = xp.stack([none if o is None else spread(o.emission) for o in owners], axis=1)
    owner = surfaces.material
    albedo = xp.stack(plain, axis=1)[:, owner]
    for number, o in enumerate(owners):
        if o is not None and isinstance(o.albedo, Texture):
            rows = np.nonzero(surfaces.material == number)[0]
            points, weight = _face_points(scene.lattice, surfaces, rows)
            values = mean_values(o.albedo, scene.lattice, points, weight, bands)
            albedo = jnp.asarray(albedo).at[:, rows].set(values)
    medium = dict.fromkeys(("scattering_albedo", "medium_source", "extinction", "absorption"))
    if scene.medium is not None:
        shape = (*scene.lattice.shape, bands)
        coefficients = jax.tree.map(xp.asarray, scene.medium).coefficients()
        fields = [xp.moveaxis(xp.broadcast_to(c, shape), -1, 0) for c in coefficients]
        scattering, absorption, source = (xp.where(surfaces.solid, 0.0, f).astype(real) for f in fields)
        # A voxel that neither absorbs nor scatters has no source function: give it a trace of absorption if it emits, or may
        # become one that does or scatters.
        trace = _TRACE / scene.lattice.spacing
        needed = (source > 0) | checks.is_traced(scene.medium)
        absorption = absorption + xp.where(needed & (scattering + absorption < trace), trace, 0.0).astype(real)
        extinction = scattering + absorption
        divisor = xp.where(extinction > 0, extinction, 1.0).astype(real)
        medium = {
            "scattering_albedo": scattering / divisor, "medium_source": source / divisor, "extinction": extinction,
            "absorption": absorption,
        }  # fmt: skip
    return jax.tree.map(as_jax, Materials(albedo, emission[:, owner], **medium))


def _face_points(lattice: Lattice, surfaces: Surfaces, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on the faces of some elements, and the area of each."""
    patch, weight = patch_points(surfaces.normal[rows], surfaces.offset[rows])
    center = lattice.lower + (surfaces.voxel[rows] + 0.5) * lattice.spacing
    return center[:, None] + patch * lattice.spacing, weight


class Transport(eqx.Module):
    """K without the albedos: a layout, the directions, the medium's extinction, and the sums of a uniform radiance of 1.

    In vacuum all bands are alike: their sums and factors have one, for all.
    """

    layout: Layout | Partition
    ordinates: tuple[Ordinates, ...]
    extinction: Float[Array, "C X Y Z"] | None
    element_sums: Float[Array, "C E"]
    voxel_sums: Float[Array, "C nx ny nz"]
    coverage: Float[Array, "nx ny nz"]  # weights of the paths through each voxel; 0 inside solids
    thin: bool = eqx.field(static=True)
    onward: bool = eqx.field(static=True)  # see `SweptMedium`
    factors: Light | None = None  # what leaves is multiplied by, for the exchange of power to balance
    # The medium's albedo times its factors, if light scattered in thick voxels has slopes.
    albedo: Float[Array, "C nx ny nz"] | None = None
    links: Links | None = None  # in vacuum: the same sums at the elements without a sweep

    def __call__(self, leaving: Light, inflow: Inflow | None = None, fluence: bool = True, scattered: bool = False) -> Light:
        """Mean radiance arriving at elements and in voxels, of what leaves them and of what comes in through open sides.

        With `scattered` what leaves the voxels is scattered light, which in thick ones is linear; else it is even in each.
        """
        leaving, inflow = _balanced(self.factors, leaving, inflow)
        if self.links is not None and inflow is None and not fluence:
            sums = Light(self.links.arriving(leaving.elements))
        else:
            sums = _sweep(self, leaving, inflow, fluence, self.albedo if scattered else None)
        return _means(sums, Light(self.element_sums, self.voxel_sums))

    def transposed(self, asked: Light, scattered: bool = False) -> Light:
        """The transpose in what leaves: weights of arriving light back to weights of what was sent."""
        sums = Light(self.element_sums, None if asked.voxels is None else self.voxel_sums)
        albedo = self.albedo if scattered else None
        sent = _transposed(self, jax.tree.map(_ratio, asked, sums), albedo)
        return _balanced(self.factors, sent, None)[0]


@program
def _balanced(factors: Light | None, leaving: Light, inflow: Inflow | None) -> tuple[Light, Inflow | None]:
    if factors is None:
        return leaving, inflow
    voxels = None if leaving.voxels is None or factors.voxels is None else leaving.voxels * factors.voxels
    inflow = None if inflow is None else Inflow(inflow.radiance, jnp.broadcast_to(factors.elements, leaving.elements.shape))
    return Light(leaving.elements * factors.elements, voxels), inflow


@program
def _means(sums: Light, furnace: Light) -> Light:
    elements = _ratio(sums.elements, furnace.elements)
    return Light(elements, None if sums.voxels is None else _ratio(sums.voxels, furnace.voxels))


def _balance(transport: Transport, area: Float[Array, " E"], sums: Light) -> tuple[Light, Light]:
    """Factors of what leaves that make the exchange of power balance, and the sums for them; `sums`: for light of 1.

    The power that a source sends should all arrive: with g = (pi A, 4 pi extinction V), the power at an element or in a
    voxel for a mean radiance of 1, the columns of K without albedos add up as sum_i g_i K_ij = g_j. Gathering makes the rows
    exact, not the columns, which are some percent off next to concave corners. Sinkhorn's iteration scales both in turn: the
    transposed sweep tells the columns' sums, the furnace the rows'.
    """
    vacuum, power = transport.extinction is None, _powers(transport, area)
    factors = ones_like(power)
    for beyond in _ROUNDS_IN_VACUUM if vacuum else _ROUNDS_IN_MEDIUM:
        wanted = jax.tree.map(_ratio, power, Light(sums.elements) if vacuum else sums)
        sent = _transposed(transport, wanted)
        step = as_jax(beyond, factors.elements.dtype)
        factors = jax.tree.map(partial(_factor, step), factors, power, sent)
        sums = _sums(transport, factors)
    return factors, sums


@program
def _powers(transport: Transport, area: Float[Array, " E"]) -> Light:
    """At elements and in voxels, for a mean radiance of 1."""
    layout, images = transport.layout, len(transport.layout.unfolding.images())
    power = jnp.broadcast_to(jnp.pi * area, (len(transport.element_sums), len(area)))
    if transport.extinction is None:
        return Light(power)
    weight = sum(jnp.sum(o.weight) for o in transport.ordinates)
    volume = transport.coverage * (4 * jnp.pi / weight * layout.spacing**3 / images)
    return Light(power, layout.from_padded(transport.extinction) / images * volume)


@program
def _factor(beyond: Array, factor: Array, wanted: Array, sent: Array) -> Array:
    better = jnp.clip(jnp.where(sent > 0, wanted / jnp.where(sent > 0, sent, 1.0), 1.0), 0.5, 2.0)
    return factor * (better / factor) ** beyond


def _transposed(transport: Transport, asked: Light, albedo=None) -> Light:
    if transport.links is not None and asked.voxels is None:
        return Light(transport.links.sent(asked.elements))
    manner = Manner(transport.thin, transport.onward)
    known = manner, transport.layout, transport.ordinates, transport.extinction
    exitance, source, slopes = unswept(*known, asked.elements, asked.voxels, albedo is not None)
    if slopes is not None and source is not None:
        source = source + _unsloped(transport.layout, slopes, albedo, transport.extinction)
    return Light(exitance, source)


@program
def _ratio(sums: Array, furnace: Array) -> Array:
    return jnp.where(furnace > 0, sums / jnp.where(furnace > 0, furnace, 1.0), 0.0)


def _sweep(transport: Transport, leaving: Light, inflow: Inflow | None, fluence: bool, albedo=None) -> Light:
    """Sums of light; sources in the voxels have slopes if the `albedo` is given that they come by."""
    slopes = None
    if albedo is not None and leaving.voxels is not None:
        slopes = _slopes(transport.layout, leaving.voxels, albedo, transport.extinction)
    # By links it takes less than by reading rays, which only lights voxels then.
    links = transport.links if inflow is None and native.at_hand(leaving.elements) else None
    manner = Manner(transport.thin, transport.onward, fluence, links is None)
    known = manner, transport.layout, transport.ordinates, transport.extinction
    sums = Light(*swept(*known, leaving.elements, leaving.voxels, slopes, inflow))
    return sums if links is None else Light(links.arriving(leaving.elements), sums.voxels)


@program
def _slopes(layout: Layout | Partition, source, albedo, extinction) -> tuple[Array, ...]:
    return slopes_over(layout, source, albedo, extinction)


@program
def _unsloped(layout: Layout | Partition, slopes: tuple[Array, ...], albedo, extinction) -> Array:
    """The transpose of `_slopes` in the source."""
    return jax.vjp(lambda source: _slopes(layout, source, albedo, extinction), jnp.zeros_like(albedo))[1](slopes)[0]


_count_laps = eqx.filter_jit(laps_over)


def _sums(transport: Transport, leaving: Light) -> Light:
    """The sums for light of 1, or in proportion to it: of elements alone where those can be had without a sweep."""
    if transport.links is not None:
        return Light(transport.links.arriving(leaving.elements))
    return _furnace(transport, leaving)


def _furnace(transport: Transport, leaving: Light) -> Light:
    """The sums at elements and, outside solids, in voxels for light of 1, or in proportion to it."""
    sums = _sweep(transport, leaving, None, True)
    assert sums.voxels is not None
    return Light(sums.elements, _outside(transport.layout, sums.voxels))


@program
def _outside(layout: Layout | Partition, voxels: Array) -> Array:
    solid = layout.from_padded(layout.buried[None].astype(layout.real))[0] > 0
    return jnp.where(solid, 0.0, voxels)


@program
def _padded(layout: Layout | Partition, field: Array) -> Array:
    return layout.to_padded(field)


@program
def _first(field: Array) -> Array:
    return field[0]


@program
def _one_above_the_other(one: Light, other: Light) -> Light:
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), one, other)


@program
def _parted(both: Light) -> tuple[Light, Light]:
    half = len(both.elements) // 2
    return jax.tree.map(lambda a: a[:half], both), jax.tree.map(lambda a: a[half:], both)


@program
def _greatest(extinction: Array) -> Array:
    return lax.stop_gradient(jnp.max(extinction))


def make_transport(
    layout: Layout | Partition,
    quadrature: Quadrature,
    extinction: Float[Array, "C nx ny nz"] | None,
    bands: int,
    beam: bool = False,
    area: Float[np.ndarray, " E"] | None = None,
    albedo: Float[Array, "C nx ny nz"] | None = None,
) -> Transport:
    """Prepare the sweeps of one set of directions over a layout.

    With `area`, of the elements, the exchange of power is balanced. Where voxels are optically thick, light read next to a
    surface is carried on to it and, with `albedo`, of the medium, scattered light is linear in each voxel. Directions on one
    side of the mirrors stand for their reflections too; those of a `beam` do not, and its light is read as it is found:
    carried on to a surface it would lose what it loses along it.

    **Raises** `ValueError` where rays along a periodic axis never end.
    """
    # What no parameter moves is worked out now, even while JAX stages the rest.
    with nullcontext() if checks.is_traced((extinction, albedo)) else worked_out_now():
        return _make_transport(layout, quadrature, extinction, bands, beam, area, albedo)


def _make_transport(
    layout: Layout | Partition, quadrature: Quadrature, extinction, bands: int, beam: bool, area, albedo
) -> Transport:
    if not beam and layout.unfolding.axes:
        quadrature = quadrature.mirrored(layout.unfolding.axes)
    with worked_out_now():
        ordinates = mark_over(layout, make_ordinates(quadrature, bands, plane_size(layout), layout.wide))
    padded = None if extinction is None else _padded(layout, extinction)
    thickest = None
    if extinction is not None:
        thickest = _greatest(extinction)
        thickest = (thickest if checks.is_traced(thickest) else np.asarray(thickest)) * layout.spacing
    # Programs differ by these: where the extinction is not known yet, by the one that always serves.
    thin = thickest is not None and checks.surely(thickest * np.sqrt(3) <= thin_limit(thickest.dtype))
    thick = thickest is not None and not checks.surely(thickest <= THIN)
    if 0 in layout.pad:
        ordinates, longest = _count_laps(layout, ordinates, lax.stop_gradient(padded), _MOST_LAPS)
        if checks.surely(longest >= _MOST_LAPS):
            raise ValueError(
                f"boundary: some rays are still going after {_MOST_LAPS} laps of a periodic axis; expected every ray to meet "
                "a surface, an open side or an absorbing medium; close or open another side, or add absorption"
            )
    ones = lambda *shape: as_jax(np.ones((1 if extinction is None else bands, *shape), layout.real))
    links = None
    if area is not None and extinction is None and isinstance(layout, Layout) and worth_linking(layout, len(quadrature)):
        links = find_links(layout, ordinates)
    transport = Transport(layout, ordinates, padded, ones(), ones(), ones(), thin, thick and not beam, links=links)
    unit = stored(layout, Light(ones(layout.elements), None if extinction is None else ones(*layout.shape)))
    sums = uniform = _sums(transport, unit)
    if area is not None:
        if uniform.voxels is not None:
            transport = dataclasses.replace(transport, coverage=_first(uniform.voxels))
        factors, sums = _balance(transport, as_jax(area, layout.real), uniform)
        transport = dataclasses.replace(transport, factors=factors)
        if links is not None:  # those of voxels, of both in one sweep
            uniform, sums = _parted(_furnace(transport, _one_above_the_other(unit, factors)))
    assert sums.voxels is not None and uniform.voxels is not None
    fields = {"element_sums": sums.elements, "voxel_sums": sums.voxels, "coverage": _first(uniform.voxels)}
    transport = dataclasses.replace(transport, **fields)
    if thick and albedo is not None:
        if transport.factors is not None and transport.factors.voxels is not None:
            albedo = _times(albedo, transport.factors.voxels)
        transport = dataclasses.replace(transport, albedo=albedo, thin=False)
    return transport
