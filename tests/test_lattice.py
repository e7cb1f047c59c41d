"""The lattice: positions of voxels, and refusal of what is not a lattice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from raymanifold_jax.lattice import Lattice

LATTICE = Lattice((2, 3, 4), spacing=0.5, origin=(1, -1, 0))


def test_corners_extent_and_size():
    """The box of a non-cubic lattice is shape * spacing, put at the origin given."""
    np.testing.assert_array_equal(LATTICE.lower, [1, -1, 0])
    np.testing.assert_array_equal(LATTICE.upper, [2, 0.5, 2])
    np.testing.assert_array_equal(LATTICE.extent, [1, 1.5, 2])
    assert LATTICE.size == 24


def test_centers_are_half_integers_in_voxel_coordinates():
    """Index (i, j, k) of `centers` is the centre of voxel (i, j, k): axes are x, y, z in this order."""
    centers = LATTICE.centers()
    assert centers.shape == (2, 3, 4, 3)
    assert centers.dtype == np.float64
    np.testing.assert_allclose(centers[1, 0, 2], [1.75, -0.75, 1.25], rtol=1e-15)
    indices = np.moveaxis(np.indices((2, 3, 4)), 0, -1)
    np.testing.assert_allclose(LATTICE.to_voxel(centers), indices + 0.5, rtol=1e-14)


def test_contains_is_the_closed_box():
    """Corners belong to the box, points just beyond any face do not."""
    assert LATTICE.contains(LATTICE.centers()).all()
    assert LATTICE.contains(np.stack([LATTICE.lower, LATTICE.upper])).all()
    middle, reach = (LATTICE.lower + LATTICE.upper) / 2, LATTICE.extent / 2 + 1e-9
    beyond = np.concatenate([middle + np.diag(reach), middle - np.diag(reach)])
    assert not LATTICE.contains(beyond).any()


def test_traced_points_keep_their_dtype():
    """Points may be traced, and JAX arrays come back in the dtype they had."""
    points = jnp.asarray([[1.25, -1.0, 2.0], [0.0, 0.0, 0.0]], jnp.float32)
    voxel = jax.jit(LATTICE.to_voxel)(points)
    assert voxel.dtype == jnp.float32
    np.testing.assert_allclose(voxel, [[0.5, 0, 4], [-2, 2, 0]], rtol=1e-6)
    assert jax.jit(LATTICE.contains)(points).tolist() == [True, False]


def test_is_static():
    """A lattice has no leaves and can be hashed and compared, so it can steer a compilation."""
    assert jax.tree.leaves(LATTICE) == []
    assert hash(LATTICE) == hash(Lattice((2, 3, 4), 0.5, (1, -1, 0)))
    assert Lattice((np.int64(2), 3, 4), np.float32(0.5), np.array([1, -1, 0])) == LATTICE


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"shape": 8}, ValueError, "shape: got 8"),
        ({"shape": (8, 8)}, ValueError, r"shape: got \(8, 8\)"),
        ({"shape": [8, []]}, ValueError, r"shape: got \[8, \[\]\]"),
        ({"shape": (8, 8, 0)}, ValueError, r"shape\[2\]: got 0"),
        ({"shape": (8.0, 8, 8)}, TypeError, r"shape\[0\]: got 8.0"),
        ({"shape": (8, True, 8)}, TypeError, r"shape\[1\]: got True"),
        ({"spacing": 0.0}, ValueError, "spacing: got 0.0"),
        ({"spacing": -1}, ValueError, "spacing: got -1"),
        ({"spacing": float("nan")}, ValueError, "spacing: got nan"),
        ({"spacing": (1, 1, 1)}, ValueError, "spacing"),
        ({"spacing": "wide"}, TypeError, "spacing: got wide"),
        ({"origin": (0, 0)}, ValueError, "origin"),
        ({"origin": (0, float("inf"), 0)}, ValueError, r"origin: got inf at index \(1,\)"),
    ],
)
def test_bad_input(arguments, error, message):
    """What is not a lattice is refused by name and value, with the way out after a semicolon."""
    with pytest.raises(error, match=message + ".*, expected .*; "):
        Lattice(**{"shape": (8, 8, 8), **arguments})


def test_points_of_a_wrong_shape_are_refused():
    """Points without x, y, z on the last axis are an error, in numpy and in JAX."""
    for points in (np.zeros((3, 2)), jnp.zeros((3, 2)), 1.0):
        with pytest.raises(ValueError, match="points"):
            LATTICE.to_voxel(points)
