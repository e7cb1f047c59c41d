"""What the loops take: arrays of numpy, by name.

`Float` is the fields' own type, of 32 or 64 bits; `Shaped` what rays carry: light of that type, or numbers of voxels.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float64, Int64, Shaped, UInt8, UInt32

UNEVEN, EVEN, PATCHY = 0, 1, 2
BLOCK = 128  # elements, or CUT voxels, that are worked on at a time
TOGETHER = 4  # directions that pass a plane at the same time, forwards through a medium
ROWS = 20  # numbers of an element in a block, and of a CUT voxel
CUT_ROWS = 16

Chosen = Int64[np.ndarray, "n"]  # directions that a core takes
Field = Float[np.ndarray, "K C P"]
Sums = Float64[np.ndarray, "C M"]  # of readers


class Ways(NamedTuple):
    """Directions along one axis, (axis, u, v) each; `sense` +-1 tells which way the planes are passed."""

    weight: Float64[np.ndarray, "N"]
    toward: Float64[np.ndarray, "N 3"]
    slope: Float64[np.ndarray, "N 2"]
    start: Float64[np.ndarray, "N 2"]
    sense: Int64[np.ndarray, "N"]
    laps: Int64[np.ndarray, "N"]
    index: Int64[np.ndarray, "N"]  # in the quadrature


class Planes(NamedTuple):
    """The lattice as K planes of `height` x `width` voxels along one axis, but for the surfaces in it."""

    height: int
    width: int
    margin: int  # in front of a plane of rays, and behind it: at least its width, in whole lines of cache
    wrap_v: bool
    spacing: float
    even: Int64[np.ndarray, "K C"]  # EVEN: all but the listed voxels have the extinction `depth`; PATCHY: that or none; UNEVEN
    depth: Float64[np.ndarray, "K C"]
    extinction: Field  # or nothing where all planes are even


class Cells(NamedTuple):
    """Listed voxels, plane by plane: those of plane k are first[k] to first[k + 1]."""

    first: Int64[np.ndarray, "K+1"]
    cell: UInt32[np.ndarray, "J"]  # flat in the plane; unsigned, because numba looks whether other numbers are negative
    plane: Float[np.ndarray, "4 J"]  # offset and normal of its surface; ghosts: nothing
    extinction: Float[np.ndarray, "C J"]
    image: Int64[np.ndarray, "J"]  # of ghosts that are open: their mirror image, else -1


class Readers(NamedTuple):
    """Elements that read voxels (see `layout.Reads`), plane by plane, in runs that have the same surface.

    Those in CUT voxels, whose surfaces are hardly ever the same, are runs of their own, behind the others of their plane.
    """

    runs: Int64[np.ndarray, "K+1"]  # runs of plane k: runs[k] to runs[k + 1]
    alone: Int64[np.ndarray, "K"]  # of which those from alone[k] on are of one reader each
    first: Int64[np.ndarray, "R+1"]  # readers of run r: first[r] to first[r + 1]
    face: Float[np.ndarray, "4 M"]  # offset and normal of their surface
    plane: Float[np.ndarray, "4 M"]  # and of that in their voxel; (1, 0, 0, 0) where there is none
    height: Float[np.ndarray, "M"]
    cut: Int64[np.ndarray, "M"]  # number of the voxel among the CUT ones, -1 where it is none
    cell: UInt32[np.ndarray, "M"]
    element: Int64[np.ndarray, "M"]
    bits: UInt8[np.ndarray, "N M/8"]  # whether it reads in a direction, which comes from before it
    even: Bool[np.ndarray, "C R"]  # whether all of the run have the same extinction
    extinction: Float64[np.ndarray, "C M"]  # of the voxel


class Around(NamedTuple):
    """The lattice as `mark` looks at it: K planes along one axis, and the surface in every voxel."""

    count: int
    height: int
    width: int
    padded: tuple[bool, bool, bool]  # along (axis, u, v)
    strides: tuple[int, int, int]
    planes: Float[np.ndarray, "4 V"]  # offset and normal along (axis, u, v)


class Elements(NamedTuple):
    """Elements plane by plane: those of plane k are first[k] to first[k + 1]."""

    first: Int64[np.ndarray, "K+1"]
    face: Float[np.ndarray, "4 I"]
    alike: Bool[np.ndarray, "I"]  # whether its face is that of the one before it
    row: Int64[np.ndarray, "I"]
    column: Int64[np.ndarray, "I"]


class Light(NamedTuple):
    """What is sent (forwards), or asked back of it (backwards)."""

    source: Field
    slopes: tuple[Field, Field, Field]  # or nothing
    cut: Float[np.ndarray, "C J"]  # exitance of CUT voxels
    ghost: Float[np.ndarray, "C J"]  # and of ghosts
    radiance: Float[np.ndarray, "images n C"]  # that enters
    factor: Float[np.ndarray, "C J"]  # of ghosts: what that is multiplied by


class Manner(NamedTuple):
    """`thin`, `onward` as in `SweptMedium`; `limit` is `thin_limit`; `rows`: directions taken at a time."""

    medium: bool
    sloped: bool
    thin: bool
    onward: bool
    fluence: bool
    limit: float
    rows: int


class Segments(NamedTuple):
    """Where the rays of a direction are on their way through a plane."""

    share: Float64[np.ndarray, "3"]
    begin: Float64[np.ndarray, "3 3"]
    end: Float64[np.ndarray, "3 3"]
    move: Int64[np.ndarray, "3"]
    step: Float64[np.ndarray, "3"]
    row: Int64[np.ndarray, "4"]  # of the rays before each segment and after the last


class AllSegments(NamedTuple):
    """`Segments` of directions that pass together."""

    share: Float64[np.ndarray, "together 3"]
    begin: Float64[np.ndarray, "together 3 3"]
    end: Float64[np.ndarray, "together 3 3"]
    move: Int64[np.ndarray, "together 3"]
    step: Float64[np.ndarray, "together 3"]
    row: Int64[np.ndarray, "together 4"]


class Work(NamedTuple):
    """A core's own memory, of any content."""

    rows: Float[np.ndarray, "rows P"]  # rows + 4 together of P + 2 margin: rays, both ends joined
    nowhere: Float[np.ndarray, "P"]
    asked: Float[np.ndarray, "3 P"]  # of the rays before each segment (backwards)
    here: Float[np.ndarray, "B"]  # blocks of CUT voxels (see `cut`)
    sent: Float[np.ndarray, "together J"]
    own: Int64[np.ndarray, "rows"]  # which row holds the rays of each direction
    free: Int64[np.ndarray, "together 4"]  # rows that hold none
    passing: Int64[np.ndarray, "rows"]  # directions that pass a plane
    count: Int64[np.ndarray, "together"]  # their segments there
    length: Float64[np.ndarray, "together"]  # their paths
    weight: Float64[np.ndarray, "together"]
    point: Float64[np.ndarray, "3"]
    whole: Float64[np.ndarray, "3"]
    form: Float64[np.ndarray, "F"]
    picked: UInt32[np.ndarray, "M"]
    at: UInt32[np.ndarray, "B"]
    way: AllSegments


class Standing(NamedTuple):
    """A core's own memory where rays keep their places (see `vacuum`), of any content."""

    rows: Shaped[np.ndarray, "rows P"]  # rays
    shift: Int64[np.ndarray, "rows"]  # from where a ray is kept to the voxel it is in
    nowhere: Shaped[np.ndarray, "1"]
    hits: Shaped[np.ndarray, "3 M"]  # rays before each segment, as those read them that are `picked`
    probes: Shaped[np.ndarray, "3 M"]
    picked: UInt32[np.ndarray, "2 M"]  # hits and probes that read in a direction
    here: Shaped[np.ndarray, "B"]  # as in `Work`
    sent: Shaped[np.ndarray, "J"]
    form: Float64[np.ndarray, "F"]
    at: UInt32[np.ndarray, "B"]
    way: Segments
