"""The light-ray-cube scheme of Langer, Breton & Zucker (Graphics Interface 1995): the paper, as it stands.

Rays go through the nodes of the lattice along L = (p, q, r), the points on the surface of a cube of half-width M: 24 M^2 + 2
directions (sections 2 and 6). One hop of a ray is L itself, M planes along the face's axis and (p, q) nodes across, so rays
stay on nodes, and the planes fall into M interleaved families. The six faces hold (2M + 1)^2 entries each, 726 for M = 5;
points on edges and corners lie on two or three of them. Each is swept once here, with its whole solid angle as its weight:
the same sums as sweeping it on each of its faces with a part of that.

One iteration is a *local transformation* (arriving to leaving light, node by node) and a *coordinate evolution* (leaving
to arriving light, along the rays). The paper's wording was not at hand: both follow a description of it, and what is this
module's reading of it is said where it matters.

Where the scheme loses or makes light, by how much (M = 5 unless said; `tests/test_light_ray_cube.py` measures it again):

- Weights. The 726 entries with a whole cell's solid angle each add up to 1.107 of the sphere: an albedo over 0.904 would
  amplify. Points on edges and corners must share theirs; they do here.
- Cosines. The weights' sums of |N . L| over half the sphere are 0.995 to 1.0015 of pi, by the normal (M = 2: 0.968 to 1.008).
- Linear attenuation. |L| is 1.22 M in the mean, but every hop counts as M: a medium is taken to be thinner by that. Between
  plates 1.5 optical depths apart, 20 % more light gets through than with exponential attenuation (24 planes, M = 3).
- Layers. Light leaves one layer of SURFACE nodes and arrives at another, so a gap of n planes is crossed in less: in the
  same gap 28 % more light gets through than should, and the power that medium and plates absorb is 21 % above what was sent.
- Thicker bodies. A layer sends and stops light as if it were the surface: a ball with a radius of 8 voxels and M = 2 sends 1.9
  times its power, one of 10 with M = 5 2.9 times.
- Grazing light in a layer. If light ends at the first node that it arrives at, a direction that comes down r planes a hop
  reaches r nodes of the M in a column: a flat surface loses 18 % of the light of a uniform sky, its innermost nodes most. The
  three balls in fog (N = 64, iterated to the end) then have irradiances 41 % low and lose 23 % of their power; with light that
  goes on to the solid, 3 % low, and 5 % too much power.
- Edges. Nodes along a concave edge have slanting normals, and rays that arrive there from behind the wall arrive dark: a closed
  room of 32 voxels with albedo 0.5 loses 8 % of its power, and more the larger M / N is.

Together, three balls in fog (figure 5; N = 128, linear) iterated to the end against a path tracer: irradiance 3.0 % low (rms
3.9 %), fluence 3.6 % low (rms 4.4 %). The paper's 5 iterations leave 51 % of the irradiance out: albedos of 0.9 need more.

Public: `LightRayCube`, `NodeFields`, `coordinate_evolution`, `local_transformation`, `count_laps`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from .. import checks
from ..layout import AXES
from ..operator import Light, Materials
from .ray_layout import Faces, Plane, RayLattice, entry_sides
from .ray_partition import RayBlock

_LEVEL = 1e-6  # |N . L / |L|| below this: the ray neither arrives nor leaves
_ENDED = 1e-6  # share of the light on a periodic axis that no longer matters


class LightRayCube(eqx.Module):
    """The paper's scheme: hops of `half_width` planes along the 24 M^2 + 2 directions of the light ray cube.

    **Arguments:**

    - `half_width`: M >= 1. Surfaces become layers of nodes M thick: solids, gaps and shadows are seen no finer than that.
    - `attenuation`: what a hop leaves of the light. "linear", as printed: 1 - extinction * M * spacing, for every
      direction alike; a medium in which that is negative is refused. "exponential": exp(-extinction * |L| * spacing).
    - `grazing`: what becomes of light that arrives at a node of a surface's layer while deeper nodes are still ahead.
      "passes": it goes on to the solid, and all of them see it. "ends": it ends at the first, and is lost to the others.
    """

    half_width: int = eqx.field(static=True, default=5)
    attenuation: Literal["linear", "exponential"] = eqx.field(static=True, default="linear")
    grazing: Literal["passes", "ends"] = eqx.field(static=True, default="passes")

    def __check_init__(self):
        checks.positive_int("half_width", self.half_width)
        for name, known in (("attenuation", ("linear", "exponential")), ("grazing", ("passes", "ends"))):
            value = getattr(self, name)
            if value not in known:
                checks.fail(name, repr(value), " or ".join(map(repr, known)), f"{known[0]!r} is the paper's")


class NodeFields(eqx.Module):
    """What rays meet, on the padded lattice; 0 at inert nodes."""

    normal: Float[Array, "3 X Y Z"]  # 0 but at SURFACE nodes
    alive: Float[Array, "1 X Y Z"]  # 1 at FREE and SURFACE nodes
    exitance: Float[Array, "C X Y Z"]  # radiance leaving SURFACE nodes
    extinction: Float[Array, "C X Y Z"] | None = None  # 1 / scene unit
    source: Float[Array, "C X Y Z"] | None = None  # source function


def local_transformation(materials: Materials, arriving: Light) -> Light:
    """The paper's Local_Transformation: leaving light from arriving light, at every node by itself.

        SURFACE:  B / pi = albedo E / pi + emitted radiance
        FREE:     S = (zeta Lambda / (4 pi) + emission) / (zeta + gamma)

    with `arriving` the means E / pi and Lambda / (4 pi). The paper's equation 1 alternates this and `coordinate_evolution`.
    """
    return Light(materials.emission, materials.medium_source) + materials.reflected(arriving)


def coordinate_evolution(
    lattice: RayLattice | RayBlock,
    fields: NodeFields,
    faces: Faces,
    scheme: LightRayCube,
    sky: Float[Array, "C n"] | None = None,
    gather: Float[Array, "3 X Y Z"] | None = None,
    fluence: bool = True,
) -> tuple[Float[Array, "C nx ny nz"], Float[Array, "C nx ny nz"] | None]:
    """The paper's Coordinate_Evolution: all rays, from the nodes where they begin to the nodes where they end.

        for each of the six faces, for each direction L of the face, for each plane along the face's axis,
        at all nodes x of the plane at once:
            R := radiance at x - L, after a hop through the medium
            case x of
                FREE:                     R goes on
                SURFACE and N . L < 0:    R arrives at x, and goes on             (`grazing="ends"`: 0 goes on)
                SURFACE and N . L > 0:    R := exitance of x, which goes on
                SOLID:                    0 goes on
            E(x) += weight |N . L| R / |L|  where R arrives;    Lambda(x) += weight R

    Where N . L = 0 exactly, as for an axis along a wall, light goes on as past a FREE node; that, and that light goes on in the
    layer until SOLID nodes end it, is this module's reading. R is `sky` beyond an open side and 0 beyond a wall. Returns the
    mean radiances E / pi and Lambda / (4 pi); with `gather`, normals G, the first is instead the sum of
    weight max(-G . L, 0) R / |L| / pi over all light that goes on from x.
    """
    zeros = jnp.zeros((fields.exitance.shape[0], *lattice.padded), fields.exitance.dtype)
    sums = (zeros, zeros if fluence else None)

    def one_face(face, own: Faces, plane: Plane, sums):
        slabs = _on_face(face, lambda f: _slabs(lattice, plane, f, fields, gather))
        edges = _on_face(face, lambda f: _edges(lattice, f))
        step = _Step(plane, slabs, edges, sky, scheme, lattice.spacing)
        return jax.tree.map(
            lambda total, s: total + _on_face(face, lambda f: lattice.turned_back(plane.unflat(s), f)),
            sums,
            _sweep_face(step, own, fluence),
        )

    if lattice.cubic:  # one program for the six faces: less to compile
        plane = lattice.plane(0)
        sums = lax.fori_loop(0, 6, lambda f, sums: one_face(f, jax.tree.map(lambda a: a[f], faces), plane, sums), sums)
    else:
        for face in range(6):
            sums = one_face(face, jax.tree.map(lambda a, f=face: a[f], faces), lattice.plane(face // 2), sums)
    arriving, seen = jax.tree.map(lattice.from_padded, sums)
    return arriving / jnp.pi, None if seen is None else seen / (4 * jnp.pi)


def _on_face(face: int | Array, function: Callable[[int], Any]) -> Any:
    """`function` of a face that is known now, or only when the program runs."""
    if isinstance(face, int):
        return function(face)
    return lax.switch(face, [lambda f=f: function(f) for f in range(6)])


class _Slabs(NamedTuple):
    """Everything on slabs, in separate arrays: slices of one stacked array keep XLA from vectorising the step."""

    normal: tuple[Array, ...]  # along (axis, u, v)
    gather: tuple[Array, ...] | None
    alive: Array
    exitance: Array
    extinction: Array | None
    source: Array | None


def _slabs(lattice: RayLattice | RayBlock, plane: Plane, face: int, fields: NodeFields, gather: Array | None) -> _Slabs:
    flat = lambda field: None if field is None else plane.flat(lattice.turned(field, face))
    along = lambda vectors: None if vectors is None else tuple(flat(vectors[a]) for a in AXES[face // 2])
    others = (fields.alive, fields.exitance, fields.extinction, fields.source)
    return _Slabs(along(fields.normal), along(gather), *map(flat, others))  # pyright: ignore[reportArgumentType]


class _Edges(NamedTuple):
    """Where the lattice ends on a face: which of the `entry_sides` are open, and its size along (u, v)."""

    open: Array
    size: Array


def _edges(lattice: RayLattice | RayBlock, face: int) -> _Edges:
    opened = [lattice.open[side] for side in entry_sides(face)]
    return _Edges(jnp.asarray(opened), jnp.asarray([lattice.shape[a] for a in AXES[face // 2][1:]]))


class _Own(NamedTuple):
    """One chunk of a face's directions."""

    direction: Array
    hop: Array
    length: Array
    weight: Array
    index: Array
    laps: Array


class _Around(NamedTuple):
    """What does not change from plane to plane: light beyond the sides, and the share of hops that is inside them."""

    before: Array | None
    light: Array | None
    inside: Array | None


class _Step(NamedTuple):
    """Everything the rays of one face share."""

    plane: Plane
    slabs: _Slabs
    edges: _Edges
    sky: Array | None  # radiance beyond open sides, (bands, directions)
    scheme: LightRayCube
    spacing: float

    def around(self, own: _Own) -> _Around:
        """What a chunk of directions meets at the sides of every plane: worked out once for all planes."""
        before, beside = self._beyond(own)
        return _Around(before, beside, None if self.slabs.extinction is None else self._inside(own))

    def _beyond(self, own: _Own) -> tuple[Array | None, Array | None]:
        """Light beyond the lattice: before the first plane, and at the inert nodes around every plane; [D, C, 1, P] each."""
        if self.sky is None:
            return None, None
        plane, edges = self.plane, self.edges
        row, column = plane.beyond(edges.size, own.hop)
        through = lambda hops, low, high: jnp.where(hops > 0, low, high)[:, None, None]
        u = through(own.hop[:, 0], edges.open[1], edges.open[2])
        v = through(own.hop[:, 1], edges.open[3], edges.open[4])
        # Where two sides meet, a wall goes on beyond the open one.
        across = (~row | u) & (~column | v)
        flat = lambda mask: mask.reshape(mask.shape[0], 1, 1, -1)
        light = self.sky.T[own.index][:, :, None, None]
        return jnp.where(flat(across & edges.open[0]), light, 0.0), jnp.where(flat(across & (row | column)), light, 0.0)

    def __call__(self, k: Array | int, rays: Array, own: _Own, around: _Around) -> tuple[Array, Array, Array]:
        """One hop, to slab k: the light that goes on; that arrives, times its cosine; and that is there."""
        plane, scheme = self.plane, self.scheme
        here = jax.tree.map(lambda a: lax.dynamic_index_in_dim(a, k, 0, keepdims=False), self.slabs)
        rays = plane.hop(rays, own.hop)
        if here.extinction is not None:
            rays = self._through_medium(k, rays, here, own, around)
        facing = _towards(here.normal, own)
        there = jnp.where(facing > _LEVEL, here.exitance, rays) * here.alive
        goes_on = there if scheme.grazing == "passes" else jnp.where(facing < -_LEVEL, 0.0, there)
        arrives = jnp.maximum(-facing, 0.0) * rays
        if here.gather is not None:
            arrives = jnp.maximum(-_towards(here.gather, own), 0.0) * goes_on
        return goes_on if around.light is None else goes_on + around.light, arrives, there

    def _through_medium(self, k: Array | int, rays: Array, here: _Slabs, own: _Own, around: _Around) -> Array:
        """What a hop leaves of light, and adds to it: the volume term (paper, section 8), with h the spacing,

        linear:       L (1 - d) + S d,  d = (gamma + zeta) M h,  so that S d = (zeta Lambda / 4 pi + emission) M h
        exponential:  L exp(-d) + S (1 - exp(-d)),  d = (gamma + zeta) |L| h

        Of a hop into the lattice d is the part inside.
        """
        assert here.extinction is not None and here.source is not None and around.inside is not None
        m, linear = self.scheme.half_width, self.scheme.attenuation == "linear"
        inside = around.inside
        if not self.plane.periodic:  # the first slab's hops come from before the first plane
            inside = jnp.minimum(inside, ((k * m + jnp.arange(m) + 0.5) / m)[:, None])
        nodes = m if linear else own.length[:, None, None, None]
        depth = here.extinction * (inside * (nodes * self.spacing))
        return here.source + (rays - here.source) * (1 - depth if linear else jnp.exp(-depth))

    def _inside(self, own: _Own) -> Array:
        """The share of each hop that is inside the lattice's sides along u and v; [D, 1, 1, P]."""
        plane = self.plane
        inside = jnp.ones((len(own.length), plane.height, plane.stride), own.length.dtype)
        for i, (place, wraps) in enumerate(((plane.rows, plane.wrap_u), (plane.columns, plane.wrap_v))):
            if not wraps:
                slope = own.hop[:, i, None]
                ahead = jnp.where(slope > 0, place, self.edges.size[i] - 1 - place)
                share = (jnp.maximum(ahead, 0) + 0.5) / jnp.maximum(jnp.abs(slope), 0.5)
                inside = jnp.minimum(inside, jnp.expand_dims(share, 2 - i))
        return inside.reshape(len(inside), 1, 1, -1)

    def start(self, own: _Own, before: Array | None) -> Array:
        plane, bands = self.plane, self.slabs.exitance.shape[1]
        shape = (own.weight.shape[0], bands, plane.half_width, plane.height * plane.stride)
        return jnp.broadcast_to(jnp.zeros((), self.slabs.exitance.dtype) if before is None else before, shape)

    def lap(self, rays: Array, own: _Own, around: _Around) -> Array:
        """Carry rays once around a periodic axis."""

        def slab_step(k, carry):
            _, rays = carry
            return rays, self(k, rays, own, around)[0]

        count = self.slabs.alive.shape[0]
        last_two = jnp.concatenate(lax.fori_loop(0, count, slab_step, (rays, rays)), axis=2)
        # The planes that the first M are reached from, in the last two slabs.
        before = (jnp.arange(self.plane.half_width) - self.plane.half_width) % self.plane.planes
        return last_two[:, :, before - (count - 2) * self.plane.half_width]


def _towards(normal: tuple[Array, ...], own: _Own) -> Float[Array, "D 1 M P"]:
    """N . L / |L|."""
    a, u, v = (own.direction[:, i, None, None, None] for i in range(3))
    return normal[0] * a + normal[1] * u + normal[2] * v


def _own(faces: Faces, number: Array) -> _Own:
    return _Own(*(a[number] for a in (faces.direction, faces.hop, faces.length, faces.weight, faces.index, faces.laps)))


def _sweep_face(step: _Step, faces: Faces, fluence: bool) -> tuple[Array, Array | None]:
    """Sums over a face's directions, on slabs: of weighted light that arrives, and of weighted light that is there."""
    count = step.slabs.alive.shape[0]

    def chunk_step(number, totals):
        own = _own(faces, number)
        around = step.around(own)

        def slab_step(k, carry):
            rays, (arriving, seen) = carry
            rays, arrives, there = step(k, rays, own, around)
            arriving = _add(arriving, k, own.weight, arrives)
            seen = None if seen is None else _add(seen, k, own.weight, there)
            return rays, (arriving, seen)

        rays = step.start(own, around.before)
        if step.plane.periodic:  # enough laps that where the light began no longer matters
            rays = lax.fori_loop(0, own.laps - 1, lambda _, r: step.lap(r, own, around), rays)
        return lax.fori_loop(0, count, slab_step, (rays, totals))[1]

    zeros = jnp.zeros_like(step.slabs.exitance)
    return lax.fori_loop(0, faces.chunks, chunk_step, (zeros, zeros if fluence else None))


def _add(total: Array, k: Array, weight: Array, values: Array) -> Array:
    row = lax.dynamic_index_in_dim(total, k, 0, keepdims=False)
    return lax.dynamic_update_index_in_dim(total, row + jnp.tensordot(weight, values, 1), k, 0)


def count_laps(lattice: RayLattice | RayBlock, fields: NodeFields, faces: Faces, scheme: LightRayCube) -> Faces:
    """The faces with the number of laps after which less than 1e-6 of the light on a periodic axis is left.

    Rays along an axis that meet nothing never end; so laps are counted until every ray that crosses the lattice's other axes
    has done so. What is still going then carries light from its last laps only.
    """
    m, others = lattice.half_width, [n for n, p in zip(lattice.shape, lattice.periodic, strict=True) if not p]
    dark = eqx.tree_at(lambda f: f.exitance, fields, jnp.zeros_like(fields.exitance))
    if fields.source is not None:
        dark = eqx.tree_at(lambda f: f.source, dark, jnp.zeros_like(fields.source))
    laps = []
    for face in range(6):
        plane, directions = lattice.plane(face // 2), jax.tree.map(lambda a, f=face: a[f], faces)
        step = _Step(plane, _slabs(lattice, plane, face, dark, None), _edges(lattice, face), None, scheme, lattice.spacing)
        most = -(-m * max(others or lattice.shape) // plane.planes) + 1

        def chunk_laps(number, step=step, directions=directions, most=most):
            own = _own(directions, number)
            around = step.around(own)
            lit = jnp.where(own.weight[:, None, None, None] > 0, jnp.ones_like(step.start(own, None)), 0.0)
            more = lambda state: (state[0] < most) & (lattice.largest(jnp.max(state[1])) > _ENDED)
            return lax.while_loop(more, lambda s: (s[0] + 1, step.lap(s[1], own, around)), (jnp.int32(0), lit))[0] + 1

        one = jnp.ones_like(faces.laps[face])
        laps.append(lax.map(chunk_laps, jnp.arange(len(one))) if plane.periodic else one)
    return eqx.tree_at(lambda f: f.laps, faces, jnp.stack(laps))
