"""Solving a scene for the light everywhere.

The scene becomes surface elements and a layout for the sweeps; light straight from the sources is worked out once; bounced
light is iterated to a certified bound (see `iteration`).

Public: `solve`; `resolve` for `Solution.resolve`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.sharding import Mesh
from jaxtyping import Array, Bool, Float

from . import checks
from .acceleration import make_diffusion
from .arrays import as_jax, numpy_or_jax, on_accelerator, real_dtype, stop_gradient, worked_out_now, zeros_like
from .checkpoint import Checkpoint
from .direct import first_flight, sky_radiance
from .implicit import Unwatched, attach
from .iteration import Iteration, System, certify
from .memory import check_memory
from .operator import Light, Materials, Transport, make_transport, materials
from .optimistix_solver import OptimistixFixedPoint
from .placement import check_agreement, restored, stored
from .prepare import Prepared, let_go, prepare_once
from .programs import program
from .progress import Progress, make_progress
from .quadrature import Quadrature, for_scene
from .scene import OPEN, PointLight, Scene, Sky, Sun, Wall
from .sharding import check_mesh
from .solution import Energy, Solution, _Hidden
from .solvers import Anderson, Jacobi, Krylov, Orders, automatic, worth_diffusing
from .source_checks import check_sources
from .surfaces import Surfaces
from .transport import native
from .transport.characteristic import Characteristic
from .transport.light_ray_cube import LightRayCube
from .transport.ray_cube_system import CubeSystem, make_cube_system


def solve(
    scene: Scene,
    quadrature: Quadrature | None = None,
    scheme: Characteristic | LightRayCube | None = None,
    rtol: float = 1e-4,
    solver: Jacobi | Krylov | Anderson | OptimistixFixedPoint | str = "auto",
    max_sweeps: int = 1000,
    throw: bool = False,
    progress: bool | Progress | None = None,
    mesh: Mesh | None = None,
    checkpoint: Checkpoint | None = None,
    prepared: Prepared | None = None,
    bounces: int | None = None,
    start: Solution | None = None,
) -> Solution:
    """Solve a scene for the light everywhere.

    JAX differentiates the solution in every physical value of the scene, forwards and backwards, at about the cost of one more
    solve (`implicit`); shapes, and directions and positions of lights, have no derivative. Under `jit` and `vmap` no error
    bound is known (`Solution.error_bound` is nan), and emission that is traced is swept, in compact parts too.

    **Arguments:**

    - `quadrature`: directions of the sweeps; `rm.quadrature.for_scene(scene)` if None, about 200. More directions reduce ray
      effects; time grows with their number.
    - `scheme`: `rm.Characteristic()`, or the paper's `rm.LightRayCube(half_width=5)`, which brings its own directions:
      leave `quadrature` out.
    - `rtol`: the certified error bound's target, relative to the largest radiosity or medium source (times pi).
    - `solver`: `rm.Krylov()`, `rm.Anderson()`, `rm.OptimistixFixedPoint(...)` or the paper's `rm.Jacobi()`. "auto" takes
      `Jacobi` with the paper's scheme and where little is reflected, else `Krylov`, with diffusion where light bounces often or
      the medium is thick: see `Solution.solver`.
    - `max_sweeps`: the iteration stops there at the latest. With `Jacobi`, k of them are k of the paper's iterations: light
      straight from the sources, and k bounces. With `throw`, that raises `RuntimeError`; without, read
      `Solution.converged` and `Solution.result`.
    - `checkpoint`: an `rm.Checkpoint`, in which the iteration keeps its state, and from which it may go on.
    - `prepared`: what `prepare(scene)` gave for a scene of the same shapes, lattice and kinds of sides, to save time; pass
      the same `quadrature` each time as well.
    - `bounces`: only light that surfaces and medium have sent on at most so many times before it arrives; `None`: all of it.
      With 0 it comes straight from the sources, and pictures show what surfaces and fog send on once: single scattering. The
      bound then tells how far that is from all the light. `solver` has no say.
    - `start`: a solution of the same geometry whose light is near this one's, to begin with; `Solution.resolve` does that. Not
      with `bounces`, a checkpoint, the paper's scheme, nor under JAX's transformations.
    - `mesh`: `rm.pe_array(nu, nv)` splits the lattice over devices (see `partition`). Results are the same to rounding. What
      needs no sweep is done on one device: the geometry, light straight from point lights and small emitters, readings of
      the solution. Not under `jit` and `vmap`.
    - `progress`: True or None shows a bar on a terminal when the solve takes long; False never; or a `Progress`.

    With the extra `fast`, two other processes compile loops for up to a minute at the very first solve of an installation.

    **Raises** `ValueError` or `TypeError` for unusable arguments, traced shapes among them, before any work; `RuntimeError`
    with `throw`.
    """
    _check_arguments(scene, quadrature, scheme, rtol, solver, max_sweeps, mesh, checkpoint, prepared)
    if start is not None:
        _check_start(scene, start, bounces, checkpoint)
    options = {"rtol": rtol, "scheme": scheme, "mesh": mesh}
    chosen = solver if bounces is None else _orders(bounces, scene, checkpoint)
    cube = scheme if isinstance(scheme, LightRayCube) else None
    quadrature = for_scene(scene) if quadrature is None else quadrature
    if prepared is None:
        let_go()
    check_memory(scene.lattice.shape, scene.bands, len(quadrature), scene.medium is not None)
    if mesh is None and cube is None and not on_accelerator() and not checks.is_traced(scene.medium):
        native.compile_aside(real_dtype(), scene.medium is not None)
    meter = make_progress(progress)
    with meter:
        meter.start(f"solve {scene.summary()}")
        prepared = prepare_once(scene) if prepared is None else prepared.used_again()
        surfaces = prepared.surfaces
        layout = prepared.layout_on(mesh if cube is None else None)
        with worked_out_now():
            check_sources(scene, surfaces)
        stuff = materials(scene, surfaces)
        _check_steady(scene, surfaces, stuff)
        if mesh is not None:
            geometry = (surfaces.position, surfaces.normal, surfaces.area)
            numbers = stop_gradient((geometry, stuff, quadrature.directions, float(rtol)))
            check_agreement("scene", numbers)
            check_agreement("scheme", np.frombuffer(repr(cube).encode(), np.uint8))
        nodes = None if cube is None else make_cube_system(scene, surfaces, cube, mesh)
        again = None
        if nodes is not None:
            system, quadrature = nodes.system, nodes.quadrature
        else:
            area = surfaces.area if _exchanges(scene, stuff) else None
            own = stored(layout, stuff)
            make = lambda: make_transport(
                layout, quadrature, own.extinction, scene.bands, area=area, albedo=own.scattering_albedo
            )
            key = (id(quadrature), scene.bands, area is None, mesh)
            transport = prepared.reuse(key, (stuff.extinction, stuff.scattering_albedo), make, quadrature)
            system = System(transport, own, first_flight(scene, surfaces, transport, quadrature, own, prepared, key))
            # What speeds up and certifies the iteration is the same for other lights.
            values = stop_gradient((stuff.albedo, stuff.scattering_albedo, stuff.extinction))
            again = lambda make, near: prepared.reuse(("certificate", near, *key), values, make, quadrature)
        first = None if start is None or nodes is not None else stored(layout, _sent(start, stuff))
        iteration, chosen = _iterate(system, surfaces, again, float(rtol), chosen, max_sweeps, meter, checkpoint, first)
        if not prepared.keeps:
            prepared.forget()  # blocks on a mesh
        hidden = _Hidden(surfaces, prepared, quadrature, options)
        solution = _finish(scene, surfaces, quadrature, stuff, iteration, nodes, chosen, hidden)
    if throw and not solution.converged and solution.ending != "as asked":
        raise RuntimeError(f"solve: {solution.result}")
    return solution


def resolve(solution: Solution, scene: Scene, options: Mapping[str, Any]) -> Solution:
    """`Solution.resolve`."""
    checks.instance("scene", scene, Scene, "make one with rm.Scene(lattice, solids=[...], ...)")
    before = solution._hidden
    given: dict[str, Any] = dict(before.options or {}) | dict(options)
    if given.get("scheme") is None or isinstance(given["scheme"], Characteristic):
        given.setdefault("quadrature", before.quadrature)
    if given.get("bounces") is None and given.get("checkpoint") is None:
        given.setdefault("start", solution)
    if not _same_geometry(solution.scene, scene):
        got = "a scene of another geometry"
        checks.fail("scene", got, "the lattice, shapes and kinds of sides that were solved", "use rm.solve(scene)")
    given.setdefault("prepared", before.prepared)
    return solve(scene, **given)


def _same_geometry(one: Scene, other: Scene) -> bool:
    kinds = lambda scene: [Wall if isinstance(side, Wall) else side for side in scene.boundary.sides]
    shapes = lambda scene: [solid.shape for solid in scene.solids]
    return kinds(one) == kinds(other) and bool(eqx.tree_equal((one.lattice, shapes(one)), (other.lattice, shapes(other))))


def _check_start(scene: Scene, start: Solution, bounces: int | None, checkpoint: Checkpoint | None) -> None:
    checks.instance("start", start, Solution, "pass what rm.solve returned")
    if bounces is not None or checkpoint is not None:
        checks.fail("start", "a solution, with bounces or a checkpoint", "None", "these begin with no light: leave it out")
    if not _same_geometry(start.scene, scene):
        checks.fail("start", "a solution of another geometry", "one of the scene's", "leave it out")


def _sent(start: Solution, stuff: Materials) -> Light | None:
    """What surfaces and medium would send of a solution's light; None if its bands are others."""
    found = start.diffuse_irradiance, start.sun_irradiance, start.diffuse_fluence, start.sun_fluence
    if found[0].shape != stuff.albedo.shape or checks.is_traced((found, stuff)):
        return None
    total = _in_all(*found)
    return stuff.reflected(total if stuff.scattering_albedo is not None else Light(total.elements))


@program
def _in_all(diffuse_irradiance: Array, sun_irradiance: Array, diffuse_fluence: Array, sun_fluence: Array) -> Light:
    return Light((diffuse_irradiance + sun_irradiance) / jnp.pi, (diffuse_fluence + sun_fluence) / (4 * jnp.pi))


def _iterate(
    system: Any, surfaces: Surfaces, again: Callable | None, rtol: float, solver: Any, most: int, meter: Progress,
    checkpoint: Checkpoint | None, start: Light | None,
) -> tuple[Iteration | Unwatched, Any]:  # fmt: skip
    """The iteration when it is over, and the solver it was left to. `again` is None in the paper's scheme."""
    traced = checks.is_traced(system)
    known = stop_gradient(system) if traced else system
    if checks.is_traced(known):
        iteration, near = Unwatched(system, rtol, most), None
        solver = iteration.solver
    else:
        fresh = []
        if isinstance(solver, str):
            paper = again is None
            solver = Jacobi() if paper else automatic(known, _depth(known.materials, known.transport.layout.spacing))
        diffuse = again is not None and worth_diffusing(known, solver)

        def diffusion_and_certificate():
            fresh.append(True)
            near = make_diffusion(known.transport, surfaces, known.materials) if diffuse else None
            return near, certify(known if near is None else dataclasses.replace(known, near=near))

        make = diffusion_and_certificate
        near, certificate = make() if again is None or traced else again(make, diffuse)
        known = known if near is None else dataclasses.replace(known, near=near)
        certificate = certificate if fresh else dataclasses.replace(certificate, sweeps=0)
        iteration = Iteration(known, certificate, rtol, most, meter)
        if start is not None:
            iteration.start_from(start)
        if checkpoint is not None:
            iteration.resume(checkpoint)
        solver.run(iteration)
        iteration.tighten()
    if traced:
        iteration.system = dataclasses.replace(system, near=near)
        iteration.arriving = attach(iteration.system, iteration.arriving, rtol, most)
    return iteration, solver


def _orders(bounces: int, scene: Scene, checkpoint: Checkpoint | None) -> Orders:
    bounces = checks.positive_int("bounces", bounces, at_least=0)
    if checks.is_traced(scene):
        checks.fail("bounces", f"{bounces} under JAX's transformations", "None", "derivatives are of all light", TypeError)
    if checkpoint is not None:
        checks.fail("checkpoint", f"one with bounces={bounces}", "None", "so few sweeps need none")
    return Orders(bounces)


def _depth(stuff: Materials, spacing: float) -> float:
    """The largest optical depth along an axis of the lattice, or a little more."""
    if stuff.extinction is None:
        return 0.0
    return float(_longest(stuff.extinction)) * spacing


@program
def _longest(extinction: Float[Array, "C nx ny nz"]) -> Float[Array, ""]:
    return jnp.stack([jnp.max(jnp.sum(extinction, axis)) for axis in (1, 2, 3)]).max()


def _exchanges(scene: Scene, stuff: Materials) -> bool:
    """Whether anything sends light through the sweeps of the solve: else nothing needs balancing."""
    fields = (stuff.albedo, stuff.emission, stuff.scattering_albedo, stuff.medium_source)
    return any(isinstance(light, Sky) for light in scene.lights) or any(map(checks.may_differ_from_zero, fields))


def _check_arguments(scene, quadrature, scheme, rtol, solver, max_sweeps, mesh, checkpoint, prepared) -> None:
    checks.instance("scene", scene, Scene, "make one with rm.Scene(lattice, solids=[...], ...)")
    if quadrature is not None:
        checks.instance("quadrature", quadrature, Quadrature, "use rm.quadrature.fibonacci(200)")
        total = quadrature.weights.sum()
        if abs(total / (4 * np.pi) - 1) > 1e-6:
            checks.fail("quadrature", f"weights that add up to {total:.6g}", "4 pi", "use a set of rm.quadrature as it is made")
    if scheme is not None:
        checks.instance("scheme", scheme, (Characteristic, LightRayCube), "use rm.Characteristic() or rm.LightRayCube()")
    if isinstance(scheme, LightRayCube) and quadrature is not None:
        got = f"{quadrature} with {scheme}"
        checks.fail("quadrature", got, "None", "the light ray cube has its own directions: leave quadrature out")
    geometry: list[Any] = [solid.shape for solid in scene.solids]
    geometry += [getattr(light, name, None) for light in scene.lights for name in ("direction", "position", "hemisphere")]
    if checks.is_traced(geometry):
        expected = "shapes and directions of lights that JAX does not trace"
        advice = "close over the scene, and put parameters in with equinox.tree_at: what is in front of what has no derivative"
        checks.fail("scene", "traced geometry", expected, advice, TypeError)
    if not (isinstance(solver, Jacobi | Krylov | Anderson | OptimistixFixedPoint) or solver == "auto"):
        kinds = 'rm.Krylov(), rm.Anderson(), rm.OptimistixFixedPoint(...), rm.Jacobi() or "auto"'
        checks.fail("solver", repr(solver), kinds, 'leave it at "auto"')
    if mesh is not None:
        check_mesh(mesh, scene.lattice.shape)
        if checks.is_traced(stop_gradient(scene)):
            advice = "jax.grad and jvp go through outside of jit; or leave mesh out"
            checks.fail("mesh", "a mesh under jit or vmap", "a scene of known values", advice, TypeError)
    if checkpoint is not None:
        checks.instance("checkpoint", checkpoint, Checkpoint, 'pass rm.Checkpoint("run.npz")')
    if prepared is not None:
        checks.instance("prepared", prepared, Prepared, "pass what prepare(scene) returns")
        if prepared.layout.shape != scene.lattice.shape:
            got = f"what was prepared for {prepared.layout.shape} voxels"
            checks.fail("prepared", got, f"the scene's {scene.lattice.shape}", "prepare the scene itself")
    checks.positive_int("max_sweeps", max_sweeps)
    finest = 16 * float(jnp.finfo(real_dtype()).eps)
    if not (isinstance(rtol, (int, float, np.floating)) and math.isfinite(rtol) and finest <= rtol < 1):
        checks.fail("rtol", repr(rtol), f"a number from {finest:.2g} (what {real_dtype()} can hold) to 1", "use 1e-3 to 1e-5")


def _check_steady(scene: Scene, surfaces: Surfaces, stuff: Materials) -> None:
    """Light must be able to end somewhere, if there is any."""
    sources = [stuff.emission, *(f for f in (stuff.medium_source,) if f is not None)]
    sources += [light.intensity for light in scene.lights if isinstance(light, PointLight)]
    if checks.is_traced(stuff.albedo) or any(checks.is_traced(s) for s in sources):
        return
    lossless = np.all(np.asarray(stuff.albedo) >= 1, axis=1)
    if stuff.absorption is not None:
        lossless &= ~np.any(np.asarray(stuff.absorption) > 0, axis=(1, 2, 3))
    if surfaces.open.any() or not lossless.any() or not any(np.any(np.asarray(s) > 0) for s in sources):
        return
    raise ValueError(
        "scene: got sources in a closed scene where nothing absorbs (every albedo is 1), expected light to end somewhere: "
        "there is no steady state; lower an albedo below 1, add absorption, or open a side"
    )


def _finish(
    scene: Scene,
    surfaces: Surfaces,
    quadrature: Quadrature,
    stuff: Materials,
    iteration: Iteration | Unwatched,
    nodes: CubeSystem | None,
    solver: object,
    hidden: _Hidden,
) -> Solution:
    system, bounced = iteration.system, iteration.arriving
    # Within its bound a Krylov iterate may dip below 0, where the exact solution is not.
    bounced = _not_negative(bounced)
    if not system.scatters:  # the iteration did not need the light in the voxels
        before = iteration.before if isinstance(iteration, Iteration) and iteration.asked else bounced
        everywhere = zeros_like(system.source)
        if before is not None:
            everywhere = system.transport(system.materials.reflected(system.source + before), fluence=True)
        bounced = Light(bounced.elements, everywhere.voxels)
    rest, sun = system.direct.rest + bounced, system.direct.sun
    if nodes is not None:
        rest, sun, outside = *nodes.at_elements(rest, sun), as_jax(~nodes.solid)
        free = _where(outside, jnp.ones((), rest.elements.dtype))
    else:
        covered = _covered(system.transport)
        rest, sun, covered = restored(system.transport.layout, (rest, sun, covered))
        outside = as_jax(~surfaces.solid)
        free = _where(outside, covered)
    fields = _fields(rest, sun, outside)
    return Solution(
        scene=scene, **fields, free=free, albedo=stuff.albedo, emission=stuff.emission,
        energy=_energy(scene, surfaces, quadrature, stuff, free, fields),
        error_bound=math.pi * iteration.bound, target=math.pi * iteration.target,
        history=math.pi * np.array(iteration.residuals[1:]), sweeps=iteration.sweeps + iteration.certificate.sweeps,
        ending=iteration.ending, solver=repr(solver), rounding=math.pi * iteration.rounding,
        no_bound=iteration.certificate.reason if iteration.residuals[-1] > 0 else "",
        _hidden=hidden,
    )  # fmt: skip


@program
def _not_negative(light: Light) -> Light:
    return jax.tree.map(lambda x: x + lax.stop_gradient(jnp.maximum(-x, 0.0)), light)


@program
def _covered(transport: Transport) -> Float[Array, "nx ny nz"]:
    """The share of each voxel that is free: of the sum of weights that a wholly free one gets."""
    weights = jnp.stack([jnp.sum(o.weight) for o in transport.ordinates])
    return transport.coverage / (weights.sum() * len(transport.layout.unfolding.images()))


@program
def _where(outside: Bool[Array, "nx ny nz"], values: Float[Array, "..."]) -> Float[Array, "nx ny nz"]:
    return jnp.where(outside, values, 0.0)


@program
def _fields(rest: Light, sun: Light, outside: Bool[Array, "nx ny nz"]) -> dict[str, Array]:
    fluence = lambda light: jnp.where(outside, 4 * jnp.pi * light.voxels, 0.0)
    return {
        "diffuse_irradiance": jnp.pi * rest.elements,
        "sun_irradiance": jnp.pi * sun.elements,
        "diffuse_fluence": fluence(rest),
        "sun_fluence": fluence(sun),
    }


def _energy(scene: Scene, surfaces: Surfaces, quadrature, stuff: Materials, free, fields) -> Energy:
    points = [light.intensity for light in scene.lights if isinstance(light, PointLight)]
    entering, area = _entering(scene, surfaces, quadrature, free.dtype), as_jax(surfaces.area, free.dtype)
    return _account(stuff, free, fields, points, entering, area, as_jax(surfaces.open), np.asarray(scene.lattice.spacing))


@program
def _account(stuff: Materials, free, fields, points, entering, area, is_open, spacing) -> Energy:
    real, bands = free.dtype, len(stuff.albedo)
    irradiance = fields["diffuse_irradiance"] + fields["sun_irradiance"]
    emitted = jnp.sum(jnp.pi * stuff.emission * area)
    volume = free * spacing**3
    in_medium = jnp.zeros((), real)
    if stuff.absorption is not None and stuff.medium_source is not None and stuff.extinction is not None:
        in_medium = jnp.sum(stuff.absorption * (fields["diffuse_fluence"] + fields["sun_fluence"]) * volume)
        emitted = emitted + jnp.sum(4 * jnp.pi * stuff.medium_source * stuff.extinction * volume)
    for intensity in points:
        emitted = emitted + 4 * jnp.pi * jnp.sum(jnp.broadcast_to(intensity, (bands,)))
    return Energy(
        emitted=emitted,
        entering=entering,
        absorbed_by_surfaces=jnp.sum(jnp.where(is_open, 0.0, (1 - stuff.albedo) * irradiance * area)),
        absorbed_by_medium=in_medium,
        leaving=jnp.sum(jnp.where(is_open, irradiance * area, 0.0)),
    )


def _entering(scene: Scene, surfaces: Surfaces, quadrature: Quadrature, real) -> Float[Array, ""]:
    """Power that skies and suns send in through the open sides."""
    total, xp = np.zeros((), real), numpy_or_jax(scene)
    radiance = xp.asarray(sky_radiance(scene, quadrature.directions))
    for side, kind in enumerate(scene.boundary.sides):
        if kind is not OPEN:
            continue
        mask = surfaces.open & (surfaces.side == side)
        area = float(surfaces.area[mask].sum())
        inward = np.zeros(3)
        inward[side // 2] = -1.0 if side % 2 else 1.0
        cosine = np.maximum(quadrature.directions @ inward, 0) * quadrature.weights
        cosine *= np.pi / cosine.sum()
        total = total + area * xp.sum(radiance @ cosine.astype(real))
        for light in scene.lights:
            if isinstance(light, Sun):
                share = max(float(np.asarray(light.direction) @ inward), 0.0)
                irradiance = xp.broadcast_to(xp.asarray(light.irradiance), (scene.bands,))
                total = total + area * share * xp.sum(irradiance)
    return as_jax(total, real)
