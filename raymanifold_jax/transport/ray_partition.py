"""The nodes of the light-ray-cube scheme in blocks over a 2D mesh of devices.

Blocks are those of `partition`, of a lattice whose axes that are not periodic end in M inert nodes: so its ends can be joined,
and all blocks lie on a torus. Rays hop from block to block with a halo of M nodes (`shift.hop_around`). Values of SURFACE
nodes, which are lists on one device, are lists in blocks here: each device has those of its nodes, and zeros behind them.

`RayPartition` is the lattice as all devices together hold it, from outside; `RayBlock` is the part of one, within `shard_map`.
Both stand for a `ray_layout.RayLattice`.

Public: `RayPartition`, `RayBlock`, `NodeLists`, `make_ray_partition`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array, Float, Int

from ..layout import AXES, Unfolding
from ..partition import FIELD, SAME, TABLE, Shapes, Uncompared, put
from ..sharding import NAMES
from ..shift import Torus
from .ray_layout import Plane, RayLattice, in_order

LIST = Spec(None, NAMES)  # of lists of SURFACE nodes


class NodeLists:
    """Where each SURFACE node of the scene's list is in the lists of all devices, one after the other, `size` long."""

    def __init__(self, slot: np.ndarray, size: int):
        self.slot, self.size = slot, size


class _RayShapes(eqx.Module):
    """What is the same of the whole and of each block."""

    lattice: RayLattice
    shapes: Shapes

    @property
    def half_width(self) -> int:
        return self.lattice.half_width

    @property
    def spacing(self) -> float:
        return self.lattice.spacing

    @property
    def periodic(self) -> tuple[bool, bool, bool]:
        return self.lattice.periodic


class RayPartition(_RayShapes):
    """A `RayLattice` over a mesh; see the module's docstring."""

    kept: Uncompared = eqx.field(static=True)  # `NodeLists`

    @property
    def lists(self) -> NodeLists:
        return self.kept.value

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of stored fields."""
        return self.shapes.shape

    @property
    def padded(self) -> tuple[int, int, int]:
        return self.shapes.padded

    @property
    def largest_plane(self) -> int:
        """Nodes of the largest plane of a block."""
        return self.shapes.largest_plane

    def on_blocks(self, function: Callable, fields: Any, lists: Any, same: Any, out: Any) -> Any:
        """function(block, fields, lists, same) on every device, with its part of each; `out` are the results' specs."""
        local = lambda *parts: function(RayBlock(self.lattice, self.shapes), *parts)
        specs = (FIELD, LIST, SAME)
        return jax.shard_map(local, mesh=self.shapes.mesh, in_specs=specs, out_specs=out, check_vma=False)(fields, lists, same)

    @eqx.filter_jit
    def to_padded(self, field: Float[Array, "C nx ny nz"]) -> Float[Array, "C X Y Z"]:
        return self.on_blocks(lambda block, field, *_: block.shapes.to_padded(field), field, (), (), FIELD)

    @eqx.filter_jit
    def from_padded(self, field: Float[Array, "C X Y Z"]) -> Float[Array, "C nx ny nz"]:
        return self.on_blocks(lambda block, field, *_: block.shapes.from_padded(field), field, (), (), FIELD)

    def spread(self, values: Float[Array, "C S"], cell: Int[Array, "P I"]) -> Float[Array, "C nx ny nz"]:
        """Lists of SURFACE nodes as stored fields."""

        def local(block: RayBlock, _, lists, __):
            values, (cell,) = lists
            field = jnp.zeros((len(values), int(np.prod(block.shapes.shape_here))), values.dtype)
            return field.at[:, cell].set(values, mode="drop").reshape(-1, *block.shapes.shape_here)

        return self._with_cells(local, (), values, cell, FIELD)

    def collect(self, field: Float[Array, "C nx ny nz"], cell: Int[Array, "P I"]) -> Float[Array, "C S"]:
        """The inverse of `spread`."""

        def local(block: RayBlock, field, lists, _):
            (cell,) = lists[1]
            return field.reshape(len(field), -1).at[:, cell].get(mode="fill", fill_value=0)

        return self._with_cells(local, field, (), cell, LIST)

    def _with_cells(self, local: Callable, fields: Any, values: Any, cell: Array, out: Any) -> Any:
        run = lambda fields, values, cell: local(RayBlock(self.lattice, self.shapes), fields, (values, cell), ())
        specs = (FIELD, LIST, TABLE)
        return jax.shard_map(run, mesh=self.shapes.mesh, in_specs=specs, out_specs=out, check_vma=False)(fields, values, cell)


class RayBlock(_RayShapes):
    """One device's part of a partition, within `shard_map`."""

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of the scene: where the torus ends for light that comes in."""
        return self.lattice.shape

    @property
    def open(self) -> tuple[bool, ...]:
        return self.lattice.open

    @property
    def cubic(self) -> bool:
        return self.lattice.cubic

    @property
    def padded(self) -> tuple[int, int, int]:
        return self.shapes.padded_here

    def from_padded(self, field: Float[Array, "C X Y Z"]) -> Float[Array, "C nx ny nz"]:
        return self.shapes.from_padded(field)

    def plane(self, axis: int) -> Plane:
        """The planes of a sweep along an axis: this device's block of them."""
        lattice, (_, u, v) = self.lattice, AXES[axis]
        tables = [self.shapes.split(a, name) for a, name in zip((u, v), NAMES, strict=True)]
        height, width = (table.shape[1] for table in tables)
        used = [tuple(int(n) for n in (table >= 0).sum(1)) for table in tables]
        rows, columns = self.shapes.columns(axis)
        wraps, torus = lattice.periodic, Torus(height, width, *used)
        n, m = lattice.shape[axis], lattice.half_width
        return Plane(n, wraps[axis], wraps[u], wraps[v], m, height, width, 0, rows, columns, torus)

    def turned(self, field: Float[Array, "*C X Y Z"], face: int) -> Float[Array, "*C A U V"]:
        """A field with the face's axis first and its planes in the order in which rays meet them."""
        axis, lead = face // 2, field.ndim - 3
        field = self.shapes.turned(field, axis)
        field = field.transpose(*range(lead), *(lead + a for a in AXES[axis]))
        return in_order(field, self.lattice.shape[axis], face)

    def turned_back(self, field: Float[Array, "*C A U V"], face: int) -> Float[Array, "*C X Y Z"]:
        """The inverse of `turned`; what is in empty slots is left."""
        like = jax.ShapeDtypeStruct((*field.shape[:-3], *self.padded), field.dtype)
        return jax.linear_transpose(lambda field: self.turned(field, face), like)(field)[0]

    def largest(self, values: Array) -> Array:
        """Of all devices."""
        return lax.pmax(values, NAMES)


def make_ray_partition(lattice: RayLattice, mesh: Mesh, cell: np.ndarray) -> tuple[RayPartition, Int[Array, "P I"]]:
    """A lattice of nodes split over a mesh; and where its SURFACE nodes, at the flat indices `cell`, are on each device."""
    plain = Unfolding(((False,),) * 3)
    shapes = Shapes(mesh, plain, lattice.shape, lattice.padded, (0, 0, 0), lattice.spacing, 0)
    x, y, z = np.unravel_index(cell, lattice.shape)
    size = shapes.shape_here
    (i, x), (j, y) = np.divmod(x, size[0]), np.divmod(y, size[1])  # stored blocks are full, but for the last
    device, here = i * shapes.parts("v") + j, np.ravel_multi_index((x, y, z), size)
    counts = np.bincount(device, minlength=mesh.size)
    order = np.argsort(device, kind="stable")
    rank = np.empty(len(order), int)
    rank[order] = np.arange(len(order)) - np.repeat(np.cumsum(counts) - counts, counts)
    most = max(1, int(counts.max()))
    table = np.full((mesh.size, most), int(np.prod(size)), np.int32)  # beyond the end: dropped
    table[device, rank] = here
    return RayPartition(lattice, shapes, Uncompared(NodeLists(device * most + rank, table.size))), put(mesh, table, TABLE)
