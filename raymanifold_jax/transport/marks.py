"""Which directions have rays that arrive at each element in its own voxel: elsewhere its probe voxel is read.

Public: `mark_hits`.
"""

from __future__ import annotations

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int, UInt32

from ..layout import AXES, Layout, Ordinates, picked
from . import native
from .reading import arrival
from .step import chords_at, chunk_of


def mark_hits(layout: Layout, ordinates: tuple[Ordinates, ...]) -> tuple[Ordinates, ...]:
    """Note in the ordinates which directions have rays that arrive at each element in its own voxel.

    Rays that come out of a neighbouring voxel below that voxel's plane do not count. They were stopped there, where the
    neighbour's plane stands proud of a curved surface, and would darken the element.
    """

    found = []
    by_machine_code = native.serves(layout, ordinates, ())
    xp, hit_bits = (np, native.hit_bits) if by_machine_code else (jnp, _hit_bits)
    buried, plane, faces, cell = map(xp.asarray, (layout.buried, layout.plane, layout.face, layout.cell))
    planes = xp.where(buried, plane.dtype.type(-1), plane[0]).ravel(), *(plane[1 + a].ravel() for a in range(3))
    strides = (layout.padded[1] * layout.padded[2], layout.padded[2], 1)
    for axis, (own, reads) in enumerate(zip(ordinates, layout.reads, strict=True)):
        order = AXES[axis]
        geometry = planes[0], *(planes[1 + a] for a in order)
        a, u, v = order
        shape, padded = layout.padded_along(axis), (layout.pad[a] > 0, layout.pad[u] > 0, layout.pad[v] > 0)
        voxel = xp.unravel_index(cell, layout.padded)
        home = xp.stack([voxel[a] for a in order])
        face = faces[np.array([0, *(1 + a for a in order)])]
        if int(own.chunks) == 0:
            bits = np.zeros((own.weight.shape[0], -(-own.weight.shape[1] // 32), face.shape[1]), np.uint32)
        else:
            bits = hit_bits(geometry, np.array([strides[a] for a in order]), shape, padded, own, face, home)
        found.append(own.marked(*(picked(bits, r.image) for r in reads.kinds)))
    return tuple(found)


@eqx.filter_jit  # by axis: in a cubic lattice they share a program
def _hit_bits(
    geometry: tuple[Array, ...],
    strides: Int[np.ndarray, "3"],
    shape: tuple[int, int, int],
    padded: tuple[bool, ...],
    ordinates: Ordinates,
    face: Float[Array, "4 I"],
    home: Int[Array, "3 I"],
) -> UInt32[Array, "G words I"]:
    """For each element image, by its plane along (axis, u, v) and its own voxel; `geometry` is flat, with these `strides`."""
    if ordinates.weight.shape[0] == 0:
        return jnp.zeros((0, 1, face.shape[1]), jnp.uint32)
    count, height, width = shape

    def is_ghost(*place):
        return sum(((i == 0) | (i == n - 1)) & p for i, n, p in zip(place, shape, padded, strict=True)) > 0

    def one(chunk: Ordinates, face, home):
        plane, row, column = home
        face = tuple(component[None] for component in face)
        chords = chords_at(chunk, jnp.where(chunk.sign > 0, plane, count - 1 - plane), width, not padded[2])
        found, clean = False, True
        for number, ends in enumerate(chords.ends):
            hit = arrival(face, ends, chords.share[number][:, None, None])[0][:, 0, 0]
            offset = jnp.zeros_like(chords.offsets[0]) if number == 0 else chords.offsets[number - 1]
            along_v = jnp.where((jnp.abs(offset) == 1) & (width > 1), offset, 0)
            along_u = (offset - along_v) // width
            step = chunk.sign if number == 0 else 0
            before = (plane - step) % count, (row - along_u) % height, (column - along_v) % width
            flat = sum(i * stride for i, stride in zip(before, strides, strict=True))
            inside = [g[flat] for g in geometry]
            # The same point seen from the voxel before: one voxel further along the axis that is crossed.
            offset_type = ends[0][0].dtype
            back = (jnp.full_like(ends[0][0], step), along_u.astype(offset_type), along_v.astype(offset_type))
            e = [x + y for x, y in zip(ends[0], back, strict=True)]
            above = inside[0] + inside[1] * e[0] + inside[2] * e[1] + inside[3] * e[2]
            # Ghost voxels emit at their faces: what leaves them for the lattice has not been inside a solid.
            emitted = is_ghost(*before) & ~is_ghost(plane, row, column)
            found, clean = found | hit, clean & (~hit | (above > -1e-3) | emitted)
        flags = jnp.asarray(found & clean).astype(jnp.uint32)
        flags = jnp.pad(flags, (0, -flags.shape[0] % 32)).reshape(-1, 32)
        return jnp.sum(flags << jnp.arange(32, dtype=jnp.uint32), axis=1, dtype=jnp.uint32)

    def of_chunk(number):
        return jax.vmap(partial(one, chunk_of(ordinates, number)), in_axes=(1, 1), out_axes=1)(face, home)

    return lax.map(of_chunk, jnp.arange(ordinates.weight.shape[0]))
