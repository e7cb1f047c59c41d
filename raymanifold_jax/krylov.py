"""(I - K) x = b by generalised conjugate residuals, one application of K a step, and arithmetic of light.

With the residual r of the guess, a step sends z = M r through K. From w = (I - K) z its parts along the w of steps before are
taken off, from z the same of their z, and then

    x gains z <r, w> / <w, w>,        r loses w <r, w> / <w, w>:

|r| is as small as it can be with all of them (Eisenstat, Elman & Schultz, SIAM J. Numer. Anal. 20, 1983). With all steps kept
this is GMRES; where it converges quickly, (I - K) M is nearly symmetric, and the last few will do. M, the preconditioner, may
change from step to step. What is kept of each step is the caller's choice: z, or what of it arrives.

Public: `Direction`, `step`, `FEW`, `MANY`, `linear_solve`, `combine`, `dot`, `norm`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .arrays import zeros_like
from .operator import Light
from .programs import program

FEW = 5  # steps to keep where each at least halves the residual
MANY = 12  # elsewhere


class Direction(NamedTuple):
    """A step that was made: what is kept of it, and its w, of length 1."""

    kept: Light
    image: Light


def step(
    apply: Callable[[Light], tuple[Light, Light]],
    precondition: Callable[[Light], Light],
    solution: Light,
    residual: Light,
    before: Sequence[Direction],
) -> tuple[Light, Light, Direction]:
    """The next solution, its residual, and the direction taken; `apply(z)` returns (what to keep of z, K z)."""
    unit, scale = _unit(residual)
    sent = precondition(unit)
    kept, passed = apply(sent)
    # One program for few and one for many.
    missing = FEW - len(before) if len(before) <= FEW else -len(before) % MANY
    filled = (*before, *(no_directions(kept, residual, missing) if missing else ()))
    solution, residual, direction = _step(solution, residual, scale, filled, sent, kept, passed)
    return solution, residual, direction


def no_directions(kept: Light, image: Light, count: int) -> tuple[Direction, ...]:
    """Zeros, which change nothing, alike what these are."""
    return (Direction(zeros_like(kept), zeros_like(image)),) * count


def linear_solve(
    apply: Callable[[Light], Light],
    right: Light,
    precondition: Callable[[Light], Light] = lambda light: light,
    good: Callable[[Light], bool] | None = None,
    most: int = 200,
) -> tuple[Light, Light, int]:
    """Solve (I - K) x = right for any linear `apply`, K or its transpose, with light of any sign.

    `good(residual)` says when to stop, by default below 1e-5 of `right` in the 2-norm; `most` is the most applications.
    Returns x, the residual, and how many times K was applied.
    """
    target = 1e-5 * float(norm(right))
    good = (lambda residual: float(norm(residual)) <= target) if good is None else good
    solution, residual, count = zeros_like(right), right, 0
    directions: list[Direction] = []
    both = lambda sent: (sent, apply(sent))
    while count < most and not good(residual):
        solution, residual, direction = step(both, precondition, solution, residual, directions)
        directions = [*directions, direction][-MANY:]
        count += 1
    return solution, residual, count


@program
def _unit(light: Light) -> tuple[Light, Array]:
    """Over its largest value, so that squares neither overflow nor vanish, and that value."""
    scale = jnp.maximum(light.largest(), jnp.finfo(light.elements.dtype).tiny)
    return jax.tree.map(lambda x: x / scale, light), scale


@program
def _step(
    solution: Light, residual: Light, scale: Array, before: tuple[Direction, ...], sent: Light, kept: Light, passed: Light
) -> tuple[Light, Light, Direction]:
    image = jax.tree.map(jnp.subtract, sent, passed)
    images = [direction.image for direction in before]
    overlaps = [jnp.zeros((), scale.dtype)] * len(before)
    for _ in range(2):  # twice is enough, in float32 too
        more = [dot(image, other) for other in images]
        image, overlaps = _less(image, more, images), list(map(jnp.add, overlaps, more))
    kept = _less(kept, overlaps, [direction.kept for direction in before])
    length = norm(image)
    inverse = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
    kept, image = (jax.tree.map(lambda x: x * inverse, light) for light in (kept, image))
    along = scale * dot(jax.tree.map(lambda x: x / scale, residual), image)
    return _less(solution, [-along], [kept]), _less(residual, [along], [image]), Direction(kept, image)


def _less(light: Light, weights: Sequence[Array], others: Sequence[Light]) -> Light:
    """Light without so much of the others."""
    for weight, other in zip(weights, others, strict=True):
        light = jax.tree.map(lambda x, o, weight=weight: x - weight * o, light, other)
    return light


def dot(a: Light, b: Light) -> Array:
    return sum(jax.tree.leaves(jax.tree.map(lambda x, y: jnp.sum(x * y), a, b)), start=jnp.zeros((), a.elements.dtype))


@program
def norm(light: Light) -> Array:
    """The 2-norm, with squares that neither overflow nor vanish."""
    unit, scale = _unit(light)
    return scale * jnp.sqrt(dot(unit, unit))


@program
def _sum(weights: tuple[Array, ...], fields: tuple[Light, ...]) -> Light:
    total = jax.tree.map(lambda x: weights[0] * x, fields[0])
    for weight, field in zip(weights[1:], fields[1:], strict=True):
        total = jax.tree.map(lambda t, x, weight=weight: t + weight * x, total, field)
    return total


def combine(weights, fields: list[Light]) -> Light:
    """The sum of `fields`, each times its weight."""
    real = fields[0].elements.dtype
    return _sum(tuple(np.asarray(w, real) for w in weights), tuple(fields))
