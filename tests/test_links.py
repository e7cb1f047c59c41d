"""Vacuum: bounces by links are those of sweeps; and sweeps in parts, one for each core, are whole sweeps."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax import operator
from raymanifold_jax.operator import Light, make_transport
from raymanifold_jax.prepare import prepare
from raymanifold_jax.transport import cores

WALL = rm.Wall(albedo=0.6)
BALL = rm.Solid(rm.Sphere((3.1, 2.8, 3.3), 1.9), albedo=(0.3, 0.7))
SIDES = {
    "box": rm.Boundary(WALL, WALL, (WALL, rm.OPEN)),
    "mirrors": rm.Boundary(rm.MIRROR, (rm.MIRROR, WALL), (WALL, rm.OPEN)),
    "periodic": rm.Boundary(rm.PERIODIC, rm.PERIODIC, (WALL, rm.OPEN)),
}


def scene(sides: str) -> rm.Scene:
    return rm.Scene(rm.Lattice((6, 7, 8)), [BALL], lights=[rm.Sky(1.0)], boundary=SIDES[sides])


@pytest.mark.parametrize("sides", SIDES)
def test_a_bounce_by_links_is_a_sweep(x64, sides):
    prepared = prepare(scene(sides))
    area, quadrature = prepared.surfaces.area, rm.quadrature.for_scene(scene(sides), 60)
    transport = make_transport(prepared.layout, quadrature, None, 2, area=area)
    assert transport.links is not None
    light = Light(jnp.asarray(np.random.default_rng(0).uniform(size=(2, prepared.layout.elements))))
    linked, swept = transport(light), dataclasses.replace(transport, links=None)(light)
    np.testing.assert_allclose(linked.elements, swept.elements, atol=1e-13)
    np.testing.assert_allclose(linked.voxels, swept.voxels, atol=1e-13)
    np.testing.assert_array_equal(transport(light, fluence=False).elements, linked.elements)
    x, y = light.elements, light.elements[::-1, ::-1]
    forth = jnp.vdot(y, transport(Light(x), fluence=False).elements)
    assert float(jnp.vdot(transport.transposed(Light(y)).elements, x)) == pytest.approx(float(forth), rel=1e-13)


def test_solutions_do_not_depend_on_links(monkeypatch, x64):
    linked = rm.solve(scene("box"), rm.quadrature.fibonacci(60), rtol=1e-8, solver=rm.Krylov(), progress=False)
    monkeypatch.setattr(operator, "worth_linking", lambda *_: False)
    swept = rm.solve(scene("box"), rm.quadrature.fibonacci(60), rtol=1e-8, solver=rm.Krylov(), progress=False)
    assert linked.sweeps == swept.sweeps
    np.testing.assert_allclose(linked.surfaces.irradiance, swept.surfaces.irradiance, rtol=1e-9)
    np.testing.assert_allclose(linked.fluence, swept.fluence, rtol=1e-9)


def test_links_that_take_too_much_memory_are_not_made():
    layout = prepare(scene("box")).layout
    assert operator.worth_linking(layout, 60)
    assert not operator.worth_linking(layout, 10**7)


@pytest.mark.parametrize("medium", [None, pytest.param(rm.Medium(0.3, 0.1), marks=pytest.mark.slow)])
def test_parts_of_a_sweep_add_up(monkeypatch, x64, medium):
    """On 1 and 3 cores, with chunks that do not divide by that; twice, for only the second time is in threads."""
    of = rm.Scene(rm.Lattice((6, 7, 8)), [BALL], medium, [rm.Sky(1.0)], SIDES["box"])
    prepared = prepare(of)
    extinction = None if medium is None else jnp.full((2, 6, 7, 8), 0.4)
    monkeypatch.setattr("raymanifold_jax.layout._CHUNK", 1 << 9)
    monkeypatch.setattr(cores, "_FEW", 0)
    transport = make_transport(prepared.layout, rm.quadrature.fibonacci(90), extinction, 2)
    assert transport.ordinates[0].weight.shape[0] > 2
    source = None if medium is None else jnp.ones((2, 6, 7, 8))
    light = Light(jnp.asarray(np.random.default_rng(0).uniform(size=(2, prepared.layout.elements))), source)
    found = []
    for count in (1, 3, 3):
        monkeypatch.setattr(cores, "count_cores", lambda count=count: count)
        found.append((transport(light), transport.transposed(light)))
    for other in found[1:]:
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12), found[0], other)
