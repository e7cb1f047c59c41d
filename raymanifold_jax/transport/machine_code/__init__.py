"""The steps of the characteristic scheme as loops for one core of a CPU, compiled by numba.

The equations are those of `characteristic`, where they are explained; here is how they are laid out. A core takes some
directions through all planes, a few at a time so that their rays stay in its cache. In most voxels a segment is a loop over
the whole plane, without a branch, that moves the rays on the way: the ray that is in voxel i now was in voxel i - move before.
Voxels that a surface cuts, and ghost voxels at the rim, are few: they are listed, and overwrite what that loop left there.
Segments of no length are left out; where the extinction is the same all over a plane, so are the exponentials. Without a medium
rays keep their place in memory, and only the listed voxels are visited (`vacuum`). What elements read is worked out for many of
them at once (`readers`).

Numbers of whole planes are of the fields' own type; those of elements are worked out in 64 bits.

What is exported are the loops' names: numba is imported where one has to be compiled (see `kept`).

Public: `forwards`, `backwards`, `in_vacuum`, `views`, `tally`, `sort`, `follow`, `retrace`, `mark`, `pack`, and the tuples that
they take; `get_ready`.
"""

from .arguments import (
    BLOCK,
    CUT_ROWS,
    EVEN,
    PATCHY,
    ROWS,
    TOGETHER,
    UNEVEN,
    Around,
    Cells,
    Elements,
    Light,
    Manner,
    Planes,
    Readers,
    Segments,
    Standing,
    Ways,
    Work,
)
from .kept import Loop, get_ready

forwards, backwards = Loop("evolution", "forwards"), Loop("evolution", "backwards")
in_vacuum, views = Loop("vacuum", "in_vacuum"), Loop("vacuum", "views")
tally, sort, follow, retrace = (Loop("vacuum", name) for name in ("tally", "sort", "follow", "retrace"))
mark, pack = Loop("marks", "mark"), Loop("marks", "pack")

__all__ = [
    "BLOCK",
    "CUT_ROWS",
    "EVEN",
    "PATCHY",
    "ROWS",
    "TOGETHER",
    "UNEVEN",
    "Around",
    "Cells",
    "Elements",
    "Light",
    "Manner",
    "Planes",
    "Readers",
    "Segments",
    "Standing",
    "Ways",
    "Work",
    "backwards",
    "follow",
    "forwards",
    "get_ready",
    "in_vacuum",
    "mark",
    "pack",
    "retrace",
    "sort",
    "tally",
    "views",
]
