"""The padded, unfolded lattice: fields of few voxels, spread out, say what their lists do."""

import numpy as np
import problems
import pytest

import raymanifold_jax as rm
from raymanifold_jax.prepare import prepare

_MIRRORED = rm.Boundary(x=(rm.MIRROR, rm.OPEN), y=(rm.Wall(0.5), rm.OPEN), z=rm.PERIODIC)


@pytest.mark.parametrize("solids", [[], [rm.Solid(rm.Sphere((0.5, 0.4, 0.5), 0.27), 0.5)]], ids=["empty", "a ball"])
@pytest.mark.parametrize("boundary", [problems.walls(0.5), rm.Boundary(rm.OPEN, rm.OPEN, rm.OPEN), _MIRRORED])
def test_fields_of_few_voxels(boundary, solids):
    prepared = prepare(rm.Scene(rm.Lattice((6, 5, 4), 0.2), solids=solids, boundary=boundary))
    layout, surfaces = prepared.layout, prepared.surfaces
    plane, free, image = (np.asarray(field) for field in (layout.plane, layout.free, layout.inflow_image))
    ghost = np.ones(layout.padded, bool)
    ghost[tuple(slice(p, n - p) for p, n in zip(layout.pad, layout.padded, strict=True))] = False
    np.testing.assert_array_equal(plane[:, ghost], np.repeat([[-1.0], [0.0], [0.0], [0.0]], ghost.sum(), axis=1))
    # Voxels with elements are not free; those with a single one have its plane.
    count = np.bincount(np.asarray(layout.cell), minlength=ghost.size).reshape(ghost.shape)
    np.testing.assert_array_equal(free, (count == 0) & ~ghost)
    np.testing.assert_array_equal(plane[:, free], np.repeat([[1.0], [0.0], [0.0], [0.0]], free.sum(), axis=1))
    cell, face = np.asarray(layout.cell), np.asarray(layout.face)
    single = (count.ravel()[cell] == 1) & ~ghost.ravel()[cell]
    np.testing.assert_allclose(plane.reshape(4, -1)[:, cell[single]], face[:, single], rtol=0, atol=2e-7)
    # Open ghosts: those of each image, where its open elements are.
    expected = np.full(ghost.size, -1)
    images = len(layout.unfolding.images())
    is_open = np.tile(surfaces.open, images)
    expected[cell[is_open]] = np.repeat(np.arange(images), len(surfaces))[is_open]
    np.testing.assert_array_equal(image.ravel(), expected)
    assert (image[~ghost] == -1).all() and (image >= 0).any() == any(side is rm.OPEN for side in boundary.sides)
