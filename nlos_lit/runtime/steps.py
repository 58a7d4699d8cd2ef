"""The steps of a diagnosis: said with the time that is left, and kept, so that an interrupted diagnosis goes
on where it was.
"""

from __future__ import annotations

import io
import pickle
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import torch

from nlos_lit.capture.errors import UserError

T = TypeVar("T")
SETTINGS = "settings.json"
Report = Callable[[str, float, float], None]
# What a step takes, in base fits, until one of its kind has been timed.
SHARE = {"image": 0.3, "fit": 1.0, "screen": 1.0, "refit": 0.3, "check": 1.0}


class Steps:
    """Does the steps of one diagnosis.

    Args:
        report: called at the start of each step with what it is, seconds since the start, and seconds that
            are left (an estimate, for the turn at hand).
        folder: where results of steps are kept; None keeps nothing.
        settings: all that results depend on, as text.

    Raises:
        UserError: other settings have made what is there.
    """

    def __init__(
        self, report: Report = lambda text, passed, left: None, folder: Path | None = None, settings: str = ""
    ) -> None:
        self.report, self.folder, self.settings = report, folder, settings
        if (
            folder is not None
            and (folder / SETTINGS).exists()
            and (folder / SETTINGS).read_text() != settings
        ):
            raise UserError(
                f"{folder} holds the steps of an interrupted diagnosis with other settings; go on with the same settings, choose "
                "another folder, or move it away"
            )
        self.shared: dict[str, Any] = {}
        self.began, self.taken, self.ahead = time.monotonic(), {}, dict.fromkeys(SHARE, 0)
        self.earlier = 0.0  # seconds that kept results took when they were made

    def share(self, objects: Mapping[str, Any]) -> None:
        """Large objects that every result refers to; they are kept once, by whoever made them, not with each
        result.
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

    def several(self, kind: str, jobs: list[tuple[str, str, Callable[[], T]]], at_once: int) -> list[T]:
        """Results of independent steps (text, name, make), ``at_once`` of them at a time with a single thread
        of torch each.
        """
        if at_once == 1:
            return [self(kind, *job) for job in jobs]
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        pool = ThreadPoolExecutor(at_once, initializer=torch.set_num_threads, initargs=(1,))
        try:
            return list(pool.map(lambda job: self(kind, *job, at_once=at_once), jobs))
        finally:
            pool.shutdown(cancel_futures=True)
            torch.set_num_threads(threads)

    def __call__(self, kind: str, text: str, name: str, make: Callable[[], T], at_once: int = 1) -> T:
        """The result of ``make``, or of an earlier call that was kept under ``name``; ``at_once`` steps go on
        side by side.
        """
        file = None if self.folder is None else self.folder / f"{name}.pickle"
        if file is not None and file.exists():
            self.ahead[kind] = max(0, self.ahead[kind] - 1)
            took, result = self._load(file)
            self.earlier += took
            return result
        self.report(text, time.monotonic() - self.began, self.left())
        began = time.monotonic()
        result = make()
        took = (time.monotonic() - began) / at_once
        self.taken.setdefault(kind, []).append(took)
        self.ahead[kind] = max(0, self.ahead[kind] - 1)
        if file is not None:
            self._keep(file, (took, result))
        return result

    def _keep(self, file: Path, result: Any) -> None:
        names = {id(value): name for name, value in self.shared.items()}
        whole = io.BytesIO()
        _Pickler(whole, names).dump(result)
        file.parent.mkdir(parents=True, exist_ok=True)
        (file.parent / SETTINGS).write_text(self.settings)
        part = file.with_suffix(".part")
        part.write_bytes(whole.getvalue())
        part.rename(file)

    def _load(self, file: Path) -> Any:
        return _Unpickler(io.BytesIO(file.read_bytes()), self.shared).load()


class _Pickler(pickle.Pickler):
    """Writes names for shared objects."""

    def __init__(self, file: io.BytesIO, names: Mapping[int, str]) -> None:
        super().__init__(file, pickle.HIGHEST_PROTOCOL)
        self.names = names

    def persistent_id(self, obj: Any) -> str | None:
        return self.names.get(id(obj))


class _Unpickler(pickle.Unpickler):
    """Puts shared objects in for their names."""

    def __init__(self, file: io.BytesIO, shared: Mapping[str, Any]) -> None:
        super().__init__(file)
        self.shared = shared

    def persistent_load(self, pid: str) -> Any:
        return self.shared[pid]
