"""The paper's machine without devices: an array of processing elements that is an axis of one program.

The elements of a 64 x 32 array, as many as the MasPar had, are the two axes of a `jax.vmap`. Each runs the code that a device
of a mesh runs on its block (`ray_partition`), and all it knows of its neighbours comes by `ppermute` and all-to-alls. It shows
what each element holds and does; for speed there is the plain evolution, for real devices `rm.pe_array`.

Public: `Elements`, `evolution_on_elements`.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AbstractMesh
from jaxtyping import Array, Float

from ..blocks import positions
from ..layout import Unfolding
from ..partition import Shapes
from ..sharding import NAMES
from .light_ray_cube import LightRayCube, NodeFields, coordinate_evolution
from .ray_layout import Faces, RayLattice
from .ray_partition import RayBlock


class _Element(RayBlock):
    """One element's part; its results stay on the padded lattice."""

    def from_padded(self, field: Float[Array, "C X Y Z"]) -> Float[Array, "C X Y Z"]:
        return field


class Elements(eqx.Module):
    """The nodes of a lattice over nu x nv elements: `split` gives each its block, `joined` puts blocks together again."""

    block: _Element

    def __init__(self, lattice: RayLattice, pe: tuple[int, int]):
        mesh = AbstractMesh(pe, NAMES)
        plain = Unfolding(((False,),) * 3)
        shapes = Shapes(mesh, plain, lattice.shape, lattice.padded, (0, 0, 0), lattice.spacing, 0)  # pyright: ignore[reportArgumentType]
        self.block = _Element(lattice, shapes)

    @property
    def columns(self) -> tuple[np.ndarray, np.ndarray]:
        """The padded lattice's rows and columns of each block, (nu, h) and (nv, w); -1: none."""
        return self.block.shapes.split(0, "u"), self.block.shapes.split(1, "v")

    def split(self, field: Float[Array, "C X Y Z"]) -> Float[Array, "nu nv C h w Z"]:
        rows, columns = self.columns
        there = (rows >= 0)[:, None, :, None] & (columns >= 0)[:, None]
        blocks = field[:, rows[:, None, :, None], columns[:, None]]
        return jnp.moveaxis(blocks * there[..., None], 0, 2)

    def joined(self, blocks: Float[Array, "nu nv C h w Z"]) -> Float[Array, "C nx ny nz"]:
        field = blocks.transpose(2, 0, 3, 1, 4, 5)
        field = field.reshape(len(field), field.shape[1] * field.shape[2], -1, field.shape[-1])
        rows, columns = (positions(table) for table in self.columns)
        return self.block.lattice.from_padded(field[:, rows][:, :, columns])


@eqx.filter_jit
def evolution_on_elements(
    elements: Elements, fields: NodeFields, faces: Faces, scheme: LightRayCube, sky: Float[Array, "C n"] | None, fluence: bool
) -> tuple[Float[Array, "C nx ny nz"], Float[Array, "C nx ny nz"] | None]:
    """`light_ray_cube.coordinate_evolution` of fields on the padded lattice, every element doing its share."""
    own = lambda fields: coordinate_evolution(elements.block, fields, faces, scheme, sky, None, fluence)
    everywhere = jax.vmap(jax.vmap(own, axis_name=NAMES[1]), axis_name=NAMES[0])
    return jax.tree.map(elements.joined, everywhere(jax.tree.map(elements.split, fields)))
