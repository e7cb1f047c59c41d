"""A layout in blocks over a 2D mesh of devices: what each holds, and how the scene is turned between sweep axes.

Fields lie on the devices as blocks of x (over the mesh axis `u`) and y (over `v`), whole along z. The sweep along z uses them
as they are; the planes of the other two come by two all-to-alls each (Langer, Breton & Zucker 1995, section 7.1: the scene is
rotated), with [i/u] for "axis i split over u":

    along x:   [x/u, y/v, z]  ->  [x/u, y, z/v]  ->  [x, y/u, z/v]
    along y:   [x/u, y/v, z]  ->  [x, y/v, z/u]  ->  [x/v, y, z/u]

Two forms of a field are kept. A *stored* one is the scene's, with empty columns behind the others where sizes do not divide. A
*padded* one is that of `layout.Layout.padded`, unfolded and with ghost voxels, in even blocks, so that every block has columns
to pass on. Values of elements are the same on all devices; each adds up what its block sees of them.

`Partition` is the lattice as all devices together hold it, from outside; `Block` is the part of one, within `shard_map`. Both
stand for a `Layout`.

Public: `Partition`, `Block`, `make_partition`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array, Bool, Float, Int

from .blocks import even, full, make_moves, positions, take, unfolded
from .layout import AXES, AxisReads, Layout, Ordinates, Reads, Unfolding, exitance_in_voxels, flat_planes
from .sharding import NAMES
from .shift import Ring, neighbours

FIELD, TABLE, SAME = Spec(None, *NAMES), Spec(NAMES), Spec()  # of fields; with a row for each device; the same everywhere
SLOTS = (1, 2)  # at least, of a block along u and v: moves by one row and by one column of flat planes must differ


class _Tables(eqx.Module):
    """What each device knows of the elements; a row for each device."""

    cell: Int[Array, "P I"]
    source_element: Int[Array, "P I"]
    share: Float[Array, "P I"]
    reads: tuple[AxisReads, ...]


class _Fields(eqx.Module):
    """The geometry, as `Layout` has it, in padded blocks."""

    plane: Float[Array, "4 X Y Z"]
    buried: Bool[Array, "1 X Y Z"]
    inflow_image: Int[Array, "1 X Y Z"]


class Shapes(eqx.Module):
    """All that is known of a layout in blocks without its arrays."""

    mesh: Mesh = eqx.field(static=True)
    unfolding: Unfolding
    scene_shape: tuple[int, int, int] = eqx.field(static=True)
    lattice: tuple[int, int, int] = eqx.field(static=True)  # padded and unfolded, before it was split
    pad: tuple[int, int, int] = eqx.field(static=True)
    spacing: float = eqx.field(static=True)
    elements: int = eqx.field(static=True)

    def parts(self, name: str) -> int:
        return self.mesh.shape[name]

    def split(self, axis: int, name: str) -> Int[np.ndarray, "p s"]:
        """The padded columns of each block of an axis."""
        return even(self.lattice[axis], self.parts(name), SLOTS[NAMES.index(name)])

    def origin(self, axis: int) -> Int[np.ndarray, " N"]:
        """The scene's column that each padded one is an image of; -1: none."""
        columns = unfolded(self.scene_shape[axis], self.unfolding.blocks[axis], self.pad[axis])
        return np.pad(columns, (0, self.lattice[axis] - len(columns)), constant_values=-1)

    def stored(self, axis: int) -> Int[np.ndarray, "p s"]:
        return full(self.scene_shape[axis], self.parts(NAMES[axis]))

    @property
    def cubic(self) -> bool:
        return len(set(self.lattice)) == 1 and len(set(self.pad)) == 1

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of stored fields."""
        x, y = (self.stored(axis).size for axis in (0, 1))
        return x, y, self.scene_shape[2]

    @property
    def padded(self) -> tuple[int, int, int]:
        x, y = (self.split(axis, NAMES[axis]).size for axis in (0, 1))
        return x, y, self.lattice[2]

    @property
    def shape_here(self) -> tuple[int, int, int]:
        """Of a device's part of stored fields."""
        x, y = (self.stored(axis).shape[1] for axis in (0, 1))
        return x, y, self.scene_shape[2]

    @property
    def padded_here(self) -> tuple[int, int, int]:
        x, y = (self.split(axis, NAMES[axis]).shape[1] for axis in (0, 1))
        return x, y, self.lattice[2]

    @property
    def largest_plane(self) -> int:
        """Voxels of the largest plane of a block."""
        return max(self.split(u, "u").shape[1] * self.split(v, "v").shape[1] for _, u, v in AXES)

    def to_padded(self, field: Float[Array, "C nx ny nz"]) -> Float[Array, "C X Y Z"]:
        """A device's part, stored, of its own and other devices' parts, within `shard_map`."""
        for axis, name in enumerate(NAMES):
            origin = self.origin(axis)
            columns = self.split(axis, name)
            wanted = np.where(columns >= 0, origin[np.maximum(columns, 0)], -1)
            field = make_moves(name, self.stored(axis), wanted)(field, field.ndim - 3 + axis)
        return take(field, field.ndim - 1, self.origin(2))

    def from_padded(self, field: Float[Array, "C X Y Z"]) -> Float[Array, "C nx ny nz"]:
        """Sum over the images: the transpose of `to_padded`."""
        like = jax.ShapeDtypeStruct((*field.shape[:-3], *self.shape_here), field.dtype)
        return jax.linear_transpose(self.to_padded, like)(field)[0]

    def turned(self, field: Array, axis: int) -> Array:
        """All columns of the sweep axis, a block of the others, within `shard_map`; see the module's docstring."""
        if axis == 2:
            return field
        # The first all-to-all splits z over one mesh axis, the second completes the sweep axis over the other.
        over, then, middle = ("v", "u", 1) if axis == 0 else ("u", "v", 0)
        lattice, split = self.lattice, self.split
        x = field.ndim - 3
        field = take(field, x + 2, split(2, over).ravel())
        field = _all_to_all(field, over, x + 2, x + middle)
        place = np.append(positions(split(middle, over)), -1)
        field = take(field, x + middle, place[split(middle, then).ravel()])
        field = _all_to_all(field, then, x + middle, x + axis)
        place = positions(split(axis, then))
        assert len(place) == lattice[axis]
        return take(field, x + axis, place)

    def columns(self, axis: int) -> tuple[Array, Array]:
        """The padded rows and columns of the planes here, within `shard_map`; -1: none."""
        _, u, v = AXES[axis]
        return tuple(jnp.asarray(self.split(a, name))[lax.axis_index(name)] for a, name in zip((u, v), NAMES, strict=True))  # pyright: ignore[reportReturnType]


class Uncompared:
    """Something to keep beside arrays that programs do not depend on."""

    def __init__(self, value: Any):
        self.value = value

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Uncompared)

    def __hash__(self) -> int:
        return 0


class _InBlocks(eqx.Module):
    """What a `Layout` says of itself that is the same of all blocks and of each."""

    shapes: Shapes
    fields: _Fields
    tables: _Tables

    @property
    def unfolding(self) -> Unfolding:
        return self.shapes.unfolding

    @property
    def pad(self) -> tuple[int, int, int]:
        return self.shapes.pad

    @property
    def spacing(self) -> float:
        return self.shapes.spacing

    @property
    def elements(self) -> int:
        return self.shapes.elements

    @property
    def plane(self) -> Float[Array, "4 X Y Z"]:
        return self.fields.plane

    @property
    def real(self) -> np.dtype:
        return np.dtype(self.fields.plane.dtype)

    @property
    def free(self) -> Bool[Array, "X Y Z"]:
        return self.plane[0] == 1.0

    @property
    def wide(self) -> bool:
        """Not so: rays also cross from block to block."""
        return False

    @property
    def buried(self) -> Bool[Array, "X Y Z"]:
        return self.fields.buried[0]


class Partition(_InBlocks):
    """A `Layout` over a mesh; see the module's docstring."""

    whole: Uncompared = eqx.field(static=True)  # the `Layout`, from which directions are prepared

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of stored fields."""
        return self.shapes.shape

    @property
    def padded(self) -> tuple[int, int, int]:
        return self.shapes.padded

    @property
    def largest_plane(self) -> int:
        return self.shapes.largest_plane

    def on_blocks(self, function: Callable, tables: Any, fields: Any, same: Any, out: Any) -> Any:
        """function(block, tables, fields, same) on every device, with its part of each; `out` are the results' specs."""

        def local(own_tables, own_fields, tables, fields, same):
            row = lambda tree: jax.tree.map(lambda a: a[0], tree)
            return function(Block(self.shapes, own_fields, row(own_tables)), row(tables), fields, same)

        specs = (TABLE, FIELD, TABLE, FIELD, SAME)
        run = jax.shard_map(local, mesh=self.shapes.mesh, in_specs=specs, out_specs=out, check_vma=False)
        return run(self.tables, self.fields, tables, fields, same)

    @eqx.filter_jit
    def to_padded(self, field: Float[Array, "C nx ny nz"]) -> Float[Array, "C X Y Z"]:
        return self.on_blocks(lambda block, _, field, __: block.to_padded(field), (), field, (), FIELD)

    @eqx.filter_jit
    def from_padded(self, field: Float[Array, "C X Y Z"]) -> Float[Array, "C nx ny nz"]:
        return self.on_blocks(lambda block, _, field, __: block.from_padded(field), (), field, (), FIELD)

    def place(self, field: np.ndarray) -> Float[Array, "nx ny nz"]:
        """A known field in the shape of stored ones."""
        return put(self.shapes.mesh, np.asarray(field, self.real), Spec(*NAMES))

    def cut(self, ordinates: tuple[Ordinates, ...]) -> tuple[Ordinates, ...]:
        """Directions whose hits are marked on the whole layout, as blocks read them; the same on all devices but for marks."""
        whole: Layout = self.whole.value
        mesh = self.shapes.mesh
        found = []
        for own, cut in zip(ordinates, _cut_rows(self.shapes, whole), strict=True):
            bits = []
            for mark, rows in zip((own.hit_bits, own.probe_bits), cut, strict=True):
                assert mark is not None
                # Rows that pad read with no weight, whatever their bits.
                bits.append(put(mesh, np.moveaxis(np.asarray(mark)[:, :, np.maximum(rows.row, 0)], 2, 0), TABLE))
            bare = jax.tree.map(lambda a: put(mesh, a, SAME), own.marked(None, None))
            found.append(bare.marked(*bits))
        return tuple(found)


class Block(_InBlocks):
    """One device's part of a partition, within `shard_map`. Lengths and numbers are of this part."""

    @property
    def padded(self) -> tuple[int, int, int]:
        return self.shapes.padded_here

    @property
    def shape(self) -> tuple[int, int, int]:
        return self.shapes.shape_here

    @property
    def cubic(self) -> bool:
        return self.shapes.cubic

    @property
    def inflow_image(self) -> Int[Array, "X Y Z"]:
        return self.fields.inflow_image[0]

    @property
    def reads(self) -> tuple[AxisReads, ...]:
        return self.tables.reads

    @property
    def cell(self) -> Int[Array, " I"]:
        return self.tables.cell

    @property
    def source_element(self) -> Int[Array, " I"]:
        return self.tables.source_element

    @property
    def share(self) -> Float[Array, " I"]:
        return self.tables.share

    def padded_along(self, axis: int) -> tuple[int, int, int]:
        """Planes, and their rows and columns here."""
        _, u, v = AXES[axis]
        return self.shapes.lattice[axis], self.shapes.split(u, "u").shape[1], self.shapes.split(v, "v").shape[1]

    def to_padded(self, field: Float[Array, "C nx ny nz"]) -> Float[Array, "C X Y Z"]:
        return self.shapes.to_padded(field)

    def from_padded(self, field: Float[Array, "C X Y Z"]) -> Float[Array, "C nx ny nz"]:
        return self.shapes.from_padded(field)

    def exitance_field(self, exitance: Float[Array, "C E"]) -> Float[Array, "C X Y Z"]:
        return exitance_in_voxels(exitance, self.source_element, self.share, self.cell, self.padded)

    def planes(self, field: Array, axis: int, fill: float = 0) -> Array:
        """A padded field as flat planes along a sweep axis, [K, *C, P]; `fill` in the slots that hold no voxel."""
        flat = flat_planes(self.shapes.turned(field, axis), axis)
        return jnp.where(self._empty(axis), jnp.asarray(fill, flat.dtype), flat) if fill else flat

    def from_planes(self, planes: Float[Array, "K C P"], axis: int) -> Float[Array, "C X Y Z"]:
        """Back from planes; what is in empty slots is left."""
        like = jax.ShapeDtypeStruct((planes.shape[1], *self.padded), planes.dtype)
        return jax.linear_transpose(lambda field: self.planes(field, axis), like)(planes)[0]

    def _empty(self, axis: int) -> Bool[Array, " P"]:
        rows, columns = self.shapes.columns(axis)
        return ((rows < 0)[:, None] | (columns < 0)).ravel()

    def rim(self, axis: int) -> Bool[Array, " P"]:
        """Ghost voxels at the rim of the planes, and empty slots."""
        edges = []
        for where, a in zip(self.shapes.columns(axis), AXES[axis][1:], strict=True):
            ends = (where < self.pad[a]) | (where >= self.shapes.lattice[a] - self.pad[a])
            edges.append(ends | (where < 0))
        return (edges[0][:, None] | edges[1]).ravel()

    def ring(self, axis: int) -> Ring:
        rows, columns = self.shapes.columns(axis)
        _, height, width = self.padded_along(axis)
        parts = self.shapes.parts("u"), self.shapes.parts("v")
        return Ring(height, width, jnp.sum(rows >= 0), jnp.sum(columns >= 0), parts)

    def largest(self, values: Array) -> Array:
        """Of all devices."""
        return lax.pmax(values, NAMES)

    def neighbour(self, field: Array, axis: int, step: int) -> Array:
        """Each voxel's neighbour in a padded field, axis 0 to 2; 0 beyond ends that are not joined."""
        dim = field.ndim - 3 + axis
        size = field.shape[dim]
        if axis == 2:
            moved = jnp.roll(field, -step, dim)
            number = jnp.arange(size)
        else:
            name = NAMES[axis]
            number = jnp.asarray(self.shapes.split(axis, name))[lax.axis_index(name)]
            moved = neighbours(field, dim, -step, jnp.sum(number >= 0), name, self.shapes.parts(name))
        if self.pad[axis] == 0:
            return moved
        end = number == (self.shapes.lattice[axis] - 1 if step > 0 else 0)
        return jnp.where(end.reshape([-1 if d == dim else 1 for d in range(field.ndim)]), 0.0, moved)


def _all_to_all(field: Array, name: str, split: int, concat: int) -> Array:
    return lax.all_to_all(field, name, split, concat, tiled=True)


class _Cut:
    """Rows of a table of reads for each device, in tiles by plane; -1: padding."""

    def __init__(self, row: np.ndarray, cell: np.ndarray, first_tile: np.ndarray):
        self.row, self.cell, self.first_tile = row, cell, first_tile


def _cut_rows(shapes: Shapes, layout: Layout) -> list[list[_Cut]]:
    """For each sweep axis and kind of read: which rows each device reads, where, and the first tile of each plane."""
    counts = [[_by_device(shapes, layout, axis, reads) for reads in layout.reads[axis].kinds] for axis in range(3)]
    cuts: list[list[_Cut]] = [[], [], []]
    for kind in range(2):
        tile = layout.reads[0].kinds[kind].tile
        tiles = [-(-counts[axis][kind][2] // tile) for axis in range(3)]  # by device and plane
        total = max(1, *(int(t.sum(1).max(initial=0)) for t in tiles)) * tile
        for axis in range(3):
            device, place, per_plane, plane, row = counts[axis][kind]
            first = np.concatenate([np.zeros((len(per_plane), 1), int), np.cumsum(tiles[axis], 1)], 1)
            order = np.lexsort((plane, device))
            group = device[order] * per_plane.shape[1] + plane[order]
            starts = np.concatenate([[0], np.cumsum(per_plane.ravel())])
            rank = np.arange(len(order)) - starts[group]
            target = first[device[order], plane[order]] * tile + rank
            rows, cells = np.full((len(per_plane), total), -1), np.zeros((len(per_plane), total), int)
            rows[device[order], target], cells[device[order], target] = row[order], place[order]
            cuts[axis].append(_Cut(rows, cells, first))
    return cuts


def _by_device(shapes: Shapes, layout: Layout, axis: int, reads: Reads):
    """Of the rows in use: device, cell there, plane and row; and how many rows each device has in each plane."""
    normal = np.stack([np.asarray(component) for component in reads.plane[1:]])
    row = np.flatnonzero(np.any(normal != 0, axis=0))
    first = np.asarray(reads.first_tile) * reads.tile
    plane = np.searchsorted(first, row, side="right") - 1
    width = layout.padded_along(axis)[2]
    cell = np.asarray(reads.cell)[row]
    _, u, v = AXES[axis]
    device, place = _block_of(shapes, u, v, cell // width, cell % width)
    count = shapes.parts("u") * shapes.parts("v")
    per_plane = np.zeros((count, layout.padded[axis]), int)
    np.add.at(per_plane, (device, plane), 1)
    return device, place, per_plane, plane, row


def _block_of(shapes: Shapes, u: int, v: int, row: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The device that holds a place of a plane, and its flat number there."""
    tables = shapes.split(u, "u"), shapes.split(v, "v")
    (i, row), (j, column) = (
        np.divmod(positions(table)[where], table.shape[1]) for table, where in zip(tables, (row, column), strict=True)
    )
    return i * shapes.parts("v") + j, row * tables[1].shape[1] + column


def put(mesh: Mesh, values: Any, spec: Spec) -> Array:
    """Known values on the devices of a mesh, of all processes."""
    values = np.asarray(values)
    return jax.make_array_from_callback(values.shape, NamedSharding(mesh, spec), lambda index: values[index])


def make_partition(layout: Layout, mesh: Mesh) -> Partition:
    """A layout split over a mesh with axes "u" and "v" (see `sharding.check_mesh`)."""
    shapes = Shapes(
        mesh, layout.unfolding, layout.shape, layout.padded, layout.pad, layout.spacing, layout.elements,
    )  # fmt: skip
    place = lambda values, spec: put(mesh, values, spec)
    return Partition(
        shapes, _place_fields(shapes, layout, place), _place_tables(shapes, layout, place), Uncompared(layout),
    )  # fmt: skip


def _place_fields(shapes: Shapes, layout: Layout, place: Callable) -> _Fields:
    def blocked(field, fill):
        field = np.asarray(field)
        for axis, name in enumerate(NAMES):
            columns = shapes.split(axis, name).ravel()
            field = np.take(field, np.maximum(columns, 0), axis + 1)
            empty = (columns < 0).reshape([-1 if d == axis + 1 else 1 for d in range(4)])
            field = np.where(empty, np.asarray(fill, field.dtype).reshape(-1, 1, 1, 1), field)
        return place(field, FIELD)

    return _Fields(
        blocked(layout.plane, (-1, 0, 0, 0)), blocked(layout.buried[None], False), blocked(layout.inflow_image[None], -1)
    )


def _place_tables(shapes: Shapes, layout: Layout, place: Callable) -> _Tables:
    count = shapes.parts("u") * shapes.parts("v")
    x, y, z = np.unravel_index(np.asarray(layout.cell), layout.padded)
    device, cell = _block_of(shapes, 0, 1, x, y)
    cell = cell * layout.padded[2] + z
    order = np.argsort(device, kind="stable")
    sizes = np.bincount(device, minlength=count)
    rank = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)

    def spread(values):
        values = np.asarray(values)
        table = np.zeros((count, max(1, sizes.max(initial=0))), values.dtype)
        table[device[order], rank] = values[order]
        return place(table, TABLE)

    reads = []
    for of_axis, cuts in zip(layout.reads, _cut_rows(shapes, layout), strict=True):
        hits, probes = (_place_reads(r, cut, place) for r, cut in zip(of_axis.kinds, cuts, strict=True))
        reads.append(AxisReads(hits, probes))
    return _Tables(
        spread(cell.astype(np.int32)), spread(layout.source_element), spread(layout.share), (reads[0], reads[1], reads[2])
    )


def _place_reads(reads: Reads, cut: _Cut, place: Callable) -> Reads:
    def spread(values):
        values = np.asarray(values)
        picked = np.moveaxis(values[..., np.maximum(cut.row, 0)], -2, 0)  # devices first
        unused = (cut.row < 0).reshape(len(cut.row), *[1] * (values.ndim - 1), -1)
        return place(np.where(unused, np.zeros((), values.dtype), picked), TABLE)

    return Reads(
        cell=place(cut.cell.astype(np.int32), TABLE),
        element=spread(reads.element),
        plane=tuple(spread(component) for component in reads.plane),
        height=spread(reads.height),
        image=spread(reads.image),
        first_tile=place(cut.first_tile.astype(np.int32), TABLE),
        tile=reads.tile,
    )
