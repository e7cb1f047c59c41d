"""How nodes and directions of the light-ray-cube scheme lie in memory.

A *face* is one of the six of the light ray cube: face 2a holds the directions that go up axis a, face 2a + 1 those that go
down it. Its planes, in the order in which its rays meet them, are taken M at a time: such a *slab* holds one plane of each of
the M interleaved families that hops of M planes make.

`RayLattice` is the lattice on one device; `ray_partition.RayBlock` stands for it where the lattice is split over a mesh.

Public: `Faces`, `make_faces`, `RayLattice`, `Plane`, `entry_sides`.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from ..arrays import real_dtype
from ..layout import AXES
from ..quadrature import cube_points, light_ray_cube
from ..shift import Torus, hop, hop_around

CHUNK = 1 << 19  # rays times bands in one step: a compromise between a CPU's caches and the cost of starting a step


class Faces(eqx.Module):
    """The directions of the six faces, in chunks of equal size; weight 0 pads."""

    direction: Float[Array, "6 G D 3"]  # of length 1, along (axis, u, v)
    hop: Int[Array, "6 G D 2"]  # (p, q)
    length: Float[Array, "6 G D"]  # |L| in nodes
    weight: Float[Array, "6 G D"]
    index: Int[Array, "6 G D"]  # the direction's number in `quadrature.light_ray_cube`
    laps: Int[Array, "6 G"]  # of a periodic sweep axis
    chunks: Int[Array, " 6"]  # how many of the G are in use


def make_faces(half_width: int, rays: int) -> Faces:
    """The face lists of a light ray cube, in chunks that suit slabs of `rays` rays (bands included)."""
    points, quadrature = cube_points(half_width), light_ray_cube(half_width)
    dominant = np.argmax(np.abs(points), axis=1)  # the first of equals: an edge belongs to one face
    lists = [np.flatnonzero((dominant == a) & (np.sign(points[:, a]) == s)) for a in range(3) for s in (1, -1)]
    largest = max(map(len, lists))
    size = -(-largest // -(-largest // int(np.clip(CHUNK // rays, 2, 16))))
    count = -(-largest // size)
    shape = (6, count * size)
    hops, length, weight, index = np.zeros((*shape, 2), int), np.ones(shape), np.zeros(shape), np.zeros(shape, int)
    direction = np.zeros((*shape, 3))
    direction[..., 0] = 1
    for face, members in enumerate(lists):
        n, order = len(members), list(AXES[face // 2])
        direction[face, :n] = quadrature.directions[members][:, order]
        hops[face, :n] = points[members][:, order[1:]]
        length[face, :n] = np.linalg.norm(points[members], axis=1)
        weight[face, :n], index[face, :n] = quadrature.weights[members], members
    real = real_dtype()
    split = lambda a, kind: jnp.asarray(a.reshape(6, count, size, *a.shape[2:]), kind)
    return Faces(
        direction=split(direction, real), hop=split(hops, np.int32), length=split(length, real), weight=split(weight, real),
        index=split(index, np.int32), laps=jnp.ones((6, count), np.int32),
        chunks=jnp.asarray([-(-len(members) // size) for members in lists], np.int32),
    )  # fmt: skip


class RayLattice(eqx.Module):
    """How the nodes lie in memory. Static.

    Axes that are not periodic have at least M inert nodes after the last: the lattice's ends are joined, as on a torus, and
    these stand for what is beyond either end.
    """

    shape: tuple[int, int, int] = eqx.field(static=True)
    padded: tuple[int, int, int] = eqx.field(static=True)
    periodic: tuple[bool, bool, bool] = eqx.field(static=True)
    open: tuple[bool, ...] = eqx.field(static=True)  # the six sides
    half_width: int = eqx.field(static=True)
    spacing: float = eqx.field(static=True)

    @property
    def cubic(self) -> bool:
        """Whether the six faces are alike, and can share one program."""
        return len(set(self.padded)) == len(set(self.shape)) == len(set(self.periodic)) == 1

    @property
    def largest_plane(self) -> int:
        """Nodes."""
        return int(np.prod(sorted(self.padded)[1:]))

    def to_padded(self, field: Float[Array, "*C nx ny nz"]) -> Float[Array, "*C X Y Z"]:
        width = [(0, n - m) for n, m in zip(self.padded, self.shape, strict=True)]
        return jnp.pad(field, [(0, 0)] * (field.ndim - 3) + width)

    def from_padded(self, field: Float[Array, "*C X Y Z"]) -> Float[Array, "*C nx ny nz"]:
        return field[(..., *(slice(n) for n in self.shape))]

    def spread(self, values: Float[Array, "C S"], cell: Int[Array, " S"]) -> Float[Array, "C nx ny nz"]:
        """Lists of SURFACE nodes, at the flat indices `cell`, as fields."""
        field = jnp.zeros((len(values), int(np.prod(self.shape))), values.dtype)
        return field.at[:, cell].set(values).reshape(-1, *self.shape)

    def collect(self, field: Float[Array, "C nx ny nz"], cell: Int[Array, " S"]) -> Float[Array, "C S"]:
        """The inverse of `spread`."""
        return field.reshape(len(field), -1)[:, cell]

    def plane(self, axis: int) -> Plane:
        """The planes of a sweep along an axis."""
        _, u, v = AXES[axis]
        n, wraps, padded, m = self.shape, self.periodic, self.padded, self.half_width
        margin = m if wraps[v] else 0
        rows, columns = np.arange(padded[u]), np.arange(padded[v] + 2 * margin)
        return Plane(n[axis], wraps[axis], wraps[u], wraps[v], m, padded[u], padded[v], margin, rows, columns)

    def turned(self, field: Float[Array, "*C X Y Z"], face: int) -> Float[Array, "*C A U V"]:
        """A field with the face's axis first and its planes in the order in which rays meet them."""
        lead, axis = field.ndim - 3, face // 2
        field = field.transpose(*range(lead), *(lead + a for a in AXES[axis]))
        return in_order(field, self.shape[axis], face)

    def turned_back(self, field: Float[Array, "*C A U V"], face: int) -> Float[Array, "*C X Y Z"]:
        """The inverse of `turned`; 0 behind the lattice's last planes."""
        lead, axis = field.ndim - 3, face // 2
        field = jnp.flip(field, lead) if face % 2 else field
        field = jnp.pad(field, [(0, 0)] * lead + [(0, self.padded[axis] - self.shape[axis]), (0, 0), (0, 0)])
        return field.transpose(*range(lead), *(lead + AXES[axis].index(a) for a in range(3)))

    def largest(self, values: Array) -> Array:
        """Of all devices, of which there is one."""
        return values


class Plane(NamedTuple):
    """The (u, v) plane of a sweep, flat: `height` rows of `width` nodes, with `margin` nodes more at both ends of each row.

    Margins hold copies of nodes beyond the ends, where v is periodic. A plane that is split over a mesh (`torus`) has none:
    each block is the part of one device.
    """

    planes: int
    periodic: bool  # the sweep axis
    wrap_u: bool
    wrap_v: bool
    half_width: int
    height: int
    width: int
    margin: int
    rows: Int[Array, " U"] | Int[np.ndarray, " U"]  # the numbers on the lattice; -1: a slot without nodes
    columns: Int[Array, " V"] | Int[np.ndarray, " V"]  # margins included
    torus: Torus | None = None

    @property
    def stride(self) -> int:
        return self.width + 2 * self.margin

    def flat(self, field: Float[Array, "*C A U V"]) -> Float[Array, "K *C M P"]:
        """Slabs of flat planes."""
        slabs = -(-self.planes // self.half_width)
        extra = slabs * self.half_width - self.planes
        edge = (self.margin, self.margin)
        field = jnp.pad(field, [(0, 0)] * (field.ndim - 3) + [(0, extra), (0, 0), edge])
        field = field.reshape(*field.shape[:-3], slabs, self.half_width, self.height * self.stride)
        return jnp.moveaxis(field, -3, 0)

    def unflat(self, slabs: Float[Array, "K *C M P"]) -> Float[Array, "*C A U V"]:
        field = jnp.moveaxis(slabs, 0, -3)
        field = field.reshape(*field.shape[:-3], -1, self.height, self.stride)
        return field[..., : self.planes, :, self.margin : self.margin + self.width]

    def hop(self, rays: Float[Array, "D C M P"], hops: Int[Array, "D 2"]) -> Float[Array, "D C M P"]:
        """Move the rays of each direction by its hop (p, q)."""
        if self.torus is not None:
            return hop_around(rays, hops, self.torus)
        return hop(rays, hops, self.height, self.width, self.margin)

    def beyond(self, size: Int[Array, " 2"], hops: Int[Array, "D 2"]) -> tuple[Bool[Array, "D U V"], Bool[Array, "D U V"]]:
        """The inert nodes behind the last row, and behind the last column, of a lattice of this `size` along (u, v)."""
        rows, columns = jnp.asarray(self.rows), jnp.asarray(self.columns)
        column = (columns[None] >= size[1]) & (not self.wrap_v)
        if self.torus is not None:
            return (rows[:, None] >= size[0])[None], column[None]
        # On flat planes what is beyond the low end of a row lies at the end of the row before.
        late = column & (hops[:, 1, None, None] > 0)
        return (rows[:, None] + late) % self.height >= size[0], column[None]


def in_order(field: Float[Array, "*C A U V"], planes: int, face: int) -> Float[Array, "*C A U V"]:
    """The first planes, as many as rays meet, in the order in which those of a face do."""
    field = lax.slice_in_dim(field, 0, planes, axis=field.ndim - 3)
    return jnp.flip(field, field.ndim - 3) if face % 2 else field


def entry_sides(face: int) -> tuple[int, int, int, int, int]:
    """The sides where a face's rays may enter: before the first plane, then where u and v are low and high."""
    axis, u, v = AXES[face // 2]
    return 2 * axis + face % 2, 2 * u, 2 * u + 1, 2 * v, 2 * v + 1
