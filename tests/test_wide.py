"""Sweeps as a GPU does them, all of a plane at once, give what others do: in float64 to rounding, on a CPU."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax import layout
from raymanifold_jax.operator import Light, Transport, make_transport, materials
from raymanifold_jax.prepare import prepare
from raymanifold_jax.transport import native
from raymanifold_jax.transport.characteristic import Inflow
from raymanifold_jax.windows import make_windows


@pytest.fixture(autouse=True)
def double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def _box(medium: rm.Medium | None, boundary: rm.Boundary, shape: tuple[int, int, int] = (9, 9, 9), count: int = 1) -> rm.Scene:
    solids = rm.Solid(rm.Sphere((0.5, 0.5, 0.45), 0.23), 0.8), rm.Solid(rm.Box((0.1, 0.1, 0), (0.3, 0.35, 0.3)), 0.5)
    return rm.Scene(rm.Lattice(shape, 1 / 9), solids[:count], medium, lights=[rm.Sky(1.0)], boundary=boundary)


def _uneven(shape: tuple[int, ...], strength: float) -> np.ndarray:
    return strength * np.random.default_rng(5).uniform(0, 2, shape) ** 2


_ROOM = rm.Boundary(x=rm.Wall(0.5), y=rm.OPEN, z=(rm.Wall(0.7), rm.OPEN))
_SCENES = {
    "vacuum": lambda: _box(None, _ROOM, count=2),  # no plane is crowded
    "thick uneven fog in two bands": lambda: _box(rm.Medium(_uneven((9, 9, 9, 2), 12.0), absorption=0.3), _ROOM),
    "around an axis, mirrored": lambda: _box(
        rm.Medium(_uneven((5, 6, 9), 4.0), absorption=0.3),
        rm.Boundary(x=rm.PERIODIC, y=rm.MIRROR, z=(rm.Wall(0.7), rm.OPEN)),
        (5, 6, 9),
        count=2,
    ),
}


def _transport(scene: rm.Scene, monkeypatch: pytest.MonkeyPatch, wide: bool) -> Transport:
    monkeypatch.setattr(layout, "on_accelerator", lambda: wide)
    monkeypatch.setattr(native, "serves", (lambda *_: False) if wide else _SERVES)
    prepared = prepare(scene)
    assert prepared.layout.wide == wide
    stuff = materials(scene, prepared.surfaces)
    quadrature = rm.quadrature.for_scene(scene, 40)
    return make_transport(prepared.layout, quadrature, stuff.extinction, scene.bands, albedo=stuff.scattering_albedo)


_SERVES = native.serves


def _results(scene: rm.Scene, transport: Transport) -> list[np.ndarray]:
    """Sums of random light, forwards and backwards."""
    random, outside = np.random.default_rng(3), ~prepare(scene).surfaces.solid
    elements = jnp.asarray(random.uniform(size=(scene.bands, transport.layout.elements)))
    voxels = None
    if transport.extinction is not None:
        voxels = jnp.asarray(random.uniform(size=(scene.bands, *scene.lattice.shape)) * outside)
    light = Light(elements, voxels)
    images, count = len(transport.layout.unfolding.images()), 1 + max(int(o.index.max()) for o in transport.ordinates)
    inflow = Inflow(jnp.asarray(random.uniform(size=(images, count, scene.bands))), 0.5 + elements)
    lit, bounced = transport(light, inflow), transport(light, scattered=True)
    sent = transport.transposed(light, scattered=True)
    fields = [np.asarray(f) * outside for f in (lit.voxels, bounced.voxels, sent.voxels) if f is not None]
    return [np.asarray(f) for f in (lit.elements, bounced.elements, sent.elements)] + fields


@pytest.mark.slow
@pytest.mark.parametrize("name", _SCENES)
def test_wide_sweeps_give_the_same(name: str, monkeypatch: pytest.MonkeyPatch):
    scene = _SCENES[name]()
    expected = _results(scene, _transport(scene, monkeypatch, wide=False))
    wide = _transport(scene, monkeypatch, wide=True)
    windows = wide.layout.reads[2].windows
    assert windows is not None and (windows.count > 0) == (name != "vacuum")
    for found, right in zip(_results(scene, wide), expected, strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-11, atol=1e-12 * np.abs(right).max())


@pytest.mark.slow
def test_wide_sweeps_are_differentiated_in_the_extinction(monkeypatch: pytest.MonkeyPatch):
    scene = _box(rm.Medium(scattering=_uneven((9, 9, 9), 4.0), absorption=0.3), _ROOM)
    scattering = materials(scene, prepare(scene).surfaces).extinction
    assert scattering is not None
    direction = jnp.asarray(np.random.default_rng(1).uniform(size=scattering.shape)) * (scattering > 0)

    def loss(extinction, wide: bool):
        monkeypatch.setattr(layout, "on_accelerator", lambda: wide)
        monkeypatch.setattr(native, "serves", (lambda *_: False) if wide else _SERVES)
        whole = prepare(scene).layout
        transport = make_transport(whole, rm.quadrature.fibonacci(40), extinction, 1)
        light = transport(Light(jnp.ones((1, whole.elements)), extinction))
        return jnp.sum(light.elements**2) + jnp.sum(light.voxels**2)

    value, gradient = jax.value_and_grad(loss)(scattering, wide=True)
    assert float(value) == pytest.approx(float(loss(scattering, wide=False)), rel=1e-12)
    slope = jnp.vdot(gradient, direction)
    step = 1e-5
    steps = [float(loss(scattering + sign * step * direction, False)) for sign in (1, -1)]
    assert slope == pytest.approx((steps[0] - steps[1]) / (2 * step), rel=1e-5)


def test_windows_hold_all_rows_of_every_plane():
    counts = [np.array([1024, 64, 128, 0, 64, 1024]), np.array([128, 1216, 64, 64, 64, 0])]
    for windows, count in zip(make_windows(counts, [1024, 1024]), counts, strict=True):
        assert windows.size < 1024 and windows.size + windows.rest >= 1216
        crowded, slot = np.asarray(windows.crowded), np.asarray(windows.slot)
        assert len(crowded) == windows.count == 2
        for plane, rows in enumerate(count):
            there = rows > windows.size
            assert (slot[plane] < windows.count) == there
            assert not there or crowded[slot[plane]] == plane
    # A lattice of one layer, all of it crowded, beside axes with two walls: no plane may be read twice.
    layer = [np.array([192, *[64] * 192, 192])] * 2 + [np.array([768])]
    for windows, count in zip(make_windows(layer, [194, 194, 194**2]), layer, strict=True):
        crowded, slot = np.asarray(windows.crowded), np.asarray(windows.slot)
        twice = [plane for number, plane in enumerate(crowded) if count[plane] > windows.size and slot[plane] != number]
        assert not twice and windows.size + windows.rest >= count.max()
    (alone,) = make_windows([np.full(40, 640)], [1024])  # no plane has fewer: none is crowded
    assert alone.count == 0 and alone.size >= 640 and alone.rest == 0
