"""Moving rays to the neighbouring processing element: the only communication of a sweep."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int


def shift(values: Float[Array, "D C P"], offsets: Int[Array, " D"], width: int, wrap_v: bool) -> Float[Array, "D C P"]:
    """Move the rays of each direction by a flat offset: 0, +-1 (along v) or +-`width` (along u).

    Planes are flat with `width` voxels along v. Both ends are joined, so u is periodic as it stands; ghost voxels at the rim
    make that harmless where the domain is not. `wrap_v` joins the ends of each row as well.
    """
    moved = _roll(values, offsets, width)
    if not wrap_v or width == 1:
        return moved
    # A step along v across a row's end must come back in the same row.
    along_v = jnp.where(jnp.abs(offsets) == 1, offsets, 0)
    column = jnp.arange(values.shape[-1]) % width
    back = _roll(values, offsets - width * along_v, width)
    crossed = ((along_v[:, None] > 0) & (column == 0)) | ((along_v[:, None] < 0) & (column == width - 1))
    return jnp.where(crossed[:, None, :], back, moved)


def _roll(values: Float[Array, "D C P"], offsets: Int[Array, " D"], reach: int) -> Float[Array, "D C P"]:
    # One slice of a padded copy a direction: twice as fast on CPUs as rolls and selects.
    padded = jnp.concatenate([values[..., -reach:], values, values[..., :reach]], axis=-1)
    size = values.shape[-1]
    return jax.vmap(lambda row, offset: lax.dynamic_slice_in_dim(row, reach - offset, size, axis=1))(padded, offsets)


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
