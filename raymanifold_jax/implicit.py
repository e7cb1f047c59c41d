"""Derivatives of a solve: one more linear solve each, and no tape over iterations.

The bounced light a that arrives is the fixed point

    a = T R (s + a),        T transport, R reflection and scattering, s first-flight light,

whatever iteration found it. Where T, R and s change,

    da = (I - T R)^-1 (d(T R) (s + a) + T R ds),        and backwards        l = a' + R'T' l,

the second with the transposed sweep; l is then pulled back through one application of T R. Both are solved by restarted GMRES
on u = v + A u. Known numbers are iterated on the host, with diffusion for a preconditioner (`acceleration`); while JAX traces
(`jit`, `vmap`) plain steps make up a loop of the program, and a solve keeps no record of its sweeps.

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
from jaxtyping import Array, Float, Int

from . import checks
from .acceleration import Diffusion
from .adjoint import linear
from .arrays import stop_gradient
from .iteration import Certificate, System
from .krylov import dot, linear_solve, norm
from .operator import Light, Materials, Transport
from .solvers import Krylov

_RESTART = 8
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
        self.ending, self.solver = "", Krylov(_RESTART, diffusion=False)


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
            return _gmres(apply, operand, tolerance, self.most)
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


# GMRES (see `krylov`) as a loop of a program


class _State(NamedTuple):
    solution: Light
    basis: Light  # stacked: _RESTART + 1
    hessenberg: Float[Array, "m1 m"]
    length: Float[Array, ""]  # of the residual the cycle began with
    left: Float[Array, ""]  # of the residual now
    step: Int[Array, ""]
    count: Int[Array, ""]


def _gmres(apply: Callable[[Light], Light], right: Light, tolerance: float, most: int) -> Light:
    """u with |right + A u - u| <= tolerance |right|, Euclidean."""
    state, scale, target = _begin(right, tolerance)
    last = lambda state: jax.tree.map(lambda b: lax.dynamic_index_in_dim(b, state.step, 0, keepdims=False), state.basis)
    going = lambda state: (state.left > target) & (state.count < most)
    state = lax.while_loop(going, lambda state: _advance(state, apply(last(state)), target), state)
    return jax.tree.map(lambda x: x * scale, state.solution)


@jax.jit
def _begin(right: Light, tolerance) -> tuple[_State, Array, Array]:
    # Scaled, so that squares neither overflow nor vanish: loss functions may be tiny.
    largest = right.largest()
    scale = jnp.where(largest > 0, largest, 1.0)
    right = jax.tree.map(lambda x: x / scale, right)
    length = jnp.sqrt(dot(right, right))
    real = right.elements.dtype
    basis = jax.tree.map(lambda x: jnp.zeros((_RESTART + 1, *x.shape), real), right)
    first = jax.tree.map(lambda b, x: b.at[0].set(x / jnp.where(length > 0, length, 1.0)), basis, right)
    none = jnp.zeros((), np.int32)
    nothing = jax.tree.map(jnp.zeros_like, right)
    state = _State(nothing, first, jnp.zeros((_RESTART + 1, _RESTART), real), length, length, none, none)
    return state, scale, tolerance * length


@jax.jit
def _advance(state: _State, image: Light, target: Array) -> _State:
    """One step: `image` is A applied to the last vector of the basis."""
    basis, step = state.basis, state.step
    vector = jax.tree.map(lambda b, x: lax.dynamic_index_in_dim(b, step, 0, keepdims=False) - x, basis, image)
    column = jnp.zeros(_RESTART + 1, state.length.dtype)
    for _ in range(2):  # twice is enough, in float32 too; unused vectors are 0
        overlap = sum(jax.tree.leaves(jax.tree.map(lambda b, x: jnp.tensordot(b, x, x.ndim), basis, vector)))
        vector = jax.tree.map(lambda b, x, overlap=overlap: x - jnp.tensordot(overlap, b, 1), basis, vector)
        column = column + overlap
    length = jnp.sqrt(dot(vector, vector))
    inverse = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
    basis = jax.tree.map(lambda b, x: lax.dynamic_update_index_in_dim(b, x * inverse, step + 1, 0), basis, vector)
    hessenberg = state.hessenberg.at[:, step].set(column.at[step + 1].set(length))
    right = jnp.zeros_like(column).at[0].set(state.length)
    weights = jnp.linalg.lstsq(hessenberg, right)[0]
    residual = right - hessenberg @ weights
    left = jnp.sqrt(jnp.sum(residual**2))
    ends = (step + 1 == _RESTART) | (left <= target) | (length <= 1e-6 * state.length)

    def end(_):
        solution = jax.tree.map(lambda s, b: s + jnp.tensordot(weights, b[:-1], 1), state.solution, basis)
        vector = jax.tree.map(lambda b: jnp.tensordot(residual, b, 1), basis)
        size = jnp.sqrt(dot(vector, vector))
        inverse = jnp.where(size > 0, 1 / jnp.where(size > 0, size, 1.0), 0.0)
        first = jax.tree.map(lambda b, x: jnp.zeros_like(b).at[0].set(x * inverse), basis, vector)
        return _State(solution, first, jnp.zeros_like(hessenberg), size, size, jnp.zeros_like(step), state.count + 1)

    def go_on(_):
        return _State(state.solution, basis, hessenberg, state.length, left, step + 1, state.count + 1)

    return lax.cond(ends, end, go_on, None)
