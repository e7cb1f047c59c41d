"""Deterministic light transport on a voxel lattice.

The usual import is `import raymanifold_jax as rm`. Names are loaded at their first use, so that the import itself (and
`raymanifold --help`) does not wait for JAX: `_MODULE_OF` says which module holds each of them.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Public name -> the module that holds it.
_MODULE_OF = {
    "Lattice": "lattice",
    "Box": "shapes",
    "Cylinder": "shapes",
    "HalfSpace": "shapes",
    "Shape": "shapes",
    "Sphere": "shapes",
    "Torus": "shapes",
    "Mesh": "mesh",
    "MeshReport": "mesh",
    "Voxels": "voxels",
    "voxel_solids": "voxels",
    "MIRROR": "scene",
    "OPEN": "scene",
    "PERIODIC": "scene",
    "Boundary": "scene",
    "Medium": "scene",
    "PointLight": "scene",
    "Scene": "scene",
    "Sky": "scene",
    "Solid": "scene",
    "Sun": "scene",
    "Wall": "scene",
    "Checkpoint": "checkpoint",
    "Texture": "texture",
    "Fit": "fit",
    "Parameter": "fit",
    "fit": "fit",
    "FluenceTarget": "targets",
    "IrradianceTarget": "targets",
    "PictureTarget": "targets",
    "load": "load",
    "Characteristic": "transport.characteristic",
    "LightRayCube": "transport.light_ray_cube",
    "CostReport": "cost",
    "cost_report": "cost",
    "Anderson": "solvers",
    "Jacobi": "solvers",
    "Krylov": "solvers",
    "OptimistixFixedPoint": "optimistix_solver",
    "pe_array": "sharding",
    "Solution": "solution",
    "solve": "solve",
    "ErrorEstimate": "error_estimate",
    "estimate_error": "error_estimate",
    "fluence": "gather",
    "irradiance": "gather",
    "outgoing_flux": "gather",
    "radiance": "gather",
    "OrthographicCamera": "camera",
    "PerspectiveCamera": "camera",
    "render": "render",
    "render_layers": "render",
}
_SUBMODULES = ("io", "quadrature", "scenes", "skies", "spectra")

__all__ = ["__version__", *_MODULE_OF, *_SUBMODULES]  # pyright: ignore[reportUnsupportedDunderAll]

if TYPE_CHECKING:
    from raymanifold_jax import io as io
    from raymanifold_jax import quadrature as quadrature
    from raymanifold_jax import scenes as scenes
    from raymanifold_jax import skies as skies
    from raymanifold_jax import spectra as spectra
    from raymanifold_jax.camera import OrthographicCamera as OrthographicCamera
    from raymanifold_jax.camera import PerspectiveCamera as PerspectiveCamera
    from raymanifold_jax.checkpoint import Checkpoint as Checkpoint
    from raymanifold_jax.cost import CostReport as CostReport
    from raymanifold_jax.cost import cost_report as cost_report
    from raymanifold_jax.error_estimate import ErrorEstimate as ErrorEstimate
    from raymanifold_jax.error_estimate import estimate_error as estimate_error
    from raymanifold_jax.fit import Fit as Fit
    from raymanifold_jax.fit import Parameter as Parameter
    from raymanifold_jax.fit import fit as fit
    from raymanifold_jax.gather import fluence as fluence
    from raymanifold_jax.gather import irradiance as irradiance
    from raymanifold_jax.gather import outgoing_flux as outgoing_flux
    from raymanifold_jax.gather import radiance as radiance
    from raymanifold_jax.lattice import Lattice as Lattice
    from raymanifold_jax.load import load as load
    from raymanifold_jax.mesh import Mesh as Mesh
    from raymanifold_jax.mesh import MeshReport as MeshReport
    from raymanifold_jax.optimistix_solver import OptimistixFixedPoint as OptimistixFixedPoint
    from raymanifold_jax.render import render as render
    from raymanifold_jax.render import render_layers as render_layers
    from raymanifold_jax.scene import MIRROR as MIRROR
    from raymanifold_jax.scene import OPEN as OPEN
    from raymanifold_jax.scene import PERIODIC as PERIODIC
    from raymanifold_jax.scene import Boundary as Boundary
    from raymanifold_jax.scene import Medium as Medium
    from raymanifold_jax.scene import PointLight as PointLight
    from raymanifold_jax.scene import Scene as Scene
    from raymanifold_jax.scene import Sky as Sky
    from raymanifold_jax.scene import Solid as Solid
    from raymanifold_jax.scene import Sun as Sun
    from raymanifold_jax.scene import Wall as Wall
    from raymanifold_jax.shapes import Box as Box
    from raymanifold_jax.shapes import Cylinder as Cylinder
    from raymanifold_jax.shapes import HalfSpace as HalfSpace
    from raymanifold_jax.shapes import Shape as Shape
    from raymanifold_jax.shapes import Sphere as Sphere
    from raymanifold_jax.shapes import Torus as Torus
    from raymanifold_jax.sharding import pe_array as pe_array
    from raymanifold_jax.solution import Solution as Solution
    from raymanifold_jax.solve import solve as solve
    from raymanifold_jax.solvers import Anderson as Anderson
    from raymanifold_jax.solvers import Jacobi as Jacobi
    from raymanifold_jax.solvers import Krylov as Krylov
    from raymanifold_jax.targets import FluenceTarget as FluenceTarget
    from raymanifold_jax.targets import IrradianceTarget as IrradianceTarget
    from raymanifold_jax.targets import PictureTarget as PictureTarget
    from raymanifold_jax.texture import Texture as Texture
    from raymanifold_jax.transport.characteristic import Characteristic as Characteristic
    from raymanifold_jax.transport.light_ray_cube import LightRayCube as LightRayCube
    from raymanifold_jax.voxels import Voxels as Voxels
    from raymanifold_jax.voxels import voxel_solids as voxel_solids


def __getattr__(name: str) -> Any:
    if name in _SUBMODULES:
        value = import_module(f"{__name__}.{name}")
    elif name in _MODULE_OF:
        value = getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """The package, where `solve` and `render` stay functions when the modules of the same names are imported."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Importing a submodule binds it on its package, which would hide the function of that name.
        if not (isinstance(value, ModuleType) and name in _MODULE_OF):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
