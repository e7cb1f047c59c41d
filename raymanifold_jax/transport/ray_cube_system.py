"""A scene as the light-ray-cube scheme solves it: x = K x + b on nodes, and the way back to surface elements.

Unknowns are those of `operator`, with the scene's SURFACE nodes for elements. A surface element's irradiance, which
pictures and the energy balance are made of, is the mean over the nodes of the layer in front of it: the M nodes nearest to the
points k + 1/2 voxels along its normal, k = 0 ... M - 1. That is what an eye far away sees of a layer whose nodes
come in turn.

Light straight from sources: skies enter with the rays, as in the paper; so does the light of surfaces and media that
emit. Suns and point lights, whose directions are none of the cube's, are taken at each node exactly (a first flight): a
SURFACE node's irradiance from a sun is the sun's fluence in its voxel times |N . direction|.

Public: `CubeTransport`, `CubeSystem`, `make_cube_system`.
"""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, Float, Int

from .. import checks
from ..arrays import real_dtype
from ..direct import Direct, _from_point, _from_sun, brightest, sky_radiance
from ..iteration import System
from ..layout import make_layout
from ..operator import Light, materials
from ..partition import SAME, put
from ..placement import restored, stored
from ..quadrature import Quadrature, light_ray_cube
from ..scene import MIRROR, OPEN, PointLight, Scene, Sky, Sun
from ..surfaces import Surfaces
from .light_ray_cube import LightRayCube, NodeFields, count_laps, local_transformation
from .ray_cube_derivative import evolved, evolved_back
from .ray_layout import Faces, RayLattice, make_faces
from .ray_nodes import RayNodes, find_nodes
from .ray_partition import RayPartition, make_ray_partition


class CubeTransport(eqx.Module):
    """One coordinate evolution as an operator on the light of SURFACE nodes (elements) and voxels."""

    lattice: RayLattice | RayPartition
    scheme: LightRayCube
    faces: Faces
    fields: NodeFields  # without light
    cell: Int[Array, " E"] | Int[Array, "P I"]  # where SURFACE nodes are, on each device of a mesh

    @eqx.filter_jit
    def __call__(
        self, leaving: Light, sky: Float[Array, "C n"] | None = None, fluence: bool = True, scattered: bool = False
    ) -> Light:
        """Mean radiance arriving at SURFACE nodes and in voxels, of what leaves them and comes in through open sides.

        Light that is `scattered` is the same all over a voxel, as all light in the paper.
        """
        fields = self._with_light(leaving)
        arriving, seen = evolved(self.lattice, self.scheme, fields, self.faces, sky, None, fluence)
        return Light(self.lattice.collect(arriving, self.cell), seen)

    @eqx.filter_jit
    def outgoing(
        self, leaving: Light, sky: Float[Array, "C n"] | None, inward: Float[Array, "3 nx ny nz"]
    ) -> Float[Array, "C nx ny nz"]:
        """Mean radiance that goes out against the directions `inward`, at the nodes that have one."""
        fields, gather = self._with_light(leaving), self.lattice.to_padded(inward)
        return evolved(self.lattice, self.scheme, fields, self.faces, sky, gather, False)[0]

    @eqx.filter_jit
    def transposed(self, asked: Light, scattered: bool = False) -> Light:
        """The transpose in what leaves: weights of arriving light back to weights of what was sent."""
        fields = self._with_light(jax.tree.map(jnp.zeros_like, asked))
        weights = self.lattice.spread(asked.elements, self.cell), asked.voxels
        exitance, source = evolved_back(self.lattice, self.scheme, fields, self.faces, weights)
        exitance = self.lattice.collect(self.lattice.from_padded(exitance), self.cell)
        return Light(exitance, None if source is None else self.lattice.from_padded(source))

    def _with_light(self, leaving: Light) -> NodeFields:
        exitance, source = self.lattice.spread(leaving.elements, self.cell), None
        if self.fields.extinction is not None:
            source = self.lattice.to_padded(jnp.zeros_like(exitance) if leaving.voxels is None else leaving.voxels)
        return dataclasses.replace(self.fields, exitance=self.lattice.to_padded(exitance), source=source)


@dataclasses.dataclass(frozen=True)
class CubeSystem:
    """What a solve needs: the equations on nodes, and how their light is seen at the scene's surface elements."""

    system: System
    nodes: RayNodes
    surfaces: Surfaces
    quadrature: Quadrature
    column: np.ndarray  # (elements, M): rows of the node table in front of each element; -1: none
    sky: Float[Array, "C n"] | None
    sun_leaving: Float[Array, "C E"]  # mean radiance of the suns at the surface elements

    @property
    def solid(self) -> np.ndarray:
        return self.nodes.solid

    @property
    def _transport(self) -> CubeTransport:
        transport = self.system.transport
        assert isinstance(transport, CubeTransport)
        return transport

    def at_elements(self, rest: Light, sun: Light) -> tuple[Light, Light]:
        """The light at nodes as light at the scene's elements: means over layers, and what leaves through open sides."""
        leaving = self._leaving(rest + sun)
        rest, sun = restored(self._transport.lattice, (rest, sun))
        is_open = jnp.asarray(self.surfaces.open)
        seen = lambda light, through: Light(jnp.where(is_open, through, self._mean(light.elements)), light.voxels)
        return seen(rest, leaving), seen(sun, self.sun_leaving)

    def _mean(self, at_nodes: Float[Array, "C S"]) -> Float[Array, "C E"]:
        if not len(self.nodes.cell):
            return jnp.zeros((len(at_nodes), len(self.column)), at_nodes.dtype)
        weight = (self.column >= 0) / np.maximum((self.column >= 0).sum(1, keepdims=True), 1)
        picked = at_nodes[:, np.maximum(self.column, 0)]
        return jnp.einsum("cem,em->ce", picked, jnp.asarray(weight, at_nodes.dtype))

    def _leaving(self, arriving: Light) -> Float[Array, "C E"]:
        """Mean radiance that leaves through open sides, at their elements (0 elsewhere), of all light that arrives."""
        sent = local_transformation(self.system.materials, arriving)
        surfaces = self.surfaces
        transport = self._transport
        total = jnp.zeros((sent.elements.shape[0], len(surfaces)), sent.elements.dtype)
        for axis in range(3):
            rows = np.flatnonzero(surfaces.open & (surfaces.side // 2 == axis))
            if len(rows):
                inward = np.zeros((3, *self.nodes.solid.shape))
                ends = np.moveaxis(inward[axis], axis, 0)
                ends[0], ends[-1] = 1.0, -1.0
                inward = stored(transport.lattice, jnp.asarray(inward, sent.elements.dtype))
                out = restored(transport.lattice, transport.outgoing(sent, self.sky, inward))
                last = np.clip(surfaces.voxel[rows], 0, np.array(self.nodes.solid.shape) - 1)
                total = total.at[:, rows].set(out[(slice(None), *last.T)])
        return total


def make_cube_system(scene: Scene, surfaces: Surfaces, scheme: LightRayCube, mesh: Mesh | None = None) -> CubeSystem:
    """The equations of a scene, with the light straight from its sources; over a mesh if there is one.

    **Raises** `ValueError` for MIRROR sides, for a lattice too coarse for the half-width, and for linear attenuation where a
    hop's extinction is more than 1.
    """
    _check(scene, scheme)
    m = scheme.half_width
    nodes = find_nodes(scene, m)
    stuff = materials(scene, nodes.table)
    if stuff.extinction is not None:
        deepest = lax.stop_gradient(stuff.extinction.max())
        if not checks.is_traced(deepest):  # else jit or vmap keeps it
            _check_depth(scheme, float(deepest), scene.lattice.spacing)
    periodic = scene.boundary.periodic
    padded = [n if wraps else n + m for n, wraps in zip(scene.lattice.shape, periodic, strict=True)]
    opened = tuple(kind is OPEN for kind in scene.boundary.sides)
    lattice = RayLattice(scene.lattice.shape, (padded[0], padded[1], padded[2]), periodic, opened, m, scene.lattice.spacing)
    cell: Array = jnp.asarray(nodes.cell, np.int32)
    if mesh is not None:
        lattice, cell = make_ray_partition(lattice, mesh, nodes.cell)
    own = stored(lattice, stuff)
    real = real_dtype()
    spread = lambda field: lattice.to_padded(stored(lattice, jnp.asarray(field, real)))
    extinction = None if own.extinction is None else lattice.to_padded(own.extinction)
    fields = NodeFields(spread(nodes.normal), spread(~nodes.solid[None]), jnp.zeros((0, 0, 0, 0), real), extinction)
    faces = make_faces(m, m * lattice.largest_plane * scene.bands)
    if mesh is not None:
        faces = jax.tree.map(lambda a: put(mesh, a, SAME), faces)
    faces = _with_laps(lattice, fields, faces, scheme, scene.bands)
    transport = CubeTransport(lattice, scheme, faces, fields, cell)
    quadrature = light_ray_cube(m)
    has_sky = any(isinstance(light, Sky) for light in scene.lights)
    sky = sky_radiance(scene, quadrature.directions) if has_sky else None
    suns, suns_leaving = _suns(scene, surfaces, nodes)
    direct = Direct(stored(lattice, suns), _rest(scene, nodes, transport, own, sky), brightest(scene, sky))
    system = System(transport, own, direct)  # pyright: ignore[reportArgumentType]
    return CubeSystem(system, nodes, surfaces, quadrature, _columns(scene, surfaces, nodes, m), sky, suns_leaving)


def _check(scene: Scene, scheme: LightRayCube) -> None:
    for side, kind in enumerate(scene.boundary.sides):
        if kind is MIRROR:
            name = ("x-", "x+", "y-", "y+", "z-", "z+")[side]
            raise ValueError(
                f"boundary: got MIRROR at {name}, expected OPEN, PERIODIC or a Wall with scheme=LightRayCube; "
                "use scheme=rm.Characteristic(), or make the mirrored half a part of the scene"
            )


def _check_depth(scheme: LightRayCube, extinction: float, spacing: float) -> None:
    depth = extinction * scheme.half_width * spacing
    if scheme.attenuation == "linear" and depth > 1:
        raise ValueError(
            f"attenuation: got 'linear' and an extinction of {depth:.3g} a hop of {scheme.half_width} voxels, expected at most "
            "1 (1 - extinction must not be negative); use attenuation='exponential', more voxels, or a smaller half_width"
        )


def _with_laps(lattice: RayLattice | RayPartition, fields: NodeFields, faces: Faces, scheme: LightRayCube, bands: int) -> Faces:
    if not any(lattice.periodic):
        return faces
    dark = jnp.zeros((bands, *lattice.padded), fields.normal.dtype)
    source = None if fields.extinction is None else dark
    extinction = None if fields.extinction is None else lax.stop_gradient(fields.extinction)
    lit = dataclasses.replace(fields, exitance=dark, extinction=extinction, source=source)
    return _count_laps(lattice, lit, faces, scheme)


@eqx.filter_jit
def _count_laps(lattice: RayLattice | RayPartition, fields: NodeFields, faces: Faces, scheme: LightRayCube) -> Faces:
    if isinstance(lattice, RayLattice):
        return count_laps(lattice, fields, faces, scheme)
    local = lambda block, fields, _, faces: count_laps(block, fields, faces, scheme)
    return lattice.on_blocks(local, fields, (), faces, SAME)


def _rest(scene: Scene, nodes: RayNodes, transport: CubeTransport, stuff, sky) -> Light:
    """First-flight light of skies, emitting surfaces and media, and point lights."""
    emits = checks.may_differ_from_zero((stuff.emission, stuff.medium_source))
    if sky is None and not emits:
        dark = jnp.zeros((scene.bands, *scene.lattice.shape), stuff.emission.dtype)
        rest = Light(jnp.zeros_like(stuff.emission), stored(transport.lattice, dark))
    else:
        rest = transport(Light(stuff.emission, stuff.medium_source), sky)
    for light in scene.lights:
        if isinstance(light, PointLight):
            rest = rest + stored(transport.lattice, _from_point(scene, nodes.table, light))
    return rest


def _suns(scene: Scene, surfaces: Surfaces, nodes: RayNodes) -> tuple[Light, Float[Array, "C E"]]:
    """The suns' light at nodes and in voxels; and at surface elements, as the characteristic scheme sweeps it."""
    stuff, bands = materials(scene, surfaces), scene.bands
    in_voxels = jnp.zeros((bands, *scene.lattice.shape), stuff.emission.dtype)
    at_nodes = jnp.zeros((bands, len(nodes.cell)), in_voxels.dtype)
    at_elements = jnp.zeros((bands, len(surfaces)), in_voxels.dtype)
    suns = [light for light in scene.lights if isinstance(light, Sun)]
    layout = make_layout(scene, surfaces) if suns else None
    for sun in suns:
        assert layout is not None
        light = _from_sun(scene, surfaces, layout, sun, stuff)
        assert light.voxels is not None
        beam = jnp.where(nodes.solid, 0.0, light.voxels)
        cosine = np.maximum(-nodes.table.normal @ np.asarray(sun.direction), 0.0)
        # E = fluence times cosine, and means are E / pi and fluence / (4 pi).
        at_nodes = at_nodes + 4 * beam.reshape(bands, -1)[:, nodes.cell] * jnp.asarray(cosine, beam.dtype)
        in_voxels, at_elements = in_voxels + beam, at_elements + light.elements
    return Light(at_nodes, in_voxels), at_elements


def _columns(scene: Scene, surfaces: Surfaces, nodes: RayNodes, m: int) -> np.ndarray:
    """The SURFACE nodes in front of each element of a solid or wall; where there are none, the nearest one."""
    shape = np.array(scene.lattice.shape)
    number = np.full(shape, -1)
    number.reshape(-1)[nodes.cell] = np.arange(len(nodes.cell))
    start = np.asarray(scene.lattice.to_voxel(surfaces.position))
    ahead = start[:, None] + (np.arange(m) + 0.5)[:, None] * surfaces.normal[:, None]
    voxel = np.floor(ahead + 1e-9 * surfaces.normal[:, None]).astype(int)
    periodic = np.array(scene.boundary.periodic)
    inside = np.all(periodic | ((voxel >= 0) & (voxel < shape)), axis=2)
    voxel = np.where(periodic, voxel % shape, np.clip(voxel, 0, shape - 1))
    column = np.where(inside, number[tuple(np.moveaxis(voxel, 2, 0))], -1)
    for offset in _nearest_first(2 * m):
        bare = np.flatnonzero((column < 0).all(1) & ~surfaces.open)
        if not len(bare):
            break
        near = np.floor(start[bare]).astype(int) + offset
        inside = np.all(periodic | ((near >= 0) & (near < shape)), axis=1)
        column[bare, 0] = np.where(inside, number[tuple((near % shape).T)], -1)
    return column


def _nearest_first(reach: int) -> np.ndarray:
    side = np.arange(-reach, reach + 1)
    offsets = np.stack(np.meshgrid(side, side, side, indexing="ij"), -1).reshape(-1, 3)
    return offsets[np.argsort((offsets**2).sum(1), kind="stable")]
