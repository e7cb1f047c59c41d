"""Sources whose light can reach nothing are refused: one inside a solid, off the lattice, or too small to have a surface.

Public: `check_sources`.
"""

from __future__ import annotations

import numpy as np

from . import checks
from .scene import OPEN, SIDES, PointLight, Scene, Sun
from .surfaces import Surfaces
from .unfolding import unfolded_axes


def check_sources(scene: Scene, surfaces: Surfaces) -> None:
    """Raise `ValueError` for a source that the scene's light can have nothing of. Traced values are not looked at."""
    for i, light in enumerate(scene.lights):
        if checks.is_traced(light):
            continue
        if isinstance(light, PointLight):
            _check_point(scene, f"lights[{i}]: position", np.asarray(light.position, float))
        elif isinstance(light, Sun):
            _check_sun(scene, f"lights[{i}]: direction", np.asarray(light.direction, float))
    found = set(np.unique(surfaces.material).tolist())
    for i, solid in enumerate(scene.solids):
        shines = not checks.is_traced(solid.emission) and checks.may_differ_from_zero(solid.emission)
        if shines and i not in found:
            checks.fail(
                f"solids[{i}]", f"an emitter ({type(solid.shape).__name__}) none of whose surface is in a voxel of the lattice",
                "a surface in the lattice, of about a voxel at least",
                f"move it into {scene.lattice.box}, make it larger than {scene.lattice.spacing:.4g}, or use rm.PointLight",
            )  # fmt: skip


def _check_point(scene: Scene, name: str, position: np.ndarray) -> None:
    if any(axis.endless for axis in unfolded_axes(scene)):
        expected = "open sides, walls, or one mirror along an axis"
        advice = "there it has images without end: use a small solid with an emission, or rm.Sun"
        checks.fail(name, "a point light between periodic sides or two mirrors", expected, advice)
    if not bool(np.all(scene.lattice.contains(position[None]))):
        checks.fail(
            name,
            position.tolist(),
            f"a point of the lattice, {scene.lattice.box}",
            "move it, enlarge the lattice, or use rm.Sun",
        )
    if scene.solids and not checks.is_traced(scene.solids):
        depth = -float(np.asarray(scene.distance(position[None].astype(np.float32)))[0])
        if depth > 0:
            got = f"{position.tolist()}, {depth / scene.lattice.spacing:.3g} voxels inside a solid"
            checks.fail(name, got, "a point outside the solids", "move it out; to make a solid shine give it an emission")


def _check_sun(scene: Scene, name: str, direction: np.ndarray) -> None:
    faced = [side for side in range(6) if (-direction if side % 2 else direction)[side // 2] > 1e-6]
    if not any(scene.boundary.sides[side] is OPEN for side in faced):
        sides = ", ".join(SIDES[side] for side in faced)
        checks.fail(
            name,
            direction.tolist(),
            f"an OPEN side that it enters by ({sides})",
            "open one in Boundary(...), or leave the sun out",
        )
