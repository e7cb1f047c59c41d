"""The characteristic scheme: one plane at a time, exact in the cell.

Rays of one direction w cross the planes of the lattice along the axis where |w| is largest. From one plane to the next a ray
moves by the slopes (p, q) = (w_u, w_v) / |w_axis|, at most one voxel each, so it crosses at most one boundary along u and one
along v: three segments, whose lengths and end points are the same for all rays of the direction ("the same step
everywhere", Langer, Breton & Zucker 1995, section 4). Over the free part of a segment, of optical length tau,

    L' = S + (L - S) exp(-tau),    mean = S + (L - S) (1 - exp(-tau)) / tau,

with S the source function; the source of light scattered in thick voxels is linear instead (see `slopes`). A surface is the
plane g(e) = offset + n . e = 0 in its voxel, e from the voxel's centre: where g changes from + to - along a segment the ray
arrives at the surface and leaves as the surface's exitant radiance; where it changes from - to +, the free part begins at
the surface.

Public: `Characteristic`, `sweep`, `SweptMedium`, `Inflow`, `count_laps`; and `fields_along`, `track_along`, `on_axis`,
`each_chunk` and `radiance_entering` for its relatives.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..layout import AXES, AxisReads, Layout, Ordinates
from ..partition import Block
from .reading import Crowd, add_reads
from .step import Fields, Track, chunk_of, row_of, total_over


class Characteristic(eqx.Module):
    """The default scheme: exact chords, CUT voxels, any direction (see the module's docstring)."""


class SweptMedium(eqx.Module):
    """A medium on the padded lattice."""

    extinction: Float[Array, "C X Y Z"]  # 1 / scene unit
    source: Float[Array, "C X Y Z"]  # source function, W m^-2 sr^-1
    thin: bool = eqx.field(static=True, default=False)  # no path through a voxel is optically longer than `thin_limit`
    slopes: tuple[Float[Array, "C X Y Z"], ...] | None = None  # of the source along x, y, z, per voxel's side
    onward: bool = eqx.field(static=True, default=False)  # whether light read in probe voxels is carried on to the surface


class Inflow(eqx.Module):
    """Radiance entering open sides: by mirror image of the side and direction of the quadrature."""

    radiance: Float[Array, "images n C"]
    factor: Float[Array, "C E"] | None = None  # to be multiplied by, at each open element


def sweep(
    layout: Layout | Block,
    ordinates: tuple[Ordinates, ...],
    exitance: Float[Array, "C E"],
    medium: SweptMedium | None = None,
    inflow: Inflow | None = None,
    fluence: bool = True,
) -> tuple[Float[Array, "C E"], Float[Array, "C nx ny nz"] | None]:
    """One coordinate evolution over all six faces: the light that `exitance`, the medium's source and `inflow` send out.

    Returns the sums, over directions, of weight * cosine * radiance arriving at each element, and of weight * path share *
    radiance in each voxel (None without `fluence`). Divide by the same sums for a uniform radiance of 1 (the *furnace*) to
    get means: a furnace is then exact by construction.
    """
    bands = exitance.shape[0]
    surface = layout.exitance_field(exitance)
    factor = None if inflow is None or inflow.factor is None else layout.exitance_field(inflow.factor)

    def one_axis(axis, own: Ordinates, reads: AxisReads, sums):
        at_elements, in_voxels = sums
        fields, occupied, images = on_axis(axis, lambda a: fields_along(layout, a, surface, medium, inflow is not None))
        track = track_along(layout, axis if isinstance(axis, int) else 0, fields, occupied)
        strength = None if factor is None else on_axis(axis, lambda a, field=factor: layout.planes(field, a))
        (hits, probes), passing = _sweep_axis(track, own, reads, images, inflow, strength, fluence)
        at_elements = at_elements.at[:, reads.hits.element].add(hits).at[:, reads.probes.element].add(probes)
        if passing is not None:
            in_voxels = in_voxels + on_axis(axis, lambda a: layout.from_planes(passing, a))
        return at_elements, in_voxels

    sums = (
        jnp.zeros((bands, layout.elements), exitance.dtype),
        jnp.zeros((bands, *layout.padded), exitance.dtype) if fluence else None,
    )
    if layout.cubic:  # one program for the three axes: less to compile
        directions = jax.tree.map(lambda *a: jnp.stack(a), *ordinates)
        reads = jax.tree.map(lambda *a: jnp.stack(a), *layout.reads)
        one = lambda axis, sums: one_axis(axis, row_of(directions, axis), row_of(reads, axis), sums)
        sums = lax.fori_loop(0, 3, one, sums)
    else:
        for axis in range(3):
            sums = one_axis(axis, ordinates[axis], layout.reads[axis], sums)
    at_elements, in_voxels = sums
    return at_elements, None if in_voxels is None else layout.from_padded(in_voxels)


def on_axis(axis: int | Array, function: Callable[[int], Any]) -> Any:
    """`function` of a sweep axis that is known now, or only when the program runs."""
    if isinstance(axis, int):
        return function(axis)
    return lax.switch(axis, [lambda a=a: function(a) for a in range(3)])


def fields_along(layout: Layout | Block, axis: int, surface: Float[Array, "C X Y Z"], medium: SweptMedium | None, inflow: bool):
    """Everything on planes along a sweep axis.

    The fields, which planes hold surfaces, and with `inflow` the image numbers of open ghost voxels.
    """
    planes = lambda field, fill=0: layout.planes(field, axis, fill)
    surfaces = layout.plane
    fields = Fields(
        geometry=(planes(surfaces[0], -1), *(planes(surfaces[1 + a]) for a in AXES[axis])),
        exitance=planes(surface),
        extinction=None if medium is None else planes(medium.extinction),
        source=None if medium is None else planes(medium.source),
        slopes=None if medium is None or medium.slopes is None else tuple(planes(medium.slopes[a]) for a in AXES[axis]),
        thin=medium is not None and medium.thin,
        onward=medium is not None and medium.onward,
    )
    occupied = jnp.any((fields.geometry[0] != 1.0) & ~layout.rim(axis), axis=-1)
    occupied = layout.largest(occupied.astype(np.int32)) > 0  # all devices must go the same way
    return fields, occupied | _end_planes(layout, axis), planes(layout.inflow_image, -1) if inflow else None


def _end_planes(layout: Layout | Block, axis: int) -> np.ndarray:
    """The planes of ghost voxels before and behind all others."""
    number = np.arange(layout.padded_along(axis)[0])
    return (number < layout.pad[axis]) | (number >= len(number) - layout.pad[axis])


def track_along(layout: Layout | Block, axis: int, fields: Fields, occupied: Array) -> Track:
    count, height, width = layout.padded_along(axis)
    periodic, wrap_v = layout.pad[axis] == 0, layout.pad[AXES[axis][2]] == 0
    rim, ring = layout.rim(axis), layout.ring(axis)
    wrap_v = wrap_v and ring is None
    return Track(fields, occupied, rim, count, height * width, width, periodic, wrap_v, layout.spacing, ring, layout.wide)


def _sweep_axis(
    track: Track,
    ordinates: Ordinates,
    reads: AxisReads,
    images: Int[Array, "K P"] | None,
    inflow: Inflow | None,
    strength: Float[Array, "K C P"] | None,
    fluence: bool,
) -> tuple[tuple[Float[Array, "C M"], Float[Array, "C M2"]], Float[Array, "K C P"] | None]:
    bands, real = track.fields.exitance.shape[1], track.fields.exitance.dtype
    crowd = Crowd(reads.windows)

    def chunk_step(own: Ordinates, totals):
        radiance_in = None if inflow is None else inflow.radiance[:, own.index]
        table, length = track.table(own, 0), track.length(own)

        def entering(number):
            if images is None or radiance_in is None:
                return None
            radiance = radiance_entering(row_of(images, number), radiance_in)
            return radiance if strength is None else radiance * row_of(strength, number)

        def plane_step(step, carry):
            rays, reading, mean, kept = carry
            number, chords = track.plane(own, step), row_of(table, step)
            kept = crowd.keep(kept, number, rays)
            starts, rays, passing = track.cross(number, rays, chords, length, entering(number), fluence)
            if passing is not None:
                row = lax.dynamic_index_in_dim(mean, number, 0, keepdims=False)
                row = row + total_over(own.weight, passing, track.wide)
                mean = lax.dynamic_update_index_in_dim(mean, row, number, 0)
            reading = add_reads(reading, number, reads, own, starts, chords, row_of(track.fields, number), length)
            return rays, reading, mean, kept

        def read_rest(number, reading, kept):
            chords = row_of(table, track.plane(own, number))  # the plane's number and the step's turn into each other
            starts, _, _ = track.cross(number, crowd.kept(kept, number, rays), chords, length, entering(number), False)
            return add_reads(reading, number, reads, own, starts, chords, row_of(track.fields, number), length, rest=True)

        rays = jnp.zeros((own.weight.shape[0], bands, track.area), real)
        if track.periodic:  # enough laps that what entered at the first no longer matters
            first = lambda number: (number - own.laps + 1) * track.count
            rays = lax.fori_loop(0, own.laps - 1, lambda number, r: track.lap(own, first(number), r, entering), rays)
        reading, mean = totals
        _, reading, mean, kept = lax.fori_loop(0, track.count, plane_step, (rays, reading, mean, crowd.nothing(rays)))
        return crowd.each(lambda number, reading: read_rest(number, reading, kept), reading), mean

    totals = (
        tuple(jnp.zeros((bands, kind.cell.shape[0]), real) for kind in reads.kinds),
        jnp.zeros((track.count, bands, track.area), real) if fluence else None,
    )
    return each_chunk(ordinates, chunk_step, totals, track.wide)


def each_chunk(ordinates: Ordinates, add: Callable[[Ordinates, Any], Any], totals: Any, wide: bool) -> Any:
    """`add(chunk, totals)` one chunk of directions after the other; `wide`: two at a time, each of them to nothing."""
    count = ordinates.weight.shape[0]
    if not wide or count < 2 or count % 2:
        return lax.fori_loop(0, ordinates.chunks, lambda number, totals: add(chunk_of(ordinates, number), totals), totals)
    axes = jax.tree.map(lambda a: 0 if a.ndim else None, ordinates)
    nothing = jax.tree.map(jnp.zeros_like, totals)

    def two(number, totals):
        own = jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, 2 * number, 2) if a.ndim else a, ordinates)
        found = jax.vmap(lambda chunk: add(chunk, nothing), in_axes=(axes,))(own)
        return jax.tree.map(lambda total, more: total + more.sum(0), totals, found)

    return lax.fori_loop(0, (ordinates.chunks + 1) // 2, two, totals)


def count_laps(
    layout: Layout | Block, ordinates: tuple[Ordinates, ...], extinction: Float[Array, "C X Y Z"] | None, most: int
) -> tuple[tuple[Ordinates, ...], Int[Array, ""]]:
    """How often rays must go around each periodic axis until less than 1e-6 of their light is left; and the most of these."""
    bands = 1 if extinction is None else extinction.shape[0]
    dark = jnp.zeros((bands, *layout.padded), layout.real)
    medium = None if extinction is None else SweptMedium(extinction, dark)

    def chunk_laps(track: Track, own: Ordinates):
        def lap(state):
            number, rays, _ = state
            rays = track.lap(own, number * track.count, rays, lambda _: None)
            return number + 1, rays, layout.largest(jnp.max(rays))

        rays = jnp.where(own.weight[:, None, None] > 0, jnp.ones((1, bands, track.area), dark.dtype), 0.0)
        more = lambda state: (state[0] < most) & (state[2] > 1e-6)
        return lax.while_loop(more, lap, (jnp.int32(0), rays, jnp.max(rays)))[0] + 1

    counted, longest = [], jnp.int32(1)
    for axis, own in enumerate(ordinates):
        if layout.pad[axis] == 0 and own.weight.shape[0]:
            track = track_along(layout, axis, *fields_along(layout, axis, dark, medium, False)[:2])
            numbers = jnp.arange(own.weight.shape[0])
            laps = lax.map(lambda chunk, track=track, own=own: chunk_laps(track, chunk_of(own, chunk)), numbers)
            own, longest = eqx.tree_at(lambda o: o.laps, own, laps), jnp.maximum(longest, laps.max())
        counted.append(own)
    return tuple(counted), longest


def radiance_entering(image: Int[Array, " P"], radiance: Float[Array, "images D C"]) -> Float[Array, "D C P"]:
    """Sky radiance emitted by the open ghost voxels of a plane."""
    total = jnp.zeros((*radiance.shape[1:], image.shape[0]), radiance.dtype)
    for number in range(radiance.shape[0]):
        total = total + jnp.where(image == number, radiance[number][..., None], 0.0)
    return total
