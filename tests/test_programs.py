"""Programs that are kept on disk: found again by what they are made from and by nothing less, and left alone else."""

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from raymanifold_jax import program_files, programs
from raymanifold_jax.operator import Light
from raymanifold_jax.program_files import keep_in
from raymanifold_jax.programs import program

traced = []  # once for every time that JAX traces the function


def weighted(light: Light, factor: float = 2.0, also=None):
    traced.append(factor)
    values = jnp.sort(jnp.sin(light.elements)) * factor
    return Light(values, light.voxels), {"sum": values.sum(), "factor": factor}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where programs are kept for this test, which counts as part of the package; the programs are those of one process."""
    monkeypatch.setattr(programs, "_KNOWN", programs._KNOWN | {__name__})
    monkeypatch.setattr(program_files, "_on_one_cpu", lambda: True)
    traced.clear()
    keep_in(tmp_path)
    yield tmp_path / "programs"
    keep_in(None)


def kept(folder) -> list[Path]:
    return sorted(file for file in folder.iterdir() if not file.name.startswith("task-"))


def in_a_new_process(*arguments, **named):
    """The result of a program that this process has not met, and how often it was traced."""
    before = len(traced)
    return program(weighted)(*arguments, **named), len(traced) - before


def light(count=5, dtype=np.float32) -> Light:
    return Light(np.linspace(0, 3, count).astype(dtype)[None])


def same(found, expected) -> None:
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_a_second_start_traces_nothing_and_has_the_same_numbers(folder):
    expected = weighted(light(), 3.0)
    first, count = in_a_new_process(light(), 3.0)
    assert count == 1 and len(kept(folder)) == 1
    second, count = in_a_new_process(light(), 3.0)
    assert count == 0
    same(first, second)
    np.testing.assert_allclose(second[0].elements, expected[0].elements, rtol=1e-6)
    assert second[1]["factor"] == 3.0 and second[0].voxels is None


@pytest.mark.parametrize(
    "other",
    [
        pytest.param((light(6), 3.0), id="shape"),
        pytest.param((light(dtype=np.int32), 3.0), id="dtype"),
        pytest.param((light(), 3.5), id="value"),
        pytest.param((light(), 3), id="kind of number"),
        pytest.param((Light(light().elements, light().elements), 3.0), id="tree"),
        pytest.param((light(), 3.0, np.sin), id="function"),
    ],
)
def test_other_arguments_are_another_program(folder, other):
    in_a_new_process(light(), 3.0)
    found, count = in_a_new_process(*other)
    assert count == 1 and found[1]["factor"] == other[1]
    assert len(kept(folder)) == 2
    assert in_a_new_process(*other)[1] == 0


def test_double_precision_is_another_program(folder, x64):
    found, _ = in_a_new_process(light(dtype=np.float64))
    assert found[0].elements.dtype == np.float64
    with jax.enable_x64(False):
        found, count = in_a_new_process(light(dtype=np.float64))
    assert count == 1 and found[0].elements.dtype == np.float32


def test_other_sources_or_versions_are_another_program(folder, monkeypatch):
    in_a_new_process(light())
    monkeypatch.setattr(program_files, "_circumstances", lambda: b"of another version")
    assert in_a_new_process(light())[1] == 1
    assert in_a_new_process(light())[1] == 0


def test_what_all_programs_depend_on(monkeypatch):
    """The environment of JAX and XLA, and versions."""
    digest = program_files._circumstances.__wrapped__
    before = digest()
    assert digest() == before
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "") + " ")
    changed = digest()
    assert changed != before
    monkeypatch.setattr(program_files, "version", lambda name: "0.0.1")
    assert digest() != changed


@pytest.mark.parametrize("damage", [lambda whole: b"", lambda whole: whole[:-9], lambda whole: whole[:99] + b"?" + whole[100:]])
def test_a_damaged_file_is_replaced(folder, damage):
    expected, _ = in_a_new_process(light())
    (file,) = kept(folder)
    file.write_bytes(damage(file.read_bytes()))
    found, count = in_a_new_process(light())
    assert count == 1
    same(found, expected)
    assert in_a_new_process(light())[1] == 0 and kept(folder) == [file]


def test_what_a_task_used_is_loaded_ahead(folder):
    """In the order of first use; what is not there any more is made again, and what is not asked for does no harm."""
    keep_in(folder.parent, "a task")
    expected = [in_a_new_process(light(n))[0] for n in (3, 4, 5)]
    (task,) = folder.glob("task-*")
    names = task.read_text().split()
    assert sorted(names) == [file.name for file in kept(folder)]
    (folder / names[1]).unlink()
    keep_in(folder.parent, "a task")
    found, counts = zip(*(in_a_new_process(light(n)) for n in (3, 4)), strict=True)
    same(list(found), expected[:2])
    assert counts == (0, 1) and task.read_text().split() == names
    task.write_bytes(b"\xff\0 nonsense")
    keep_in(folder.parent, "a task")
    assert in_a_new_process(light(3))[1] == 0
    keep_in(folder.parent, "another task")
    assert in_a_new_process(light(5))[1] == 0 and len(list(folder.glob("task-*"))) == 2


def test_where_jax_traces_programs_step_aside(folder):
    """Under `grad`, `jit` and `vmap` the function is part of the caller's program, and nothing is kept."""
    total = lambda values: program(weighted)(Light(values))[1]["sum"]
    values = jnp.asarray(light().elements)
    same(jax.grad(total)(values), jax.grad(lambda v: weighted(Light(v))[1]["sum"])(values))
    np.testing.assert_allclose(jax.jit(total)(values), total(values), rtol=1e-6)
    np.testing.assert_allclose(jax.vmap(total)(values[None]), [total(values)], rtol=1e-6)
    assert len(kept(folder)) == 1  # of the calls outside


def test_functions_of_others_are_not_known_by_their_names(folder, monkeypatch):
    """Somebody's function may change under the same name: its program is compiled in every process."""
    monkeypatch.setattr(programs, "_KNOWN", programs._KNOWN - {__name__})
    found, count = in_a_new_process(light(), also=light)
    assert count == 1 and found[1]["factor"] == 2.0
    assert in_a_new_process(light(), also=lambda: 1)[1] == 1
    assert not kept(folder)


def test_results_that_are_arguments(folder):
    """What passes through a program unchanged comes back as well."""
    given = Light(light().elements, jnp.ones((1, 2, 2, 2)))
    for _ in range(2):
        found, _ = in_a_new_process(given)
        np.testing.assert_array_equal(found[0].voxels, given.voxels)


@pytest.mark.skipif(not hasattr(os, "getuid"), reason="folders have no modes here")
def test_a_folder_that_others_can_write_to_is_not_used(tmp_path):
    (tmp_path / "programs").mkdir()
    (tmp_path / "programs").chmod(0o777)
    keep_in(tmp_path)
    assert program_files.folder() is None
    (tmp_path / "programs").chmod(0o700)
    keep_in(tmp_path)
    assert program_files.folder() is not None
    keep_in(None)
    assert program_files.folder() is None


def test_a_second_start_of_the_command_line(tmp_path):
    """It makes the same picture, to the last bit, from the programs of the first, and compiles next to nothing."""
    code = """
        import collections, jax
        from raymanifold_jax.cli import main
        counts = collections.Counter()
        jax.monitoring.register_event_duration_secs_listener(lambda event, *_, **__: counts.update([event]))
        main("render three-balls --size 6 --directions 24 --resolution 16 --quiet --out x.exr".split(), standalone_mode=False)
        print(counts["/jax/core/compile/backend_compile_duration"])
    """
    environment = {name: value for name, value in os.environ.items() if name != "JAX_COMPILATION_CACHE_DIR"}
    environment |= {"RAYMANIFOLD_CACHE": str(tmp_path / "cache"), "PYTHONPATH": os.pathsep.join(sys.path)}
    compiled, pictures = [], []
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-c", textwrap.dedent(code)], cwd=tmp_path, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        compiled.append(int(done.stdout))
        pictures.append((tmp_path / "x.exr").read_bytes())
    assert pictures[0] == pictures[1]
    assert compiled[0] > 50 and compiled[1] < 25, compiled
