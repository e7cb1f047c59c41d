"""How the scattered light's source changes within thick voxels.

With the source constant in each voxel a step of optical depth t carries light too far by a share of about t: in thick media
light spreads too fast. So the source is taken to be linear there,

    S(x) = a (J + theta g . (x - centre)),    theta = 1 / (1 + 3 (1 - a) t^2),

with a the voxel's scattering albedo and g the difference of the mean radiance J between the voxels before and behind, from one
side only where the other holds nothing that scatters. J is continuous where coefficients are not. theta lets the slope go
where light dies out within a voxel, as it does with decrement sqrt(3 (1 - a)) t: a straight line would be negative there. CUT
voxels have no slope and lend none: their mean is one over an odd part of them. Nor have thin ones: see `thickness`.

Public: `source_slopes`, `thickness`, `flattening`, `THIN`.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..layout import Layout
from ..partition import Block

#: Optical depth of a voxel's side up to which light is taken to be the same all over it.
THIN = 0.1


def thickness(depth: Array) -> Array:
    """0 for optical depths of a voxel's side up to `THIN`, 1 from twice as much on."""
    return jnp.clip(depth / THIN - 1, 0.0, 1.0)


def flattening(depth: Array, albedo: Array) -> Array:
    """theta, and less of it in voxels that are nearly thin."""
    return thickness(depth) / (1 + 3 * jnp.maximum(1 - albedo, 0.0) * depth**2)


def source_slopes(
    layout: Layout | Block,
    source: Float[Array, "C X Y Z"],
    albedo: Float[Array, "C X Y Z"],
    extinction: Float[Array, "C X Y Z"],
) -> tuple[Float[Array, "C X Y Z"], ...]:
    """Slopes along x, y and z per voxel's side, on the padded lattice; linear in `source`.

    `albedo` is what the source is of J, factors included that balance the exchange of power.
    """
    scatters = (albedo > 0) & layout.free
    mean = jnp.where(scatters, source / jnp.where(scatters, albedo, 1.0), 0.0)
    strength = jnp.where(scatters, albedo * flattening(extinction * layout.spacing, albedo), 0.0)
    there = scatters.astype(source.dtype)
    slopes = []
    for axis in range(3):
        before, after = (layout.neighbour(mean, axis, step) for step in (-1, 1))
        has_before, has_after = (layout.neighbour(there, axis, step) for step in (-1, 1))
        both = has_before + has_after
        rise = has_after * (after - mean) + has_before * (mean - before)
        slopes.append(strength * rise / jnp.maximum(both, 1.0))
    return tuple(slopes)
