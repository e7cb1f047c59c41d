"""The solver against published numbers, at sizes small enough for every run; at the sizes of the targets with `slow`.

`python -m benchmarks accuracy` prints the errors themselves.
"""

import problems
import pytest

import raymanifold_jax as rm


def readings(name: str, size: int, directions: int | None = None) -> dict[str, problems.Readings]:
    case = problems.CASES[name]
    scene = case.build(size)
    quadrature = rm.quadrature.for_scene(scene, directions or case.directions)
    return case.read(rm.solve(scene, quadrature, rtol=case.rtol, progress=False))


# Measured, worst error: Kobayashi 1i 0.1 %, 1f 0.1 %, Crosbie-Schrenker 0.15 %.
@pytest.mark.parametrize(
    ("name", "size", "quantity", "worst"),
    [
        ("kobayashi-1i", 10, "fluence", 0.005),
        pytest.param("crosbie-schrenker", 16, "source", 0.003, marks=pytest.mark.slow),
        pytest.param("burns-christon", 21, "div q", 0.004, marks=pytest.mark.slow),
        pytest.param("disort-1f", 32, "leaving", 0.002, marks=pytest.mark.slow),
        pytest.param("disort-1f", 32, "all levels", 0.002, marks=pytest.mark.slow),
        pytest.param("disort-9a", 84, "leaving", 0.002, marks=pytest.mark.slow),
        pytest.param("disort-9a", 84, "all levels", 0.002, marks=pytest.mark.slow),
    ],
)
def test_small(name, size, quantity, worst):
    found = readings(name, size)[quantity]
    assert found.worst() < worst, found.errors()


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in problems.CASES if name.startswith(("kobayashi", "burns", "crosbie", "disort"))]
)
def test_at_the_size_of_the_target(name):
    case = problems.CASES[name]
    size = case.sizes[-1]
    found = readings(name, size)
    for quantity, target in case.targets(size).items():
        assert target.met(found[quantity]), (quantity, found[quantity].errors())
