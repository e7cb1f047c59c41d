"""The estimated error against the true one, where the answer is known."""

import numpy as np
import problems
import pytest

import raymanifold_jax as rm


def brackets(estimate: rm.ErrorEstimate, exact: np.ndarray, at_most: float) -> None:
    """The true error is no more than the estimate, and the estimate no more than so many times as large."""
    true = float(np.sqrt(np.mean((estimate.values - exact) ** 2)))
    assert true <= estimate.rms <= at_most * true, (true, str(estimate))


@pytest.mark.slow
def test_room_with_its_ceiling_alight():
    # Scene A of the rendered references at 16^3; their own error is 0.1 %.
    rows = problems.probes("A")["probes"][::4]
    column = lambda name: np.array([row[name] for row in rows])
    estimate = rm.estimate_error(rm.scenes.room(16), column("position"), column("normal"), rm.quadrature.fibonacci(100))
    brackets(estimate, column("irradiance"), 8)
    assert "error about" in str(estimate) and estimate.solution.converged


@pytest.mark.slow
def test_fog():
    # Scene C of the rendered references at 16^3, fluence; their own error is 0.3 %.
    rows = problems.probes("C")["fluence"]
    positions = np.array([row["position"] for row in rows])
    estimate = rm.estimate_error(rm.scenes.three_balls_in_fog(16), positions, quadrature=rm.quadrature.fibonacci(100))
    brackets(estimate, 4 * np.pi * np.array([row["mean_radiance"] for row in rows]), 20)


def test_furnace_has_no_error_but_the_iterations():
    problem = problems.furnace("box", 0.5)
    estimate = rm.estimate_error(problem.scene, quadrature=rm.quadrature.fibonacci(40), rtol=1e-5)
    # Every set of directions and every voxel size gives the same, to rounding.
    assert estimate.relative < 1e-4
    assert len(estimate.values) > 30


def test_bad_input():
    odd = rm.Scene(rm.Lattice((5, 4, 4)), boundary=rm.Boundary(*[rm.Wall(0.5, 1.0)] * 3))
    with pytest.raises(ValueError, match=r"lattice.shape: got \(5, 4, 4\), expected even numbers"):
        rm.estimate_error(odd)
    with pytest.raises(ValueError, match="points: got None, expected points, as the scene has no surfaces"):
        rm.estimate_error(rm.Scene(rm.Lattice((4, 4, 4)), lights=[rm.Sky()]))
