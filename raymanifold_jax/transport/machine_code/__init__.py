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
they take; `get_ready`, `compile_aside`.
"""

import numpy as np
from jaxtyping import Float, Float64, Int32, Int64, UInt8, UInt32

from .arguments import (
    BLOCK,
    CUT_ROWS,
    EVEN,
    PATCHY,
    ROWS,
    TOGETHER,
    UNEVEN,
    AllSegments,
    Around,
    Cells,
    Chosen,
    Elements,
    Field,
    Light,
    Manner,
    Planes,
    Readers,
    Segments,
    Standing,
    Sums,
    Ways,
    Work,
)
from .kept import Loop, compile_aside, get_ready

_LATTICE = Ways, Planes, Cells, Cells, Readers, Readers
_LIST = Int32[np.ndarray, "n"]
_WEIGHTS = Float[np.ndarray, "L"]
_PLACES = Int64[np.ndarray, "N"], Int64[np.ndarray, "N"]  # chunk and place of each direction
_WORDS = UInt32[np.ndarray, "G words I"]
_LINKS = int, int, Int32[np.ndarray, "E+1"], _LIST, _WEIGHTS, Float64[np.ndarray, "C n"], Float64[np.ndarray, "C n"]

forwards = Loop("evolution", "forwards", Chosen, *_LATTICE, Light, Manner, Work, Sums, Sums, Field)
backwards = Loop("evolution", "backwards", Chosen, *_LATTICE, Manner, Work, Sums, Sums, Field, Light)
in_vacuum = Loop("vacuum", "in_vacuum", Chosen, *_LATTICE, Light, Manner, Standing, Sums, Sums, Field)
views = Loop(
    "vacuum", "views", Chosen, *_LATTICE, Manner, Standing, _LIST, _LIST, _LIST, _LIST, _WEIGHTS, carried=np.dtype(np.int32)
)
tally, sort = Loop("vacuum", "tally", _LIST, _LIST), Loop("vacuum", "sort", _LIST, _LIST, _WEIGHTS, _LIST, _LIST, _WEIGHTS)
follow, retrace = Loop("vacuum", "follow", *_LINKS), Loop("vacuum", "retrace", *_LINKS)
mark = Loop("marks", "mark", Chosen, Ways, Around, Elements, *_PLACES, Segments, _WORDS)
pack = Loop(
    "marks", "pack", Chosen, Ways, _WORDS, np.uint32, *_PLACES, UInt32[np.ndarray, "M"], Float[np.ndarray, "4 M"],
    UInt32[np.ndarray, "M"], UInt8[np.ndarray, "M"], UInt8[np.ndarray, "N M/8"],
)  # fmt: skip

__all__ = [
    "BLOCK",
    "CUT_ROWS",
    "EVEN",
    "PATCHY",
    "ROWS",
    "TOGETHER",
    "UNEVEN",
    "AllSegments",
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
    "compile_aside",
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
