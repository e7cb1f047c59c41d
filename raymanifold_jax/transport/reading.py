"""What the elements read of the rays in a plane: in their own voxel, or in their probe voxel where no rays arrive there.

Public: `Rows`, `each_rows`, `Crowd`, `Reading`, `read_rows`, `add_reads`, `mean_of_hits`, `mean_of_paths`, `arrival`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..layout import AxisReads, Ordinates, Reads
from ..windows import Windows
from .slopes import thickness
from .step import Chords, Fields, attenuate, facing, free_part, height_above, row_of, source_along, total_over

#: A ray counts as arriving at an element if it is at most this far (voxels) behind its plane where it enters the voxel: the
#: planes of neighbouring voxels on a curved surface do not join exactly.
BEHIND = 0.05
ONWARD = 2.0  # planes: how far radiance from a probe voxel is carried on at most
T = TypeVar("T")


class Rows(NamedTuple):
    """`count` rows of reads from `first` on, of which the first `used` count, if that is not None."""

    first: Int[Array, ""]
    count: int
    used: Int[Array, ""] | None

    def of(self, a: Array) -> Array:
        return lax.dynamic_slice_in_dim(a, self.first, self.count, axis=-1)

    def put(self, into: Array, values: Array) -> Array:
        return lax.dynamic_update_slice_in_dim(into, values, self.first, axis=-1)


def each_rows(
    reads: Reads,
    plane: Int[Array, ""],
    windows: Windows | None,
    one: Callable[[Rows, Any], Any],
    state: Any,
    rest: bool = False,
) -> Any:
    """`one(rows, state)` for the reads of a plane, tile by tile; with `windows` for the first of them, or for the `rest`."""
    begin, end = reads.first_tile[plane], reads.first_tile[plane + 1]
    if windows is None:
        return lax.fori_loop(begin, end, lambda tile, state: one(Rows(tile * reads.tile, reads.tile, None), state), state)
    start, used = begin * reads.tile, (end - begin) * reads.tile
    if rest:
        return one(Rows(start + windows.size, windows.rest, used - windows.size), state)
    return one(Rows(start, windows.size, used), state)


class Crowd(NamedTuple):
    """The crowded planes of `windows`, if there are any, and what is kept of each: rows of trees of arrays."""

    windows: Windows | None

    @property
    def count(self) -> int:
        return 0 if self.windows is None else self.windows.count

    def nothing(self, like: T) -> T | None:
        return jax.tree.map(lambda a: jnp.zeros((self.count + 1, *a.shape), a.dtype), like) if self.count else None

    def keep(self, kept: T | None, plane: Int[Array, ""], values: T) -> T | None:
        """Note the values of a plane, if it is a crowded one."""
        if self.windows is None or kept is None:
            return None
        slot = self.windows.slot[plane]
        return jax.tree.map(lambda into, a: lax.dynamic_update_index_in_dim(into, a, slot, 0), kept, values)

    def kept(self, kept: T | None, plane: Int[Array, ""], otherwise: T) -> T:
        """What was noted of a plane."""
        return otherwise if self.windows is None or kept is None else row_of(kept, self.windows.slot[plane])

    def each(self, one: Callable[[Int[Array, ""], T], T], state: T) -> T:
        """`one(plane, state)` for each of the crowded planes."""
        if self.windows is None or not self.count:
            return state
        planes = self.windows.crowded
        return lax.fori_loop(0, self.count, lambda which, state: one(planes[which], state), state)


class Reading(NamedTuple):
    """Elements that read voxels of a plane: which voxels, and what they read as a function of the light there."""

    cell: Int[Array, " T"]
    of_each: Callable  # (rays before each of three segments [D, C, T], voxels) -> by direction [D, C, T]
    value: Callable  # (rays before each of three segments [D, C, T], (exitance, source) [C, T]) -> [C, T]


def read_rows(rows: Rows, reads: Reads, bits, own: Ordinates, chords: Chords, plane: Fields, length, mean_of) -> Reading:
    """Weight * cosine * radiance of the elements of some rows, in the directions of `bits`."""
    cell, face = rows.of(reads.cell), tuple(rows.of(component) for component in (*reads.plane, reads.height))
    word, bit = np.divmod(np.arange(own.weight.shape[0]), 32)
    chosen = ((rows.of(bits)[word] >> bit[:, None].astype(np.uint32)) & 1).astype(length.dtype)
    wide = rows.used is not None
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
        return total_over(jnp.ones_like(own.weight), of_each(*light), wide)

    return Reading(cell, of_each, value)


def add_reads(
    sums: tuple[Array, Array],
    number: Int[Array, ""],
    reads: AxisReads,
    own: Ordinates,
    starts,
    chords: Chords,
    plane: Fields,
    length,
    rest: bool = False,
) -> tuple[Array, Array]:
    """Add what the elements that read voxels of plane `number` get, in their own voxels and in their probe voxels."""

    def added(sums, reads_of_kind: Reads, bits, mean_of):
        def one(rows: Rows, sums):
            read = read_rows(rows, reads_of_kind, bits, own, chords, plane, length, mean_of)
            total = read.value(tuple(ray[:, :, read.cell] for ray in starts), plane.cells(read.cell).sent)
            return rows.put(sums, rows.of(sums) + total)

        return each_rows(reads_of_kind, number, reads.windows, one, sums, rest)

    assert own.hit_bits is not None and own.probe_bits is not None  # by mark_hits
    hits, probes = sums
    return added(hits, reads.hits, own.hit_bits, mean_of_hits), added(probes, reads.probes, ~own.probe_bits, mean_of_paths)


def _along(direction: Float[Array, "D 3"], face: tuple) -> Float[Array, "D T"]:
    """w . n of each direction and element."""
    a, u, v = (direction[:, k, None] for k in range(3))
    return a * face[1] + u * face[2] + v * face[3]


def mean_of_hits(radiance, plane: Fields, face, chords: Chords, length) -> Float[Array, "D C T"]:
    """Mean radiance of the rays that arrive at the element in its own voxel; 0 where none does."""
    total = count = 0.0
    for number, ends in enumerate(chords.ends):
        share = chords.share[number][:, None, None]
        hit, part = arrival(face, ends, share)
        path = share * part
        end, _ = attenuate(radiance[number], plane, source_along(plane, chords, number, 0.0, path), length * path)
        total, count = total + jnp.where(hit, end, 0.0), count + hit
    return total / jnp.maximum(count, 1)


def mean_of_paths(radiance, plane: Fields, face, chords: Chords, length) -> Float[Array, "D C T"]:
    """Mean radiance of the free paths in the voxel; 0 where there are none.

    With `onward` carried on to the element's plane: in a thick medium it would be read half a voxel too deep.
    """
    total = paths = 0.0
    towards = -height_above((0.0, *face[1:4]), chords.step)
    # A step is as long as the rays' slant makes it.
    spacing = length / jnp.sqrt(sum(x**2 for x in chords.step))[:, None, None]
    lit = facing(plane, chords)
    for number, ends in enumerate(chords.ends):
        share = chords.share[number][:, None, None]
        free = free_part(lit, ends[0], share)
        start = jnp.where(free.behind, share - free.share, 0.0)
        source = source_along(plane, chords, number, start, free.share)
        _, mean = attenuate(jnp.where(free.behind, plane.exitance, radiance[number]), plane, source, length * free.share)
        if plane.onward:
            middle = start + free.share / 2
            height = height_above((face[4], *face[1:4]), ends[0]) - middle * towards
            onward = jnp.clip(height / jnp.maximum(towards, 1e-6), 0.0, ONWARD)
            onward = onward * thickness(plane.extinction * spacing)
            mean, _ = attenuate(mean, plane, source_along(plane, chords, number, middle, onward), length * onward)
        total, paths = total + free.share * mean, paths + free.share
    return jnp.where(paths > 1e-6, total / jnp.maximum(paths, 1e-6), 0.0)


def arrival(face: tuple, ends: tuple, share) -> tuple[Array, Array]:
    """Whether rays arrive at the element's plane in a segment, and the share of the segment before it."""
    g0, g1 = height_above(face, ends[0]), height_above(face, ends[1])
    hit = (g0 >= -BEHIND) & (g1 < 0) & (share > 0) & (g0 > g1)
    return hit, jnp.clip(g0 / jnp.maximum(g0 - g1, 1e-9), 0.0, 1.0)
