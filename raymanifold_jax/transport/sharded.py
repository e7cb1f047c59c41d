"""Sweeps over a lattice that is split over a mesh of devices: the same code on every block, and sums of what blocks see.

Within `shard_map` a `partition.Block` stands for the layout. Rays pass between blocks by `shift`; the scene is turned between
sweep axes by the block; values of elements are summed over the mesh at the end. No field is ever gathered on one device.

Public: `sweep_over`, `adjoint_over`, `laps_over`, `slopes_over`: `sweep`, `adjoint_sweep`, `count_laps` and `source_slopes`
of a `Layout` or a `Partition`; `mark_over`: `mark_hits`; `plane_size`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..layout import Layout, Ordinates
from ..partition import FIELD, SAME, Partition
from ..sharding import NAMES
from .characteristic import Inflow, SweptMedium, count_laps, sweep
from .marks import mark_hits
from .slopes import source_slopes
from .transpose import Adjoint, adjoint_sweep

_Marks = list[tuple[Array | None, Array | None]]


def plane_size(layout: Layout | Partition) -> int:
    """Voxels of the largest plane that a device sweeps."""
    return layout.largest_plane if isinstance(layout, Partition) else int(np.prod(sorted(layout.padded)[1:]))


def mark_over(layout: Layout | Partition, ordinates: tuple[Ordinates, ...]) -> tuple[Ordinates, ...]:
    if isinstance(layout, Partition):
        return layout.cut(mark_hits(layout.whole.value, ordinates))
    return mark_hits(layout, ordinates)


def sweep_over(
    layout: Layout | Partition,
    ordinates: tuple[Ordinates, ...],
    exitance: Float[Array, "C E"],
    medium: SweptMedium | None,
    inflow: Inflow | None,
    fluence: bool,
) -> tuple[Float[Array, "C E"], Float[Array, "C nx ny nz"] | None]:
    if isinstance(layout, Layout):
        return sweep(layout, ordinates, exitance, medium, inflow, fluence)

    def local(block, marks, medium, same):
        ordinates, exitance, inflow = same
        elements, voxels = sweep(block, _joined(ordinates, marks), exitance, medium, inflow, fluence)
        return lax.psum(elements, NAMES), voxels

    bare, marks = _parted(ordinates)
    return layout.on_blocks(local, marks, medium, (bare, exitance, inflow), (SAME, FIELD))


def adjoint_over(
    layout: Layout | Partition,
    ordinates: tuple[Ordinates, ...],
    at_elements: Float[Array, "C E"],
    in_voxels: Float[Array, "C nx ny nz"] | None,
    exitance: Float[Array, "C E"] | None,
    medium: SweptMedium | None = None,
    inflow: Inflow | None = None,
) -> Adjoint:
    if isinstance(layout, Layout):
        return adjoint_sweep(layout, ordinates, at_elements, in_voxels, exitance, medium, inflow)

    def local(block, marks, fields, same):
        ordinates, at_elements, exitance, inflow = same
        in_voxels, medium = fields
        found = adjoint_sweep(block, _joined(ordinates, marks), at_elements, in_voxels, exitance, medium, inflow)
        sums = lax.psum((found.exitance, found.radiance, found.factor), NAMES)
        return Adjoint(sums[0], found.source, found.slopes, found.extinction, sums[1], sums[2])

    bare, marks = _parted(ordinates)
    out = Adjoint(SAME, FIELD, FIELD, FIELD, SAME, SAME)  # pyright: ignore[reportArgumentType]
    return layout.on_blocks(local, marks, (in_voxels, medium), (bare, at_elements, exitance, inflow), out)


def laps_over(
    layout: Layout | Partition, ordinates: tuple[Ordinates, ...], extinction: Float[Array, "C X Y Z"] | None, most: int
) -> tuple[tuple[Ordinates, ...], Int[Array, ""]]:
    if isinstance(layout, Layout):
        return count_laps(layout, ordinates, extinction, most)
    bare, marks = _parted(ordinates)
    local = lambda block, _, extinction, ordinates: count_laps(block, ordinates, extinction, most)
    counted, longest = layout.on_blocks(local, (), extinction, bare, SAME)
    return _joined(counted, marks), longest


def slopes_over(layout: Layout | Partition, source: Array, albedo: Array, extinction: Array) -> tuple[Array, ...]:
    """Slopes, on the padded lattice, of a source and an albedo in the scene's voxels; see `source_slopes`."""
    if isinstance(layout, Layout):
        return source_slopes(layout, layout.to_padded(source), layout.to_padded(albedo), extinction)
    of_block: Any = lambda block, _, f, __: source_slopes(block, block.to_padded(f[0]), block.to_padded(f[1]), f[2])
    return layout.on_blocks(of_block, (), (source, albedo, extinction), (), FIELD)


def _parted(ordinates: tuple[Ordinates, ...]) -> tuple[tuple[Ordinates, ...], _Marks]:
    """What is the same on all devices, and the marks of hits, which are not."""
    marks: _Marks = [(own.hit_bits, own.probe_bits) for own in ordinates]
    return tuple(own.marked(None, None) for own in ordinates), marks


def _joined(ordinates: tuple[Ordinates, ...], marks: _Marks) -> tuple[Ordinates, ...]:
    return tuple(own.marked(*bits) for own, bits in zip(ordinates, marks, strict=True))
