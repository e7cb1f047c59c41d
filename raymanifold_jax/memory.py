"""How much memory a solve takes, and how much there is. Host memory only: an accelerator's own is left out.

The need in bytes, with V voxels (a layer of ghosts included), C bands, E surface elements and D directions:

    need = PROGRAM + C BAND + 4 V (GEOMETRY + C (FIELDS + cores)) + 4 P cores ROWS + E (ELEMENT + C D) + links

P is the voxels of the largest plane, of which each core keeps rays. C D: the bits that say which directions hit an element.
Without a medium there are also links from element to element (see `transport.links`), at most LINKS E D and usually half of
that, if these are not more than MOST_LINKS. Of fields that are LARGE only HELD are there at a time, as what is freed is given
back (`give_back_freed`). Where sweeps are XLA's (see `transport.native`), it is not between them, there are SWEEPS bytes and
BUFFERS words a voxel more, and the links are longer on their way. The constants are for 32-bit numbers; with them the peaks of
ring and three balls (32 to 160 cubed), the room (32, 64) and the Cornell box (32) come out within 20 %, of first and of later
starts. The two processes that compile loops at the very first (`transport.machine_code`) are not counted.

Public names: `estimate_memory`, `available_memory`, `check_memory`, `give_back_freed`, `gigabytes`.
"""

import ctypes
import functools
import importlib.util
import os
from collections.abc import Callable
from pathlib import Path

from .threads import count_cores

PROGRAM = 485_000_000  # Python, JAX, programs; a first start, which compiles them, takes 0 to 170 MB more
SWEEPS = 150_000_000  # compilation of XLA's sweeps
BAND = 40_000_000  # work arrays of a batch
GEOMETRY = 30  # words a voxel: the samples of the signed distance, copies turned to each axis
FIELDS_VACUUM = 11  # words a voxel and band: sums of a sweep, fluence of sun, sky and bounces
FIELDS_MEDIUM = 56  # the same, coefficients, source, the multigrid's, and the iteration's unknowns of many sweeps
BUFFERS = 32  # words a voxel
ROWS = 20  # planes of rays: of four directions and what they need while they pass four at a time
LINKS = 13  # bytes an element and direction, half of which come from behind it, while they are sorted; 8 of 20 remain
MOST_LINKS = 1 << 30  # bytes: more are not made
LARGE = 1 << 22  # bytes of an array: smaller ones are not worth giving back
HELD = 0.55  # of large fields' memory, beside all that ever is allocated
ELEMENT = 1000  # bytes an element: its rows in each axis's reads, position, material

Shape = tuple[int, int, int]


def estimate_memory(scene_shape: Shape, bands: int, directions: int, medium: bool, elements: int | None = None) -> int:
    """Bytes that a solve takes at its peak (module docstring).

    `scene_shape`: voxels along x, y, z. `medium`: whether there is one. `elements`: left out, half as many again as
    the domain's six sides have.
    """
    nx, ny, nz = scene_shape
    if elements is None:
        elements = 3 * (nx * ny + ny * nz + nz * nx)
    cores = count_cores()
    fields = GEOMETRY + bands * ((FIELDS_MEDIUM if medium else FIELDS_VACUUM) + cores)
    links = 0 if medium else LINKS * elements * directions
    links = links // 2 if links <= MOST_LINKS else 0
    program = PROGRAM
    if importlib.util.find_spec("numba") is None:
        program, fields, links = PROGRAM + SWEEPS, fields + BUFFERS, 4 * links
    elif _trim() is not None and 4 * bands * nx * ny * nz >= LARGE:
        fields *= HELD
    voxels = (nx + 2) * (ny + 2) * (nz + 2)
    rays = cores * ROWS * voxels // (min(scene_shape) + 2)
    return program + bands * BAND + int(4 * (voxels * fields + rays)) + elements * (ELEMENT + bands * directions) + links


def available_memory() -> int | None:
    """Bytes this process can still take: what the machine has left, or its control group if that is less.

    Where only the machine's whole memory is known, that; None where nothing is.
    """
    return min((size for size in (_machine(), *_control_groups()) if size is not None), default=None)


def check_memory(scene_shape: Shape, bands: int, directions: int, medium: bool, elements: int | None = None) -> None:
    """Raise `ValueError` if a solve (arguments of `estimate_memory`) needs more memory than is available."""
    available = available_memory()
    need = estimate_memory(scene_shape, bands, directions, medium, elements)
    if available is None or need <= available:
        return
    longest = max(scene_shape)
    low, high = 0, longest  # the longest side that fits, by halving
    while high - low > 1:
        side = (low + high) // 2
        nx, ny, nz = (max(1, n * side // longest) for n in scene_shape)
        fits = estimate_memory((nx, ny, nz), bands, directions, medium) <= available
        low, high = (side, high) if fits else (low, side)
    advice = f"{low} voxels on the longest side would fit" if low else "free some memory, or use a larger machine"
    got = f"{' x '.join(map(str, scene_shape))} voxels, which need about {gigabytes(need)}"
    raise ValueError(f"size: got {got}, expected at most the {gigabytes(available)} available; {advice}")


def give_back_freed(size: int) -> None:
    """Give memory that was freed back to the system, where arrays have this `size` in bytes and it is worth its milliseconds.

    The C library keeps what lies between arrays still in use, and each thread what it used: a quarter of a large solve's peak.
    """
    trim = _trim()
    if trim is not None and size >= LARGE:
        trim(0)


@functools.cache
def _trim() -> Callable[[int], int] | None:
    """glibc's `malloc_trim`; None where there is another C library."""
    try:
        trim = ctypes.CDLL(None).malloc_trim
        trim.argtypes = [ctypes.c_size_t]
        return trim
    except (AttributeError, OSError, TypeError):
        return None


def gigabytes(size: float) -> str:
    """`size` in bytes, as text."""
    return f"{size / 1e9:.2f} GB" if size < 1e11 else f"{size / 1e9:.3g} GB"


def _machine() -> int | None:
    for line in _read(Path("/proc/meminfo")).splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    names = ("SC_PHYS_PAGES", "SC_PAGE_SIZE")
    if not set(names) <= set(getattr(os, "sysconf_names", ())):
        return None
    pages, size = (os.sysconf(name) for name in names)
    return pages * size if pages > 0 else None


def _control_groups(root: Path = Path("/sys/fs/cgroup"), own: Path = Path("/proc/self/cgroup")) -> list[int]:
    """What is left in this process's control groups, of version 2 or 1, and in those around them."""
    left = []
    for line in _read(own).splitlines():
        _, controllers, path = line.split(":", 2)
        if controllers and "memory" not in controllers.split(","):
            continue
        v1 = bool(controllers)
        top = root / "memory" if v1 else root
        names = ("memory.limit_in_bytes", "memory.usage_in_bytes") if v1 else ("memory.max", "memory.current")
        group = top / path.lstrip("/")
        for folder in (group, *group.parents):
            limit, usage = (_read(folder / name).strip() for name in names)
            if limit.isdigit() and usage.isdigit():  # else "max", or no such file
                # Pages of files count as used, and are given up when needed.
                stat = dict(row.split(maxsplit=1) for row in _read(folder / "memory.stat").splitlines())
                left.append(max(0, int(limit) - int(usage) + int(stat.get("inactive_file", 0))))
            if folder == top:
                break
    return left


def _read(path: Path) -> str:
    try:
        return path.read_text()
    except OSError:
        return ""
