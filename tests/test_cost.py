"""The cost report: formulae against counting, against the compiled program, and against the paper's numbers."""

import jax
import numpy as np
import problems
import pytest
from click.testing import CliRunner

import raymanifold_jax as rm
from raymanifold_jax.cli import main
from raymanifold_jax.cost import PAPER
from raymanifold_jax.operator import Light
from raymanifold_jax.quadrature import cube_points
from raymanifold_jax.surfaces import find_surfaces
from raymanifold_jax.transport.ray_cube_system import CubeTransport, make_cube_system


def test_the_papers_own_case():
    # N = 128, M = 5 on 64 x 32: 726 entries times 1024 nodes an element; 3.2e6 ray updates a second on the whole array.
    report = rm.cost_report(rm.scenes.ring(128))
    assert report.nodes == PAPER.nodes_per_element == 1024
    assert report.ray_updates == 726 * 1024 == PAPER.ray_updates
    assert report.ray_updates_once == 602 * 1024
    assert report.seconds_on_the_paper_machine == pytest.approx(480)
    assert PAPER.updates_per_second * 2048 == pytest.approx(3.2e6, rel=0.02)
    # 16 bytes a node is all that 16 KB an element leave; here a node takes 6 numbers of 4 bytes.
    assert report.scene_bytes == 1024 * 6 * 4


def test_exchange_is_what_leaves_the_blocks():
    # Count, node by node, the rays whose hop ends in another block.
    n, m, pe = 12, 2, (3, 2)
    report = rm.cost_report(rm.scenes.ring(n), rm.LightRayCube(m), pe)
    block, leaving = (n // pe[0], n // pe[1]), 0
    u, v = np.meshgrid(np.arange(block[0]), np.arange(block[1]), indexing="ij")
    points = cube_points(m)
    for axis in range(3):
        for hop in points[np.abs(points[:, axis]) == m]:
            p, q = hop[(axis + 1) % 3], hop[(axis + 2) % 3]
            stays = (u + p >= 0) & (u + p < block[0]) & (v + q >= 0) & (v + q < block[1])
            leaving += n * int((~stays).sum())
    assert report.exchanged_bytes == 4 * leaving
    # Two all-to-alls: 2/3 and 1/2 of what an element holds.
    assert report.rotation_bytes == round(report.scene_bytes * (2 / 3 + 1 / 2))


def test_one_element_exchanges_nothing():
    report = rm.cost_report(rm.scenes.ring(16), pe=(1, 1))
    assert report.exchanged_bytes == 0 and report.rotation_bytes == 0


@pytest.mark.parametrize("medium", [None, rm.Medium(1.0, 0.1)], ids=["vacuum", "fog"])
def test_scene_memory_is_what_the_compiled_program_holds(medium):
    # One element. Predicted: the numbers a node that go in and come out. The program's arguments and results hold the same
    # on a lattice with M inert nodes more an axis, and small tables of directions.
    n, m = 24, 2
    scene = rm.Scene(problems.cube(n), medium=medium, boundary=problems.walls(0.5))
    report = rm.cost_report(scene, rm.LightRayCube(m), pe=(1, 1))
    system = make_cube_system(scene, find_surfaces(scene), rm.LightRayCube(m)).system
    transport, stuff = system.transport, system.materials
    assert isinstance(transport, CubeTransport)
    fog = medium is not None

    def evolve(fields, elements, voxels):
        there = CubeTransport(transport.lattice, transport.scheme, transport.faces, fields, transport.cell)
        arrived = there(Light(elements, voxels), fluence=fog)
        return (arrived.elements, arrived.voxels) if fog else arrived.elements

    program = jax.jit(evolve).lower(transport.fields, stuff.albedo, stuff.scattering_albedo).compile()
    analysis = program.memory_analysis()
    assert analysis is not None
    held = analysis.argument_size_in_bytes + analysis.output_size_in_bytes
    # Exitance and arriving light come as lists of SURFACE nodes.
    lists = 2 * (n**3 - len(stuff.albedo[0])) * 4
    padding = ((n + m) / n) ** 3
    assert 0.95 * (report.scene_bytes - lists) < held < 1.05 * padding * (report.scene_bytes - lists) + 1e5


def test_characteristic_scheme_and_larger_arrays():
    scene = rm.scenes.three_balls_in_fog(128)
    cube, ours = rm.cost_report(scene), rm.cost_report(scene, rm.Characteristic())
    assert ours.ray_updates == 200 * 1024 and ours.exchanged_bytes < cube.exchanged_bytes
    large = rm.cost_report(scene, pe=(128, 128))
    assert large.nodes == 128 and large.largest_size > cube.largest_size
    assert large.bytes_at_512 > 512**3 / 128**2 * 9 * 4


def test_command_line():
    result = CliRunner().invoke(main, ["cost", "ring", "--size", "128"])
    assert result.exit_code == 0 and "743,424" in result.output and "16 KB" in result.output
    for arguments, message in (
        (["--pe", "0x3"], "64x32"),
        (["--size", "16"], "at most 16 elements"),
        (["--half-width", "0"], "1 to 64"),
    ):
        failed = CliRunner().invoke(main, ["cost", "ring", *arguments])
        assert failed.exit_code == 2 and message in failed.output, failed.output


def test_bad_input():
    scene = rm.scenes.ring(64)
    with pytest.raises(TypeError, match="pe: got 64"):
        rm.cost_report(scene, pe=64)
    with pytest.raises(ValueError, match="pe: got"):
        rm.cost_report(scene, pe=(65, 2))
    with pytest.raises(ValueError, match="quadrature"):
        rm.cost_report(scene, rm.LightRayCube(), quadrature=rm.quadrature.fibonacci(50))
    with pytest.raises(TypeError, match="scheme"):
        rm.cost_report(scene, "cube")
