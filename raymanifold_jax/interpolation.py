"""Irradiance between the surface elements.

Each element e carries its irradiance E_e and a slope g_e along the surface, fitted to its neighbours by least squares.
At a surface point x with normal n,

    E(x) = sum_e w_e (E_e + g_e . (x - x_e)) / sum_e w_e,      w_e = max(0, n . n_e)^4 product_i max(0, 1 - |x - x_e|_i)

over the elements in the 3 x 3 x 3 voxels around x, lengths in voxels: linear irradiance comes out exactly wherever the
fit sees it, at edges too, and no facet of a voxel shows. The result stays near the range of the values around it.

Public: `ElementTable`, `element_table`, `slopes`, `interpolate_irradiance`.
"""

from __future__ import annotations

import itertools
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .arrays import as_jax, real_dtype
from .scene import PERIODIC, Scene
from .surfaces import Surfaces
from .unfolding import in_blocks

_BLOCK = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
_RIDGE = 0.05  # voxels squared: slopes that less than this much spread supports fade
_LEAST = 1e-6  # share of elements out of reach, or facing elsewhere: only they count where there are no others
_BEYOND = 0.5  # of the range of the values around: as far as a result may leave it


class ElementTable(eqx.Module):
    """Which elements lie in the 3 x 3 x 3 voxels around each voxel.

    `row` is flat over the lattice; row 0 of `around` is empty, and -1 stands for no element.
    """

    row: Int[Array, " V"]
    around: Int[Array, "rows K"]
    position: Float[Array, "E 3"]  # voxel coordinates
    normal: Float[Array, "E 3"]


def element_table(scene: Scene, surfaces: Surfaces) -> ElementTable:
    """The elements of solids and walls by voxel; those of open sides are left out."""
    real = real_dtype()
    shape, number = np.asarray(scene.lattice.shape), max(len(surfaces), 1)
    kept = np.nonzero(~surfaces.open)[0]
    kept = kept[np.lexsort(surfaces.voxel[kept].T[::-1])]
    keys = []
    for step in _BLOCK:  # each time in order but for the rims: quick to sort
        beside = surfaces.voxel[kept] + step
        beside = np.where(scene.boundary.periodic, beside % shape, beside)
        inside = ((beside >= 0) & (beside < shape)).all(-1)
        keys.append(np.ravel_multi_index(tuple(beside[inside].T), tuple(shape)) * number + kept[inside])
    key = np.sort(np.concatenate(keys), kind="stable")
    # Once each, even where the voxels before and behind are the same one.
    cell, element = np.divmod(key[np.diff(key, prepend=-1) > 0], number)
    (first,) = np.nonzero(np.diff(cell, prepend=-1))
    count = np.diff(first, append=len(cell))
    around = np.full((len(first) + 1, max(count.max(initial=0), 1)), -1, np.int32)
    around[np.repeat(np.arange(1, len(first) + 1), count), np.arange(len(cell)) - np.repeat(first, count)] = element
    row = np.zeros(np.prod(shape), np.int32)
    row[cell[first]] = np.arange(1, len(first) + 1)
    position = (surfaces.position - scene.lattice.lower) / scene.lattice.spacing
    if not len(surfaces):
        position = np.zeros((1, 3))
    normal = surfaces.normal if len(surfaces) else np.zeros((1, 3))
    return ElementTable(as_jax(row), as_jax(around), as_jax(position, real), as_jax(normal, real))


def slopes(scene: Scene, table: ElementTable, values: Float[Array, "E C"]) -> Float[Array, "E C 3"]:
    """Slopes of `values` along the surface at each element, per voxel, from the neighbours within the 3 x 3 x 3 voxels."""
    return in_blocks(_slopes, (scene, table, values), (table.position, table.normal))


def _slopes(context, u: Array, normal: Array) -> Array:
    scene, table, values = context
    ahead = lambda vectors: tuple(vectors[:, axis, None] for axis in range(3))
    element, arms, facing = _seen(scene, table, _members(scene, table, u), ahead(u), ahead(normal))
    arm = jnp.stack(arms, -1)
    weight = facing * jnp.maximum(1.0 - jnp.sum(arm**2, -1) / 5.0, 0.0)
    total = jnp.maximum(weight.sum(1), 1e-20)
    around = values[element]
    mean = jnp.einsum("nk,nki->ni", weight, arm) / total[:, None]
    level = jnp.einsum("nk,nkc->nc", weight, around) / total[:, None]
    arm, around = arm - mean[:, None], around - level[:, None]
    spread = jnp.einsum("nk,nki,nkj->nij", weight, arm, arm) / total[:, None, None]
    moment = jnp.einsum("nk,nki,nkc->nic", weight, arm, around) / total[:, None, None]
    # Across the surface nothing is known: no slope there.
    return jnp.swapaxes(_solve(spread + _RIDGE * _square(normal) + 1e-2 * _RIDGE * jnp.eye(3), moment), 1, 2)


def _square(normal: Array) -> Array:
    return 100.0 * normal[:, :, None] * normal[:, None, :]


def _solve(a: Array, b: Array) -> Array:
    """a^-1 b for symmetric (n, 3, 3), by the adjugate: far quicker here than a general solver."""
    r = [jnp.cross(a[:, 1], a[:, 2]), jnp.cross(a[:, 2], a[:, 0]), jnp.cross(a[:, 0], a[:, 1])]
    determinant = jnp.sum(a[:, 0] * r[0], -1)
    return jnp.stack(r, 1) @ b / determinant[:, None, None]


def interpolate_irradiance(
    scene: Scene,
    table: ElementTable,
    values: Float[Array, "E C"],
    slope: Float[Array, "E C 3"],
    u: Float[Array, "n 3"],
    normal: Float[Array, "n 3"],
) -> Float[Array, "n C"]:
    """Irradiance at surface points in voxel coordinates (module docstring). 0 where no element is near."""
    members = _members(scene, table, u).T
    # One neighbour after the other: XLA takes a fifth longer for all at once.
    nothing = jnp.zeros((len(u), values.shape[1]), u.dtype)

    def add(number, state):
        weights, total, low, high = state
        element, (x, y, z), facing = _seen(scene, table, members[number], tuple(u.T), tuple(normal.T))
        squared = x**2 + y**2 + z**2
        overlap = (jnp.maximum(1.0 - jnp.abs(arm), 0.0) for arm in (x, y, z))
        weight = (facing * (math.prod(overlap) + _LEAST / (0.1 + squared) ** 3))[:, None]
        own, rise = values[element], slope[element]
        there = own - sum(rise[..., axis] * arm[:, None] for axis, arm in enumerate((x, y, z)))
        around = ((facing > 0.1) & (squared < 6.0))[:, None]
        low = jnp.minimum(low, jnp.where(around, own, jnp.inf))
        high = jnp.maximum(high, jnp.where(around, own, -jnp.inf))
        return weights + weight, total + weight * there, low, high

    begin = nothing[:, :1], nothing, nothing + jnp.inf, nothing - jnp.inf
    weights, total, low, high = lax.fori_loop(0, len(members), add, begin)
    result = total / jnp.maximum(weights, 1e-30)
    margin = _BEYOND * (high - low)
    result = jnp.where(high >= low, jnp.clip(result, low - margin, high + margin), result)
    return jnp.maximum(result, 0.0)


def _members(scene: Scene, table: ElementTable, u: Array) -> Int[Array, "n K"]:
    """The elements in the voxels around points; -1: none."""
    shape = np.asarray(scene.lattice.shape)
    home = jnp.clip(jnp.floor(u).astype(jnp.int32), 0, shape - 1)
    return table.around[table.row[home @ np.array([shape[1] * shape[2], shape[2], 1])]]


def _seen(
    scene: Scene, table: ElementTable, member: Array, u: tuple[Array, ...], normal: tuple[Array, ...]
) -> tuple[Array, tuple[Array, ...], Array]:
    """Of members: the element, x_e - x by coordinates, and how much it faces the same way. `u`, `normal`: of their points."""
    element = jnp.maximum(member, 0)
    position, outward = table.position[element], table.normal[element]
    arms = []
    for axis, kind in enumerate(scene.boundary.sides[::2]):
        arm = position[..., axis] - u[axis]
        if kind is PERIODIC:
            n = scene.lattice.shape[axis]
            arm = arm - n * jnp.round(arm / n)
        arms.append(arm)
    cosine = sum(outward[..., axis] * n for axis, n in enumerate(normal))
    return element, tuple(arms), jnp.where(member >= 0, jnp.maximum(cosine, 0.0) ** 4 + _LEAST, 0.0)
