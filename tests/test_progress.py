"""The progress bar knows the way to go, stays quiet where it should, and never disturbs a solve."""

import io
import math
import sys
import threading

import jax
import numpy as np
import pytest
from rich.console import Console

from raymanifold_jax.progress import Decay, NoProgress, Progress, RichProgress, make_progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_make_progress(monkeypatch):
    monkeypatch.setattr(sys, "stderr", io.StringIO())
    assert all(type(make_progress(choice)) is NoProgress for choice in (None, True, False))
    monkeypatch.setattr(sys, "stderr", Terminal())
    assert type(make_progress(None)) is type(make_progress(True)) is RichProgress
    assert type(make_progress(False)) is NoProgress
    mine = NoProgress()
    assert make_progress(mine) is mine
    with pytest.raises(TypeError, match="progress: got maybe"):
        make_progress("maybe")  # pyright: ignore[reportArgumentType]


def test_geometric_decay_is_foreseen():
    # The bound halves every 2 s, from 1 to a target of 2^-20: 40 s in all.
    decay = Decay()
    for sweep in range(16):
        decay.add(sweep, 0.5**sweep, 0.5**20, now=2.0 * sweep)
        assert decay.fraction == pytest.approx(sweep / 20)
    assert decay.seconds_left == pytest.approx(40 - 30)
    assert decay.sweeps_per_second == pytest.approx(0.5)
    decay.add(20, 0.5**21, 0.5**20, now=40.0)
    assert (decay.fraction, decay.seconds_left) == (1.0, 0.0)


odd_bounds = [math.inf, math.nan, 0.0, -1.0, 1.0, 5e-324, 2.0, math.nan, 1e-3, 1e-3, 1e308]


@pytest.mark.parametrize("target", [1e-2, 0.0, math.nan, math.inf, -1.0])
def test_odd_bounds_do_no_harm(target):
    decay = Decay()
    for sweep, bound in enumerate(odd_bounds):
        decay.add(sweep, bound, target, now=float(sweep // 2))
        assert 0 <= decay.fraction <= 1
        assert decay.seconds_left is None or decay.seconds_left >= 0


def shown(delay: float, updates) -> str:
    screen = Terminal()
    progress = RichProgress(delay, Console(file=screen, force_terminal=True, width=140))
    with progress:
        progress.start("three balls")
        if progress._timer is not None and delay == 0:
            progress._timer.join()
        for update in updates:
            progress.update(*update)
    progress.close()
    return screen.getvalue()


def test_bar_shows_bound_target_and_sweeps():
    text = shown(0, [(1, 0.5, 1e-4), (np.int32(7), np.float32(0.03), np.float32(1e-4))])
    for part in ("three balls", "bound 0.03 (target 0.0001)", "7 sweeps", "/s", "left"):
        assert part in text


def test_bar_takes_odd_bounds():
    assert "bound inf" in shown(0, [(i, bound, 1e-3) for i, bound in enumerate([*odd_bounds, math.inf])])


def test_short_solves_stay_quiet():
    assert shown(60, [(1, 0.5, 1e-4)]) == ""


def test_bar_starts_again_after_closing():
    screen = Terminal()
    progress = RichProgress(0, Console(file=screen, force_terminal=True, width=140))
    for name in ("first", "second"):
        progress.start(name)
        assert progress._timer is not None
        progress._timer.join()
        progress.update(1, 0.1, 1e-3)
        progress.close()
    assert "first" in screen.getvalue() and "second" in screen.getvalue()
    progress.update(2, 0.1, 1e-3)  # a late callback


def test_updates_from_many_threads_and_a_jax_callback():
    progress = RichProgress(0, Console(file=Terminal(), force_terminal=True, width=140))
    seen = []

    def tell(sweeps, bound):
        progress.update(sweeps, bound, 1e-3)
        seen.append(int(sweeps))

    @jax.jit
    def solve(x):
        def sweep(i, x):
            jax.debug.callback(tell, i, x)
            return x / 2

        return jax.lax.fori_loop(0, 5, sweep, x)

    with progress:
        progress.start()
        threads = [threading.Thread(target=tell, args=(i, 0.5)) for i in range(8)]
        for thread in threads:
            thread.start()
        solve(1.0).block_until_ready()
        jax.effects_barrier()
        for thread in threads:
            thread.join()
    assert sorted(seen) == sorted([*range(8), *range(5)])


def test_progress_is_an_interface():
    with pytest.raises(TypeError):
        Progress()  # pyright: ignore[reportAbstractUsage]
