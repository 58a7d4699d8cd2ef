"""Progress of long work with the time that is left: a bar on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

log = logging.getLogger(__name__)


class Ticker:
    """One task's progress, a bar on a terminal and lines in a log elsewhere.

    Args:
        what: is done.
        total: steps; ``update`` may name another where more is to be done.
        done: steps that are done already.
    """

    def __init__(self, what: str, total: int, done: int = 0) -> None:
        self.what, self.total, self.start = what, total, done
        console = Console(stderr=True)
        self.bar: Progress | None = None
        if console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[note]}"),
            )
            self.bar = Progress(
                *columns, TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn(), console=console
            )
            self.bar.start()
            self.task = self.bar.add_task(what, total=total, completed=done, note="")
        self.began = self.spoke = time.monotonic()

    def update(self, done: int, note: str = "", total: int | None = None) -> None:
        """Say how far the task is; it may be called as often as one likes.

        Args:
            done: steps so far.
            note: beside them.
            total: steps in all, where these have changed.
        """
        self.total = total or self.total
        if self.bar is not None:
            self.bar.update(self.task, completed=done, total=self.total, note=note)
            return
        now = time.monotonic()
        if (now - self.spoke > 10 or done == self.total) and done > self.start:
            left = (now - self.began) / (done - self.start) * (self.total - done)
            log.info(
                "%s: %d of %d%s, %.0f s left", self.what, done, self.total, f", {note}" if note else "", left
            )
            self.spoke = now

    def close(self) -> None:
        if self.bar is not None:
            self.bar.stop()


def roughly(seconds: float) -> str:
    """A time that is only estimated.

    Examples:
        >>> roughly(34), roughly(447), roughly(5504)
        ('34 s', '7 min', '1.5 h')
    """
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


class StepTicker:
    """Progress of work whose steps differ and whose length is estimated on the way.

    As a context it closes its bar.

    Args:
        what: is done.
    """

    def __init__(self, what: str) -> None:
        console = Console(stderr=True)
        self.bar: Progress | None = None
        if console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.fields[note]}"),
                TimeElapsedColumn(),
            )
            self.bar = Progress(*columns, TextColumn("{task.fields[left]}"), console=console)
            self.task = self.bar.add_task(what, total=None, note="", left="")

    def step(self, text: str, passed: float, left: float) -> None:
        """A step begins.

        Args:
            text: what it is.
            passed: seconds since the start.
            left: seconds that are left of the part at hand; 0 where that is not known.
        """
        ahead = f"about {roughly(left)} left of this part" if left else ""
        if self.bar is not None:
            self.bar.update(
                self.task, completed=passed, total=passed + left if left else None, note=text, left=ahead
            )
        else:
            log.info("%.0f s: %s%s", passed, text, f", {ahead}" if ahead else "")

    def __enter__(self) -> StepTicker:
        if self.bar is not None:
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            self.bar.stop()


@contextmanager
def planes_progress(what: str) -> Iterator[Callable[[int, int], None]]:
    """A ``progress(done, total)`` callback that opens its bar at the first call."""
    ticker: Ticker | None = None

    def progress(done: int, total: int) -> None:
        nonlocal ticker
        if ticker is None:
            ticker = Ticker(what, total)
        ticker.update(done, total=total)

    try:
        yield progress
    finally:
        if ticker is not None:
            ticker.close()
