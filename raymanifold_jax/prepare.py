"""What solves of one geometry share: surfaces, their layout, and sweeps through a medium that stays the same.

Finding the surfaces, marking which rays hit them and balancing the exchange take as long as some sweeps each. A fit solves the
same geometry with other values many times, and does this once.

Public: `prepare`, `prepare_once`, `let_go`, `Prepared`.
"""

from __future__ import annotations

import threading
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
from .memory import give_back_freed
from .partition import Partition, make_partition
from .placement import known
from .scene import Scene
from .surfaces import Surfaces, find_surfaces

_SMALL = 1 << 20  # voxels times bands, of which a solve keeps what it has made

_lock = threading.Lock()
_latest: Callable[[], Prepared | None] = lambda: None


class Prepared:
    """Surfaces and layout of a geometry; `reuse` keeps what was made for some values while they stay the same.

    One that `keeps` nothing lets go what a solve has no more use for, until it is used again.
    """

    def __init__(self, surfaces: Surfaces, layout: Layout):
        self.surfaces, self.layout = surfaces, layout
        self.keeps = self.for_good = True
        self._kept: dict[Hashable, tuple[list[np.ndarray], Any, Any]] = {}
        self._partitions: dict[Mesh, Partition] = {}

    def __getstate__(self) -> dict[str, Any]:
        # What is kept is found by ids of objects, which copies do not have.
        return self.__dict__ | {"_kept": {}, "_partitions": {}}

    def layout_on(self, mesh: Mesh | None) -> Layout | Partition:
        """The layout, or its blocks on a mesh."""
        if mesh is None:
            return self.layout
        if mesh not in self._partitions:
            self._partitions[mesh] = make_partition(self.layout, mesh)
        return self._partitions[mesh]

    def used_again(self) -> Prepared:
        """Itself, which keeps what is made from now on."""
        self.keeps = self.for_good = True
        return self

    def forget(self) -> None:
        """Keep nothing, unless it was used again."""
        if not self.for_good:
            self.keeps = False
            self._kept.clear()
            self._partitions.clear()

    def reuse(self, key: Hashable, values: Any, make: Callable[[], Any], alive: Any = None) -> Any:
        """`make()`, or what it gave before for the same `key` and equal arrays in `values`.

        `alive` is kept as well: an object whose id is part of the key.
        """
        if not self.keeps or checks.is_traced(values):
            return make()
        now = [known(jnp.asarray(leaf)) for leaf in jax.tree.leaves(values)]
        before, kept, _ = self._kept.get(key, ([], None, None))
        same = len(now) == len(before) and all(map(np.array_equal, now, before))
        if kept is None or not same:
            kept = make()
            if self.keeps and not checks.is_traced(kept):
                self._kept[key] = now, kept, alive
        return kept


def prepare_once(scene: Scene) -> Prepared:
    """For a solve that may be the only one of its geometry.

    What it makes is kept where that is small, for `Solution.resolve` to answer at once; unless it does, until `let_go`.
    """
    global _latest
    prepared = prepare(scene)
    prepared.for_good, prepared.keeps = False, int(np.prod(scene.lattice.shape)) * scene.bands <= _SMALL
    with _lock:
        let_go()
        _latest = weakref.ref(prepared)
    return prepared


def let_go() -> None:
    """Have the last solve that was prepared once forget what it keeps."""
    before = _latest()
    if before is not None:
        before.forget()


def prepare(scene: Scene) -> Prepared:
    """Sample the geometry of a scene; its values are not looked at."""
    # Known even while JAX traces values.
    with worked_out_now():
        surfaces = find_surfaces(scene)
        layout = make_layout(scene, surfaces)
        give_back_freed(layout.real.itemsize * surfaces.solid.size)
        return Prepared(surfaces, layout)
