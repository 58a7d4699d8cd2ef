"""Threads follow the cores that others leave free, of a load that is made up here."""

from __future__ import annotations

import logging

import pytest
import torch

from nlos_lit.runtime import threads
from nlos_lit.runtime.threads import busy_cores, choose_threads


@pytest.fixture
def machine(monkeypatch):
    """Four cores, of which this process may use two; a load and shares of work that a test sets."""

    def set_to(load: float, shares: tuple[float, ...] = (0, 0, 0, 0)) -> None:
        monkeypatch.setattr(threads.os, "getloadavg", lambda: (load, 9.0, 9.0))
        monkeypatch.setattr(threads.psutil, "cpu_percent", lambda interval, percpu: list(shares))

    monkeypatch.setattr(threads.os, "cpu_count", lambda: 4)
    monkeypatch.setattr(threads.os, "sched_getaffinity", lambda pid: {1, 2})
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    yield set_to
    torch.set_num_threads(before)


@pytest.mark.parametrize(
    ("load", "shares", "busy", "chosen"),
    [
        (0.2, (100, 100, 100, 100), 0.1, 2),  # a quiet minute: nobody looks closer
        (4.0, (0, 100, 100, 0), 2.0, 1),  # busy, and it shows
        (4.0, (0, 100, 5, 0), 1.05, 1),
        (4.0, (100, 2, 3, 100), 0.05, 2),  # the others' work is on other cores, or has just ended
        (2.0, (0, 100, 100, 0), 1.0, 1),  # half of the machine's load
    ],
)
def test_threads_are_the_cores_that_are_free(machine, caplog, load, shares, busy, chosen):
    machine(load, shares)
    assert busy_cores() == pytest.approx(busy)
    with caplog.at_level(logging.INFO):
        choose_threads(None)
    assert torch.get_num_threads() == chosen
    (said,) = caplog.messages
    assert said.startswith(f"{chosen} thread")
    assert f"of 2 cores others keep {busy:.1f} busy; threads=N overrides it" in said


def test_what_is_asked_for_stands(machine, monkeypatch, caplog):
    machine(8.0, (100, 100, 100, 100))
    choose_threads(2)
    assert torch.get_num_threads() == 2
    choose_threads(None, processes=2)  # each gets its share from Lightning
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    choose_threads(None)
    assert torch.get_num_threads() == 2
    assert caplog.messages == []
