"""The step of the characteristic scheme: rays of many directions through one plane of voxels.

The equations are those of `characteristic`. Rays are [D, C, P]: directions, bands, voxels of the plane, flat. Each of the
three segments between two planes is one pass over all of them, in the voxel where the ray is then; between segments the rays
move on to their next voxels.

Public: `Track`, `Fields`, `Chords`, `chords_at`, `chord_table`, `chunk_of`, `row_of`, `total_over`, `facing`, `free_part`,
`source_along`, `attenuate`, `height_above`, `thin_limit`.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..layout import Ordinates
from ..shift import Ring, shift


def thin_limit(real) -> float:
    """Up to this optical length (1 - exp(-tau)) / tau comes by its series: as exact, at a third of an exponential's cost."""
    return 0.35 if jnp.finfo(real).bits <= 32 else 0.02


class Chords(NamedTuple):
    """The three segments of each direction's rays between two planes; [D] each, points relative to the voxel's centre."""

    ends: tuple  # ((e_axis, e_u, e_v) entry, the same exit) of each segment
    step: tuple  # (+-1, p, q): the way from one plane to the next
    share: tuple  # each segment's share of the step
    offsets: tuple  # flat moves after the first and the second segment


class Track(NamedTuple):
    """Everything the sweeps along one axis share."""

    fields: Fields
    occupied: Array  # [K] planes with surfaces other than ghost voxels at their rim
    rim: np.ndarray | Array  # [P] those ghost voxels
    count: int  # planes
    area: int  # voxels a plane
    width: int
    periodic: bool
    wrap_v: bool
    spacing: float
    ring: Ring | None = None  # where planes are split over devices
    wide: bool = False  # see `Layout`

    def length(self, own: Ordinates) -> Float[Array, " D"]:
        return self.spacing / jnp.abs(own.direction[:, 0])

    def plane(self, own: Ordinates, step: Int[Array, ""]) -> Int[Array, ""]:
        return jnp.where(own.sign > 0, step, self.count - 1 - step)

    def table(self, own: Ordinates, first: Int[Array, ""] | int) -> Chords:
        return chord_table(own, first, self.count, self.width, self.wrap_v)

    def cross(self, number: Int[Array, ""], rays, chords: Chords, length, entering, fluence: bool, sent=None):
        """Carry rays through plane `number`, of its own light or of what is `sent` instead; see `_cross`."""
        plane = row_of(self.fields, number)
        plane = plane if sent is None else plane.sending(sent)
        through = lambda cut: lambda: _cross(rays, chords, plane, length, entering, self, fluence, cut)
        if self.wide:
            return through(True)()
        return lax.cond(self.occupied[number], through(True), through(False))

    def uncross(self, number: Int[Array, ""], chords: Chords, length, entering, like: tuple, asked: tuple):
        """The transpose of `cross` in the rays, what is `sent` and the light that enters: `like` these three.

        `asked` are weights of what `cross` gives. `entering(light)` is linear.
        """
        plane = row_of(self.fields, number)
        through = lambda cut: lambda: _uncross(chords, plane, length, entering, self, cut, like, asked)
        if self.wide:
            return through(True)()
        return lax.cond(self.occupied[number], through(True), through(False))

    def lap(self, own: Ordinates, first: Int[Array, ""] | int, rays: Float[Array, "D C P"], entering) -> Float[Array, "D C P"]:
        """Carry rays once around a periodic axis; `entering(plane)` is what its open ghost voxels send in."""
        table = self.table(own, first)

        def step(k, rays):
            number = self.plane(own, k)
            return self.cross(number, rays, row_of(table, k), self.length(own), entering(number), False)[1]

        return lax.fori_loop(0, self.count, step, rays)


class Fields(eqx.Module):
    """Geometry (offset and normal), exitance, extinction and source of some planes, of one plane, or of voxels of one.

    Each is an array of its own: slices of one stacked array keep XLA from vectorising the step (20 times slower).
    """

    geometry: tuple[Array, ...]
    exitance: Array
    extinction: Array | None
    source: Array | None
    slopes: tuple[Array, ...] | None  # of the source along the sweep axis, u and v
    thin: bool = eqx.field(static=True)
    onward: bool = eqx.field(static=True)

    def cells(self, cells: Int[Array, " T"]) -> Fields:
        return jax.tree.map(lambda a: a[..., cells], self)

    @property
    def sent(self) -> tuple[Array, ...]:
        """What a sweep is linear in: the exitance, with a medium the source, and its slopes if it has any."""
        return (self.exitance, *(() if self.source is None else (self.source,)), *(self.slopes or ()))

    def sending(self, sent: tuple[Array, ...]) -> Fields:
        """The same geometry with other light and, if it comes last, other extinction."""
        if self.source is None:
            return dataclasses.replace(self, exitance=sent[0])
        end = 2 + len(self.slopes or ())
        extinction = sent[end] if len(sent) > end else self.extinction
        return dataclasses.replace(
            self, exitance=sent[0], source=sent[1], slopes=self.slopes and sent[2:end], extinction=extinction
        )


def row_of(table, index: Int[Array, ""]):
    """One row of each array."""
    return jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, index, 0, keepdims=False), table)


def chunk_of(ordinates: Ordinates, number: Int[Array, ""]) -> Ordinates:
    """One chunk of directions."""
    return jax.tree.map(lambda a: a[number] if a.ndim else a, ordinates)


def total_over(weight: Float[Array, " D"], values: Float[Array, "D C P"], wide: bool) -> Float[Array, "C P"]:
    """The sum over directions: as a product, which a CPU does faster, or one that can be part of what makes the values."""
    return (weight[:, None, None] * values).sum(0) if wide else jnp.tensordot(weight, values, 1)


def chord_table(own: Ordinates, first: Int[Array, ""] | int, count: int, width: int, wrap_v: bool) -> Chords:
    """The chords of a chunk for all planes of a sweep: worked out once, because XLA would do it again for every voxel."""
    return jax.vmap(lambda step: chords_at(own, step, width, wrap_v))(first + jnp.arange(count))


def chords_at(own: Ordinates, step: Int[Array, ""], width: int, wrap_v: bool) -> Chords:
    """Where each direction's rays cross voxel boundaries between plane `step` and the next, counted from their start."""

    def crossing(k):
        slope, here = own.slope[:, k], own.start[:, k] + step * own.slope[:, k]
        there = own.start[:, k] + (step + 1) * own.slope[:, k]
        moved = jnp.floor(there) - jnp.floor(here)
        place = here - jnp.floor(here)
        gap = jnp.where(moved > 0, 1 - place, place)
        when = jnp.where(moved == 0, 1.0, gap / jnp.maximum(jnp.abs(slope), 1e-30))
        return place - 0.5, slope, moved, jnp.clip(when, 0.0, 1.0)

    u, p, move_u, when_u = crossing(0)
    v, q, move_v, when_v = crossing(1)
    u_first = when_u <= when_v
    first, second = jnp.minimum(when_u, when_v), jnp.maximum(when_u, when_v)
    flat_u = (move_u * width).astype(jnp.int32)
    flat_v = jnp.zeros_like(flat_u) if wrap_v and width == 1 else move_v.astype(jnp.int32)
    sense = own.sign.astype(u.dtype)

    def point(time, crossed_u, crossed_v):
        e_u = u + p * time - jnp.where(crossed_u, move_u, 0.0)
        e_v = v + q * time - jnp.where(crossed_v, move_v, 0.0)
        return sense * (time - 0.5), jnp.clip(e_u, -0.5, 0.5), jnp.clip(e_v, -0.5, 0.5)

    zero, one = jnp.zeros_like(u), jnp.ones_like(u)
    never, always = jnp.zeros_like(u_first), jnp.ones_like(u_first)
    ends = (
        (point(zero, never, never), point(first, never, never)),
        (point(first, u_first, ~u_first), point(second, u_first, ~u_first)),
        (point(second, always, always), point(one, always, always)),
    )
    offsets = (jnp.where(u_first, flat_u, flat_v), jnp.where(u_first, flat_v, flat_u))
    return Chords(ends, (jnp.broadcast_to(sense, p.shape), p, q), (first, second - first, 1 - second), offsets)


def height_above(geometry: tuple, point: tuple) -> Float[Array, "D 1 P"]:
    """g = offset + n . e, the height above each voxel's surface plane, of each direction's point."""
    a, u, v = (x[:, None, None] for x in point)
    return geometry[0] + geometry[1] * a + geometry[2] * u + geometry[3] * v


class _Plane(NamedTuple):
    """Voxels and how the rays of each direction fall on their surfaces: n . step, and 1 over its magnitude, [D, 1, P]."""

    fields: Fields
    slope: Array
    steepness: Array


def facing(fields: Fields, chords: Chords) -> _Plane:
    slope = height_above((0.0, *fields.geometry[1:]), chords.step)
    return _Plane(fields, slope, 1 / (jnp.abs(slope) + 1e-20))


class _Free(NamedTuple):
    """The free part of a segment: whether it starts behind a surface, ends behind one, and its share of the step."""

    behind: Array
    arrives: Array
    share: Array


def free_part(plane: _Plane, start: tuple, share: Array) -> _Free:
    g0 = height_above(plane.fields.geometry, start)
    g1 = g0 + share * plane.slope
    # Of the way down from the higher end, the free part; all of it where both ends are free, nothing where both are not.
    free = jnp.minimum(jnp.maximum(g0, g1) * plane.steepness, share)
    return _Free(g0 < 0, g1 < 0, jnp.maximum(free, 0.0))


class _Source(NamedTuple):
    """The source function in the middle of a path, and how far it rises along it (None: it is constant)."""

    middle: Array
    rise: Array | None


def source_along(fields: Fields, chords: Chords, number: int, start, path) -> _Source | None:
    """The source along a part of segment `number`: from `start`, a share of the step counted from the segment's, on."""
    if fields.source is None or fields.slopes is None:
        return None if fields.source is None else _Source(fields.source, None)
    along = lambda point: sum(s * x[:, None, None] for s, x in zip(fields.slopes or (), point, strict=True))
    slope = along(chords.step)
    return _Source(fields.source + along(chords.ends[number][0]) + slope * (start + path / 2), slope * path)


def attenuate(radiance, plane: Fields, source: _Source | None, length):
    """Radiance at the end of a path and its mean over it, in the medium."""
    if plane.extinction is None or source is None:
        return radiance, radiance
    tau = plane.extinction * length
    mean = 1 - tau * (1 / 2 - tau * (1 / 6 - tau * (1 / 24 - tau * (1 / 120 - tau * (1 / 720 - tau * (1 / 5040))))))
    excess = radiance - source.middle
    if plane.thin:
        return radiance - tau * (mean * excess), source.middle + mean * excess
    transmittance = jnp.exp(-tau)
    limit = thin_limit(tau.dtype)
    thin = tau < limit
    mean = jnp.where(thin, mean, (1 - transmittance) / jnp.maximum(tau, limit))
    # The first form keeps the light a thin path adds, the second the light a thick one lets through.
    end = jnp.where(thin, radiance - tau * mean * excess, source.middle + transmittance * excess)
    average = source.middle + mean * excess
    if source.rise is not None:
        # A linear source adds ((1 + T) / 2 - mean) times its rise to the end, and takes 1 / tau of that from the average.
        series = tau * (1 / 12 - tau * (1 / 24 - tau * (1 / 80 - tau * (1 / 360 - tau * (1 / 2016 - tau * (1 / 13440))))))
        bend = jnp.where(thin, series, ((1 + transmittance) / 2 - mean) / jnp.maximum(tau, limit)) * source.rise
        end, average = end + tau * bend, average - bend
    return end, average


def _cross(rays, chords: Chords, fields: Fields, length, entering, track: Track, fluence: bool, cut: bool):
    """Carry rays [D, C, P] through one plane of voxels; also their radiance before each segment and their path means.

    Without `cut` the plane holds no surface but the ghost voxels at its rim.
    """
    starts, passing = [], None
    plane = facing(fields, chords) if cut else None
    for number in range(3):
        if number:
            rays = _moved(rays, chords.offsets[number - 1], track)
        starts.append(rays)
        rays, passed = _segment(number, rays, chords, fields, plane, length, entering, track, fluence)
        passing = passed if passing is None or passed is None else passing + passed
    return starts, rays, passing


def _uncross(chords: Chords, fields: Fields, length, entering, track: Track, cut: bool, like: tuple, asked: tuple):
    """The transpose of `_cross`, segment by segment: JAX's own, of the shifts, would be several times slower."""
    to_starts, rays, passing = asked
    plane, backs = facing(fields, chords) if cut else None, []
    # What is sent, of each direction for itself: summed as a product with ones, which XLA does vectorise.
    directions = len(rays)
    like = like[0], jax.tree.map(lambda a: jax.ShapeDtypeStruct((directions, *a.shape), a.dtype), like[1]), like[2]
    for number in (2, 1, 0):

        def segment(rays, sent, light, number=number):
            sending, lit = fields.sending(sent), plane and plane._replace(fields=fields.sending(sent))
            return _segment(number, rays, chords, sending, lit, length, entering(light), track, passing is not None)

        rays, *back = jax.linear_transpose(segment, *like)((rays, passing))
        backs.append(back)
        rays = rays + to_starts[number]
        if number:
            rays = _moved(rays, -chords.offsets[number - 1], track)
    sent, light = jax.tree.map(lambda *parts: sum(parts), *backs)
    return rays, jax.tree.map(lambda a: total_over(jnp.ones(directions, a.dtype), a, track.wide), sent), light


def _moved(rays, offsets, track: Track):
    # The barrier keeps XLA from computing the segment again for each reader of the moved rays.
    return shift(lax.optimization_barrier(rays), offsets, track.width, track.wrap_v, track.ring, track.wide)


def _segment(number: int, rays, chords: Chords, fields: Fields, plane: _Plane | None, length, entering, track, fluence: bool):
    """Carry rays through their segment `number` in a plane; also, with `fluence`, their path means there."""
    emitted = fields.exitance if entering is None else fields.exitance + entering
    share = chords.share[number][:, None, None]
    if plane is not None:
        free = free_part(plane, chords.ends[number][0], share)
        rays, path = jnp.where(free.behind, emitted, rays), free.share
    else:
        free, path = None, share
    start = 0.0 if free is None else jnp.where(free.behind, share - path, 0.0)
    source = source_along(fields, chords, number, start, path)
    end, mean = attenuate(rays, fields, source, length[:, None, None] * path)
    if fluence and source is not None and source.rise is not None and fields.source is not None:
        # The paths' middles are not all at the voxel's: what they are off counts as in linear light.
        mean = mean - (source.middle - fields.source)
    return jnp.where(track.rim if free is None else free.arrives, emitted, end), path * mean if fluence else None
