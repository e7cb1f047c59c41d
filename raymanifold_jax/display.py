"""What notebooks show of scenes and solutions: tables of names and values.

Public for this package: `html_table`, `scene_html`.
"""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from . import checks
from .scene import SIDES, PointLight, Scene, Sky, Sun, Wall
from .skies import CieSky
from .texture import Texture

_LIGHTS = {Sky: ("radiance", "hemisphere"), Sun: ("direction", "irradiance"), PointLight: ("position", "intensity")}
_MOST = 16  # numbers shown one by one


def html_table(rows: list[tuple[str, str]]) -> str:
    """Names and what they stand for, as HTML."""
    cells = "".join(
        f"<tr><th style='text-align:left'>{escape(name)}</th><td style='text-align:left'>{escape(text)}</td></tr>"
        for name, text in rows
    )
    return f"<table>{cells}</table>"


def scene_html(scene: Scene) -> str:
    """A scene part by part."""
    lattice = scene.lattice
    size = " x ".join(map(str, lattice.shape))
    rows = [("lattice", f"{size} voxels of {lattice.spacing:.4g}, {_corners(lattice.lower, lattice.upper)}")]
    for i, solid in enumerate(scene.solids):
        where = f"{type(solid.shape).__name__}, {_corners(*solid.shape.bounds())}"
        rows.append((f"solids[{i}]", f"{where}; {_shown(solid, 'albedo', 'emission')}"))
    what = "vacuum" if scene.medium is None else _shown(scene.medium, "scattering", "absorption", "emission")
    rows.append(("medium", what))
    for i, light in enumerate(scene.lights):
        rows.append((f"lights[{i}]", f"{type(light).__name__}: {_shown(light, *_LIGHTS[type(light)])}"))
    for name, side in zip(SIDES, scene.boundary.sides, strict=True):
        rows.append((name, f"wall: {_shown(side, 'albedo', 'emission')}" if isinstance(side, Wall) else side.name.lower()))
    if scene.banded:
        rows.append(("bands", str(scene.bands)))
    return html_table(rows)


def _corners(lower: Any, upper: Any) -> str:
    low, high = (", ".join(f"{x:.4g}" for x in np.asarray(corner)) for corner in (lower, upper))
    return f"({low}) to ({high})"


def _shown(part: Any, *names: str) -> str:
    """Values by name, in short; those that are 0 or None are left out, unless it is the first."""
    texts = []
    for i, name in enumerate(names):
        value = getattr(part, name)
        if value is None:
            continue
        if isinstance(value, Texture):
            text = f"a texture of {value.values.size} numbers"
        elif isinstance(value, CieSky):
            text = f"of the CIE sky {value.kind}, {_shown(value, 'zenith', 'ground', 'sun_direction')}"
        elif callable(value):
            text = f"a {type(value).__name__}"
        elif checks.is_traced(value):
            text = "traced"
        elif np.size(value) > _MOST:
            text = f"{np.min(value):.4g} to {np.max(value):.4g} ({' x '.join(map(str, np.shape(value)))} numbers)"
        elif i and not np.any(np.asarray(value)):
            continue
        else:
            text = ", ".join(f"{x:.4g}" for x in np.asarray(value, float).ravel())
        texts.append(f"{name} {text}")
    return "; ".join(texts)
