"""What the loops take: arrays of numpy, by name."""

from __future__ import annotations

from typing import Any, NamedTuple

UNEVEN, EVEN, PATCHY = 0, 1, 2
BLOCK = 128  # elements, or CUT voxels, that are worked on at a time
TOGETHER = 4  # directions that pass a plane at the same time, forwards through a medium
ROWS = 20  # numbers of an element in a block, and of a CUT voxel
CUT_ROWS = 16


class Ways(NamedTuple):
    """Directions along one axis, (axis, u, v) each; `sense` +-1 tells which way the planes are passed."""

    weight: Any  # [N]
    toward: Any  # [N, 3]
    slope: Any  # [N, 2]
    start: Any  # [N, 2]
    sense: Any  # [N]
    laps: Any  # [N]
    index: Any  # [N] in the quadrature


class Planes(NamedTuple):
    """The lattice as K planes of `height` x `width` voxels along one axis, but for the surfaces in it."""

    height: int
    width: int
    margin: int  # in front of a plane of rays, and behind it: at least its width, in whole lines of cache
    wrap_v: bool
    spacing: float
    even: Any  # [K, C] EVEN: all voxels but the listed ones have the extinction `depth`; PATCHY: that or none; else UNEVEN
    depth: Any  # [K, C]
    extinction: Any  # [K, C, P], or nothing where all planes are even


class Cells(NamedTuple):
    """Listed voxels, plane by plane: those of plane k are first[k] to first[k + 1]."""

    first: Any  # [K + 1]
    cell: Any  # [J] flat in the plane; unsigned, because numba looks whether other numbers are negative
    plane: Any  # [4, J] offset and normal of its surface; ghosts: nothing
    extinction: Any  # [C, J]
    image: Any  # [J] of ghosts that are open: their mirror image, else -1


class Readers(NamedTuple):
    """Elements that read voxels (see `layout.Reads`), plane by plane, in runs that have the same surface.

    Those in CUT voxels, whose surfaces are hardly ever the same, are runs of their own, behind the others of their plane.
    """

    runs: Any  # [K + 1] runs of plane k: runs[k] to runs[k + 1]
    alone: Any  # [K] of which those from alone[k] on are of one reader each
    first: Any  # [R + 1] readers of run r: first[r] to first[r + 1]
    face: Any  # [4, M] offset and normal of their surface
    plane: Any  # [4, M] and of that in their voxel; (1, 0, 0, 0) where there is none
    height: Any  # [M]
    cut: Any  # [M] number of the voxel among the CUT ones, -1 where it is none
    cell: Any  # [M] unsigned
    element: Any  # [M]
    bits: Any  # [N, M / 8] whether it reads in a direction, which comes from before it
    even: Any  # [C, R] whether all of the run have the same extinction
    extinction: Any  # [C, M] of the voxel


class Around(NamedTuple):
    """The lattice as `mark` looks at it: K planes along one axis, and the surface in every voxel."""

    count: int
    height: int
    width: int
    padded: tuple[bool, bool, bool]  # along (axis, u, v)
    strides: tuple[int, int, int]
    planes: Any  # [4, V] offset and normal along (axis, u, v)


class Elements(NamedTuple):
    """Elements plane by plane: those of plane k are first[k] to first[k + 1]."""

    first: Any  # [K + 1]
    face: Any  # [4, I]
    alike: Any  # [I] whether its face is that of the one before it
    row: Any  # [I]
    column: Any  # [I]


class Light(NamedTuple):
    """What is sent (forwards), or asked back of it (backwards)."""

    source: Any  # [K, C, P]
    slopes: Any  # 3 times that, or nothing
    cut: Any  # [C, J] exitance of CUT voxels
    ghost: Any  # [C, J] and of ghosts
    radiance: Any  # [images, n, C] that enters
    factor: Any  # [C, J] of ghosts: what that is multiplied by


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
    """Where the rays of a direction are on their way through a plane; in `Work` those of several, one after the other."""

    share: Any  # [3]
    begin: Any  # [3, 3]
    end: Any  # [3, 3]
    move: Any  # [3]
    step: Any  # [3]
    row: Any  # [4] of the rays before each segment and after the last


class Work(NamedTuple):
    """A core's own memory, of any content."""

    rows: Any  # [rows + 4 together, P + 2 margin] rays, both ends joined
    nowhere: Any  # [P]
    asked: Any  # [3, P] of the rays before each segment (backwards)
    here: Any  # blocks of CUT voxels (see `cut`)
    sent: Any  # [together, most ghosts in a plane]
    own: Any  # [rows] which row holds the rays of each direction
    free: Any  # [together, 4] rows that hold none
    passing: Any  # [rows] directions that pass a plane
    count: Any  # [together] their segments there
    length: Any  # [together] their paths
    weight: Any  # [together]
    point: Any  # [3]
    whole: Any  # [3]
    form: Any  # [(ROWS + 1) * BLOCK]
    picked: Any  # [most readers of a plane, or 1]
    at: Any  # [BLOCK]
    way: Any  # Segments of all [together]


class Standing(NamedTuple):
    """A core's own memory where rays keep their places (see `vacuum`), of any content."""

    rows: Any  # [rows, P] rays
    shift: Any  # [rows] from where a ray is kept to the voxel it is in
    nowhere: Any  # [1]
    hits: Any  # [3, most of a plane] rays before each segment, as those read them that are `picked`
    probes: Any
    picked: Any  # [2, most of a plane] hits and probes that read in a direction
    here: Any  # as in `Work`
    sent: Any
    form: Any  # [(ROWS + 1) * BLOCK]
    at: Any  # [BLOCK]
    way: Any  # Segments
