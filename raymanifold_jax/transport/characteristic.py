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

Public: `Characteristic`, `sweep`, `SweptMedium`, `Inflow`, `count_laps`, `thin_limit`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..layout import AXES, AxisReads, Layout, Ordinates, Reads
from ..partition import Block
from ..shift import Ring, shift
from .slopes import thickness

#: A ray counts as arriving at an element if it is at most this far (voxels) behind its plane where it enters the voxel: the
#: planes of neighbouring voxels on a curved surface do not join exactly.
_BEHIND = 0.05
_ONWARD = 2.0  # planes: how far radiance from a probe voxel is carried on at most


def thin_limit(real) -> float:
    """Up to this optical length (1 - exp(-tau)) / tau comes by its series: as exact, at a third of an exponential's cost."""
    return 0.35 if jnp.finfo(real).bits <= 32 else 0.02


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


class Chords(NamedTuple):
    """The three segments of each direction's rays between two planes; [D] each, points relative to the voxel's centre."""

    ends: tuple  # ((e_axis, e_u, e_v) entry, the same exit) of each segment
    step: tuple  # (+-1, p, q): the way from one plane to the next
    share: tuple  # each segment's share of the step
    offsets: tuple  # flat moves after the first and the second segment


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
        fields, occupied, images = _on_axis(axis, lambda a: _fields(layout, a, surface, medium, inflow is not None))
        track = _track(layout, axis if isinstance(axis, int) else 0, fields, occupied)
        strength = None if factor is None else _on_axis(axis, lambda a, field=factor: layout.planes(field, a))
        hits, probes, passing = _sweep_axis(track, own, reads, images, inflow, strength, fluence)
        at_elements = at_elements.at[:, reads.hits.element].add(hits).at[:, reads.probes.element].add(probes)
        if passing is not None:
            in_voxels = in_voxels + _on_axis(axis, lambda a: layout.from_planes(passing, a))
        return at_elements, in_voxels

    sums = (
        jnp.zeros((bands, layout.elements), exitance.dtype),
        jnp.zeros((bands, *layout.padded), exitance.dtype) if fluence else None,
    )
    if layout.cubic:  # one program for the three axes: less to compile
        directions = jax.tree.map(lambda *a: jnp.stack(a), *ordinates)
        reads = jax.tree.map(lambda *a: jnp.stack(a), *layout.reads)
        one = lambda axis, sums: one_axis(axis, _row(directions, axis), _row(reads, axis), sums)
        sums = lax.fori_loop(0, 3, one, sums)
    else:
        for axis in range(3):
            sums = one_axis(axis, ordinates[axis], layout.reads[axis], sums)
    at_elements, in_voxels = sums
    return at_elements, None if in_voxels is None else layout.from_padded(in_voxels)


def _on_axis(axis: int | Array, function: Callable[[int], Any]) -> Any:
    """`function` of a sweep axis that is known now, or only when the program runs."""
    if isinstance(axis, int):
        return function(axis)
    return lax.switch(axis, [lambda a=a: function(a) for a in range(3)])


class _Track(NamedTuple):
    """Everything the sweeps along one axis share."""

    fields: _Fields
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
        return _chord_table(own, first, self.count, self.width, self.wrap_v)

    def cross(self, number: Int[Array, ""], rays, chords: Chords, length, entering, fluence: bool, sent=None):
        """Carry rays through plane `number`, of its own light or of what is `sent` instead; see `_cross`."""
        plane = _row(self.fields, number)
        plane = plane if sent is None else plane.sending(sent)
        through = lambda cut: lambda: _cross(rays, chords, plane, length, entering, self, fluence, cut)
        if self.wide:
            return through(True)()
        return lax.cond(self.occupied[number], through(True), through(False))

    def uncross(self, number: Int[Array, ""], chords: Chords, length, entering, like: tuple, asked: tuple):
        """The transpose of `cross` in the rays, what is `sent` and the light that enters: `like` these three.

        `asked` are weights of what `cross` gives. `entering(light)` is linear.
        """
        plane = _row(self.fields, number)
        through = lambda cut: lambda: _uncross(chords, plane, length, entering, self, cut, like, asked)
        if self.wide:
            return through(True)()
        return lax.cond(self.occupied[number], through(True), through(False))

    def lap(self, own: Ordinates, first: Int[Array, ""] | int, rays: Float[Array, "D C P"], entering) -> Float[Array, "D C P"]:
        """Carry rays once around a periodic axis; `entering(plane)` is what its open ghost voxels send in."""
        table = self.table(own, first)

        def step(k, rays):
            number = self.plane(own, k)
            return self.cross(number, rays, _row(table, k), self.length(own), entering(number), False)[1]

        return lax.fori_loop(0, self.count, step, rays)


def _fields(layout: Layout | Block, axis: int, surface: Float[Array, "C X Y Z"], medium: SweptMedium | None, inflow: bool):
    """Everything on planes along a sweep axis.

    The fields, which planes hold surfaces, and with `inflow` the image numbers of open ghost voxels.
    """
    planes = lambda field, fill=0: layout.planes(field, axis, fill)
    fields = _Fields(
        geometry=(planes(layout.plane[0], -1), *(planes(layout.plane[1 + a]) for a in AXES[axis])),
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


def _track(layout: Layout | Block, axis: int, fields: _Fields, occupied: Array) -> _Track:
    count, height, width = layout.padded_along(axis)
    periodic, wrap_v = layout.pad[axis] == 0, layout.pad[AXES[axis][2]] == 0
    rim, ring = layout.rim(axis), layout.ring(axis)
    wrap_v = wrap_v and ring is None
    return _Track(fields, occupied, rim, count, height * width, width, periodic, wrap_v, layout.spacing, ring, layout.wide)


def _sweep_axis(
    track: _Track,
    ordinates: Ordinates,
    reads: AxisReads,
    images: Int[Array, "K P"] | None,
    inflow: Inflow | None,
    strength: Float[Array, "K C P"] | None,
    fluence: bool,
) -> tuple[Float[Array, "C M"], Float[Array, "C M2"], Float[Array, "K C P"] | None]:
    bands, real = track.fields.exitance.shape[1], track.fields.exitance.dtype

    def chunk_step(own: Ordinates, totals):
        radiance_in = None if inflow is None else inflow.radiance[:, own.index]
        table, length = track.table(own, 0), track.length(own)

        def entering(number):
            if images is None or radiance_in is None:
                return None
            radiance = _entering(_row(images, number), radiance_in)
            return radiance if strength is None else radiance * _row(strength, number)

        def plane_step(step, carry):
            rays, (hits, probes, mean) = carry
            number, chords = track.plane(own, step), _row(table, step)
            starts, rays, passing = track.cross(number, rays, chords, length, entering(number), fluence)
            if passing is not None:
                row = lax.dynamic_index_in_dim(mean, number, 0, keepdims=False)
                row = row + _total(own.weight, passing, track.wide)
                mean = lax.dynamic_update_index_in_dim(mean, row, number, 0)
            here = (own, starts, chords, _row(track.fields, number), length, track.wide)
            assert own.hit_bits is not None and own.probe_bits is not None  # by mark_hits
            hits = _read(hits, number, reads.hits, own.hit_bits, *here, _mean_of_hits)
            probes = _read(probes, number, reads.probes, ~own.probe_bits, *here, _mean_of_paths)
            return rays, (hits, probes, mean)

        rays = jnp.zeros((own.weight.shape[0], bands, track.area), real)
        if track.periodic:  # enough laps that what entered at the first no longer matters
            first = lambda number: (number - own.laps + 1) * track.count
            rays = lax.fori_loop(0, own.laps - 1, lambda number, r: track.lap(own, first(number), r, entering), rays)
        return lax.fori_loop(0, track.count, plane_step, (rays, totals))[1]

    totals = (
        jnp.zeros((bands, reads.hits.cell.shape[0]), real),
        jnp.zeros((bands, reads.probes.cell.shape[0]), real),
        jnp.zeros((track.count, bands, track.area), real) if fluence else None,
    )
    return each_chunk(ordinates, chunk_step, totals, track.wide)


def each_chunk(ordinates: Ordinates, add: Callable[[Ordinates, Any], Any], totals: Any, wide: bool) -> Any:
    """`add(chunk, totals)` one chunk of directions after the other; `wide`: two at a time, each of them to nothing."""
    if not wide or ordinates.weight.shape[0] < 2:
        return lax.fori_loop(0, ordinates.chunks, lambda number, totals: add(_chunk(ordinates, number), totals), totals)
    axes = jax.tree.map(lambda a: 0 if a.ndim else None, ordinates)
    nothing = jax.tree.map(jnp.zeros_like, totals)

    def two(number, totals):
        own = jax.tree.map(lambda a: lax.dynamic_slice_in_dim(a, 2 * number, 2) if a.ndim else a, ordinates)
        found = jax.vmap(lambda chunk: add(chunk, nothing), in_axes=(axes,))(own)
        return jax.tree.map(lambda total, more: total + more.sum(0), totals, found)

    return lax.fori_loop(0, (ordinates.chunks + 1) // 2, two, totals)


def _total(weight: Float[Array, " D"], values: Float[Array, "D C P"], wide: bool) -> Float[Array, "C P"]:
    """The sum over directions: as a product, which a CPU does faster, or one that can be part of what makes the values."""
    return (weight[:, None, None] * values).sum(0) if wide else jnp.tensordot(weight, values, 1)


def _chunk(ordinates: Ordinates, number: Int[Array, ""]) -> Ordinates:
    """One chunk of directions."""
    return jax.tree.map(lambda a: a[number] if a.ndim else a, ordinates)


def count_laps(
    layout: Layout | Block, ordinates: tuple[Ordinates, ...], extinction: Float[Array, "C X Y Z"] | None, most: int
) -> tuple[tuple[Ordinates, ...], Int[Array, ""]]:
    """How often rays must go around each periodic axis until less than 1e-6 of their light is left; and the most of these."""
    bands = 1 if extinction is None else extinction.shape[0]
    dark = jnp.zeros((bands, *layout.padded), layout.plane.dtype)
    medium = None if extinction is None else SweptMedium(extinction, dark)

    def chunk_laps(track: _Track, own: Ordinates):
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
            track = _track(layout, axis, *_fields(layout, axis, dark, medium, False)[:2])
            numbers = jnp.arange(own.weight.shape[0])
            laps = lax.map(lambda chunk, track=track, own=own: chunk_laps(track, _chunk(own, chunk)), numbers)
            own, longest = eqx.tree_at(lambda o: o.laps, own, laps), jnp.maximum(longest, laps.max())
        counted.append(own)
    return tuple(counted), longest


def _chord_table(own: Ordinates, first: Int[Array, ""] | int, count: int, width: int, wrap_v: bool) -> Chords:
    """The chords of a chunk for all planes of a sweep: worked out once, because XLA would do it again for every voxel."""
    return jax.vmap(lambda step: _chords(own, step, width, wrap_v))(first + jnp.arange(count))


def _row(table, index: Int[Array, ""]):
    """One row of each array."""
    return jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, index, 0, keepdims=False), table)


class _Fields(eqx.Module):
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

    def cells(self, cells: Int[Array, " T"]) -> _Fields:
        return jax.tree.map(lambda a: a[..., cells], self)

    @property
    def sent(self) -> tuple[Array, ...]:
        """What a sweep is linear in: the exitance, with a medium the source, and its slopes if it has any."""
        return (self.exitance, *(() if self.source is None else (self.source,)), *(self.slopes or ()))

    def sending(self, sent: tuple[Array, ...]) -> _Fields:
        """The same geometry with other light and, if it comes last, other extinction."""
        if self.source is None:
            return dataclasses.replace(self, exitance=sent[0])
        end = 2 + len(self.slopes or ())
        extinction = sent[end] if len(sent) > end else self.extinction
        return dataclasses.replace(
            self, exitance=sent[0], source=sent[1], slopes=self.slopes and sent[2:end], extinction=extinction
        )


def _chords(own: Ordinates, step: Int[Array, ""], width: int, wrap_v: bool) -> Chords:
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


def _height(geometry: tuple, point: tuple) -> Float[Array, "D 1 P"]:
    """g = offset + n . e, the height above each voxel's surface plane, of each direction's point."""
    a, u, v = (x[:, None, None] for x in point)
    return geometry[0] + geometry[1] * a + geometry[2] * u + geometry[3] * v


class _Plane(NamedTuple):
    """Voxels and how the rays of each direction fall on their surfaces: n . step, and 1 over its magnitude, [D, 1, P]."""

    fields: _Fields
    slope: Array
    steepness: Array


def _facing(fields: _Fields, chords: Chords) -> _Plane:
    slope = _height((0.0, *fields.geometry[1:]), chords.step)
    return _Plane(fields, slope, 1 / (jnp.abs(slope) + 1e-20))


class _Free(NamedTuple):
    """The free part of a segment: whether it starts behind a surface, ends behind one, and its share of the step."""

    behind: Array
    arrives: Array
    share: Array


def _free_part(plane: _Plane, start: tuple, share: Array) -> _Free:
    g0 = _height(plane.fields.geometry, start)
    g1 = g0 + share * plane.slope
    # Of the way down from the higher end, the free part; all of it where both ends are free, nothing where both are not.
    free = jnp.minimum(jnp.maximum(g0, g1) * plane.steepness, share)
    return _Free(g0 < 0, g1 < 0, jnp.maximum(free, 0.0))


class _Source(NamedTuple):
    """The source function in the middle of a path, and how far it rises along it (None: it is constant)."""

    middle: Array
    rise: Array | None


def _source(fields: _Fields, chords: Chords, number: int, start, path) -> _Source | None:
    """The source along a part of segment `number`: from `start`, a share of the step counted from the segment's, on."""
    if fields.source is None or fields.slopes is None:
        return None if fields.source is None else _Source(fields.source, None)
    along = lambda point: sum(s * x[:, None, None] for s, x in zip(fields.slopes or (), point, strict=True))
    slope = along(chords.step)
    return _Source(fields.source + along(chords.ends[number][0]) + slope * (start + path / 2), slope * path)


def _attenuate(radiance, plane: _Fields, source: _Source | None, length):
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


def _cross(rays, chords: Chords, fields: _Fields, length, entering, track: _Track, fluence: bool, cut: bool):
    """Carry rays [D, C, P] through one plane of voxels; also their radiance before each segment and their path means.

    Without `cut` the plane holds no surface but the ghost voxels at its rim.
    """
    starts, passing = [], None
    plane = _facing(fields, chords) if cut else None
    for number in range(3):
        if number:
            rays = _moved(rays, chords.offsets[number - 1], track)
        starts.append(rays)
        rays, passed = _segment(number, rays, chords, fields, plane, length, entering, track, fluence)
        passing = passed if passing is None or passed is None else passing + passed
    return starts, rays, passing


def _uncross(chords: Chords, fields: _Fields, length, entering, track: _Track, cut: bool, like: tuple, asked: tuple):
    """The transpose of `_cross`, segment by segment: JAX's own, of the shifts, would be several times slower."""
    to_starts, rays, passing = asked
    plane, backs = _facing(fields, chords) if cut else None, []
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
    return rays, jax.tree.map(lambda a: _total(jnp.ones(directions, a.dtype), a, track.wide), sent), light


def _moved(rays, offsets, track: _Track):
    # The barrier keeps XLA from computing the segment again for each reader of the moved rays.
    return shift(lax.optimization_barrier(rays), offsets, track.width, track.wrap_v, track.ring, track.wide)


def _segment(number: int, rays, chords: Chords, fields: _Fields, plane: _Plane | None, length, entering, track, fluence: bool):
    """Carry rays through their segment `number` in a plane; also, with `fluence`, their path means there."""
    emitted = fields.exitance if entering is None else fields.exitance + entering
    share = chords.share[number][:, None, None]
    if plane is not None:
        free = _free_part(plane, chords.ends[number][0], share)
        rays, path = jnp.where(free.behind, emitted, rays), free.share
    else:
        free, path = None, share
    start = 0.0 if free is None else jnp.where(free.behind, share - path, 0.0)
    source = _source(fields, chords, number, start, path)
    end, mean = _attenuate(rays, fields, source, length[:, None, None] * path)
    if fluence and source is not None and source.rise is not None and fields.source is not None:
        # The paths' middles are not all at the voxel's: what they are off counts as in linear light.
        mean = mean - (source.middle - fields.source)
    return jnp.where(track.rim if free is None else free.arrives, emitted, end), path * mean if fluence else None


def _entering(image: Int[Array, " P"], radiance: Float[Array, "images D C"]) -> Float[Array, "D C P"]:
    """Sky radiance emitted by the open ghost voxels of a plane."""
    total = jnp.zeros((*radiance.shape[1:], image.shape[0]), radiance.dtype)
    for number in range(radiance.shape[0]):
        total = total + jnp.where(image == number, radiance[number][..., None], 0.0)
    return total


class _ReadRows(NamedTuple):
    """`count` rows of reads from `first` on, of which the first `used` count, if that is not None."""

    first: Int[Array, ""]
    count: int
    used: Int[Array, ""] | None

    def of(self, a: Array) -> Array:
        return lax.dynamic_slice_in_dim(a, self.first, self.count, axis=-1)

    def put(self, into: Array, values: Array) -> Array:
        return lax.dynamic_update_slice_in_dim(into, values, self.first, axis=-1)


def each_rows(reads: Reads, plane: Int[Array, ""], wide: bool, one: Callable[[_ReadRows, Any], Any], state: Any) -> Any:
    """`one(rows, state)` for the reads of a plane: tile after tile, or (`wide`) at once, without those of others."""
    begin, end = reads.first_tile[plane], reads.first_tile[plane + 1]
    if wide:
        return one(_ReadRows(begin * reads.tile, reads.window, (end - begin) * reads.tile), state)
    return lax.fori_loop(begin, end, lambda tile, state: one(_ReadRows(tile * reads.tile, reads.tile, None), state), state)


class _Read(NamedTuple):
    """Elements that read voxels of a plane: which voxels, and what they read as a function of the light there."""

    cell: Int[Array, " T"]
    of_each: Callable  # (rays before each of three segments [D, C, T], voxels) -> by direction [D, C, T]
    value: Callable  # (rays before each of three segments [D, C, T], (exitance, source) [C, T]) -> [C, T]


def _read_rows(
    rows: _ReadRows, reads: Reads, bits, own: Ordinates, chords: Chords, plane: _Fields, length, wide: bool, mean_of
) -> _Read:
    """Weight * cosine * radiance of the elements of some rows, in the directions of `bits`."""
    cell, face = rows.of(reads.cell), tuple(rows.of(component) for component in (*reads.plane, reads.height))
    word, bit = np.divmod(np.arange(own.weight.shape[0]), 32)
    chosen = ((rows.of(bits)[word] >> bit[:, None].astype(np.uint32)) & 1).astype(length.dtype)
    if rows.used is not None:
        chosen = jnp.where(jnp.arange(rows.count) < rows.used, chosen, 0)
    weight = own.weight[:, None] * jnp.maximum(-_along(own.direction, face), 0.0) * chosen
    voxels = plane.cells(cell)

    def of_each(radiance, here):
        return weight[:, None] * mean_of(radiance, here, face, chords, length[:, None, None])

    def value(radiance, sent):
        # Gathered once, not anew for every use; and summed as a product with ones: XLA vectorises neither otherwise.
        light = radiance, voxels.sending(sent)
        light = light if wide else lax.optimization_barrier(light)
        return _total(jnp.ones_like(own.weight), of_each(*light), wide)

    return _Read(cell, of_each, value)


def _read(
    sums, plane_number, reads: Reads, bits, own: Ordinates, starts, chords: Chords, plane: _Fields, length, wide: bool, mean_of
):
    """Add what the elements that read voxels of this plane get."""

    def one(rows: _ReadRows, sums):
        read = _read_rows(rows, reads, bits, own, chords, plane, length, wide, mean_of)
        total = read.value(tuple(ray[:, :, read.cell] for ray in starts), plane.cells(read.cell).sent)
        return rows.put(sums, rows.of(sums) + total)

    return each_rows(reads, plane_number, wide, one, sums)


def _along(direction: Float[Array, "D 3"], face: tuple) -> Float[Array, "D T"]:
    """w . n of each direction and element."""
    a, u, v = (direction[:, k, None] for k in range(3))
    return a * face[1] + u * face[2] + v * face[3]


def _mean_of_hits(radiance, plane: _Fields, face, chords: Chords, length) -> Float[Array, "D C T"]:
    """Mean radiance of the rays that arrive at the element in its own voxel; 0 where none does."""
    total = count = 0.0
    for number, ends in enumerate(chords.ends):
        share = chords.share[number][:, None, None]
        hit, part = _hit(face, ends, share)
        path = share * part
        end, _ = _attenuate(radiance[number], plane, _source(plane, chords, number, 0.0, path), length * path)
        total, count = total + jnp.where(hit, end, 0.0), count + hit
    return total / jnp.maximum(count, 1)


def _mean_of_paths(radiance, plane: _Fields, face, chords: Chords, length) -> Float[Array, "D C T"]:
    """Mean radiance of the free paths in the voxel; 0 where there are none.

    With `onward` carried on to the element's plane: in a thick medium it would be read half a voxel too deep.
    """
    total = paths = 0.0
    towards = -_height((0.0, *face[1:4]), chords.step)
    # A step is as long as the rays' slant makes it.
    spacing = length / jnp.sqrt(sum(x**2 for x in chords.step))[:, None, None]
    facing = _facing(plane, chords)
    for number, ends in enumerate(chords.ends):
        share = chords.share[number][:, None, None]
        free = _free_part(facing, ends[0], share)
        start = jnp.where(free.behind, share - free.share, 0.0)
        source = _source(plane, chords, number, start, free.share)
        _, mean = _attenuate(jnp.where(free.behind, plane.exitance, radiance[number]), plane, source, length * free.share)
        if plane.onward:
            middle = start + free.share / 2
            height = _height((face[4], *face[1:4]), ends[0]) - middle * towards
            onward = jnp.clip(height / jnp.maximum(towards, 1e-6), 0.0, _ONWARD)
            onward = onward * thickness(plane.extinction * spacing)
            mean, _ = _attenuate(mean, plane, _source(plane, chords, number, middle, onward), length * onward)
        total, paths = total + free.share * mean, paths + free.share
    return jnp.where(paths > 1e-6, total / jnp.maximum(paths, 1e-6), 0.0)


def _hit(face: tuple, ends: tuple, share) -> tuple[Array, Array]:
    """Whether rays arrive at the element's plane in a segment, and the share of the segment before it."""
    g0, g1 = _height(face, ends[0]), _height(face, ends[1])
    hit = (g0 >= -_BEHIND) & (g1 < 0) & (share > 0) & (g0 > g1)
    return hit, jnp.clip(g0 / jnp.maximum(g0 - g1, 1e-9), 0.0, 1.0)
