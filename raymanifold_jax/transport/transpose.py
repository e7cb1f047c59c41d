"""The transposed sweep: from what is read at elements and voxels, back to what was sent.

A coordinate evolution is linear in the elements' exitance, the medium's source and the light that enters. Its transpose runs
the planes backwards: each plane first takes up what its elements and voxels ask for (the transposed reads), then hands the
rays on to the plane before. The step through one plane is the sweep's own, transposed by JAX; geometry and attenuation are
worked out again on the way, so that nothing is kept from a forward sweep.

In the extinction a sweep is not linear. Its derivative, for weights y of the results,

    d<y, sweep> / d extinction = sum over planes of  (adjoint rays) . d(step through the plane) / d extinction,

needs the rays as they were where they entered each plane: one chunk of directions is swept forwards once more, and its rays
are kept plane by plane: planes x chunk numbers, about one lattice's worth for each direction of a chunk. Around a periodic axis
every lap is reached from the start again: time grows with the square of the laps.

Public: `transposed_sweep`, `adjoint_sweep`, `Adjoint`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..layout import AXES, AxisReads, Layout, Ordinates, picked
from ..partition import Block
from .characteristic import (
    Inflow,
    SweptMedium,
    each_chunk,
    fields_along,
    on_axis,
    radiance_entering,
    track_along,
)
from .reading import Crowd, Rows, each_rows, mean_of_hits, mean_of_paths, read_rows
from .step import Track, row_of


class Adjoint(NamedTuple):
    """What the results' weights say of everything a sweep depends on; None for what was not asked."""

    exitance: Float[Array, "C E"]
    source: Float[Array, "C nx ny nz"] | None
    slopes: tuple[Float[Array, "C X Y Z"], ...] | None
    extinction: Float[Array, "C X Y Z"] | None
    radiance: Float[Array, "images n C"] | None  # of the inflow
    factor: Float[Array, "C E"] | None


def transposed_sweep(
    layout: Layout,
    ordinates: tuple[Ordinates, ...],
    at_elements: Float[Array, "C E"],
    in_voxels: Float[Array, "C nx ny nz"] | None,
    medium: SweptMedium | None = None,
    slopes_of: Callable[[Array], tuple[Array, ...]] | None = None,
) -> tuple[Float[Array, "C E"], Float[Array, "C nx ny nz"] | None]:
    """The transpose of `sweep` in (exitance, medium.source), applied to weights of its two results.

    <sweep(x), y> = <x, transposed_sweep(y)> to rounding. The source of `medium` and its slopes are not looked at;
    `slopes_of`, linear, makes them of the padded source where there are any.
    """
    if medium is not None:
        dark = jnp.zeros((at_elements.shape[0], *layout.padded), at_elements.dtype)
        medium = dataclasses.replace(medium, source=dark, slopes=None if slopes_of is None else (dark,) * 3)
    found = adjoint_sweep(layout, ordinates, at_elements, in_voxels, None, medium)
    if found.source is None or found.slopes is None or slopes_of is None:
        return found.exitance, found.source
    return found.exitance, found.source + layout.from_padded(jax.vjp(slopes_of, dark)[1](found.slopes)[0])


def adjoint_sweep(
    layout: Layout | Block,
    ordinates: tuple[Ordinates, ...],
    at_elements: Float[Array, "C E"],
    in_voxels: Float[Array, "C nx ny nz"] | None,
    exitance: Float[Array, "C E"] | None,
    medium: SweptMedium | None = None,
    inflow: Inflow | None = None,
) -> Adjoint:
    """The derivative of <weights, sweep(...)> in the exitance, the source, its slopes if it has any, and the light that enters.

    With `exitance` (what was sent), and `medium` as it was swept, also in the extinction and in the inflow's factor; the slopes
    stand for themselves there.
    """
    bands, real = at_elements.shape[0], at_elements.dtype
    whole, sloped = exitance is not None, medium is not None and medium.slopes is not None
    dark = jnp.zeros((bands, *layout.padded), real)
    sent = layout.exitance_field(exitance) if exitance is not None else dark
    asked = None if in_voxels is None else layout.to_padded(in_voxels)
    factor = None if inflow is None or inflow.factor is None else layout.exitance_field(inflow.factor)

    def one_axis(axis, own: Ordinates, reads: AxisReads, sums):
        fields, occupied, images = on_axis(axis, lambda a: fields_along(layout, a, sent, medium, inflow is not None))
        track = track_along(layout, axis if isinstance(axis, int) else 0, fields, occupied)
        planes = lambda field: None if field is None else on_axis(axis, lambda a: layout.planes(field, a))
        rows = tuple(picked(at_elements, r.element) for r in reads.kinds)
        entry = None if inflow is None else _Entry(images, inflow.radiance, planes(factor))
        back, light = _axis_adjoint(track, own, reads, rows, planes(asked), entry, whole)
        back = on_axis(axis, lambda a: [layout.from_planes(field, a) for field in _in_scene_order(back, a, sloped)])
        fields, total = sums
        return [t + f for t, f in zip(fields, back, strict=True)], None if light is None else total + light

    number = 1 + (medium is not None) * (1 + 3 * sloped + whole) + (whole and factor is not None)
    sums = ([dark] * number, None if inflow is None else jnp.zeros_like(inflow.radiance))
    if layout.cubic:
        directions = jax.tree.map(lambda *a: jnp.stack(a), *ordinates)
        reads = jax.tree.map(lambda *a: jnp.stack(a), *layout.reads)
        sums = lax.fori_loop(0, 3, lambda a, sums: one_axis(a, row_of(directions, a), row_of(reads, a), sums), sums)
    else:
        for axis in range(3):
            sums = one_axis(axis, ordinates[axis], layout.reads[axis], sums)
    fields, radiance = list(sums[0]), sums[1]
    strength = _at_elements(layout, fields.pop()) if whole and factor is not None else None
    curve = fields.pop() if whole and medium is not None else None
    return Adjoint(
        exitance=_at_elements(layout, fields[0]),
        source=None if medium is None else layout.from_padded(fields[1]),
        slopes=tuple(fields[2:]) if sloped else None,
        extinction=curve,
        radiance=radiance,
        factor=strength,
    )


def _in_scene_order(fields: list[Array], axis: int, sloped: bool) -> list[Array]:
    """Slopes along the sweep axis, u and v put in the order x, y, z; all else as it is."""
    if not sloped:
        return fields
    return [*fields[:2], *(fields[2 + AXES[axis].index(a)] for a in range(3)), *fields[5:]]


def _at_elements(layout: Layout | Block, field: Float[Array, "C X Y Z"]) -> Float[Array, "C E"]:
    """The transpose of `Layout.exitance_field`."""
    values = field.reshape(field.shape[0], -1)[:, layout.cell] * layout.share
    return jnp.zeros((field.shape[0], layout.elements), field.dtype).at[:, layout.source_element].add(values)


class _Entry(NamedTuple):
    """Light that enters: which mirror image each voxel of the planes belongs to, its radiance, and factors."""

    image: Array
    radiance: Array
    strength: Array | None


def _axis_adjoint(track: Track, ordinates: Ordinates, reads: AxisReads, rows, wanted, entry: _Entry | None, whole: bool):
    """Derivatives in planes [K, C, P] and in the radiance, of all chunks of one axis.

    The planes are of exitance, source, slopes, extinction and factor.
    """
    fields = track.fields
    bands, real = fields.exitance.shape[1], fields.exitance.dtype
    fluence = wanted is not None
    zero_row = jnp.zeros((bands, track.area), real)
    crowd = Crowd(reads.windows)
    has_medium = fields.extinction is not None
    kinds = len(fields.sent) + (has_medium and whole)
    has_factor = whole and entry is not None and entry.strength is not None

    def sent_row(number):
        """What the derivative is taken at."""
        if not whole:
            return (zero_row,) * kinds
        full = fields.sent if fields.extinction is None else (*fields.sent, fields.extinction)
        return tuple(row_of(f, number) for f in full)

    def add(planes, number, rows):
        at = lambda p: lax.dynamic_index_in_dim(p, number, 0, keepdims=False)
        return [lax.dynamic_update_index_in_dim(p, at(p) + r, number, 0) for p, r in zip(planes, rows, strict=True)]

    def chunk_step(own: Ordinates, totals):
        length = track.length(own)
        rays_shape = (own.weight.shape[0], bands, track.area)
        nothing = jnp.zeros(rays_shape, real)
        none_asked = (nothing,) * 3, (zero_row,) * kinds

        def entering(number, light):
            if entry is None or light is None:
                return None
            radiance = radiance_entering(row_of(entry.image, number), light[0])
            strength = light[1] if has_factor else None if entry.strength is None else row_of(entry.strength, number)
            return radiance if strength is None else radiance * strength

        def light_at(number):
            if entry is None:
                return None
            radiance = entry.radiance[:, own.index] if whole else jnp.zeros_like(entry.radiance[:, own.index])
            return (radiance, row_of(entry.strength, number)) if has_factor else (radiance,)

        def through(number, chords, with_passing, rays):
            """The step through a plane, and its pullback to rays, what is sent, and what enters."""

            def step(rays, sent, light):
                starts, rays, passing = track.cross(number, rays, chords, length, entering(number, light), with_passing, sent)
                return tuple(starts), rays, passing

            at = rays, sent_row(number), light_at(number)
            if not whole:  # linear: nothing of the way forwards is needed, nor kept
                return (), lambda asked: track.uncross(number, chords, length, partial(entering, number), at, asked)
            (starts, _, _), back = jax.vjp(step, *at)
            return starts, back

        def keep(totals, number, sent, light):
            planes, radiance = totals
            if light is not None:
                radiance = radiance.at[:, own.index].add(light[0])
                sent = (*sent, light[1]) if has_factor else sent
            return add(planes, number, sent), radiance

        def forwards(first, rays):
            """Rays where they enter each plane of a lap, in the order they are met."""
            table = track.table(own, first)

            def step(k, state):
                rays, entries = state
                number = track.plane(own, k)
                entries = lax.dynamic_update_index_in_dim(entries, rays, k, 0)
                light = entering(number, light_at(number))
                return track.cross(number, rays, row_of(table, k), length, light, False)[1], entries

            return lax.fori_loop(0, track.count, step, (rays, jnp.zeros((track.count, *rays_shape), real)))[1]

        def at_start(laps_before):
            """Rays at the start of a lap."""
            if not (whole and track.periodic):
                return nothing
            first = lambda n: (n - own.laps + 1) * track.count
            enter = lambda number: entering(number, light_at(number))
            return lax.fori_loop(0, laps_before, lambda n, r: track.lap(own, first(n), r, enter), nothing)

        def backwards(first, start, rays, totals, read):
            """Back through one lap, with what elements and voxels ask for if it is the last."""
            table = track.table(own, first)
            entries = forwards(first, start) if whole else None

            def ask_rest(number, of_rest):
                step = track.plane(own, number)  # the plane's number and the step's turn into each other
                chords = row_of(table, step)
                entered = nothing if entries is None else row_of(entries, step)
                starts, _ = through(number, chords, False, entered)
                return crowd.keep(of_rest, number, asked_at(number, chords, starts, none_asked, rest=True))

            of_rest = crowd.each(ask_rest, crowd.nothing(none_asked)) if read else None

            def plane_step(k, carry):
                rays, totals = carry
                step = track.count - 1 - k
                number, chords = track.plane(own, step), row_of(table, step)
                entered = nothing if entries is None else row_of(entries, step)
                starts, back = through(number, chords, read and fluence, entered)
                asked = crowd.kept(of_rest, number, none_asked)
                if read:
                    asked = asked_at(number, chords, starts, asked)
                passing = own.weight[:, None, None] * row_of(wanted, number)[None] if read and fluence else None
                to_starts, sent = asked
                rays, more, light = back((to_starts, rays, passing))
                sent = tuple(a + b for a, b in zip(sent, more, strict=True))
                return rays, keep(totals, number, sent, light)

            return lax.fori_loop(0, track.count, plane_step, (rays, totals))

        def asked_at(number, chords, starts, asked, rest=False):
            plane, at = row_of(fields, number), sent_row(number)
            assert own.hit_bits is not None and own.probe_bits is not None
            means = ((mean_of_hits, own.hit_bits), (mean_of_paths, ~own.probe_bits))
            for (mean_of, bits), where, values in zip(means, reads.kinds, rows, strict=True):

                def one(rows: Rows, asked, mean_of=mean_of, bits=bits, where=where, values=values):
                    read = read_rows(rows, where, bits, own, chords, plane, length, mean_of)
                    if whole:
                        here = tuple(ray[:, :, read.cell] for ray in starts), tuple(row[:, read.cell] for row in at)
                    else:
                        some = jnp.zeros((rays_shape[0], bands, rows.count), real)
                        here = (some,) * 3, (jnp.zeros((bands, rows.count), real),) * kinds
                    back = jax.vjp(read.value, *here)[1]
                    to_starts, to_sent = back(rows.of(values))
                    starts_sum, sent_sum = asked
                    starts_sum = tuple(s.at[:, :, read.cell].add(t) for s, t in zip(starts_sum, to_starts, strict=True))
                    return starts_sum, tuple(s.at[:, read.cell].add(t) for s, t in zip(sent_sum, to_sent, strict=True))

                asked = each_rows(where, number, reads.windows, one, asked, rest)
            return asked

        rays, totals = backwards(0, at_start(own.laps - 1), nothing, totals, True)
        if not track.periodic:
            return totals

        def lap(n, carry):
            rays, totals = carry
            return backwards(-(n + 1) * track.count, at_start(own.laps - 2 - n), rays, totals, False)

        return lax.fori_loop(0, own.laps - 1, lap, (rays, totals))[1]

    planes = [jnp.zeros((track.count, bands, track.area), real)] * (kinds + has_factor)
    radiance = None if entry is None else jnp.zeros_like(entry.radiance)
    # What is kept of a chunk is large: not of two at once.
    return each_chunk(ordinates, chunk_step, (planes, radiance), track.wide and not whole)
