"""The command line of the benchmarks. Only click is imported before a command runs.

Public name: `main`.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

_QUESTIONS = {
    "accuracy": "How far from known answers is the solver, and what does that cost?",
    "error-vs-time": "Which size, how many directions and which quadrature give the smallest error in a given time?",
    "stability": "Does a solve stay finite, non-negative and within its bound where numbers are extreme?",
    "convergence": "How many sweeps to a certified error of 1e-4, over albedos and optical depths?",
    "gradient": "What do an image loss and its gradient cost, beside the solve alone?",
    "speed": "How long do a sweep, a bounce and a whole solve take, and how does that grow?",
    "paper": "What do the paper's two figures take and show, by its scheme and by ours?",
    "peer": "How long do we take for an error of 1 %, and how long does a path tracer on the same cores?",
}


class _Problem(click.ParamType):
    name = "problem"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        import problems

        if value not in problems.CASES:
            self.fail(f"got {value!r}, expected one of {', '.join(problems.CASES)}", param, ctx)
        return value


class _NewFile(click.Path):
    """A file that can be written."""

    def __init__(self) -> None:
        super().__init__(path_type=Path, dir_okay=False, writable=True)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        path = super().convert(value, param, ctx)
        if not Path(str(path)).parent.is_dir():
            self.fail(f"got {str(value)!r}, expected a directory that exists; make it first, or write elsewhere", param, ctx)
        return path


def _at_least(least: int) -> click.IntRange:
    return click.IntRange(min=least)


_quick = click.option("--quick", is_flag=True, help="Small sizes and few directions: not the figures to quote.")
_only = click.option("--only", type=_Problem(), multiple=True, metavar="NAME", help="This problem; may be repeated.")
_json = click.option("--json", "json_file", type=_NewFile(), metavar="FILE", help="Write the record there.")
_repeats = click.option("--repeats", type=_at_least(0), default=1, show_default=True, help="Timed solves after the first.")


def _sizes(help_text: str) -> Callable[..., Any]:
    return click.option("--size", "sizes", type=_at_least(1), multiple=True, metavar="N", help=help_text)


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """How accurate the solver is on problems with known answers, and what that costs."""


@main.command()
@_quick
@_only
@_sizes("Voxels along the longest side; may be repeated. [default: the size each problem's target is meant for]")
@click.option("--all-sizes", is_flag=True, help="All of each problem's own sizes.")
@click.option("--directions", type=_at_least(9), metavar="N", help="[default: 200; with --quick 60]")
@click.option("--quadrature", default="default", show_default=True, metavar="NAME", help="The kind of set.")
@_repeats
@_json
def accuracy(
    quick: bool,
    only: tuple[str, ...],
    sizes: tuple[int, ...],
    all_sizes: bool,
    directions: int | None,
    quadrature: str,
    repeats: int,
    json_file: Path | None,
) -> None:
    """Errors, seconds and memory on the problems of the catalogue."""
    import problems

    from .measure import Job, run
    from .record import environment, write
    from .table import accuracy_table

    _check_quadrature(quadrature)
    if sum(map(bool, (sizes, quick, all_sizes))) > 1:
        raise click.UsageError("--quick, --all-sizes and --size exclude one another; keep one of them")
    jobs = []
    for name in only or problems.CASES:
        case = problems.CASES[name]
        chosen = sizes or (case.sizes if all_sizes else case.sizes[:1] if quick else case.sizes[-1:])
        count = directions or (60 if quick else case.directions)
        jobs += [Job(name, size, count, quadrature, 0 if quick else repeats) for size in chosen]
    records = []
    for record in run(jobs, _tell):
        records.append(record)
        write(json_file, _QUESTIONS["accuracy"], records, environment=environment())
    _print_environment(environment())
    click.echo(accuracy_table(records))
    click.echo("Errors in per cent of the value, or of " + "; ".join(_scales(records)) if _scales(records) else "")
    if any("error" in record for record in records):
        raise SystemExit(1)


@main.command("error-vs-time")
@_quick
@_only
@_sizes("May be repeated. [default: 16, 32 and 64; with --quick 8 and 16]")
@click.option("--directions", "counts", type=_at_least(9), multiple=True, metavar="N", help="[default: 50, 100, 200, 400]")
@click.option("--quadrature", "quadratures", multiple=True, metavar="NAME", help="May be repeated. [default: all]")
@click.option("--out", type=_NewFile(), metavar="FILE.png", help="Draw the work-precision plot there (extra: plot).")
@click.option("--peer", type=click.Path(path_type=Path, exists=True), metavar="FILE", help="Add the curve of a peer's record.")
@_repeats
@_json
def error_vs_time(
    quick: bool,
    only: tuple[str, ...],
    sizes: tuple[int, ...],
    counts: tuple[int, ...],
    quadratures: tuple[str, ...],
    out: Path | None,
    peer: Path | None,
    repeats: int,
    json_file: Path | None,
) -> None:
    """Sweep sizes, numbers of directions and quadratures; draw error against time."""
    import json

    from .measure import PAPER, QUADRATURES, Job, run
    from .record import environment, write
    from .table import accuracy_table

    for name in quadratures:
        _check_quadrature(name)
    if out is not None:
        from .plot import check_matplotlib

        check_matplotlib()
    sizes = sizes or ((8, 16) if quick else (16, 32, 64))
    counts = counts or ((50, 100) if quick else (50, 100, 200, 400))
    names = quadratures or (("fibonacci",) if quick else (*QUADRATURES, PAPER))
    jobs = [
        Job(problem, size, count, quadrature, repeats)
        for problem in only or ("room", "fog")
        for quadrature in names
        for size in sizes
        for count in counts
    ]
    records = []
    for record in run(jobs, _tell):
        records.append(record)
        write(json_file, _QUESTIONS["error-vs-time"], records, environment=environment())
    if out is not None:
        from .plot import work_precision

        work_precision(records, out, json.loads(peer.read_text()) if peer else None)
        click.echo(f"wrote {out}", err=True)
    _print_environment(environment())
    click.echo(accuracy_table(records))


@main.command()
@_quick
@click.option("--scene", "scenes", type=click.Choice(["A", "C"]), multiple=True, help="May be repeated. [default: both]")
@_sizes("Of our solves; may be repeated. [default: 8, 16, 24, 32 and 48; with --quick 8]")
@click.option("--directions", "counts", type=_at_least(9), multiple=True, metavar="N", help="[default: 50, 100, 200 and 300]")
@click.option("--seconds", type=float, default=120.0, show_default=True, help="The most Mitsuba gets for a scene and quantity.")
@click.option("--goal", type=float, default=0.01, show_default=True, help="The rms error to reach.")
@click.option("--out", type=_NewFile(), metavar="FILE.png", help="Draw error against time there (extra: plot).")
@_json
def peer(
    quick: bool,
    scenes: tuple[str, ...],
    sizes: tuple[int, ...],
    counts: tuple[int, ...],
    seconds: float,
    goal: float,
    out: Path | None,
    json_file: Path | None,
) -> None:
    """Mitsuba 3 and this package on scenes A and C, one after the other on the same cores."""
    from .peer import compare
    from .record import environment, write

    scenes = scenes or ("A", "C")
    sizes = sizes or ((8,) if quick else (8, 16, 24, 32, 48))
    counts = counts or ((50,) if quick else (50, 100, 200, 300))
    result = compare(scenes, sizes, counts, 5.0 if quick else seconds, goal, _tell)
    about = environment("mitsuba", "drjit")
    write(json_file, _QUESTIONS["peer"], result.ours, environment=about, mitsuba=result.curves, summary=result.summary)
    if out is not None:
        from .plot import work_precision

        work_precision(result.ours, out, {"mitsuba": result.curves})
    _print_environment(about)
    click.echo(result.table())


@main.command()
@click.option("--quick", is_flag=True, help="The ends of each range only.")
@_json
def stability(quick: bool, json_file: Path | None) -> None:
    """Extreme depths, albedos, contrasts, radiances, directions and shapes; float32 against float64."""
    import jax

    from .record import environment, write
    from .stability import cases, measure, stability_table

    rows = []
    for number, case in enumerate(cases(quick)):
        if number % 50 == 49:  # each compiled program holds regions of memory, of which a process gets some ten thousand
            jax.clear_caches()
        rows.append(measure(case, _tell))
        write(json_file, _QUESTIONS["stability"], rows, environment=environment())
    _print_environment(environment())
    click.echo(stability_table(rows))
    if any(row["verdict"] != "ok" for row in rows):
        raise SystemExit(1)


@main.command()
@click.option("--quick", is_flag=True, help="The ends of each range only.")
@click.option("--size", type=_at_least(2), default=32, show_default=True, help="Voxels along a side.")
@click.option("--directions", type=_at_least(9), default=200, show_default=True)
@click.option("--jacobi", type=_at_least(0), default=200, show_default=True, help="Its sweeps; the rest is extrapolated.")
@click.option("--out", type=_NewFile(), metavar="FILE.png", help="Draw Jacobi's false convergence there (extra: plot).")
@_json
def convergence(quick: bool, size: int, directions: int, jacobi: int, out: Path | None, json_file: Path | None) -> None:
    """Sweeps and time of the default solver and of Jacobi, in a foggy room; in float64."""
    from .convergence import convergence_table, false_convergence, measure, rooms
    from .record import environment, write

    rows = []
    for room in rooms(quick):
        rows.append(measure(room, size, directions, jacobi, _tell))
        write(json_file, _QUESTIONS["convergence"], rows, environment=environment())
    if out is not None:
        false_convergence(out)
        click.echo(f"wrote {out}", err=True)
    _print_environment(environment())
    click.echo(convergence_table(rows))


@main.command()
@click.option("--size", type=_at_least(4), default=32, show_default=True, help="Voxels along a side.")
@click.option("--directions", type=_at_least(9), default=200, show_default=True)
@click.option("--cells", type=_at_least(1), default=16, show_default=True, help="Of the floor's texture, along a side.")
@click.option("--pixels", type=_at_least(1), default=64, show_default=True, help="Of the picture, along a side.")
@click.option("--repeats", type=_at_least(1), default=3, show_default=True, help="Timed runs after the first.")
@click.option("--prb", type=_at_least(0), default=0, metavar="SAMPLES", help="Mitsuba's prb beside it (extra: peer); 64, say.")
@_json
def gradient(size: int, directions: int, cells: int, pixels: int, repeats: int, prb: int, json_file: Path | None) -> None:
    """Time and peak memory of a solve, of an image loss, and of the loss with its gradient."""
    from .gradient import gradient_table, measure
    from .record import environment, write

    try:
        records = measure(size, directions, cells, pixels, repeats, _tell, prb)
    except RuntimeError as error:
        raise click.ClickException(str(error)) from None
    write(json_file, _QUESTIONS["gradient"], records, environment=environment())
    _print_environment(environment())
    click.echo(gradient_table(records))


@main.command()
@_quick
@_sizes("Voxels along a side; may be repeated. [default: 32 and 64; with --quick 8 and 16]")
@click.option("--directions", "counts", type=_at_least(9), multiple=True, metavar="N", help="[default: 200; with --quick 60]")
@click.option("--bands", type=_at_least(1), multiple=True, default=(1, 3), show_default=True, help="Of the sweeps.")
@click.option("--rtol", type=float, default=1e-3, show_default=True, help="Certified error of the solves.")
@click.option("--repeats", type=_at_least(1), default=5, show_default=True, help="Timed runs after the first.")
@click.option(
    "--case",
    "cases",
    multiple=True,
    type=click.Choice(["vacuum", "homogeneous", "heterogeneous", "ring", "three-balls", "room"]),
    help="Only sweeps of this case, or solves of this scene; may be repeated.",
)
@_json
def speed(
    quick: bool, sizes: tuple[int, ...], counts: tuple[int, ...], bands: tuple[int, ...], rtol: float, repeats: int,
    cases: tuple[str, ...], json_file: Path | None,
) -> None:  # fmt: skip
    """Time of sweeps, bounces and whole solves, how it grows with size and directions, and what skipped work would take."""
    from .record import environment, write
    from .skipped import skipped, skipped_table
    from .speed import CASES, SCENES, roofline, solves, speed_table, sweeps

    sizes = sizes or ((8, 16) if quick else (32, 64))
    counts = counts or ((60,) if quick else (200,))
    records = []
    chosen = lambda names: [name for name in names if not cases or name in cases]
    for made in (
        roofline(repeats, _tell),
        sweeps(chosen(CASES), sizes, counts, bands, repeats, _tell),
        solves(chosen(SCENES), sizes, counts[0], rtol, repeats, _tell),
        () if cases else skipped(sizes[len(sizes) // 2], counts[0], rtol, repeats, _tell),
    ):
        for record in made:
            records.append(record)
            write(json_file, _QUESTIONS["speed"], records, environment=environment())
    _print_environment(environment())
    click.echo(speed_table(records))
    if not cases:
        click.echo("\n" + skipped_table(records))


@main.command()
@click.option("--size", type=_at_least(12), default=128, show_default=True, help="Voxels along a side; the paper's N.")
@click.option("--half-width", type=_at_least(1), default=5, show_default=True, help="Of the light ray cube; the paper's M.")
@click.option("--directions", type=_at_least(9), default=200, show_default=True, help="Of the characteristic scheme.")
@click.option("--pixels", type=_at_least(8), default=384, show_default=True, help="Of each picture, along a side.")
@click.option("--repeats", type=_at_least(1), default=5, show_default=True, help="Timed sweeps after the first.")
@click.option("--out", type=_NewFile(), metavar="FILE.png", help="Write the pictures there, side by side.")
@_json
def paper(
    size: int, half_width: int, directions: int, pixels: int, repeats: int, out: Path | None, json_file: Path | None
) -> None:
    """Figures 4 and 5 by both schemes, and sweeps over two virtual devices."""
    from .paper import figures, figures_table, montage, scaling, scaling_table
    from .record import environment, write

    records, pictures = [], []
    for record, picture in figures(size, half_width, directions, pixels, _tell):
        records.append(record)
        pictures.append(picture)
        write(json_file, _QUESTIONS["paper"], records, environment=environment())
    shared = list(scaling(min(size, 64), half_width, directions, repeats, _tell))
    write(json_file, _QUESTIONS["paper"], records + shared, environment=environment())
    if out is not None:
        import raymanifold_jax as rm

        rm.io.write_png(out, montage(pictures))
    _print_environment(environment())
    click.echo(f"{figures_table(records)}\n\n{scaling_table(shared)}")


def _check_quadrature(name: str) -> None:
    from .measure import DEFAULT, PAPER, QUADRATURES

    if name not in (DEFAULT, PAPER, *QUADRATURES):
        expected = f"{DEFAULT}, {PAPER} (its whole scheme) or one of {', '.join(QUADRATURES)}"
        raise click.UsageError(f"--quadrature: got {name!r}, expected {expected}")


def _tell(text: str) -> None:
    click.echo(text, err=True)


def _scales(records: list[dict[str, Any]]) -> list[str]:
    named = {r["problem"]: r["errors_of"] for r in records if r.get("errors_of", "the value") != "the value"}
    return [f"{what} ({name})" for name, what in named.items()]


def _print_environment(about: dict[str, Any]) -> None:
    click.echo(", ".join(f"{name} {value}" for name, value in about.items()))
