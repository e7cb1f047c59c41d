"""The paper's coordinate evolution, differentiated: by the light that leaves nodes, and by the extinction that it crosses.

Along the slabs k of one chunk of directions rays change by

    R_k = (1 - d_k) (H R_{k-1}) + d_k S_k,      or the exitance where the ray meets a node that sends,

with H the hop: linear in exitance, source and sky, and smooth in the extinction that d_k depends on. What ray meets what is
fixed. Forwards JAX differentiates the sweep itself. Backwards it goes through the same steps in loops of known length, which
keep the rays that enter each slab (D rays a node, for one chunk of D directions at a time; chunks and steps are run again on
the way back). On a periodic axis they keep one slab a lap as well, for as many laps as there may be.

Public: `evolved`, `evolved_back`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from ..adjoint import with_adjoint
from ..partition import FIELD
from .light_ray_cube import LightRayCube, NodeFields, _edges, _own, _slabs, _Step, coordinate_evolution
from .ray_layout import Faces, RayLattice
from .ray_partition import RayBlock, RayPartition

Sky = Float[Array, "C n"]
Gather = Float[Array, "3 X Y Z"]
Results = tuple[Float[Array, "C nx ny nz"], Float[Array, "C nx ny nz"] | None]


def evolved(
    lattice: RayLattice | RayPartition, scheme: LightRayCube, fields: NodeFields, faces: Faces, sky: Sky | None,
    gather: Gather | None, fluence: bool,
) -> Results:  # fmt: skip
    """`coordinate_evolution`, with derivatives in exitance, source, extinction and sky."""
    how = _Evolution(lattice, scheme, fluence)
    return with_adjoint(how, _Adjoint(how))(fields, faces, sky, gather)


def evolved_back(
    lattice: RayLattice | RayPartition, scheme: LightRayCube, fields: NodeFields, faces: Faces, asked: Results
) -> tuple[Float[Array, "C X Y Z"], Float[Array, "C X Y Z"] | None]:
    """The transpose in exitance and source (None without a medium), padded, from weights of the sums."""
    how = _Evolution(lattice, scheme, asked[1] is not None)
    put = lambda exitance, source: dataclasses.replace(fields, exitance=exitance, source=source)
    moving = lambda exitance, source: how.taped(put(exitance, source), faces, None, None)
    return jax.vjp(moving, fields.exitance, fields.source)[1](asked)


@dataclasses.dataclass(frozen=True)
class _Evolution:
    lattice: RayLattice | RayPartition
    scheme: LightRayCube
    fluence: bool

    def __call__(self, fields: NodeFields, faces: Faces, sky: Sky | None, gather: Gather | None) -> Results:
        def evolution(lattice, fields, gather, faces, sky):
            return coordinate_evolution(lattice, fields, faces, self.scheme, sky, gather, self.fluence)

        return self._over(evolution, fields, faces, sky, gather)

    def taped(self, fields: NodeFields, faces: Faces, sky: Sky | None, gather: Gather | None) -> Results:
        """The same, in loops of known length that JAX can turn round."""
        return self._over(self._taped, fields, faces, sky, gather)

    def _over(self, evolution: Callable, fields: NodeFields, faces: Faces, sky: Sky | None, gather: Gather | None) -> Results:
        """On one device, or on all of a mesh."""
        if isinstance(self.lattice, RayLattice):
            return evolution(self.lattice, fields, gather, faces, sky)
        local = lambda block, fields, _, same: evolution(block, *fields, *same)
        return self.lattice.on_blocks(local, (fields, gather), (), (faces, sky), (FIELD, FIELD if self.fluence else None))

    def _taped(
        self, lattice: RayLattice | RayBlock, fields: NodeFields, gather: Gather | None, faces: Faces, sky: Sky | None
    ) -> Results:
        zeros = jnp.zeros((fields.exitance.shape[0], *lattice.padded), fields.exitance.dtype)
        sums = (zeros, zeros if self.fluence else None)
        for face in range(6):
            plane = lattice.plane(face // 2)
            slabs, edges = _slabs(lattice, plane, face, fields, gather), _edges(lattice, face)
            step = _Step(plane, slabs, edges, sky, self.scheme, lattice.spacing)
            found = _face(step, jax.tree.map(lambda a, f=face: a[f], faces), self._laps(lattice, face // 2), self.fluence)
            back = jax.tree.map(lambda s, f=face, p=plane: lattice.turned_back(p.unflat(s), f), found)
            sums = jax.tree.map(jnp.add, sums, back)
        arriving, seen = jax.tree.map(lattice.from_padded, sums)
        return arriving / jnp.pi, None if seen is None else seen / (4 * jnp.pi)

    @staticmethod
    def _laps(lattice: RayLattice | RayBlock, axis: int) -> int:
        """The most laps before the last along an axis; `count_laps` has the reason."""
        if not lattice.periodic[axis]:
            return 0
        shape = lattice.shape
        others = [n for n, wraps in zip(shape, lattice.periodic, strict=True) if not wraps]
        return -(-lattice.half_width * max(others or shape) // shape[axis]) + 1


@dataclasses.dataclass(frozen=True)
class _Adjoint:
    how: _Evolution

    def __call__(self, arguments: Any, wanted: Any, weights: Results) -> Any:
        fields, faces, sky, gather = arguments
        kept = fields.extinction if wanted[0].extinction else None

        def moving(exitance, source, extinction, sky):
            extinction = fields.extinction if extinction is None else extinction
            moved = dataclasses.replace(fields, exitance=exitance, source=source, extinction=extinction)
            return self.how.taped(moved, faces, sky, gather)

        exitance, source, extinction, sky = jax.vjp(moving, fields.exitance, fields.source, kept, sky)[1](weights)
        # Geometry stands for itself: nobody asks for its derivative.
        extinction = fields.extinction if extinction is None else extinction
        return dataclasses.replace(fields, exitance=exitance, source=source, extinction=extinction), faces, sky, gather


def _face(step: _Step, faces: Faces, laps: int, fluence: bool) -> tuple[Array, Array | None]:
    """Sums over a face's directions, on slabs."""
    slabs = jnp.arange(step.slabs.alive.shape[0])

    @jax.checkpoint  # one chunk's rays are kept at a time
    def chunk(number):
        own = _own(faces, number)
        around = step.around(own)
        sweep = jax.checkpoint(lambda rays, k: step(k, rays, own, around))

        def slab_step(rays, k):
            rays, arrives, there = sweep(rays, k)
            total = lambda values: jnp.tensordot(own.weight, values, 1)
            return rays, (total(arrives), total(there) if fluence else None)

        def lap(rays, number):
            ends = _lap(step, sweep, rays)
            return jnp.where(number < own.laps - 1, ends, rays), None

        rays = step.start(own, around.before)
        if laps:
            rays = lax.scan(jax.checkpoint(lap), rays, jnp.arange(laps))[0]
        return lax.scan(slab_step, rays, slabs)[1]

    def chunk_step(totals, number):
        return jax.tree.map(jnp.add, totals, chunk(number)), None

    zeros = jnp.zeros_like(step.slabs.exitance)
    return lax.scan(chunk_step, (zeros, zeros if fluence else None), jnp.arange(len(faces.laps)))[0]


def _lap(step: _Step, sweep: Any, rays: Array) -> Array:
    """`_Step.lap`, with steps that are run again on the way back."""

    def slab_step(carry, k):
        _, rays = carry
        return (rays, sweep(rays, k)[0]), None

    count, m = step.slabs.alive.shape[0], step.plane.half_width
    last_two = jnp.concatenate(lax.scan(slab_step, (rays, rays), jnp.arange(count))[0], axis=2)
    before = (jnp.arange(m) - m) % step.plane.planes
    return last_two[:, :, before - (count - 2) * m]
