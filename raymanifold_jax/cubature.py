"""Means over directions of what points see, with more rays where it changes by steps.

The directions around a normal, by the cosine, or the two halves of the sphere, are each mapped on a square, equal shares to
equal areas, and the square is cut into cells with a ray in each. Where a cell's radiance does not go on from its neighbours'
on both sides, a step of it is taken to cross the cell, somewhere: a cell of share w and a step D leave an error of variance
(w D)^2 / 12. The worst cells are cut in 4 x 4, twice, until what is left to the mean is small. An edge across a whole view,
which n even rays find to about n^(-3/4), takes n^(-3/2) for the finest cells' n then.

Public: `mean_of_rays`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from . import checks
from .directions import frames

_SIDE = 32  # cells of a square, along a side
_CUT = 4
_RIM = 3  # cells around a square that are looked at as well
_WAYS = ((1, 0), (0, 1), (1, 1), (1, -1))
#: Cells of a point to be cut at once, at most, and how often; then again for the smaller ones.
_CUTS = ((512, 3), (1024, 1))
_GOLDEN = (np.sqrt(5) - 1) / 2

#: See(point numbers (m,), directions (m, 3)) -> radiance (m, C)
See = Callable[[Int[np.ndarray, " m"], Float[np.ndarray, "m 3"]], Float[Array, "m C"]]


class _Cells(NamedTuple):
    """Squares of cells of one size, each square of one point."""

    map: Int[np.ndarray, " s"]  # which whole square that directions are mapped on: each point has one, or one for each half
    column: Int[np.ndarray, "s k k"]  # counted through the whole square
    row: Int[np.ndarray, "s k k"]
    number: int  # cells of this size in that square, along a side

    def cut(self, which: tuple[np.ndarray, ...]) -> _Cells:
        """Some of the cells, each a square of smaller ones."""
        fine = np.arange(_CUT)
        column = _CUT * self.column[which][:, None, None] + fine[:, None]
        row = _CUT * self.row[which][:, None, None] + fine
        column, row = np.broadcast_arrays(column, row)
        return _Cells(self.map[which[0]], column, row, _CUT * self.number)

    @staticmethod
    def joined(parts: list[_Cells]) -> _Cells:
        """Squares of cells of one size."""
        maps, columns, rows = (np.concatenate(arrays) for arrays in zip(*(p[:3] for p in parts), strict=True))
        return _Cells(maps, columns, rows, parts[0].number)

    def windows(self, maps: np.ndarray) -> np.ndarray:
        """Each square of cells of some maps, with a rim of those around it."""
        reach = np.arange(-_RIM, self.row.shape[1] + _RIM)
        at = lambda first: np.clip(first[:, None] + reach, 0, self.number - 1)
        columns, rows = at(self.column[:, 0, 0]), at(self.row[:, 0, 0])
        return maps[self.map[:, None, None], columns[:, :, None], rows[:, None]]

    def directions(self, normals: Float[np.ndarray, "n 3"] | None) -> Float[np.ndarray, "s k k 3"]:
        # Not all in the middles of their cells, but evenly through them: no edge along rows is met by all of them at once.
        within = (_GOLDEN * (np.arange(self.number) + 0.5)) % 1
        within += 0.5 - within.mean()
        shifted = lambda here, other: (here + within[other]) / self.number
        disc = _square_to_disc(
            *(np.clip(2 * shifted(*at) - 1, -1, 1) for at in ((self.column, self.row), (self.row, self.column)))
        )
        squared = np.minimum((disc**2).sum(-1, keepdims=True), 1.0)
        if normals is not None:
            lifted = np.concatenate([disc, np.sqrt(1 - squared)], -1)
            return np.einsum("sabj,sji->sabi", lifted, frames(normals)[self.map])
        upwards = np.where(self.map % 2 == 0, 1.0, -1.0)[:, None, None, None]
        return np.concatenate([disc * np.sqrt(2 - squared), upwards * (1 - squared)], -1)


def _square_to_disc(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Squares around the origin to circles, equal areas to equal areas (Shirley & Chiu, J. Graphics Tools 2(3), 1997)."""
    wide = np.abs(x) > np.abs(y)
    radius, other = np.where(wide, x, y), np.where(wide, y, x)
    angle = np.pi / 4 * other / np.where(radius == 0, 1.0, radius)
    near, far = radius * np.cos(angle), radius * np.sin(angle)
    return np.stack([np.where(wide, near, far), np.where(wide, far, near)], -1)


def mean_of_rays(see: See, count: int, normals: Float[np.ndarray, "n 3"] | None, tolerance: float) -> Float[Array, "n C"]:
    """The mean radiance that `count` points see, weighted by the cosine where there are normals.

    Cells are cut until the standard error is `tolerance` of the mean, or many are; never while JAX stages a program.
    """
    halves = 1 if normals is not None else 2
    grid = np.broadcast_to(np.arange(_SIDE), (count * halves, _SIDE, _SIDE))
    cells = _Cells(np.arange(count * halves), grid.swapaxes(1, 2), grid, _SIDE)
    seen, share, mean = _look(see, cells, normals)
    total = jnp.zeros((count, seen.shape[-1]), seen.dtype).at[cells.map // halves].add(mean)
    if checks.is_traced(jax.lax.stop_gradient(seen)):
        return total
    maps, scale = _known(seen), _known(total)
    for most, rounds in _CUTS:
        point, whole, parts = cells.map // halves, np.ones(cells.row.shape, bool), []
        for _ in range(rounds):
            steps = whole * _steps(cells.windows(maps), scale[point])
            which = _worst((share * steps) ** 2 / 12, point, tolerance**2 / 2, most)
            if not len(which[0]):
                break
            finer = cells.cut(which)
            inside, finer_share, mean = _look(see, finer, normals)
            total = total.at[finer.map // halves].add(mean - share * seen[which])
            parts.append((finer, inside))
            whole[which] = False
            # What is found in a cell tells of steps to those beside it.
            maps[cells.map[which[0]], cells.column[which], cells.row[which]] = _known(inside).mean((1, 2))
        if not parts:
            break
        cells, seen, share = _Cells.joined([p[0] for p in parts]), jnp.concatenate([p[1] for p in parts]), finer_share
        maps = maps.repeat(_CUT, 1).repeat(_CUT, 2)
        maps[cells.map[:, None, None], cells.column, cells.row] = _known(seen)
    return total


def _known(values: Array) -> np.ndarray:
    return np.array(jax.lax.stop_gradient(values))


def _look(see: See, cells: _Cells, normals: Float[np.ndarray, "n 3"] | None) -> tuple[Array, float, Array]:
    """The radiance of cells (s, k, k, C), the share of each in its point's mean, and what each square adds to that (s, C)."""
    size, halves = cells.row.shape, 1 if normals is not None else 2
    share = 1 / (halves * cells.number**2)
    directions = cells.directions(normals).reshape(-1, 3)
    seen = see(np.repeat(cells.map // halves, size[1] * size[2]), directions).reshape(*size, -1)
    return seen, share, share * seen.sum((1, 2))


def _steps(wide: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """How far each cell's radiance is from going on evenly between its neighbours', any way, in the band worst off.

    Of a step between two cells, all of it in both; nothing of an even slope, nor where two such meet. `wide` has a rim.
    """
    wide = wide / np.where(scale > 0, scale, np.inf)[:, None, None]
    size = wide.shape[1] - 2 * _RIM + 2  # with one cell of the rim
    steps = np.zeros(())
    for i, j in _WAYS:
        at = lambda k, i=i, j=j: wide[:, 2 + k * i : 2 + k * i + size, 2 + k * j : 2 + k * j + size]
        rises = [at(k + 1) - at(k) for k in (-2, -1, 0, 1)]
        bends = [np.abs(after - before) for before, after in itertools.pairwise(rises)]
        steps = np.maximum(steps, np.minimum(bends[1], np.maximum(bends[0], bends[2])))
    steps = steps.max(-1)
    # Cells beside a step's are cut as well: were it left to what each happened to see, means would be biased.
    at = lambda i, j: steps[:, 1 + i : size - 1 + i, 1 + j : size - 1 + j]
    beside = np.max([at(i, j) for way in _WAYS for i, j in (way, (-way[0], -way[1]))], axis=0)
    return np.maximum(at(0, 0), beside)


def _worst(variance: np.ndarray, point: np.ndarray, allowed: float, most: int) -> tuple[np.ndarray, ...]:
    """The cells, `most` of each point at most, without which each point's others add up to no more than is `allowed`."""
    values = variance.ravel()
    owner = np.repeat(point, variance.shape[1] * variance.shape[2])
    order = np.lexsort((values, owner))
    owner, total = owner[order], np.cumsum(values[order])
    first = np.searchsorted(owner, owner)
    last = np.searchsorted(owner, owner, side="right")
    left = total - np.where(first > 0, total[np.maximum(first - 1, 0)], 0.0)
    chosen = (left > allowed) & (np.arange(len(owner)) >= last - most)
    return np.unravel_index(np.sort(order[chosen]), variance.shape)
