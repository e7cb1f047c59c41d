"""Sweeps that can be differentiated: by the sources they carry, and by the extinction they cross.

`swept` is `sweep` and `unswept` is `transposed_sweep`, with fields of the lattice in and out, under JAX's transformations:
forwards JAX differentiates them itself, backwards `adjoint_sweep` does. With K(s) for a sweep through the extinction s, the
adjoints of (s, x) -> K x and (s, y) -> K'y share the form <y, K x>:

    of K x:   x' = K'y,      s' = d<y, K x>/ds        (y the cotangent)
    of K'y:   y' = K z,      s' = d<y, K z>/ds        (z the cotangent)

Public: `swept`, `unswept`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .. import checks
from ..adjoint import with_adjoint
from ..layout import Layout, Ordinates
from .characteristic import Inflow, SweptMedium, sweep
from .transpose import adjoint_sweep, transposed_sweep

Field = Float[Array, "C nx ny nz"]
Results = tuple[Float[Array, "C E"], Field | None]


def swept(
    layout: Layout,
    ordinates: tuple[Ordinates, ...],
    extinction: Float[Array, "C X Y Z"] | None,
    thin: bool,
    exitance: Float[Array, "C E"],
    source: Field | None,
    inflow: Inflow | None,
    fluence: bool,
) -> Results:
    """`sweep`: sums at the elements and, with `fluence`, in the voxels. `source` of None is a dark medium."""
    return with_adjoint(_Sweep(thin, fluence), _SweepAdjoint(thin))(layout, ordinates, extinction, exitance, source, inflow)


def unswept(
    layout: Layout,
    ordinates: tuple[Ordinates, ...],
    extinction: Float[Array, "C X Y Z"] | None,
    thin: bool,
    at_elements: Float[Array, "C E"],
    in_voxels: Field | None,
) -> Results:
    """`transposed_sweep`: what was sent, from weights of the sums."""
    return with_adjoint(_Unsweep(thin), _UnsweepAdjoint(thin))(layout, ordinates, extinction, at_elements, in_voxels)


@dataclasses.dataclass(frozen=True)
class _Sweep:
    thin: bool
    fluence: bool

    def __call__(self, *arguments) -> Results:
        return _sweep(self.thin, self.fluence, *arguments)

    def push(self, arguments, moves) -> Results | None:
        """Where only what is carried moves: another sweep, by the same program."""
        layout, ordinates, extinction, exitance, source, inflow = arguments
        _, _, crossed, moved, emitted, light = moves
        if crossed is not None or (light is not None and light.factor is not None):
            return None
        moved = jnp.zeros_like(exitance) if moved is None else moved
        emitted = jnp.zeros_like(source) if emitted is None and source is not None else emitted
        entering = None if light is None or light.radiance is None else Inflow(light.radiance, inflow.factor)
        return _sweep(self.thin, self.fluence, layout, ordinates, extinction, moved, emitted, entering)


@dataclasses.dataclass(frozen=True)
class _Unsweep:
    thin: bool

    def __call__(self, *arguments) -> Results:
        return _unsweep(self.thin, *arguments)

    def push(self, arguments, moves) -> Results | None:
        layout, ordinates, extinction, at_elements, in_voxels = arguments
        _, _, crossed, elements, voxels = moves
        if crossed is not None:
            return None
        elements = jnp.zeros_like(at_elements) if elements is None else elements
        voxels = jnp.zeros_like(in_voxels) if voxels is None and in_voxels is not None else voxels
        return _unsweep(self.thin, layout, ordinates, extinction, elements, voxels)


@dataclasses.dataclass(frozen=True)
class _SweepAdjoint:
    thin: bool

    def __call__(self, arguments, wanted, weights: Results):
        layout, ordinates, extinction, exitance, source, inflow = arguments
        if _any(wanted[2]) or _any(None if inflow is None else wanted[5].factor):
            found = _whole_adjoint(self.thin, layout, ordinates, extinction, weights, exitance, source, inflow)
        else:
            entering = inflow if _any(wanted[5]) else None
            found = _adjoint(self.thin, False, layout, ordinates, extinction, weights, exitance, source, entering)
        light: Any = None
        if inflow is not None:
            light = Inflow(found.radiance, None if inflow.factor is None else found.factor)  # pyright: ignore
        # Only what is wanted is read: the geometry stands for itself.
        return layout, ordinates, found.extinction, found.exitance, None if source is None else found.source, light


@dataclasses.dataclass(frozen=True)
class _UnsweepAdjoint:
    thin: bool

    def __call__(self, arguments, wanted, weights: Results):
        layout, ordinates, extinction, at_elements, in_voxels = arguments
        exitance, source = weights
        fluence = in_voxels is not None
        elements, voxels = _sweep(self.thin, fluence, layout, ordinates, extinction, exitance, source, None)
        curve = None
        if _any(wanted[2]):
            asked = (at_elements, in_voxels)
            curve = _whole_adjoint(self.thin, layout, ordinates, extinction, asked, exitance, source, None).extinction
        return layout, ordinates, curve, elements, voxels


def _whole_adjoint(thin: bool, layout: Layout, ordinates, extinction, weights: Results, exitance, source, inflow):
    """Everything's derivative. What is missing is given as nothing, so that all calls share one program: it is a large one."""
    real, bands = exitance.dtype, exitance.shape[0]
    images = len(layout.unfolding.images())
    if inflow is None and not checks.is_traced(ordinates):
        count = 1 + max(int(jnp.max(o.index, initial=0)) for o in ordinates)
        inflow = Inflow(jnp.zeros((images, count, bands), real))
    if inflow is not None and inflow.factor is None:
        inflow = Inflow(inflow.radiance, jnp.ones((bands, layout.elements), real))
    at_elements, in_voxels = weights
    if extinction is not None:
        dark = jnp.zeros((bands, *layout.shape), real)
        source = dark if source is None else source
        in_voxels = dark if in_voxels is None else in_voxels
    return _adjoint(thin, True, layout, ordinates, extinction, (at_elements, in_voxels), exitance, source, inflow)


def _any(wanted: Any) -> bool:
    return any(jax.tree.leaves(wanted))


def _medium(layout: Layout, extinction, source, thin: bool, like: Array) -> SweptMedium | None:
    if extinction is None:
        return None
    dark = jnp.zeros((extinction.shape[0], *layout.shape), like.dtype)
    return SweptMedium(extinction, layout.to_padded(dark if source is None else source), thin)


# Programs of their own: furnaces, bounces and first flights of one shape share them.


@eqx.filter_jit
def _sweep(thin: bool, fluence: bool, layout, ordinates, extinction, exitance, source, inflow) -> Results:
    medium = _medium(layout, extinction, source, thin, exitance)
    return sweep(layout, ordinates, exitance, medium, inflow, fluence)


@eqx.filter_jit
def _unsweep(thin: bool, layout, ordinates, extinction, at_elements, in_voxels) -> Results:
    medium = _medium(layout, extinction, None, thin, at_elements)
    return transposed_sweep(layout, ordinates, at_elements, in_voxels, medium)


@eqx.filter_jit
def _adjoint(thin: bool, whole: bool, layout, ordinates, extinction, weights: Results, exitance, source, inflow):
    medium = _medium(layout, extinction, source, thin, weights[0])
    return adjoint_sweep(layout, ordinates, *weights, exitance if whole else None, medium, inflow)
