"""What a solve returns: the light everywhere, and how far it can be trusted.

Public: `Solution`, `SurfaceTable`, `Energy`.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from .programs import program
from .scene import Scene
from .surfaces import Surfaces

if TYPE_CHECKING:
    from .prepare import Prepared
    from .quadrature import Quadrature
    from .spectra import Bands


class SurfaceTable(NamedTuple):
    """One row for each surface element, in scene units and W m^-2; trailing band axis where the scene has bands."""

    positions: Float[jax.Array, "E 3"]
    normals: Float[jax.Array, "E 3"]
    areas: Float[jax.Array, " E"]
    albedo: Float[jax.Array, " E *bands"]
    irradiance: Float[jax.Array, " E *bands"]
    radiosity: Float[jax.Array, " E *bands"]


class Energy(NamedTuple):
    """Where the power goes, in W (all bands together).

    `emitted` by surfaces, medium and point lights plus `entering` through open sides from sky and suns should equal
    `absorbed_by_surfaces` plus `absorbed_by_medium` plus `leaving` through open sides. `imbalance` is the difference over
    the power put in.
    """

    emitted: Float[jax.Array, ""]
    entering: Float[jax.Array, ""]
    absorbed_by_surfaces: Float[jax.Array, ""]
    absorbed_by_medium: Float[jax.Array, ""]
    leaving: Float[jax.Array, ""]

    @property
    def imbalance(self) -> Float[jax.Array, ""]:
        return _imbalance(*self)


@program
def _imbalance(emitted, entering, *taken) -> Float[jax.Array, ""]:
    put_in = emitted + entering
    return (put_in - sum(taken)) / jnp.where(put_in > 0, put_in, 1.0)


@dataclasses.dataclass(frozen=True)
class _Hidden:
    """Static data that jit compares by identity."""

    surfaces: Surfaces
    # For the next solve (`Solution.resolve`); not saved.
    prepared: Prepared | None = dataclasses.field(default=None, metadata={"saved": False})
    quadrature: Quadrature | None = dataclasses.field(default=None, metadata={"saved": False})
    options: Mapping[str, Any] | None = dataclasses.field(default=None, metadata={"saved": False})

    def __hash__(self) -> int:
        return id(self.surfaces)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Hidden) and other.surfaces is self.surfaces


class Solution(eqx.Module):
    """The light in a scene.

    - `fluence`: (nx, ny, nz[, bands]), W m^-2, the mean over the part of each voxel outside solids; 0 inside.
    - `surfaces`: positions, normals, areas, albedo, irradiance, radiosity, one row for each element.
    - `energy`: the power balance and its imbalance.
    - `error_bound`: certified: no radiosity, and no medium source times pi, is further than this from the exact solution of
      the discrete problem (in radiosity units; rounding apart). inf where no bound is known, nan under `jit` and `vmap`.
    - `sweeps`: applications of the transport operator on the full lattice. `history`: the largest residual after each
      iterate, in radiosity units. `ending`: "converged", "sweep limit", "stagnated", "diverged", "no bound" or, with `bounces`,
      "as asked"; `result`: the same in a sentence, with advice; `converged`: whether the bound met the tolerance; `solver`:
      which one it was.
    - `rounding`: what the float type's rounding in the sweeps may add to the error, in radiosity units; an estimate.
    - `no_bound`: why there is no error bound; empty where there is one.
    - `diffuse_*` and `sun_*`: (bands, ...), the light of the suns' direct beams, and all other light.
    """

    scene: Scene
    diffuse_irradiance: Float[jax.Array, "C E"]
    sun_irradiance: Float[jax.Array, "C E"]
    diffuse_fluence: Float[jax.Array, "C nx ny nz"]
    sun_fluence: Float[jax.Array, "C nx ny nz"]
    free: Float[jax.Array, "nx ny nz"]
    albedo: Float[jax.Array, "C E"]
    emission: Float[jax.Array, "C E"]
    energy: Energy
    error_bound: float = eqx.field(static=True)
    target: float = eqx.field(static=True)
    history: np.ndarray
    sweeps: int = eqx.field(static=True)
    ending: str = eqx.field(static=True)
    solver: str = eqx.field(static=True)
    rounding: float = eqx.field(static=True)
    no_bound: str = eqx.field(static=True)
    _hidden: _Hidden = eqx.field(static=True)

    def resolve(self, scene: Scene, **options: Any) -> Solution:
        """Solve for other lights, albedos, emissions or medium in the same geometry, from this solution on.

        What depends on the geometry alone is not done again, and the iteration starts from this light; the directions, the
        scheme and `rtol` stay what they were unless `options`, which are those of `rm.solve`, say otherwise. A solve of more
        than a million voxels and bands lets go what it has made (who sees whom; see `rm.solve`, `prepared`), a smaller one when
        another scene is solved; then the first call makes it anew. From then on it is kept.

        **Raises** `ValueError` for a scene with another lattice, other shapes or other kinds of sides.
        """
        from .solve import resolve

        return resolve(self, scene, options)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the solution and its scene to a file that `rm.load` reads; whole, or the old one stays.

        **Raises** `ValueError` for a scene with a sky that is a function; `FileNotFoundError` if the directory is missing.
        """
        from .io.archive import save_solution

        save_solution(path, self)

    def plot(self, at: Any = None) -> Any:
        """A matplotlib figure: planes of fluence through `at`, light on surfaces, convergence (`plots`)."""
        from .plots import plot_solution

        return plot_solution(self, at)

    def view(self, height: int = 512, bands: Bands | None = None, white: Any = None) -> Any:
        """A `k3d.Plot` to turn about in a notebook: radiosity on surfaces, fluence in the fog (`viewer`).

        `bands` of wavelength and the light that is `white` give many bands their colours, as in `Bands.to_rgb`.
        """
        from .viewer import view_solution

        return view_solution(self, height, bands, white)

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        from .display import html_table

        energy = {name.replace("_", " "): float(value) for name, value in self.energy._asdict().items()}
        rows = {"scene": self.scene.summary(), "result": self.result}
        rows |= {f"{name}, W": f"{value:.6g}" for name, value in energy.items()}
        rows["imbalance"] = f"{100 * float(self.energy.imbalance):+.3f} %"
        return html_table(list(rows.items()))

    @property
    def elements(self) -> Surfaces:
        """The surface elements' geometry, as numpy arrays."""
        return self._hidden.surfaces

    @property
    def fluence(self) -> Float[jax.Array, "nx ny nz *bands"]:
        return self._banded(self.diffuse_fluence + self.sun_fluence)

    @property
    def surfaces(self) -> SurfaceTable:
        """The elements of solids and walls (those of open sides: `outgoing_flux`)."""
        kept = np.nonzero(~self.elements.open)[0]
        irradiance = (self.diffuse_irradiance + self.sun_irradiance)[:, kept]
        radiosity = self.albedo[:, kept] * irradiance + jnp.pi * self.emission[:, kept]
        real = irradiance.dtype
        return SurfaceTable(
            *(jnp.asarray(a[kept], real) for a in (self.elements.position, self.elements.normal, self.elements.area)),
            *(self._banded(a) for a in (self.albedo[:, kept], irradiance, radiosity)),
        )

    @property
    def converged(self) -> bool:
        """Whether the error bound meets the tolerance."""
        return self.ending == "converged"

    @property
    def result(self) -> str:
        """How the iteration ended."""
        bound, target, count = self.error_bound, self.target, self.sweeps
        if np.isnan(bound):
            return "solved inside a program that JAX traced (jit, vmap), which keeps no bound"
        if self.converged:
            text = f"converged: error bound {bound:.3g} is within the target {target:.3g} after {count} sweeps ({self.solver})"
            rounding = f"; rounding may add up to {self.rounding:.3g}: enable float64 if that matters"
            return text + rounding * (self.rounding > target)
        if self.ending == "as asked":
            return f"{self.solver}, as asked: all the light differs from it by {bound:.3g} at most"
        ending = {
            "no bound": f"no error bound: {self.no_bound}; lower an albedo below 1, or open a side",
            "stagnated": "stagnated at the float type's rounding; raise rtol, or enable float64",
            "diverged": 'diverged: the residual grew a thousandfold; use solver="auto", and report the scene if it did',
            "sweep limit": "sweep limit reached; raise max_sweeps or rtol",
        }[self.ending]
        if self.no_bound and self.ending != "no bound":
            ending += f"; and there is no error bound: {self.no_bound}; lower an albedo below 1, or open a side"
        return f"not converged after {count} sweeps of {self.solver} (bound {bound:.3g}, target {target:.3g}): {ending}"

    def _banded(self, values: Float[jax.Array, "C *shape"]) -> Float[jax.Array, "*shape C"]:
        return jnp.moveaxis(values, 0, -1) if self.scene.banded else values[0]

    def __repr__(self) -> str:
        return f"Solution({self.scene.summary()}; {self.result})"
