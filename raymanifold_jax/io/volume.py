"""Media from files: a density per voxel from `.npy`, `.npz`, zarr or OpenVDB, and a `Medium` of it.

With a density d and cross-sections a band, the medium's coefficients are

    scattering = d * scattering cross-section,    absorption = d * absorption cross-section.

Public names: `read_volume`, `medium_from_density`; `resampled` for this package.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from .. import checks
from ..lattice import Lattice
from ..scene import Medium

_FORMATS = (".npy", ".npz", ".zarr", ".vdb")


def read_volume(path: str | os.PathLike[str], name: str | None = None) -> Float[np.ndarray, "nx ny nz *bands"]:
    """The values of a volume, axes x, y, z and perhaps bands.

    **Arguments:** `path`: `.npy`, `.npz`, a `.zarr` directory or zip (needs zarr, extra `volume`), or `.vdb` (needs the
    `openvdb` module, which comes with OpenVDB; the box of the grid's active voxels, and vectors are bands). `name`: which of
    the file's arrays or grids; left out where there is one only.

    **Raises** `FileNotFoundError`; `ImportError` without the module; `ValueError` for a damaged file, a missing name, an array
    of other than 3 or 4 axes, or values that are negative or not finite; `TypeError` for values that are not real numbers.
    """
    path = Path(path)
    if not path.exists():
        checks.fail("path", repr(str(path)), "a file that exists", "check its spelling", FileNotFoundError)
    suffix = path.suffix.lower()
    if suffix not in _FORMATS:
        checks.fail("path", repr(str(path)), f"a name ending in {', '.join(_FORMATS)}", "save it with numpy.save first")
    read = {".npy": _numpy, ".npz": _numpy, ".zarr": _zarr, ".vdb": _openvdb}[suffix]
    try:
        values = read(path, name)
    except ImportError:
        raise
    except _Refused as error:
        raise ValueError(str(error)) from None
    except Exception as error:  # each reader fails in its own ways
        raise ValueError(
            f"path: got {str(path)!r}, which cannot be read ({type(error).__name__}: {error}), expected a whole {suffix} "
            "file of numbers; write or copy it again"
        ) from error
    values = np.asarray(checks.non_negative(f"values of {path.name}", values))
    if values.ndim not in (3, 4) or 0 in values.shape:
        checks.fail("path", f"{path.name} of shape {values.shape}", "axes x, y, z, and perhaps bands", "reshape it first")
    return values


def medium_from_density(
    density: Any, lattice: Lattice, scattering: Any = 1.0, absorption: Any = 0.0, emission: Any = 0.0, scale: float = 1.0
) -> Medium:
    """A medium of a density times what a unit of it scatters, absorbs and emits.

    **Arguments:**

    - `density`: (nx, ny, nz) >= 0; one of another shape than the lattice's is averaged over the lattice's voxels, or repeated.
    - `scattering`, `absorption`, `emission`: of density 1, () or (bands,), >= 0, in the units of `Medium`.
    - `scale`: a factor on the density.

    **Raises** `ValueError` for numbers or shapes outside those.
    """
    checks.instance("lattice", lattice, Lattice, "pass the scene's lattice")
    values = np.asarray(checks.non_negative("density", density))
    if values.ndim != 3 or 0 in values.shape:
        checks.fail("density", f"an array of shape {values.shape}", "shape (nx, ny, nz)", "bands belong in the coefficients")
    values = resampled(values, lattice.shape) * float(checks.non_negative("scale", scale, ()))
    parts = {}
    for key, value in {"scattering": scattering, "absorption": absorption, "emission": emission}.items():
        factor = np.asarray(checks.non_negative(key, value))
        if factor.ndim > 1:
            checks.fail(key, f"an array of shape {factor.shape}", "a number or shape (bands,)", "one number a band")
        # What is 0 everywhere stays a number, without a value for each voxel.
        parts[key] = factor if not factor.any() else values * factor if factor.ndim == 0 else values[..., None] * factor
    return Medium(**parts)


class _Refused(Exception):
    """What a reader found wrong, in the house's words."""


def _chosen(path: Path, names: list[str], name: str | None) -> str:
    if name is None and len(names) == 1:
        return names[0]
    if name not in names:
        got = "no name" if name is None else repr(name)
        raise _Refused(f"name: got {got} for {str(path)!r}, expected one of {', '.join(names) or 'none'}; say which to read")
    return name


def _numpy(path: Path, name: str | None) -> np.ndarray:
    if path.suffix.lower() == ".npy":
        if name is not None:
            raise _Refused(f"name: got {name!r} for {str(path)!r}, expected none; an .npy file holds one array without a name")
        return np.load(path, allow_pickle=False)
    if not zipfile.is_zipfile(path):
        raise ValueError("it is no zip archive")
    with np.load(path, allow_pickle=False) as archive:
        return archive[_chosen(path, list(archive.files), name)]


def _zarr(path: Path, name: str | None) -> np.ndarray:
    try:
        import zarr
    except ImportError as error:
        raise ImportError("read_volume needs zarr for .zarr; pip install 'raymanifold-jax[volume]'") from error
    node: Any = zarr.open(str(path), mode="r")
    if isinstance(node, zarr.Group):
        node = node[_chosen(path, sorted(node.array_keys()), name)]
    elif name is not None:
        raise _Refused(f"name: got {name!r} for {str(path)!r}, expected none; it holds one array without a name")
    return np.asarray(node[...])


def _openvdb(path: Path, name: str | None) -> np.ndarray:
    try:
        import openvdb  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "read_volume needs the openvdb module for .vdb; install OpenVDB with its Python bindings, or save as .npy"
        ) from error
    grids = openvdb.readAllGridMetadata(str(path))
    grid = openvdb.read(str(path), _chosen(path, [grid.name for grid in grids], name))
    if grid.activeVoxelCount() == 0:
        raise _Refused(f"name: got {grid.name!r} of {str(path)!r}, which has no active voxels; choose another grid")
    lower, upper = (np.array(corner) for corner in grid.evalActiveVoxelBoundingBox())
    values = np.zeros((*(upper - lower + 1), *np.shape(grid.background)))
    grid.copyToArray(values, ijk=tuple(int(i) for i in lower))
    return values


def resampled(values: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """Volumes (nx, ny, nz, ...) of another shape: means over the voxels of a lattice that fills the same box."""
    for axis, count in enumerate(shape):
        size = values.shape[axis]
        if size == count:
            continue
        # Integrals up to each voxel's ends, by linear interpolation of the running sum.
        running = np.concatenate([np.zeros_like(values.take([0], axis)), np.cumsum(values, axis)], axis)
        at = np.arange(count + 1) * size / count
        low = np.minimum(at.astype(int), size - 1)
        share = (at - low).reshape([-1 if a == axis else 1 for a in range(values.ndim)])
        ends = running.take(low, axis) * (1 - share) + running.take(low + 1, axis) * share
        values = np.diff(ends, axis=axis) * count / size
    return np.maximum(values, 0.0)
