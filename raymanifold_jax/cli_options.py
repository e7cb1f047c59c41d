"""Options of the command line: how their values are read and refused, before any work.

Only click is imported here. Names with an underscore at their head aside, all is for `cli`.
"""

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from .scenes import SceneEntry

_LARGEST_PICTURE = 16384  # pixels a side
_FEWEST_DIRECTIONS = 24  # with fewer, the six faces of the sweep get no more than a few each


class SceneName(click.ParamType):
    """A scene by its name. `before(ctx, name)` is called before anything heavy is imported."""

    name = "scene"

    def __init__(self, before: Callable[[click.Context, str], None] | None = None):
        self._before = before

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> "SceneEntry":
        if self._before is not None and ctx is not None:
            self._before(ctx, str(value))
        from .scenes import find

        if str(value).lower().endswith(".toml"):
            with one_line_errors():
                return _scene_file(value)
        try:
            return find(value)
        except ValueError as error:
            self.fail(str(error), param, ctx)


class FileName(click.Path):
    """A path, which need not be there."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if "\0" in str(value):
            self.fail(f"got {str(value)!r}, expected no null character; write another name", param, ctx)
        return super().convert(value, param, ctx)


def _scene_file(path: str) -> "SceneEntry":
    """A scene file as an entry of the catalogue."""
    from .io import load_scene
    from .scenes import STANDARD_VIEWS, SceneEntry

    file = load_scene(path)
    size = max(file.scene.lattice.shape)
    build = lambda n: file.scene if n == size else load_scene(path, n).scene
    views = file.cameras or STANDARD_VIEWS
    return SceneEntry(file.path.stem, build, file.description or str(path), size, views, file.bands, file.white)


class Resolution(click.ParamType):
    name = "resolution"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        parts = str(value).lower().split("x")
        sides = [int(part) if part.isascii() and part.isdigit() and len(part) < 10 else 0 for part in parts]
        if not (len(sides) in (1, 2) and all(1 <= side <= _LARGEST_PICTURE for side in sides)):
            expected = f"expected pixels from 1 to {_LARGEST_PICTURE}"
            self.fail(f"got {value!r}, {expected}; write 640x480, or 512 for a square", param, ctx)
        return sides[0], sides[-1]


class Elements(click.ParamType):
    name = "elements"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        parts = str(value).lower().split("x")
        sides = [int(part) if part.isascii() and part.isdigit() and len(part) < 10 else 0 for part in parts]
        if not (len(sides) == 2 and min(sides) >= 1):
            self.fail(f"got {value!r}, expected elements along u and v; write 64x32", param, ctx)
        return sides[0], sides[1]


class Exposure(click.ParamType):
    name = "exposure"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | None:
        """Stops; None is auto."""
        if str(value).lower() == "auto":
            return None
        try:
            stops = float(value)
        except ValueError:
            stops = math.nan
        if not abs(stops) <= 100:
            self.fail(f"got {value!r}, expected stops from -100 to 100; write -1 to halve, or auto", param, ctx)
        return stops


def checked(valid: Callable[[Any], bool], expected: str, advice: str) -> Callable[..., Any]:
    """A click callback that refuses values which are not `valid`."""

    def check(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        if value is not None and not valid(value):
            raise click.BadParameter(f"got {value}, expected {expected}; {advice}", ctx, param)
        return value

    return check


def output(ctx: click.Context, param: click.Parameter, path: Path | None) -> Path | None:
    if path is None:
        return None
    if path.suffix.lower() != ".exr":
        got = f"got {str(path)!r}, expected a name that ends in .exr"
        raise click.BadParameter(f"{got}; write {str(path) + '.exr'!r}, a .png appears beside it", ctx, param)
    for target in (path, path.with_suffix(".png")):
        check_writable(target, ctx, param)
    return path


def check_writable(path: Path, ctx: click.Context, param: click.Parameter | None = None) -> None:
    folder, advice = path.parent, "make it first, or write elsewhere"
    try:
        if not folder.is_dir():
            raise click.BadParameter(f"got {str(path)!r}, expected a directory that exists; {advice}", ctx, param)
        if not os.access(folder, os.W_OK | os.X_OK):
            advice = "choose another with --out"
            raise click.BadParameter(f"got {str(path)!r}, expected a directory you may write in; {advice}", ctx, param)
        if path.exists() and not path.is_file():
            raise click.BadParameter(f"got {str(path)!r}, expected a file; something else has that name", ctx, param)
    except OSError as error:  # a name too long, a directory that may not be entered
        raise click.BadParameter(f"got {str(path)!r}: {error.strerror}; choose another name", ctx, param) from error


def _checkpoint(ctx: click.Context, param: click.Parameter, path: Path | None) -> Path | None:
    if path is not None:
        check_writable(path, ctx, param)
    return path


def _save(ctx: click.Context, param: click.Parameter, path: Path | None) -> Path | None:
    if path is not None:
        if path.suffix.lower() != ".npz":
            got = f"got {str(path)!r}, expected a name that ends in .npz"
            raise click.BadParameter(f"{got}; write {str(path) + '.npz'!r}", ctx, param)
        check_writable(path, ctx, param)
    return path


scene_argument = click.argument("scene", type=SceneName(), metavar="SCENE")
# Eager ones are read before the scene is looked for.
lattice_options = (
    click.option(
        "--size",
        is_eager=True,
        type=int,
        metavar="N",
        callback=checked(lambda n: n >= 4, "a whole number >= 4", "64 is quick, 128 fine"),
        help="Voxels a side. [default: the scene's own]",
    ),
    click.option(
        "--directions",
        is_eager=True,
        type=int,
        metavar="N",
        default=200,
        show_default=True,
        callback=checked(
            lambda n: _FEWEST_DIRECTIONS <= n <= 1_000_000,
            f"a whole number from {_FEWEST_DIRECTIONS} to 1000000",
            "200 is often enough",
        ),
        help="Directions of the sweeps.",
    ),
)
solve_options = (
    *lattice_options,
    click.option(
        "--rtol",
        type=float,
        metavar="X",
        default=1e-3,
        show_default=True,
        callback=checked(lambda x: 0 < x < 1, "a number between 0 and 1", "1e-3 is fine for pictures"),
        help="Certified error bound to reach, relative to the largest radiosity.",
    ),
    click.option(
        "--max-sweeps",
        type=int,
        metavar="N",
        default=1000,
        show_default=True,
        callback=checked(lambda n: n >= 1, "a whole number >= 1", "leave it out for 1000"),
        help="Stop there at the latest.",
    ),
    click.option(
        "--checkpoint",
        type=FileName(),
        metavar="FILE",
        callback=_checkpoint,
        help="Keep the state of the iteration there, about once a minute.",
    ),
    click.option("--resume", is_flag=True, help="Go on from the checkpoint, if there is one."),
    click.option(
        "--save",
        type=FileName(),
        metavar="FILE.npz",
        callback=_save,
        help="Keep the solution, for rm.load.",
    ),
    click.option(
        "--pe",
        is_eager=True,
        type=Elements(),
        metavar="AxB",
        help="Split the lattice over an array of A x B devices; CPUs are made virtual. [default: one device]",
    ),
    click.option("--quiet", is_flag=True, help="Print nothing but warnings and errors."),
    click.option("--no-progress", is_flag=True, help="No progress bar."),
)


def with_options(options: Sequence[Callable[..., Any]]) -> Callable[..., Any]:
    def decorate(function: Callable[..., Any]) -> Callable[..., Any]:
        for option in reversed(options):
            function = option(function)
        return function

    return decorate


def _failure(error: BaseException, exit_code: int) -> click.ClickException:
    failure = click.ClickException(" ".join(str(error).split()) or type(error).__name__)
    vars(failure)["exit_code"] = exit_code  # a class variable by its declaration
    return failure


@contextmanager
def one_line_errors() -> Iterator[None]:
    """What the library refuses, and what the machine cannot do, in one line."""
    try:
        yield
    except ValueError as error:
        raise _failure(error, 2) from error
    except (MemoryError, OSError) as error:
        raise _failure(error, 1) from error
    except RuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):  # XLA's word for out of memory
            raise
        raise _failure(error, 1) from error
