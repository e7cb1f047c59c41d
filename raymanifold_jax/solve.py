"""Solving for the light everywhere: x = K x + b by Jacobi iteration, stopped on a certified bound.

x holds what surfaces reflect and the medium scatters (see `operator`), b the part of it straight from sources, so the
k-th iterate holds light of up to k bounces (Langer, Breton & Zucker 1995, eq. 1). K has no negative entries. For any w > 0
with w - K w > 0, an iterate whose residual is r is at most

    |x* - x| <= max |r| * max w / min(w - K w)

from the exact solution x* of the discrete problem. w = 1 serves while every row of K adds up to less than 1; else
w = 1 + K 1 + K^2 1 + ..., until every path of light has had a chance to end. The last change is no such bound: at albedo 0.99
it can be 100 times smaller than the error.

Public: `solve`, `Jacobi`.
"""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import checks
from .direct import Direct, first_flight, sky_radiance
from .layout import make_layout
from .operator import Light, Materials, Transport, make_transport, materials
from .progress import Progress, make_progress
from .quadrature import Quadrature, fibonacci
from .scene import OPEN, PointLight, Scene, Sun
from .solution import Energy, Solution, _Hidden
from .surfaces import Surfaces, find_surfaces
from .transport.characteristic import Characteristic

_DEFAULT_DIRECTIONS = 200
_CERTAIN = 0.98  # a largest row sum of K above this asks for a better w
_POWERS = 48  # terms of w tried at most
_STALLED = 24  # sweeps without progress before giving up


class Jacobi(eqx.Module):
    """The paper's iteration: one sweep a bounce. Converges where light is lost; quickly where albedos are below 0.9."""


@dataclasses.dataclass(frozen=True)
class _Certificate:
    """The error after a sweep is at most `factor` times that sweep's largest change; `sweeps` were spent to know."""

    factor: float
    sweeps: int


@dataclasses.dataclass
class _State:
    """How far the iteration is; radiances."""

    arriving: Light  # bounced light so far
    changes: list[float]
    target: float
    stagnated: bool = False

    def bound(self, certificate: _Certificate) -> float:
        return certificate.factor * self.changes[-1] if self.changes else math.inf

    def stuck(self) -> bool:
        """No new smallest change for a while."""
        return len(self.changes) > _STALLED and min(self.changes[-_STALLED:]) >= min(self.changes[:-_STALLED])


class _System(eqx.Module):
    """x = K x + b: the transport, the materials, and the first-flight light."""

    transport: Transport
    materials: Materials
    direct: Direct

    @property
    def source(self) -> Light:
        return self.direct.sun + self.direct.rest

    @property
    def scatters(self) -> bool:
        return self.materials.extinction is not None


def solve(
    scene: Scene,
    quadrature: Quadrature | None = None,
    scheme: Characteristic | None = None,
    rtol: float = 1e-4,
    solver: Jacobi | str = "auto",
    max_sweeps: int = 1000,
    throw: bool = False,
    progress: bool | Progress | None = None,
    mesh: None = None,
) -> Solution:
    """Solve a scene for the light everywhere.

    **Arguments:**

    - `quadrature`: directions of the sweeps; `rm.quadrature.fibonacci(200)` if None. More directions reduce ray effects; time
      grows with their number.
    - `scheme`: `rm.Characteristic()`.
    - `rtol`: the certified error bound's target, relative to the largest radiosity or medium source (times pi).
    - `solver`: `rm.Jacobi()`, or "auto" for it.
    - `max_sweeps`: the iteration stops there at the latest. With `throw`, that raises `RuntimeError`; without, read
      `Solution.converged` and `Solution.result`.
    - `progress`: True or None shows a bar on a terminal when the solve takes long; False never; or a `Progress`.

    **Raises** `ValueError` or `TypeError` for unusable arguments before any work, `RuntimeError` with `throw`.
    """
    _check_arguments(scene, quadrature, scheme, rtol, solver, max_sweeps, mesh)
    quadrature = fibonacci(_DEFAULT_DIRECTIONS) if quadrature is None else quadrature
    meter = make_progress(progress)
    with meter:
        meter.start(f"solve {scene.summary()}")
        surfaces = find_surfaces(scene)
        stuff = materials(scene, surfaces)
        layout = make_layout(scene, surfaces)
        transport = make_transport(layout, quadrature, stuff.extinction, scene.bands)
        system = _System(transport, stuff, first_flight(scene, surfaces, transport, quadrature, stuff))
        certificate = _certify(system)
        state = _iterate(system, certificate, rtol, max_sweeps, meter)
        solution = _finish(scene, surfaces, quadrature, system, certificate, state)
    if throw and not solution.converged:
        raise RuntimeError(f"solve: {solution.result}")
    return solution


def _check_arguments(scene, quadrature, scheme, rtol, solver, max_sweeps, mesh) -> None:
    checks.instance("scene", scene, Scene, "make one with rm.Scene(lattice, solids=[...], ...)")
    if quadrature is not None:
        checks.instance("quadrature", quadrature, Quadrature, "use rm.quadrature.fibonacci(200)")
        total = quadrature.weights.sum()
        if abs(total / (4 * np.pi) - 1) > 1e-6:
            checks.fail("quadrature", f"weights that add up to {total:.6g}", "4 pi", "use a set of rm.quadrature as it is made")
    if scheme is not None:
        checks.instance("scheme", scheme, Characteristic, "use rm.Characteristic()")
    if not (isinstance(solver, Jacobi) or solver == "auto"):
        checks.fail("solver", repr(solver), 'rm.Jacobi() or "auto"', 'leave it at "auto"')
    if mesh is not None:
        checks.fail("mesh", repr(mesh), "None", "sweeps run on one device so far; leave mesh out")
    checks.positive_int("max_sweeps", max_sweeps)
    finest = 16 * float(jnp.finfo(jnp.zeros(0).dtype).eps)
    if not (isinstance(rtol, (int, float, np.floating)) and math.isfinite(rtol) and finest <= rtol < 1):
        checks.fail(
            "rtol", repr(rtol), f"a number from {finest:.2g} (what {jnp.zeros(0).dtype} can hold) to 1", "use 1e-3 to 1e-5"
        )


def _certify(system: _System) -> _Certificate:
    """Find w by applying K to 1 until what is left everywhere is surely less than 1."""

    def apply(leaving: Light) -> Light:
        return system.materials.reflected(system.transport(leaving, fluence=system.scatters))

    total = jax.tree.map(jnp.ones_like, system.materials.reflected(system.source))
    power = apply(total)
    row_sum = min(float(power.largest()), 1.0)
    count = 1
    # Where rows add up to well below 1 this loop does nothing.
    while float(power.largest()) > _CERTAIN and count < _POWERS:
        power, total, count = apply(power), total + power, count + 1
    left = float(power.largest())
    return _Certificate(row_sum * float(total.largest()) / (1 - left) if left < 1 - 1e-6 else math.inf, count)


def _iterate(system: _System, certificate: _Certificate, rtol: float, most: int, meter: Progress) -> _State:
    """Add up the orders of bounced light until the bound is met or `most` sweeps are done.

    Each sweep carries the last order alone, x_(k+1) - x_k = K (x_k - x_(k-1)). That is Jacobi's iteration, but its rounding errors
    shrink with the orders.
    """
    source = system.source
    leaving = system.materials.reflected(source)
    arriving = jax.tree.map(jnp.zeros_like, Light(source.elements, source.voxels if system.scatters else None))
    lost = arriving
    # What sources send out straight away is part of the scale; it is all there is where nothing is reflected.
    scale = max(float(leaving.largest()), float(jnp.max(system.materials.emission, initial=0.0)))
    state = _State(arriving, [float(leaving.largest())], target=rtol * scale)
    while state.bound(certificate) > state.target:
        if len(state.changes) > most or state.stuck():
            state.stagnated = state.stuck()
            break
        arriving, lost, leaving, change, largest = _next_order(system, state.arriving, lost, leaving)
        state.arriving = arriving
        state.changes.append(float(change))
        state.target = rtol * max(scale, float(largest))
        meter.update(len(state.changes) - 1, math.pi * state.bound(certificate), math.pi * state.target)
    return state


@eqx.filter_jit
def _next_order(system: _System, total: Light, lost: Light, leaving: Light):
    """One bounce more: the total of bounced light (Kahan's sum: `lost` holds its low bits), what leaves of this order, the
    largest of that, and the largest of all that leaves."""
    order = system.transport(leaving, fluence=system.scatters)
    addend = jax.tree.map(jnp.subtract, order, lost)
    after = total + addend
    lost = jax.tree.map(lambda new, old, a: (new - old) - a, after, total, addend)
    leaving = system.materials.reflected(order)
    largest = system.materials.reflected(system.source + after).largest()
    return after, lost, leaving, leaving.largest(), largest


def _finish(scene, surfaces: Surfaces, quadrature, system: _System, certificate, state: _State) -> Solution:
    bounced = state.arriving
    if not system.scatters:  # the iteration did not need the light in the voxels
        everywhere = system.transport(system.materials.reflected(system.source + bounced), fluence=True)
        bounced = Light(bounced.elements, everywhere.voxels)
    rest = system.direct.rest + bounced
    outside = jnp.asarray(~surfaces.solid)
    free = jnp.where(outside, system.transport.voxel_sums / _whole(system.transport), 0.0)
    fluence = lambda light: jnp.where(outside, 4 * jnp.pi * light.voxels, 0.0)
    fields = {
        "diffuse_irradiance": jnp.pi * rest.elements,
        "sun_irradiance": jnp.pi * system.direct.sun.elements,
        "diffuse_fluence": fluence(rest),
        "sun_fluence": fluence(system.direct.sun),
    }
    bound = state.bound(certificate)
    return Solution(
        scene=scene, **fields, free=free, albedo=system.materials.albedo, emission=system.materials.emission,
        energy=_energy(scene, surfaces, quadrature, system.materials, free, fields),
        error_bound=math.pi * bound, target=math.pi * state.target, history=math.pi * np.array(state.changes[1:]),
        sweeps=len(state.changes) - 1 + certificate.sweeps, converged=bound <= state.target, stagnated=state.stagnated,
        _hidden=_Hidden(surfaces),
    )  # fmt: skip


def _whole(transport: Transport) -> Float[Array, ""]:
    """The sum of weights that a wholly free voxel gets."""
    weights = jnp.stack([jnp.sum(o.weight) for o in transport.ordinates])
    return weights.sum() * len(transport.layout.unfolding.images())


def _energy(scene: Scene, surfaces: Surfaces, quadrature, stuff: Materials, free, fields) -> Energy:
    real = free.dtype
    area = jnp.asarray(surfaces.area, real)
    is_open = jnp.asarray(surfaces.open)
    irradiance = fields["diffuse_irradiance"] + fields["sun_irradiance"]
    emitted = jnp.sum(jnp.pi * stuff.emission * area)
    volume = free * scene.lattice.spacing**3
    in_medium = jnp.zeros((), real)
    if stuff.absorption is not None and stuff.medium_source is not None and stuff.extinction is not None:
        in_medium = jnp.sum(stuff.absorption * (fields["diffuse_fluence"] + fields["sun_fluence"]) * volume)
        emitted = emitted + jnp.sum(4 * jnp.pi * stuff.medium_source * stuff.extinction * volume)
    for light in scene.lights:
        if isinstance(light, PointLight):
            emitted = emitted + 4 * jnp.pi * jnp.sum(jnp.broadcast_to(light.intensity, (scene.bands,)))
    return Energy(
        emitted=emitted,
        entering=_entering(scene, surfaces, quadrature, real),
        absorbed_by_surfaces=jnp.sum(jnp.where(is_open, 0.0, (1 - stuff.albedo) * irradiance * area)),
        absorbed_by_medium=in_medium,
        leaving=jnp.sum(jnp.where(is_open, irradiance * area, 0.0)),
    )


def _entering(scene: Scene, surfaces: Surfaces, quadrature: Quadrature, real) -> Float[Array, ""]:
    """Power that skies and suns send in through the open sides."""
    total = jnp.zeros((), real)
    radiance = sky_radiance(scene, quadrature.directions)
    for side, kind in enumerate(scene.boundary.sides):
        if kind is not OPEN:
            continue
        mask = surfaces.open & (surfaces.side == side)
        area = float(surfaces.area[mask].sum())
        inward = np.zeros(3)
        inward[side // 2] = -1.0 if side % 2 else 1.0
        cosine = np.maximum(quadrature.directions @ inward, 0) * quadrature.weights
        cosine *= np.pi / cosine.sum()
        total = total + area * jnp.sum(radiance @ jnp.asarray(cosine, real))
        for light in scene.lights:
            if isinstance(light, Sun):
                share = max(float(np.asarray(light.direction) @ inward), 0.0)
                total = total + area * share * jnp.sum(jnp.broadcast_to(light.irradiance, (scene.bands,)))
    return total
