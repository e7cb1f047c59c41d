"""Derivatives of a solve: one more linear solve each, and no tape over iterations.

The bounced light a that arrives is the fixed point

    a = T R (s + a),        T transport, R reflection and scattering, s first-flight light,

whatever iteration found it. Where T, R and s change,

    da = (I - T R)^-1 (d(T R) (s + a) + T R ds),        and backwards        l = a' + R'T' l,

the second with the transposed sweep; l is then pulled back through one application of T R. Both are solved by
the steps of `krylov` on u = v + A u: of known numbers on the host, with diffusion for a preconditioner (`acceleration`); while
JAX traces (`jit`, `vmap`), without one, in a loop of the program, and a solve keeps no record of its sweeps.

Public: `attach`, `Unwatched`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Array, Int

from . import checks
from .acceleration import Diffusion
from .adjoint import linear
from .arrays import stop_gradient
from .iteration import Certificate, System
from .krylov import FEW, Direction, linear_solve, no_directions, norm, step
from .operator import Light, Materials, Transport
from .solvers import Krylov

_Residuals = tuple[Transport, Materials, Diffusion | None]
_SHARE = 0.1  # of the solve's tolerance that residuals of derivatives may have, relative to what is solved for


class Unwatched:
    """What stands for an iteration while JAX traces the solve: its result, and no bound on the error."""

    def __init__(self, system: System, rtol: float, most: int):
        self.system = system
        known = stop_gradient(system)
        first = known.bounce(known.materials.reflected(known.source))[0]
        self.arriving = _Solve(rtol, most, False)((known.transport, known.materials, None), first)
        self.bound = self.target = self.rounding = math.nan
        self.residuals, self.sweeps, self.certificate = [math.nan], 0, Certificate(math.nan, 0)
        self.ending, self.solver = "", Krylov(diffusion=False)


def attach(system: System, arriving: Light, rtol: float, most: int) -> Light:
    """`arriving`, the fixed point of `system`, with derivatives in everything that `system` holds.

    `rtol` and `most` (sweeps) are the solve's.
    """

    @jax.custom_jvp
    def fixed(system, arriving):
        return arriving

    def rule(primals, tangents):
        system, value = primals
        leaves, tree = jax.tree.flatten(system)
        moves = jax.tree.leaves(tangents[0], is_leaf=lambda x: isinstance(x, SymbolicZero))
        active = [i for i, m in enumerate(moves) if not isinstance(m, SymbolicZero)]
        arriving = fixed(system, value)  # once more, so that it can be differentiated again

        def bounce(*values):
            full = list(leaves)
            for i, v in zip(active, values, strict=True):
                full[i] = v
            moved: System = tree.unflatten(full)
            return moved.bounce(moved.materials.reflected(moved.source + arriving))[0]

        change = jax.jvp(bounce, [leaves[i] for i in active], [moves[i] for i in active])[1]
        return arriving, _solved(rtol, most, False, (system.transport, system.materials, system.near), change)

    fixed.defjvp(rule, symbolic_zeros=True)
    return fixed(system, stop_gradient(arriving))


def _solved(rtol: float, most: int, transposed: bool, residuals, operand: Light) -> Light:
    forward, backward = _Solve(rtol, most, transposed), _Solve(rtol, most, not transposed)
    derivatives = _Change(rtol, most, transposed), _Change(rtol, most, not transposed)
    return linear(forward, backward, residuals, operand, operand, derivatives)


@dataclasses.dataclass(frozen=True)
class _Solve:
    """u = v + A u, with A = T R or its transpose."""

    rtol: float
    most: int
    transposed: bool

    def __call__(self, residuals: _Residuals, operand: Light) -> Light:
        apply = lambda u: _apply(self.transposed, residuals, u)
        tolerance = max(_SHARE * self.rtol, 16 * float(jnp.finfo(operand.elements.dtype).eps))
        if checks.is_traced((residuals, operand)):
            return _solved_within(apply, operand, tolerance, self.most)
        near = residuals[2]
        precondition = (lambda u: u) if near is None else near.of_arriving_transposed if self.transposed else near.of_arriving
        target = tolerance * float(norm(operand))
        good = lambda residual: float(norm(residual)) <= target
        return linear_solve(apply, operand, precondition, good, self.most)[0]


@dataclasses.dataclass(frozen=True)
class _Change:
    """How u changes with A: du = dA u + A du."""

    rtol: float
    most: int
    transposed: bool

    def __call__(self, residuals, operand: Light, result: Light, tangent: Callable) -> Light:
        change = tangent(lambda r: _apply(self.transposed, r, result))
        return _solved(self.rtol, self.most, self.transposed, residuals, change)


def _apply(transposed: bool, residuals: _Residuals, light: Light) -> Light:
    transport, stuff, _ = residuals
    if transposed:
        return stuff.reflected(transport.transposed(light, scattered=True))
    return transport(stuff.reflected(light), fluence=stuff.extinction is not None, scattered=True)


# The solver of `krylov` as a loop of a program


class _State(NamedTuple):
    solution: Light
    residual: Light
    directions: tuple[Direction, ...]
    count: Int[Array, ""]


def _solved_within(apply: Callable[[Light], Light], right: Light, tolerance: float, most: int) -> Light:
    """u with |right + A u - u| <= tolerance |right|, Euclidean."""
    target = tolerance * norm(right)
    none = jnp.zeros((), np.int32)
    state = _State(jax.tree.map(jnp.zeros_like, right), right, no_directions(right, right, FEW), none)

    def advance(state: _State) -> _State:
        both = lambda sent: (sent, apply(sent))
        solution, residual, direction = step(both, lambda u: u, state.solution, state.residual, state.directions)
        return _State(solution, residual, (*state.directions[1:], direction), state.count + 1)

    going = lambda state: (norm(state.residual) > target) & (state.count < most)
    return lax.while_loop(going, advance, state).solution
