"""How a scene lies in memory for the sweeps: the padded lattice, mirror images, and which element reads which voxel.

The *padded* lattice has one ghost voxel around every axis that is not periodic. Mirror sides are unfolded: the lattice is
doubled along their axis, only directions on one side of the mirror are swept, and results are folded back. For each sweep
axis the elements' *reads* are listed plane by plane, in tiles of equal size, so that one small loop serves any number of
elements in a plane.

Public: `Layout`, `make_layout`, `ghosts`, `Ordinates`, `make_ordinates`.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from .arrays import as_jax, numpy_or_jax_of, on_accelerator, real_dtype
from .programs import program
from .quadrature import Quadrature
from .scene import MIRROR, Scene
from .surfaces import Surfaces
from .windows import Windows, make_windows

AXES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))  # sweep axis, u, v
_CHUNK = 1 << 17  # rays times bands in one step: a compromise between a CPU's caches and the cost of starting a step
_WIDE_CHUNK = 1 << 24  # the same on a GPU, which should start few steps, within its memory
_WORD = 32
_TILE = 64  # at least, to 1024
Field = TypeVar("Field", Array, np.ndarray)


class Unfolding(eqx.Module):
    """Mirror sides, axis by axis, as blocks of the lattice that are copies (False) or reflections (True) of it."""

    blocks: tuple[tuple[bool, ...], ...] = eqx.field(static=True)

    @property
    def axes(self) -> tuple[int, ...]:
        return tuple(axis for axis in range(3) if len(self.blocks[axis]) > 1)

    def unfold(self, field: Field) -> Field:
        """A field [C, nx, ny, nz] and its images, [C, X, Y, Z], of numpy or of JAX."""
        xp = numpy_or_jax_of(field)
        for axis in self.axes:
            parts = [xp.flip(field, axis + 1) if mirrored else field for mirrored in self.blocks[axis]]
            field = xp.concatenate(parts, axis + 1)
        return field

    def fold(self, field: Field) -> Field:
        """Sum over the images: the transpose of `unfold`."""
        xp = numpy_or_jax_of(field)
        for axis in self.axes:
            parts = xp.split(field, len(self.blocks[axis]), axis + 1)
            turned = [xp.flip(p, axis + 1) if m else p for p, m in zip(parts, self.blocks[axis], strict=True)]
            field = xp.stack(turned).sum(0)
        return field

    def images(self) -> list[tuple[tuple[int, ...], np.ndarray]]:
        """Every image: its block number along each axis, and the signs (3,) it gives to directions."""
        numbers = itertools.product(*(range(len(b)) for b in self.blocks))
        return [(n, np.array([-1 if self.blocks[a][n[a]] else 1 for a in range(3)])) for n in numbers]


class Reads(eqx.Module):
    """Which element reads which voxel during the sweeps along one axis; rows sorted by plane, padded to whole tiles."""

    cell: Int[Array, " M"]  # voxel read, flat in its plane
    element: Int[Array, " M"]
    plane: tuple[Float[Array, " M"], ...]  # the element's plane: offset, then the normal along (axis, u, v); padding: 0
    height: Float[Array, " M"]  # of the read voxel's centre above the element's plane, in voxels
    image: Int[Array, " M"]  # of which of the layout's element images this is
    first_tile: Int[Array, " K1"]
    tile: int = eqx.field(static=True)


class AxisReads(NamedTuple):
    """`hits`: rays that arrive at the element in its own voxel. `probes`: the paths in its probe voxel."""

    hits: Reads
    probes: Reads
    windows: Windows | None = None  # on a GPU, on which sweeps are *wide*: all of a plane at once, without a choice on the way

    @property
    def kinds(self) -> tuple[Reads, Reads]:
        return self.hits, self.probes


class Layout(eqx.Module):
    """The padded, unfolded lattice of a scene and its surface elements on it. See the module's docstring."""

    unfolding: Unfolding
    shape: tuple[int, int, int] = eqx.field(static=True)  # the scene's lattice
    padded: tuple[int, int, int] = eqx.field(static=True)
    pad: tuple[int, int, int] = eqx.field(static=True)
    spacing: float = eqx.field(static=True)
    elements: int = eqx.field(static=True)
    cut_cell: Int[Array, " J"]  # voxels that hold a surface, flat in the padded lattice
    cut_plane: Float[Array, "4 J"]  # and the offset and normal that stand for it
    cell: Int[Array, " I"]  # voxel of each element image, flat in the padded lattice
    face: Float[Array, "4 I"]  # and its plane: offset and normal
    source_element: Int[Array, " I"]
    share: Float[Array, " I"]  # its share of that voxel's exitance
    buried: Bool[Array, "X Y Z"]  # voxels wholly inside solids
    open_cell: Int[Array, " O"]  # ghost voxels that are open, flat
    open_image: Int[Array, " O"]  # and which mirror image they belong to
    reads: tuple[AxisReads, ...]  # by sweep axis

    @property
    def plane(self) -> Float[Array, "4 X Y Z"]:
        """Offset and normal of each voxel's surface; free: 1, 0; ghosts: -1, 0."""
        return _spread_out(self.cut_cell, self.cut_plane, (1.0, 0.0, 0.0, 0.0), (-1.0, 0.0, 0.0, 0.0), self.padded, self.pad)

    @property
    def free(self) -> Bool[Array, "X Y Z"]:
        """Voxels without surfaces."""
        return _spread_out(self.cut_cell, self.cut_plane[:1], (1.0,), (-1.0,), self.padded, self.pad)[0] == 1.0

    @property
    def inflow_image(self) -> Int[Array, "X Y Z"]:
        """Which mirror image an open ghost voxel belongs to; -1: not open."""
        return _spread_out(self.open_cell, self.open_image[None], (-1,), (-1,), self.padded, self.pad)[0]

    @property
    def real(self) -> np.dtype:
        """The dtype of its real numbers."""
        return np.dtype(self.cut_plane.dtype)

    @property
    def wide(self) -> bool:
        return self.reads[0].windows is not None

    @property
    def cubic(self) -> bool:
        """Whether the sweeps along the three axes are alike, and can share one program."""
        return len(set(self.padded)) == 1 and len(set(self.pad)) == 1

    def padded_along(self, axis: int) -> tuple[int, int, int]:
        """The padded shape, sweep axis first."""
        order = AXES[axis]
        return self.padded[order[0]], self.padded[order[1]], self.padded[order[2]]

    def to_padded(self, field: Field) -> Field:
        """Unfold a field [C, nx, ny, nz] of the scene's lattice and give it ghost voxels (0)."""
        return numpy_or_jax_of(field).pad(self.unfolding.unfold(field), ((0, 0), *((p, p) for p in self.pad)))

    def from_padded(self, field: Field) -> Field:
        inner = tuple(slice(p, n - p) for p, n in zip(self.pad, self.padded, strict=True))
        return self.unfolding.fold(field[(slice(None), *inner)])

    def planes(self, field: Float[Array, "*C X Y Z"], axis: int, _fill: float = 0) -> Float[Array, "K *C P"]:
        """A padded field as flat planes along a sweep axis; blocks of a layout fill the places that hold no voxel."""
        return flat_planes(field, axis)

    def from_planes(self, planes: Float[Array, "K C P"], axis: int) -> Float[Array, "C X Y Z"]:
        """The inverse of `planes`."""
        field = jnp.moveaxis(planes, 1, 0).reshape(-1, *self.padded_along(axis))
        return field.transpose(0, *(1 + AXES[axis].index(a) for a in range(3)))

    def rim(self, axis: int) -> Bool[np.ndarray, " P"]:
        """The ghost voxels at the rim of a plane, flat."""
        inside = np.ones([self.padded[a] - 2 * self.pad[a] for a in AXES[axis][1:]], bool)
        return ~np.pad(inside, [(self.pad[a], self.pad[a]) for a in AXES[axis][1:]]).ravel()

    def ring(self, _axis: int) -> None:
        """Planes are whole: there are no other blocks."""

    def largest(self, values: Array) -> Array:
        """Of all devices, of which there is one."""
        return values

    def neighbour(self, field: Array, axis: int, step: int) -> Array:
        """Each voxel's neighbour in a padded field, axis 0 to 2; 0 beyond ends that are not joined."""
        dim = field.ndim - 3 + axis
        moved = jnp.roll(field, -step, dim)
        if self.pad[axis] == 0:
            return moved
        end = jnp.arange(field.shape[dim]) == (field.shape[dim] - 1 if step > 0 else 0)
        return jnp.where(end.reshape([-1 if d == dim else 1 for d in range(field.ndim)]), 0.0, moved)

    def exitance_field(self, exitance: Float[Array, "C E"]) -> Float[Array, "C X Y Z"]:
        """Each voxel's exitant radiance: the mean over its elements, by area."""
        return exitance_in_voxels(exitance, self.source_element, self.share, self.cell, self.padded)


@program
def _spread_out(cell: Int[Array, " J"], values: Array, inside: tuple, rim: tuple, padded: tuple, pad: tuple) -> Array:
    """Few voxels' values [K, J] on the padded lattice, where all others inside have the same, and all at the rim."""
    widths = [(p, p) for p in pad]
    shape = tuple(n - 2 * p for n, p in zip(padded, pad, strict=True))
    rows = []  # one by one, which XLA takes to
    for own, i, r in zip(values, inside, rim, strict=True):
        field = jnp.pad(jnp.full(shape, i, values.dtype), widths, constant_values=r).ravel()
        rows.append(field.at[cell].set(own, unique_indices=True, indices_are_sorted=True).reshape(padded))
    return jnp.stack(rows)


def flat_planes(field: Float[Array, "*C X Y Z"], axis: int) -> Float[Array, "K *C P"]:
    """A field as flat planes along a sweep axis."""
    bands = field.ndim - 3
    turned = field.transpose(bands + axis, *range(bands), *(bands + a for a in AXES[axis][1:]))
    return turned.reshape(*turned.shape[:-2], -1)


def picked(values: Array | np.ndarray, index: Int[Array, " M"]) -> Array:
    """values[..., index]; zeros where a scene has no elements to pick from, and rows of reads only pad."""
    if isinstance(values, np.ndarray):
        there = np.asarray(index)
        return as_jax(values[..., there] if values.shape[-1] else np.zeros((*values.shape[:-1], len(there)), values.dtype))
    return values[..., index] if values.shape[-1] else jnp.zeros((*values.shape[:-1], len(index)), values.dtype)


def exitance_in_voxels(
    exitance: Float[Array, "C E"],
    element: Int[Array, " I"],
    share: Float[Array, " I"],
    cell: Int[Array, " I"],
    shape: tuple[int, int, int],
) -> Float[Array, "C X Y Z"]:
    """The sum, in each voxel, over the element images there: their exitance times their share."""
    flat = jnp.zeros((exitance.shape[0], int(np.prod(shape))), exitance.dtype)
    return flat.at[:, cell].add(exitance[:, element] * share).reshape(-1, *shape)


def make_layout(scene: Scene, surfaces: Surfaces) -> Layout:
    lattice = scene.lattice
    sides = scene.boundary.sides
    unfolding = Unfolding(tuple(_blocks(sides[2 * a] is MIRROR, sides[2 * a + 1] is MIRROR) for a in range(3)))
    both_mirrors = [sides[2 * a] is MIRROR and sides[2 * a + 1] is MIRROR for a in range(3)]
    pad = _triple(0 if scene.boundary.periodic[a] or both_mirrors[a] else 1 for a in range(3))
    shape = np.array(lattice.shape)
    padded = _triple(n * len(b) + 2 * p for n, b, p in zip(lattice.shape, unfolding.blocks, pad, strict=True))

    images = [_image(unfolding, number, signs, shape, pad, surfaces) for number, signs in unfolding.images()]
    voxel, probe, normal = (np.concatenate([image[key] for image in images]) for key in ("voxel", "probe", "normal"))
    element = np.tile(np.arange(len(surfaces)), len(images))
    image_number = np.repeat(np.arange(len(images)), len(surfaces))
    offset = surfaces.offset[element]
    flat = np.asarray(np.ravel_multi_index(tuple(voxel.T), padded)) if len(voxel) else np.zeros(0, int)

    area = surfaces.area[element]
    ghost = ghosts(padded, pad)
    cells, place = np.unique(flat, return_inverse=True)
    weight = area / np.maximum(np.bincount(place, area, len(cells)), 1e-300)[place]
    inside = ~ghost.ravel()[cells]
    plane = _voxel_planes(place, len(cells), offset, normal, weight)[:, inside]
    is_open = surfaces.open[element]
    open_cell, first = np.unique(flat[is_open], return_index=True)
    blocked = np.pad(
        unfolding.unfold(surfaces.solid[None])[0],
        [(p, p) for p in pad],
        constant_values=True,
    )
    periodic = [p == 0 for p in pad]
    away = probe - voxel
    probe = np.where(periodic, probe % padded, np.clip(probe, 0, np.array(padded) - 1))
    probing = ~blocked[tuple(probe.T)]
    rows = {"element": element, "image": np.arange(len(flat)), "offset": offset, "normal": normal, "away": np.zeros_like(away)}
    probes = {key: value[probing] for key, value in (rows | {"away": away}).items()}
    real = real_dtype()
    return Layout(
        unfolding=unfolding,
        shape=lattice.shape,
        padded=padded,
        pad=pad,
        spacing=lattice.spacing,
        elements=len(surfaces),
        cut_cell=as_jax(cells[inside], np.int32),
        cut_plane=as_jax(plane, real),
        cell=as_jax(flat, np.int32),
        face=as_jax(np.column_stack([offset, normal]).T, real),
        source_element=as_jax(element, np.int32),
        share=as_jax(weight, real),
        buried=as_jax(blocked & ~ghost),
        open_cell=as_jax(open_cell, np.int32),
        open_image=as_jax(image_number[is_open][first], np.int32),
        reads=_all_reads(padded, [(rows, voxel), (probes, probe[probing])], real),
    )


def ghosts(padded: tuple[int, int, int], pad: tuple[int, int, int]) -> Bool[np.ndarray, "X Y Z"]:
    """The ghost voxels at the rim of a padded lattice."""
    ghost = np.ones(padded, bool)
    ghost[tuple(slice(p, n - p) for p, n in zip(pad, padded, strict=True))] = False
    return ghost


def _triple(values: Iterable[int]) -> tuple[int, int, int]:
    a, b, c = values
    return a, b, c


def _blocks(lower: bool, upper: bool) -> tuple[bool, ...]:
    return {(False, False): (False,), (True, False): (True, False)}.get((lower, upper), (False, True))


def _image(unfolding, number, signs, shape, pad, surfaces: Surfaces) -> dict[str, np.ndarray]:
    """An image's voxels, probe voxels and normals on the padded lattice."""
    start = np.array(number) * shape + pad
    reflected = signs < 0
    voxel = start + np.where(reflected, shape - 1 - surfaces.voxel, surfaces.voxel)
    return {
        "voxel": voxel,
        "probe": voxel + (surfaces.probe - surfaces.voxel) * signs,
        "normal": surfaces.normal * signs,
    }


def _voxel_planes(place: np.ndarray, count: int, offset: np.ndarray, normal: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """The one plane that stands for the elements of each voxel in the sweep, (4, J); `place` says which voxel is whose."""
    plane = np.array([np.bincount(place, weight * values, count) for values in (offset, *normal.T)], float)
    length = np.linalg.norm(plane[1:], axis=0)
    plane /= np.where(length > 1e-6, length, 1.0)
    # A voxel that solids fill up to its faces blocks every ray: so do convex edges of aligned boxes.
    shallow = np.full(count, -np.inf)
    np.maximum.at(shallow, place, offset)
    filled = (np.bincount(place, minlength=count) > 1) & (shallow < -0.4)
    plane[:, filled] = np.array([-1.0, 0.0, 0.0, 0.0])[:, None]
    return plane


def _all_reads(padded: tuple[int, int, int], kinds: list[tuple[dict, np.ndarray]], real) -> tuple[AxisReads, ...]:
    """The reads of each kind, by the elements in its rows, of their voxels."""
    counts = [[np.bincount(voxel[:, axis], minlength=padded[axis]) for axis in range(3)] for _, voxel in kinds]
    if not on_accelerator():
        tiles, spare, windows = [_usual_tile(of_kind) for of_kind in counts], 0, (None,) * 3
    else:
        rows = [np.maximum(*(-(-of_kind[axis] // _TILE) * _TILE for of_kind in counts)) for axis in range(3)]
        windows = make_windows(rows, [int(np.prod(padded)) // n for n in padded])
        tiles, spare = [_TILE] * len(kinds), windows[0].size + windows[0].rest
    of_kinds = [_reads(padded, *kind, c, tile, spare, real) for kind, c, tile in zip(kinds, counts, tiles, strict=True)]
    return tuple(AxisReads(hits, probes, w) for hits, probes, w in zip(*of_kinds, windows, strict=True))


def _usual_tile(counts: list[np.ndarray]) -> int:
    occupied = np.concatenate(counts)
    typical = np.median(occupied[occupied > 0]) if occupied.any() else 1
    return int(np.clip(2 ** np.ceil(np.log2(max(typical, 1))), _TILE, 1024))


def _reads(padded: tuple[int, int, int], rows: dict, voxel: np.ndarray, counts, tile: int, spare: int, real) -> list[Reads]:
    """The reads of `voxel` by the elements in `rows`, for each sweep axis; all axes get arrays of the same length."""
    total = max(1, *(int((-(-count // tile)).sum()) for count in counts)) * tile + spare
    return [_axis_reads(axes, padded[axes[2]], counts[axes[0]], tile, total, rows, voxel, real) for axes in AXES]


def _axis_reads(
    axes: tuple[int, int, int], width: int, count: np.ndarray, tile: int, total: int, rows: dict, voxel: np.ndarray, real
) -> Reads:
    axis, u, v = axes
    order = np.argsort(voxel[:, axis], kind="stable")
    first_tile = np.concatenate([[0], np.cumsum(-(-count // tile))])
    # Row of each read: its plane's first tile, then its rank in the plane.
    sorted_plane = voxel[order, axis]
    rank = np.arange(len(order)) - np.concatenate([[0], np.cumsum(count)])[sorted_plane]
    row = first_tile[sorted_plane] * tile + rank
    flat = lambda where: where[:, u] * width + where[:, v]

    def spread(values, dtype):
        out = np.zeros((*values.shape[1:], total), dtype)
        out[..., row] = np.moveaxis(values[order], 0, -1)
        return as_jax(out)

    return Reads(
        cell=spread(flat(voxel), np.int32),
        element=spread(rows["element"], np.int32),
        plane=tuple(spread(values, real) for values in (rows["offset"], *rows["normal"].T[[axis, u, v]])),
        height=spread(rows["offset"] + np.einsum("mi,mi->m", rows["normal"], rows["away"]), real),
        image=spread(rows["image"], np.int32),
        first_tile=as_jax(first_tile, np.int32),
        tile=tile,
    )


class Ordinates(eqx.Module):
    """The directions swept along one axis, in chunks of equal size; weight 0 pads.

    `slope` is the step (du, dv) a plane, `start` the fractional position (fx, fy) at the first plane, `sign` the sense along
    the axis, `index` the direction's number in the quadrature.
    """

    direction: Float[Array, "G D 3"]  # along (axis, u, v)
    weight: Float[Array, "G D"]
    slope: Float[Array, "G D 2"]
    start: Float[Array, "G D 2"]
    index: Int[Array, "G D"]
    sign: Int[Array, " G"]
    laps: Int[Array, " G"]
    chunks: Int[Array, ""]  # how many of the G are in use
    # Bit d of each hit or probe read, in words of 32: rays of direction d arrive at the element in its own voxel.
    hit_bits: UInt32[Array, "G words M"] | None = None
    probe_bits: UInt32[Array, "G words M2"] | None = None

    def marked(self, hits: Array | None, probes: Array | None) -> Ordinates:
        """The same directions with these bits."""
        return dataclasses.replace(self, hit_bits=hits, probe_bits=probes)


def make_ordinates(quadrature: Quadrature, bands: int, plane_size: int, wide: bool = False) -> tuple[Ordinates, ...]:
    """Sort directions by their dominant axis and sense, and chunk them to suit planes of `plane_size` voxels.

    `wide`: large chunks, two of which are swept at once.
    """
    w = quadrature.directions
    dominant = np.argmax(np.abs(w), axis=1)
    groups = {
        (axis, sign): np.nonzero((dominant == axis) & (np.sign(w[:, axis]) == sign))[0] for axis in range(3) for sign in (1, -1)
    }
    largest = max(len(g) for g in groups.values())
    wanted = max(8, (_WIDE_CHUNK if wide else _CHUNK) // (bands * plane_size))
    wanted = wanted if wide else min(2 * _WORD, wanted)
    size = -(-largest // -(-largest // wanted))
    count = max(sum(-(-len(groups[axis, sign]) // size) for sign in (1, -1)) for axis in range(3))
    count += count % 2 if wide else 0
    return tuple(_axis_ordinates(quadrature, axis, groups, size, count) for axis in range(3))


def _axis_ordinates(quadrature: Quadrature, axis: int, groups: dict, size: int, count: int) -> Ordinates:
    order = list(AXES[axis])
    chunks = [(sign, g[i : i + size]) for sign in (1, -1) for g in [groups[axis, sign]] for i in range(0, len(g), size)]
    direction = np.zeros((count, size, 3))
    direction[..., 0] = 1
    signs = np.ones(count, np.int32)
    weight, index = np.zeros((count, size)), np.zeros((count, size), int)
    slope, start = np.zeros((count, size, 2)), np.full((count, size, 2), 0.5)
    for row, (sign, members) in enumerate(chunks):
        direction[row, :, 0] = signs[row] = sign
        n = len(members)
        direction[row, :n] = quadrature.directions[members][:, order]
        weight[row, :n], index[row, :n] = quadrature.weights[members], members
        slope[row, :n] = direction[row, :n, 1:] / np.abs(direction[row, :n, :1])
        # The first offset goes with the larger slope, and is measured along the ray: turned scenes get turned rays.
        offset = quadrature.offsets[members]
        swap = np.abs(slope[row, :n, 1]) > np.abs(slope[row, :n, 0])
        offset = np.where(swap[:, None], offset[:, ::-1], offset)
        start[row, :n] = np.where(slope[row, :n] < 0, 1 - offset, offset)
    real = real_dtype()
    return Ordinates(
        direction=as_jax(direction, real), weight=as_jax(weight, real), slope=as_jax(slope, real),
        start=as_jax(start, real), index=as_jax(index, np.int32),
        sign=as_jax(signs), laps=as_jax(np.ones(count, np.int32)), chunks=as_jax(len(chunks), np.int32),
    )  # fmt: skip
