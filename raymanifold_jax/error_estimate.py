"""How far off a solution is: from the iteration, the directions and the voxels, each by solving again.

A scene is solved three times: as asked, with twice the directions (of another set: rotated), and with voxels of twice the side.
Where errors fall with the number of directions N as N^-p and with the voxel's side h as h^q, the solution asked for differs
from the exact one by about

    angle:  |f(N) - f(2N)| / (1 - 2^-p),        space:  |f(h) - f(2h)| / (2^q - 1),

with p = 3/4 and q = 1, the lowest orders seen. Of these differences the root mean square over all points is what to rely on; at
one point they may be small by chance. The iteration's share is the certified bound.

Public: `ErrorEstimate`, `estimate_error`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from . import checks
from .gather import fluence, irradiance
from .lattice import Lattice
from .quadrature import Quadrature, for_scene
from .scene import MIRROR, PERIODIC, Medium, Scene
from .solution import Solution
from .solve import solve
from .surfaces import find_surfaces

_ANGLE = 1 / (1 - 2**-0.75)
_SPACE = 1.0
_PROBES = 64


@dataclasses.dataclass(frozen=True)
class ErrorEstimate:
    """Values at some points, and how far they may be from the exact ones; all in W m^-2, (n, *bands).

    - `values`: irradiance, or fluence where no normals were given.
    - `angle`, `space`: the estimates at each point; `iteration`: the certified bound, everywhere, inf if there is none.
    - `rms`: all together, over all points; `relative`: that over the root mean square of the values.
    - `solution`: the solve that was asked for.
    """

    values: Float[np.ndarray, "n *bands"]
    angle: Float[np.ndarray, "n *bands"]
    space: Float[np.ndarray, "n *bands"]
    iteration: float
    solution: Solution

    @property
    def rms(self) -> float:
        parts = [np.sqrt(np.mean(part**2)) for part in (self.angle, self.space)]
        return float(np.sqrt(sum(part**2 for part in parts)) + self.iteration)

    @property
    def relative(self) -> float:
        size = float(np.sqrt(np.mean(self.values**2)))
        return self.rms / size if size > 0 else 0.0

    def __str__(self) -> str:
        size = max(float(np.sqrt(np.mean(self.values**2))), 1e-300)
        share = lambda part: f"{100 * float(np.sqrt(np.mean(np.square(part)))) / size:.2g} %"
        parts = ", ".join(f"{name} {share(getattr(self, name))}" for name in ("angle", "space", "iteration"))
        return f"error about {share(self.rms)} of the values at {len(self.values)} points ({parts})"


def estimate_error(
    scene: Scene,
    points: Any = None,
    normals: Any = None,
    quadrature: Quadrature | None = None,
    rtol: float = 1e-4,
    progress: bool | None = None,
) -> ErrorEstimate:
    """Estimate the error of `rm.solve(scene, quadrature, rtol=rtol)`, at about twice the cost of a solve more.

    **Arguments:** `points` (n, 3) with `normals` (n, 3) on surfaces, for irradiance; without normals in free space, for
    fluence; by default the middles of 64 surface elements, drawn evenly by area.

    **Raises** `ValueError` for a lattice whose numbers of voxels are not even (1 is allowed along periodic axes and between
    mirrors, without solids), for a scene without surfaces if no points are given, and for what `rm.solve` refuses.
    """
    checks.instance("scene", scene, Scene, "make one with rm.Scene(lattice, solids=[...], ...)")
    coarse = _coarser(scene)
    if points is None:
        points, normals = _probes(scene)
    first = for_scene(scene) if quadrature is None else quadrature
    finer = for_scene(scene, 2 * len(first)).rotate(_turn(scene))
    read = lambda solution: np.asarray(fluence(solution, points) if normals is None else irradiance(solution, points, normals))
    solution = solve(scene, first, rtol=rtol, progress=progress)
    values = read(solution)
    more_directions = read(solve(scene, finer, rtol=rtol, progress=progress))
    larger_voxels = read(solve(coarse, first, rtol=rtol, progress=progress))
    # No radiosity is off by more than the bound; fluence is 4 times a radiosity's worth of mean radiance.
    iteration = solution.error_bound * (4 if normals is None else 1)
    return ErrorEstimate(
        values, _ANGLE * np.abs(values - more_directions), _SPACE * np.abs(values - larger_voxels), iteration, solution
    )


def _turn(scene: Scene) -> np.ndarray:
    """A rotation that takes no direction of a set to another's place; none next to mirrors, whose symmetry it would break."""
    if MIRROR in scene.boundary.sides:
        return np.eye(3)
    a, b = 0.7, 0.4
    about_z = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    about_x = np.array([[1, 0, 0], [0, np.cos(b), -np.sin(b)], [0, np.sin(b), np.cos(b)]])
    return about_x @ about_z


def _probes(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    surfaces = find_surfaces(scene)
    (closed,) = np.nonzero(~surfaces.open & (surfaces.area > 0))
    if not len(closed):
        checks.fail("points", None, "points, as the scene has no surfaces", "pass points=[[x, y, z], ...] in free space")
    share = np.cumsum(surfaces.area[closed]) / surfaces.area[closed].sum()
    chosen = closed[np.unique(np.searchsorted(share, (np.arange(_PROBES) + 0.5) / _PROBES))]
    return surfaces.position[chosen], surfaces.normal[chosen]


def _coarser(scene: Scene) -> Scene:
    """The scene on voxels of twice the side."""
    lattice, sides = scene.lattice, scene.boundary.sides
    unbounded = [all(side in (PERIODIC, MIRROR) for side in sides[2 * a : 2 * a + 2]) for a in range(3)]
    kept = [n == 1 and unbounded[a] and not scene.solids for a, n in enumerate(lattice.shape)]
    if any(n % 2 and not keep for n, keep in zip(lattice.shape, kept, strict=True)):
        checks.fail(
            "lattice.shape", lattice.shape, "even numbers of voxels", "make them even: voxels are doubled for comparison"
        )
    shape = [n if keep else n // 2 for n, keep in zip(lattice.shape, kept, strict=True)]
    coarse = eqx.tree_at(lambda s: s.lattice, scene, Lattice(shape, 2 * lattice.spacing, lattice.origin))
    if scene.medium is None:
        return coarse
    fields = (scene.medium.scattering, scene.medium.absorption, scene.medium.emission)
    return eqx.tree_at(lambda s: s.medium, coarse, Medium(*(_means(f, lattice.shape, shape) for f in fields)))


def _means(field: Any, fine: tuple[int, ...], coarse: list[int]) -> Any:
    """Means over the voxels that become one; what is the same everywhere stays."""
    if field.ndim < 3:
        return field
    parts = [size for n, m in zip(fine, coarse, strict=True) for size in (m, n // m)]
    return jnp.mean(field.reshape(*parts, *field.shape[3:]), axis=(1, 3, 5))
