"""Random arguments, right and wrong: a scene's parts and the command line answer with what was asked, or say what was wrong.

An error is a `ValueError` or `TypeError` that tells what it got and what it expected; nothing crashes, hangs or writes a file.
Damaged files have tests like these beside those of their formats.
"""

import contextlib

import numpy as np
import pytest
from click.testing import CliRunner
from hypothesis import example, given, settings
from hypothesis import strategies as st

import raymanifold_jax as rm
from raymanifold_jax import cli

NUMBERS = st.one_of(
    st.sampled_from([0, 1, -1, 0.5, 2.0, 1e-30, 1e30, float("nan"), float("inf"), -0.0, True, None, "0.5", 1j, b"1", [], {}]),
    st.floats(-3, 3),
)
VECTORS = st.one_of(
    st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    st.lists(NUMBERS, max_size=4),
    st.sampled_from([(0, 0, 0), (0, 0, 1), (1e-40, 0, 0), "xyz", 1.0, None, np.zeros((3, 3)), [[1, 2, 3]]]),
)
VALUES = st.one_of(
    st.floats(0, 1),
    NUMBERS,
    st.lists(st.floats(0, 1), min_size=1, max_size=4),
    st.sampled_from([np.ones((2, 2)), np.full((4, 4, 4), 0.3), np.full((4, 4, 4, 3), 0.3), np.ones((4, 4, 5)), lambda w: w]),
)
SIDES = st.one_of(st.sampled_from([rm.OPEN, rm.MIRROR, rm.PERIODIC, rm.Wall(0.5), "open", None, 0.5]))

SHAPES = st.one_of(
    st.tuples(st.just(rm.Sphere), VECTORS, NUMBERS),
    st.tuples(st.just(rm.Box), VECTORS, VECTORS),
    st.tuples(st.just(rm.Torus), VECTORS, NUMBERS, NUMBERS, VECTORS),
    st.tuples(st.just(rm.Cylinder), VECTORS, VECTORS, NUMBERS),
    st.tuples(st.just(rm.HalfSpace), VECTORS, VECTORS),
    st.tuples(st.just(rm.Voxels), VALUES, st.just(rm.Lattice((4, 4, 4), 0.25))),
)
LIGHTS = st.one_of(
    st.tuples(st.just(rm.Sky), VALUES, VECTORS),
    st.tuples(st.just(rm.Sun), VECTORS, VALUES),
    st.tuples(st.just(rm.PointLight), VECTORS, VALUES),
)
KINDS = st.one_of(st.integers(-1, 18), NUMBERS)
MESH = rm.Mesh(
    np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]), np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]), 8
)
PARTS = st.one_of(
    SHAPES,
    LIGHTS,
    st.tuples(st.just(rm.skies.cie), KINDS, VECTORS, VALUES, st.one_of(st.none(), VALUES), VECTORS, VALUES),
    st.tuples(st.just(rm.skies.cie), KINDS, VECTORS, st.none(), VALUES),
    st.tuples(st.just(rm.Texture), VALUES, st.sampled_from(["x", "z", "w", 1]), VECTORS, VECTORS),
    st.tuples(
        st.just(rm.Texture.on_faces), st.sampled_from([MESH, MESH.translate((1, 0, 0)), rm.Box((0, 0, 0), (1, 1, 1))]), VALUES
    ),
    st.tuples(st.just(rm.Lattice), st.one_of(VECTORS, st.lists(st.integers(-1, 9), min_size=3, max_size=3)), NUMBERS, VECTORS),
    st.tuples(st.just(rm.Wall), VALUES, VALUES),
    st.tuples(st.just(rm.Medium), VALUES, VALUES, VALUES),
    st.tuples(
        st.just(rm.PerspectiveCamera), VECTORS, VECTORS, VECTORS, NUMBERS, st.sampled_from([(8, 8), (0, 8), (8.5, 8), 8, "8x8"])
    ),
    st.tuples(st.just(rm.OrthographicCamera), VECTORS, VECTORS, VECTORS, NUMBERS, NUMBERS),
    st.tuples(st.just(rm.Boundary), SIDES, SIDES, st.tuples(SIDES, SIDES)),
)


def made(call):
    """What (function, *arguments) returns; None if it refuses in the house's way."""
    function, *arguments = call
    try:
        return function(*arguments)
    except (ValueError, TypeError) as error:
        assert "expected" in str(error) and "got" in str(error), (call, error)
        return None


@settings(max_examples=2000, deadline=None)
@given(PARTS)
def test_parts_are_made_or_refused(call):
    made(call)


@settings(max_examples=500, deadline=None)
@given(
    st.lists(st.tuples(SHAPES, VALUES, VALUES), max_size=2), st.lists(LIGHTS, max_size=2), st.tuples(VALUES, VALUES, VALUES),
    st.tuples(SIDES, SIDES, SIDES),
)  # fmt: skip
def test_scenes_are_made_or_refused(solids, lights, medium, sides):
    """Of parts that are right each by itself: numbers of bands and shapes of fields may not go together."""
    shapes = [(made(shape), albedo, emission) for shape, albedo, emission in solids]
    bodies = [made((rm.Solid, shape, albedo, emission)) for shape, albedo, emission in shapes if shape is not None]
    parts = [body for body in bodies if body is not None], [light for light in map(made, lights) if light is not None]
    boundary = made((rm.Boundary, *sides)) or rm.Boundary()
    scene = made((rm.Scene, rm.Lattice((4, 4, 4), 0.25), parts[0], made((rm.Medium, *medium)), parts[1], boundary))
    assert scene is None or scene.bands >= 1


class _Reached(Exception):
    """A solve was about to begin."""


WORDS = st.one_of(
    st.sampled_from(
        ["ring", "three-balls", "nowhere", "x.toml", "0", "-1", "1e9", "nan", "8x8", "2x", "", "out.exr", "south", "é", "--"]
    ),
    st.integers(-5, 10**12).map(str),
    st.text(max_size=6),
)
OPTIONS = [
    "--size", "--directions", "--rtol", "--resolution", "--samples", "--exposure", "--camera", "--turntable", "--all-views",
    "--fly-through",
    "--out", "--half", "--layers", "--quiet", "--checkpoint", "--resume", "--save", "--pe", "--half-width",
    "--characteristic", "--force",
]  # fmt: skip


@settings(max_examples=1500, deadline=None)
@given(
    st.sampled_from(["render", "solve", "info", "cost", "init", "scenes", "nonsense"]),
    st.lists(st.one_of(WORDS, st.sampled_from(OPTIONS)), max_size=6),
)
@example("init", ["\0"])
@example("render", ["ring", "--out", "\0.exr"])
@example("solve", ["ring", "--save", "\0.npz"])
@example("solve", ["ring", "--checkpoint", "\0"])
def test_command_lines_are_run_or_refused(tmp_path_factory, command, words):
    def stop(*_, **__):
        raise _Reached

    before = cli._solve, cli._start
    cli._solve, cli._start = stop, lambda pe: None
    try:
        with contextlib.chdir(tmp_path_factory.getbasetemp()):
            result = CliRunner().invoke(cli.main, [command, *words])
    finally:
        cli._solve, cli._start = before
    assert isinstance(result.exception, SystemExit | _Reached | None), (command, words, result.exception)
    if isinstance(result.exception, SystemExit) and result.exit_code:
        assert "Error" in result.output and "Traceback" not in result.output, (command, words, result.output)


def test_the_tests_of_messages_can_fail():
    with pytest.raises(AssertionError):
        made((float, "x"))
