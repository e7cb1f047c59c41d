"""The solvers of x = K x + b: which combination of sweeps comes next.

- `Jacobi` adds up orders of bounced light: the k-th iterate holds light of up to k bounces (Langer et al. 1995, eq. 1). As many
  sweeps as light bounces: fine below albedos of 0.5, hopeless near 1.
- `Krylov` takes the combination of what it has swept that leaves the smallest residual (GMRES), and sends what diffusion makes
  of the residual (`acceleration`): ten to twenty sweeps, whatever the albedo and the optical depth.
- `Anderson` mixes the last few iterates instead: nearly as good, with less memory, and no restarts.
- `OptimistixFixedPoint` leaves the iteration to a solver of optimistix (`optimistix_solver`).

All start from the light straight from the sources, and stop on the same certified bound.

Public: `Jacobi`, `Krylov`, `Anderson`, `automatic`, `worth_diffusing`.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from . import checks
from .arrays import ones_like
from .iteration import Iteration, System
from .krylov import Subspace, combine, dot, norm
from .operator import Light
from .programs import program

_FEW_BOUNCES = 0.1  # up to this albedo nothing beats adding up orders
_MANY_BOUNCES = 0.7  # from here on diffusion pays for its making
_MANY_GATHERED = 0.98  # likewise where a bounce is a gather, of which diffusion takes as long as several
_THICK = 3.0  # optical depth along the lattice's longest side, likewise


class Jacobi(eqx.Module):
    """The paper's iteration: one sweep a bounce. Converges where light is lost; quickly where albedos are low.

    Each sweep carries the last order of bounces alone, so rounding errors shrink with the orders.
    """

    def run(self, iteration: Iteration) -> None:
        while not iteration.over:
            order, residual = iteration.system.bounce(iteration.residual)
            arriving, iteration.lost = _add(iteration.arriving, iteration.lost, order)
            iteration.reach(arriving, residual)
            iteration.keep()


class Orders(eqx.Module):
    """The first `count` orders of bounces, and no more: what `solve(bounces=count)` runs."""

    count: int = eqx.field(static=True)

    def run(self, iteration: Iteration) -> None:
        iteration.cut_short()
        for _ in range(self.count):
            order, residual = iteration.system.bounce(iteration.residual)
            iteration.before = iteration.arriving
            iteration.reach(iteration.arriving + order, residual)


@program
def _add(total: Light, lost: Light, order: Light) -> tuple[Light, Light]:
    """Kahan's sum: `lost` holds the low bits."""
    addend = jax.tree.map(jnp.subtract, order, lost)
    after = total + addend
    return after, jax.tree.map(lambda new, old, a: (new - old) - a, after, total, addend)


class Krylov(eqx.Module):
    """GMRES on (I - K) x = b, restarted after `restart` sweeps; 2 `restart` + 1 fields more.

    With a medium it begins anew as soon as four sweeps or more have halved the residual on average: that takes no more sweeps,
    and mostly 9 fields.

    With `diffusion`, preconditioned by it (`acceleration`): nearly the same number of sweeps at any albedo and optical depth.
    """

    restart: int = eqx.field(static=True, default=12)
    diffusion: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        checks.positive_int("restart", self.restart)

    def run(self, iteration: Iteration) -> None:
        while not iteration.over:
            self._go_on(iteration)
            iteration.keep()

    def _go_on(self, iteration: Iteration) -> None:
        """Until it is over, or time to begin anew: what was kept till then is given up at the end."""
        precondition = iteration.system.precondition if self.diffusion else lambda light: light
        begun = iteration.arriving
        space = Subspace(iteration.system.bounce, iteration.residual, self.restart, precondition)
        while not (iteration.over or space.done):
            space.step()
            iteration.reach(begun + space.gain(), space.residual)
            if iteration.close:
                iteration.polish()


class Anderson(eqx.Module):
    """Anderson's mixing of the last `history` steps (J. ACM 12, 1965): 2 `history` fields more.

    From the residual r and its last changes R, with those of the iterate X, the next iterate is x - X c + M (r - R c), where c
    makes |r - R c| as small as can be, and M is diffusion (see `Krylov`) or 1.
    """

    history: int = eqx.field(static=True, default=6)
    diffusion: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        checks.positive_int("history", self.history)

    def run(self, iteration: Iteration) -> None:
        system = iteration.system
        changes: list[tuple[Light, Light]] = []
        while not iteration.over:
            arriving, residual = iteration.arriving, iteration.residual
            weights = _mixing([change for _, change in changes], residual)
            mixed, left = arriving, residual
            for weight, (of_arriving, of_residual) in zip(weights, changes, strict=True):
                mixed = combine([1, -weight], [mixed, of_arriving])
                left = combine([1, -weight], [left, of_residual])
            sent = system.precondition(left) if self.diffusion else left
            order, passed = system.bounce(sent)
            after, new = mixed + order, combine([1, -1, 1], [left, sent, passed])
            changes = [*changes, (combine([1, -1], [after, arriving]), combine([1, -1], [new, residual]))][-self.history :]
            iteration.reach(after, new)
            if iteration.close:
                iteration.polish()
            # Changes that differ little from one another make much of rounding: no bound rests on a residual that was carried.
            if iteration.sweeps_left == 1 or (iteration.over and len(changes) > 1):
                iteration.work_out()
                changes = []
            iteration.keep()


def _mixing(changes: list[Light], residual: Light) -> np.ndarray:
    """The c of least squares, by the normal equations of changes scaled to length 1."""
    lengths = np.array([float(norm(change)) for change in changes])
    if not len(changes) or not lengths.all():
        return np.zeros(len(changes))
    scaled = [combine([1 / length], [change]) for length, change in zip(lengths, changes, strict=True)]
    scale = float(norm(residual))
    unit = combine([1 / scale], [residual])
    gram = np.array([[float(dot(a, b)) for b in scaled] for a in scaled])
    right = np.array([float(dot(a, unit)) for a in scaled])
    accuracy = 8 * len(changes) * float(jnp.finfo(residual.elements.dtype).eps)
    return np.linalg.lstsq(gram, right, rcond=accuracy)[0] * scale / lengths


def _largest_albedo(system: System) -> float:
    return float(system.materials.reflected(ones_like(system.source)).largest())


def automatic(system: System, depth: float) -> Jacobi | Krylov:
    """The solver for a scene: by its largest albedo, and by the largest optical depth along an axis of the lattice."""
    largest = _largest_albedo(system)
    if largest <= _FEW_BOUNCES:
        return Jacobi()
    many = _MANY_BOUNCES if system.transport.links is None else _MANY_GATHERED
    return Krylov(diffusion=largest >= many or depth >= _THICK)


def worth_diffusing(system: System, solver: object) -> bool:
    """Whether a solve needs diffusion: to be fast, or only for its certificate."""
    if system.transport.links is None or not isinstance(solver, Krylov) or solver.diffusion:
        return True
    return _largest_albedo(system) >= _MANY_GATHERED
