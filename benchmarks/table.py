"""Records as text.

Public names: `accuracy_table`, `seconds_text`.
"""

from collections.abc import Iterable
from typing import Any

_HEAD = ("problem", "quantity", "size", "directions", "solve s", "compile s", "read s", "memory MB")
_ERRORS = ("bias %", "rms %", "worst %", "reference %", "target", "met")


def accuracy_table(records: Iterable[dict[str, Any]]) -> str:
    """One line for each quantity of each problem; errors in per cent of what the problem relates them to."""
    rows: list[tuple[str, ...]] = [(*_HEAD, *_ERRORS)]
    for record in records:
        size, directions = str(record["size"]), str(record["directions"])
        if "error" in record:
            rows.append((record["problem"], f"failed: {record['error']}", size, directions, *[""] * 10))
            continue
        seconds = record["seconds"]
        cost = (
            seconds_text(seconds["first"] if seconds["warm"] is None else seconds["warm"]),
            seconds_text(seconds["compile"]),
            seconds_text(sum(seconds["read"].values())),
            f"{record['memory'] / 1e6:.0f}",
        )
        for number, (quantity, errors) in enumerate(record["quantities"].items()):
            name = record["problem"] if number == 0 else ""
            about = (size, directions, *cost) if number == 0 else [""] * 6
            figures = [_percent(errors[key]) for key in ("bias", "rms", "worst", "reference_error")]
            met = {None: "", True: "yes", False: "no"}[errors["met"]]
            met += "" if record["converged"] else " (not converged)"
            rows.append((name, quantity, *about, *figures, _target(errors["target"]), met))
    widths = [max(len(row[i]) for row in rows if not row[1].startswith("failed")) for i in range(len(rows[0]))]
    left = {0, 1, 12, 13}

    def line(row: tuple[str, ...]) -> str:
        cells = enumerate(zip(row, widths, strict=True))
        return "  ".join(c.ljust(w) if i in left else c.rjust(w) for i, (c, w) in cells).rstrip()

    return "\n".join(map(line, rows))


def seconds_text(seconds: float | None) -> str:
    return "-" if seconds is None else f"{seconds:.2f}" if seconds < 10 else f"{seconds:.1f}"


def _percent(share: float) -> str:
    value = 100 * share
    return f"{value:.1e}" if value and abs(value) < 0.001 else f"{value:.3f}"


def _target(target: dict[str, float | None] | None) -> str:
    asked = [f"{name} {100 * value:.3g}" for name, value in (target or {}).items() if value is not None]
    return ", ".join(asked)
