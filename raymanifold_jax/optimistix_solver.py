"""Fixed-point solvers of optimistix at work on x = b + K x.

Public: `OptimistixFixedPoint`.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax

from . import checks
from .iteration import Iteration
from .krylov import combine
from .operator import Light

_LEAST_GAIN = 0.5  # of the residual: a run that leaves more has made no progress worth another


class OptimistixFixedPoint(eqx.Module):
    """`optimistix.fixed_point` with one of its solvers, such as `optimistix.FixedPointIteration(rtol=1e-4, atol=1e-6)`.

    It is run on b + K x with `throw=False` (raising gathers fields, and can hang on several devices) and an iterative adjoint
    (lineax's GMRES; the default builds a dense matrix). Then one sweep more gives the residual, for which it is run again until
    the certified bound is met, or a run does not halve the residual. Tolerances of the solver are relative to its own
    unknowns; each run solves for the residual, scaled to 1. Root finders with dense Jacobians are out of reach.

    **Raises** `TypeError` for what is no optimistix solver.
    """

    solver: Any

    def __init__(self, solver: Any):
        import optimistix

        kinds = (optimistix.AbstractFixedPointSolver, optimistix.AbstractRootFinder)
        checks.instance("solver", solver, kinds, "pass optimistix.FixedPointIteration(rtol=1e-4, atol=1e-6)")
        self.solver = solver

    def run(self, iteration: Iteration) -> None:
        import lineax
        import optimistix

        system = iteration.system
        adjoint = optimistix.ImplicitAdjoint(linear_solver=lineax.GMRES(rtol=1e-5, atol=1e-7))
        calls = 0

        def count() -> None:
            nonlocal calls
            calls += 1

        def step(unknown: Light, right: Light) -> Light:
            jax.debug.callback(count)
            return right + system.bounce(unknown)[1]

        while not iteration.over:
            before, scale = iteration.residuals[-1], float(iteration.residual.largest())
            right = combine([1 / scale], [iteration.residual])
            most = max(1, iteration.sweeps_left - 1)
            found = optimistix.fixed_point(step, self.solver, right, right, adjoint=adjoint, max_steps=most, throw=False)
            jax.effects_barrier()
            sent = combine([scale], [found.value])
            order, passed = system.bounce(sent)
            iteration.spend(calls)
            calls = 0
            iteration.reach(iteration.arriving + order, combine([1, -1, 1], [iteration.residual, sent, passed]))
            if not iteration.residuals[-1] <= _LEAST_GAIN * before:
                iteration.stuck = True
