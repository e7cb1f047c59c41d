"""The package imports without JAX, and its lazy names are the ones that type checkers are told of."""

import ast
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import raymanifold_jax as rm


def in_new_process(code: str) -> None:
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_import_does_not_load_jax():
    in_new_process(
        "import sys; import raymanifold_jax as rm; dir(rm); rm.__version__\n"
        "heavy = {'jax', 'numpy', 'equinox', 'rich', 'OpenEXR', 'PIL'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )


@pytest.mark.parametrize("name", rm.__all__)
def test_every_public_name_loads(name):
    assert getattr(rm, name) is not None
    assert name in dir(rm)


def test_submodule_needs_no_import():
    in_new_process("import raymanifold_jax as rm; assert callable(rm.quadrature.fibonacci)")


@pytest.mark.parametrize("name", ["solve", "render"])
@pytest.mark.parametrize("first", ["import raymanifold_jax.{0}", "from raymanifold_jax.{0} import {0}", "rm.{0}"])
def test_function_is_not_hidden_by_its_module(name, first):
    # The import system binds a submodule on its package; rm.solve(...) would then fail, depending on who imported what.
    in_new_process(
        f"import raymanifold_jax as rm\n{first.format(name)}\nassert callable(rm.{name})\n"
        f"from raymanifold_jax import {name}\nassert callable({name})"
    )


def test_unknown_name():
    with pytest.raises(AttributeError, match="no attribute 'radiosty'"):
        _ = rm.radiosty  # pyright: ignore[reportAttributeAccessIssue]
    assert not hasattr(rm, "__wrapped__")


def test_type_checkers_know_the_same_names():
    tree = ast.parse(Path(str(rm.__file__)).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    declared = {}
    for node in block.body:
        assert isinstance(node, ast.ImportFrom) and node.module is not None
        for alias in node.names:
            assert alias.name == alias.asname, "only `import x as x` is a re-export"
            declared[alias.name] = node.module
    lazy = {name: f"{rm.__name__}.{module}" for name, module in rm._MODULE_OF.items()}
    assert declared == lazy | dict.fromkeys(rm._SUBMODULES, rm.__name__)
    assert isinstance(rm, ModuleType)
