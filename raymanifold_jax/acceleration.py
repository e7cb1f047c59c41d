"""Diffusion as a preconditioner: what light does over many bounces, without a sweep.

Where light bounces hundreds of times it spreads as heat does. With J the mean radiance in a voxel, g = 4 pi extinction V the
power it takes up for J = 1, R its scattering albedo, and f the light that leaves it,

    g (1 - R) J + sum over neighbours k (J - J') = g f,        k = 4 pi h^2 (1 / (3 h / l) + 1/4),

with l the mean free path. The first term of k is the diffusion of radiance; the second is what the sweep itself does in thick
voxels that radiate with one source each (the solve would not converge otherwise). Where sources have slopes (see
`transport.slopes`), light passes between voxels by their third differences instead: with L the sum of differences to
neighbours, 4 pi h^2 L / (3 h / l) becomes that times (1 + 3 h / (16 l) L), and solving takes a second step, (1 + ...)^-1.
Both together are what the sweep does to waves of any length. Surfaces hang on their
probe voxels by Marshak's condition, 2 pi A (J - B), and end free paths too (the Knudsen regime of gases), so that the same
equation serves in vacuum. It is symmetric, with seven points, and solved by conjugate gradients and multigrid, at a few
percent of a sweep's time. With A that matrix,

    (I - K)^-1 = I + (I - K)^-1 K   is nearly   M = I + R A^-1 g,

and GMRES on (I - K) M needs about as many sweeps for albedo 0.9999 as for 0.9, in thin media as in thick ones (diffusion
synthetic acceleration as a preconditioner: Warsa, Wareing & Morel, Nucl. Sci. Eng. 147, 2004).

Public: `Diffusion`, `make_diffusion`.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Int

from .arrays import as_jax
from .layout import Layout
from .operator import Light, Materials, Transport
from .placement import known
from .programs import program
from .surfaces import Surfaces
from .transport.slopes import flattening

_FREE_PATH = 4.0  # times the distance to the nearest surface, where nothing else ends a path
_ENOUGH = 0.05  # of the residual may be left: GMRES corrects the rest
_MOST = 30  # steps of conjugate gradients
_WHOLE = 1 - 1e-4  # free share of a voxel that no surface cuts: a sum, which rounding may leave below 1
_DAMPING = 0.8  # of Jacobi's smoothing
_SMOOTHINGS = 2  # before and after a coarser level


Axes: TypeAlias = tuple[bool, bool, bool]


class _Level(NamedTuple):
    """A seven-point matrix: conductance from each voxel to the next along each axis (the last: to the first), and the rest."""

    links: tuple[Array, Array, Array]  # [C, nx, ny, nz] each
    loss: Array  # what a voxel absorbs, for J = 1
    smoothing: Array  # the damping over the diagonal


def _level(links: list[Array], loss: Array) -> _Level:
    diagonal = sum((link + jnp.roll(link, 1, axis) for axis, link in enumerate(links, start=1)), start=loss)
    return _Level((links[0], links[1], links[2]), loss, _DAMPING / diagonal)


class _Matrix(eqx.Module):
    """A level made ready to be applied many times: XLA works with parts of one array four times as fast as with moved ones."""

    links: tuple[Array, Array, Array]  # to each voxel from the one before, and one more
    loss: Array
    smoothing: Array
    periodic: Axes = eqx.field(static=True)

    @classmethod
    def of(cls, level: _Level, periodic: Axes) -> _Matrix:
        links = (
            _extended(link, periodic, tuple((int(a == axis), 0) for a in range(3))) for axis, link in enumerate(level.links)
        )
        x, y, z = lax.optimization_barrier(tuple(links))
        return cls((x, y, z), level.loss, level.smoothing, periodic)

    def apply(self, field: Array) -> Array:
        around, shape = _extended(field, self.periodic, ((1, 1),) * 3), field.shape[1:]
        total = self.loss * field
        for axis, link in enumerate(self.links):
            for step in (0, 1):
                here = lax.slice_in_dim(link, step, step + shape[axis], axis=1 + axis)
                begin = [1 + (2 * step - 1) * (a == axis) for a in range(3)]
                beside = around[:, *(slice(at, at + n) for at, n in zip(begin, shape, strict=True))]
                total = total + here * (field - beside)
        return total


def _extended(field: Array, periodic: Axes, widths: tuple[tuple[int, int], ...]) -> Array:
    """With so many voxels more before and behind: along periodic axes what follows there, else 0."""
    for axes, mode in ((periodic, "wrap"), ([not p for p in periodic], "constant")):
        wanted = [(0, 0), *(width if chosen else (0, 0) for width, chosen in zip(widths, axes, strict=True))]
        if any(sum(width) for width in wanted):
            field = jnp.pad(field, wanted, mode=mode)
    return field


class _Second(NamedTuple):
    """The second step, where sources have slopes."""

    levels: tuple[_Level | _Matrix, ...]
    kept: Float[Array, "C nx ny nz"]  # weight of what a voxel has from the first
    bend: Float[Array, "C E"]  # conductance to the elements


class Diffusion(eqx.Module):
    """M of the module's docstring, for one scene and its albedos."""

    levels: tuple[_Level | _Matrix, ...]
    second: _Second | None
    power: Light  # g
    albedo: Light  # R
    probe: Int[Array, " E"]  # the voxel each element hangs on, flat
    coupling: Float[Array, "C E"]  # k
    periodic: Axes = eqx.field(static=True)

    def __call__(self, leaving: Light) -> Light:
        """M applied to what leaves: about the solution of (I - K) x = leaving."""
        return _precondition(self, leaving)

    def of_arriving(self, light: Light) -> Light:
        """The same where bounces take arriving light to arriving light: I + A^-1 g R."""
        return _of_arriving(self, light)

    def of_arriving_transposed(self, light: Light) -> Light:
        """Its transpose: I + R g A^-1, both steps in turn."""
        return _of_arriving_transposed(self, light)


@program
def _precondition(near: Diffusion, leaving: Light) -> Light:
    weighted = jax.tree.map(jnp.multiply, near.power, leaving)
    return leaving + jax.tree.map(jnp.multiply, near.albedo, _spread(near, weighted))


@program
def _of_arriving(near: Diffusion, light: Light) -> Light:
    return light + _spread(near, jax.tree.map(lambda g, r, x: g * r * x, near.power, near.albedo, light))


@program
def _of_arriving_transposed(near: Diffusion, light: Light) -> Light:
    spread = _spread_transposed(near, light)
    return light + jax.tree.map(lambda g, r, x: g * r * x, near.power, near.albedo, spread)


def _spread(near: Diffusion, sent: Light) -> Light:
    """A^-1 applied to powers: elements are eliminated, the voxels solved for."""
    whole, passed = _elimination(near)
    into = _gathered(near, passed * sent.elements)
    voxels = _conjugate_gradients(near, near.levels, into if sent.voxels is None else into + sent.voxels)
    elements = (sent.elements + near.coupling * _above(near, voxels)) / whole
    if near.second is not None:
        beside = _gathered(near, near.second.bend * near.albedo.elements * elements)
        voxels = _conjugate_gradients(near, near.second.levels, near.second.kept * voxels + beside)
    return Light(elements, None if sent.voxels is None else voxels)


def _spread_transposed(near: Diffusion, asked: Light) -> Light:
    """The transpose of `_spread`."""
    whole, passed = _elimination(near)
    elements = asked.elements
    voxels = jnp.zeros_like(near.levels[0].loss) if asked.voxels is None else asked.voxels
    if near.second is not None:
        smooth = _conjugate_gradients(near, near.second.levels, voxels)
        voxels = near.second.kept * smooth
        elements = elements + near.second.bend * near.albedo.elements * _above(near, smooth)
    elements = elements / whole
    voxels = _conjugate_gradients(near, near.levels, voxels + _gathered(near, near.coupling * elements))
    return Light(elements + passed * _above(near, voxels), None if asked.voxels is None else voxels)


def _elimination(near: Diffusion) -> tuple[Array, Array]:
    albedo, power = near.albedo.elements, near.power.elements
    whole = power * (1 - albedo) + near.coupling * albedo
    return whole, near.coupling * albedo / whole


def _above(near: Diffusion, voxels: Array) -> Array:
    """Values of voxels at the elements that hang on them."""
    return voxels[:, *_where(near.probe, voxels.shape)]


def _gathered(near: Diffusion, elements: Array) -> Array:
    """In each voxel the sum over the elements that hang on it."""
    shape = near.levels[0].loss.shape
    return jnp.zeros(shape, elements.dtype).at[:, *_where(near.probe, shape)].add(elements)


def _where(probe: Int[Array, " E"], shape: tuple[int, ...]) -> tuple[Array, ...]:
    # By three indices: on a mesh, flat fields would have to be gathered from their blocks.
    return jnp.unravel_index(probe, shape[1:])


def _conjugate_gradients(near: Diffusion, levels: tuple[_Level | _Matrix, ...], right: Array) -> Array:
    matrices = tuple(level if isinstance(level, _Matrix) else _Matrix.of(level, near.periodic) for level in levels)
    dot = lambda a, b: jnp.sum(a * b, axis=(1, 2, 3), keepdims=True)
    ratio = lambda a, b: jnp.where(b > 0, a / jnp.where(b > 0, b, 1.0), 0.0)

    def step(state):
        count, field, residual, direction, length = state
        image = matrices[0].apply(direction)
        move = ratio(length, dot(direction, image))
        field, residual = field + move * direction, residual - move * image
        better = _cycle(matrices, residual)
        new = dot(residual, better)
        return count + 1, field, residual, better + ratio(new, length) * direction, new

    first = _cycle(matrices, right)
    begun = dot(right, first)
    going = lambda state: (state[0] < _MOST) & jnp.any(state[4] > _ENOUGH**2 * begun)
    return lax.while_loop(going, step, (0, jnp.zeros_like(right), right, first, begun))[1]


def _cycle(matrices: tuple[_Matrix, ...], right: Array) -> Array:
    """One V-cycle: smoothing, the same on a lattice of half the size, smoothing. Symmetric."""
    matrix, coarser = matrices[0], matrices[1:]

    # In loops, because XLA otherwise works a step out again for each of the points that the next step reads.
    def smooth_and_look(number, state):
        field, _ = state
        left = right - matrix.apply(field)
        return jnp.where(number < _SMOOTHINGS - 1, field + matrix.smoothing * left, field), left

    # The first smoothing is from 0; the last turn only finds what is left.
    field, left = lax.fori_loop(0, _SMOOTHINGS, smooth_and_look, (matrix.smoothing * right, right))
    if coarser:
        field = field + _refine(_cycle(coarser, _coarsen(left)), right.shape)
    smooth = lambda _, field: field + matrix.smoothing * (right - matrix.apply(field))
    return lax.fori_loop(0, _SMOOTHINGS, smooth, field)


def _pairs(field: Array, axis: int) -> Array:
    """Sums of neighbours two by two along an axis; one that is left over stays as it is."""
    size = field.shape[axis]
    if size % 2:
        field = jnp.pad(field, [(0, int(a == axis)) for a in range(field.ndim)])
    return field.reshape(*field.shape[:axis], (size + 1) // 2, 2, *field.shape[axis + 1 :]).sum(axis + 1)


def _coarsen(field: Array) -> Array:
    """Sums of eight neighbours."""
    bands, *size = field.shape
    field = jnp.pad(field, [(0, 0), *((0, n % 2) for n in size)])
    halves = [m for n in size for m in (-(-n // 2), 2)]
    return field.reshape(bands, *halves).sum((2, 4, 6))


def _refine(field: Array, shape: tuple[int, ...]) -> Array:
    """The transpose of `_coarsen`."""
    bands, *size = field.shape
    doubled = [m for n in size for m in (n, 2)]
    spread = jnp.broadcast_to(field.reshape(bands, *(m for n in size for m in (n, 1))), (bands, *doubled))
    return spread.reshape(bands, *(2 * n for n in size))[tuple(slice(n) for n in shape)]


def _coarse_level(level: _Level) -> _Level:
    links = []
    for axis, link in enumerate(level.links, start=1):
        size = link.shape[axis]
        last = lax.slice_in_dim(link, size - 1, size, axis=axis)
        outer = lax.slice_in_dim(link, 1, size, stride=2, axis=axis)
        link = jnp.concatenate([outer, last], axis) if size % 2 else outer
        for other in {1, 2, 3} - {axis}:
            link = _pairs(link, other)
        links.append(link / 2)  # twice as far
    return _level(links, _coarsen(level.loss))


def make_diffusion(transport: Transport, surfaces: Surfaces, stuff: Materials) -> Diffusion:
    """The preconditioner of a scene on its lattice."""
    layout = transport.layout
    weights = sum(known(o.weight).sum() for o in transport.ordinates) * len(layout.unfolding.images())
    free = np.clip(known(transport.coverage) / weights, 0.0, 1.0)
    ends = _distance(free == 0, surfaces, layout.shape)
    periodic = [a for a in range(3) if layout.pad[a] == 0 and a not in layout.unfolding.axes]
    shape = surfaces.solid.shape  # on a mesh, the layout's may have empty columns behind
    probe = np.where([a in periodic for a in range(3)], surfaces.probe % shape, surfaces.probe)
    probe = np.clip(probe, 0, np.array(shape) - 1)
    flat = np.asarray(np.ravel_multi_index(tuple(probe.T), layout.shape)) if len(probe) else np.zeros(0, int)
    place = as_jax if isinstance(layout, Layout) else layout.place
    area = surfaces.area / layout.spacing**2  # powers are in units of a voxel's face
    return _assemble(
        stuff, place(free), place(1 / (_FREE_PATH * ends)), as_jax(area), as_jax(flat, np.int32),
        layout.spacing, (0 in periodic, 1 in periodic, 2 in periodic), transport.albedo is not None, isinstance(layout, Layout),
    )  # fmt: skip


def _distance(solid: np.ndarray, surfaces: Surfaces, shape: tuple[int, int, int]) -> np.ndarray:
    """From each voxel to the nearest surface, in voxels, along the axes (at least 1/2)."""
    distance = np.where(solid, 0.0, float(sum(shape)))
    distance[tuple(np.clip(surfaces.probe, 0, np.array(shape) - 1).T)] = 0.5
    for axis in range(3):
        steps = np.arange(shape[axis]).reshape([-1 if a == axis else 1 for a in range(3)])
        for flipped in (False, True):
            turned = np.flip(distance, axis) if flipped else distance
            turned = np.minimum.accumulate(turned - steps, axis) + steps
            distance = np.flip(turned, axis) if flipped else turned
    return np.maximum(distance, 0.5)


@program
def _assemble(
    stuff: Materials, free, ends, area, probe, spacing: float, periodic: Axes, sloped: bool, one_device: bool
) -> Diffusion:
    real, bands = stuff.albedo.dtype, stuff.albedo.shape[0]
    free, ends, area = (x.astype(real) for x in (free, ends, area))
    extinction = 0.0 if stuff.extinction is None else stuff.extinction * spacing
    depth = jnp.broadcast_to(extinction, (bands, *free.shape)).astype(real)
    power = 4 * jnp.pi * depth * free
    scattering = jnp.zeros_like(depth) if stuff.scattering_albedo is None else stuff.scattering_albedo
    total = depth + ends
    straight = jnp.zeros_like(depth)
    if sloped:
        straight = jnp.where((scattering > 0) & (free > _WHOLE), flattening(depth, scattering), 0.0)
    links, bends = [], []
    for axis in (1, 2, 3):
        next_to = lambda field, axis=axis: jnp.roll(field, -1, axis)
        size = depth.shape[axis]
        inside = jnp.arange(size).reshape([-1 if a == axis else 1 for a in range(4)]) < size - (not periodic[axis - 1])
        open_part = jnp.where(inside, jnp.minimum(free, jnp.roll(free, -1, axis - 1)), 0.0)
        bend = jnp.minimum(straight, next_to(straight))
        links.append(4 * jnp.pi * open_part * (2 / (3 * (total + next_to(total))) + (1 - bend) / 4))
        bends.append(open_part * bend)
    of_elements = jnp.broadcast_to(jnp.pi * area, stuff.albedo.shape)
    at_probe = _where(probe, depth.shape)
    deep, bend = depth[:, *at_probe], straight[:, *at_probe]
    coupling = 2 * of_elements / (1 + jnp.minimum(deep, 1.0))
    beside = 2 / jnp.pi * of_elements * bend  # half as far as to the next voxel
    taken = coupling * of_elements * (1 - stuff.albedo) / (of_elements * (1 - stuff.albedo) + coupling * stuff.albedo)
    loss = (power * (1 - scattering)).at[:, *at_probe].add(taken)
    # Nothing happens in voxels inside solids; and a matrix that nearly is singular must not be.
    links_of = sum((link + jnp.roll(link, 1, axis) for axis, link in enumerate(links, start=1)), start=jnp.zeros_like(loss))
    loss = jnp.where(links_of + loss > 0, loss + 8 * jnp.finfo(real).eps * links_of, 1.0)
    # One plane more does not part evenly into the blocks of a mesh: there it is added each time.
    ready = lambda levels: tuple(_Matrix.of(level, periodic) for level in levels) if one_device else levels
    second = None
    if sloped:
        kept = 16 * (1 / (3 * total) + (1 - straight) / 4)
        second = _Second(ready(_levels(bends, kept.at[:, *at_probe].add(beside))), kept, beside)
    voxels = None if stuff.scattering_albedo is None else power
    powers, albedos = Light(of_elements, voxels), Light(stuff.albedo, stuff.scattering_albedo)
    return Diffusion(ready(_levels(links, loss)), second, powers, albedos, probe, coupling, periodic)


def _levels(links: list[Array], loss: Array) -> tuple[_Level, ...]:
    """The matrix on the lattice, and on coarser ones down to two voxels."""
    levels = [_level(links, loss)]
    while max(levels[-1].loss.shape[1:]) > 2:
        levels.append(_coarse_level(levels[-1]))
    return tuple(levels)
