"""The steps of a diagnosis: said with the time that is left, and kept, so that an interrupted diagnosis goes
on where it was.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import torch

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.foreign import bounded
from nlos_lit.runtime.plain_file import Kind, not_ours, read_plain, record, write_plain, write_whole

T = TypeVar("T")
SETTINGS = "settings.json"
Report = Callable[[str, float, float], None]
# What a step takes, in base fits, until one of its kind has been timed.
SHARE = {"image": 0.3, "fit": 1.0, "screen": 1.0}


class Kept(NamedTuple):
    """A step that was done, and how long it took."""

    seconds: float
    result: Any


class Steps:
    """Does the steps of one diagnosis.

    Kept results are plain files (:mod:`nlos_lit.runtime.plain_file`): reading them runs nothing of theirs.

    Args:
        report: called at the start of each step with what it is, seconds since the start, and seconds that
            are left (an estimate, for the turn at hand).
        folder: where results of steps are kept; None keeps nothing.
        settings: all that results depend on, as text.
        kinds: of objects that results hold.

    Raises:
        UserError: other settings have made what is there.
    """

    def __init__(
        self,
        report: Report = lambda text, passed, left: None,
        folder: Path | None = None,
        settings: str = "",
        kinds: Sequence[Kind] = (),
    ) -> None:
        self.report, self.folder, self.settings = report, folder, settings
        self.know(kinds)
        made_with = None if folder is None else folder / SETTINGS
        if made_with is not None and made_with.exists() and bounded(made_with) != settings.encode():
            raise UserError(
                f"{folder} holds the steps of an interrupted diagnosis with other settings; go on with the "
                "same settings, choose another folder, or move it away"
            )
        self.shared: dict[str, Any] = {}
        self.began, self.ahead = time.monotonic(), dict.fromkeys(SHARE, 0)
        self.taken: dict[str, list[float]] = {}
        self.earlier = 0.0  # seconds that kept results took when they were made

    def know(self, kinds: Sequence[Kind]) -> None:
        """From now on results hold objects of these kinds."""
        self.kinds = [record(Kept), *kinds]

    def share(self, objects: Mapping[str, Any]) -> None:
        """Name large objects that every result refers to.

        They are kept once, by whoever made them, not with each result.
        """
        self.shared.update(objects)

    def plan(self, **kinds: int) -> None:
        """How many steps of each kind are to come."""
        self.ahead = dict.fromkeys(SHARE, 0) | kinds

    def left(self) -> float:
        """Seconds of the steps that are planned."""
        known = {kind: sum(taken) / len(taken) for kind, taken in self.taken.items()}
        unit = (
            max((known[kind] / SHARE[kind] for kind in known), default=0.0)
            if "fit" not in known
            else known["fit"]
        )
        return sum(number * known.get(kind, unit * SHARE[kind]) for kind, number in self.ahead.items())

    def several(self, kind: str, jobs: Sequence[tuple[str, str, Callable[[], T]]], at_once: int) -> list[T]:
        """Results of independent steps, several at a time with a single thread of torch each.

        Args:
            kind: of all these steps.
            jobs: text, name and ``make`` of each, as a step is called with.
            at_once: steps at a time.

        Returns:
            their results, in the order of ``jobs``.
        """

        def done(job: tuple[str, str, Callable[[], T]]) -> T:
            text, name, make = job
            return self(kind, text, name, make, at_once)

        if at_once == 1:
            return [done(job) for job in jobs]
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        pool = ThreadPoolExecutor(at_once, initializer=torch.set_num_threads, initargs=(1,))
        try:
            return list(pool.map(done, jobs))
        finally:
            pool.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)

    def __call__(self, kind: str, text: str, name: str, make: Callable[[], T], at_once: int = 1) -> T:
        """The result of a step, or of an earlier call that was kept under its name.

        Args:
            kind: a key of ``SHARE``, by which the time left is estimated.
            text: what is reported.
            name: that the result is kept under.
            make: does the step.
            at_once: steps that go on side by side.

        Raises:
            UserError: the file that was kept is damaged or foreign.
        """
        file = None if self.folder is None else self.folder / f"{name}.npz"
        if file is not None and file.is_file():
            self.ahead[kind] = max(0, self.ahead[kind] - 1)
            kept = read_plain(file, self.kinds, self.shared)
            if not isinstance(kept, Kept):
                raise not_ours(file)
            self.earlier += kept.seconds
            return kept.result
        self.report(text, time.monotonic() - self.began, self.left())
        began = time.monotonic()
        result = make()
        took = (time.monotonic() - began) / at_once
        self.taken.setdefault(kind, []).append(took)
        self.ahead[kind] = max(0, self.ahead[kind] - 1)
        if file is not None:
            if not (file.parent / SETTINGS).exists():
                write_whole(file.parent / SETTINGS, self.settings.encode())
            write_plain(file, Kept(took, result), self.kinds, self.shared)
        return result
