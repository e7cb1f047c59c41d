"""How many of a plane's reads are read at a time where one cannot stop to count them.

On a GPU a step whose length depends on the data waits for the host, longer than the whole step takes. So the first `size`
rows of every plane are read when the sweep is there, few enough to be no burden where a plane has none. Planes that have more,
as those along walls, are *crowded*: the rays that enter them are kept, and their other rows read after the sweep.

Public: `Windows`, `make_windows`.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Int

from .arrays import as_jax

_LEAST = 64
_MOST_CROWDED = 8  # planes whose rays are kept at once


class Windows(eqx.Module):
    """Of one sweep axis with K planes; see the module's docstring."""

    size: int = eqx.field(static=True)
    rest: int = eqx.field(static=True)  # rows of a crowded plane that are left at most
    crowded: Int[Array, " Q"]  # the planes; where other axes have more, also some that are not
    slot: Int[Array, " K"]  # number of each plane among these; Q: none of them

    @property
    def count(self) -> int:
        """Of the crowded planes."""
        return self.crowded.shape[0]


def make_windows(counts: Sequence[Int[np.ndarray, " K"]], areas: Sequence[int]) -> tuple[Windows, ...]:
    """By the rows that each plane of each axis has, and its voxels. `size`, `rest` and Q are the same for all axes."""
    most = max(int(count.max(initial=0)) for count in counts)
    crowds = lambda size: [np.nonzero(count > size)[0] for count in counts]

    def slots(size: int) -> int:
        crowded = max(map(len, crowds(size)))
        return crowded if crowded < 3 else 1 << (crowded - 1).bit_length()

    def work(size: int) -> float:
        planes = slots(size)
        # Slots that an axis does not need are filled with a plane that has nothing left to read.
        filled = all(count.min() <= size or len(own) == planes for count, own in zip(counts, crowds(size), strict=True))
        if planes > _MOST_CROWDED or not filled:
            return np.inf
        # Two kinds of reads; and a crowded plane is crossed once more.
        return 2 * size * max(map(len, counts)) + planes * (2 * (most - size) + max(areas))

    # Programs differ by these numbers: powers of 2, for few of them.
    size = min((1 << n for n in range(_LEAST.bit_length() - 1, max(most, _LEAST).bit_length() + 1)), key=work)
    crowded, planes, windows = crowds(size), slots(size), []
    for count, own in zip(counts, crowded, strict=True):
        slot = np.full(len(count), planes)
        slot[own] = np.arange(len(own))
        chosen = np.full(planes, np.argmin(count))
        chosen[: len(own)] = own
        windows.append(Windows(size, _rounded(most - size), as_jax(chosen, np.int32), as_jax(slot, np.int32)))
    return tuple(windows)


def _rounded(count: int) -> int:
    """Up to a multiple of an eighth of its power of 2."""
    if count <= 0:
        return 0
    unit = max(1, (1 << count.bit_length()) // 16)
    return -(-count // unit) * unit
