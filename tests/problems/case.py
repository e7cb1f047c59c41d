"""What a problem of the catalogue consists of: a scene of any size, what to read out of its solution, and what is known.

An error is (ours - expected) / scale, where `scale` is the expected value itself, or what the source of the numbers relates
its errors to (an incident flux, 1). The reference's own standard error, on the same scale, says how far one can look.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeAlias

import numpy as np

import raymanifold_jax as rm


class Readings(NamedTuple):
    """Numbers read out of a solution next to the expected ones, and what errors are relative to; arrays of one shape."""

    ours: np.ndarray
    expected: np.ndarray
    uncertainty: np.ndarray  # standard error of `expected`
    scale: np.ndarray

    def errors(self) -> np.ndarray:
        return (self.ours - self.expected) / self.scale

    def bias(self) -> float:
        return float(np.mean(self.errors()))

    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.errors() ** 2)))

    def worst(self) -> float:
        return float(np.abs(self.errors()).max())

    def reference_error(self) -> float:
        """Root mean square of the reference's own standard error, relative to the scale."""
        return float(np.sqrt(np.mean((self.uncertainty / self.scale) ** 2)))


def readings(ours: Any, expected: Any, uncertainty: Any = 0.0, scale: Any = None) -> Readings:
    """`Readings` of anything that broadcasts; errors are relative to the expected values if no `scale` is given."""
    ours, expected = np.asarray(ours, float), np.asarray(expected, float)
    ours, expected, uncertainty, scale = np.broadcast_arrays(ours, expected, uncertainty, expected if scale is None else scale)
    if not np.isfinite(ours).all():
        raise ValueError(f"readings: got {ours}, expected finite numbers")
    return Readings(*(np.ravel(a).astype(float) for a in (ours, expected, uncertainty, scale)))


def joined(*parts: Readings) -> Readings:
    """All readings of several kinds, each with its own scale."""
    return Readings(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class Target(NamedTuple):
    """The errors to stay below, as shares of the scale; None where nothing is asked."""

    worst: float | None = None
    rms: float | None = None
    bias: float | None = None

    def __str__(self) -> str:
        asked = [f"{name} {100 * value:.3g}%" for name, value in self._asdict().items() if value is not None]
        return ", ".join(asked) or "-"

    def met(self, got: Readings) -> bool:
        measured = (got.worst(), got.rms(), abs(got.bias()))
        return all(limit is None or value <= limit for limit, value in zip(self, measured, strict=True))


Reader: TypeAlias = Callable[[rm.Solution], dict[str, Readings]]


@dataclass(frozen=True)
class Case:
    """A problem with known answers.

    - `build(n)`: the scene with n voxels along its longest side (what else n has to be, `build` says in its error).
    - `readers`: by name, functions that take a solution to readings by the name of a quantity; each is timed by itself.
    - `sizes`: from quick to the size that the targets are meant for.
    - `targets(n)`: by the name of a quantity.
    - `errors_of`: what errors are shares of, in words.
    - `rtol`: of the solve, well below the errors to be seen.
    """

    name: str
    title: str
    build: Callable[[int], rm.Scene]
    readers: Mapping[str, Reader]
    sizes: tuple[int, ...]
    targets: Callable[[int], dict[str, Target]] = field(default=lambda n: {})
    errors_of: str = "the value"
    rtol: float = 1e-4
    directions: int = 200

    def read(self, solution: rm.Solution) -> dict[str, Readings]:
        """The readings of all readers."""
        return {name: values for reader in self.readers.values() for name, values in reader(solution).items()}


def same(**targets: Target) -> Callable[[int], dict[str, Target]]:
    """The same targets at every size; a name's underscores stand for spaces."""
    named = {name.replace("_", " "): target for name, target in targets.items()}
    return lambda n: named
