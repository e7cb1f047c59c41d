"""The work-precision plot: rms error against seconds.

Public names: `work_precision`, `check_matplotlib`.
"""

from pathlib import Path
from typing import Any

from .peer import PROBLEMS, READERS, point

_MARKERS = "osD^vP*X"


def check_matplotlib() -> None:
    """Raise `RuntimeError` if the plot cannot be drawn."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise RuntimeError("matplotlib: not installed, expected for --out; install the extra `plot`") from error


def work_precision(records: list[dict[str, Any]], out: Path, peer: dict[str, Any] | None = None) -> None:
    """One panel for each problem and quantity; a colour for each quadrature, a marker for each size, lines over directions.

    `peer`: a record with the curves of Mitsuba under "mitsuba".
    """
    check_matplotlib()
    from matplotlib.figure import Figure

    records = [record for record in records if "error" not in record]
    curves = {(PROBLEMS[c["scene"]], c["quantity"]): c for c in (peer or {}).get("mitsuba", [])}
    panels = [
        (problem, quantity)
        for problem in dict.fromkeys(record["problem"] for record in records)
        for quantity in _quantities(next(r for r in records if r["problem"] == problem))
    ]
    figure = Figure(figsize=(5.2 * len(panels), 4.4), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (problem, quantity) in zip(axes, panels, strict=True):
        _panel(axis, [r for r in records if r["problem"] == problem], quantity, curves.get((problem, quantity)))
        axis.set(xscale="log", yscale="log", title=f"{problem}: {quantity}", xlabel="seconds, without compilation")
        axis.grid(True, which="major", alpha=0.3)
    axes[0].set_ylabel("rms error, %")
    axes[-1].legend(fontsize=7, loc="upper left", bbox_to_anchor=(1, 1))
    figure.savefig(out, dpi=120)


def _panel(axis: Any, records: list[dict[str, Any]], quantity: str, curve: dict[str, Any] | None) -> None:
    sizes = sorted({record["size"] for record in records})
    for color, quadrature in enumerate(dict.fromkeys(record["quadrature"] for record in records)):
        for size in sizes:
            chosen = [r for r in records if r["quadrature"] == quadrature and r["size"] == size]
            line = sorted((point(r, quantity) for r in chosen), key=lambda p: p["directions"])
            if not line:
                continue
            counts = "/".join(str(p["directions"]) for p in line)
            axis.plot(
                [p["seconds"] for p in line],
                [100 * p["rms"] for p in line],
                _MARKERS[sizes.index(size) % len(_MARKERS)] + "-",
                color=f"C{color}",
                label=f"{quadrature}, {size} voxels, {counts} directions",
            )
    if curve is not None:
        seconds, errors = zip(*curve["points"], strict=True)
        axis.plot(seconds, [100 * e for e in errors], "k-", label=f"Mitsuba {curve['mitsuba']}, {curve['variant']}")
        axis.plot(curve["seconds_to_goal"], 1, "kx")
    reference = {r["quantities"][quantity]["reference_error"] for r in records}
    if max(reference) > 0:
        axis.axhline(100 * max(reference), color="grey", linestyle=":", label="the reference's own error")


def _quantities(record: dict[str, Any]) -> list[str]:
    """The quantities to plot: those a peer has too, or the problem's first."""
    known = [name for name in record["quantities"] if name in READERS]
    return known or list(record["quantities"])[:1]
