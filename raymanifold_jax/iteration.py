"""Solving x = K x + b, with a certified bound on the error at every sweep.

K has no negative entries and x* >= 0. For any w > 0 with w - K w > 0, and any x with residual r = b + K x - x,

    |x* - x| <= max |r| * F,    F = max w / min(w - K w),

and after one more step x' = b + K x the same with K's largest row sum as a further factor. w = 1 serves while every row of K
adds up to less than 1; else w = 1 + K 1 + K^2 1 + ..., until every path of light has had a chance to end. The last change is
no such bound: at albedo 0.99 it can be 100 times smaller than the error.

- `Jacobi` adds up orders of bounced light: the k-th iterate holds light of up to k bounces (Langer et al. 1995, eq. 1).
- `Krylov` takes the combination of the last few orders that leaves the smallest residual (GMRES: Saad & Schultz, SIAM J. Sci.
  Stat. Comput. 7, 1986), restarted. Each sweep serves it at least as well as it serves Jacobi.

Public: `System`, `Certificate`, `Iteration`, `certify`, `Jacobi`, `Krylov`.
"""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .checkpoint import Checkpoint
from .direct import Direct
from .operator import Light, Materials, Transport
from .progress import Progress

_CERTAIN = 0.98  # a largest row sum of K above this asks for a better w
_POWERS = 48  # terms of w tried at most
_STALLED = 24  # sweeps without a new smallest residual before giving up


class System(eqx.Module):
    """x = K x + b: the transport, the materials, and the first-flight light."""

    transport: Transport
    materials: Materials
    direct: Direct

    @property
    def source(self) -> Light:
        """First-flight light at elements and, with a medium, in voxels."""
        return self.direct.sun + self.direct.rest

    @property
    def scatters(self) -> bool:
        return self.materials.extinction is not None

    def bounce(self, leaving: Light) -> tuple[Light, Light]:
        """The light that arrives, of what leaves; and what of it leaves again."""
        arriving = self.transport(leaving, fluence=self.scatters, scattered=True)
        return arriving, _reflected(self.materials, arriving)

    def nothing(self) -> Light:
        """No arriving light."""
        voxels = jnp.zeros_like(self.source.voxels) if self.scatters and self.source.voxels is not None else None
        return Light(jnp.zeros_like(self.source.elements), voxels)


@dataclasses.dataclass(frozen=True)
class Certificate:
    """The error after a step is at most `factor` times the largest residual before it; `sweeps` were spent to know."""

    factor: float
    sweeps: int


def certify(system: System) -> Certificate:
    """Find w by applying K to 1 until what is left everywhere is surely less than 1."""
    total = jax.tree.map(jnp.ones_like, system.materials.reflected(system.source))
    power = system.bounce(total)[1]
    row_sum = min(float(power.largest()), 1.0)
    count = 1
    # Where rows add up to well below 1 this loop does nothing.
    while float(power.largest()) > _CERTAIN and count < _POWERS:
        total = total + power
        power, count = system.bounce(power)[1], count + 1
    left = float(power.largest())
    return Certificate(row_sum * float(total.largest()) / (1 - left) if left < 1 - 1e-6 else math.inf, count)


@eqx.filter_jit
def _reflected(stuff: Materials, arriving: Light) -> Light:
    return stuff.reflected(arriving)


class Iteration:
    """The state of a solve: the bounced light so far, the largest residual at each sweep, and whether to go on."""

    def __init__(self, system: System, certificate: Certificate, rtol: float, most: int, meter: Progress):
        self.system = system
        self.certificate = certificate
        self.arriving = system.nothing()
        self.residual = system.materials.reflected(system.source)
        self.residuals = [float(self.residual.largest())]
        # What sources send out straight away is part of the scale; it is all there is where nothing is reflected.
        self._scale = max(self.residuals[0], float(jnp.max(system.materials.emission, initial=0.0)))
        self.target = rtol * self._scale
        self._rtol, self._most, self._meter = rtol, most, meter
        self.lost = self.arriving  # the low bits of Jacobi's sum
        self.checkpoint: Checkpoint | None = None

    def _state(self) -> tuple:
        return self.arriving, self.residual, self.lost, np.array(self.residuals), np.array(self.target)

    def resume(self, checkpoint: Checkpoint) -> None:
        """Save the state to a checkpoint from now on, and go on from what it holds."""
        self.checkpoint = checkpoint
        found = checkpoint.restore((self.system.source, self.system.materials, self._rtol), self._state())
        if found is not None:
            arriving, residual, lost, residuals, target = found
            self.arriving, self.residual, self.lost = jax.tree.map(jnp.asarray, (arriving, residual, lost))
            self.residuals, self.target = [float(r) for r in residuals], float(target)

    def keep(self) -> None:
        """A place from which to go on: save the state if it is time."""
        if self.checkpoint is not None:
            self.checkpoint.keep(self._state())

    @property
    def bound(self) -> float:
        return self.certificate.factor * self.residuals[-1] if self.residuals[-1] > 0 else 0.0

    @property
    def sweeps(self) -> int:
        return len(self.residuals) - 1

    @property
    def converged(self) -> bool:
        return self.bound <= self.target

    @property
    def stagnated(self) -> bool:
        """No new smallest residual for a while."""
        return self.sweeps >= _STALLED and min(self.residuals[-_STALLED:]) >= min(self.residuals[:-_STALLED])

    @property
    def over(self) -> bool:
        return self.converged or self.stagnated or self.sweeps >= self._most

    def note(self, residual: float, largest: float) -> None:
        """One sweep more, and what it led to: the largest residual, and the largest of all that leaves."""
        self.residuals.append(residual)
        self.target = self._rtol * max(self._scale, largest)
        self._meter.update(self.sweeps, math.pi * self.bound, math.pi * self.target)


class Jacobi(eqx.Module):
    """The paper's iteration: one sweep a bounce. Converges where light is lost; quickly where albedos are below 0.9.

    Each sweep carries the last order of bounces alone, so rounding errors shrink with the orders.
    """

    def run(self, iteration: Iteration) -> None:
        while not iteration.over:
            order, iteration.residual = iteration.system.bounce(iteration.residual)
            iteration.arriving, iteration.lost = _add(iteration.arriving, iteration.lost, order)
            iteration.note(float(iteration.residual.largest()), float(_largest(iteration.system, iteration.arriving)))
            iteration.keep()


@eqx.filter_jit
def _add(total: Light, lost: Light, order: Light) -> tuple[Light, Light]:
    """Kahan's sum: `lost` holds the low bits."""
    addend = jax.tree.map(jnp.subtract, order, lost)
    after = total + addend
    return after, jax.tree.map(lambda new, old, a: (new - old) - a, after, total, addend)


class Krylov(eqx.Module):
    """GMRES on (I - K) x = b, restarted: half of Jacobi's sweeps or fewer, 2 `restart` + 1 fields more."""

    restart: int = eqx.field(static=True, default=8)

    def run(self, iteration: Iteration) -> None:
        while not iteration.over:
            self._cycle(iteration)
            iteration.keep()

    def _cycle(self, iteration: Iteration) -> None:
        system, start, begun = iteration.system, iteration.residual, iteration.arriving
        length = float(_norm(start))
        empty = jax.tree.map(jnp.zeros_like, start)
        none = system.nothing()
        basis = [_combine([1 / length], [start])] + [empty] * self.restart
        orders = [none] * self.restart
        hessenberg = np.zeros((self.restart + 1, self.restart))
        for step in range(self.restart):
            orders[step], leaving = system.bounce(basis[step])
            basis[step + 1], column = _arnoldi(tuple(basis), basis[step], leaving)
            hessenberg[:, step] = np.asarray(column)[: self.restart + 1]
            hessenberg[step + 1, step] = float(column[-1])
            small = hessenberg[: step + 2, : step + 1]
            right = np.zeros(step + 2)
            right[0] = length
            weights = np.linalg.lstsq(small, right, rcond=None)[0]
            left = np.zeros(self.restart + 1)
            left[: step + 2] = right - small @ weights
            chosen = np.zeros(self.restart)
            chosen[: step + 1] = weights
            residual = _combine(left, basis)
            arriving = begun + _combine(chosen, orders)
            iteration.arriving, iteration.residual = arriving, residual
            iteration.note(float(residual.largest()), float(_largest(system, arriving)))
            if iteration.over or hessenberg[step + 1, step] <= 1e-6 * length:
                return


@eqx.filter_jit
def _arnoldi(basis: tuple[Light, ...], last: Light, leaving: Light) -> tuple[Light, Array]:
    """The next basis vector: (I - K) last, made orthogonal to the basis; `leaving` is K last. Unused vectors are 0."""
    vector = jax.tree.map(jnp.subtract, last, leaving)
    column = jnp.zeros(len(basis), last.elements.dtype)
    for _ in range(2):  # twice is enough, in float32 too
        overlap = jnp.stack([_dot(b, vector) for b in basis])
        for k, b in enumerate(basis):
            vector = jax.tree.map(lambda v, x, k=k, overlap=overlap: v - overlap[k] * x, vector, b)
        column = column + overlap
    length = jnp.sqrt(_dot(vector, vector))
    scale = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
    return jax.tree.map(lambda v: v * scale, vector), jnp.append(column, length)


def _dot(a: Light, b: Light) -> Array:
    return sum(jax.tree.leaves(jax.tree.map(lambda x, y: jnp.sum(x * y), a, b)), start=jnp.zeros((), a.elements.dtype))


@eqx.filter_jit
def _norm(light: Light) -> Array:
    # Scaled, so that squares neither overflow nor vanish.
    scale = jnp.maximum(light.largest(), jnp.finfo(light.elements.dtype).tiny)
    scaled = jax.tree.map(lambda x: x / scale, light)
    return scale * jnp.sqrt(_dot(scaled, scaled))


@eqx.filter_jit
def _sum(weights: tuple[Array, ...], fields: tuple[Light, ...]) -> Light:
    total = jax.tree.map(lambda x: weights[0] * x, fields[0])
    for weight, field in zip(weights[1:], fields[1:], strict=True):
        total = jax.tree.map(lambda t, x, weight=weight: t + weight * x, total, field)
    return total


def _combine(weights, fields: list[Light]) -> Light:
    real = fields[0].elements.dtype
    return _sum(tuple(jnp.asarray(w, real) for w in weights), tuple(fields))


@eqx.filter_jit
def _largest(system: System, arriving: Light) -> Array:
    return system.materials.reflected(system.source + arriving).largest()
