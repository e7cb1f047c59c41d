"""Fitting a scene's values to what was measured.

With parameters p (albedos, coefficients, lights) and residuals r(p) over all targets (`targets`), find

    min |r(p)|^2 / 2      within the physical range of every parameter.

Few parameters (or few residuals): Gauss-Newton with the whole Jacobian, one linear solve for each of the fewer of both, in a
trust region that stays inside the bounds (Branch, Coleman & Li, SIAM J. Sci. Comput. 21, 1999; `scipy.optimize.least_squares`).
Many: L-BFGS-B (Byrd, Lu, Nocedal & Zhu, SIAM J. Sci. Comput. 16, 1995), one solve and one transposed solve each time. Bounds
are kept exactly by both: no fit leaves the physical range. The Gauss-Newton covariance of what was found is

    C = s^2 (J'J)^-1,      s^2 = |r|^2 / (residuals that count - parameters).

Derivatives are those of the discrete problem (see `implicit`). Shapes, and directions and positions of lights, have none: what
is in front of what does not change smoothly, and a shadow's edge says nothing about the sun's direction here.

Public: `fit`, `Fit`, `Parameter`.
"""

from __future__ import annotations

import dataclasses
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from . import checks
from .prepare import prepare
from .progress import Progress, make_progress
from .quadrature import Quadrature, for_scene
from .scene import Scene
from .solution import Solution
from .solve import solve
from .targets import Target
from .texture import Texture

_FEW = 48  # Jacobian rows or columns that are worth a linear solve each


class Parameter(eqx.Module):
    """Values of a scene to be fitted.

    **Arguments:**

    - `where`: a name such as `"solids[0].albedo"`, `"boundary.z[0].albedo"`, `"medium.scattering"`, `"lights[1].irradiance"`,
      or a function from the scene to one of its arrays, as for `equinox.tree_at`. Of a `Texture` it is the values.
    - `lower`, `upper`: bounds; [0, 1] for an albedo and [0, inf) for all else if left out.
    - `start` and `expand`, together: fit values of another shape, that expand(values), a function of JAX, makes the scene's
      array of: a fog on a coarser lattice, one albedo for many walls. They begin at `start`, and bounds hold for them.
    """

    where: str | Callable[[Scene], Any] = eqx.field(static=True)
    lower: float | None = eqx.field(static=True, default=None)
    upper: float | None = eqx.field(static=True, default=None)
    start: Any = None
    expand: Callable[[Array], Array] | None = eqx.field(static=True, default=None)


@dataclasses.dataclass(frozen=True)
class Fit:
    """What a fit found.

    - `scene` with the fitted values, and its `solution`. To go on, fit this scene again.
    - `values`: the fitted values by parameter. `uncertainty`: their standard deviations (Gauss-Newton), and `covariance` of all
      of them in one, in order; None where there are too many parameters (`rm.fit(..., covariance=True)` insists).
    - `residual`: weighted rms residual of each target; `history`: that of all of them, at every evaluation.
    - `unseen`: the parameters, or which of their entries, that no target depends on.
    - `converged`, and the `reason` for which it stopped.
    """

    scene: Scene
    solution: Solution
    values: dict[str, np.ndarray]
    uncertainty: dict[str, np.ndarray] | None
    covariance: Float[np.ndarray, "p p"] | None
    residual: list[float]
    history: list[float]
    unseen: dict[str, np.ndarray]
    converged: bool
    reason: str
    evaluations: int

    def __repr__(self) -> str:
        return f"Fit({', '.join(self.values)}; rms residual {self.history[-1]:.4g} after {self.evaluations}; {self.reason})"


class _Stop(Exception):
    """Ends an optimiser from inside."""


def fit(
    scene: Scene,
    targets: Target | Sequence[Target],
    parameters: str | Parameter | Sequence[str | Parameter],
    quadrature: Quadrature | None = None,
    method: str = "auto",
    rtol: float = 1e-3,
    tolerance: float = 1e-4,
    max_evaluations: int = 60,
    target_rms: float = 0.0,
    covariance: bool | None = None,
    progress: bool | Progress | None = None,
) -> Fit:
    """Find the values of a scene that explain targets, starting from those it has.

    **Arguments:**

    - `targets`: `rm.PictureTarget`, `rm.IrradianceTarget`, `rm.FluenceTarget`, one or several.
    - `parameters`: names or `rm.Parameter`, one or several.
    - `quadrature`, `rtol`: of the solves, as for `solve`. Gradients are as exact as the solves.
    - `method`: "gauss-newton", "l-bfgs", or "auto": the first with at most 48 parameters or residuals.
    - `tolerance`: it has converged when a step changes the sum of squares by a smaller share than this squared, or the gradient
      has vanished.
    - `max_evaluations`: solves (with derivatives) at most. `target_rms`: stop as soon as the weighted rms residual is below:
      with weights 1 / sigma^2, 1 is the noise level.
    - `covariance`: whether to work out uncertainties; if None, with Gauss-Newton only.

    Parameters that no target sees are reported in `Fit.unseen`, with a warning, and stay as they are.

    **Raises** `ValueError` or `TypeError` for unusable arguments, before any work.
    """
    chosen = _Chosen(scene, parameters)
    targets = [targets] if isinstance(targets, Target) else list(targets)
    _check(scene, targets, method, tolerance, max_evaluations)
    quadrature = for_scene(scene) if quadrature is None else quadrature
    run = _Run(chosen, targets, quadrature, float(rtol), max_evaluations, float(target_rms), make_progress(progress))
    few = min(chosen.size, run.count) <= _FEW
    method = ("gauss-newton" if few else "l-bfgs") if method == "auto" else method
    with run.meter:
        run.meter.start(f"fit {chosen.size} values to {run.count}")
        unseen = run.unseen()
        converged, reason = (_gauss_newton if method == "gauss-newton" else _l_bfgs)(run, float(tolerance))
        wanted = method == "gauss-newton" if covariance is None else covariance
        matrix = _covariance(run, unseen) if wanted else None
    return run.finish(unseen, matrix, converged, reason)


def _check(scene: Any, targets: list[Any], method: str, tolerance: float, most: int) -> None:
    if not targets:
        checks.fail("targets", "none", "at least one", "pass rm.PictureTarget(camera, picture)")
    for i, target in enumerate(targets):
        checks.instance(f"targets[{i}]", target, Target, "pass rm.PictureTarget(camera, picture) and the like")
        target.check(f"targets[{i}]", scene)
    if method not in ("auto", "gauss-newton", "l-bfgs"):
        checks.fail("method", repr(method), '"auto", "gauss-newton" or "l-bfgs"', 'leave it at "auto"')
    checks.positive("tolerance", tolerance, ())
    checks.positive_int("max_evaluations", most)


class _Chosen:
    """The parameters as one vector."""

    def __init__(self, scene: Scene, parameters: Any):
        checks.instance("scene", scene, Scene, "make one with rm.Scene(lattice, solids=[...], ...)")
        given = [parameters] if isinstance(parameters, str | Parameter) else list(parameters)
        if not given:
            checks.fail("parameters", "none", "at least one", 'pass a name, as in "solids[0].albedo"')
        self.scene = scene
        self.parameters = [p if isinstance(p, Parameter) else Parameter(p) for p in given]
        self.names = [p.where if isinstance(p.where, str) else f"parameters[{i}]" for i, p in enumerate(self.parameters)]
        found = [_look_up(scene, name, p.where) for name, p in zip(self.names, self.parameters, strict=True)]
        self.where = [where for where, _ in found]
        self.start = [_start(name, p, value) for name, p, (_, value) in zip(self.names, self.parameters, found, strict=True)]
        self.size = sum(value.size for value in self.start)
        ends = np.cumsum([value.size for value in self.start])
        self.slices = [slice(end - value.size, end) for end, value in zip(ends, self.start, strict=True)]
        self.lower, self.upper = (np.concatenate(b) for b in zip(*map(self._bounds, range(len(found))), strict=True))
        outside = (self.vector < self.lower) | (self.vector > self.upper)
        if outside.any():
            at = next(i for i, s in enumerate(self.slices) if outside[s].any())
            checks.fail(self.names[at], self.start[at], "a start within the bounds", "change the scene's value, or the bounds")

    def _bounds(self, i: int) -> tuple[np.ndarray, np.ndarray]:
        parameter, value = self.parameters[i], self.start[i]
        is_albedo = self.names[i].endswith("albedo") or self.names[i].endswith("albedo.values")
        lower = 0.0 if parameter.lower is None else parameter.lower
        upper = (1.0 if is_albedo else np.inf) if parameter.upper is None else parameter.upper
        if not lower < upper:
            checks.fail(self.names[i], f"bounds {lower} and {upper}", "lower < upper", "swap them, or leave the parameter out")
        return np.full(value.size, lower), np.full(value.size, upper)

    @property
    def vector(self) -> np.ndarray:
        return np.concatenate([value.ravel() for value in self.start])

    def split(self, vector: Any) -> list[Any]:
        return [vector[s].reshape(value.shape) for s, value in zip(self.slices, self.start, strict=True)]

    def put(self, vector: Array) -> Scene:
        """The scene with these values."""
        scene = self.scene
        for where, value, parameter in zip(self.where, self.split(vector), self.parameters, strict=True):
            scene = eqx.tree_at(where, scene, value if parameter.expand is None else parameter.expand(value))
        return scene


def _start(name: str, parameter: Parameter, value: Any) -> np.ndarray:
    if (parameter.start is None) != (parameter.expand is None):
        checks.fail(name, "one of start and expand", "both or neither", "say where the values to expand begin")
    if parameter.expand is None:
        return np.asarray(value, float)
    start = np.asarray(checks.finite("start", parameter.start), float)
    found, expected = jax.eval_shape(parameter.expand, jnp.asarray(start)).shape, jnp.shape(value)
    if found != expected:
        checks.fail("expand", f"an array of shape {found}", f"{expected}, as {name} in the scene", "repeat values to fill it")
    return start


def _look_up(scene: Scene, name: str, where: Any) -> tuple[Callable, Any]:
    if isinstance(where, str):
        steps = re.findall(r"\.?([A-Za-z_]\w*)|\[(\d+)\]", where)
        if "".join(f".{a}" if a else f"[{b}]" for a, b in steps).lstrip(".") != where:
            checks.fail("parameters", repr(where), "a name of a value in the scene", 'write it as in "boundary.z[0].albedo"')

        def reach(scene: Any) -> Any:
            for attribute, index in steps:
                scene = getattr(scene, attribute) if attribute else scene[int(index)]
            return scene

    else:
        reach = where
    try:
        value: Any = reach(scene)
    except (AttributeError, IndexError, TypeError) as error:
        checks.fail("parameters", repr(name), "a value that the scene has", f"{error}: look at the scene's parts")
    if isinstance(value, Texture):
        return (lambda scene: reach(scene).values), value.values
    if not eqx.is_inexact_array(value) or not value.size:
        what = f"{name}, a {type(value).__name__}"
        advice = (
            "albedo, emission, scattering, absorption, radiance, irradiance and intensity are; shapes and directions are not"
        )
        checks.fail("parameters", what, "a value that can be fitted", advice, TypeError)
    return reach, value


class _Run:
    """Residuals and their derivatives at a vector of parameters, counted and remembered."""

    def __init__(self, chosen: _Chosen, targets: list[Target], quadrature: Quadrature, rtol, most, target_rms, meter: Progress):
        self.chosen, self.targets, self.quadrature, self.meter = chosen, targets, quadrature, meter
        self._rtol, self._most, self._target = rtol, most, target_rms
        self._prepared = prepare(chosen.scene)
        self.count = int(sum((target.weight > 0).sum() for target in targets))
        self.history: list[float] = []
        self.best = (np.inf, chosen.vector)
        self._at: tuple[np.ndarray, Any] | None = None
        self._begun = time.monotonic()

    def solution(self, vector: Any) -> Solution:
        scene = self.chosen.put(vector)
        return solve(scene, self.quadrature, rtol=self._rtol, progress=False, prepared=self._prepared)

    def residuals(self, vector: Array) -> Float[Array, " n"]:
        solution = self.solution(vector)
        return jnp.concatenate([target.residuals(solution) for target in self.targets])

    def note(self, vector: np.ndarray, squares: float) -> None:
        if not np.isfinite(squares):
            raise _Stop("failed: a residual is not finite; the best values before are kept")
        rms = float(np.sqrt(squares / max(self.count, 1)))
        self.history.append(rms)
        if squares < self.best[0]:
            self.best = squares, vector.copy()
        self.meter.update(len(self.history), rms, self._target)
        if rms <= self._target:
            raise _Stop(f"converged: rms residual {rms:.3g} is within the target {self._target:.3g}")
        if len(self.history) >= self._most:
            raise _Stop(f"stopped after {self._most} evaluations; raise max_evaluations, or fit Fit.scene again")

    def value_and_gradient(self, vector: np.ndarray) -> tuple[float, np.ndarray]:
        half = lambda x: 0.5 * jnp.sum(self.residuals(x) ** 2)
        value, gradient = jax.value_and_grad(half)(jnp.asarray(vector))
        self.note(vector, 2 * float(value))
        return float(value), np.asarray(gradient, float)

    def linearised(self, vector: np.ndarray) -> tuple[np.ndarray, Callable]:
        """Residuals, and the Jacobian's maker; kept for the last vector."""
        if self._at is None or not np.array_equal(self._at[0], vector):
            x = jnp.asarray(vector)
            if self.chosen.size <= self.count:
                residuals, push = jax.linearize(self.residuals, x)
                make = lambda: np.stack([np.asarray(push(e)) for e in jnp.eye(len(x), dtype=x.dtype)], 1)
            else:
                residuals, pull = jax.vjp(self.residuals, x)
                make = lambda: np.stack([np.asarray(pull(e)[0]) for e in jnp.eye(len(residuals), dtype=residuals.dtype)])
            self._at = vector.copy(), (np.asarray(residuals, float), make)
        return self._at[1]

    def unseen(self) -> dict[str, np.ndarray]:
        """Entries that change no residual: those without an answer to a random pull."""
        residuals, pull = jax.vjp(self.residuals, jnp.asarray(self.chosen.vector))
        signs = np.random.default_rng(0).choice([-1.0, 1.0], residuals.shape) * np.random.default_rng(1).uniform(
            0.5, 1.5, residuals.shape
        )
        answer = np.asarray(pull(jnp.asarray(signs, residuals.dtype))[0], float)
        found = {
            n: part == 0 for n, part in zip(self.chosen.names, self.chosen.split(answer), strict=True) if (part == 0).any()
        }
        for name, where in found.items():
            what = "" if where.all() else f" in {int(where.sum())} of {where.size} entries"
            warnings.warn(f"fit: no target depends on {name}{what}; it stays as it is (Fit.unseen)", stacklevel=4)
        return found

    def finish(self, unseen: dict, matrix: np.ndarray | None, converged: bool, reason: str) -> Fit:
        vector = jnp.asarray(self.best[1])
        solution = self.solution(vector)
        parts = [float(np.sqrt(np.sum(np.square(t.residuals(solution))) / (t.weight > 0).sum())) for t in self.targets]
        names, chosen = self.chosen.names, self.chosen
        by_name = lambda v: dict(zip(names, map(np.asarray, chosen.split(v)), strict=True))
        uncertainty = None if matrix is None else by_name(np.sqrt(np.diag(matrix)))
        return Fit(
            scene=chosen.put(vector), solution=solution, values=by_name(np.asarray(vector)), uncertainty=uncertainty,
            covariance=matrix, residual=parts, history=self.history, unseen=unseen, converged=converged, reason=reason,
            evaluations=len(self.history),
        )  # fmt: skip


def _gauss_newton(run: _Run, tolerance: float) -> tuple[bool, str]:
    from scipy.optimize import least_squares

    def residuals(vector):
        found = run.linearised(vector)[0]
        run.note(vector, float(np.sum(found**2)))
        return found

    jacobian: Any = lambda vector: run.linearised(vector)[1]()
    try:
        result = least_squares(
            residuals, _inside(run.chosen), jac=jacobian, bounds=(run.chosen.lower, run.chosen.upper),
            x_scale="jac", ftol=tolerance**2, xtol=tolerance**2, gtol=tolerance**2, max_nfev=10 * run._most,
        )  # fmt: skip
    except _Stop as stop:
        return str(stop).startswith("converged"), str(stop)
    return result.status > 0, _worded(result.status > 0, result.message)


def _l_bfgs(run: _Run, tolerance: float) -> tuple[bool, str]:
    from scipy.optimize import minimize

    try:
        # Scaled to begin at 1, for a tolerance on the gradient that means the same for all targets.
        first, _ = run.value_and_gradient(run.chosen.vector)
        scale = 1 / first if first > 0 else 1.0
        result = minimize(
            lambda v: tuple(scale * part for part in run.value_and_gradient(v)), run.chosen.vector, jac=True, method="L-BFGS-B",
            bounds=list(zip(run.chosen.lower, run.chosen.upper, strict=True)),
            options={"ftol": tolerance**2, "gtol": 0.01 * tolerance**2, "maxcor": 20, "maxiter": 10 * run._most},
        )  # fmt: skip
    except _Stop as stop:
        return str(stop).startswith("converged"), str(stop)
    if "ABNORMAL" in result.message:
        return False, "stopped: rounding hides further progress; raise tolerance, lower rtol, or enable float64"
    return bool(result.success), _worded(bool(result.success), str(result.message))


def _inside(chosen: _Chosen) -> np.ndarray:
    """A start off the bounds, where a trust region inside them can begin."""
    lower, upper, start = chosen.lower, chosen.upper, chosen.vector
    room = np.where(np.isfinite(upper), upper - lower, np.maximum(np.abs(start), 1.0))
    return np.clip(start, lower + 1e-3 * room, np.where(np.isfinite(upper), upper - 1e-3 * room, np.inf))


def _worded(converged: bool, message: str) -> str:
    return f"{'converged' if converged else 'not converged'}: {message.strip().rstrip('.').lower()}"


def _covariance(run: _Run, unseen: Mapping[str, np.ndarray]) -> np.ndarray:
    """C of the parameters that are seen; infinite variance for the others."""
    chosen = run.chosen
    residuals, make = run.linearised(run.best[1])
    jacobian = np.asarray(make(), float)
    blind = np.concatenate(
        [np.broadcast_to(unseen.get(n, False), v.shape).ravel() for n, v in zip(chosen.names, chosen.start, strict=True)]
    )
    free = max(run.count - int((~blind).sum()), 1)
    matrix = np.diag(np.full(chosen.size, np.inf))
    kept = jacobian[:, ~blind]
    matrix[np.ix_(~blind, ~blind)] = np.sum(residuals**2) / free * np.linalg.pinv(kept.T @ kept)
    return matrix
