"""Progress of a solve: how far the certified error bound is from its target.

A solver calls `start` once, `update(sweeps, bound, target)` after each sweep, and `close` in a `finally`. Calls may
come from any thread (a JAX callback runs on one of its own), and no value of the bound makes them fail.

With bound b falling geometrically from b₀ towards the target b*, the bar shows log(b₀/b) / log(b₀/b*), and the time
left is log(b/b*) over the rate of fall seen lately.

Public names: `Progress`, `NoProgress`, `RichProgress`, `make_progress`.
"""

import abc
import math
import sys
import threading
import time
from collections import deque
from typing import Any

from . import checks


class Progress(abc.ABC):
    """What a solver tells about itself. Also a context manager, which closes at the end."""

    @abc.abstractmethod
    def start(self, description: str = "solve") -> None:
        """The solve begins."""

    @abc.abstractmethod
    def update(self, sweeps: int, bound: float, target: float) -> None:
        """`sweeps` are done, the error is at most `bound` (which may be inf or NaN), and `target` is where it ends."""

    @abc.abstractmethod
    def close(self) -> None:
        """The solve has ended, well or not. Closing twice does no harm."""

    def __enter__(self) -> "Progress":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class NoProgress(Progress):
    """Says nothing."""

    def start(self, description: str = "solve") -> None:
        pass

    def update(self, sweeps: int, bound: float, target: float) -> None:
        pass

    def close(self) -> None:
        pass


class RichProgress(Progress):
    """A bar on standard error, which appears once the solve has taken `delay` seconds: short solves stay quiet.

    `console` is a `rich.console.Console` to draw on in the place of standard error.
    """

    def __init__(self, delay: float = 1.0, console: Any = None):
        self._delay = float(checks.non_negative("delay", delay, ()))
        self._console = console
        self._lock = threading.RLock()
        self._timer: threading.Timer | None = None
        self._bar: Any = None
        self._task: Any = None
        self._decay = Decay()
        self._description = ""
        self._fields: dict[str, Any] = {}

    def start(self, description: str = "solve") -> None:
        with self._lock:
            self.close()
            self._decay = Decay()
            self._description = description
            self._fields = _fields(0, math.nan, math.nan, self._decay)
            # A timer, not the first update, shows the bar: the first sweep waits for compilation and may take long.
            self._timer = threading.Timer(self._delay, self._show)
            self._timer.daemon = True
            self._timer.start()

    def update(self, sweeps: int, bound: float, target: float) -> None:
        with self._lock:
            sweeps, bound, target = int(sweeps), float(bound), float(target)
            self._decay.add(sweeps, bound, target)
            self._fields = _fields(sweeps, bound, target, self._decay)
            if self._bar is not None:
                self._bar.update(self._task, **self._fields)

    def close(self) -> None:
        with self._lock:
            timer, bar = self._timer, self._bar
            self._timer = self._bar = None
        if timer is not None:
            timer.cancel()
        # Outside the lock: stopping waits for the thread that draws.
        if bar is not None:
            bar.stop()

    def _show(self) -> None:
        with self._lock:
            if self._timer is not threading.current_thread():
                return  # closed, or started anew, while the timer fired
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("bound {task.fields[bound]} (target {task.fields[target]})"),
                TextColumn("{task.fields[sweeps]} sweeps"),
                TextColumn("{task.fields[speed]}/s"),
                TimeElapsedColumn(),
                TextColumn("{task.fields[left]} left"),
                console=self._console or Console(stderr=True),
                redirect_stdout=False,  # what the user prints belongs on standard output, also while the bar shows
            )
            self._task = self._bar.add_task(self._description, total=1.0, **self._fields)
            # The time since `start`, not since the bar appeared.
            self._bar.tasks[0].start_time -= time.monotonic() - self._decay.began
            self._bar.start()


class Decay:
    """The bound's way so far: from it the fraction done, the sweeps a second and the time left. None is unknown."""

    def __init__(self, window: int = 12):
        self.began = time.monotonic()
        self.fraction: float = 0.0
        self.sweeps_per_second: float | None = None
        self.seconds_left: float | None = None
        self._first: float | None = None
        self._lately: deque[tuple[float, int, float]] = deque(maxlen=window)

    def add(self, sweeps: int, bound: float, target: float, now: float | None = None) -> None:
        """One more value of the bound, at time `now` in seconds (left out, the clock says)."""
        now = time.monotonic() if now is None else now
        # Non-positive and infinite bounds have no place on a logarithmic scale; they still count as sweeps.
        log_bound = math.log(bound) if 0 < bound < math.inf else math.nan
        self._lately.append((now, sweeps, log_bound))
        then, sweeps_then, _ = self._lately[0]
        self.sweeps_per_second = (sweeps - sweeps_then) / (now - then) if now > then else None
        self.seconds_left = None
        if bound <= target:
            self.fraction, self.seconds_left = 1.0, 0.0
            return
        if math.isnan(log_bound) or not 0 < target < math.inf:
            return
        if self._first is None:
            self._first = log_bound
        to_go = log_bound - math.log(target)
        whole = self._first - math.log(target)
        self.fraction = min(max(1 - to_go / whole, 0.0), 1.0) if whole > 0 else 0.0
        known = [(t, b) for t, _, b in self._lately if not math.isnan(b)]
        then, log_bound_then = known[0]
        if now > then and log_bound < log_bound_then:
            self.seconds_left = to_go * (now - then) / (log_bound_then - log_bound)


def make_progress(progress: bool | Progress | None) -> Progress:
    """What `solve(..., progress=...)` means.

    `None` and `True`: a bar if standard error is a terminal, else nothing. `False`: nothing. A `Progress`: that one.
    Raises `TypeError` for anything else.
    """
    if isinstance(progress, Progress):
        return progress
    if progress is None or progress is True:
        terminal = sys.stderr is not None and sys.stderr.isatty()
        return RichProgress() if terminal else NoProgress()
    if progress is False:
        return NoProgress()
    checks.fail("progress", progress, "True, False, None or a Progress", "use False for silence", TypeError)


def _fields(sweeps: int, bound: float, target: float, decay: Decay) -> dict[str, Any]:
    return {
        "completed": decay.fraction,
        "sweeps": sweeps,
        "bound": _number(bound),
        "target": _number(target),
        "speed": _number(decay.sweeps_per_second),
        "left": _clock(decay.seconds_left),
    }


def _number(value: float | None) -> str:
    return "-" if value is None or math.isnan(value) else f"{value:.2g}"


def _clock(seconds: float | None) -> str:
    if seconds is None or seconds >= 360_000:  # 100 hours: no estimate at all
        return "-:--:--"
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}"
