"""Progress bars."""

import math
import sys
import time
from collections.abc import Iterable, Iterator
from operator import length_hint
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeRemainingColumn,
)
from rich.text import Text

_T = TypeVar("_T")


class Bar(Progress):
    """A progress bar with rate and time left, on standard error.

    Args:
        shown: Whether to draw it; default: on a terminal; elsewhere, as in a log, lines are
            printed.
        lines: Print lines also on a terminal, since bars of several processes would overwrite each
            other.
        evaluations: Network evaluations of all units, for `evaluated`; 0: unknown, as for adaptive
            solvers.
        every: Seconds between lines.
    """

    label = ""  # before each line, of a process beside others; it draws no bar

    def __init__(
        self,
        doing: str,
        total: int,
        unit: str = "scans",
        shown: bool | None = None,
        lines: bool = False,
        evaluations: int = 0,
        every: float = 30,
    ) -> None:
        lines = lines or (bool(self.label) and shown is None)
        drawn = not lines and (
            sys.stderr is not None and sys.stderr.isatty() if shown is None else shown
        )
        super().__init__(
            TextColumn(doing),
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn(unit),
            _Rate(),
            TimeRemainingColumn(),
            TextColumn("{task.fields[note]}"),
            console=Console(stderr=True, get_time=time.monotonic),
            speed_estimate_period=math.inf,
            transient=True,
            disable=not drawn,
        )
        self._task = self.add_task(unit, total=total, note="")
        self._doing = doing
        self._unit = unit
        self.every = every
        self._share = total / evaluations if evaluations else 0.0
        self._spent = 0
        self._lines = lines or (shown is None and not drawn)
        self._printed = time.monotonic()

    def __call__(self, units: float = 1) -> None:
        self.advance(self._task, units)
        now = time.monotonic()
        task = self.tasks[0]
        if self._lines and now - self._printed >= self.every and task.speed:
            self._printed = now
            # not those begun
            counted = f"{self._doing} {int(task.completed + 1e-6)}/{task.total:.0f} {self._unit}"
            left = _duration(task.time_remaining or 0)
            line = f"{self.label}{counted}  {task.speed:.2f}/s  {left} left  {task.fields['note']}"
            print(line.rstrip(), file=sys.stderr, flush=True)

    def evaluated(self) -> None:
        self._spent += 1
        self.set(note=f"{self._spent} evaluations")
        self(self._share)

    def set(self, done: float | None = None, note: str | None = None) -> None:
        """Set the number of finished units, and the note after the bar."""
        if note is not None:
            self.update(self._task, note=note)
        if done is not None:
            self(done - self.tasks[0].completed)


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text(f"{speed:.2f}/s" if speed else "")


def track(
    items: Iterable[_T], doing: str, unit: str = "", total: int | None = None, least: int = 0
) -> Iterator[_T]:
    """Iterate over items, with a bar if there are at least `least`; `total` is for iterables
    without a length.
    """
    count = length_hint(items) if total is None else total
    with Bar(doing, count, unit, shown=None if count >= least else False) as bar:
        for item in items:
            yield item
            bar()


def _duration(seconds: float) -> str:
    """75 -> '1:15', 3700 -> '1:01:40'."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
