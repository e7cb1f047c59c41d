"""Vacuum: who sees whom, found once, so that each bounce is a gather.

Where nothing attenuates, the radiance that a ray carries is that of the one surface it left. One coordinate evolution with the
numbers of surfaces in place of their radiance tells, for every element and direction, which these are; the sums of a sweep are
then

    sum over k of weight[k, m] * exitance[source[k, m]]

for each read m of an element, at most a few k a direction. A sweep costs N^3 steps a direction, this about one for each
element that light falls on, and its transpose is a scatter to the same places.

Public: `Links`, `find_links`, `worth_linking`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..arrays import as_jax
from ..layout import AxisReads, Layout, Ordinates, Reads
from ..memory import LINKS, MOST_LINKS
from . import native
from .characteristic import fields_along, track_along
from .cores import each_on_a_core
from .reading import Rows, each_rows, mean_of_hits, mean_of_paths, read_rows
from .step import Chords, Fields, Track, chunk_of, row_of

_NUMBERS = 1 << 24  # that 32-bit reals hold


class _Rows(eqx.Module):
    """The links of some reads: padded with weight 0."""

    source: Int[Array, "S M"]
    weight: Float[Array, "S M"]
    element: Int[Array, " M"]


class _List(eqx.Module):
    """The links one by one, element by element: found by machine code, and followed by it where numbers are known."""

    first: Int[Array, " E1"]
    source: Int[Array, " L"]
    weight: Float[Array, " L"]

    @property
    def parts(self) -> tuple[Array, Array, Array]:
        return self.first, self.source, self.weight


class Links(eqx.Module):
    """Sums at the elements of what other elements send, and their transpose."""

    rows: tuple[_Rows, ...] | _List
    # Voxels that send, numbered: of which elements what they send is made.
    element: Int[Array, " I"]
    share: Float[Array, " I"]
    number: Int[Array, " I"]
    numbers: int = eqx.field(static=True)
    elements: int = eqx.field(static=True)

    def arriving(self, exitance: Float[Array, "C E"]) -> Float[Array, "C E"]:
        """As `sweep`: sums over directions of weight * cosine * radiance arriving at each element."""
        if not isinstance(self.rows, _List) or not native.at_hand((self.rows, exitance)):
            return _arriving(self, exitance)
        share, number, element = np.asarray(self.share), np.asarray(self.number), np.asarray(self.element)
        voxels = [np.bincount(number, band[element] * share, self.numbers) for band in np.asarray(exitance)]
        return as_jax(native.follow(self.rows.parts, np.array(voxels)), exitance.dtype)

    def sent(self, asked: Float[Array, "C E"]) -> Float[Array, "C E"]:
        """The transpose of `arriving`."""
        if isinstance(self.rows, _List) and native.at_hand((self.rows, asked)):
            voxels = native.retrace(self.rows.parts, np.asarray(asked), self.numbers)
            share, number, element = np.asarray(self.share), np.asarray(self.number), np.asarray(self.element)
            found = [np.bincount(element, band[number] * share, self.elements) for band in voxels]
            return as_jax(np.array(found), asked.dtype)
        like = jax.ShapeDtypeStruct(asked.shape, asked.dtype)
        return jax.linear_transpose(lambda exitance: _arriving(self, exitance), like)(asked)[0]


@eqx.filter_jit
def _arriving(links: Links, exitance: Float[Array, "C E"]) -> Float[Array, "C E"]:
    bands = exitance.shape[0]
    voxels = jnp.zeros((bands, links.numbers), exitance.dtype)
    voxels = voxels.at[:, links.number].add(exitance[:, links.element] * links.share)
    sums = jnp.zeros((bands, links.elements), exitance.dtype)
    if isinstance(links.rows, _List):
        first, source, weight = lax.optimization_barrier(links.rows.parts)  # or XLA spends long on working this out ahead
        element = jnp.repeat(np.arange(links.elements), jnp.diff(first), total_repeat_length=len(source))
        return sums.at[:, element].add(weight * voxels[:, source], indices_are_sorted=True)
    for rows in links.rows:

        def add(total, link):
            source, weight = link
            return total + weight * voxels[:, source], None

        total = jnp.zeros((bands, rows.element.shape[0]), exitance.dtype)
        total, _ = lax.scan(add, total, (rows.source, rows.weight))
        sums = sums.at[:, rows.element].add(total)
    return sums


def worth_linking(layout: Layout, directions: int) -> bool:
    """Whether there are elements, and their links fit. A GPU has swept anew before links are found."""
    count = layout.cell.shape[0]
    return not layout.wide and 0 < count < _NUMBERS and LINKS * count * directions <= MOST_LINKS


def find_links(layout: Layout, ordinates: tuple[Ordinates, ...]) -> Links:
    """One sweep with numbers for radiance."""
    cell = np.asarray(layout.cell)
    sending, number = np.unique(cell, return_inverse=True)
    numbers = np.zeros(int(np.prod(layout.padded)), np.int32)
    numbers[sending] = np.arange(1, len(sending) + 1)
    numbers = numbers.reshape(layout.padded)
    if native.serves(layout, ordinates, ()):
        rows = _List(*map(as_jax, native.views(layout, ordinates, numbers)))
    else:
        rows = tuple(_swept_rows(layout, ordinates, numbers))
    return Links(
        rows=rows,
        element=layout.source_element,
        share=layout.share,
        number=as_jax(number + 1, np.int32),
        numbers=len(sending) + 1,
        elements=layout.elements,
    )


def _swept_rows(layout: Layout, ordinates: tuple[Ordinates, ...], numbers: Int[np.ndarray, "X Y Z"]) -> list[_Rows]:
    found: dict[tuple[int, int], list] = {}
    for view in _all_views(layout, ordinates, numbers):
        found.setdefault((view.axis, view.kind), []).append((view.read, view.source, view.weight))
    rows = []
    for (axis, kind), parts in found.items():
        row, source, weight = (np.concatenate(values) for values in zip(*parts, strict=True))
        if len(row):
            rows.append(_packed(row, source, weight, layout.reads[axis].kinds[kind].element))
    return rows


def _packed(row: np.ndarray, source: np.ndarray, weight: np.ndarray, element: Array) -> _Rows:
    """Links as a table with one column for each read that has some."""
    order = np.argsort(row, kind="stable")
    row, source, weight = row[order], source[order], weight[order]
    used, first, count = np.unique(row, return_index=True, return_counts=True)
    column = np.repeat(np.arange(len(used)), count)
    slot = np.arange(len(row)) - first[column]
    sources = np.zeros((count.max(), len(used)), np.int32)
    weights = np.zeros(sources.shape, weight.dtype)
    sources[slot, column], weights[slot, column] = source, weight
    return _Rows(as_jax(sources), as_jax(weights), element[used])


@eqx.filter_jit  # by axis: in a cubic lattice they share a program
def _views(track: Track, ordinates: Ordinates, chunk: Int[Array, ""], reads: AxisReads) -> tuple[tuple[Array, Array], ...]:
    """What the hits and the probes of one chunk see: numbers of voxels that send, 0 for none, and their weights.

    Hits [3 D, M] see by the rays before each of the three segments in a voxel, probes [4 D, M] the voxel's own surface as well.
    """
    own = chunk_of(ordinates, chunk)
    table, length = track.table(own, 0), track.length(own)
    dark = lambda _: None

    def plane_step(step, carry):
        rays, seen = carry
        number, chords = track.plane(own, step), row_of(table, step)
        starts, rays, _ = track.cross(number, rays, chords, length, None, False)
        plane = row_of(track.fields, number)
        assert own.hit_bits is not None and own.probe_bits is not None  # by mark_hits
        here = (own, starts, chords, plane, length)
        hits = _view(seen[0], number, reads.hits, own.hit_bits, *here, mean_of_hits)
        return rays, (hits, _view(seen[1], number, reads.probes, ~own.probe_bits, *here, mean_of_paths))

    def nothing(kind: Reads, kinds: int):
        shape = (kinds, own.weight.shape[0], kind.cell.shape[0])
        return jnp.zeros(shape, np.int32), jnp.zeros(shape, length.dtype)

    rays = jnp.zeros((own.weight.shape[0], 1, track.area), length.dtype)
    if track.periodic:
        first = lambda number: (number - own.laps + 1) * track.count
        rays = lax.fori_loop(0, own.laps - 1, lambda number, r: track.lap(own, first(number), r, dark), rays)
    _, seen = lax.fori_loop(0, track.count, plane_step, (rays, (nothing(reads.hits, 3), nothing(reads.probes, 4))))
    return jax.tree.map(lambda a: a.reshape(-1, a.shape[-1]), seen)


def _view(seen, plane_number, reads: Reads, bits, own: Ordinates, starts, chords: Chords, plane: Fields, length, mean_of):
    """Note what the elements that read voxels of this plane see."""

    def one(rows: Rows, seen):
        read = read_rows(rows, reads, bits, own, chords, plane, length, mean_of)
        rays = lax.optimization_barrier(tuple(ray[:, 0, read.cell] for ray in starts))
        sources = [*rays, jnp.broadcast_to(plane.exitance[:, read.cell], rays[0].shape)]
        # What is read is linear in the four: their weights are what it is for one of them alone.
        voxels, ones = plane.cells(read.cell), jnp.ones((1, rows.count), length.dtype)
        none = jnp.zeros((len(rays[0]), 1, rows.count), length.dtype)
        alone = [(tuple(none + (i == k) for i in range(3)), voxels.sending((ones * (k == 3),))) for k in range(4)]
        weights = [read.of_each(*light)[:, 0] for light in alone]
        write = lambda to, values: rows.put(to, jnp.stack(values[: len(to)]))
        return write(seen[0], [s.astype(np.int32) for s in sources]), write(seen[1], weights)

    return each_rows(reads, plane_number, None, one, seen)


def _all_views(layout: Layout, ordinates: tuple[Ordinates, ...], numbers: Int[np.ndarray, "X Y Z"]) -> Iterator[_View]:
    """In vacuum, chunk by chunk, which voxels' surfaces each read of an element sees, by their `numbers` (1 and up)."""
    codes = as_jax(numbers, layout.real)[None]
    for axis, (own, reads) in enumerate(zip(ordinates, layout.reads, strict=True)):
        if own.weight.shape[0] == 0:
            continue
        fields, occupied, _ = fields_along(layout, axis, codes, None, False)
        track = track_along(layout, axis, fields, occupied)

        def of_chunk(chunk: int, track=track, own=own, reads=reads, axis=axis) -> list[_View]:
            return [_seen(axis, *of_kind) for of_kind in enumerate(_views(track, own, jnp.int32(chunk), reads))]

        for seen in each_on_a_core(of_chunk, range(int(own.chunks)), "views", track, own, reads):
            yield from seen


class _View(NamedTuple):
    """What the `hits` (kind 0) or `probes` (kind 1) along a sweep axis see in some directions: one entry a link."""

    axis: int
    kind: int
    read: Int[np.ndarray, " L"]
    source: Int[np.ndarray, " L"]  # number of the voxel that sends
    weight: Float[np.ndarray, " L"]


def _seen(axis: int, kind: int, seen: tuple[Array, Array]) -> _View:
    source, weight = (np.asarray(a) for a in seen)
    place = np.nonzero((weight > 0) & (source > 0))
    return _View(axis, kind, place[1].astype(np.int32), source[place], weight[place])
