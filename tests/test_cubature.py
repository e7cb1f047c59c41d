"""Means over directions: even functions exactly, smooth ones by the cells' own error, steps by what cutting cells leaves.

Error budget: 1024 cells err by 1e-3 at most on smooth functions; with steps the standard error is 1e-3 of the mean, of which
three are allowed.
"""

import jax.numpy as jnp
import numpy as np
import pytest

from raymanifold_jax.cubature import mean_of_rays

UP = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])


def mean(function, normals, count=2):
    """Of one function of directions, and the rays it took."""
    looked = []

    def see(point, directions):
        looked.append(len(directions))
        np.testing.assert_allclose((directions**2).sum(1), 1.0, rtol=1e-12)
        return jnp.asarray(function(directions))[:, None]

    return np.asarray(mean_of_rays(see, count, normals, 1e-3))[:, 0], sum(looked)


def test_even_light_takes_no_more_rays(x64):
    for normals, halves in ((UP, 1), (None, 2)):
        found, rays = mean(lambda w: np.ones(len(w)), normals)
        np.testing.assert_allclose(found, 1.0, rtol=1e-13)
        assert rays == 2 * halves * 1024


def test_smooth_light(x64):
    # Around n the mean of (n . w)^2 by the cosine is 1/2; over the sphere that of w_z^2 is 1/3 and of w_z 0.
    # Within two of the standard errors asked for.
    for number, normal in enumerate(UP):
        found, _ = mean(lambda w, n=normal: (w @ n) ** 2, UP)
        assert found[number] == pytest.approx(0.5, rel=2e-3)
    assert mean(lambda w: w[:, 2] ** 2, None)[0] == pytest.approx(1 / 3, rel=1e-3)
    assert mean(lambda w: w[:, 2], None)[0] == pytest.approx(0.0, abs=5e-4)
    assert mean(lambda w: w[:, 0] + w[:, 1], None)[0] == pytest.approx(0.0, abs=5e-4)


@pytest.mark.parametrize("size", [0.5, 0.1])
@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_square_lamp_overhead(x64, size, turn):
    # A square at height 1 above a point on a plane, its corner straight above: four times the corner's view factor
    # (Howell, A catalog of radiation configuration factors, B-3): F = 2 (s / sqrt(1 + s^2)) atan(s / sqrt(1 + s^2)) / (2 pi).
    c, s = np.cos(turn), np.sin(turn)
    lamp = lambda w: (np.abs(c * w[:, 0] + s * w[:, 1]) < size * w[:, 2]) & (np.abs(c * w[:, 1] - s * w[:, 0]) < size * w[:, 2])
    root = size / np.sqrt(1 + size**2)
    expected = 4 * root * np.arctan(root) / np.pi
    found, rays = mean(lambda w: lamp(w) * 1.0, UP[:1], 1)
    assert found[0] == pytest.approx(expected, rel=3e-3)
    assert rays < 26000


def test_step_over_the_sphere(x64):
    axis = np.array([0.48, 0.6, 0.64])
    found, _ = mean(lambda w: 1.0 * (w @ axis > 0.4), None)
    assert found == pytest.approx(0.3, rel=3e-3)
    # In two bands the one that changes decides.
    see = lambda _, w: jnp.stack([jnp.ones(len(w)), jnp.asarray(1.0 * (w @ axis > 0.4))], 1)
    np.testing.assert_allclose(mean_of_rays(see, 1, None, 1e-3)[0], [1.0, 0.3], rtol=3e-3)
