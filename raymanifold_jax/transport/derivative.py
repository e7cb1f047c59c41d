"""Sweeps that can be differentiated: by the sources they carry, and by the extinction they cross.

`swept` is `sweep` and `unswept` is its transpose, with fields of the lattice in and out, on one device or over a mesh, under
JAX's transformations: forwards JAX differentiates them itself, backwards `adjoint_sweep` does. With K(s) for a sweep through
the extinction s, the adjoints of (s, x) -> K x and (s, y) -> K'y share the form <y, K x>:

    of K x:   x' = K'y,      s' = d<y, K x>/ds        (y the cotangent)
    of K'y:   y' = K z,      s' = d<y, K z>/ds        (z the cotangent)

x holds the source's slopes too, where there are any: what they depend on is left to their maker (`slopes`). CUT voxels have
none: those given there, and those that K' gives there, mean nothing.

Public: `swept`, `unswept`, `Manner`.
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
from ..partition import Partition
from . import native
from .characteristic import Inflow, SweptMedium
from .cores import sum_over_cores
from .sharded import adjoint_over, sweep_over
from .transpose import Adjoint

Field = Float[Array, "C nx ny nz"]
Slopes = tuple[Float[Array, "C X Y Z"], ...]
Results = tuple[Float[Array, "C E"], Field | None]
Sent = tuple[Float[Array, "C E"], Field | None, Slopes | None]


@dataclasses.dataclass(frozen=True)
class Manner:
    """What a sweep's program is made for; `thin` and `onward` as in `SweptMedium`.

    `fluence`: with sums in the voxels. Without `elements` those at elements mean nothing: nobody asks for them.
    """

    thin: bool
    onward: bool = False
    fluence: bool = True
    elements: bool = True


def swept(
    manner: Manner,
    layout: Layout | Partition,
    ordinates: tuple[Ordinates, ...],
    extinction: Float[Array, "C X Y Z"] | None,
    exitance: Float[Array, "C E"],
    source: Field | None,
    slopes: Slopes | None,
    inflow: Inflow | None,
) -> Results:
    """`sweep`: sums at the elements and, with `fluence`, in the voxels. `source` of None is a dark medium."""
    run = with_adjoint(_Sweep(manner), _SweepAdjoint(manner))
    return run(layout, ordinates, extinction, exitance, source, slopes, inflow)


def unswept(
    manner: Manner,
    layout: Layout | Partition,
    ordinates: tuple[Ordinates, ...],
    extinction: Float[Array, "C X Y Z"] | None,
    at_elements: Float[Array, "C E"],
    in_voxels: Field | None,
    sloped: bool = False,
) -> Sent:
    """The transpose of `swept`: exitance, source and, with `sloped`, its slopes, from weights of the sums."""
    run = with_adjoint(_Unsweep(manner, sloped), _UnsweepAdjoint(manner))
    return run(layout, ordinates, extinction, at_elements, in_voxels)


def _or_zeros(moves: Any, like: Any) -> Any:
    """`moves`, with zeros where nothing moves."""
    return jax.tree.map(lambda a, m: jnp.zeros_like(a) if m is None else m, like, moves)


@dataclasses.dataclass(frozen=True)
class _Sweep:
    manner: Manner

    def __call__(self, *arguments) -> Results:
        return _sweep(self.manner, *arguments)

    def push(self, arguments, moves) -> Results | None:
        """Where only what is carried moves: another sweep, by the same program."""
        layout, ordinates, extinction, *carried, inflow = arguments
        _, _, crossed, *moved, light = moves
        if crossed is not None or (light is not None and light.factor is not None):
            return None
        entering = None if light is None or light.radiance is None else Inflow(light.radiance, inflow.factor)
        exitance, source, slopes = _or_zeros(moved, carried)
        return _sweep(self.manner, layout, ordinates, extinction, exitance, source, slopes, entering)


@dataclasses.dataclass(frozen=True)
class _Unsweep:
    manner: Manner
    sloped: bool

    def __call__(self, *arguments) -> Sent:
        return _unsweep(self.manner, self.sloped, *arguments)

    def push(self, arguments, moves) -> Sent | None:
        layout, ordinates, extinction, *asked = arguments
        _, _, crossed, *moved = moves
        if crossed is not None:
            return None
        return _unsweep(self.manner, self.sloped, layout, ordinates, extinction, *_or_zeros(moved, asked))


@dataclasses.dataclass(frozen=True)
class _SweepAdjoint:
    manner: Manner

    def __call__(self, arguments, wanted, weights: Results):
        layout, ordinates, extinction, *sent, inflow = arguments
        if _any(wanted[2]) or _any(None if inflow is None else wanted[-1].factor):
            found = _whole_adjoint(self.manner, layout, ordinates, extinction, weights, tuple(sent), inflow)
        else:
            entering = inflow if _any(wanted[-1]) else None
            found = _adjoint(self.manner, False, layout, ordinates, extinction, weights, tuple(sent), entering)
        light: Any = None
        if inflow is not None:
            light = Inflow(found.radiance, None if inflow.factor is None else found.factor)  # pyright: ignore
        # Only what is wanted is read: the geometry stands for itself.
        source, slopes = (None if s is None else f for s, f in zip(sent[1:], (found.source, found.slopes), strict=True))
        return layout, ordinates, found.extinction, found.exitance, source, slopes, light


@dataclasses.dataclass(frozen=True)
class _UnsweepAdjoint:
    manner: Manner

    def __call__(self, arguments, wanted, weights: Sent):
        layout, ordinates, extinction, *asked = arguments
        manner = dataclasses.replace(self.manner, fluence=asked[1] is not None)
        elements, voxels = _sweep(manner, layout, ordinates, extinction, *weights, None)
        curve = None
        if _any(wanted[2]):
            curve = _whole_adjoint(manner, layout, ordinates, extinction, tuple(asked), weights, None).extinction
        return layout, ordinates, curve, elements, voxels


def _whole_adjoint(manner: Manner, layout: Layout | Partition, ordinates, extinction, weights: Results, sent: Sent, inflow):
    """Everything's derivative. What is missing is given as nothing, so that all calls share one program: it is a large one."""
    exitance, source, slopes = sent
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
        if slopes is None and manner.onward:  # thick: bounces have them
            slopes = (jnp.zeros_like(extinction),) * 3
    return _adjoint(manner, True, layout, ordinates, extinction, (at_elements, in_voxels), (exitance, source, slopes), inflow)


def _any(wanted: Any) -> bool:
    return any(jax.tree.leaves(wanted))


def _medium(manner: Manner, layout: Layout | Partition, extinction, source, slopes, like: Array) -> SweptMedium | None:
    if extinction is None:
        return None
    dark = jnp.zeros((extinction.shape[0], *layout.shape), like.dtype)
    source = layout.to_padded(dark if source is None else source)
    return SweptMedium(extinction, source, manner.thin, slopes, manner.onward)


def _sweep(manner: Manner, *arguments) -> Results:
    if native.serves(arguments[0], arguments[1], arguments[2:]):
        return native.sweep(manner, *arguments)
    return sum_over_cores(_sweep_program, (manner,), *arguments)


def _unsweep(manner: Manner, sloped: bool, *arguments) -> Sent:
    layout, ordinates, *asked = arguments
    if native.serves(layout, ordinates, asked):
        return native.unsweep(manner, *arguments, sloped=sloped)
    return sum_over_cores(_unsweep_program, (manner, sloped), *arguments)


def _adjoint(manner: Manner, whole: bool, layout, ordinates, extinction, weights: Results, sent: Sent, inflow) -> Adjoint:
    arguments = layout, ordinates, extinction, weights, sent, inflow
    if not whole and inflow is None and native.serves(layout, ordinates, arguments[2:]):
        found = native.unsweep(manner, layout, ordinates, extinction, *weights, sent[2] is not None)
        return Adjoint(*found, None, None, None)
    return sum_over_cores(_adjoint_program, (manner, whole), *arguments)


# Programs of their own: furnaces, bounces and first flights of one shape share them.


@eqx.filter_jit
def _sweep_program(manner: Manner, layout, ordinates, extinction, exitance, source, slopes, inflow) -> Results:
    medium = _medium(manner, layout, extinction, source, slopes, exitance)
    return sweep_over(layout, ordinates, exitance, medium, inflow, manner.fluence)


@eqx.filter_jit
def _unsweep_program(manner: Manner, sloped: bool, layout, ordinates, extinction, at_elements, in_voxels) -> Sent:
    dark = jnp.zeros((at_elements.shape[0], *layout.padded), at_elements.dtype)
    medium = _medium(manner, layout, extinction, None, (dark,) * 3 if sloped else None, at_elements)
    found = adjoint_over(layout, ordinates, at_elements, in_voxels, None, medium)
    return found.exitance, found.source, found.slopes


@eqx.filter_jit
def _adjoint_program(manner: Manner, whole: bool, layout, ordinates, extinction, weights: Results, sent: Sent, inflow):
    exitance, source, slopes = sent
    medium = _medium(manner, layout, extinction, source, slopes, weights[0])
    return adjoint_over(layout, ordinates, *weights, exitance if whole else None, medium, inflow)
