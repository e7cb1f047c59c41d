"""What a scene costs on an array of processing elements, before anything is run.

On an array of a x b elements each element holds a block of the (u, v) plane, ceil(n_u / a) x ceil(n_v / b) columns, whole
along the sweep axis; between axes the scene is rotated (Langer, Breton & Zucker 1995, sections 7.1 and 7.2). Per element, with
C bands, s bytes a number, n planes, blocks of h x w columns, and hops of at most m nodes (M of the light ray cube; 1 for the
characteristic scheme, whose slabs are one plane thick):

    scene      n h w F s                     F numbers a node, see `numbers_per_node`
    rays       m (h + 2m)(w + 2m) C s        for each direction in flight, halo included
    updates    n h w sum over the scheme's directions, edges of the cube counted on each face
    exchanged  n C s sum over directions of  h w - max(h - |p|, 0) max(w - |q|, 0)        rays that leave their block
    rotation   n h w F s ((a - 1)/a + (b - 1)/b)    two all-to-alls, over the rows and over the columns of the array

Sizes are those of the axis with the largest blocks; `exchanged` and `updates` are sums over the three axes. The (p, q) of a
direction is its hop; in the characteristic scheme its slopes, at most one node a plane.

`exchanged` is what must go to another element. This program sends more (`sent`): the rims of a block on all sides, wherever a
direction's rays go, so that all directions of a chunk move in one message. With W x H the slots of the block in use, on the
lattice with its inert nodes (M behind, or one on either side), and r the rows that a rim passes on until every block has M
(M itself, where no block is narrower):

    light ray cube    ceil(n / M) M C s (2 r_u W + 2 r_v (H + 2M))    a direction
    characteristic    2 n C s (2 W + 2 H)                             a direction: two shifts a plane

Public: `CostReport`, `cost_report`, `numbers_per_node`, `PAPER`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from . import checks
from .arrays import real_dtype
from .blocks import even
from .layout import AXES
from .partition import SLOTS
from .quadrature import Quadrature, cube_points, fibonacci
from .scene import Scene
from .shift import halo_steps
from .transport.characteristic import Characteristic
from .transport.light_ray_cube import LightRayCube


@dataclasses.dataclass(frozen=True)
class PaperMachine:
    """The paper's own numbers: N = 128, M = 5 on a MasPar of 64 x 32 elements (sections 7.1 and 7.2)."""

    size: int = 128
    half_width: int = 5
    pe: tuple[int, int] = (64, 32)
    memory_per_element: int = 16 * 1024  # bytes
    local_transformation_seconds: float = 0.6
    rotation_seconds: float = 0.3
    iteration_seconds: float = 480.0

    @property
    def nodes_per_element(self) -> int:
        return self.size**3 // (self.pe[0] * self.pe[1])

    @property
    def updates_per_second(self) -> float:
        """Ray updates a second of one element, in what local transformation and rotations leave of an iteration."""
        rest = self.iteration_seconds - self.local_transformation_seconds - 3 * self.rotation_seconds
        return self.ray_updates / rest

    @property
    def ray_updates(self) -> int:
        """Of one element, an iteration."""
        return 6 * (2 * self.half_width + 1) ** 2 * self.nodes_per_element


PAPER = PaperMachine()


@dataclasses.dataclass(frozen=True)
class CostReport:
    """Costs of one element, in bytes and counts (module docstring). `str()` is a table.

    `seconds_on_the_paper_machine`: of an iteration, at the paper's rates: evolution, local transformation, three rotations.
    """

    scheme: str
    shape: tuple[int, int, int]
    pe: tuple[int, int]
    nodes: int
    scene_bytes: int
    ray_bytes: int  # for each direction in flight
    ray_updates: int  # an iteration
    ray_updates_once: int  # the same with each of the cube's directions swept once
    exchanged_bytes: int  # a sweep of all directions
    sent_bytes: int  # a sweep of all directions, by this program
    rotation_bytes: int
    seconds_on_the_paper_machine: float
    largest_size: int  # voxels a side that fit into the paper's 16 KB an element
    bytes_at_512: int  # an element's memory at 512 voxels a side

    @property
    def memory_per_element(self) -> int:
        """The scene and one direction's rays, in bytes."""
        return self.scene_bytes + self.ray_bytes

    def __str__(self) -> str:
        paper, seconds = PAPER, self.seconds_on_the_paper_machine
        rows = [
            ("lattice", " x ".join(map(str, self.shape)), "128 x 128 x 128"),
            ("scheme", self.scheme, "M = 5"),
            ("elements", f"{self.pe[0]} x {self.pe[1]}", "64 x 32"),
            ("nodes an element", f"{self.nodes:,}", f"{paper.nodes_per_element:,}"),
            ("memory an element", _bytes(self.memory_per_element), _bytes(paper.memory_per_element)),
            ("  its share of the scene", _bytes(self.scene_bytes), ""),
            ("  rays, one direction", _bytes(self.ray_bytes), ""),
            ("ray updates an iteration", f"{self.ray_updates:,}", f"{paper.ray_updates:,}"),
            ("  each direction once", f"{self.ray_updates_once:,}", ""),
            ("exchanged a sweep", _bytes(self.exchanged_bytes), ""),
            ("  sent by this program", _bytes(self.sent_bytes), ""),
            ("exchanged a rotation", _bytes(self.rotation_bytes), ""),
            ("iteration on that machine", f"{seconds:,.4g} s", f"{paper.iteration_seconds:g} s"),
            ("  local transformation", "", f"{paper.local_transformation_seconds:g} s"),
            ("  rotation", "", f"{paper.rotation_seconds:g} s"),
            ("largest size in 16 KB", f"{self.largest_size}^3", f"{paper.size}^3"),
            ("memory at 512^3", _bytes(self.bytes_at_512), ""),
        ]
        return "\n".join(f"{name:<28}{own:>20}{paper:>20}" for name, own, paper in [("an element", "here", "the paper"), *rows])


def numbers_per_node(bands: int, medium: bool) -> int:
    """Numbers that a sweep keeps for every node.

    Light-ray cube: normal (3), whether it is solid, exitance and arriving light of each band; with a medium also extinction,
    source and fluence. Characteristic: the surface's plane (4) in place of the first two.
    """
    return 4 + bands * (5 if medium else 2)


def cost_report(scene: Any, scheme: Any = None, pe: Any = (64, 32), quadrature: Any = None) -> CostReport:
    """What one iteration of `scheme` costs each element of an array of `pe` elements, from formulae (module docstring).

    `scheme`: `LightRayCube()` by default. `quadrature`: directions of the characteristic scheme, 200 by default.

    **Raises** `TypeError` or `ValueError` for anything else, and for more elements along an axis than there are voxels.
    """
    checks.instance("scene", scene, Scene, "make one with rm.Scene(lattice, solids=[...], ...)")
    scheme = LightRayCube() if scheme is None else scheme
    checks.instance("scheme", scheme, (LightRayCube, Characteristic), "use rm.LightRayCube() or rm.Characteristic()")
    a, b = _elements(pe)
    fewest = min(scene.lattice.shape)
    if max(a, b) > fewest:
        checks.fail("pe", (a, b), f"at most {fewest} elements a side, a voxel each", "use fewer, or more voxels")
    groups = _directions(scheme, quadrature)
    medium, bands = scene.medium is not None, scene.bands
    own = _costs(scene.lattice.shape, (a, b), groups, scheme, bands, medium)
    fits = lambda n: sum(_costs((n,) * 3, (a, b), groups, scheme, bands, medium)[1:3])
    low, high = 0, 1 << 14
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if fits(middle) <= PAPER.memory_per_element else (low, middle)
    nodes, scene_bytes, ray_bytes, updates, once, exchanged, rotation = own
    share = nodes / PAPER.nodes_per_element
    seconds = updates / PAPER.updates_per_second
    seconds += share * (PAPER.local_transformation_seconds + 3 * PAPER.rotation_seconds)
    name = f"LightRayCube({scheme.half_width})" if isinstance(scheme, LightRayCube) else "Characteristic"
    return CostReport(
        name, scene.lattice.shape, (a, b), nodes, scene_bytes, ray_bytes, updates, once, exchanged,
        _sent(scene, (a, b), groups, scheme), rotation, seconds, low, fits(512),
    )  # fmt: skip


def _elements(pe: Any) -> tuple[int, int]:
    if not (isinstance(pe, tuple | list) and len(pe) == 2):
        checks.fail("pe", pe, "elements along u and v", "pass two whole numbers, as in (64, 32)", TypeError)
    return checks.positive_int("pe[0]", pe[0]), checks.positive_int("pe[1]", pe[1])


def _directions(scheme: Any, quadrature: Any) -> list[tuple[np.ndarray, float]]:
    """For each axis its hops (n, 2), and how many of them count once: directions on edges are on several faces."""
    if isinstance(scheme, LightRayCube):
        if quadrature is not None:
            checks.fail("quadrature", quadrature, "None", "the light ray cube has its own directions: leave it out")
        points = cube_points(scheme.half_width)
        on = np.abs(points) == scheme.half_width
        return [(np.abs(points[on[:, a]][:, AXES[a][1:]]), float((1 / on.sum(1))[on[:, a]].sum())) for a in range(3)]
    quadrature = fibonacci(200) if quadrature is None else quadrature
    checks.instance("quadrature", quadrature, Quadrature, "use rm.quadrature.fibonacci(200)")
    w = np.abs(quadrature.directions)
    groups = [w[np.argmax(w, axis=1) == a] for a in range(3)]
    return [(g[:, AXES[a][1:]] / g[:, [a]], float(len(g))) for a, g in enumerate(groups)]


def _costs(shape, pe, groups, scheme, bands: int, medium: bool) -> tuple[int, int, int, int, int, int, int]:
    reach = scheme.half_width if isinstance(scheme, LightRayCube) else 1
    number = real_dtype().itemsize
    node_bytes = number * numbers_per_node(bands, medium)
    nodes, rays, updates, once, exchanged = 0, 0, 0, 0.0, 0.0
    for axis, (hops, single) in enumerate(groups):
        n, u, v = (shape[i] for i in AXES[axis])
        h, w = -(-u // pe[0]), -(-v // pe[1])
        nodes, rays = max(nodes, n * h * w), max(rays, reach * (h + 2 * reach) * (w + 2 * reach))
        updates, once = updates + n * h * w * len(hops), once + n * h * w * single
        staying = np.maximum(h - hops[:, 0] * (pe[0] > 1), 0) * np.maximum(w - hops[:, 1] * (pe[1] > 1), 0)
        exchanged += n * float((h * w - staying).sum())
    around = sum((p - 1) / p for p in pe)
    whole = lambda value: round(float(value))
    return (
        nodes, nodes * node_bytes, rays * bands * number, updates, whole(once), whole(exchanged * bands * number),
        whole(nodes * node_bytes * around),
    )  # fmt: skip


def _sent(scene: Scene, pe: tuple[int, int], groups: list[tuple[np.ndarray, float]], scheme: Any) -> int:
    """Of a sweep of all directions, once around periodic axes."""
    cube = isinstance(scheme, LightRayCube)
    reach, margin = (scheme.half_width,) * 2 if cube else (1, 2)
    shape = scene.lattice.shape
    lattice = [n if periodic else n + margin for n, periodic in zip(shape, scene.boundary.periodic, strict=True)]
    sent = 0
    for axis, (hops, _) in enumerate(groups):
        blocks = [even(lattice[a], parts, least) for a, parts, least in zip(AXES[axis][1:], pe, SLOTS, strict=True)]
        rows, columns = (sum(halo_steps([int(n) for n in (block >= 0).sum(1)], reach)) for block in blocks)
        height, width = (block.shape[1] for block in blocks)
        if cube:
            steps, rims = -(-shape[axis] // reach) * reach, rows * width + columns * (height + 2 * reach)
        else:
            steps, rims = 2 * shape[axis], rows * width + columns * height
        sent += len(hops) * steps * 2 * rims
    return sent * scene.bands * real_dtype().itemsize


def _bytes(size: float) -> str:
    for unit, scale in (("GB", 2**30), ("MB", 2**20), ("KB", 2**10)):
        if size >= scale:
            return f"{size / scale:.4g} {unit}"
    return f"{size:.0f} B"
