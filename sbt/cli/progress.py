"""Progress on stderr: a bar on a terminal, else a line now and then, or nothing."""

from __future__ import annotations

import math
import sys
import time
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from sbt import Progress

__all__ = ["ProgressDisplay", "duration"]

_QUIET_SECONDS = 10.0
"""Without a terminal, a line of progress appears at most this often within an iteration."""
_DRAWN = 0.1
"""Seconds between two drawings of the bar."""
_RATE_FROM = 1.0
"""Seconds from which on a rate is told."""


class ProgressDisplay:
    """Progress on stderr: a bar on a terminal, else a line now and then, or nothing.

    Use as a context manager; call it with each `Progress`.
    """

    def __init__(self, *, silent: bool = False):
        """Decide how to show."""
        self._silent = silent
        self._bar: Any = None
        self._task: Any = None
        self._began = (0, 0.0)  # runs that were done, and when, at the first call of a campaign
        self._drawn = -math.inf
        self._last = (-1, -math.inf)
        self._seen: Progress | None = None

    def __enter__(self) -> ProgressDisplay:
        """Return the display itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Leave the last state of the bar on the screen."""
        if self._bar is not None:
            if self._seen is not None:
                self._draw(self._seen)
            self._bar.stop()

    def __call__(self, progress: Progress) -> None:
        """Show a state of the campaign."""
        if self._silent:
            return
        if sys.stderr.isatty():
            self._on_terminal(progress)
        else:
            self._on_line(progress)

    def _on_terminal(self, progress: Progress) -> None:
        now, before = time.monotonic(), self._seen
        if before is None or progress.done < before.done:  # of a benchmark, another cell
            self._began = (progress.done, now)
        new = before is None or (before.activity, before.iteration) != (progress.activity, progress.iteration)
        self._seen = progress
        if self._bar is None:
            from rich.console import Console
            from rich.progress import BarColumn, TextColumn
            from rich.progress import Progress as Bar

            columns = (TextColumn("{task.fields[doing]}"), BarColumn(bar_width=None), TextColumn("{task.fields[told]}"))
            console = Console(file=sys.stderr, force_terminal=True)
            self._bar = Bar(*columns, console=console, auto_refresh=False, expand=True)  # no thread: workers are forked
            self._task = self._bar.add_task("", total=1, doing="", told="")
            self._bar.start()
        if new or now - self._drawn >= _DRAWN or progress.done >= progress.budget:
            self._draw(progress)

    def _draw(self, progress: Progress) -> None:
        self._drawn = time.monotonic()
        told = " · ".join(_parts(progress, *self._rate(progress)))
        done, total = min(progress.done, progress.budget), max(progress.budget, 1)
        self._bar.update(self._task, total=total, completed=done, doing=progress.activity, told=told)
        self._bar.refresh()

    def _rate(self, progress: Progress) -> tuple[float | None, float | None]:
        """Return runs a second and seconds left; None where they are not known yet."""
        done, since = progress.done - self._began[0], time.monotonic() - self._began[1]
        if done <= 0 or since < _RATE_FROM or progress.done >= progress.budget:
            return None, None
        rate = done / since
        return rate, max(progress.budget - progress.done, 0) / rate

    def _on_line(self, progress: Progress) -> None:
        iteration, shown = self._last
        now = time.monotonic()
        beyond = progress.done - progress.budget
        if progress.iteration == iteration and now - shown < _QUIET_SECONDS and beyond != 0:
            return
        self._last = (progress.iteration, now)
        done = f"{progress.done}/{progress.budget} runs" if beyond <= 0 else f"{progress.budget} runs and {beyond} more"
        line = f"{done}, iteration {progress.iteration}, {_counts(progress)}"
        print(line, file=sys.stderr, flush=True)


def _parts(progress: Progress, rate: float | None, remaining: float | None) -> list[str]:
    """Return what stands beside the bar."""
    beyond = progress.done - progress.budget
    parts = [f"{progress.done}/{progress.budget}" if beyond <= 0 else f"{progress.budget} + {beyond}"]
    parts += [f"{rate:.3g}/s"] if rate is not None else []
    parts.append(f"{progress.critical} critical")
    parts += [f"{progress.failed} failed"] if progress.failed else []
    return [*parts, *([f"{duration(remaining)} left"] if remaining is not None and beyond < 0 else [])]


def duration(seconds: float) -> str:
    """Return a duration for people.

    >>> duration(0.4), duration(75), duration(4000)
    ('1 s', '1 min 15 s', '1 h 7 min')
    """
    whole = max(math.ceil(seconds), 1)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60} s"
    return f"{whole // 3600} h {round(whole % 3600 / 60)} min"


def _counts(progress: Progress) -> str:
    failed = f", {progress.failed} failed" if progress.failed else ""
    return f"{progress.critical} critical{failed}, {progress.activity}"
