"""Sweeps by loops of our own give what XLA's do, forwards and backwards, in float64 to rounding.

Numbers in solids are left out: nobody reads them, and rays there are not the same.
"""

from __future__ import annotations

import dataclasses
import itertools
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import raymanifold_jax as rm
from raymanifold_jax.layout import make_ordinates
from raymanifold_jax.operator import Transport, _slopes, make_transport, materials
from raymanifold_jax.prepare import prepare
from raymanifold_jax.transport import derivative, machine_code, native
from raymanifold_jax.transport.characteristic import Inflow
from raymanifold_jax.transport.links import find_links
from raymanifold_jax.transport.machine_code import kept
from raymanifold_jax.transport.marks import mark_hits
from raymanifold_jax.transport.sharded import plane_size

pytest.importorskip("numba", reason="the extra `fast`")


@pytest.fixture(autouse=True)
def double() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def _uneven(shape: tuple[int, ...], strength: float) -> np.ndarray:
    return strength * np.random.default_rng(5).uniform(0, 2, shape) ** 2


def _box(medium: rm.Medium | None, boundary: rm.Boundary, shape: tuple[int, int, int] = (9, 9, 9)) -> rm.Scene:
    ball = rm.Solid(rm.Sphere((0.5, 0.5, 0.45), 0.23).union(rm.Box((0.1, 0.1, 0), (0.3, 0.35, 0.3))), 0.8)
    return rm.Scene(rm.Lattice(shape, 1 / 9), solids=[ball], medium=medium, lights=[rm.Sky(1.0)], boundary=boundary)


_ROOM = rm.Boundary(x=rm.Wall(0.5), y=rm.OPEN, z=(rm.Wall(0.7), rm.OPEN))
_AROUND = rm.Boundary(x=rm.PERIODIC, y=rm.MIRROR, z=(rm.Wall(0.7), rm.OPEN))
_TORUS = rm.Boundary(x=rm.OPEN, y=rm.PERIODIC, z=rm.PERIODIC)
_TURNING = (_AROUND, "around an axis, mirrored"), (_TORUS, "around two axes")
_SCENES = {
    "vacuum": lambda: _box(None, _ROOM),
    "vacuum around an axis, mirrored": lambda: _box(None, _AROUND, (5, 6, 9)),
    "vacuum around two axes": lambda: _box(None, _TORUS, (9, 5, 4)),
    "thin fog": lambda: _box(rm.Medium(scattering=0.5, absorption=0.1), _ROOM),
    "thick fog": lambda: _box(rm.Medium(scattering=8.0, absorption=0.5), _ROOM),
    "thin uneven fog": lambda: _box(rm.Medium(scattering=_uneven((9, 9, 9), 0.2), absorption=0.0), _ROOM),
    "thick uneven fog in two bands": lambda: _box(rm.Medium(_uneven((9, 9, 9, 2), 12.0), absorption=0.3), _ROOM),
    "around an axis, mirrored": lambda: _box(rm.Medium(_uneven((5, 6, 9), 4.0), absorption=0.3), _AROUND, (5, 6, 9)),
    "around two axes": lambda: _box(rm.Medium(2.0, absorption=0.5), _TORUS, (9, 5, 4)),
    # More runs of elements with the same face in a plane than are worked on at a time.
    "a gentle slope": lambda: rm.Scene(
        rm.Lattice((400, 4, 6), 0.5), solids=[rm.Solid(rm.HalfSpace((0, 0, 1.2), (-0.0045, 0, 1)), 0.7)],
        medium=rm.Medium(0.3, 0.1), lights=[rm.Sky(1.0)], boundary=_ROOM,
    ),
    "one column": lambda: rm.Scene(
        rm.Lattice((1, 1, 6), 0.5), medium=rm.Medium(1.0, 0.2), lights=[rm.Sky(1.0)],
        boundary=rm.Boundary(x=rm.PERIODIC, y=rm.PERIODIC, z=(rm.Wall(0.3), rm.OPEN)),
    ),
}  # fmt: skip


class _Case:
    """A scene's sweep with random light, and the free voxels."""

    def __init__(self, scene: rm.Scene):
        prepared = prepare(scene)
        stuff = materials(scene, prepared.surfaces)
        quadrature = rm.quadrature.for_scene(scene, 40)
        self.bands, self.layout = scene.bands, prepared.layout
        self.transport: Transport = make_transport(
            self.layout, quadrature, stuff.extinction, self.bands, albedo=stuff.scattering_albedo
        )
        self.free = ~prepared.surfaces.solid
        self._random = np.random.default_rng(3)
        self.elements = self.random(self.layout.elements)
        self.voxels = None if stuff.extinction is None else self.random(*self.layout.shape) * self.free
        images = len(self.layout.unfolding.images())
        radiance = jnp.asarray(self._random.uniform(size=(images, len(quadrature), self.bands)))
        self.inflow = Inflow(radiance, self.random(self.layout.elements))
        self.slopes = None
        if self.voxels is not None and self.transport.albedo is not None:
            self.slopes = _slopes(self.layout, self.voxels, self.transport.albedo, self.transport.extinction)
        self.manner = derivative.Manner(self.transport.thin, self.transport.onward)
        self.known = self.layout, self.transport.ordinates, self.transport.extinction

    def random(self, *shape: int) -> jax.Array:
        return jnp.asarray(self._random.uniform(size=(self.bands, *shape)))


def _close(found, expected, free: np.ndarray) -> None:
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        if a.shape[1:] == free.shape:
            a, b = a * free, b * free
        np.testing.assert_allclose(a, b, rtol=0, atol=1e-12 * float(jnp.abs(b).max()))


_QUICK = {"vacuum", "thin fog", "thick uneven fog in two bands"}
_EACH = pytest.mark.parametrize("name", [n if n in _QUICK else pytest.param(n, marks=pytest.mark.slow) for n in _SCENES])


@_EACH
def test_sweep(name):
    case = _Case(_SCENES[name]())
    for slopes, inflow in {(id(s), id(i)): (s, i) for s in (None, case.slopes) for i in (None, case.inflow)}.values():
        given = *case.known, case.elements, case.voxels, slopes, inflow
        assert native.serves(*given[:2], given[2:])
        expected = derivative._sweep_program(case.manner, *given)
        _close(native.sweep(case.manner, *given), expected, case.free)


@_EACH
def test_transpose(name):
    case = _Case(_SCENES[name]())
    for sloped in {False, case.slopes is not None}:
        expected = derivative._unsweep_program(case.manner, sloped, *case.known, case.elements, case.voxels)
        found = native.unsweep(case.manner, *case.known, case.elements, case.voxels, sloped)
        _close(found[:2], expected[:2], case.free)
        if sloped:
            _, back = jax.vjp(
                lambda s: _slopes(case.layout, s, case.transport.albedo, case.transport.extinction), jnp.zeros_like(case.voxels)
            )
            _close(back(found[2]), back(expected[2]), case.free)


@pytest.mark.parametrize("name", ["vacuum", pytest.param("around an axis, mirrored", marks=pytest.mark.slow)])
def test_light_that_only_comes_in_is_swept_where_it_does(name):
    case = _Case(_SCENES[name]())
    towards = np.random.default_rng(4).uniform(size=case.inflow.radiance.shape[1]) < 0.5  # half of the sky is dark
    inflow = Inflow(case.inflow.radiance * towards[:, None], case.inflow.factor)
    given = *case.known, 0 * case.elements, None if case.voxels is None else 0 * case.voxels, None, inflow
    axes = range(3)
    lines = [native._axis(case.layout, case.transport.ordinates[axis], axis) for axis in axes]
    lit = [native._lit(case.layout, line, axis, inflow) for axis, line in zip(axes, lines, strict=True)]
    assert 0 < sum(map(len, lit)) < 0.6 * sum(len(line.ways.weight) for line in lines)
    _close(native.sweep(case.manner, *given), derivative._sweep_program(case.manner, *given), case.free)


def test_slopes_alone_are_swept():
    case = _Case(_SCENES["thick uneven fog in two bands"]())
    given = *case.known, 0 * case.elements, 0 * case.voxels, case.slopes, None
    found = native.sweep(case.manner, *given)
    assert np.abs(found[0]).max() > 0
    _close(found, derivative._sweep_program(case.manner, *given), case.free)


def test_without_fluence():
    case = _Case(_SCENES["thick uneven fog in two bands"]())
    given = *case.known, case.elements, case.voxels, None, case.inflow
    manner = derivative.Manner(case.transport.thin, case.transport.onward, fluence=False)
    elements, voxels = native.sweep(manner, *given)
    assert voxels is None
    _close(elements, derivative._sweep_program(manner, *given)[0], case.free)


@pytest.mark.parametrize("name", ["vacuum", "thin fog"])
def test_without_elements(name):
    case = _Case(_SCENES[name]())
    given = *case.known, case.elements, case.voxels, None, case.inflow
    elements, voxels = native.sweep(dataclasses.replace(case.manner, elements=False), *given)
    assert not elements.any()
    np.testing.assert_array_equal(voxels, native.sweep(case.manner, *given)[1])


@pytest.mark.parametrize(
    "boundary",
    [pytest.param(_ROOM, id="room"), *(pytest.param(b, id=i, marks=pytest.mark.slow) for b, i in _TURNING)],
)
def test_links(boundary, monkeypatch):
    case = _Case(_box(None, boundary))
    found = find_links(case.layout, case.transport.ordinates)
    monkeypatch.setattr(native, "serves", lambda *_: False)
    expected = find_links(case.layout, case.transport.ordinates)
    for method in ("arriving", "sent"):
        right = getattr(expected, method)(case.elements)
        _close(getattr(found, method)(case.elements), right, case.free)
        by_xla = jax.jit(lambda sent, method=method: getattr(found, method)(sent))  # along the same list
        _close(by_xla(case.elements), right, case.free)


@pytest.mark.parametrize(
    "name", ["vacuum", "around an axis, mirrored", pytest.param("around two axes", marks=pytest.mark.slow)]
)
def test_marks(name, monkeypatch):
    layout = _Case(_SCENES[name]()).layout
    ordinates = make_ordinates(rm.quadrature.for_scene(_SCENES[name](), 40), 1, plane_size(layout))
    found = mark_hits(layout, ordinates)
    monkeypatch.setattr(native, "serves", lambda *_: False)
    for one, other in zip(found, mark_hits(layout, ordinates), strict=True):
        for chunk, place in np.argwhere(np.asarray(one.weight) > 0):
            for bits in ("hit_bits", "probe_bits"):
                a, b = (np.asarray(getattr(o, bits))[chunk, place // 32] >> np.uint32(place % 32) & 1 for o in (one, other))
                np.testing.assert_array_equal(a, b)


def test_a_plain_install_gives_the_same_light(monkeypatch):
    scene = _SCENES["thin fog"]()
    found = rm.solve(scene, rm.quadrature.fibonacci(40), rtol=1e-8, progress=False)
    monkeypatch.setattr(native, "installed", lambda: False)
    expected = rm.solve(scene, rm.quadrature.fibonacci(40), rtol=1e-8, progress=False)
    np.testing.assert_allclose(found.fluence, expected.fluence, rtol=1e-7)
    np.testing.assert_allclose(found.surfaces.irradiance, expected.surfaces.irradiance, rtol=0, atol=1e-7)


# Loops that are kept


_LINKS = np.array([0, 1, 3]), np.array([2, 0, 1]), np.array([0.5, 1.0, 2.0]), np.array([[1.0, 10.0, 100.0]])


def _follow(loop: kept.Loop) -> np.ndarray:
    got = np.zeros((1, 2))
    loop(0, 2, *_LINKS, got)
    return got


@pytest.fixture
def folder(monkeypatch, tmp_path) -> Path:
    monkeypatch.setattr(kept, "_folder", lambda: tmp_path)
    return tmp_path


def test_a_loop_is_compiled_once_and_kept(monkeypatch, folder):
    np.testing.assert_array_equal(_follow(kept.Loop("vacuum", "follow")), [[50.0, 21.0]])
    (file,) = folder.glob("*.loop")
    monkeypatch.setattr(kept.Loop, "_compiled", lambda *_: pytest.fail("compiled again"))
    np.testing.assert_array_equal(_follow(kept.Loop("vacuum", "follow")), [[50.0, 21.0]])
    monkeypatch.undo()
    monkeypatch.setattr(kept, "_folder", lambda: folder)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2])  # cut short
    np.testing.assert_array_equal(_follow(kept.Loop("vacuum", "follow")), [[50.0, 21.0]])
    assert kept._read(file) is not None
    file.write_bytes(b"")
    file.chmod(0o600)
    folder.chmod(0o777)  # others may have written there
    assert kept._read(file) is None


def test_what_is_kept_needs_no_numba(folder):
    code = f"""
import pathlib, sys
import numpy as np
from raymanifold_jax.transport.machine_code import kept

kept._folder = lambda: pathlib.Path({str(folder)!r})
kept.get_ready()
got = np.zeros((1, 2))
kept.Loop("vacuum", "follow")(0, 2, np.array([0, 0, 1]), np.array([0]), np.array([0.5]), np.array([[4.0]]), got)
print("numba" in sys.modules, got.tolist() == [[0.0, 2.0]])
"""
    run = lambda: subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=300)
    first, second = run(), run()
    assert first.stdout.split() == ["True", "True"], first.stderr
    assert second.stdout.split() == ["False", "True"], second.stderr


def test_loops_take_arrays_without_gaps():
    loop = kept.Loop("vacuum", "follow")
    with pytest.raises(ValueError, match="got an array with gaps"):
        loop(0, 2, *_LINKS, np.zeros((1, 4))[:, ::2])


def test_processes_compile_one_at_a_time(folder):
    fcntl = pytest.importorskip("fcntl", reason="locks of files")
    loop = kept.Loop("vacuum", "follow")
    file = loop.file(0, 2, *_LINKS, np.zeros((1, 2)))
    with file.with_suffix(".lock").open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        waiting = threading.Thread(target=_follow, args=(loop,))
        waiting.start()
        waiting.join(2)
        waited = waiting.is_alive()
    waiting.join()
    assert waited and file.exists()


def test_loops_take_what_they_are_said_to_take():
    for x64, medium in itertools.product((False, True), (rm.Medium(2.0, 0.1), None)):
        with jax.enable_x64(x64):
            rm.solve(_box(medium, _ROOM, (3, 3, 3)), rm.quadrature.fibonacci(12), progress=False)
    for loop in (getattr(machine_code, name) for name in machine_code.__all__):
        if isinstance(loop, kept.Loop):
            said = {kept.form_of(loop.examples(np.dtype(real))) for real in (np.float32, np.float64)}
            assert set(loop._ready) == said, loop.name


def test_loops_are_compiled_by_processes_of_their_own(monkeypatch, folder):
    fcntl = pytest.importorskip("fcntl", reason="locks of files")
    commands, process = [], subprocess.Popen([sys.executable, "-c", ""])
    monkeypatch.setattr(kept.subprocess, "Popen", lambda command, **_: commands.append(command) or process)
    monkeypatch.setattr(kept, "count_cores", lambda: 2)
    loops = machine_code.tally, machine_code.follow
    begun = lambda real=float: (commands.clear(), kept.compile_aside(np.dtype(real), loops, ()), len(commands))[-1]
    assert begun() == 1
    kept._compile("<f8", ["tally"])
    assert {file.name for file in folder.glob("*.loop")} == {machine_code.tally.file(*[np.zeros(1, np.int32)] * 2).name}
    assert begun() == 1  # one is there, the other is not
    command = commands[0]
    follow = machine_code.follow.file(*machine_code.follow.examples(np.dtype(float)))
    with follow.with_suffix(".lock").open("a") as other:
        fcntl.flock(other, fcntl.LOCK_EX)
        kept._compile("<f8", ["follow"])  # somebody else is about to
        assert not follow.exists()
    kept._compile("<f8", ["follow"])
    assert follow.exists() and begun() == 0
    for name, value in {"executable": "/usr/bin/another", "frozen": True}.items():
        with monkeypatch.context() as patch:
            patch.setattr(sys, name, value, raising=False)
            assert begun(np.float32) == 0
    folder.chmod(0o777)  # others may write there: nothing of it is used
    assert begun(np.float32) == 0
    folder.chmod(0o700)
    monkeypatch.setattr(kept, "count_cores", lambda: 1)
    assert begun(np.float32) == 0
    monkeypatch.undo()
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)  # beside the sources, as these are kept
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_numba_that_does_not_import_is_told_and_left_alone(monkeypatch):
    def broken(*_):
        raise ImportError("Numba needs NumPy 1.0 or less")

    monkeypatch.setattr(native.importlib, "import_module", broken)
    with pytest.warns(UserWarning, match="sweeps take longer: Numba needs NumPy"):
        assert not native.installed.__wrapped__()


def test_single_precision_is_single():
    with jax.enable_x64(False):
        solution = rm.solve(_SCENES["thin fog"](), rtol=1e-3, progress=False)
        assert solution.fluence.dtype == np.float32
        assert solution.converged
