"""Light at points and along rays, from a finished solution.

Surfaces reflect the interpolated irradiance of their elements and, exactly, each sun's: a shadow ray finds whether it is
lit. With albedo rho and emitted radiance L_e, a ray that ends on a surface behind transmittance T sees

    L = T (rho / pi (E + sum over suns) + L_e) + what the medium scatters and emits on the way,

and one that leaves sees T times the sky. The sun's disc itself is not seen.

Public names: `radiance`, `irradiance`, `fluence`, `outgoing_flux`; `surface_radiance` and `LightField` for this package.
"""

from __future__ import annotations

import itertools
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import checks
from .arrays import as_jax, numpy_or_jax, worked_out_now
from .cubature import mean_of_rays
from .direct import sky_radiance
from .directions import gathering
from .emitters import emitter_light, point_light, small_emitters
from .interpolation import ElementTable, element_table, interpolate_irradiance, slopes
from .keep import keep
from .march import fill, interpolate, march_between, transmittance_between
from .programs import program
from .scene import MIRROR, OPEN, SIDES, PointLight, Scene, Solid, Sun, Wall
from .solution import Solution
from .texture import Texture, value_at
from .trace import Hit, trace_rays
from .unfolding import in_blocks, sloped, to_voxel
from .volume_sources import compact_sources, emission_of, volume_light, with_emission

_OFF = 2e-3  # voxels: how far off a surface rays start
_DEEP = 0.5  # voxels: how far inside a solid a point on its surface may be by mistake
_POINTS = 256  # points of a final gather at once, with _RAYS rays and one band each
_RAYS = 1024
_TOLERANCE = 2.5e-3  # standard error of a gather, of the mean
_BLOCKS = 5  # of a volume source, along each axis, for one of the solve's


class LightField(eqx.Module):
    """A solution made ready to be looked up: fields without gaps, elements by voxel, materials by index."""

    scene: Scene
    diffuse: Float[Array, "C nx ny nz"]
    fluence: Float[Array, "C nx ny nz"]
    table: ElementTable
    irradiance: Float[Array, "E C"]
    slope: Float[Array, "E C 3"]
    albedo: Float[Array, "M C"]
    emission: Float[Array, "M C"]


def radiance(solution: Solution, origins: Any, directions: Any) -> Float[Array, "n *bands"]:
    """What an eye at `origins` sees along `directions`, (n, 3) each, in W m^-2 sr^-1.

    Directions may have any length but 0. Walls are seen from inside only: an eye outside the lattice looks through those
    in front of it.

    **Raises** `TypeError` for anything but a solution, `ValueError` for NaN, another shape, a direction of length 0, or an
    origin inside a solid.
    """
    _check_solution(solution)
    origins, directions = _rays(origins, directions, "origins", "directions")
    check_outside(solution.scene, "origins", origins)
    return _banded(solution.scene, in_blocks(radiance_along, light_field(solution), (origins, directions)))


def irradiance(solution: Solution, points: Any, normals: Any, directions: int | None = None) -> Float[Array, "n *bands"]:
    """Irradiance at surface points by a final gather, (n, 3) each, in W m^-2.

    The mean of the radiance over `directions` directions spread over the hemisphere around each normal, and the light
    of suns, point lights, small emitting surfaces and compact volume sources exactly. By default 1024 directions and, at
    points that see edges of bright and dark, up to 40 000 more along them (see `cubature`). The normals may have any length
    but 0. Points up to half a voxel inside a solid or outside the lattice are taken to be on the surface.

    **Raises** `TypeError` for anything but a solution, `ValueError` for NaN, another shape, a normal of length 0, or points
    further inside.
    """
    _check_solution(solution)
    points, normals = _rays(points, normals, "points", "normals")
    number = None if directions is None else checks.positive_int("directions", directions)
    points = _lift(solution.scene, points, normals)
    return _banded(solution.scene, _gathered(solution, points, normals, number))


def fluence(solution: Solution, points: Any, directions: int | None = None) -> Float[Array, "n *bands"]:
    """Fluence at points (n, 3) of the space that solids leave free, in W m^-2, by a final gather.

    4 pi times the mean of the radiance over `directions` directions, and the light of suns, point lights, small emitting
    surfaces and compact volume sources exactly. By default 2048 directions and, where edges of bright and dark are seen, up to
    40 000 more along them (see `cubature`). With `directions=0` it is interpolated between the voxels instead: quick, for
    many points.

    **Raises** `TypeError` for anything but a solution, `ValueError` for NaN, another shape, or points outside the lattice or
    inside a solid.
    """
    _check_solution(solution)
    points, scene = checks.points("points", points), solution.scene
    number = None if directions is None else checks.positive_int("directions", directions, at_least=0)
    if isinstance(points, np.ndarray):
        outside = ~np.asarray(scene.lattice.contains(points))
        if outside.any():
            at = int(np.argmax(outside))
            advice = "there is no medium and no voxel there: leave it out"
            checks.fail(f"points[{at}]", points[at].tolist(), f"a point of the lattice, {scene.lattice.box}", advice)
    check_outside(scene, "points", points)
    if number == 0:
        return _banded(scene, in_blocks(_fluence_at, light_field(solution), (points,)))
    margin = _OFF * scene.lattice.spacing
    clip = np.clip if isinstance(points, np.ndarray) else jnp.clip
    points = clip(points, scene.lattice.lower + margin, scene.lattice.upper - margin)
    return _banded(scene, _gathered(solution, points, None, number))


def _gathered(solution: Solution, points: Any, normals: Any, number: int | None) -> Float[Array, "n C"]:
    """The light at some points: the mean over directions of what rays see, and what comes straight from small sources."""
    scene, margin = solution.scene, _OFF * solution.scene.lattice.spacing
    field = light_field(solution)
    compact = compact_sources(scene, solution.elements, _BLOCKS)
    if compact is not None:
        rest = jnp.where(compact.emits, 0.0, emission_of(scene))
        field = eqx.tree_at(lambda f: f.scene, field, with_emission(scene, rest))
    emitters = small_emitters(scene, solution.elements)
    far = np.zeros(len(points), bool) if emitters is None else ~emitters.near(points)
    dark = eqx.tree_at(lambda f: f.emission, field, jnp.zeros_like(field.emission))
    total = jnp.zeros((len(points), scene.bands))
    pick = lambda chosen: None if normals is None else normals[chosen]
    for chosen, seen in ((np.nonzero(~far)[0], field), (np.nonzero(far)[0], dark)):
        if len(chosen):
            total = total.at[chosen].set(_mean_of_rays(seen, points[chosen], pick(chosen), number))
    if emitters is not None and far.any():
        (chosen,) = np.nonzero(far)
        on_surface = points[chosen] if normals is None else points[chosen] - margin * normals[chosen]
        total = total.at[chosen].add(emitter_light(scene, emitters, on_surface, pick(chosen)).T)
    if compact is not None:
        total = total + volume_light(scene, compact, points, normals, rays=4 * (number or _fewest(normals))).T
    for light in scene.lights:
        if isinstance(light, PointLight):
            total = total + point_light(scene, light, points, normals).T
    suns = (points,) if normals is None else (points, normals)
    return total + in_blocks(_sun_fluence if normals is None else _sun_irradiance, scene, suns)


def _mean_of_rays(field: LightField, points: Any, normals: Any, number: int | None) -> Float[Array, "n C"]:
    """4 pi times the mean of the radiance over the sphere; with normals pi times its mean, weighted by the cosine.

    Without a `number` of rays as many as it takes, where that can be known now.
    """
    whole = 4 * jnp.pi if normals is None else jnp.pi
    parts = []
    size = max(1, _POINTS * _RAYS // ((number or _fewest(normals)) * field.scene.bands))
    for i in range(0, len(points), size):
        block, around = points[i : i + size], None if normals is None else normals[i : i + size]
        see = lambda point, rays, block=block: in_blocks(radiance_along, field, (block[point], rays))
        if number is None:
            parts.append(mean_of_rays(see, len(block), around, _TOLERANCE))
        else:
            rays = gathering(number, len(block), around).reshape(-1, 3)
            seen = see(np.repeat(np.arange(len(block)), number), rays)
            parts.append(seen.reshape(len(block), number, -1).mean(1))
    return whole * jnp.concatenate(parts)


def _fewest(normals: Any) -> int:
    """Rays around a normal, or over the whole sphere, to begin with."""
    return 2 * _RAYS if normals is None else _RAYS


def outgoing_flux(solution: Solution, side: str) -> Float[Array, "nu nv *bands"]:
    """Power per area that leaves through an open side, in W m^-2, one value for each voxel's face.

    `side` is one of x-, x+, y-, y+, z-, z+; axes are the other two in increasing order: z+ gives (nx, ny). Where a solid
    covers part of a face, the mean over the whole face: the sum times the face's area is the power that leaves.

    **Raises** `ValueError` for another name or a side that is not OPEN.
    """
    _check_solution(solution)
    if side not in SIDES:
        checks.fail("side", repr(side), f"one of {', '.join(SIDES)}", 'the upper side of z is "z+"')
    number, scene, elements = SIDES.index(side), solution.scene, solution.elements
    kind = scene.boundary.sides[number]
    if kind is not OPEN:
        got = f"{side}, which is {'a Wall' if isinstance(kind, Wall) else kind.name}"
        checks.fail("side", got, "an OPEN side", "no light leaves through others; make it OPEN in Boundary(...)")
    kept = np.nonzero(elements.open & (elements.side == number))[0]
    u, v = (axis for axis in range(3) if axis != number // 2)
    share = as_jax(elements.area[kept] / scene.lattice.spacing**2, solution.diffuse_irradiance.dtype)
    values = (solution.diffuse_irradiance + solution.sun_irradiance)[:, kept] * share
    flux = jnp.zeros((scene.lattice.shape[u], scene.lattice.shape[v], scene.bands), values.dtype)
    flux = flux.at[elements.voxel[kept, u], elements.voxel[kept, v]].add(values.T)
    return flux if scene.banded else flux[..., 0]


# Looking up


def light_field(solution: Solution) -> LightField:
    """The solution made ready; made once for each."""
    make = lambda: _light_field(solution)
    return make() if checks.is_traced(solution) else keep((solution,), "light field", make)


def _light_field(solution: Solution) -> LightField:
    scene, bands = solution.scene, solution.scene.bands
    owners = [*scene.solids, *(side if isinstance(side, Wall) else None for side in scene.boundary.sides)]
    real = solution.diffuse_irradiance.dtype
    xp = numpy_or_jax(owners)
    spread = lambda o, name: xp.broadcast_to(xp.asarray(0.0 if o is None else getattr(o, name), real), (bands,))
    diffuse = fill(solution.diffuse_fluence, solution.free)
    table = keep((solution.elements,), "element table", lambda: element_table(scene, solution.elements))
    values = _transposed(solution.diffuse_irradiance) if len(solution.elements) else jnp.zeros((1, bands), real)
    return LightField(
        scene=scene,
        diffuse=diffuse,
        fluence=_sum(diffuse, fill(solution.sun_fluence, solution.free)),
        table=table,
        irradiance=values,
        slope=slopes(scene, table, values),
        albedo=as_jax(xp.stack([spread(None if o is None or isinstance(o.albedo, Texture) else o, "albedo") for o in owners])),
        emission=as_jax(xp.stack([spread(o, "emission") for o in owners])),
    )


@program
def _transposed(values: Array) -> Array:
    return values.T


@program
def _sum(one: Array, other: Array) -> Array:
    return one + other


def surface_radiance(field: LightField, hit: Hit) -> Float[Array, "n C"]:
    """Radiance that leaves the surfaces at hits, in every direction; 0 where there is none."""
    arriving, albedo = surface_light(field, hit)
    return albedo / jnp.pi * arriving + jnp.where((hit.material >= 0)[:, None], field.emission[hit.material], 0.0)


def surface_light(field: LightField, hit: Hit) -> tuple[Float[Array, "n C"], Float[Array, "n C"]]:
    """Irradiance and albedo of the surfaces at hits; 0 where there is none."""
    scene = field.scene
    u = to_voxel(scene, hit.point)
    arriving = interpolate_irradiance(scene, field.table, field.irradiance, field.slope, u, hit.normal)
    arriving = arriving + _sun_irradiance(scene, hit.point + _OFF * scene.lattice.spacing * hit.normal, hit.normal)
    there = (hit.material >= 0)[:, None]
    return jnp.where(there, arriving, 0.0), jnp.where(there, _albedo(field, jnp.maximum(hit.material, 0), hit.point), 0.0)


def _albedo(field: LightField, material: Array, points: Array) -> Float[Array, "n C"]:
    scene, albedo = field.scene, field.albedo[material]
    for number, owner in enumerate([*scene.solids, *scene.boundary.sides]):
        if isinstance(owner, Solid | Wall) and isinstance(owner.albedo, Texture):
            here = value_at(owner.albedo, scene.lattice, points, scene.bands)
            albedo = jnp.where((material == number)[:, None], here, albedo)
    return albedo


def radiance_along(field: LightField, origins: Array, directions: Array) -> Float[Array, "n C"]:
    """`radiance` for one block of rays with directions of length 1."""
    scene = field.scene
    hit = trace_rays(scene, origins, directions)
    behind = jnp.where((hit.material >= 0)[:, None], surface_radiance(field, hit), sky_radiance(scene, -hit.direction).T)
    if scene.medium is None:
        return behind
    added, passed = march_between((scene, field.fluence), origins, directions, hit.enter, hit.distance)
    return added + passed * behind


def _fluence_at(field: LightField, points: Array) -> Float[Array, "n C"]:
    scene = field.scene
    return interpolate(scene, field.diffuse, to_voxel(scene, points)) + _sun_light(scene, points, None)


def _sun_irradiance(scene: Scene, points: Array, normals: Array) -> Float[Array, "n C"]:
    return _sun_light(scene, points, normals)


def _sun_fluence(scene: Scene, points: Array) -> Float[Array, "n C"]:
    return _sun_light(scene, points, None)


def _sun_light(scene: Scene, points: Array, normals: Array | None) -> Float[Array, "n C"]:
    """Direct light of all suns at points off the surfaces: irradiance, or fluence without normals."""
    total = jnp.zeros((len(points), scene.bands), points.dtype)
    sides = scene.boundary.sides
    mirrors = [axis for axis in range(3) if MIRROR in sides[2 * axis : 2 * axis + 2]]
    for sun in scene.lights:
        if not isinstance(sun, Sun):
            continue
        direction = jnp.asarray(sun.direction, points.dtype)
        for flips in itertools.product((False, True), repeat=len(mirrors)):
            # By mirrors, beams arrive along reflected directions as well; each path is looked for once.
            sign, share = jnp.ones(3, points.dtype), jnp.ones((), points.dtype)
            for axis, flipped in zip(mirrors, flips, strict=True):
                if flipped:
                    sign = sign.at[axis].set(-1.0)
                    share = jnp.where(direction[axis] == 0, 0.0, share)
            travel = direction * sign
            back = jnp.broadcast_to(-travel, points.shape)
            if normals is None:
                lit = _sunlit(scene, points, back, -direction) * share
            else:
                cosine = jnp.maximum(-(normals @ travel), 0.0)[:, None]
                # Rays from surfaces that face away start where they meet nothing, and take no time.
                start = jnp.where(cosine > 0, points, _beyond(scene, -travel))
                lit = _sunlit(scene, start, back, -direction) * share * cosine
            total = total + lit * jnp.broadcast_to(sun.irradiance, (scene.bands,)).astype(points.dtype)
    return total


def _beyond(scene: Scene, direction: Array) -> Float[Array, " 3"]:
    """A point that has the lattice behind it, seen along a direction."""
    lower, upper = (jnp.asarray(corner, direction.dtype) for corner in (scene.lattice.lower, scene.lattice.upper))
    return (lower + upper) / 2 + 2 * jnp.linalg.norm(upper - lower) * direction


def _sunlit(scene: Scene, points: Array, back: Array, towards: Array) -> Float[Array, "n C"]:
    """Transmittance to the sun, 0 in shadow: the ray back must leave through an open side, straight towards it."""
    hit = trace_rays(scene, points, back)
    lit = (hit.material < 0) & (jnp.abs(hit.direction - towards).max(-1) < 1e-6)
    if scene.medium is None:
        return jnp.broadcast_to(lit[:, None], (len(points), scene.bands)).astype(points.dtype)
    spacing = scene.lattice.spacing
    # A point on a solid that stands out of an open side is outside already: nothing is on the way.
    inside = lit & jnp.isfinite(hit.distance)
    reach = jnp.where(inside, hit.distance, 0.0) / spacing
    enter = jnp.where(inside, hit.enter, 0.0) / spacing
    passed = transmittance_between(scene, to_voxel(scene, points), sloped(back), enter, jnp.maximum(reach, enter))
    return jnp.where(lit[:, None], passed, 0.0)


def _banded(scene: Scene, values: Float[Array, "n C"]) -> Float[Array, "n *bands"]:
    return values if scene.banded else values[:, 0]


# Points, directions and what can be wrong with them


def _check_solution(solution: Any) -> None:
    checks.instance("solution", solution, Solution, "pass what rm.solve(scene) returns")


def check_outside(scene: Scene, name: str, points: Any) -> None:
    """Raise `ValueError` if any of `points` (n, 3) is inside a solid."""
    _check_depth(scene, name, points, 0.01, "outside the solids", "move it out of the solid")


def _check_depth(scene: Scene, name: str, points: Any, deepest: float, expected: str, advice: str) -> None:
    if not scene.solids or checks.is_traced((scene, points)) or not len(points):
        return
    depth = -np.asarray(in_blocks(Scene.distance, scene, (points,))) / scene.lattice.spacing
    at = int(np.argmax(depth))
    if depth[at] > deepest:
        solid = int(scene.solid_at(jnp.asarray(points[at], float)))
        got = f"{np.asarray(points[at]).tolist()}, {depth[at]:.3g} voxels inside solids[{solid}]"
        checks.fail(f"{name}[{at}]", got, f"a point {expected}", advice)


def _rays(points: Any, vectors: Any, points_name: str, vectors_name: str) -> tuple[Any, Any]:
    """Both checked, the vectors scaled to length 1."""
    points, vectors = checks.points(points_name, points), checks.points(vectors_name, vectors)
    if points.shape != vectors.shape:
        got = f"shapes {points.shape} and {vectors.shape}"
        checks.fail(f"{points_name} and {vectors_name}", got, "as many of one as of the other", "repeat the shorter one")
    if not isinstance(vectors, np.ndarray):
        return points, vectors / jnp.linalg.norm(vectors, axis=-1, keepdims=True)
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if (length == 0).any():
        at = int(np.argmin(length))
        checks.fail(f"{vectors_name}[{at}]", vectors[at].tolist(), "a vector of non-zero length", "leave that one out")
    return points, vectors / length


def _lift(scene: Scene, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Surface points moved off the surface, into the lattice."""
    lattice = scene.lattice
    u = np.asarray(lattice.to_voxel(points))
    beyond = np.maximum(-u, u - np.asarray(lattice.shape)).max(-1, initial=-np.inf)
    if len(points) and beyond.max() > _DEEP:
        at = int(np.argmax(beyond))
        expected = f"a point of the lattice, {scene.lattice.box}"
        checks.fail(f"points[{at}]", points[at].tolist(), expected, "there are no surfaces outside it: leave it out")
    advice = "pass points on a surface, or fluence(...) for points in space"
    _check_depth(scene, "points", points, _DEEP, "on a surface", advice)
    spacing = lattice.spacing
    for _ in range(2 if len(points) and scene.solids else 1):
        with worked_out_now():
            near = (
                np.asarray(in_blocks(Scene.distance, _untraced(scene), (points,)), np.float64) if len(points) else np.zeros(0)
            )
        points = points + np.maximum(_OFF * spacing - near, 0.0)[:, None] * normals
    margin = _OFF * spacing
    return np.clip(points, lattice.lower + margin, lattice.upper - margin)


def _untraced(scene: Scene) -> Scene:
    """The same geometry, with any numbers for values that are traced."""
    return jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype) if checks.is_traced(leaf) else leaf, scene)
