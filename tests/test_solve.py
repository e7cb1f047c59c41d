"""The iteration: its certified bound, its energy balance, what it says when it stops, and that solutions are well-formed."""

import functools
import importlib
import pickle

import jax
import numpy as np
import optimistix
import problems
import pytest

import raymanifold_jax as rm

DIRECTIONS = rm.quadrature.fibonacci(60)


def random_scene(seed: int) -> rm.Scene:
    """A ball in a box with random albedos up to 0.95, emissions, half a sky, and for odd seeds a medium."""
    random = np.random.default_rng(seed)
    uniform = lambda low, high: float(random.uniform(low, high))
    wall = lambda: rm.Wall(uniform(0, 0.95), uniform(0, 1) * random.integers(2))
    medium = rm.Medium(random.uniform(0, 3, (8, 8, 8)), random.uniform(0, 0.3, (8, 8, 8)), uniform(0, 0.2))
    return rm.Scene(
        problems.cube(8),
        [rm.Solid(problems.BALL, uniform(0.5, 0.95), uniform(0, 1))],
        medium if seed % 2 else None,
        [rm.Sky(uniform(0, 2), hemisphere=random.normal(size=3))],
        rm.Boundary((wall(), wall()), (wall(), wall()), (wall(), rm.OPEN if random.integers(2) else wall())),
    )


@functools.cache
def tight_solution(seed: int) -> rm.Solution:
    return rm.solve(random_scene(seed), DIRECTIONS, rtol=1e-5, solver=rm.Jacobi(), progress=False)


SOLVERS = {
    "jacobi": rm.Jacobi(),
    "krylov": rm.Krylov(),
    "plain": rm.Krylov(diffusion=False),
    "anderson": rm.Anderson(),
    "optimistix": rm.OptimistixFixedPoint(optimistix.FixedPointIteration(rtol=1e-3, atol=1e-6)),
}


@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
@pytest.mark.parametrize("seed", range(4))
def test_error_bound_holds(seed, solver):
    # A loose solve is no further from a tight one than it certifies, in radiosity and in the medium's source times pi. The
    # tight solve's own error, 1e-5 of the largest radiosity, is allowed for.
    scene = random_scene(seed)
    loose = rm.solve(scene, DIRECTIONS, rtol=1e-2, solver=solver, progress=False)
    tight = tight_solution(seed)
    assert loose.converged and tight.converged
    assert loose.error_bound <= loose.target and tight.error_bound <= tight.target
    error = np.abs(np.asarray(loose.surfaces.radiosity) - np.asarray(tight.surfaces.radiosity)).max()
    allowed = loose.error_bound + tight.error_bound + 1e-6 * float(tight.surfaces.radiosity.max())
    assert error <= allowed
    if scene.medium is not None:
        albedo = np.asarray(scene.medium.scattering / scene.medium.extinction[..., 0])
        difference = np.abs(np.asarray(loose.fluence) - np.asarray(tight.fluence))
        assert (albedo * difference / 4).max() <= allowed


def test_error_bound_of_an_albedo_close_to_one_comes_from_paths_that_end():
    # Largest albedo 1: the simple bound, residual / (1 - albedo), is infinite. Light still ends on the other walls.
    scene = rm.Scene(
        problems.cube(8),
        [rm.Solid(problems.BALL, 1.0)],
        boundary=rm.Boundary(rm.Wall(0.5, 1.0), rm.Wall(0.3), rm.Wall(0.3)),
    )
    loose, tight = (rm.solve(scene, DIRECTIONS, rtol=rtol, progress=False) for rtol in (1e-2, 1e-5))
    assert loose.converged and np.isfinite(loose.error_bound)
    error = np.abs(np.asarray(loose.surfaces.radiosity) - np.asarray(tight.surfaces.radiosity)).max()
    assert error <= loose.error_bound + tight.error_bound


@pytest.mark.parametrize("solver", [rm.Jacobi(), rm.Krylov()], ids=["jacobi", "krylov"])
def test_sweep_limit_is_told_and_can_raise(solver):
    scene = random_scene(0)
    solution = rm.solve(scene, DIRECTIONS, solver=solver, max_sweeps=2, progress=False)
    assert not solution.converged and len(solution.history) == 2
    assert solution.error_bound > solution.target
    assert "max_sweeps" in solution.result and "rtol" in solution.result and "not converged" in solution.result
    assert solution.result in repr(solution)
    with pytest.raises(RuntimeError, match="raise max_sweeps or rtol"):
        rm.solve(scene, DIRECTIONS, solver=solver, max_sweeps=2, throw=True, progress=False)


def test_light_that_never_ends_is_refused():
    # A closed cavity of albedo 1 that emits has no steady state. Told before any work.
    scene = rm.Scene(problems.cube(8), [rm.Solid(problems.BALL, 1.0, 1.0)], boundary=problems.walls(1.0))
    with pytest.raises(ValueError, match=r"no steady state; lower an albedo below 1, add absorption, or open a side"):
        rm.solve(scene, DIRECTIONS, progress=False)


def test_a_sealed_part_of_a_scene_has_no_bound():
    # Light goes out through the open side of one half; in the other half, behind a wall of albedo 1, it never ends.
    partition = rm.Solid(rm.Box((0.375, 0, 0), (0.625, 1, 1)), 1.0, 0.0)
    sides = rm.Boundary((rm.OPEN, rm.Wall(1.0, 1.0)), rm.Wall(1.0), rm.Wall(1.0))
    scene = rm.Scene(problems.cube(8), [partition], boundary=sides)
    solution = rm.solve(scene, DIRECTIONS, progress=False, max_sweeps=40)
    assert not solution.converged and solution.error_bound == np.inf
    assert solution.ending in ("no bound", "stagnated", "sweep limit", "diverged")
    assert "without loss" in solution.result and "lower an albedo below 1" in solution.result


def test_solution_is_well_formed():
    scene = random_scene(1)
    solution = rm.solve(scene, DIRECTIONS, solver=rm.Jacobi(), progress=False)
    surfaces, elements = solution.surfaces, solution.elements
    kept = ~elements.open
    count = int(kept.sum())
    assert surfaces.positions.shape == surfaces.normals.shape == (count, 3)
    for column in (surfaces.areas, surfaces.albedo, surfaces.irradiance, surfaces.radiosity):
        assert column.shape == (count,) and column.dtype == np.float32
    emission = np.asarray(solution.emission)[0, kept]
    np.testing.assert_allclose(
        surfaces.radiosity, np.asarray(surfaces.albedo * surfaces.irradiance) + np.pi * emission, rtol=1e-6
    )
    assert solution.fluence.shape == scene.lattice.shape
    assert (np.asarray(solution.fluence) >= 0).all() and (np.asarray(surfaces.irradiance) >= 0).all()
    # Orders of bounced light shrink by at least the largest row sum, so Jacobi's history falls.
    assert (np.diff(solution.history) < 0).all()
    assert "converged" in solution.result and str(solution.sweeps) in solution.result


def test_energy_balance_counts_each_way_in_and_out():
    # A black box: what the walls emit, pi L A, they absorb; nothing leaves. Exactly known, but for the gather's share.
    black = rm.solve(
        rm.Scene(problems.cube(8), [rm.Solid(problems.BALL, 0.0)], boundary=problems.walls(0.0, 1.0)),
        DIRECTIONS,
        progress=False,
    )
    assert float(black.energy.emitted) == pytest.approx(6 * np.pi, rel=1e-5)
    assert float(black.energy.entering) == float(black.energy.leaving) == float(black.energy.absorbed_by_medium) == 0
    # A uniform sky sends pi A through each open side.
    lone = rm.solve(problems.lone_ball(0.5).scene, DIRECTIONS, progress=False)
    assert float(lone.energy.entering) == pytest.approx(6 * np.pi, rel=1e-5)
    assert abs(float(lone.energy.imbalance)) < 0.02


def _without_end(absorption) -> rm.Solution:
    sides = rm.Boundary(rm.PERIODIC, rm.PERIODIC, rm.PERIODIC)
    scene = rm.Scene(rm.Lattice((3, 4, 5)), medium=rm.Medium(0.4, absorption, 2.0), boundary=sides)
    return rm.solve(scene, DIRECTIONS, rtol=1e-10, progress=False)


def test_a_medium_without_end(x64):
    # Periodic along all axes, without any surface: the fluence is 4 pi emission / absorption, and so it is by a final gather.
    solution = _without_end(0.5)
    assert solution.converged and len(solution.surfaces.areas) == 0
    np.testing.assert_allclose(solution.fluence, 16 * np.pi, rtol=1e-8)
    np.testing.assert_allclose(rm.fluence(solution, [[1.0, 2.0, 3.0]], directions=16), 16 * np.pi, rtol=1e-6)


@pytest.mark.slow
def test_derivative_of_a_medium_without_end(x64):
    slope = jax.grad(lambda absorption: _without_end(absorption).fluence[1, 1, 1])(0.5)
    np.testing.assert_allclose(slope, -32 * np.pi, rtol=1e-6)


@pytest.mark.parametrize("medium", [None, rm.Medium(0.3, 0.1)])
def test_orders_of_bounces_add_up(x64, medium):
    """k bounces are k of Jacobi's sweeps, many are all the light; the bound tells what is missing."""
    scene = rm.Scene(problems.cube(6), [], medium, [rm.Sun((0.2, 0.3, -1))], problems.walls(0.5, 0.0, rm.OPEN))
    run = lambda **options: rm.solve(scene, rm.quadrature.fibonacci(48), progress=False, **options)
    whole = run(rtol=1e-10)
    for count in (0, 1, 3):
        some = run(bounces=count)
        assert some.ending == "as asked" and "as asked" in some.result
        gap = np.abs(whole.surfaces.radiosity - some.surfaces.radiosity).max()
        assert 0 < gap <= some.error_bound * (1 + 1e-9)
        if count:
            jacobi = run(solver=rm.Jacobi(), max_sweeps=count)
            np.testing.assert_allclose(some.surfaces.irradiance, jacobi.surfaces.irradiance, rtol=1e-12)
    np.testing.assert_allclose(run(bounces=0).diffuse_fluence, 0, atol=1e-15)
    for name in ("diffuse_irradiance", "diffuse_fluence"):
        np.testing.assert_allclose(getattr(run(bounces=40), name), getattr(whole, name), rtol=1e-8)
    assert run(bounces=2, throw=True).sweeps >= 2


def test_bad_bounces():
    scene = rm.Scene(problems.cube(4), boundary=problems.walls(0.5, 1.0))
    with pytest.raises(ValueError, match="bounces: got -1"):
        rm.solve(scene, bounces=-1)
    with pytest.raises(TypeError, match="bounces: got"):
        rm.solve(scene, bounces=1.5)


@pytest.mark.parametrize("fog", [pytest.param(False, marks=pytest.mark.slow), True])
def test_resolve_goes_on_from_the_light_that_was_found(fog):
    """Within the sum of both bounds of a solve from nothing, in fewer sweeps in all, and never in more."""
    wall = lambda albedo: rm.Wall(albedo)
    sides = lambda albedo: rm.Boundary(wall(albedo), wall(albedo), (wall(0.8), rm.OPEN))
    medium = rm.Medium(2.0, 0.1) if fog else None
    ball = rm.Solid(rm.Sphere((0.5, 0.5, 0.4), 0.2), 0.7)

    def scene(albedo, sky, sun=(0.3, 0.1, -1)):
        lights = [rm.Sky(sky), rm.Sun(sun, 2.0)]
        return rm.Scene(problems.cube(10), [ball], medium, lights, sides(albedo))

    quadrature = rm.quadrature.fibonacci(48)
    first, saved = rm.solve(scene(0.80, 1.0), quadrature, rtol=1e-4), []
    for changed in (scene(0.81, 1.0), scene(0.81, 1.1), scene(0.81, 1.1, (0.2, 0.2, -1))):
        found, alone = first.resolve(changed), rm.solve(changed, quadrature, rtol=1e-4)
        assert found.converged and found.target == pytest.approx(alone.target, rel=1e-4)
        difference = np.abs(found.surfaces.radiosity - alone.surfaces.radiosity).max()
        assert difference <= found.error_bound + alone.error_bound + 2e-6
        saved.append(alone.sweeps - found.sweeps)
        np.testing.assert_allclose(found.fluence, alone.fluence, atol=4 * (found.error_bound + alone.error_bound) + 2e-5)
        first = found
    assert min(saved) >= 0 and sum(saved) > 0
    other = rm.Scene(problems.cube(10), [rm.Solid(rm.Sphere((0.5, 0.5, 0.5), 0.2), 0.7)], medium, [rm.Sky(1.0)], sides(0.8))
    with pytest.raises(ValueError, match=r"use rm\.solve"):
        first.resolve(other)
    with pytest.raises(ValueError, match="start: got a solution of another geometry"):
        rm.solve(other, start=first)
    with pytest.raises(ValueError, match="begin with no light"):
        rm.solve(scene(0.8, 1.0), start=first, bounces=1)
    # Twice as many bands: nothing to begin with, and still right.
    coloured = first.resolve(scene(0.8, (1.0, 0.5, 0.2)))
    assert coloured.converged and coloured.fluence.shape[-1] == 3


def test_a_small_solve_keeps_its_sweeps_until_the_next(monkeypatch):
    """And for good once they were used again; a large one keeps none: each time sweeps are made is counted."""
    solve, prepare = (importlib.import_module(f"raymanifold_jax.{name}") for name in ("solve", "prepare"))
    made, make = [], solve.make_transport
    monkeypatch.setattr(solve, "make_transport", lambda *a, **k: made.append(1) or make(*a, **k))
    quadrature, ball = rm.quadrature.fibonacci(24), rm.Solid(problems.BALL, 0.5)
    scene = lambda sky: rm.Scene(problems.cube(6), [ball], lights=[rm.Sky(sky)])

    def times(call):
        made.clear()
        return call(), len(made)

    first, count = times(lambda: rm.solve(scene(1.0), quadrature))
    assert count == 1
    rm.solve(scene(1.0), quadrature)
    second, count = times(lambda: first.resolve(scene(1.5)))
    assert count == 1  # another solve came in between
    rm.solve(scene(1.0), quadrature)
    assert times(lambda: second.resolve(scene(2.0)))[1] == 0  # now they stay
    third = rm.solve(scene(1.0), quadrature)
    assert times(lambda: third.resolve(scene(1.5)))[1] == 0
    copy = pickle.loads(pickle.dumps(third))
    assert times(lambda: copy.resolve(scene(1.5)))[1] == 1  # a copy of a solution has none of that
    monkeypatch.setattr(prepare, "_SMALL", 6**3 - 1)
    large = rm.solve(scene(1.0), quadrature)
    assert times(lambda: large.resolve(scene(1.5)))[1] == 1
    assert times(lambda: large.resolve(scene(2.0)))[1] == 0


def test_suns_that_move_do_not_pile_up():
    """What is kept of a sun that moved is gone; of many suns a first solve keeps one."""
    ball, sun = rm.Solid(problems.BALL, 0.5), lambda x, y: rm.Sun((x, y, -1.0), 1.0)
    scene = lambda *suns: rm.Scene(problems.cube(6), [ball], lights=list(suns))
    of_suns = lambda solution: sum(key[0] == "sun" for key in solution._hidden.prepared._kept)
    first = rm.solve(scene(sun(0.1, 0.2), sun(0.3, 0.1), sun(0.2, 0.2)), rm.quadrature.fibonacci(24))
    assert of_suns(first) == 1
    second = first.resolve(scene(sun(0.1, 0.2), sun(0.3, 0.1)))
    third = second.resolve(scene(sun(0.2, 0.2), sun(0.4, 0.1)))
    assert of_suns(second) == of_suns(third) == 2
    alone = rm.solve(scene(sun(0.2, 0.2), sun(0.4, 0.1)), rm.quadrature.fibonacci(24))
    np.testing.assert_allclose(third.surfaces.irradiance, alone.surfaces.irradiance, atol=2e-4)
