"""A mesh of devices computes what one device does.

Sums over directions and elements are added up in another order there, and nothing else: results agree to a few units in the
last place of float64 (1e-12 of the largest value; what a wrong neighbour or a lost ray costs is 1e-3 or more).
`test_meshes_of_devices.py` runs these tests on virtual devices; RAYMANIFOLD_TEST_DEVICES=8 does so for pytest itself (32: the
slow ones).
"""

import os
import re
import socket
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType

import raymanifold_jax as rm
from raymanifold_jax.blocks import even, full, make_moves, positions
from raymanifold_jax.direct import sky_inflow
from raymanifold_jax.layout import flat_planes, make_ordinates
from raymanifold_jax.operator import Light, materials
from raymanifold_jax.partition import FIELD, make_partition
from raymanifold_jax.placement import known, restored, stored
from raymanifold_jax.prepare import prepare
from raymanifold_jax.shift import Ring, shift
from raymanifold_jax.transport.characteristic import SweptMedium
from raymanifold_jax.transport.emulated import Elements, evolution_on_elements
from raymanifold_jax.transport.light_ray_cube import coordinate_evolution
from raymanifold_jax.transport.ray_cube_system import make_cube_system
from raymanifold_jax.transport.sharded import adjoint_over, laps_over, mark_over, plane_size, slopes_over, sweep_over

_EXACT = 1e-12
_QUADRATURE = rm.quadrature.fibonacci(48)


def scene(kind: str, shape: tuple[int, int, int]) -> rm.Scene:
    wall = rm.Wall(albedo=0.6)
    sides = {
        "open": rm.Boundary(x=(wall, rm.OPEN), y=(rm.OPEN, wall), z=(wall, rm.OPEN)),
        "mirror": rm.Boundary(x=(rm.MIRROR, rm.OPEN), y=(rm.OPEN, rm.MIRROR), z=(rm.MIRROR, wall)),
        "periodic": rm.Boundary(x=rm.PERIODIC, y=rm.PERIODIC, z=rm.PERIODIC),
        "mixed": rm.Boundary(x=(rm.MIRROR, rm.MIRROR), y=rm.PERIODIC, z=(wall, rm.OPEN)),
    }[kind]
    ball = rm.Solid(rm.Sphere((0.45, 0.5, 0.4), 0.25), albedo=0.7, emission=0.5)
    lights = [] if kind == "periodic" else [rm.Sky(radiance=1.0)]
    lattice = rm.Lattice(shape, spacing=1 / shape[0])
    # Voxels more than 0.1 free paths thick: scattered light has slopes.
    return rm.Scene(lattice, [ball], medium=rm.Medium(scattering=2.0, absorption=0.5), lights=lights, boundary=sides)


def close(mesh: object, one: object, tolerance: float = _EXACT) -> None:
    for a, b in zip(jax.tree.leaves(mesh), jax.tree.leaves(one), strict=True):
        a, b = known(a), np.asarray(b)
        assert a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * max(1.0, np.abs(b).max()))


def test_blocks_hold_every_column_once():
    for count, parts in ((7, 4), (8, 4), (4, 4), (9, 2), (5, 1)):
        for table in (even(count, parts, 2), full(count, parts)):
            assert sorted(table[table >= 0]) == list(range(count))
            np.testing.assert_array_equal(table.ravel()[positions(table)], np.arange(count))
        assert np.all(even(count, parts)[:, 0] >= 0)  # a ring has no gap


def test_columns_move_between_splits():
    """To mirrored, padded blocks and to plain ones: what arrives is what was asked for."""
    mesh = rm.pe_array(4, 2)
    source = full(6, 4)
    wanted = even(14, 4)
    image = np.concatenate([[-1], np.arange(6), np.arange(6)[::-1], [-1]])
    wanted = np.where(wanted >= 0, image[wanted], -1)
    moves = make_moves("u", source, wanted)
    values = np.where(source >= 0, 10.0 + source, 0.0).ravel()
    spec = jax.sharding.PartitionSpec("u")
    got = jax.jit(jax.shard_map(lambda f: moves(f, 0), mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False))(values)
    np.testing.assert_array_equal(got, np.where(wanted >= 0, 10.0 + wanted, 0.0).ravel())


@pytest.mark.parametrize("kind, shape", [("mixed", (3, 7, 4)), ("open", (7, 5, 6))])
def test_planes_of_blocks_are_the_planes_of_the_lattice(kind, shape):
    """Turned to each sweep axis and back, in uneven blocks; unfolded and padded like on one device."""
    if kind == "mixed":
        shape = (4, 7, 4)
    layout = prepare(scene(kind, shape)).layout
    partition = make_partition(layout, rm.pe_array(4, 2))
    field = np.random.default_rng(0).random((2, *shape)).astype(np.float32)
    padded = partition.to_padded(stored(partition, jnp.asarray(field)))
    expected = np.asarray(layout.to_padded(jnp.asarray(field)))
    rows, columns = (positions(partition.shapes.split(axis, name)) for axis, name in enumerate("uv"))
    np.testing.assert_array_equal(np.asarray(padded)[:, rows][:, :, columns], expected)
    close(restored(partition, partition.from_padded(padded)), layout.from_padded(jnp.asarray(expected)), 1e-6)
    for axis, (_, u, v) in enumerate(((0, 1, 2), (1, 2, 0), (2, 0, 1))):

        def turned(block, _, field, __, axis=axis):
            planes = block.planes(field, axis)
            _, height, width = block.padded_along(axis)
            back = block.from_planes(planes, axis)
            return planes.reshape(*planes.shape[:2], height, width), back

        out = (jax.sharding.PartitionSpec(None, None, "u", "v"), FIELD)
        planes, back = jax.jit(lambda f, turned=turned, out=out: partition.on_blocks(turned, (), f, (), out))(padded)
        rows, columns = (positions(partition.shapes.split(a, name)) for a, name in ((u, "u"), (v, "v")))
        picked = np.asarray(planes)[:, :, rows][:, :, :, columns]
        np.testing.assert_array_equal(picked.reshape(*picked.shape[:2], -1), flat_planes(jnp.asarray(expected), axis))
        close(back, padded, 0.0)


@pytest.mark.parametrize("nu, nv", [(4, 2), (1, 2), (2, 1)])
def test_rays_move_around_the_ring_as_on_one_device(nu, nv):
    """A periodic plane of 7 x 5 voxels in uneven blocks."""
    height, width = 7, 5
    rows, columns = even(height, nu), even(width, nv, 2)
    values = np.random.default_rng(1).random((5, 1, height, width))
    moves = np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
    offsets = jnp.asarray(moves @ [width, 1])
    expected = shift(jnp.asarray(values.reshape(5, 1, -1)), offsets, width, True).reshape(values.shape)
    blocked = values[:, :, np.maximum(rows, 0).ravel()][:, :, :, np.maximum(columns, 0).ravel()]
    size = rows.shape[1], columns.shape[1]

    def local(values):
        here = jax.lax.axis_index("u"), jax.lax.axis_index("v")
        used = [jnp.sum(jnp.asarray(table)[i] >= 0) for table, i in zip((rows, columns), here, strict=True)]
        flat = jnp.asarray(moves @ [size[1], 1])
        moved = shift(values.reshape(5, 1, -1), flat, size[1], False, Ring(*size, used[0], used[1], (nu, nv)))
        return moved.reshape(values.shape)

    spec = jax.sharding.PartitionSpec(None, None, "u", "v")
    got = jax.jit(jax.shard_map(local, mesh=rm.pe_array(nu, nv), in_specs=spec, out_specs=spec, check_vma=False))(blocked)
    np.testing.assert_array_equal(got[:, :, positions(rows)][:, :, :, positions(columns)], expected)


def both_ways(layout, of: rm.Scene, transposed: bool):
    """A sweep with slopes and a sky, and its transpose; and the text of the compiled sweep."""
    rng = np.random.default_rng(2)
    prepared = prepare(of)
    stuff = materials(of, prepared.surfaces)
    extinction, albedo = stored(layout, (stuff.extinction, stuff.scattering_albedo))
    ordinates = mark_over(layout, make_ordinates(_QUADRATURE.mirrored(layout.unfolding.axes), 1, plane_size(layout)))
    padded = layout.to_padded(extinction)
    ordinates, longest = jax.jit(laps_over, static_argnums=3)(layout, ordinates, padded, 100)
    exitance = stored(layout, jnp.asarray(rng.random((1, layout.elements))))
    source = stored(layout, jnp.asarray(rng.random((1, *of.lattice.shape))))
    inflow = sky_inflow(of, layout, _QUADRATURE)

    def run(layout, ordinates, padded, exitance, source):
        slopes = slopes_over(layout, source, albedo, padded)
        medium = SweptMedium(padded, layout.to_padded(source), False, slopes, True)
        return sweep_over(layout, ordinates, exitance, medium, inflow, True)

    def back(layout, ordinates, padded, exitance, source):
        zero = jnp.zeros_like(padded)
        found = adjoint_over(layout, ordinates, exitance, source, None, SweptMedium(padded, zero, False, (zero,) * 3, True))
        return found.exitance, found.source, [layout.from_padded(s) for s in found.slopes]

    compiled = jax.jit(run).lower(layout, ordinates, padded, exitance, source).compile()
    results = [compiled(layout, ordinates, padded, exitance, source)]
    if transposed:
        results.append(jax.jit(back)(layout, ordinates, padded, exitance, source))
    return restored(layout, results), int(longest), compiled.as_text()


def agree(kind: str, shape: tuple[int, int, int], meshes, transposed: bool) -> None:
    of = scene(kind, shape)
    layout = prepare(of).layout
    expected, laps, _ = both_ways(layout, of, transposed)
    for nu, nv in meshes:
        partition = make_partition(layout, rm.pe_array(nu, nv))
        found, laps_here, text = both_ways(partition, of, transposed)
        assert laps_here == laps
        close(found, expected)
        if nu * nv > 1:
            gathers_no_field(text, layout.elements)


def gathers_no_field(text: str, elements: int) -> None:
    """The compiled program gathers nothing larger than a value an element, and does exchange rims."""
    assert "collective-permute" in text
    for found in re.finditer(r"= \(?(\w+)\[([\d,]*)\][^=\n]* all-gather(?:-start)?\(", text):
        size = np.prod([int(n) for n in found.group(2).split(",") if n])
        assert size <= elements, found.group(0)


def test_a_sweep_and_its_transpose_over_uneven_blocks(x64):
    agree("open", (7, 7, 7), [(4, 2)], transposed=True)


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, shape, meshes",
    [
        ("open", (8, 8, 8), [(1, 1), (2, 1), (1, 4), (2, 4), (8, 4)]),
        ("mirror", (5, 5, 5), [(4, 2)]),
        ("periodic", (7, 7, 7), [(4, 2)]),
        ("mixed", (5, 7, 6), [(1, 4)]),
    ],
)
def test_sweeps_over_many_meshes(x64, kind, shape, meshes):
    agree(kind, shape, meshes, transposed=True)


def cube_both_ways(of: rm.Scene, scheme: rm.LightRayCube, mesh):
    """A coordinate evolution and its transpose, laps around periodic axes, and the text of the compiled evolution."""
    cube = make_cube_system(of, prepare(of).surfaces, scheme, mesh)
    transport, rng = cube.system.transport, np.random.default_rng(2)
    light = lambda: Light(jnp.asarray(rng.random((1, len(cube.nodes.cell)))), jnp.asarray(rng.random((1, *of.lattice.shape))))
    sent, asked = stored(transport.lattice, (light(), light()))
    compiled = eqx.filter_jit(lambda transport, sent, sky: transport(sent, sky)).lower(transport, sent, cube.sky).compile()
    found = compiled(transport, sent, cube.sky), transport.transposed(asked)
    return restored(transport.lattice, found), np.asarray(transport.faces.laps), compiled.compiled.as_text()


@pytest.mark.parametrize(
    "kind, shape, scheme, meshes",
    [
        ("open", (7, 7, 7), rm.LightRayCube(2, "exponential"), [(4, 2)]),
        pytest.param("open", (7, 9, 8), rm.LightRayCube(2, "exponential"), [(4, 2)], marks=pytest.mark.slow),
        pytest.param("periodic", (7, 7, 7), rm.LightRayCube(1), [(2, 4)], marks=pytest.mark.slow),
        # Blocks narrower than M: halos of several blocks.
        pytest.param(
            "open",
            (9, 9, 9),
            rm.LightRayCube(3, "linear", "ends"),
            [(1, 1), (2, 1), (1, 4), (4, 2), (8, 4)],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_coordinate_evolutions_over_meshes(x64, kind, shape, scheme, meshes):
    of = scene(kind, shape)
    expected, laps, _ = cube_both_ways(of, scheme, None)
    for nu, nv in meshes:
        found, laps_here, text = cube_both_ways(of, scheme, rm.pe_array(nu, nv))
        np.testing.assert_array_equal(laps_here, laps)
        close(found, expected)
        if nu * nv > 1:
            gathers_no_field(text, 0)


@pytest.mark.parametrize(
    "kind, size, half_width, pe",
    [
        ("open", 9, 2, (4, 2)),
        pytest.param("periodic", 7, 1, (2, 4), marks=pytest.mark.slow),
        pytest.param("open", 64, 1, (64, 32), marks=pytest.mark.slow),
    ],
)
def test_an_emulated_array_of_elements(kind, size, half_width, pe):
    """2048 elements, as many as the paper's machine had: the same light to the last bit, element by element."""
    of = scene(kind, (size,) * 3)
    cube = make_cube_system(of, prepare(of).surfaces, rm.LightRayCube(half_width, "exponential"))
    transport, rng = cube.system.transport, np.random.default_rng(2)
    number = lambda *shape: jnp.asarray(rng.random(shape), jnp.float32)
    fields = transport._with_light(Light(number(1, len(cube.nodes.cell)), number(1, size, size, size)))
    expected = coordinate_evolution(transport.lattice, fields, transport.faces, transport.scheme, cube.sky)
    elements = Elements(transport.lattice, pe)
    found = evolution_on_elements(elements, fields, transport.faces, transport.scheme, cube.sky, True)
    close(found, expected, 2e-7)


def _quantities(parameters, kind, shape, mesh, scheme=None):
    """Two numbers of a solution: they hang on every bounce."""
    of = scene(kind, shape)
    ball = rm.Solid(of.solids[0].shape, albedo=parameters[0], emission=0.5)
    medium = rm.Medium(scattering=parameters[1], absorption=0.5)
    lights = [*of.lights, rm.PointLight((0.8, 0.8, 0.8), intensity=parameters[2])]
    of = rm.Scene(of.lattice, [ball], medium=medium, lights=lights, boundary=of.boundary)
    quadrature = _QUADRATURE if scheme is None else None
    solution = rm.solve(of, quadrature, rtol=1e-10, mesh=mesh, scheme=scheme or rm.Characteristic(), progress=False)
    return jnp.mean(solution.fluence) + jnp.mean(solution.surfaces.irradiance), solution.fluence


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind, shape, nu, nv",
    [("open", (8, 8, 8), 4, 2), ("open", (8, 8, 8), 8, 4), ("mixed", (5, 7, 6), 1, 4)],
)
def test_solutions_and_gradients_do_not_depend_on_the_mesh(x64, kind, shape, nu, nv):
    """Solved to 1e-10, which the bound on the iteration's error keeps; derivatives' residuals are a tenth of that."""
    parameters = jnp.array([0.7, 2.0, 1.5])
    run = lambda mesh: jax.value_and_grad(_quantities, has_aux=True)(parameters, kind, shape, mesh)
    close(run(rm.pe_array(nu, nv)), run(None), 1e-8)


@pytest.mark.slow
def test_solutions_and_gradients_of_the_papers_scheme_do_not_depend_on_the_mesh(x64):
    parameters, scheme = jnp.array([0.7, 2.0, 1.5]), rm.LightRayCube(2, "exponential")
    run = lambda mesh: jax.value_and_grad(_quantities, has_aux=True)(parameters, "open", (8, 8, 8), mesh, scheme)
    close(run(rm.pe_array(4, 2)), run(None), 1e-8)


@pytest.mark.parametrize("scheme", [pytest.param(rm.LightRayCube(2), marks=pytest.mark.slow), rm.Characteristic()])
def test_predicted_messages_are_those_of_the_compiled_program(scheme):
    """Bytes that a device sends for one hop of a direction, from the shapes of the compiled program's permutes."""
    of = scene("open", (12, 12, 12))
    mesh = rm.pe_array(4, 2)
    if isinstance(scheme, rm.LightRayCube):
        cube = make_cube_system(of, prepare(of).surfaces, scheme, mesh)
        transport, hops, directions = cube.system.transport, 12 // 2, 6 * 25
        sent = stored(transport.lattice, Light(jnp.ones((1, len(cube.nodes.cell))), jnp.ones((1, 12, 12, 12))))
        program = eqx.filter_jit(lambda transport, sent: transport(sent)).lower(transport, sent).compile().compiled
        chunk, text = transport.faces.hop.shape[2], program.as_text()
    else:
        layout = prepare(of).layout
        partition = make_partition(layout, mesh)
        ordinates = mark_over(partition, make_ordinates(_QUADRATURE, 1, plane_size(partition)))
        exitance = stored(partition, jnp.ones((1, layout.elements)))
        run = lambda partition, ordinates, exitance: sweep_over(partition, ordinates, exitance, None, None, False)
        text = jax.jit(run).lower(partition, ordinates, exitance).compile().as_text()
        chunk, hops, directions = ordinates[0].direction.shape[1], 12, len(_QUADRATURE)
    # The second branch is for planes without surfaces: one or the other runs.
    shapes = re.findall(r"= f32\[([\d,]+)\]\S* collective-permute\((?!.*branch_1).*while/body/.*while/body", text)
    sizes = [[int(n) for n in found.split(",")] for found in shapes]
    permuted = sum(4 * int(np.prod(size)) for size in sizes if size[0] == chunk)
    predicted = rm.cost_report(of, scheme, (4, 2), None if isinstance(scheme, rm.LightRayCube) else _QUADRATURE)
    assert permuted > 0
    assert predicted.sent_bytes / (directions * hops) == permuted / chunk


def test_a_mesh_that_cannot_be_used_is_refused():
    of = scene("open", (4, 4, 4))
    other = jax.make_mesh((2, 2), ("x", "y"), axis_types=(AxisType.Auto,) * 2)
    with pytest.raises(ValueError, match=r"mesh: got axes \('x', 'y'\), expected axes \('u', 'v'\)"):
        rm.solve(of, mesh=other)
    with pytest.raises(ValueError, match="8 x 1 elements for 4 x 4 x 4 voxels, expected at most 4 elements a side"):
        rm.solve(of, mesh=rm.pe_array(8, 1))
    with pytest.raises(TypeError, match="pe_array"):
        rm.solve(of, mesh=(4, 2))
    with pytest.raises(ValueError, match=r"16 x 4 elements, expected at most the 8 CPU .* JAX_NUM_CPU_DEVICES=64"):
        rm.pe_array(16, 4)
    with pytest.raises(ValueError, match="nu"):
        rm.pe_array(0, 2)

    def traced(radiance):
        lit = rm.Scene(of.lattice, lights=[rm.Sky(radiance)], boundary=of.boundary)
        return rm.solve(lit, mesh=rm.pe_array(2, 1)).fluence

    with pytest.raises(TypeError, match="under jit"):
        jax.jit(traced)(1.0)


def own_environment() -> dict[str, str]:
    """For a process that makes its devices itself."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")}
    return inherited | {"PYTHONPATH": str(Path(rm.__file__).parents[1])}


def test_devices_are_made_before_jax_starts():
    """In a process of its own, because JAX starts once."""
    code = "import raymanifold_jax as rm; import jax; print(dict(rm.pe_array(3, 2).shape), jax.device_count())"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=own_environment(), timeout=120)
    assert found.stdout.strip() == "{'u': 3, 'v': 2} 6", found.stderr


def processes(folder: Path, **signals: str) -> list[tuple[str, int]]:
    """What two processes of two devices each print, and their exit codes; the files they write are in `folder`."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    script = Path(__file__).with_name("two_processes.py")
    command = lambda n: [sys.executable, str(script), "2", str(n), str(port), str(folder / f"{n}.npz")]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "env": own_environment() | signals}
    started = [subprocess.Popen(command(n), **pipes) for n in range(2)]
    try:
        return [(p.communicate(timeout=900)[0], p.returncode) for p in started]
    finally:
        for process in started:
            process.kill()


@pytest.mark.slow
def test_two_processes_solve_what_one_does(tmp_path):
    """In float32: 1e-5, some hundred units in the last place, where other compilers' choices are summed in 8 sweeps."""
    for text, code in processes(tmp_path):
        assert code == 0, text
    subprocess.run(
        [sys.executable, str(Path(__file__).with_name("two_processes.py")), str(tmp_path / "one.npz")],
        timeout=900, check=True, env=own_environment(),
    )  # fmt: skip
    first, second, expected = (np.load(tmp_path / f"{name}.npz") for name in ("0", "1", "one"))
    for key in ("fluence", "irradiance"):
        np.testing.assert_array_equal(first[key], second[key])
        np.testing.assert_allclose(first[key], expected[key], rtol=0, atol=1e-5 * expected[key].max())


@pytest.mark.slow
def test_a_peer_that_dies_ends_the_other_with_an_error(tmp_path):
    (text, code), (_, killed) = processes(tmp_path, DIES="1")
    assert killed == 3
    assert code != 0 and "Error" in text
    assert not (tmp_path / "0.npz").exists()


@pytest.mark.slow
def test_processes_that_disagree_on_the_scene_are_told(tmp_path):
    for text, code in processes(tmp_path, ALTERS="1"):
        assert code != 0
        assert "scene: got another one in process(es) 1 than in process 0" in text
