"""The command line: `raymanifold render`, `solve`, `init`, `scenes`, `info`, `cost`.

Only click is imported here: everything heavy is loaded inside the commands, so that `--help` answers at once. All
option values are checked before any work. Exit codes: 0; 1 where a solve did not converge (its pictures are written
all the same) or the machine gave out; 2 for a value that cannot be used.

Public name: `main`.
"""

import gc
import itertools
import math
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from . import __version__
from .cli_options import (
    Elements,
    Exposure,
    FileName,
    Resolution,
    SceneName,
    check_writable,
    checked,
    lattice_options,
    one_line_errors,
    output,
    scene_argument,
    solve_options,
    with_options,
)

if TYPE_CHECKING:
    import numpy as np

    from .scene import Scene
    from .scenes import SceneEntry, View
    from .solution import Solution

_BRIGHT, _BRIGHT_SHARE = 0.9, 99.0  # auto exposure: this percentile of the radiance becomes this much of white
_NEW_OBJECTS = 200_000  # between looks for garbage: a short run has some 500 000, and looking at all of them again takes time
_CACHED_FROM = 0.02  # seconds: programs that compile faster are not kept; the many small ones add up


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="raymanifold")
@click.pass_context
def main(ctx: click.Context) -> None:
    """Deterministic light transport on a voxel lattice: solve a scene, and take pictures of it.

    Try: raymanifold render three-balls --out fog.exr
    """
    # The library's warnings in one line each, without the place in its code.
    ctx.with_resource(warnings.catch_warnings())
    warnings.showwarning = _show_warning
    before = gc.get_threshold()
    gc.set_threshold(_NEW_OBJECTS)
    ctx.call_on_close(lambda: gc.set_threshold(*before))
    # Read when numpy is first imported. Its threads, for products that we have none of, wait by spinning on our cores.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")


def _load_ahead(ctx: click.Context, name: str) -> None:
    """Have what earlier runs compiled for such a command loaded while the rest is imported."""
    # What is not given has no value yet, or one of click's own.
    size, directions, pe = (ctx.params.get(option) for option in ("size", "directions", "pe"))
    if not isinstance(pe, tuple):
        _use_cache(f"{name} {size if isinstance(size, int) else 'own'} {directions}")


_scene_to_solve = click.argument("scene", type=SceneName(before=_load_ahead), metavar="SCENE")


@main.command()
@_scene_to_solve
@click.option(
    "--out",
    type=FileName(),
    callback=output,
    metavar="FILE.exr",
    help="The OpenEXR file; a PNG appears beside it. [default: SCENE.exr]",
)
@click.option("--camera", metavar="NAME", help="The view: `raymanifold scenes` lists them. [default: the first]")
@click.option("--all-views", is_flag=True, help="All of the scene's views, as FILE-VIEW.exr.")
@click.option(
    "--turntable",
    type=click.IntRange(1, 9999),
    metavar="N",
    help="N views from all around, as FILE-000.exr and so on: one solve, a film.",
)
@click.option(
    "--fly-through",
    type=click.IntRange(2, 9999),
    metavar="N",
    help="N views on a smooth path through the scene's perspective cameras, as FILE-000.exr and so on.",
)
@click.option(
    "--resolution", type=Resolution(), default="512", metavar="WxH", show_default=True, help="Pixels: 640x480, or 512."
)
@click.option(
    "--samples",
    type=int,
    metavar="N",
    default=4,
    show_default=True,
    callback=checked(
        lambda n: 1 <= n <= 1024 and math.isqrt(n) ** 2 == n, "a square number from 1 to 1024", "4 or 16 are good"
    ),
    help="Rays a pixel: 1, 4, 9, ...",
)
@click.option(
    "--exposure",
    type=Exposure(),
    metavar="STOPS",
    default="auto",
    show_default=True,
    help=f"Of the PNG: stops, or auto, which takes the {_BRIGHT_SHARE:g}th percentile to {_BRIGHT} of white (linear).",
)
@click.option("--half", is_flag=True, help="Store 16-bit floats.")
@click.option("--layers", is_flag=True, help="Depth, normals, albedo and irradiance as layers of the OpenEXR file.")
@with_options(solve_options)
@click.pass_context
def render(
    ctx: click.Context,
    scene: "SceneEntry",
    out: Path | None,
    camera: str | None,
    all_views: bool,
    turntable: int | None,
    fly_through: int | None,
    resolution: tuple[int, int],
    samples: int,
    exposure: float | None,
    half: bool,
    layers: bool,
    **settings: Any,
) -> None:
    """Solve SCENE (ring, three-balls, room, cornell-box or a file.toml) and write pictures of it."""
    film = turntable is not None or fly_through is not None
    if sum(given is not None for given in (camera, turntable, fly_through)) + all_views > 1:
        names = "--camera, --all-views, --turntable and --fly-through"
        raise click.UsageError(f"{names} exclude each other; leave all but one out", ctx)
    if camera is not None and camera not in scene.views:
        got = f"--camera: got {camera!r}, expected one of {', '.join(scene.views)}"
        raise click.UsageError(f"{got}; leave it out for {next(iter(scene.views))!r}", ctx)
    out = Path(f"{scene.name}.exr") if out is None else out
    available = _film(scene.views, turntable, fly_through, ctx) if film else scene.views
    several = all_views or film
    wanted = list(available) if several else [camera or next(iter(available))]
    files = {view: out.with_stem(f"{out.stem}-{view}") if several else out for view in wanted}
    for file in files.values():
        for target in (file, file.with_suffix(".png")):
            check_writable(target, ctx)
    size = settings["size"] or scene.default_size
    with one_line_errors():
        _start(settings["pe"])
        built = _build(scene, size, settings["directions"])
        if scene.bands is None and built.bands not in (1, 3):
            expected = "1 or 3 (R, G, B), or a table [bands] that tells their wavelengths"
            raise ValueError(
                f"{scene.name}: got values of {built.bands} bands, expected {expected}; write edges = [...] there, in nm"
            )
        views = {view: make(built.lattice, resolution) for view, make in available.items()}
        solution, seconds = _solve(built, **settings)

        import raymanifold_jax as rm

        began = time.perf_counter()
        shown = not (settings["quiet"] or settings["no_progress"])
        with _rendering(len(files), shown) as done:
            pictures = {view: rm.render(solution, views[view], samples=samples, progress=done()) for view in files}
        more = {view: rm.render_layers(solution, views[view]) if layers else {} for view in files}
        render_seconds = time.perf_counter() - began
        seen = {view: _visible(scene, picture) for view, picture in pictures.items()}
        # One exposure for all views, so that they can be compared.
        stops = _auto_exposure(seen.values()) if exposure is None else exposure
        for view, file in files.items():
            header = {"camera": view, "samples": samples, "exposure": stops}
            header |= _header(scene, size, solution, settings["directions"], settings["rtol"])
            attributes = {f"raymanifold.{key}": value for key, value in header.items()}
            if scene.bands is None:
                rm.io.write_exr(file, pictures[view], attributes=attributes, half=half, layers=more[view])
            else:
                rm.spectra.write_spectral_exr(file, pictures[view], scene.bands, scene.white, more[view], attributes, half)
            rm.io.write_png(file.with_suffix(".png"), seen[view], exposure=stops)
    if not settings["quiet"]:
        _report(scene, solution, {"solve": seconds, "render": render_seconds})
        kind = "auto" if exposure is None else "given"
        _line("exposure", f"{stops:+.2f} stops ({kind})")
        for file in files.values():
            _line("wrote", f"{file}, {file.with_suffix('.png')}")
    _warn_unless_converged(ctx, solution)


@main.command()
@_scene_to_solve
@with_options(solve_options)
@click.pass_context
def solve(ctx: click.Context, scene: "SceneEntry", **settings: Any) -> None:
    """Solve SCENE (ring, three-balls, room, cornell-box or a file.toml) and print where its light goes."""
    with one_line_errors():
        _start(settings["pe"])
        built = _build(scene, settings["size"] or scene.default_size, settings["directions"])
        solution, seconds = _solve(built, **settings)
    if not settings["quiet"]:
        _report(scene, solution, {"solve": seconds})
        click.echo("energy, W")
        for name, value in solution.energy._asdict().items():
            _line(f"  {name.replace('_', ' ')}", f"{float(value):.6g}")
    _warn_unless_converged(ctx, solution)


@main.command()
@click.argument("file", type=FileName(), default="scene.toml", metavar="[FILE.toml]")
@click.option("--force", is_flag=True, help="Replace a file that is there.")
@click.pass_context
def init(ctx: click.Context, file: Path, force: bool) -> None:
    """Write a commented scene file to start from. [default: scene.toml]"""
    from .io.exr import written_atomically
    from .io.scene_writer import EXAMPLE

    if file.suffix.lower() != ".toml":
        raise click.UsageError(
            f"FILE: got {str(file)!r}, expected a name that ends in .toml; write {str(file) + '.toml'!r}", ctx
        )
    check_writable(file, ctx)
    if file.exists() and not force:
        raise click.UsageError(f"FILE: got {str(file)!r}, which is there; expected a new name; --force replaces it", ctx)
    with one_line_errors(), written_atomically(file) as temporary:
        temporary.write_text(EXAMPLE, encoding="utf-8")
    _line("wrote", f"{file}; next: raymanifold render {file}")


@main.command()
def scenes() -> None:
    """List the scenes, their views and default sizes."""
    from .scenes import SCENES

    for entry in SCENES.values():
        click.echo(f"{entry.name}\n    {entry.description}")
        click.echo(f"    views: {', '.join(entry.views)}; default size {entry.default_size}")


@main.command()
@click.argument("scene", type=SceneName(), metavar="[SCENE]", required=False)
@with_options(lattice_options)
def info(scene: "SceneEntry | None", size: int | None, directions: int) -> None:
    """Versions, devices, and the memory that SCENE (or every scene) needs against what there is."""
    cache = _use_cache()
    from importlib.metadata import version

    import jax

    from .memory import available_memory, estimate_memory, gigabytes
    from .scenes import SCENES

    _line("raymanifold-jax", __version__)
    _line("python", sys.version.split()[0])
    for package in ("jax", "jaxlib", "equinox", "numpy", "OpenEXR"):
        _line(package, version(package))
    _line("devices", ", ".join(str(device) for device in jax.devices()))
    _line("compiled programs", cache or "not kept")
    available = available_memory()
    _line("memory available", "unknown" if available is None else gigabytes(available))
    for entry in SCENES.values() if scene is None else [scene]:
        with one_line_errors():
            built = entry.build(size or entry.default_size)
        shape = built.lattice.shape
        need = estimate_memory(shape, built.bands, directions, built.medium is not None)
        fits = "" if available is None or need <= available else ": more than there is"
        _line(f"{entry.name} needs", f"{gigabytes(need)} at {' x '.join(map(str, shape))}{fits}")


@main.command()
@scene_argument
@click.option(
    "--size",
    type=int,
    metavar="N",
    callback=checked(lambda n: n >= 4, "a whole number >= 4", "128 is the paper's"),
    help="Voxels a side. [default: the scene's own]",
)
@click.option("--pe", type=Elements(), default="64x32", metavar="AxB", show_default=True, help="Processing elements.")
@click.option(
    "--half-width",
    type=int,
    metavar="M",
    default=5,
    show_default=True,
    callback=checked(lambda m: 1 <= m <= 64, "a whole number from 1 to 64", "5 is the paper's"),
    help="Of the light ray cube.",
)
@click.option("--characteristic", is_flag=True, help="The characteristic scheme, with 200 directions, in place of the paper's.")
def cost(scene: "SceneEntry", size: int | None, pe: tuple[int, int], half_width: int, characteristic: bool) -> None:
    """What SCENE costs each processing element of an array, beside the paper's own numbers."""
    import raymanifold_jax as rm

    scheme = rm.Characteristic() if characteristic else rm.LightRayCube(half_width)
    with one_line_errors():
        click.echo(str(rm.cost_report(scene.build(size or scene.default_size), scheme, pe)))


def _show_warning(message: Warning | str, category: type[Warning], *place: Any) -> None:
    if issubclass(category, UserWarning):
        click.echo(f"Warning: {message}", err=True)


def _start(pe: tuple[int, int] | None) -> None:
    """Have JAX start with as many devices as are asked for, before anything else makes it start."""
    if pe is not None:
        import raymanifold_jax as rm

        rm.pe_array(*pe)
        _use_cache()


def _film(views: "Mapping[str, View]", around: int | None, through: int | None, ctx: click.Context) -> "Mapping[str, View]":
    from .scenes import fly_through, turntable

    if around is not None:
        return turntable(around)
    try:
        return fly_through(views, through or 0)
    except ValueError as error:
        raise click.UsageError(f"--fly-through: {error}", ctx) from error


def _build(entry: "SceneEntry", size: int, directions: int) -> "Scene":
    """The scene, if its solve fits into memory."""
    from .memory import check_memory

    scene = entry.build(size)
    check_memory(scene.lattice.shape, scene.bands, directions, scene.medium is not None)
    return scene


def _solve(
    scene: "Scene",
    directions: int,
    rtol: float,
    max_sweeps: int,
    quiet: bool,
    no_progress: bool,
    checkpoint: Path | None,
    resume: bool,
    save: Path | None,
    pe: tuple[int, int] | None,
    **_: Any,
) -> tuple["Solution", float]:
    """The solution, and the seconds it took."""
    import jax

    import raymanifold_jax as rm

    if resume and checkpoint is None:
        raise ValueError("--resume: got no checkpoint, expected --checkpoint FILE as well; name the file to go on from")
    began = time.perf_counter()
    options: dict[str, Any] = {} if checkpoint is None else {"checkpoint": rm.Checkpoint(checkpoint, resume=resume)}
    solution = rm.solve(
        scene,
        quadrature=rm.quadrature.for_scene(scene, directions),
        rtol=rtol,
        max_sweeps=max_sweeps,
        progress=not (quiet or no_progress),
        mesh=None if pe is None else rm.pe_array(*pe),
        **options,
    )
    jax.block_until_ready(solution.diffuse_fluence)
    if save is not None:
        solution.save(save)
    return solution, time.perf_counter() - began


def _visible(entry: "SceneEntry", picture: "np.ndarray") -> "np.ndarray":
    """A picture in bands of wavelength as linear sRGB; others as they are."""
    return picture if entry.bands is None else entry.bands.to_rgb(picture, entry.white)


def _header(entry: "SceneEntry", size: int, solution: "Solution", directions: int, rtol: float) -> dict[str, Any]:
    return {
        "version": __version__,
        "scene": entry.name,
        "size": size,
        "directions": directions,
        "rtol": rtol,
        "sweeps": solution.sweeps,
        "error_bound": float(solution.error_bound),
        "imbalance": float(solution.energy.imbalance),
        "result": solution.result,
    }


def _auto_exposure(pictures: "Iterable[np.ndarray]") -> float:
    """Stops that take the brightest per cent of all pixels to `_BRIGHT` or more; 0 for black pictures."""
    import numpy as np

    bright = float(np.percentile(np.concatenate([picture.ravel() for picture in pictures]), _BRIGHT_SHARE))
    return min(max(math.log2(_BRIGHT / bright), -100.0), 100.0) if bright > 0 else 0.0


@contextmanager
def _rendering(count: int, shown: bool) -> Iterator[Callable[[], Callable[[float], None] | None]]:
    """A bar on a terminal for `count` pictures; what it gives, called once a picture, takes the share of it that is done."""
    if not (shown and sys.stderr.isatty()):
        yield lambda: None
        return
    steps = 1000
    with click.progressbar(length=count * steps, label="render", file=sys.stderr) as bar:
        pictures = itertools.count()

        def one() -> Callable[[float], None]:
            before = next(pictures) * steps
            return lambda share: bar.update(before + round(share * steps) - bar.pos)

        yield one


def _report(entry: "SceneEntry", solution: "Solution", seconds: Mapping[str, float]) -> None:
    from .memory import gigabytes

    _line(entry.name, solution.scene.summary())
    _line("sweeps", str(solution.sweeps))
    _line("certified bound", f"{solution.error_bound:.3g} W m^-2 (target {solution.target:.3g})")
    _line("energy imbalance", f"{100 * float(solution.energy.imbalance):+.3f} %")
    for name, value in seconds.items():
        _line(name, f"{value:.1f} s")
    peak = _peak_memory()
    if peak is not None:
        _line("peak memory", gigabytes(peak))


def _peak_memory() -> int | None:
    """Bytes this process has held at most; None where the system does not say."""
    try:
        import resource
    except ImportError:  # Windows
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else 1024 * peak


def _line(name: str, value: str) -> None:
    click.echo(f"{name:<24} {value}")


def _warn_unless_converged(ctx: click.Context, solution: "Solution") -> None:
    if not solution.converged:
        click.secho(f"Warning: {solution.result}", err=True, fg="red", bold=True)
        ctx.exit(1)


def _cache_directory(environment: Mapping[str, str]) -> str | None:
    """Where compiled programs are kept; None for nowhere.

    `RAYMANIFOLD_CACHE`, which may be empty for nowhere, or else JAX's own setting, or else the user's cache directory.
    """
    for variable in ("RAYMANIFOLD_CACHE", "JAX_COMPILATION_CACHE_DIR"):
        if variable in environment:
            return environment[variable] or None
    from .program_files import user_cache

    return str(user_cache(environment))


def _use_cache(task: str = "") -> str | None:
    """Have compiled programs kept; the directory, or None.

    Whole ones too (`program_files`), but in a directory of JAX's own setting, where it alone has a say.
    """
    directory = _cache_directory(os.environ)
    if directory is not None:
        try:
            os.makedirs(directory, exist_ok=True)
        except OSError as error:
            click.echo(f"Warning: no cache of compiled programs in {directory!r}: {error.strerror}", err=True)
            directory = None
    import jax

    from .program_files import keep_in

    jax.config.update("jax_compilation_cache_dir", directory)
    if "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS" not in os.environ:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", _CACHED_FROM)
    own = "RAYMANIFOLD_CACHE" in os.environ or "JAX_COMPILATION_CACHE_DIR" not in os.environ
    keep_in(directory if own else None, task)
    return directory


if __name__ == "__main__":
    main(prog_name="raymanifold")
