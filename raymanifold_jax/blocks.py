"""How an axis of the lattice is split over a mesh axis, and how its columns move between two such splits.

An axis of n columns is split in p blocks of the same size, one a device. Sizes that do not divide leave slots of a block empty
(-1 in the tables here); which ones is a matter of the split:

- `even`: every block has n / p columns, or one more, at its beginning. Every block holds some, so that blocks in a row make a
  ring without gaps.
- `full`: blocks are full but for the last ones, so that the columns lie in order with the empty slots behind them.

Public: `even`, `full`, `positions`, `Moves`, `make_moves`, `take`, `unfolded`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Int


def even(count: int, parts: int, least: int = 1) -> Int[np.ndarray, "p s"]:
    """The columns of each block, at least `least` slots a block."""
    sizes = [count // parts + (part < count % parts) for part in range(parts)]
    table = np.full((parts, max(*sizes, least)), -1)
    for part, (first, size) in enumerate(zip(np.cumsum([0, *sizes[:-1]]), sizes, strict=True)):
        table[part, :size] = first + np.arange(size)
    return table


def full(count: int, parts: int) -> Int[np.ndarray, "p s"]:
    size = -(-count // parts)
    table = np.arange(parts * size).reshape(parts, size)
    return np.where(table < count, table, -1)


def positions(table: Int[np.ndarray, "p s"]) -> Int[np.ndarray, " n"]:
    """Where each column lies in all blocks' slots, one after the other."""
    flat = table.ravel()
    slots = np.flatnonzero(flat >= 0)
    return slots[np.argsort(flat[slots])]


def unfolded(count: int, mirrored: tuple[bool, ...], pad: int) -> Int[np.ndarray, " N"]:
    """The column of the scene that each column of the padded, unfolded lattice is an image of; -1 for ghosts."""
    images = [np.arange(count)[::-1] if turned else np.arange(count) for turned in mirrored]
    return np.pad(np.concatenate(images), pad, constant_values=-1)


def take(field: Array, dim: int, index: Int[np.ndarray, " m"] | Int[Array, " m"]) -> Array:
    """Slices of a field along a dimension; 0 where the index is -1."""
    size = field.shape[dim]
    index = jnp.where(jnp.asarray(index) < 0, size, jnp.asarray(index))
    return jnp.take(field, index, axis=dim, mode="fill", fill_value=0, unique_indices=False)


class _Round(NamedTuple):
    """Devices that send to one other each, and what."""

    pairs: list[tuple[int, int]]
    send: Int[np.ndarray, "p m"]


class Moves(NamedTuple):
    """Columns from one split of an axis to another, as few as have to change devices; within `shard_map`."""

    name: str
    rounds: list[_Round]
    index: Int[np.ndarray, "p s"]  # into own columns, then what each round brings

    def __call__(self, field: Array, dim: int) -> Array:
        here = lax.axis_index(self.name)
        parts = [field]
        for pairs, send in self.rounds:
            parts.append(lax.ppermute(take(field, dim, jnp.asarray(send)[here]), self.name, pairs))
        return take(jnp.concatenate(parts, dim) if len(parts) > 1 else field, dim, jnp.asarray(self.index)[here])


def make_moves(name: str, source: Int[np.ndarray, "p s"], wanted: Int[np.ndarray, "p t"]) -> Moves:
    """From the blocks `source` of an axis over the mesh axis `name` to blocks of the columns `wanted`, repeated or not."""
    parts, size = source.shape
    where = positions(source)
    needs: dict[tuple[int, int], list[int]] = {}
    for to, columns in enumerate(wanted):
        for column in sorted(set(columns[columns >= 0].tolist())):
            needs.setdefault((int(where[column]) // size, to), []).append(column)
    found = [{int(c): slot for slot, c in enumerate(row) if c >= 0} for row in source]  # where a device has each column
    left = sorted((pair for pair in needs if pair[0] != pair[1]), key=lambda pair: -len(needs[pair]))
    rounds, begin = [], size
    while left:
        pairs: list[tuple[int, int]] = []
        for pair in left:
            if all(pair[0] != sender and pair[1] != receiver for sender, receiver in pairs):
                pairs.append(pair)
        left = [pair for pair in left if pair not in pairs]
        most = max(len(needs[pair]) for pair in pairs)
        send = np.full((parts, most), -1)
        for sender, receiver in pairs:
            columns = needs[sender, receiver]
            send[sender, : len(columns)] = where[columns] % size
            found[receiver] |= {column: begin + k for k, column in enumerate(columns)}
        rounds.append(_Round(pairs, send))
        begin += most
    index = np.array([[found[to].get(int(c), -1) for c in row] for to, row in enumerate(wanted)])
    return Moves(name, rounds, index)
