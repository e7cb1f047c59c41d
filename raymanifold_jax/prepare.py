"""What solves of one geometry share: surfaces, their layout, and sweeps through a medium that stays the same.

Finding the surfaces, marking which rays hit them and balancing the exchange take as long as some sweeps each. A fit solves the
same geometry with other values many times, and does this once.

Public: `prepare`, `prepare_once`, `Prepared`.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from . import checks
from .arrays import worked_out_now
from .layout import Layout, make_layout
from .partition import Partition, make_partition
from .placement import known
from .scene import Scene
from .surfaces import Surfaces, find_surfaces

_SMALL = 1 << 20  # voxels times bands, of which a solve keeps what it has made

_latest: Callable[[], Prepared | None] = lambda: None


class Prepared:
    """Surfaces and layout of a geometry; `reuse` keeps what was made for some values while they stay the same.

    One that is for a single solve keeps nothing: what that has no more use for is gone.
    """

    def __init__(self, surfaces: Surfaces, layout: Layout, once: bool = False):
        self.surfaces, self.layout = surfaces, layout
        self._once, self._wanted = once, False
        self._kept: dict[Hashable, tuple[list[np.ndarray], Any, Any]] = {}
        self._partitions: dict[Mesh, Partition] = {}

    def layout_on(self, mesh: Mesh | None) -> Layout | Partition:
        """The layout, or its blocks on a mesh."""
        if mesh is None:
            return self.layout
        if mesh not in self._partitions:
            self._partitions[mesh] = make_partition(self.layout, mesh)
        return self._partitions[mesh]

    def for_the_next(self) -> Prepared:
        """What a later solve of this geometry may begin with: all of it or, where this was for one solve, what is bare."""
        return Prepared(self.surfaces, self.layout) if self._once else self

    def used_again(self) -> Prepared:
        """Itself, which will not `forget` any more."""
        self._wanted = True
        return self

    def forget(self) -> None:
        """Let go what `reuse` keeps, if that was not used again."""
        if not self._wanted:
            self._kept.clear()

    def reuse(self, key: Hashable, values: Any, make: Callable[[], Any], alive: Any = None) -> Any:
        """`make()`, or what it gave before for the same `key` and equal arrays in `values`.

        `alive` is kept as well: an object whose id is part of the key.
        """
        if self._once or checks.is_traced(values):
            return make()
        now = [known(jnp.asarray(leaf)) for leaf in jax.tree.leaves(values)]
        before, kept, _ = self._kept.get(key, ([], None, None))
        same = len(now) == len(before) and all(map(np.array_equal, now, before))
        if kept is None or not same:
            kept = make()
            if not checks.is_traced(kept):
                self._kept[key] = now, kept, alive
        return kept


def prepare_once(scene: Scene) -> Prepared:
    """For a solve that may be the only one of its geometry.

    What it makes is kept where that is small, for `Solution.resolve` to answer at once; unless it does, until the next solve.
    """
    global _latest
    small = int(np.prod(scene.lattice.shape)) * scene.bands <= _SMALL
    prepared, before = prepare(scene, once=not small), _latest()
    if before is not None:
        before.forget()
    _latest = weakref.ref(prepared)
    return prepared


def prepare(scene: Scene, once: bool = False) -> Prepared:
    """Sample the geometry of a scene; its values are not looked at. `once`: for a single solve."""
    # Known even while JAX traces values.
    with worked_out_now():
        surfaces = find_surfaces(scene)
        return Prepared(surfaces, make_layout(scene, surfaces), once)
