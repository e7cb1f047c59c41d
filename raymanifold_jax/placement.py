"""Between one device and a mesh: where the arrays of a solve lie.

A solve on a mesh prepares geometry and materials on one device (the default one of each process), keeps what it iterates on in
the mesh's blocks (`partition`), and hands its solution back on one device. Both ways are linear, each the other's transpose, so
gradients go through.

Values of surface elements, (C, E), lie on all devices; those of the light-ray-cube scheme's SURFACE nodes, which are many, in
blocks too.

Public: `stored`, `restored`, `known`, `check_agreement`.
"""

from __future__ import annotations

import dataclasses
import hashlib
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh
from jax.sharding import PartitionSpec as Spec
from jaxtyping import Array

from . import checks
from .adjoint import linear
from .layout import Layout
from .partition import Partition, put
from .sharding import NAMES
from .transport.ray_layout import RayLattice
from .transport.ray_partition import LIST, NodeLists, RayPartition

Tree = TypeVar("Tree")


def stored(layout: Layout | Partition | RayLattice | RayPartition, tree: Tree) -> Tree:
    """Arrays of one device as the layout wants them: values of elements or nodes (C, E), fields of the scene in blocks.

    Without a mesh, everything as it is.
    """
    if isinstance(layout, Layout | RayLattice):
        return tree
    return jax.tree.map(lambda a: _moved(layout, a, True), tree)


def restored(layout: Layout | Partition | RayLattice | RayPartition, tree: Tree) -> Tree:
    """The inverse of `stored`."""
    if isinstance(layout, Layout | RayLattice):
        return tree
    return jax.tree.map(lambda a: _moved(layout, a, False), tree)


def known(array: Array) -> np.ndarray:
    """All numbers of an array, wherever they lie."""
    if array.is_fully_addressable or array.is_fully_replicated:
        return np.asarray(array)
    return np.asarray(multihost_utils.process_allgather(array, tiled=True))


def check_agreement(name: str, tree: Any) -> None:
    """Refuse to go on where processes of one run hold different numbers: they would wait for one another, or mix results."""
    if jax.process_count() == 1:
        return
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(tree):
        values = np.asarray(leaf)
        digest.update(f"{values.shape} {values.dtype}".encode() + values.tobytes())
    found = multihost_utils.process_allgather(np.frombuffer(digest.digest(), np.uint32))
    different = [number for number, row in enumerate(np.asarray(found)) if np.any(row != found[0])]
    if different:
        got = f"another one in process(es) {', '.join(map(str, different))} than in process 0"
        checks.fail(name, got, "the same in every process", "have all processes make it in the same way, without chance")


def _moved(partition: Partition | RayPartition, array: Array, to_mesh: bool) -> Array:
    shapes = partition.shapes
    lists = partition.lists if isinstance(partition, RayPartition) else None
    shape = array.shape
    if array.ndim > 2:
        shape = (*shape[:-3], *(shapes.shape if to_mesh else shapes.scene_shape))
    elif lists is not None:
        shape = (*shape[:-1], lists.size if to_mesh else len(lists.slot))
    there, back = _Store(shapes.mesh, shapes.shape, lists), _Restore(shapes.scene_shape, lists)
    forward, backward = (there, back) if to_mesh else (back, there)
    if not jnp.issubdtype(array.dtype, jnp.inexact):
        return forward((), [array])[0]
    return linear(forward, backward, (), [array], [jnp.zeros(shape, array.dtype)])[0]


@dataclasses.dataclass(frozen=True)
class _Store:
    mesh: Mesh
    shape: tuple[int, int, int]
    lists: NodeLists | None

    def __call__(self, _: Any, arrays: list[Array]) -> list[Array]:
        (array,) = arrays
        values = np.asarray(array)
        if array.ndim > 2:
            behind = [(0, wanted - size) for wanted, size in zip(self.shape, array.shape[-3:], strict=True)]
            values = np.pad(values, [(0, 0)] * (array.ndim - 3) + behind)
            return [put(self.mesh, values, Spec(*[None] * (array.ndim - 3), *NAMES))]
        if self.lists is None:
            return [put(self.mesh, values, Spec())]
        lists = np.zeros((len(values), self.lists.size), values.dtype)
        lists[:, self.lists.slot] = values
        return [put(self.mesh, lists, LIST)]


@dataclasses.dataclass(frozen=True)
class _Restore:
    shape: tuple[int, int, int]
    lists: NodeLists | None

    def __call__(self, _: Any, arrays: list[Array]) -> list[Array]:
        values = known(arrays[0])
        if values.ndim > 2:
            return [jnp.asarray(values[(..., *(slice(n) for n in self.shape))])]
        return [jnp.asarray(values if self.lists is None else values[:, self.lists.slot])]
