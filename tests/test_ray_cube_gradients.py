"""The paper's scheme has derivatives: its transposed sweep, and solves against central differences, in float64."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax.operator import Light
from raymanifold_jax.prepare import prepare
from raymanifold_jax.transport.ray_cube_system import make_cube_system

STEP = 1e-5


def random_scene(seed, fog, side):
    """A box of 5 x 6 x 7 voxels with a ball, two bands, and values at random."""
    rng = np.random.default_rng(seed)
    value = lambda *shape: 0.2 + 0.6 * rng.random(shape)
    wall = rm.Wall(value(2), value(2))
    medium = rm.Medium(value(5, 6, 7, 2), value(2), value(5, 6, 7)) if fog else None
    lights = [rm.Sky(value(2)), rm.Sun((0.3, 0.1, -1), value(2))]
    if side != "periodic":  # a point light has no end of images there
        lights.append(rm.PointLight((0.15, 0.8, 0.9), value()))
    ball = rm.Solid(rm.Sphere((0.5, 0.45, 0.4), 0.2), value(2), value())
    boundary = rm.Boundary(rm.PERIODIC if side == "periodic" else wall, wall, (wall, rm.OPEN))
    return rm.Scene(rm.Lattice((5, 6, 7), 1 / 6), [ball], medium, lights, boundary)


@pytest.mark.parametrize(
    ("fog", "side", "scheme"),
    [
        pytest.param(False, "wall", rm.LightRayCube(1), marks=pytest.mark.slow),
        (True, "wall", rm.LightRayCube(2, "exponential", "ends")),
        pytest.param(True, "periodic", rm.LightRayCube(1), marks=pytest.mark.slow),
    ],
)
def test_transposed_evolution(fog, side, scheme, x64):
    # <K u, v> = <u, K'v> to rounding.
    scene = random_scene(0, fog, side)
    system = make_cube_system(scene, prepare(scene).surfaces, scheme).system
    rng = np.random.default_rng(1)
    random = lambda: jax.tree.map(lambda a: jnp.asarray(rng.standard_normal(a.shape)), system.source)
    sent, asked = random(), random()
    if not fog:
        sent, asked = Light(sent.elements), Light(asked.elements)
    dot = lambda a, b: sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
    there = dot(system.transport(sent, fluence=fog), asked)
    back = dot(sent, system.transport.transposed(asked))
    np.testing.assert_allclose(there, back, rtol=1e-12, atol=1e-12 * float(jnp.sqrt(dot(sent, sent) * dot(asked, asked))))


@pytest.mark.slow
@pytest.mark.parametrize(("fog", "side"), [(False, "wall"), (True, "wall"), (True, "periodic")])
def test_gradients_of_a_solve(fog, side, x64):
    # Differences of step 1e-5 are good to 1e-9, solves to 1e-11; 1e-6 is promised.
    scene = random_scene(2, fog, side)
    found = {
        "albedo of a solid": lambda s: s.solids[0].albedo,
        "emission of a solid": lambda s: s.solids[0].emission,
        "albedo of a wall": lambda s: s.boundary.y.albedo,
        "sky": lambda s: s.lights[0].radiance,
        "sun": lambda s: s.lights[1].irradiance,
    }
    if side != "periodic":
        found["point light"] = lambda s: s.lights[2].intensity
    if fog:
        found |= {name: lambda s, name=name: getattr(s.medium, name) for name in ("scattering", "absorption", "emission")}
    where = lambda s: [get(s) for get in found.values()]
    scheme = rm.LightRayCube(1, "exponential")

    def loss(values):
        solution = rm.solve(eqx.tree_at(where, scene, values), scheme=scheme, rtol=1e-11, progress=False)
        fields = solution.surfaces.radiosity, solution.fluence, rm.outgoing_flux(solution, "z+")
        return sum(jnp.sum(field**2) for field in fields)

    values = where(scene)
    gradient = jax.grad(loss)(values)
    rng = np.random.default_rng(3)
    for i, (name, slope) in enumerate(zip(found, gradient, strict=True)):
        direction = jnp.asarray(rng.standard_normal(slope.shape))
        moved = lambda step, i=i, direction=direction: [v + step * direction if k == i else v for k, v in enumerate(values)]
        difference = (loss(moved(STEP)) - loss(moved(-STEP))) / (2 * STEP)
        np.testing.assert_allclose(jnp.sum(slope * direction), difference, rtol=1e-6, err_msg=name)
