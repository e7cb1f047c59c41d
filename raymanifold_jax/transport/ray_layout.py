"""How nodes and directions of the light-ray-cube scheme lie in memory.

A *face* is one of the six of the light ray cube: face 2a holds the directions that go up axis a, face 2a + 1 those that go
down it. Its planes, in the order in which its rays meet them, are taken M at a time: such a *slab* holds one plane of each of
the M interleaved families that hops of M planes make.

Public: `Faces`, `make_faces`, `RayLattice`, `Plane`, `make_plane`, `turned`, `turned_back`, `entry_sides`.
"""

from __future__ import annotations

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from ..layout import AXES
from ..quadrature import cube_points, light_ray_cube

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
    real = np.dtype(jnp.zeros(0).dtype)
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

    def to_padded(self, field: Float[Array, "*C nx ny nz"]) -> Float[Array, "*C X Y Z"]:
        width = [(0, n - m) for n, m in zip(self.padded, self.shape, strict=True)]
        return jnp.pad(field, [(0, 0)] * (field.ndim - 3) + width)

    def from_padded(self, field: Float[Array, "*C X Y Z"]) -> Float[Array, "*C nx ny nz"]:
        return field[(..., *(slice(n) for n in self.shape))]


class Plane(NamedTuple):
    """The (u, v) plane of a sweep, flat: `height` rows of `width` nodes, with `margin` nodes more at both ends of each row.

    Margins hold copies of nodes beyond the ends, where v is periodic.
    """

    planes: int
    periodic: bool  # the sweep axis
    wrap_u: bool
    half_width: int
    height: int
    width: int
    margin: int

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


def make_plane(lattice: RayLattice, axis: int) -> Plane:
    _, u, v = AXES[axis]
    margin = lattice.half_width if lattice.periodic[v] else 0
    n, wraps, padded, m = lattice.shape, lattice.periodic, lattice.padded, lattice.half_width
    return Plane(n[axis], wraps[axis], wraps[u], m, padded[u], padded[v], margin)


def turned(field: Float[Array, "*C X Y Z"], lattice: RayLattice, face: int) -> Float[Array, "*C A U V"]:
    """A field with the face's axis first and its planes in the order in which rays meet them."""
    lead, axis = field.ndim - 3, face // 2
    field = field.transpose(*range(lead), *(lead + a for a in AXES[axis]))
    field = lax.slice_in_dim(field, 0, lattice.shape[axis], axis=lead)
    return jnp.flip(field, lead) if face % 2 else field


def turned_back(field: Float[Array, "*C A U V"], lattice: RayLattice, face: int) -> Float[Array, "*C X Y Z"]:
    lead, axis = field.ndim - 3, face // 2
    field = jnp.flip(field, lead) if face % 2 else field
    field = jnp.pad(field, [(0, 0)] * lead + [(0, lattice.padded[axis] - lattice.shape[axis]), (0, 0), (0, 0)])
    return field.transpose(*range(lead), *(lead + AXES[axis].index(a) for a in range(3)))


def entry_sides(face: int) -> tuple[int, int, int, int, int]:
    """The sides where a face's rays may enter: before the first plane, then where u and v are low and high."""
    axis, u, v = AXES[face // 2]
    return 2 * axis + face % 2, 2 * u, 2 * u + 1, 2 * v, 2 * v + 1
