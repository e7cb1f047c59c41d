"""The colours a mesh file has, as albedos of its triangles: of faces, of vertices, or of a picture laid on them.

Public name: `read_face_colors`.
"""

from __future__ import annotations

import os
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import checks
from ..mesh import has_area, read_triangles

_SPLIT = 6  # points along a triangle's side at which its picture is looked at


def read_face_colors(path: str | os.PathLike[str]) -> Float[np.ndarray, "F 3"]:
    """R, G and B in [0, 1] of every triangle of a file, in the order of `rm.Mesh.load(path).faces`, for `rm.Texture.on_faces`.

    Colours in files are taken as sRGB and made linear; of a picture each triangle has the mean.

    **Raises** `ValueError` for a file without colours, and what `rm.Mesh.load` raises.
    """
    loaded = read_triangles(path)
    vertices, faces = np.asarray(loaded.vertices, float), np.asarray(loaded.faces)
    kind, found = getattr(loaded.visual, "kind", None), None
    if kind == "texture":
        found = _of_picture(loaded.visual, faces)
    elif kind == "face":
        found = _linear(np.asarray(loaded.visual.face_colors)[:, :3])
    elif kind == "vertex":
        found = _linear(np.asarray(loaded.visual.vertex_colors)[:, :3])[faces].mean(1)
    if found is None:
        advice = "give one albedo, or rm.Texture.on_faces(mesh, values)"
        checks.fail("path", f"{os.fspath(path)!r} without colours", "colours of faces or vertices, or a picture", advice)
    return found[has_area(vertices, faces)]


def _of_picture(visual: Any, faces: np.ndarray) -> np.ndarray | None:
    material = visual.material
    image = getattr(material, "baseColorTexture", None)
    image = getattr(material, "image", None) if image is None else image
    if image is None or visual.uv is None:
        flat = getattr(material, "main_color", None)
        return None if flat is None else np.tile(_linear(np.asarray(flat)[:3]), (len(faces), 1))
    picture = _linear(np.asarray(image.convert("RGB")))
    height, width = picture.shape[:2]
    # Middles of the small triangles that the sides' equal parts make.
    i, j = np.divmod(np.arange(_SPLIT**2), _SPLIT)
    b, c = (i + 1 / 3) / _SPLIT, (j + 1 / 3) / _SPLIT
    over = i + j >= _SPLIT
    b, c = np.where(over, 1 - b, b), np.where(over, 1 - c, c)
    share = np.stack([1 - b - c, b, c], -1)
    uv = np.einsum("sk,fkd->fsd", share, np.asarray(visual.uv, float)[faces])
    # Pictures repeat; v grows upwards, rows downwards.
    column = np.floor(uv[..., 0] % 1 * width).astype(int).clip(0, width - 1)
    row = np.floor((1 - uv[..., 1] % 1) * height).astype(int).clip(0, height - 1)
    return picture[row, column].mean(1)


def _linear(values: np.ndarray) -> np.ndarray:
    """sRGB bytes as linear numbers (IEC 61966-2-1)."""
    x = np.asarray(values, float) / 255
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
