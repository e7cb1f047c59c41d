"""Derivatives of solves and readings against central differences, and linear maps with transposes of their own.

Central differences of step h = 1e-5 in float64 are good to about 1e-9 relative here (h^2 and rounding / h); solves to 1e-11.
The tolerance 1e-6 is what derivatives are promised to.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax.adjoint import with_adjoint
from raymanifold_jax.layout import make_layout
from raymanifold_jax.operator import make_transport, materials
from raymanifold_jax.surfaces import find_surfaces
from raymanifold_jax.transport.characteristic import Inflow
from raymanifold_jax.transport.derivative import Manner, swept, unswept
from raymanifold_jax.volume_sources import compact_sources

QUADRATURE = rm.quadrature.fibonacci(24)
STEP = 1e-5


def _loop(a, b):
    return jax.lax.fori_loop(0, jnp.asarray(3), lambda i, x: jnp.sin(x * a) + b, b)


def _unrolled(a, b):
    x = b
    for _ in range(3):
        x = jnp.sin(x * a) + b
    return x


def _adjoint(arguments, wanted, cotangent):
    return jax.vjp(_unrolled, *arguments)[1](cotangent)


def test_a_function_with_an_adjoint_has_all_derivatives(x64):
    # A loop that JAX cannot turn round, against the same unrolled: gradient, Hessian (by vmap), product with it, under jit.
    a, b = jnp.arange(3.0) + 1, jnp.full(3, 0.3)
    ours, plain = (lambda p, f=f: jnp.sum(f(*p) ** 2) for f in (with_adjoint(_loop, _adjoint), _unrolled))
    push = lambda f: jax.jvp(jax.grad(f), ((a, b),), ((b, a),))[1]
    for transform in (jax.grad, jax.hessian, lambda f: jax.jit(jax.grad(f)), lambda f: lambda _: push(f)):
        found, expected = (transform(f)((a, b)) for f in (ours, plain))
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=1e-12, atol=1e-13), found, expected)


def random_scene(seed, fog, sides="open", lights=3):
    """A box with a ball, every kind of light (or the first few) and material at random values, two bands.

    Optical depths of a voxel's side are 0.1 to 0.4 times `fog`: sources have slopes above 0.1, whole ones above 0.2.
    """
    rng = np.random.default_rng(seed)
    value = lambda *shape: 0.2 + 0.6 * rng.random(shape)
    wall = rm.Wall(value(2), value(2))
    floor = rm.Wall(rm.Texture(value(3, 2, 2), lower=(0.1, 0.0), upper=(0.9, 0.8)))
    across = {"open": wall, "mirror": (rm.MIRROR, wall), "periodic": rm.PERIODIC}[sides]
    medium = rm.Medium(fog * value(4, 4, 4, 2), fog * value(2), value(4, 4, 4)) if fog else None
    return rm.Scene(
        rm.Lattice((4, 4, 4), 0.25),
        [rm.Solid(rm.Sphere(0.45 + 0.1 * rng.random(3), 0.3), value(2), value())],
        medium,
        [
            rm.Sky(value(2)),
            rm.Sun((*(0.4 * rng.random(2) - 0.2), -1), 3 * value(2)),
            rm.PointLight((0.15, 0.85, 0.8), value()),
        ][: min(lights, 2) if sides == "periodic" else lights],  # a point light has no end of images there
        rm.Boundary(across, wall, (floor, rm.OPEN)),
    )


def parameters(scene):
    """Every kind of value, by name."""
    found = {
        "albedo of a solid": lambda s: s.solids[0].albedo,
        "emission of a solid": lambda s: s.solids[0].emission,
        "albedo of a wall": lambda s: s.boundary.y.albedo,
        "texture": lambda s: s.boundary.z[0].albedo.values,
    }
    lights = {"sky": "radiance", "sun": "irradiance", "point light": "intensity"}
    for i, (name, field) in enumerate([*lights.items()][: len(scene.lights)]):
        found[name] = lambda s, i=i, field=field: getattr(s.lights[i], field)
    if scene.medium is not None:
        found |= {name: lambda s, name=name: getattr(s.medium, name) for name in ("scattering", "absorption", "emission")}
    return found


def readings(solution):
    """One number of every reading: random weights of each."""
    corner = np.array([[1.6, -1.1, 1.2]])
    towards = np.array([[x, y, z] for x in (0.2, 0.6) for y in (0.3, 0.8) for z in (0.1, 0.5)]) - corner
    floor, up = [[0.15, 0.3, 0.0], [0.9, 0.8, 0.0]], [[0.0, 0.0, 1.0]] * 2
    values = [
        solution.surfaces.radiosity,
        solution.fluence,
        rm.outgoing_flux(solution, "z+"),
        rm.radiance(solution, np.repeat(corner, len(towards), 0), towards),
        rm.fluence(solution, [[0.1, 0.2, 0.9]]),
        rm.irradiance(solution, floor, up, directions=16),
    ]
    weights = [np.random.default_rng(i).standard_normal(v.shape) for i, v in enumerate(values)]
    return sum(jnp.sum(v * w) for v, w in zip(values, weights, strict=True))


def loss_of(scene, read=readings):
    where = lambda s: [get(s) for get in parameters(scene).values()]

    def loss(values):
        changed = eqx.tree_at(where, scene, values)
        return read(rm.solve(changed, QUADRATURE, rtol=1e-11, progress=False))

    return loss, where(scene)


def check_gradient(scene, read=readings):
    loss, values = loss_of(scene, read)
    gradient = jax.grad(loss)(values)
    rng = np.random.default_rng(1)
    for i, (name, slope) in enumerate(zip(parameters(scene), gradient, strict=True)):
        direction = jnp.asarray(rng.standard_normal(slope.shape))
        moved = lambda step, i=i, direction=direction: [v + step * direction if k == i else v for k, v in enumerate(values)]
        difference = (loss(moved(STEP)) - loss(moved(-STEP))) / (2 * STEP)
        np.testing.assert_allclose(jnp.sum(slope * direction), difference, rtol=1e-6, err_msg=name)


def plain_readings(solution):
    fields = solution.surfaces.radiosity, solution.fluence, rm.outgoing_flux(solution, "z+")
    return sum(jnp.sum(field**2) for field in fields)


THICK = 4


@pytest.mark.slow
def test_gradients_in_thick_fog(x64):
    check_gradient(random_scene(0, THICK, lights=1), plain_readings)


@pytest.mark.slow
def test_gradients_in_vacuum(x64):
    check_gradient(random_scene(0, fog=0, lights=1), plain_readings)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fog", "sides"),
    [(0, "open"), (0, "periodic"), (0.2, "open"), (1, "open"), (1, "mirror"), (THICK, "open"), (THICK, "periodic")],
)
def test_gradients_of_every_reading(fog, sides, x64):
    check_gradient(random_scene(1, fog, sides))


@pytest.mark.slow
def test_gradients_with_compact_sources(x64):
    # Light of a small glowing part goes straight to everything: which voxels glow is fixed, how much they do is not.
    rng = np.random.default_rng(7)
    shape = (8, 8, 8)
    emission = np.zeros(shape)
    emission[3:5, 3:5, 3:5] = 0.5 + rng.random((2, 2, 2))
    scene = rm.Scene(rm.Lattice(shape), medium=rm.Medium(0.3 * rng.random(shape), 0.05, emission))
    assert compact_sources(scene, find_surfaces(scene)) is not None
    where = lambda s: [s.medium.scattering, s.medium.absorption, s.medium.emission]

    def loss(values):
        solution = rm.solve(eqx.tree_at(where, scene, values), QUADRATURE, rtol=1e-11, progress=False)
        near = rm.fluence(solution, [[2.5, 3.0, 3.5], [7.5, 7.0, 6.8]], directions=32)
        return plain_readings(solution) + jnp.sum(near**2)

    values = where(scene)
    gradient = jax.grad(loss)(values)
    for i, direction in enumerate([rng.standard_normal(shape), 1.0, emission * rng.standard_normal(shape)]):
        moved = lambda step, i=i, direction=direction: [v + step * direction if k == i else v for k, v in enumerate(values)]
        difference = (loss(moved(STEP)) - loss(moved(-STEP))) / (2 * STEP)
        np.testing.assert_allclose(jnp.sum(gradient[i] * direction), difference, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("fog", [0, 1, THICK])
def test_other_derivatives(fog, x64):
    # jvp against vjp (1e-8: two solves to 1e-11), Hessian times vector against differences of gradients, jit against neither.
    loss, values = loss_of(random_scene(4, fog), plain_readings)
    rng = np.random.default_rng(2)
    direction = [jnp.asarray(rng.standard_normal(v.shape)) for v in values]
    gradient = jax.grad(loss)
    slope = gradient(values)
    expected = sum(jnp.sum(a * b) for a, b in zip(slope, direction, strict=True))
    np.testing.assert_allclose(jax.jvp(loss, (values,), (direction,))[1], expected, rtol=1e-8)
    moved = lambda step: [v + step * d for v, d in zip(values, direction, strict=True)]
    product = jax.jvp(gradient, (values,), (direction,))[1]
    difference = [(a - b) / (2 * STEP) for a, b in zip(gradient(moved(STEP)), gradient(moved(-STEP)), strict=True)]
    scale = max(float(jnp.abs(d).max()) for d in difference)
    for found, expected in zip(product, difference, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * scale)
    for found, expected in zip(jax.jit(gradient)(values), slope, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
def test_batches_are_solved_one_after_the_other(x64):
    loss, values = loss_of(random_scene(5, fog=0), plain_readings)
    several = [jnp.stack([v, 0.9 * v]) for v in values]
    for k in range(2):
        expected = loss([v[k] for v in several])
        np.testing.assert_allclose(jax.vmap(loss)(several)[k], expected, rtol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(("fog", "sides"), [(0.2, "open"), (0.2, "periodic"), (THICK, "mirror"), (THICK, "periodic")])
def test_adjoint_sweeps(fog, sides, x64):
    # <J t, y> = <t, J'y> to rounding, J the derivative of a sweep or a transposed sweep in everything it depends on: in thick
    # voxels in the slopes of sources as well.
    scene = random_scene(6, fog, sides)
    surfaces = find_surfaces(scene)
    layout = make_layout(scene, surfaces)
    stuff = materials(scene, surfaces)
    transport = make_transport(layout, QUADRATURE, stuff.extinction, 2, albedo=stuff.scattering_albedo)
    thick = fog == THICK
    assert thick == transport.onward == (transport.albedo is not None)
    rng, images, shape = np.random.default_rng(3), len(layout.unfolding.images()), layout.shape
    random = lambda *shape: jnp.asarray(rng.random(shape))
    manner, known = Manner(transport.thin, transport.onward), (layout, transport.ordinates)
    forward = lambda s, *sent: swept(manner, *known, s, *sent)
    backward = lambda s, *asked: unswept(manner, *known, s, *asked, thick)
    elements, voxels = (lambda: random(2, len(surfaces))), (lambda: random(2, *shape))
    free = layout.free  # CUT voxels have no slopes
    slopes = tuple(free * (random(2, *layout.padded) - 0.5) for _ in range(3)) if thick else None
    light = Inflow(random(images, len(QUADRATURE), 2), elements())
    sloped = lambda a: free if a.shape[1:] == layout.padded else 1.0
    for function, rest in ((forward, (elements(), voxels(), slopes, light)), (backward, (elements(), voxels()))):
        arguments = (transport.extinction, *rest)
        tangent = (layout.to_padded(voxels()), *jax.tree.map(lambda a: sloped(a) * random(*a.shape), rest))
        result, pushed = jax.jvp(function, arguments, tangent)
        weights = jax.tree.map(lambda a: sloped(a) * (random(*a.shape) - 0.5), result)
        pulled = jax.vjp(function, *arguments)[1](weights)
        dot = lambda a, b: sum(jnp.sum(x * y) for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True))
        np.testing.assert_allclose(dot(pushed, weights), dot(tangent, pulled), rtol=1e-11)


def test_geometry_has_no_derivative():
    def loss(radius):
        scene = rm.Scene(rm.Lattice((4, 4, 4), 0.25), [rm.Solid(rm.Sphere((0.5, 0.5, 0.5), radius))], lights=[rm.Sky()])
        return jnp.sum(rm.solve(scene, progress=False).fluence)

    with pytest.raises(TypeError, match="scene: got traced geometry"):
        jax.grad(loss)(0.3)
