"""Moving rays to the neighbouring voxels: the only communication of a sweep.

On one device that is a local move. Where a plane is split in blocks over the mesh axes `u` and `v` (see `partition`), a block
gets the rim of its neighbours first, around a ring (the torus of the paper's machine). Rays of the light ray cube move by up to
M nodes at once and get a halo of M; where blocks are narrower than that it comes in several steps, from one block to the next.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


class Ring(NamedTuple):
    """A block of a plane on its device: its slots along u and v, how many from the first on are in use, and the mesh's size."""

    height: int
    width: int
    rows: Int[Array, ""]
    columns: Int[Array, ""]
    parts: tuple[int, int]


def shift(
    values: Float[Array, "D C P"],
    offsets: Int[Array, " D"],
    width: int,
    wrap_v: bool,
    ring: Ring | None = None,
    wide: bool = False,
) -> Float[Array, "D C P"]:
    """Move the rays of each direction by a flat offset: 0, +-1 (along v) or +-`width` (along u).

    Planes are flat with `width` voxels along v. Both ends are joined, so u is periodic as it stands; ghost voxels at the rim
    make that harmless where the domain is not. `wrap_v` joins the ends of each row as well. With a `ring` planes are split
    over the mesh, and both ends of both axes are joined. `wide`: for a GPU.
    """
    if ring is not None:
        return _shift_around(values, offsets, ring)
    if wide:
        return _picked(values, offsets, width, wrap_v)
    moved = _roll(values, offsets, width)
    if not wrap_v or width == 1:
        return moved
    # A step along v across a row's end must come back in the same row.
    along_v = jnp.where(jnp.abs(offsets) == 1, offsets, 0)
    column = jnp.arange(values.shape[-1]) % width
    back = _roll(values, offsets - width * along_v, width)
    crossed = ((along_v[:, None] > 0) & (column == 0)) | ((along_v[:, None] < 0) & (column == width - 1))
    return jnp.where(crossed[:, None, :], back, moved)


def _picked(values: Float[Array, "D C P"], offsets: Int[Array, " D"], width: int, wrap_v: bool) -> Float[Array, "D C P"]:
    """`shift` by index: no copies, and whoever reads the result may read through it."""
    cell = jnp.arange(values.shape[-1])
    source = cell - offsets[:, None]
    if wrap_v and width > 1:
        along_v = jnp.where(jnp.abs(offsets) == 1, offsets, 0)[:, None]
        crossed = ((along_v > 0) & (cell % width == 0)) | ((along_v < 0) & (cell % width == width - 1))
        source = jnp.where(crossed, source + width * along_v, source)
    source = source % values.shape[-1]
    return jnp.take_along_axis(values, source[:, None], axis=-1, mode="promise_in_bounds")


def _roll(values: Float[Array, "D C P"], offsets: Int[Array, " D"], reach: int) -> Float[Array, "D C P"]:
    # One slice of a padded copy a direction: twice as fast on CPUs as rolls and selects.
    padded = jnp.concatenate([values[..., -reach:], values, values[..., :reach]], axis=-1)
    size = values.shape[-1]
    return jax.vmap(lambda row, offset: lax.dynamic_slice_in_dim(row, reach - offset, size, axis=1))(padded, offsets)


def _shift_around(values: Float[Array, "D C P"], offsets: Int[Array, " D"], ring: Ring) -> Float[Array, "D C P"]:
    height, width = ring.height, ring.width
    plane = values.reshape(*values.shape[:2], height, width)
    around = jnp.pad(plane, ((0, 0), (0, 0), (1, 1), (1, 1)))
    for dim, used, name, parts in ((2, ring.rows, "u", ring.parts[0]), (3, ring.columns, "v", ring.parts[1])):
        before, after = _rims(plane, dim, used, name, parts)
        inside = [0, 0, 1, 1]
        inside[dim] = 0
        around = lax.dynamic_update_slice(around, before, inside)
        # Behind the last slot in use, which may be before the block's end.
        around = lax.dynamic_update_slice(around, after, [used + 1 if d == dim else start for d, start in enumerate(inside)])
    along_v = jnp.where(jnp.abs(offsets) == 1, offsets, 0)
    along_u = (offsets - along_v) // width
    one = lambda block, u, v: lax.dynamic_slice(block, (jnp.zeros_like(u), 1 - u, 1 - v), (block.shape[0], height, width))
    return jax.vmap(one)(around, along_u, along_v).reshape(values.shape)


def _rims(field: Array, dim: int, used: Int[Array, ""], name: str, parts: int) -> tuple[Array, Array]:
    """The last slice in use of the block before, and the first of the block behind, around the ring."""
    first = lax.slice_in_dim(field, 0, 1, axis=dim)
    last = lax.dynamic_slice_in_dim(field, used - 1, 1, axis=dim)
    if parts == 1:
        return last, first
    onwards = [(i, (i + 1) % parts) for i in range(parts)]
    return lax.ppermute(last, name, onwards), lax.ppermute(first, name, [(to, i) for i, to in onwards])


def neighbours(field: Array, dim: int, step: int, used: Int[Array, ""], name: str, parts: int) -> Array:
    """A field in blocks, moved by one slot (`step` of 1 or -1) along a dimension, around the ring."""
    before, after = _rims(field, dim, used, name, parts)
    size = field.shape[dim]
    around = jnp.concatenate([before, field, jnp.zeros_like(before)], dim)
    around = lax.dynamic_update_slice_in_dim(around, after, used + 1, dim)
    return lax.slice_in_dim(around, 1 - step, 1 - step + size, axis=dim)


def hop(
    rays: Float[Array, "D C M P"], hops: Int[Array, "D 2"], height: int, width: int, margin: int
) -> Float[Array, "D C M P"]:
    """Move the rays of each direction by its hop (p, q), at most M nodes either way, on a torus of `height` x `width` nodes.

    Planes are flat; each row has `margin` nodes more at both ends, M or none. Without them the torus is broken at the ends of
    rows: a ray that crosses one comes in again on the next row, which M inert nodes at the end of each row make harmless.
    """
    reach, stride = rays.shape[2], width + 2 * margin
    if margin:
        rows = rays.reshape(*rays.shape[:3], height, stride)[..., margin : margin + width]
        around = jnp.arange(-margin, width + margin) % width
        rays = rows[..., around].reshape(rays.shape)
    size, most = height * stride, reach * (stride + 1)
    if most <= size:
        padded = jnp.concatenate([rays[..., -most:], rays, rays[..., :most]], axis=-1)
    else:
        padded = rays[..., jnp.arange(-most, size + most) % size]
    offsets = hops[:, 0] * stride + hops[:, 1]
    return jax.vmap(lambda row, offset: lax.dynamic_slice_in_dim(row, most - offset, size, axis=-1))(padded, offsets)


class Torus(NamedTuple):
    """How a plane is split over the mesh axes `u` and `v`: the slots of a block, and how many each block has in use."""

    height: int
    width: int
    rows: tuple[int, ...]
    columns: tuple[int, ...]


def hop_around(rays: Float[Array, "D C M P"], hops: Int[Array, "D 2"], torus: Torus) -> Float[Array, "D C M P"]:
    """`hop` where planes are split over the mesh, without margins; within `shard_map`."""
    reach, height, width = rays.shape[2], torus.height, torus.width
    plane = rays.reshape(*rays.shape[:3], height, width)
    around = _halo(_halo(plane, 3, reach, torus.rows, "u"), 4, reach, torus.columns, "v")
    size = (*rays.shape[1:3], height, width)
    none = jnp.zeros_like(hops[0, 0])
    one = lambda block, hop: lax.dynamic_slice(block, (none, none, reach - hop[0], reach - hop[1]), size)
    return jax.vmap(one)(around, hops).reshape(rays.shape)


def halo_steps(sizes: Sequence[int], reach: int) -> list[int]:
    """The slices that a block passes on in each step, one way, for every block to get `reach`; blocks have 1 or more."""
    least, most = min(sizes), max(sizes)
    # Before step j + 1 a block has j others' slices, at least.
    return [min(most, reach - j * least) for j in range(-(-reach // least))] if len(sizes) > 1 else []


def _halo(field: Array, dim: int, reach: int, sizes: tuple[int, ...], name: str) -> Array:
    """A field in blocks with `reach` slices more at both ends of those in use; `sizes` are in use in the blocks of the ring."""
    slots, parts = field.shape[dim], len(sizes)
    if parts == 1:
        own = jnp.arange(-reach, slots + reach) % sizes[0]
        return jnp.take(field, own, axis=dim, unique_indices=False)
    here, used = lax.axis_index(name), jnp.asarray(sizes)
    put = lambda whole, part, at: lax.dynamic_update_slice_in_dim(whole, part, at, dim)
    room = reach + max(sizes)
    edge = [(room, room) if d == dim else (0, 0) for d in range(field.ndim)]
    around = jnp.pad(field, edge)
    begin, end = jnp.int32(room), room + used[here]
    steps = halo_steps(sizes, reach)
    before = lax.dynamic_slice_in_dim(around, end - steps[0], steps[0], dim)
    after = lax.slice_in_dim(field, 0, steps[0], axis=dim)
    onwards = [(i, (i + 1) % parts) for i in range(parts)]
    # A slot that is empty comes to lie where the next step's slices do.
    for step, count in enumerate(steps, 1):
        before = lax.ppermute(lax.slice_in_dim(before, before.shape[dim] - count, None, axis=dim), name, onwards)
        after = lax.ppermute(lax.slice_in_dim(after, 0, count, axis=dim), name, [(to, i) for i, to in onwards])
        around = put(put(around, before, begin - count), after, end)
        begin, end = begin - used[(here - step) % parts], end + used[(here + step) % parts]
    return lax.slice_in_dim(around, room - reach, room + slots + reach, axis=dim)
