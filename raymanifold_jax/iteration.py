"""Solving x = K x + b, with a certified bound on the error at every sweep.

K has no negative entries and x* >= 0. For any w > 0 with w - K w > 0, and any x with residual r = b + K x - x,

    |x* - x| <= max |r| * F,    F = max w / min(w - K w),

and after one more step x' = b + K x the same with F - 1 for F, because (I - K)^-1 K = (I - K)^-1 - I. w = 1 serves while every
row of K adds up to less than 1; better is a solution of (I - K) w = 1, which need not be exact. The last change is no such
bound: at albedo 0.99 it can be 100 times smaller than the error.

GMRES leaves residuals of either sign, large in few places, of which max |r| F makes far too much. One sweep more for any u says
better: if |r| <= u - K u + t (w - K w), then |x* - x| <= u + t w; here u is what diffusion makes of |r|, or a few orders of
bounces do.

Public: `System`, `Certificate`, `Iteration`, `certify`.
"""

from __future__ import annotations

import dataclasses
import math

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .acceleration import Diffusion
from .arrays import ones_like, zeros_like
from .checkpoint import Checkpoint
from .direct import Direct
from .krylov import combine, linear_solve
from .operator import Light, Materials, Transport
from .programs import program
from .progress import Progress

_PLAIN = 0.9  # up to this albedo w = 1 will do
_CERTAIN = 0.98  # a largest row sum of K above this asks for a better w
_POWERS = 48  # terms of w tried at most
_ENOUGH = 0.5  # w - K w of at least this ends the search for w
_SEARCH = 24  # sweeps of it at most
_STALLED = 24  # sweeps without a new smallest residual before giving up
_GROWN = 1e3  # times the first residual: diverged
_ORDERS = 3  # of bounces that stand for diffusion where there is none: it is left out where bounces are gathers
_HOPED = 0.2  # what polishing is at first taken to make of a bound: rather late than twice
_ROUNDING = 2.0  # units in the last place by which a sweep's result may be off, of the largest radiance


class System(eqx.Module):
    """x = K x + b: the transport, the materials, the first-flight light, and what makes a solver fast."""

    transport: Transport
    materials: Materials
    direct: Direct
    near: Diffusion | None = None

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
        return arriving, self.materials.reflected(arriving)

    def precondition(self, leaving: Light) -> Light:
        """About the solution of (I - K) x = leaving, without a sweep."""
        return leaving if self.near is None else self.near(leaving)

    def nothing(self) -> Light:
        """No arriving light."""
        source = self.source
        return zeros_like(Light(source.elements, source.voxels if self.scatters else None))


@dataclasses.dataclass(frozen=True)
class Certificate:
    """The error after a step is at most `factor` times the largest residual before it; `sweeps` were spent to know.

    `factor` is inf, and `reason` says why, where no bound was found. `weights` and `slack`: w and w - K w.
    """

    factor: float
    sweeps: int
    reason: str = ""
    weights: Light | None = None
    slack: Light | None = None


def certify(system: System) -> Certificate:
    """Find a w: 1 where albedos are moderate, else by solving (I - K) w = 1 to within a half."""
    albedo = system.materials.reflected(ones_like(system.source))
    largest = float(albedo.largest())
    if largest == 0:
        return Certificate(0.0, 0)
    if system.near is None or largest <= _PLAIN:
        return _by_powers(system, albedo)
    # Where nothing is reflected x is exact, and w may be 0.
    ones = _where_any(albedo)
    shortfall = lambda residual: float(_most_positive(residual))
    apply = lambda light: system.bounce(light)[1]
    w, residual, count = linear_solve(apply, ones, system.precondition, lambda r: shortfall(r) <= 1 - _ENOUGH, _SEARCH)
    least = 1 - shortfall(residual)  # of w - K w
    from_rows = largest / (1 - largest) if largest < 1 else math.inf
    # From w - K w > 0 follows w > 0, but for rounding.
    factor = float(w.largest()) / least - 1 if least > 0.01 else math.inf
    # What the float type cannot tell from light that bounces without loss.
    lossless = 0.1 / (_ROUNDING * float(jnp.finfo(w.elements.dtype).eps))
    if factor <= min(from_rows, lossless):
        return Certificate(factor, count, "", w, _differences(ones, residual))
    if from_rows <= lossless:
        return Certificate(from_rows, count, "", ones, _differences(ones, albedo))
    return Certificate(
        math.inf, count, f"as far as {w.elements.dtype} can tell in {count} sweeps, some light bounces without loss"
    )


@program
def _where_any(light: Light) -> Light:
    return jax.tree.map(lambda a: jnp.where(a > 0, 1.0, 0.0).astype(a.dtype), light)


@program
def _differences(one: Light, other: Light) -> Light:
    return jax.tree.map(jnp.subtract, one, other)


@program
def _most_positive(light: Light):
    return jnp.stack([jnp.max(part, initial=0.0) for part in jax.tree.leaves(light)]).max()


def _by_powers(system: System, total: Light) -> Certificate:
    """w = 1 + K 1 + K^2 1 + ..., until every path of light has had a chance to end; one sweep where albedos are moderate."""
    ones = total = _where_any(total)
    power = system.bounce(total)[1]
    count = 1
    while float(power.largest()) > _CERTAIN and count < _POWERS:
        total = total + power
        power, count = system.bounce(power)[1], count + 1
    left = float(power.largest())
    if left >= 1 - 1e-6:
        return Certificate(math.inf, count, f"some light bounces {count} times without loss")
    slack = _differences(ones, power)
    return Certificate(float(total.largest()) / (1 - left) - 1, count, "", total, slack)


@program
def _bounded(weights: Light, slack: Light, residual: Light, u: Light, passed: Light):
    """The largest of a u + t w - |r|, with t as the module's docstring says, and a as serves best; `passed` is K u."""
    size = jax.tree.map(jnp.abs, residual)
    missing = lambda r, covered, d: jnp.max(jnp.where(d > 0, (r - covered) / jnp.where(d > 0, d, 1.0), 0.0), initial=0.0)

    def bound(a):
        covered = jax.tree.map(lambda u, k: a * (u - k), u, passed)
        t = jnp.stack(jax.tree.leaves(jax.tree.map(missing, size, covered, slack))).max()
        return _most_positive(jax.tree.map(lambda r, u, w: a * u + t * w - r, size, u, weights))

    return jnp.min(jax.lax.map(bound, jnp.linspace(0.0, 2.0, 21, dtype=residual.elements.dtype)))


class Iteration:
    """The state of a solve: the bounced light so far, the largest residual at each sweep, and whether to go on."""

    def __init__(self, system: System, certificate: Certificate, rtol: float, most: int, meter: Progress):
        self.system = system
        self.certificate = certificate
        self.arriving = system.nothing()
        self.residual = system.materials.reflected(system.source)
        self.residuals = [float(self.residual.largest())]
        # What sources send out straight away is part of the scale; it is all there is where nothing is reflected.
        self._scale = max(self.residuals[0], float(_brightest(system.materials)))
        self.target = rtol * self._scale
        self._rtol, self._most, self._meter = rtol, most, meter
        self.lost = self.arriving  # the low bits of Jacobi's sum
        self.checkpoint: Checkpoint | None = None
        self.stuck = False  # a solver's own word that it cannot go on
        self._more = 0  # sweeps that led to no iterate
        self._tight = math.inf  # a bound on the present iterate's error, better than the factor's
        self._gain = _HOPED  # of polishing, on the bound
        self.asked = False  # for so many bounces and no more
        self.before: Light | None = None  # then: the bounced light one bounce earlier, if there was any

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

    def start_from(self, leaving: Light) -> None:
        """Begin with light that leaves, for one sweep, if that is nearer than none."""
        arriving, residual = self._after(leaving)
        if float(residual.largest()) < self.residuals[0]:
            self.reach(arriving, residual)
        else:
            self.spend(1)

    def work_out(self) -> None:
        """The residual of the light so far by a sweep, where a solver carried it from step to step and rounding with it."""
        self.reach(*self._after(self.system.materials.reflected(self.system.source + self.arriving)))

    def _after(self, leaving: Light) -> tuple[Light, Light]:
        """What arrives of light that leaves, and its residual."""
        arriving, again = self.system.bounce(leaving)
        return arriving, combine([1, 1, -1], [self.system.materials.reflected(self.system.source), again, leaving])

    def keep(self) -> None:
        """A place from which to go on: save the state if it is time."""
        if self.checkpoint is not None:
            self.checkpoint.keep(self._state())

    @property
    def bound(self) -> float:
        return min(self.certificate.factor * self.residuals[-1], self._tight) if self.residuals[-1] > 0 else 0.0

    @property
    def close(self) -> bool:
        """Whether it is time to polish: not before, because that interrupts a solver."""
        known = self.system.near is not None and self.certificate.weights is not None and self.sweeps_left >= 2
        return known and not self.converged and self.bound * self._gain <= self.target

    def polish(self) -> None:
        """A closer look at the residual; else, by two sweeps more, at what one order of bounces, which smooths it, leaves.

        If the bound does not meet the target then, everything stays as it was, for the solver to go on.
        """
        begun, before = (self.arriving, self.residual), self.bound
        self._look_closer()
        if self.over:
            return
        order, residual = self.system.bounce(self.residual)
        self.reach(self.arriving + order, residual)
        if self.over:
            return
        self._look_closer()
        if not self.converged:
            # Not again before it can be expected to do.
            self._gain = min(1.5 * self.bound / before, 0.5)
            self.arriving, self.residual = begun
            self._tight = math.inf
            self.residuals.pop()
            self.spend(1)

    def tighten(self) -> None:
        """A sweep or a few for a bound that is near the error, if the iteration ended on one that makes far too much of it."""
        known = self.certificate.weights is not None and self.sweeps_left >= self._orders
        if known and self.converged and self.residuals[-1] > 0 and math.isinf(self._tight):
            self._look_closer()

    @property
    def _orders(self) -> int:
        """Sweeps of a closer look: without diffusion, some orders of bounces are nearer to the error than one."""
        return 1 if self.system.near is not None else _ORDERS

    def _look_closer(self) -> None:
        weights, slack = self.certificate.weights, self.certificate.slack
        assert weights is not None and slack is not None
        size = _sizes(self.residual)
        u = self.system.precondition(size)
        passed = self.system.bounce(u)[1]
        for _ in range(self._orders - 1):
            u = size + passed
            passed = self.system.bounce(u)[1]
        tight = float(_bounded(weights, slack, self.residual, u, passed))
        self.spend(self._orders)
        self._tight = tight if math.isfinite(tight) else math.inf
        self._meter.update(self.sweeps, math.pi * self.bound, math.pi * self.target)

    @property
    def rounding(self) -> float:
        """What the float type's rounding in the sweeps may add to the error, by the same bound.

        Light that a medium takes up before it arrives anywhere counts: what is left of it is as exact as it was bright. So
        does what is too faint for the type.
        """
        limits = jnp.finfo(self.residual.elements.dtype)
        largest = max(self.target / self._rtol, float(jax.lax.stop_gradient(self.system.direct.brightest)))
        faint = float(limits.tiny) if largest > 0 else 0.0
        return _ROUNDING * (float(limits.eps) * largest + faint) * (1 + self.certificate.factor)

    @property
    def converged(self) -> bool:
        return self.bound <= self.target

    @property
    def sweeps(self) -> int:
        return len(self.residuals) - 1 + self._more

    @property
    def sweeps_left(self) -> int:
        return self._most - self.sweeps

    def spend(self, sweeps: int) -> None:
        """Count sweeps that a solver made without telling what they led to."""
        self._more += sweeps

    def cut_short(self) -> None:
        """Say that what there is at the end is what was asked for."""
        self.asked = True

    @property
    def ending(self) -> str:
        """How it stands: "" (go on), "converged", "no bound", "diverged", "stagnated", "sweep limit" or "as asked"."""
        if self.converged:
            return "converged"
        if self.asked:
            return "as asked"
        if not self.residuals[-1] <= _GROWN * self.residuals[0]:
            return "diverged"
        # Without a bound the residual alone must do: as small as for a factor of 1000.
        if not math.isfinite(self.bound) and self.residuals[-1] <= 1e-3 * self.target:
            return "no bound"
        if self.stuck:
            return "stagnated"
        if len(self.residuals) > _STALLED and min(self.residuals[-_STALLED:]) >= min(self.residuals[:-_STALLED]):
            return "stagnated"
        return "sweep limit" if self.sweeps >= self._most else ""

    @property
    def over(self) -> bool:
        return self.ending != ""

    def note(self, residual: float, largest: float) -> None:
        """One sweep more, and what it led to: the largest residual, and the largest of all that leaves."""
        self.residuals.append(residual)
        self._tight = math.inf
        self.target = self._rtol * max(self._scale, largest)
        self._meter.update(self.sweeps, math.pi * self.bound, math.pi * self.target)

    def reach(self, arriving: Light, residual: Light) -> None:
        """One sweep more, and where it led to."""
        self.arriving, self.residual = arriving, residual
        self.note(float(residual.largest()), float(_largest(self.system, arriving)))


@program
def _sizes(light: Light) -> Light:
    return jax.tree.map(jnp.abs, light)


@program
def _brightest(stuff: Materials):
    return jnp.max(stuff.emission, initial=0.0)


@program
def _largest(system: System, arriving: Light):
    return system.materials.reflected(system.source + arriving).largest()
