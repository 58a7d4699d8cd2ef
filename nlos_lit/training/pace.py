"""How often a run stops to write down where it stands."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import lightning as L

SHARE = 0.05  # of a fit's time that one kind of record may take


class Pace:
    """When a record is due: every so many iterations, or as often as ``SHARE`` of the fit's time allows.

    A batch of surfels takes 10 ms, an iteration of a large volume seconds, and a figure 2 s beside either.

    Args:
        every: iterations between records; None goes by the time that they take.

    Raises:
        ValueError: there is no such number of iterations.
    """

    def __init__(self, every: int | None) -> None:
        if every is not None and every < 1:
            raise ValueError(f"every must be 1 iteration or more, or null; found {every}")
        self.every = every
        self.began = time.perf_counter()
        self.spent = self.last = 0.0

    def start(self) -> None:
        """Count time from now on; what the last record took is what the next will."""
        self.began, self.spent = time.perf_counter(), 0.0

    def due(self, trainer: L.Trainer, step: int) -> bool:
        """Whether another record is due; all processes give the same answer.

        Args:
            trainer: that fits.
            step: iterations that are done.

        Returns:
            Yes or no.
        """
        if self.every is not None:
            return step % self.every == 0
        passed = time.perf_counter() - self.began
        affordable = self.spent + self.last <= SHARE * passed
        return bool(trainer.strategy.reduce_boolean_decision(affordable, all=True))

    @contextmanager
    def taking(self) -> Iterator[None]:
        """Count the time of a block as that of a record."""
        began = time.perf_counter()
        yield
        self.last = time.perf_counter() - began
        self.spent += self.last
