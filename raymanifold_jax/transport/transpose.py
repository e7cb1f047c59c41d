"""The transposed sweep: from what is read at elements and voxels, back to what was sent.

A coordinate evolution is linear in the elements' exitance and the medium's source. Its transpose runs the planes backwards:
each plane first takes up what its elements and voxels ask for (the transposed reads), then hands the rays on to the plane
before. The step through one plane is the sweep's own, transposed by JAX; geometry and attenuation are worked out again on the
way, so that nothing is kept from a forward sweep.

Public: `transposed_sweep`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..layout import AXES, AxisReads, Layout, Ordinates
from .characteristic import (
    SweptMedium,
    _chunk,
    _fields,
    _from_planes,
    _mean_of_hits,
    _mean_of_paths,
    _on_axis,
    _planes,
    _read_tile,
    _row,
    _Track,
    _track,
)


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
    bands = at_elements.shape[0]
    dark = jnp.zeros((bands, *layout.padded), at_elements.dtype)
    asked = None if in_voxels is None else layout.to_padded(in_voxels)

    def one_axis(axis, own: Ordinates, reads: AxisReads, sums):
        fields, occupied, _ = _on_axis(axis, lambda a: _fields(layout, a, dark, medium, False))
        track = _track(layout, axis if isinstance(axis, int) else 0, fields, occupied)
        wanted = None if asked is None else _on_axis(axis, lambda a, field=asked: _planes(field, a))
        rows = tuple(at_elements[:, r.element] for r in reads)
        sent = _axis_transpose(track, own, reads, rows, wanted)
        back = _on_axis(axis, lambda a: [_from_planes(layout, a, field) for field in _in_scene_order(sent, a)])
        return [total + field for total, field in zip(sums, back, strict=True)]

    if medium is not None:
        medium = dataclasses.replace(medium, source=dark, slopes=None if slopes_of is None else (dark,) * 3)
    sums = [dark] if medium is None else [dark] * (2 if slopes_of is None else 5)
    if layout.cubic:
        directions = jax.tree.map(lambda *a: jnp.stack(a), *ordinates)
        reads = jax.tree.map(lambda *a: jnp.stack(a), *layout.reads)
        sums = lax.fori_loop(0, 3, lambda a, sums: one_axis(a, _row(directions, a), _row(reads, a), sums), sums)
    else:
        for axis in range(3):
            sums = one_axis(axis, ordinates[axis], layout.reads[axis], sums)
    exitance = jnp.zeros((bands, layout.elements), at_elements.dtype)
    exitance = exitance.at[:, layout.source_element].add(sums[0].reshape(bands, -1)[:, layout.cell] * layout.share)
    if medium is None:
        return exitance, None
    if slopes_of is not None:
        sums[1] = sums[1] + jax.vjp(slopes_of, dark)[1](tuple(sums[2:]))[0]
    return exitance, layout.from_padded(sums[1])


def _in_scene_order(sent: tuple[Array, ...], axis: int) -> list[Array]:
    """Slopes along the sweep axis, u and v put in the order x, y, z."""
    return [*sent[:2], *(sent[2 + AXES[axis].index(a)] for a in range(len(sent) - 2))]


def _axis_transpose(track: _Track, ordinates: Ordinates, reads: AxisReads, rows: tuple[Array, ...], wanted: Array | None):
    """What was sent (exitance and, with a medium, source and its slopes) in planes [K, C, P], of all chunks along one axis."""
    fields = track.fields
    bands, real = fields.exitance.shape[1], fields.exitance.dtype
    kinds_sent = len(fields.sent)
    fluence = wanted is not None
    zero_row = jnp.zeros((bands, track.area), real)

    def add(planes, number, rows):
        at = lambda p: lax.dynamic_index_in_dim(p, number, 0, keepdims=False)
        return tuple(lax.dynamic_update_index_in_dim(p, at(p) + r, number, 0) for p, r in zip(planes, rows, strict=True))

    def chunk_step(chunk, totals):
        own = _chunk(ordinates, chunk)
        table, length = track.table(own, 0), track.length(own)
        rays_shape = (own.weight.shape[0], bands, track.area)
        nothing = jnp.zeros(rays_shape, real)

        def through(number, chords, with_passing):
            """The step through a plane as a linear function of rays, exitance and source."""

            def step(rays, sent):
                starts, rays, passing = track.cross(number, rays, chords, length, None, with_passing, sent)
                return tuple(starts), rays, passing

            return jax.vjp(step, nothing, (zero_row,) * kinds_sent)[1]

        def plane_step(k, carry):
            rays, totals = carry
            step = track.count - 1 - k
            number, chords = track.plane(own, step), _row(table, step)
            plane = _row(fields, number)
            asked = ((nothing,) * 3, (zero_row,) * kinds_sent)
            assert own.hit_bits is not None and own.probe_bits is not None
            kinds = ((_mean_of_hits, own.hit_bits), (_mean_of_paths, ~own.probe_bits))
            for (mean_of, bits), where, values in zip(kinds, reads, rows, strict=True):

                def one(tile, asked, mean_of=mean_of, bits=bits, where=where, values=values):
                    read = _read_tile(tile, where, bits, own, chords, plane, length, mean_of)
                    starts, sent = asked
                    some = jnp.zeros((rays_shape[0], bands, where.tile), real)
                    back = jax.vjp(read.value, (some,) * 3, (jnp.zeros((bands, where.tile), real),) * len(sent))[1]
                    to_starts, to_sent = back(lax.dynamic_slice_in_dim(values, tile * where.tile, where.tile, axis=-1))
                    starts = tuple(s.at[:, :, read.cell].add(t) for s, t in zip(starts, to_starts, strict=True))
                    return starts, tuple(s.at[:, read.cell].add(t) for s, t in zip(sent, to_sent, strict=True))

                asked = lax.fori_loop(where.first_tile[number], where.first_tile[number + 1], one, asked)
            starts, sent = asked
            passing = None if wanted is None else own.weight[:, None, None] * _row(wanted, number)[None]
            rays, more = through(number, chords, fluence)((starts, rays, passing))
            return rays, add(totals, number, [a + b for a, b in zip(sent, more, strict=True)])

        rays, totals = lax.fori_loop(0, track.count, plane_step, (nothing, totals))
        if not track.periodic:
            return totals

        def lap(n, carry):
            table = track.table(own, -(n + 1) * track.count)

            def back(k, carry):
                rays, totals = carry
                step = track.count - 1 - k
                number = track.plane(own, step)
                rays, more = through(number, _row(table, step), False)(((nothing,) * 3, rays, None))
                return rays, add(totals, number, more)

            return lax.fori_loop(0, track.count, back, carry)

        return lax.fori_loop(0, own.laps - 1, lap, (rays, totals))[1]

    planes = jnp.zeros((track.count, bands, track.area), real)
    return lax.fori_loop(0, ordinates.chunks, chunk_step, (planes,) * kinds_sent)
