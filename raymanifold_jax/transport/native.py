"""Sweeps on a CPU by loops of our own (`machine_code`) instead of XLA's: the same sums in a fraction of the time.

What a scene's sweeps share, the listed voxels and readers of each axis, is worked out once and kept as long as its layout,
directions and extinction are. Each core takes some of the directions through all planes and adds up for itself.

This serves known numbers of one device that is a CPU, where numba is installed; all else is left to `characteristic`, which
gives the same results to rounding.

Public: `installed`, `compile_aside`, `serves`, `at_hand`, `sweep`, `unsweep`, `views`, `follow`, `retrace`, `hit_bits`.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import importlib.util
import itertools
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from .. import checks
from ..arrays import as_jax
from ..keep import keep
from ..layout import AXES, Layout, Ordinates, Reads, ghosts
from ..memory import give_back_freed
from ..threads import count_cores
from .characteristic import Inflow
from .cores import on_cores, on_cpu
from .step import thin_limit

if TYPE_CHECKING:
    from . import machine_code

_RAYS = 1 << 18  # rays that a core takes on at a time: they stay in its cache
_LINE = 64  # bytes of a line of cache
T = TypeVar("T")


@functools.cache
def installed() -> bool:
    """Whether the loops can be used: numba is installed, fits numpy's version, and does as expected."""
    if importlib.util.find_spec("numba") is None:
        return False
    try:
        importlib.import_module(".machine_code", __package__).get_ready()
    except (ImportError, RuntimeError) as problem:
        warnings.warn(f"numba cannot be used here, so sweeps take longer: {problem}", stacklevel=2)
        return False
    return True


@functools.cache
def compile_aside(real: np.dtype, medium: bool) -> None:
    """Have what a solve needs compiled by other processes, where it is not kept, while it finds its surfaces."""
    if not installed():
        return
    from . import machine_code as code

    # In groups that take about as long; what is needed first, first. (Vacuum with too many links needs others, which then are
    # compiled when they are called.)
    if medium:
        code.compile_aside(real, (code.forwards,), (code.mark, code.pack, code.backwards))
    else:
        code.compile_aside(real, (code.mark, code.pack, code.views), (code.sort, code.in_vacuum, code.follow, code.retrace))


def serves(layout: Any, ordinates: tuple[Ordinates, ...], arguments: Any) -> bool:
    """Whether a sweep of these can be done here."""
    known = isinstance(layout, Layout) and not checks.is_traced((layout, ordinates, arguments))
    return known and installed() and on_cpu(ordinates)


class _Axis(NamedTuple):
    """What all sweeps along an axis share, but for the medium."""

    ways: machine_code.Ways
    parts: tuple[np.ndarray, ...]  # directions of each core
    shape: tuple[int, int, int]
    cut: machine_code.Cells
    ghosts: machine_code.Cells
    unlisted: np.ndarray  # [K, P] voxels that are neither cut nor ghosts
    hits: machine_code.Readers
    probes: machine_code.Readers
    at_cut: tuple[np.ndarray, np.ndarray]  # of each element image in a CUT voxel: its number, and that of the voxel
    at_ghost: tuple[np.ndarray, np.ndarray]

    @property
    def area(self) -> int:
        return self.shape[1] * self.shape[2]


class _Medium(NamedTuple):
    """The extinction of an axis, and of listed voxels."""

    there: bool
    even: np.ndarray
    depth: np.ndarray
    extinction: np.ndarray
    cut: np.ndarray
    readers: tuple[tuple[np.ndarray, np.ndarray], ...]  # of the hits' and the probes' runs, whether it is even; and of each


def sweep(
    manner: Any,
    layout: Layout,
    ordinates: tuple[Ordinates, ...],
    extinction: Float[Array, "C X Y Z"] | None,
    exitance: Float[Array, "C E"],
    source: Float[Array, "C nx ny nz"] | None,
    slopes: tuple[Float[Array, "C X Y Z"], ...] | None,
    inflow: Inflow | None,
) -> tuple[Float[Array, "C E"], Float[Array, "C nx ny nz"] | None]:
    """As `derivative.swept`."""
    from . import machine_code as code

    real, bands = np.dtype(exitance.dtype), exitance.shape[0]
    sent = np.asarray(exitance)
    volume = None
    if extinction is not None:
        volume = layout.to_padded(np.zeros((bands, *layout.shape), real) if source is None else np.asarray(source))
    slopes = None if volume is None else slopes
    sloped = slopes is not None
    at_elements = np.zeros((bands, layout.elements))
    in_voxels = np.zeros((bands, *layout.padded), real)
    dark = not sent.any() and not any(np.asarray(field).any() for field in (volume, *(slopes or ())) if field is not None)

    def begin(axis: int, line: _Axis, arguments: tuple, how: machine_code.Manner) -> Callable[[], None]:
        planes, cut, *readers = arguments
        if not manner.elements:
            readers = [r._replace(runs=np.zeros_like(r.runs), alone=np.zeros_like(r.alone)) for r in readers]
        along = lambda a: _planes(np.asarray(slopes[a]), axis) if slopes else np.zeros((1, 1, 1), real)
        light = _contiguous(code.Light(
            source=np.zeros((1, bands, 1), real) if volume is None else _planes(volume, axis),
            slopes=(along(AXES[axis][0]), along(AXES[axis][1]), along(AXES[axis][2])),
            cut=_gathered(sent, layout, line.at_cut, len(line.cut.cell)),
            ghost=_gathered(sent, layout, line.at_ghost, len(line.ghosts.cell)),
            radiance=np.zeros((0, 1, bands), real) if inflow is None else np.asarray(inflow.radiance),
            factor=_factor(layout, line, inflow, bands),
        ))  # fmt: skip

        def run(part: np.ndarray):
            sums = [np.zeros((bands, len(r.cell))) for r in readers]
            voxels, directions = _lined_up((line.shape[0] * manner.fluence, bands, line.area), real), min(how.rows, len(part))
            known = part, line.ways, planes, cut, line.ghosts, *readers, light, how
            if volume is None:
                code.in_vacuum(*known, _standing(code, line, directions, real), *sums, voxels)
            else:
                code.forwards(*known, _work(code, line, directions, code.TOGETHER, real), *sums, voxels)
            return sums, voxels

        parts = on_cores(run, _shared(_lit(layout, line, axis, inflow)) if dark else line.parts)

        def add_up() -> None:
            for sums, voxels in _as_one(parts):
                for of_kind, of_readers in zip(readers, sums, strict=True):
                    at_elements[:] += [np.bincount(of_kind.element, band, layout.elements) for band in of_readers]
                if manner.fluence:
                    in_voxels[:] += _from_planes(voxels, axis, line.shape)

        return add_up

    _one_after_the_other(begin, _lines(manner, layout, ordinates, extinction, bands, sloped, real))
    give_back_freed(real.itemsize * bands * int(np.prod(layout.shape)))
    voxels = as_jax(layout.from_padded(in_voxels)) if manner.fluence else None
    return as_jax(at_elements, real), voxels


def unsweep(
    manner: Any,
    layout: Layout,
    ordinates: tuple[Ordinates, ...],
    extinction: Float[Array, "C X Y Z"] | None,
    at_elements: Float[Array, "C E"],
    in_voxels: Float[Array, "C nx ny nz"] | None,
    sloped: bool,
) -> tuple[Float[Array, "C E"], Float[Array, "C nx ny nz"] | None, tuple[Float[Array, "C X Y Z"], ...] | None]:
    """As `derivative.unswept`: the transpose of `sweep`."""
    from . import machine_code as code

    real, bands = np.dtype(at_elements.dtype), at_elements.shape[0]
    medium, asked = extinction is not None, np.asarray(at_elements, float)
    sloped = sloped and medium
    volume = None if in_voxels is None else layout.to_padded(np.asarray(in_voxels))
    exitance = np.zeros((bands, layout.elements))
    # Of the source, and of its slopes along x, y and z.
    fields = [np.zeros((bands, *layout.padded), real) for _ in range(medium * (1 + 3 * sloped))]
    manner = dataclasses.replace(manner, fluence=volume is not None)

    def begin(axis: int, line: _Axis, arguments: tuple, how: machine_code.Manner) -> Callable[[], None]:
        planes, cut, hits, probes = arguments
        readers = hits, probes
        wanted = _contiguous(np.zeros((1, bands, 1), real) if volume is None else _planes(volume, axis))
        of_hits, of_probes = _contiguous(tuple(asked[:, r.element] for r in readers))

        def run(part: np.ndarray):
            field = lambda there: _lined_up((line.shape[0], bands, line.area) if there else (1, 1, 1), real)
            listed = lambda cells: np.zeros((bands, len(cells.cell)), real)
            slopes, nothing = (field(sloped), field(sloped), field(sloped)), np.zeros((0, 1, 1), real)
            back = code.Light(field(medium), slopes, listed(line.cut), listed(line.ghosts), nothing, nothing[:, 0])
            work = _work(code, line, min(how.rows, len(part)), 1, real)
            code.backwards(part, line.ways, planes, cut, line.ghosts, hits, probes, how, work, of_hits, of_probes, wanted, back)
            return back

        parts = on_cores(run, line.parts)

        def add_up() -> None:
            for back in _as_one(parts):
                for values, at in ((back.cut, line.at_cut), (back.ghost, line.at_ghost)):
                    exitance[:] += _scattered(values, layout, at)
                found = [back.source, *(back.slopes[AXES[axis].index(a)] for a in range(3))]
                for field, of_planes in zip(fields, found, strict=False):
                    field += _from_planes(of_planes, axis, line.shape)

        return add_up

    _one_after_the_other(begin, _lines(manner, layout, ordinates, extinction, bands, sloped, real))
    give_back_freed(real.itemsize * bands * int(np.prod(layout.shape)))
    source = as_jax(layout.from_padded(fields[0])) if medium else None
    return as_jax(exitance, real), source, tuple(map(as_jax, fields[1:])) if sloped else None


def _as_one(parts: Iterable[Any]) -> list[Any]:
    """The arrays of all trees added up in those of the first, which is quicker than to turn each; nothing of none."""
    whole: list[Any] = []
    for part in parts:
        if whole:
            jax.tree.map(np.ndarray.__iadd__, whole[0], part)
        else:
            whole.append(part)
    return whole


class Listed(NamedTuple):
    """Links of elements in vacuum, those of the same element together: which are whose, what sends, and weights."""

    first: Int[np.ndarray, " E1"]
    source: Int[np.ndarray, " L"]
    weight: Float[np.ndarray, " L"]


def views(layout: Layout, ordinates: tuple[Ordinates, ...], numbers: np.ndarray) -> Listed:
    """In vacuum, what elements see of voxels that send the `numbers` [X, Y, Z], 1 and up."""
    from . import machine_code as code
    from .derivative import Manner

    real = layout.real

    def along(axis: int, line: _Axis, arguments: tuple, how: machine_code.Manner) -> list[list[tuple[np.ndarray, ...]]]:
        planes, cut, hits, probes = arguments
        codes = numbers.transpose(AXES[axis]).reshape(-1).astype(np.int32)
        listed = _contiguous(tuple(codes[_flat(cells, line.area)] for cells in (cut, line.ghosts)))

        def run(part: np.ndarray) -> list[tuple[np.ndarray, ...]]:
            work, seen = _standing(code, line, min(how.rows, len(part)), np.dtype(np.int32)), []
            for first in range(0, len(part), how.rows):
                batch = part[first : first + how.rows]
                # A hit sees by three segments at most, a probe its own surface as well.
                most = sum(kinds * int(np.bitwise_count(r.bits[batch]).sum()) for kinds, r in ((3, hits), (4, probes)))
                lists = np.empty(most, np.int32), np.empty(most, np.int32), np.empty(most, real)
                known = batch, line.ways, planes, cut, line.ghosts, hits, probes, how, work
                count = code.views(*known, *listed, *lists)
                seen.append(tuple(values[:count] for values in lists))  # what lies behind was never written: no memory
            return seen

        return list(on_cores(run, line.parts))

    found = [along(*line) for line in _lines(Manner(False), layout, ordinates, None, 1, False, real)]
    of_cores = [[links for seen in core for links in seen] for core in itertools.zip_longest(*found, fillvalue=[])]
    del found
    return _sorted(of_cores, layout.elements, real)


def _sorted(parts: list[list[tuple[np.ndarray, ...]]], elements: int, real: np.dtype) -> Listed:
    """Lists of element, source and weight, some for each core, as one; they are emptied on the way."""
    from . import machine_code as code

    def tally(part: list[tuple[np.ndarray, ...]]) -> np.ndarray:
        count = np.zeros(elements, np.int32)
        for element, _, _ in part:
            code.tally(element, count)
        return count

    counts = [np.zeros(elements, np.int32), *on_cores(tally, parts)]
    first = np.zeros(elements + 1, np.int32)
    np.cumsum(sum(counts), out=first[1:])
    # A core's links of an element come after those of the cores before.
    places = [first[:-1] + before for before in itertools.accumulate(counts[:-1])]
    source, weight = np.empty(first[-1], np.int32), np.empty(first[-1], real)

    def sort(core: int) -> None:
        while parts[core]:
            code.sort(*parts[core].pop(), places[core], source, weight)

    list(on_cores(sort, range(len(parts))))
    return Listed(first, source, weight)


def at_hand(arrays: Any) -> bool:
    """Whether these can be worked with here."""
    leaves = jax.tree.leaves(arrays)
    if checks.is_traced(arrays) or not installed():
        return False
    return all(d.platform == "cpu" for a in leaves if isinstance(a, jax.Array) for d in a.devices())


def follow(links: Sequence[Array], sent: Float[np.ndarray, "C n"]) -> Float[np.ndarray, "C E"]:
    """What arrives at elements by their links (`Listed`) of what is `sent`."""
    from . import machine_code as code

    known, ends = _of_links(links)
    sent = _contiguous(np.asarray(sent, float))
    got = np.zeros((len(sent), len(known.first) - 1))
    list(on_cores(lambda n: code.follow(ends[n], ends[n + 1], *known, sent, got), range(count_cores())))
    return got


def retrace(links: Sequence[Array], asked: Float[np.ndarray, "C E"], count: int) -> Float[np.ndarray, "C n"]:
    """The transpose of `follow`: of `count` numbers that send."""
    from . import machine_code as code

    known, ends = _of_links(links)
    asked = _contiguous(np.asarray(asked, float))

    def run(number: int) -> np.ndarray:
        got = np.zeros((len(asked), count))
        code.retrace(ends[number], ends[number + 1], *known, asked, got)
        return got

    return np.sum(list(on_cores(run, range(count_cores()))), axis=0)


def _of_links(links: Sequence[Array]) -> tuple[Listed, np.ndarray]:
    """As numpy's arrays, and at which elements each core begins, for all to have as many links."""
    known = Listed(*_contiguous(tuple(map(np.asarray, links))))
    return known, np.searchsorted(known.first, np.linspace(0, known.first[-1], count_cores() + 1).astype(int))


def hit_bits(
    geometry: tuple[Array, ...],
    strides: Int[np.ndarray, "3"],
    shape: tuple[int, int, int],
    padded: tuple[bool, bool, bool],
    ordinates: Ordinates,
    face: Float[Array, "4 I"],
    home: Int[Array, "3 I"],
) -> UInt32[np.ndarray, "G words I"]:
    """As in `marks`: bits of the directions whose rays arrive at each element in its own voxel."""
    from . import machine_code as code

    chunk, place = np.nonzero(np.asarray(ordinates.weight) != 0)
    plane, row, column = np.asarray(home)
    order = np.argsort(plane, kind="stable")
    i, j, k = (int(stride) for stride in strides)
    around = code.Around(*shape, padded, (i, j, k), np.array([np.asarray(g) for g in geometry]))
    first = np.searchsorted(plane[order], np.arange(shape[0] + 1))
    faces = np.asarray(face)[:, order]
    alike = np.append(False, np.all(faces[:, 1:] == faces[:, :-1], axis=0))[: len(order)]
    alike[first[:-1][first[:-1] < len(order)]] = False  # each plane begins anew
    elements = code.Elements(first, faces, alike, row[order].astype(int), column[order].astype(int))
    known = _contiguous((_ways(code, ordinates, chunk, place), around, elements, chunk, place))
    found = np.zeros((ordinates.weight.shape[0], -(-ordinates.weight.shape[1] // 32), len(order)), np.uint32)
    # Directions of a chunk share words: each chunk is one core's.
    parts = [np.nonzero(chunk % count_cores() == core)[0] for core in range(count_cores())]
    for _ in on_cores(lambda part: code.mark(part, *known, _segments(code.Segments), found), [p for p in parts if len(p)]):
        pass
    bits = np.empty_like(found)
    bits[..., order] = found
    return bits


def _lines(manner: Any, layout: Layout, ordinates, extinction, bands: int, sloped: bool, real: np.dtype) -> Iterator[tuple]:
    """Each axis: its number, what is listed along it, and the arguments of `machine_code`."""
    from . import machine_code as code

    used = [axis for axis, own in enumerate(ordinates) if own.weight.shape[0] and int(own.chunks)]
    for axis, line in zip(used, on_cores(lambda axis: _axis(layout, ordinates[axis], axis), used), strict=True):
        if line.parts:
            medium = _medium(layout, line, axis, extinction, bands, real)
            arguments = _arguments(code, layout, line, medium, axis, real)
            yield axis, line, _contiguous(arguments), _manner(code, manner, medium, sloped, line, real)


def _one_after_the_other(begin: Callable[..., Callable[[], None]], lines: Iterable[tuple]) -> None:
    """Begin with each axis before the one before it is added up: the cores do not wait for that."""
    add_up: Callable[[], None] = lambda: None
    for line in lines:
        next_one = begin(*line)
        add_up()
        add_up = next_one
    add_up()


def _manner(code, manner: Any, medium: _Medium, sloped: bool, line: _Axis, real) -> machine_code.Manner:
    thin, rows = bool(manner.thin and not sloped), _at_a_time(code, line)
    return code.Manner(medium.there, sloped, thin, bool(manner.onward), bool(manner.fluence), thin_limit(real), rows)


def _at_a_time(code, line: _Axis) -> int:
    """How many directions a core takes on: those it is given in parts of about the same size."""
    most, fit = max(map(len, line.parts)), max(2, _RAYS // max(line.area, 1))
    each = -(-most // -(-most // fit))
    return -(-each // code.TOGETHER) * code.TOGETHER


def _segments(kind: Callable[..., T], *of: int) -> T:
    three, points = (*of, 3), (*of, 3, 3)
    return kind(
        np.zeros(three), np.zeros(points), np.zeros(points), np.zeros(three, int), np.zeros(three), np.zeros((*of, 4), int)
    )


def _work(code, line: _Axis, directions: int, together: int, real) -> machine_code.Work:
    size = line.area
    return code.Work(
        rows=_lined_up((directions + 4 * together, size + 2 * _margin(line, real)), real), nowhere=_lined_up((size,), real),
        asked=_lined_up((3, size), real), here=_cut_blocks(code, line, real), sent=_of_ghosts(line, together, real),
        own=np.zeros(directions, int), free=np.zeros((together, 4), int), passing=np.zeros(directions, int),
        count=np.zeros(together, int), length=np.zeros(together), weight=np.zeros(together),
        point=np.zeros(3), whole=np.zeros(3), form=np.zeros((code.ROWS + 1) * code.BLOCK),
        picked=np.zeros(_most(line), np.uint32), at=np.zeros(code.BLOCK, np.uint32), way=_segments(code.AllSegments, together),
    )  # fmt: skip


def _standing(code, line: _Axis, directions: int, real) -> machine_code.Standing:
    most = _most(line)
    return code.Standing(
        rows=np.zeros((directions, line.area), real), shift=np.zeros(directions, int), nowhere=np.zeros(1, real),
        hits=np.zeros((3, most), real), probes=np.zeros((3, most), real), picked=np.zeros((2, most), np.uint32),
        here=_cut_blocks(code, line, real), sent=_of_ghosts(line, 1, real)[0], form=np.zeros((code.ROWS + 1) * code.BLOCK),
        at=np.zeros(code.BLOCK, np.uint32), way=_segments(code.Segments),
    )  # fmt: skip


def _margin(line: _Axis, real: np.dtype) -> int:
    return _whole_lines(line.shape[2], real)


def _cut_blocks(code, line: _Axis, real) -> np.ndarray:
    most = int(np.diff(line.cut.first).max())
    return np.zeros(-(-most // code.BLOCK) * code.BLOCK * code.CUT_ROWS, real)


def _of_ghosts(line: _Axis, together: int, real) -> np.ndarray:
    return np.zeros((together, int(np.diff(line.ghosts.first).max())), real)


def _most(line: _Axis) -> int:
    """Readers of one kind in a plane, at most, and at least one; and the places that are written ahead."""
    return 7 + max(1, *(int(np.diff(r.first[r.runs]).max(initial=0)) for r in (line.hits, line.probes)))


def _arguments(code, layout: Layout, line: _Axis, medium: _Medium, axis: int, real: np.dtype) -> tuple:
    _, height, width = line.shape
    wrap_v = layout.pad[AXES[axis][2]] == 0
    margin, spacing = _margin(line, real), float(layout.spacing)
    planes = code.Planes(height, width, margin, wrap_v, spacing, medium.even, medium.depth, medium.extinction)
    readers = (
        r._replace(even=even, extinction=each) for r, (even, each) in zip((line.hits, line.probes), medium.readers, strict=True)
    )
    return planes, line.cut._replace(extinction=medium.cut), *readers


def _contiguous(given: T) -> T:
    """Arrays, in tuples of any depth, as C has them in memory."""
    if isinstance(given, tuple):
        parts = [_contiguous(part) for part in given]
        return type(given)(*parts) if hasattr(given, "_fields") else tuple(parts)  # pyright: ignore
    return np.ascontiguousarray(given) if isinstance(given, np.ndarray) else given


def _planes(field: np.ndarray, axis: int) -> np.ndarray:
    """A padded field [C, X, Y, Z] as planes [K, C, P], each of whole lines of cache."""
    a, u, v = AXES[axis]
    turned = field.transpose(1 + a, 0, 1 + u, 1 + v)
    size = turned.shape[2] * turned.shape[3]
    planes = _lined_up((*turned.shape[:2], size), field.dtype)
    planes[..., :size].reshape(turned.shape)[:] = turned
    return planes


def _lined_up(shape: tuple[int, ...], real: np.dtype) -> np.ndarray:
    """Zeros, of which each row begins with a line of cache, with a few more at its end: writing them takes half as long."""
    shape = (*shape[:-1], _whole_lines(shape[-1], real))
    size = int(np.prod(shape)) * real.itemsize
    memory = np.zeros(size + _LINE, np.uint8)
    begin = -memory.__array_interface__["data"][0] % _LINE
    return memory[begin : begin + size].view(real).reshape(shape)


def _whole_lines(count: int, real: np.dtype) -> int:
    a_line = _LINE // real.itemsize
    return -(-count // a_line) * a_line


def _from_planes(planes: np.ndarray, axis: int, shape: tuple[int, int, int]) -> np.ndarray:
    field = planes[..., : shape[1] * shape[2]].reshape(shape[0], -1, shape[1], shape[2])
    dims = (0, 2, 3)
    return field.transpose(1, *(dims[AXES[axis].index(a)] for a in range(3)))


def _gathered(values: np.ndarray, layout: Layout, at: tuple[np.ndarray, np.ndarray], count: int) -> np.ndarray:
    """In each listed voxel the sum over the element images there: their values times their share."""
    image, place = at
    share, element = np.asarray(layout.share)[image], np.asarray(layout.source_element)[image]
    total = [np.bincount(place, band[element] * share, count) for band in values]
    return np.array(total, values.dtype).reshape(len(values), count)


def _scattered(values: np.ndarray, layout: Layout, at: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """The transpose of `_gathered`."""
    image, place = at
    share, element = np.asarray(layout.share)[image], np.asarray(layout.source_element)[image]
    return np.array([np.bincount(element, band[place] * share, layout.elements) for band in values])


def _factor(layout: Layout, line: _Axis, inflow: Inflow | None, bands: int) -> np.ndarray:
    if inflow is None or inflow.factor is None:
        return np.ones((bands, len(line.ghosts.cell)), layout.real)
    return _gathered(np.asarray(inflow.factor), layout, line.at_ghost, len(line.ghosts.cell))


def _axis(layout: Layout, own: Ordinates, axis: int) -> _Axis:
    assert own.hit_bits is not None  # by mark_hits
    return keep((layout.cut_plane, own.weight, own.laps, own.hit_bits), ("axis", axis), lambda: _make_axis(layout, own, axis))


def _make_axis(layout: Layout, own: Ordinates, axis: int) -> _Axis:
    assert own.hit_bits is not None and own.probe_bits is not None  # by mark_hits
    from . import machine_code as code

    order = AXES[axis]
    count, height, width = shape = layout.padded_along(axis)
    ghost = ghosts(layout.padded, layout.pad).transpose(order).reshape(count, -1)

    def along(cell: Array) -> np.ndarray:
        """Numbers of voxels on the planes of this axis."""
        voxel = np.unravel_index(np.asarray(cell), layout.padded)
        return (voxel[order[0]] * height + voxel[order[1]]) * width + voxel[order[2]]

    home, rim = along(layout.cut_cell), np.nonzero(ghost.ravel())[0]
    surface = np.zeros(ghost.shape, bool)
    surface.ravel()[home] = True
    by_place = np.argsort(home)
    cut = _cells(code, home[by_place], shape, np.asarray(layout.cut_plane)[[0, *(1 + a for a in order)]][:, by_place])
    image = np.full(len(rim), -1)
    image[np.searchsorted(rim, along(layout.open_cell))] = np.asarray(layout.open_image)
    at_rim = _cells(code, rim, shape, np.zeros((4, 0), layout.real), image)
    number = np.full(ghost.size, -1)
    for cells in (cut, at_rim):
        number[_flat(cells, height * width)] = np.arange(len(cells.cell))
    home = along(layout.cell)  # of each element image
    in_ghost = ghost.ravel()[home]
    at = lambda image: (image, number[home[image]])
    chunk, place = np.nonzero(np.asarray(own.weight) != 0)
    ways = _ways(code, own, chunk, place)
    marked = lambda bits, wanted: (ways, chunk, place, np.asarray(bits), wanted)
    hits, probes = (
        _readers(code, reads, marked(bits, wanted), number, surface, cut)
        for reads, bits, wanted in zip(layout.reads[axis].kinds, (own.hit_bits, own.probe_bits), (1, 0), strict=True)
    )
    parts = _shared(_by_sense(ways))
    line = _contiguous((ways, parts, shape, cut, at_rim, ~surface & ~ghost, hits, probes))
    return _Axis(*line, at(np.nonzero(~in_ghost)[0]), at(np.nonzero(in_ghost)[0]))


def _by_sense(ways: machine_code.Ways) -> Int[np.ndarray, " N"]:
    """All directions; the two senses meet planes in opposite order."""
    return np.argsort(-ways.sense, kind="stable")


def _shared(numbers: np.ndarray) -> tuple[np.ndarray, ...]:
    """Directions for each core, from all over; sorted by sense, they stay so."""
    return tuple(part.copy() for first in range(count_cores()) if len(part := numbers[first :: count_cores()]))


def _lit(layout: Layout, line: _Axis, axis: int, inflow: Inflow | None) -> Int[np.ndarray, " n"]:
    """Of the directions those in which light comes in, where it comes from nowhere else."""
    ways, voxel = line.ways, np.unravel_index(np.asarray(layout.open_cell), layout.padded)
    numbers = _by_sense(ways)
    if inflow is None:
        return numbers[:0]
    shines = (np.asarray(inflow.radiance) != 0).any((0, 2))[ways.index]
    enters = np.zeros(len(shines), bool)
    for place, a in enumerate(AXES[axis]):
        for end, inward in ((0, 1), (layout.padded[a] - 1, -1)):
            if layout.pad[a] and (voxel[a] == end).any():
                enters |= inward * ways.toward[:, place] > 0
    return numbers[(shines & enters)[numbers]]


def _flat(cells: machine_code.Cells, area: int) -> np.ndarray:
    return np.repeat(np.arange(len(cells.first) - 1), np.diff(cells.first)) * area + cells.cell


def _cells(code, home: np.ndarray, shape: tuple[int, int, int], plane: np.ndarray, image: Any = ()) -> machine_code.Cells:
    number, cell = np.divmod(home, shape[1] * shape[2])
    return code.Cells(
        first=np.searchsorted(number, np.arange(shape[0] + 1)),
        cell=cell.astype(np.uint32),
        plane=plane,
        extinction=plane[:, :0],
        image=np.array(image, int),
    )


def _readers(
    code, reads: Reads, marked: tuple, number: np.ndarray, surface: np.ndarray, cells: machine_code.Cells
) -> machine_code.Readers:
    """Reads in runs of the same plane and surface; `marked` tells who reads in which direction."""
    plane = np.repeat(np.arange(len(reads.first_tile) - 1), np.diff(np.asarray(reads.first_tile)) * reads.tile)
    used = np.nonzero(np.any([np.asarray(n)[: len(plane)] != 0 for n in reads.plane[1:]], axis=0))[0]  # the rest only pads
    plane, cell = plane[used], np.asarray(reads.cell)[used].astype(int)
    where = plane * surface.shape[1] + cell
    cut = np.where(surface.ravel()[where], number[where], -1)
    face = np.array([np.asarray(values)[used] for values in (*reads.plane, reads.height)])
    order = np.lexsort((_mixed(face), cut, plane))
    sizes = np.diff(_runs(face[:, order], cut[order], plane[order]), append=len(order))
    # Those that are runs of their own come after all others of their plane.
    order = order[np.argsort(2 * plane[order] + np.repeat(sizes == 1, sizes), kind="stable")]
    face, cut, plane = face[:, order], cut[order], plane[order]
    begins = _runs(face, cut, plane)
    several, of_runs = np.diff(begins, append=len(order)) > 1, plane[begins]
    count = len(reads.first_tile) - 1
    planes = np.zeros((4, len(order)), face.dtype)
    planes[0] = 1.0
    planes[:, cut >= 0] = cells.plane[:, cut[cut >= 0]]
    runs = np.searchsorted(of_runs, np.arange(count + 1))
    return code.Readers(
        runs=runs,
        alone=runs[:-1] + np.bincount(of_runs[several], minlength=count),
        first=np.append(begins, len(order)),
        face=face[:4],
        plane=planes,
        height=face[4],
        cut=cut,
        cell=_to_bytes(cell[order].astype(np.uint32)),
        element=_to_bytes(np.asarray(reads.element)[used][order].astype(int)),
        bits=_packed_marks(code, marked, used[order], face[:4]),
        even=np.zeros((1, 0), bool),
        extinction=np.zeros((1, 0)),
    )


def _mixed(face: np.ndarray) -> np.ndarray:
    """A number for each column, by which to bring those together that are alike."""
    bits = (face + 0.0).view(f"u{face.itemsize}").astype(np.uint64)  # one zero, not two
    return np.dot(np.uint64(0x9E3779B97F4A7C15) ** np.arange(1, len(face) + 1, dtype=np.uint64), bits)


def _runs(face: np.ndarray, cut: np.ndarray, plane: np.ndarray) -> np.ndarray:
    """Where runs of readers with the same face and plane begin; those in CUT voxels are runs of their own."""
    changes = np.any(face[:, 1:] != face[:, :-1], axis=0) | (cut[1:] >= 0) | (plane[1:] != plane[:-1])
    return np.nonzero(np.concatenate([[len(plane) > 0], changes]))[0]


def _to_bytes(of_readers: np.ndarray) -> np.ndarray:
    """With 0 behind the last, up to whole bytes of their marks."""
    return np.pad(of_readers, (0, -len(of_readers) % 8))


def _packed_marks(code, marked: tuple, image: np.ndarray, face: np.ndarray) -> np.ndarray:
    """Who reads in each direction, as bits [N, M / 8], of the readers that are `image` in the layout."""
    ways, chunk, place, words, wanted = marked
    bits = np.zeros((len(chunk), -(-len(image) // 8)), np.uint8)
    known = _contiguous((ways, words, np.uint32(wanted), chunk, place, image.astype(np.uint32), face))
    room = np.empty(len(image), np.uint32), np.zeros(8 * bits.shape[1], np.uint8)
    code.pack(np.arange(len(chunk)), *known, *room, bits)
    return bits


def _ways(code, own: Ordinates, chunk: np.ndarray, place: np.ndarray) -> machine_code.Ways:
    """The directions in use, out of their chunks."""
    pick = lambda values, kind=float: np.asarray(values)[chunk, place].astype(kind)
    of_chunk = lambda values: np.asarray(values)[chunk].astype(int)
    return code.Ways(
        weight=pick(own.weight),
        toward=pick(own.direction),
        slope=pick(own.slope),
        start=pick(own.start),
        sense=of_chunk(own.sign),
        laps=of_chunk(own.laps),
        index=pick(own.index, int),
    )


def _medium(layout: Layout, line: _Axis, axis: int, extinction, bands: int, real: np.dtype) -> _Medium:
    from . import machine_code as code

    if extinction is None:
        count = line.shape[0]
        nothing = np.zeros((bands, 0), real)
        reader = np.zeros((bands, 0), bool), np.zeros((bands, 0))
        free = np.full((count, bands), code.EVEN), np.zeros((count, bands))
        return _Medium(False, *free, np.zeros((1, 1, 1), real), nothing, (reader, reader))
    name = "medium", axis, id(line.hits.bits)
    return keep((layout.cut_plane, extinction), name, lambda: _make_medium(line, axis, extinction, real))


def _make_medium(line: _Axis, axis: int, extinction: Float[Array, "C X Y Z"], real: np.dtype) -> _Medium:
    from . import machine_code as code

    lined_up = _planes(np.asarray(extinction), axis)
    planes = lined_up[..., : line.area]
    unlisted = line.unlisted[:, None]
    most = np.where(unlisted, planes, 0.0).max(-1)
    least = np.where(unlisted, planes, np.inf).min(-1)
    between = (unlisted & (planes > 0) & (planes < most[..., None])).any(-1)
    even = np.where(between, code.UNEVEN, np.where(least < most, code.PATCHY, code.EVEN))
    depth = np.where(between, 0.0, most).astype(float)
    number = lambda first: np.repeat(np.arange(len(first) - 1), np.diff(first))

    def of_readers(r: machine_code.Readers):
        each = planes[number(r.runs)[number(r.first)], :, r.cell[: r.first[-1]]].T.astype(float)
        least, most = (f.reduceat(each, r.first[:-1], axis=1) if r.first[-1] else each for f in (np.minimum, np.maximum))
        return least == most, np.ascontiguousarray(each)

    cut = planes[number(line.cut.first), :, line.cut.cell].T
    return _Medium(
        True, even, depth, np.zeros((1, 1, 1), real) if np.all(even == code.EVEN) else lined_up, np.ascontiguousarray(cut),
        (of_readers(line.hits), of_readers(line.probes)),
    )  # fmt: skip
