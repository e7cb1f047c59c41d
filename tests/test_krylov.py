"""GMRES on small systems whose solution is known: it is found, and the residual that is carried on is that of the light."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from raymanifold_jax.krylov import Subspace, linear_solve, norm
from raymanifold_jax.operator import Light

ELEMENTS, VOXELS = 7, 2


class _System:
    """A random K of the largest eigenvalue `radius`, between elements and, with a medium, 2 x 2 x 2 voxels."""

    def __init__(self, radius: float, medium: bool):
        self.medium = medium
        self.size = ELEMENTS + medium * VOXELS**3
        matrix = np.random.default_rng(3).uniform(size=(self.size, self.size))
        self.matrix = matrix * radius / abs(np.linalg.eigvals(matrix)).max()
        self.right = np.random.default_rng(4).uniform(-1, 1, self.size)

    def light(self, values: np.ndarray) -> Light:
        voxels = jnp.asarray(values[ELEMENTS:]).reshape(1, *(VOXELS,) * 3) if self.medium else None
        return Light(jnp.asarray(values[:ELEMENTS])[None], voxels)

    def values(self, light: Light) -> np.ndarray:
        return np.concatenate([np.asarray(part).ravel() for part in jax.tree.leaves(light)])

    def bounce(self, light: Light) -> Light:
        return self.light(self.matrix @ self.values(light))


@pytest.mark.parametrize("restart", [1, 3, 4, 5, 12])
@pytest.mark.parametrize(("radius", "medium"), [(0.3, True), (0.9, True), (0.9, False)])
def test_solutions_are_found_from_any_restart(x64, radius, medium, restart):
    # Error budget: 1e-10 of the right side, times what (I - K)^-1 makes of it at most (here 30), and rounding.
    system = _System(radius, medium)
    right = system.light(system.right)
    target = 1e-10 * float(norm(right))
    good = lambda residual: float(norm(residual)) <= target
    found, residual, _ = linear_solve(system.bounce, right, good=good, most=400, restart=restart)
    exact = np.linalg.solve(np.eye(system.size) - system.matrix, system.right)
    np.testing.assert_allclose(system.values(found), exact, rtol=0, atol=1e-8)
    carried = system.right - system.values(found) + system.matrix @ system.values(found)
    np.testing.assert_allclose(system.values(residual), carried, rtol=0, atol=1e-13)


@pytest.mark.parametrize("medium", [True, False])
def test_with_a_medium_it_begins_anew_where_it_converges_quickly(x64, medium):
    for radius, slow in ((0.05, False), (8.0, True)):  # one dominates: the others are as large as 1 in the second
        system = _System(radius, medium)
        space = Subspace(lambda z: (z, system.bounce(z)), system.light(system.right), 6, lambda light: light)  # noqa: B023
        start = float(norm(space.residual))
        count = 0
        while not space.done:
            space.step()
            count += 1
            if count >= 4 and medium:
                assert space.done == (count == 6 or float(norm(space.residual)) <= 0.5**count * start)
        assert count == (6 if slow or not medium else 4)
