"""GMRES on (I - K) x = b, one application of K a step, and arithmetic of light.

With the residual r of the guess, the basis v_0 = r / |r|, v_1, ... is orthonormal, and step k sends z_k = M v_k through K:

    (I - K) z_k = v_0 h_0k + ... + v_{k+1} h_{k+1,k},       x = sum y_k z_k,       |r - (I - K) x| as small as can be.

M, the preconditioner, may change from step to step (flexible GMRES: Saad, SIAM J. Sci. Comput. 14, 1993). What is kept of
each step is the caller's choice: z_k, or what of it arrives. The numbers h are worked with in float64 on the host.

Public: `Subspace`, `linear_solve`, `combine`, `dot`, `norm`.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .arrays import zeros_like
from .operator import Light
from .programs import program

_INDEPENDENT = 1e-6  # of the first residual: less than this of a new direction is rounding
_QUICK = 4  # steps at least, with a medium, that halve the residual on average, before it is time to begin anew


class Subspace:
    """What GMRES knows after some steps from a residual `start`.

    `apply(z)` returns (what to keep of z, K z). `residual` is what is left of `start`; `gain()` the same combination of what
    was kept as x is of the z. It is `done`, and time to begin anew from there, after `size` steps, where no step can help, and,
    to keep fewer fields of voxels, where the residual falls quickly anyway.
    """

    def __init__(self, apply: Callable[[Light], tuple[Light, Light]], start: Light, size: int, precondition: Callable):
        self._apply, self._precondition, self._size = apply, precondition, size
        self._length = float(norm(start))
        self._basis = [combine([1 / self._length], [start])]
        self._kept: list[Light] = []
        self._hessenberg = np.zeros((size + 1, size))
        self._weights = np.zeros(0)
        self.residual, self.done = start, False

    def step(self) -> None:
        k = len(self._kept)
        sent = self._precondition(self._basis[k])
        kept, passed = self._apply(sent)
        self._kept.append(kept)
        vector, column = _arnoldi(self._as_many(self._basis), np.int32(k + 1), sent, passed)
        self._basis.append(vector)
        hessenberg, column = self._hessenberg, np.asarray(column, np.float64)
        hessenberg[: k + 1, k], hessenberg[k + 1, k] = column[: k + 1], column[-1]
        small = hessenberg[: k + 2, : k + 1]
        right = np.zeros(k + 2)
        right[0] = self._length
        self._weights = np.linalg.lstsq(small, right, rcond=None)[0]
        left = right - small @ self._weights
        self.residual = self._combined(left, self._basis)
        quick = passed.voxels is not None and k + 1 >= _QUICK and np.linalg.norm(left) <= 0.5 ** (k + 1) * self._length
        alike = hessenberg[k + 1, k] <= _INDEPENDENT * abs(hessenberg[: k + 1, k]).max()
        self.done = quick or k + 1 == self._size or bool(alike)

    def gain(self) -> Light:
        return self._combined(self._weights, self._kept)

    def _combined(self, weights: np.ndarray, fields: list[Light]) -> Light:
        fields = self._as_many(fields)
        return combine([*weights, *np.zeros(len(fields) - len(weights))], fields)

    def _as_many(self, fields: list[Light]) -> list[Light]:
        """With the first once more, and again, so that two programs serve any number."""
        many = _QUICK + 1 if len(fields) <= _QUICK + 1 else self._size + 1
        return [*fields, *fields[:1] * (many - len(fields))]


def linear_solve(
    apply: Callable[[Light], Light],
    right: Light,
    precondition: Callable[[Light], Light] = lambda light: light,
    good: Callable[[Light], bool] | None = None,
    most: int = 200,
    restart: int = 12,
) -> tuple[Light, Light, int]:
    """Solve (I - K) x = right for any linear `apply`, K or its transpose, with light of any sign.

    `good(residual)` says when to stop, by default below 1e-5 of `right` in the 2-norm; `most` is the most applications.
    Returns x, the residual, and how many times K was applied.
    """
    target = 1e-5 * float(norm(right))
    good = (lambda residual: float(norm(residual)) <= target) if good is None else good
    solution, residual, count = zeros_like(right), right, 0
    while count < most and not good(residual):
        space = Subspace(lambda sent: (sent, apply(sent)), residual, restart, precondition)
        while True:
            space.step()
            count += 1
            if space.done or count >= most or good(space.residual):
                break
        solution, residual = solution + space.gain(), space.residual
    return solution, residual, count


@program
def _arnoldi(basis: list[Light], count: Array, sent: Light, passed: Light) -> tuple[Light, Array]:
    """The next basis vector: (I - K) sent, made orthogonal to the first `count` of the basis; `passed` is K sent."""
    vector = jax.tree.map(jnp.subtract, sent, passed)
    column = jnp.zeros(len(basis), sent.elements.dtype)
    for _ in range(2):  # twice is enough, in float32 too
        overlap = jnp.where(jnp.arange(len(basis)) < count, jnp.stack([dot(b, vector) for b in basis]), 0.0)
        for k, b in enumerate(basis):
            vector = jax.tree.map(lambda v, x, k=k, overlap=overlap: v - overlap[k] * x, vector, b)
        column = column + overlap
    length = norm(vector)
    scale = jnp.where(length > 0, 1 / jnp.where(length > 0, length, 1.0), 0.0)
    return jax.tree.map(lambda v: v * scale, vector), jnp.append(column, length)


def dot(a: Light, b: Light) -> Array:
    return sum(jax.tree.leaves(jax.tree.map(lambda x, y: jnp.sum(x * y), a, b)), start=jnp.zeros((), a.elements.dtype))


@program
def norm(light: Light) -> Array:
    """The 2-norm, with squares that neither overflow nor vanish."""
    scale = jnp.maximum(light.largest(), jnp.finfo(light.elements.dtype).tiny)
    scaled = jax.tree.map(lambda x: x / scale, light)
    return scale * jnp.sqrt(dot(scaled, scaled))


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
