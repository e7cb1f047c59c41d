"""Derivatives by hand-written adjoints, where JAX would keep a tape.

A function that sweeps or marches in loops is differentiated forwards by JAX as it stands. Backwards, JAX would keep what every
turn of a loop leaves behind; `with_adjoint` takes a function of one's own instead: with v = f(u) and a cotangent v' it gives
u' = (df/du)' v'. Both modes rest on a *linear map* whose transpose is known,

    du -> (df/du) du        and        v' -> (df/du)' v',

so `jax.jvp`, `vjp`, `grad` and forward over reverse (Hessian-vector products) work, under `jit` and `vmap` too. Reverse over
reverse does not.

Outside `jit` a linear map runs on known numbers: it may loop on the host until it has converged.

Public: `linear`, `with_adjoint`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jax.core import ShapedArray, Tracer
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from . import checks
from .arrays import is_staging

_linear_p = Primitive("linear_with_transpose")
_linear_p.multiple_results = True


@dataclasses.dataclass(frozen=True)
class _Map:
    """A linear map and its transpose on flat lists of arrays; equal maps are compiled once."""

    forward: Callable
    backward: Callable
    derivative: _Derivatives | None
    residuals: Any  # tree structures
    operand: Any
    result: Any
    result_shapes: tuple
    operand_shapes: tuple

    def run(self, *arrays):
        residuals, operand = self.split(arrays)
        leaves, found = jax.tree.flatten(self.forward(residuals, operand))
        if found != self.result:
            raise AssertionError(f"linear: got a result of structure {found}, expected {self.result}")
        return [jnp.asarray(leaf, shape.dtype) for leaf, shape in zip(leaves, self.result_shapes, strict=True)]

    def split(self, arrays) -> tuple[Any, Any]:
        count = self.residuals.num_leaves
        return self.residuals.unflatten(arrays[:count]), self.operand.unflatten(arrays[count:])

    def transposed(self) -> _Map:
        return _Map(
            self.backward, self.forward, _swap(self.derivative), self.residuals, self.result, self.operand, self.operand_shapes,
            self.result_shapes,
        )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class _Derivatives:
    """How a map and its transpose change with the residuals."""

    forward: Callable
    backward: Callable


def _swap(derivative: _Derivatives | None) -> _Derivatives | None:
    return None if derivative is None else _Derivatives(derivative.backward, derivative.forward)


def linear(
    forward: Callable,
    backward: Callable,
    residuals: Any,
    operand: Any,
    result: Any,
    derivatives: tuple[Callable, Callable] | None = None,
) -> Any:
    """forward(residuals, operand), linear in `operand`, with the transpose backward(residuals, cotangent).

    Both functions are of modules, or compare as equal where they are the same: programs are kept by them. `result` has the
    structure, shapes and dtypes of the result. `derivatives`, if given, are functions (residuals, operand, result, tangent)
    that tell how the results of `forward` and `backward` change with the residuals, where `tangent(function)` is the
    derivative of a function of the residuals; else JAX differentiates the two forwards.
    """
    shapes = lambda tree: tuple(jax.ShapeDtypeStruct(jnp.shape(a), jnp.result_type(a)) for a in jax.tree.leaves(tree))
    residual_leaves, residual_tree = jax.tree.flatten(residuals)
    leaves, tree = jax.tree.flatten(operand)
    how = None if derivatives is None else _Derivatives(*derivatives)
    result_tree = jax.tree.structure(result)
    the_map = _Map(forward, backward, how, residual_tree, tree, result_tree, shapes(result), shapes(operand))
    return result_tree.unflatten(_linear_p.bind(*residual_leaves, *leaves, map=the_map))


def with_adjoint(function: Callable, adjoint: Callable) -> Callable:
    """`function` of pytrees, differentiated backwards by adjoint(arguments, wanted, cotangent).

    `adjoint` gets the tuple of arguments, the same tree with True where a leaf's cotangent is wanted, and the result's
    cotangent; it returns a tree like the arguments, with anything (None too) where nothing is wanted. Both are of modules, or
    compare as equal where they are the same. A method function.push(arguments, moves), if there is one, may give the derivative
    along `moves` (None where nothing moves), or None to leave it to JAX.
    """

    @jax.custom_jvp
    def run(arguments):
        return function(*arguments)

    def rule(primals, tangents):
        (arguments,), (moved,) = primals, tangents
        leaves, tree = jax.tree.flatten(arguments)
        moves = jax.tree.leaves(moved, is_leaf=lambda x: isinstance(x, SymbolicZero))
        active = tuple(not isinstance(m, SymbolicZero) for m in moves)
        result = run(arguments)
        operand = [m for m in moves if not isinstance(m, SymbolicZero)]
        if not operand:
            return result, jax.tree.map(jnp.zeros_like, result)
        push, pull = _Push(function, tree, active), _Pull(adjoint, tree, active)
        return result, linear(push, pull, leaves, operand, result)

    run.defjvp(rule, symbolic_zeros=True)

    def call(*arguments):
        # Known numbers without JAX's ceremony, which takes 3 ms where there are a hundred arrays.
        return run(arguments) if checks.is_traced(arguments) or is_staging() else function(*arguments)

    return call


@dataclasses.dataclass(frozen=True)
class _Push:
    function: Callable
    tree: Any
    active: tuple[bool, ...]

    def __call__(self, leaves, tangents):
        known = getattr(self.function, "push", None)
        if known is not None:
            given = iter(tangents)
            moves = self.tree.unflatten([next(given) if on else None for on in self.active])
            if (result := known(self.tree.unflatten(leaves), moves)) is not None:
                return result

        def moving(*values):
            given = iter(values)
            full = [next(given) if on else leaf for on, leaf in zip(self.active, leaves, strict=True)]
            return self.function(*self.tree.unflatten(full))

        return jax.jvp(moving, tuple(leaf for on, leaf in zip(self.active, leaves, strict=True) if on), tuple(tangents))[1]


@dataclasses.dataclass(frozen=True)
class _Pull:
    adjoint: Callable
    tree: Any
    active: tuple[bool, ...]

    def __call__(self, leaves, cotangent):
        arguments, wanted = self.tree.unflatten(leaves), self.tree.unflatten(self.active)
        back = self.adjoint(arguments, wanted, cotangent)
        kept = [value for on, value in zip(self.active, self.tree.flatten_up_to(back), strict=True) if on]
        like = [leaf for on, leaf in zip(self.active, leaves, strict=True) if on]
        return [jnp.zeros_like(leaf) if v is None else v.astype(leaf.dtype) for v, leaf in zip(kept, like, strict=True)]


# The primitive's rules


@_linear_p.def_impl
def _run(*arrays, map):
    return map.run(*arrays)


@_linear_p.def_abstract_eval
def _shapes(*arrays, map):
    return [ShapedArray(s.shape, s.dtype) for s in map.result_shapes]


mlir.register_lowering(_linear_p, mlir.lower_fun(lambda *arrays, map: map.run(*arrays), multiple_results=True))


def _jvp(primals, tangents, *, map):
    count = map.residuals.num_leaves
    result = _linear_p.bind(*primals, map=map)
    zero = lambda t: type(t) is ad.Zero
    total = [jnp.zeros(s.shape, s.dtype) for s in map.result_shapes]
    if not all(zero(t) for t in tangents[count:]):
        moved = [ad.instantiate_zeros(t) for t in tangents[count:]]
        total = _linear_p.bind(*primals[:count], *moved, map=map)
    active = [i for i in range(count) if not zero(tangents[i])]
    if active:
        residuals, operand = map.split(primals)

        def tangent(function):
            def moving(*values):
                leaves = list(primals[:count])
                for i, value in zip(active, values, strict=True):
                    leaves[i] = value
                return function(map.residuals.unflatten(leaves))

            return jax.jvp(moving, [primals[i] for i in active], [tangents[i] for i in active])[1]

        if map.derivative is None:
            change = tangent(lambda r: map.forward(r, operand))
        else:
            change = map.derivative.forward(residuals, operand, map.result.unflatten(result), tangent)
        total = [t + c for t, c in zip(total, jax.tree.leaves(change), strict=True)]
    return result, total


ad.primitive_jvps[_linear_p] = _jvp


def _transpose(cotangents, *arrays, map):
    count = map.residuals.num_leaves
    back = map.transposed()
    given = [ad.instantiate_zeros(c) for c in cotangents]
    result = _linear_p.bind(*arrays[:count], *given, map=back)
    return [None] * count + [r if ad.is_undefined_primal(a) else None for r, a in zip(result, arrays[count:], strict=True)]


ad.primitive_transposes[_linear_p] = _transpose


def _batch(arrays, axes, *, map):
    # One after the other: a sweep fills the machine as it is.
    size = next(a.shape[x] for a, x in zip(arrays, axes, strict=True) if x is not None)
    moving = [i for i, x in enumerate(axes) if x is not None]
    stacked = [jnp.moveaxis(arrays[i], axes[i], 0) for i in moving]

    def one(values):
        full = list(arrays)
        for i, value in zip(moving, values, strict=True):
            full[i] = value
        return _linear_p.bind(*full, map=map)

    known = not any(isinstance(a, Tracer) for a in arrays)
    if known:
        results = [one([s[k] for s in stacked]) for k in range(size)]
        return [jnp.stack(r) for r in zip(*results, strict=True)], [0] * len(results[0])
    results = lax.map(one, stacked)
    return results, [0] * len(results)


batching.primitive_batchers[_linear_p] = _batch
