"""What is worked out once for some objects, and kept as long as they live.

Public: `keep`.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Hashable
from typing import Any, TypeVar

T = TypeVar("T")

_kept: dict[Hashable, Any] = {}


def keep(anchors: tuple[Any, ...], name: Hashable, make: Callable[[], T]) -> T:
    """What `make()` gave for these very objects under this name, as long as all of them live."""
    key = name, *map(id, anchors)
    if key not in _kept:
        _kept[key] = make()
        for anchor in anchors:
            weakref.finalize(anchor, _kept.pop, key, None)
    return _kept[key]
