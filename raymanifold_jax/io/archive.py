"""Solutions on disk: a zip archive of arrays, and a manifest in JSON that says how they make up a `Solution`.

The archive is an `.npz` that any numpy reads; nothing in it is code. Every array carries a checksum (the zip's CRC-32), and the
manifest a version of its own.

Public names: `save_solution`, `load_solution`; `write_archive`, `read_archive` for checkpoints.
"""

from __future__ import annotations

import dataclasses
import json
import os
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from .. import __version__, checks, mesh, mesh_faces, scene, shapes, skies, solution, surfaces, texture, voxels
from ..lattice import Lattice
from .exr import written_atomically

FORMAT = 1
_MANIFEST = "manifest"
_CLASSES: dict[str, type] = {
    kind.__name__: kind
    for kind in (
        Lattice, shapes.Sphere, shapes.Box, shapes.Torus, shapes.Cylinder, shapes.HalfSpace, shapes.Union, shapes.Intersection,
        shapes.Difference, shapes.Translated, shapes.Rotated, mesh.Mesh, mesh.Triangles, mesh.MeshReport, mesh_faces.FaceMap,
        voxels.Voxels,
        scene.Solid, scene.Wall, scene.Medium, scene.Sky, scene.Sun, scene.PointLight, scene.Boundary, scene.Scene,
        skies.CieSky, texture.Texture, surfaces.Surfaces, solution.Energy, solution.Solution, solution._Hidden,
    )
}  # fmt: skip


def save_solution(path: str | os.PathLike[str], what: solution.Solution) -> None:
    """Write a solution, its scene included. The file appears whole, or the old one stays.

    **Raises** `TypeError` for anything but a solution; `ValueError` for a scene with a sky that is a function or shapes of
    one's own, which no file can hold; `FileNotFoundError` if the directory is missing.
    """
    checks.instance("solution", what, solution.Solution, "pass what rm.solve(scene) returns")
    arrays: dict[str, np.ndarray] = {}
    tree = _encoded("solution", what, arrays)
    write_archive(path, "solution", {"tree": tree}, arrays)


def load_solution(path: str | os.PathLike[str]) -> solution.Solution:
    """Read what `Solution.save` wrote.

    **Raises** `FileNotFoundError`; `ValueError` for a file that is damaged, of another kind, or of a newer version.
    """
    manifest, arrays = read_archive(path, "solution")
    try:
        found = _decoded(manifest["tree"], arrays)
        if not isinstance(found, solution.Solution):
            raise TypeError(f"it holds a {type(found).__name__}")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise ValueError(
            f"path: got {os.fspath(path)!r}, whose manifest does not fit its arrays ({error}), expected what Solution.save "
            "wrote; solve again"
        ) from error
    return found


def write_archive(path: str | os.PathLike[str], kind: str, manifest: dict[str, Any], arrays: dict[str, np.ndarray]) -> None:
    """Write arrays and a manifest, whole or not at all."""
    head = {"raymanifold": kind, "format": FORMAT, "version": __version__, **manifest}
    text = np.frombuffer(json.dumps(head).encode(), np.uint8)
    with written_atomically(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **{_MANIFEST: text}, **arrays)
        stream.flush()
        os.fsync(stream.fileno())


def read_archive(path: str | os.PathLike[str], kind: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The manifest and the arrays of an archive of this kind."""
    path = Path(path)
    if not path.is_file():
        checks.fail("path", repr(str(path)), "a file that exists", "check its spelling", FileNotFoundError)
    try:
        with np.load(path, allow_pickle=False) as archive:
            if not isinstance(archive, np.lib.npyio.NpzFile):
                raise ValueError("it is no archive")
            arrays = {name: archive[name] for name in archive.files}
        manifest = json.loads(bytes(arrays.pop(_MANIFEST)))
        found, version = manifest["raymanifold"], manifest["format"]
    except Exception as error:  # zip, numpy and JSON fail in many ways
        raise ValueError(
            f"path: got {str(path)!r}, which is damaged or of another kind ({type(error).__name__}: {error}), expected a "
            f"whole {kind} file of raymanifold; copy or make it again"
        ) from error
    if found != kind:
        checks.fail("path", f"{str(path)!r}, which holds a {found}", f"a {kind}", "pass another file")
    if version != FORMAT:
        checks.fail("path", f"{str(path)!r} of format {version}", f"format {FORMAT}", "read it with the version that wrote it")
    return manifest, arrays


def _encoded(name: str, value: Any, arrays: dict[str, np.ndarray]) -> Any:
    """The value as JSON; its arrays go into `arrays`, and their names into the JSON."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray | jax.Array):
        key = f"a{len(arrays)}"
        arrays[key] = np.asarray(value)
        return {"array": key, "jax": isinstance(value, jax.Array)}
    if isinstance(value, scene.Side):
        return {"side": value.name}
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return {"tuple": [_encoded(f"{name}[{i}]", item, arrays) for i, item in enumerate(value)]}
    kind = type(value)
    if _CLASSES.get(kind.__name__) is not kind:
        advice = "sample a sky as an image; keep scenes with shapes of your own in Python"
        checks.fail(name, f"a {kind.__name__}", "what raymanifold brings along", advice)
    return {"class": kind.__name__, "fields": {k: _encoded(f"{name}.{k}", getattr(value, k), arrays) for k in _fields(kind)}}


def _decoded(tree: Any, arrays: dict[str, np.ndarray]) -> Any:
    if not isinstance(tree, dict):
        return tree
    if "array" in tree:
        return jnp.asarray(arrays[tree["array"]]) if tree["jax"] else arrays[tree["array"]]
    if "side" in tree:
        return scene.Side[tree["side"]]
    if "tuple" in tree:
        return tuple(_decoded(item, arrays) for item in tree["tuple"])
    kind = _CLASSES[tree["class"]]
    fields = {key: _decoded(tree["fields"][key], arrays) for key in _fields(kind)}
    if issubclass(kind, tuple):
        return kind(**fields)
    # As it was, without the checks and the work of its constructor.
    made = object.__new__(kind)
    for key, value in fields.items():
        object.__setattr__(made, key, value)
    return made


def _fields(kind: type) -> tuple[str, ...]:
    saved = lambda field: field.metadata.get("saved", True)
    return getattr(kind, "_fields", None) or tuple(field.name for field in dataclasses.fields(kind) if saved(field))
