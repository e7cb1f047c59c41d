"""Densities from files, and media made of them. Everything here is exact to rounding."""

import contextlib
import sys
import types

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import raymanifold_jax as rm

DENSITY = np.random.default_rng(0).random((4, 5, 6))
LATTICE = rm.Lattice((4, 5, 6), 0.25)


def test_numpy_files(tmp_path):
    np.save(tmp_path / "a.npy", DENSITY)
    np.savez(tmp_path / "b.npz", smoke=DENSITY, other=DENSITY * 2)
    np.testing.assert_array_equal(rm.io.read_volume(tmp_path / "a.npy"), DENSITY)
    np.testing.assert_array_equal(rm.io.read_volume(tmp_path / "b.npz", "smoke"), DENSITY)
    with pytest.raises(ValueError, match=r"name: got no name .*expected one of smoke, other"):
        rm.io.read_volume(tmp_path / "b.npz")
    with pytest.raises(ValueError, match=r"name: got 'fire' .*expected one of smoke, other"):
        rm.io.read_volume(tmp_path / "b.npz", "fire")
    with pytest.raises(ValueError, match=r"name: got 'x'.*an \.npy file holds one array"):
        rm.io.read_volume(tmp_path / "a.npy", "x")


def test_zarr(tmp_path):
    zarr = pytest.importorskip("zarr")
    zarr.save_array(str(tmp_path / "a.zarr"), DENSITY)
    zarr.save_group(str(tmp_path / "b.zarr"), smoke=DENSITY, fire=DENSITY)
    np.testing.assert_array_equal(rm.io.read_volume(tmp_path / "a.zarr"), DENSITY)
    np.testing.assert_array_equal(rm.io.read_volume(tmp_path / "b.zarr", "fire"), DENSITY)
    with pytest.raises(ValueError, match=r"expected one of fire, smoke"):
        rm.io.read_volume(tmp_path / "b.zarr")


def test_openvdb(tmp_path):
    openvdb = pytest.importorskip("openvdb")
    grid = openvdb.FloatGrid()
    grid.copyFromArray(DENSITY)
    grid.name = "density"
    openvdb.write(str(tmp_path / "a.vdb"), grids=[grid])
    np.testing.assert_allclose(rm.io.read_volume(tmp_path / "a.vdb"), DENSITY, rtol=1e-6)


class Grid:
    """What `read_volume` asks of an OpenVDB grid, with the answers that OpenVDB 10.0.1 gives."""

    def __init__(self, name, values, background: object = 0.0):
        self.name, self.values, self.background = name, np.asarray(values, np.float32), background
        self.active = (self.values != np.asarray(background)).reshape(*self.values.shape[:3], -1).any(-1)

    def activeVoxelCount(self):
        return int(self.active.sum())

    def evalActiveVoxelBoundingBox(self):
        if not self.active.any():
            return (2**31 - 1,) * 3, (-(2**31),) * 3
        found = np.argwhere(self.active)
        return tuple(map(int, found.min(0))), tuple(map(int, found.max(0)))

    def copyToArray(self, array, ijk=(0, 0, 0)):
        if array.ndim != self.values.ndim:
            raise ValueError(f"expected {self.values.ndim}-dimensional array, found {array.ndim}-dimensional array")
        box = tuple(slice(i, i + n) for i, n in zip(ijk, array.shape[:3], strict=True))
        array[...] = self.values[box]


def test_grids_of_openvdb(tmp_path, monkeypatch):
    """By a stand-in for the module: scalars, vectors, zeros around the active voxels, empty grids and wrong names."""
    rim = np.pad(DENSITY, ((2, 1), (0, 3), (1, 0)))
    vectors = np.stack([DENSITY, 2 * DENSITY, 3 * DENSITY], -1)
    grids = {g.name: g for g in (Grid("smoke", rim), Grid("color", vectors, (0.0,) * 3), Grid("none", np.zeros((2, 2, 2))))}
    module = types.SimpleNamespace(readAllGridMetadata=lambda path: [*grids.values()], read=lambda path, name: grids[name])
    monkeypatch.setitem(sys.modules, "openvdb", module)
    path = tmp_path / "a.vdb"
    path.touch()
    np.testing.assert_allclose(rm.io.read_volume(path, "smoke"), DENSITY, rtol=1e-6)
    np.testing.assert_allclose(rm.io.read_volume(path, "color"), vectors, rtol=1e-6)
    with pytest.raises(ValueError, match=r"name: got 'none' of .*a\.vdb', which has no active voxels"):
        rm.io.read_volume(path, "none")
    with pytest.raises(ValueError, match=r"name: got no name .*expected one of smoke, color, none"):
        rm.io.read_volume(path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (np.ones((3, 3)), r"of shape \(3, 3\), expected axes x, y, z"),
        (-DENSITY, r"values of bad\.npy: got -.*expected finite numbers >= 0"),
        (np.full((2, 2, 2), np.nan), r"values of bad\.npy: got nan"),
        (np.array([object()]), r"path: got .*cannot be read"),
    ],
)
def test_values_that_are_no_density(tmp_path, values, message):
    np.save(tmp_path / "bad.npy", values)
    with pytest.raises(ValueError, match=message):
        rm.io.read_volume(tmp_path / "bad.npy")


def test_wrong_names(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"path: got .*a\.npy"):
        rm.io.read_volume(tmp_path / "a.npy")
    (tmp_path / "a.raw").write_bytes(b"")
    with pytest.raises(ValueError, match=r"a name ending in \.npy, \.npz, \.zarr, \.vdb"):
        rm.io.read_volume(tmp_path / "a.raw")


@settings(max_examples=200, deadline=None)
@given(cut=st.integers(0, 1100), junk=st.binary(max_size=20), suffix=st.sampled_from(["npy", "npz", "zarr"]))
def test_damaged_files_are_refused_or_read(tmp_path_factory, cut, junk, suffix):
    folder = tmp_path_factory.getbasetemp()
    whole = folder / "whole.npy"
    np.save(whole, DENSITY) if suffix == "npy" else np.savez(folder / "whole.npz", DENSITY)
    data = whole.read_bytes() if suffix == "npy" else (folder / "whole.npz").read_bytes()
    path = folder / f"damaged.{suffix}"
    path.write_bytes(data[:cut] + junk)
    with contextlib.suppress(ValueError, TypeError, ImportError):
        assert np.isfinite(rm.io.read_volume(path)).all()


def test_medium_is_density_times_spectrum():
    medium = rm.io.medium_from_density(DENSITY, LATTICE, scattering=(1.0, 2.0), absorption=0.5, scale=3.0)
    np.testing.assert_allclose(medium.scattering, 3 * DENSITY[..., None] * np.array((1.0, 2.0)), rtol=1e-6)
    np.testing.assert_allclose(medium.absorption, 1.5 * DENSITY, rtol=1e-6)
    assert medium.emission.ndim == 0
    assert rm.Scene(LATTICE, medium=medium).bands == 2


@settings(max_examples=100, deadline=None)
@given(
    values=arrays.arrays(float, arrays.array_shapes(min_dims=3, max_dims=3, max_side=7), elements=st.floats(0, 1e3)),
    shape=st.tuples(*[st.integers(1, 7)] * 3),
)
def test_another_shape_keeps_the_amount(values, shape):
    medium = rm.io.medium_from_density(values, rm.Lattice(shape), scattering=1.0)
    if values.any():
        assert medium.scattering.shape == shape
    np.testing.assert_allclose(np.mean(np.asarray(medium.scattering, float)), values.mean(), rtol=1e-5, atol=1e-6)


def test_density_of_a_constant_is_constant():
    medium = rm.io.medium_from_density(np.full((3, 3, 3), 2.0), LATTICE)
    np.testing.assert_allclose(medium.scattering, 2.0, rtol=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"density": DENSITY[0]}, r"density: got an array of shape \(5, 6\)"),
        ({"density": -DENSITY}, r"density: got -"),
        ({"density": DENSITY, "scale": -1}, r"scale: got -1"),
        ({"density": DENSITY, "scattering": np.ones((2, 2))}, r"scattering: got an array of shape \(2, 2\)"),
    ],
)
def test_media_that_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        rm.io.medium_from_density(lattice=LATTICE, **arguments)
