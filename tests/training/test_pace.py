"""How often a run stops to write down where it stands."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from nlos_lit.training import pace as module
from nlos_lit.training.pace import SHARE, Pace


class Clock:
    """A clock that is put forward by hand."""

    def __init__(self) -> None:
        self.now = 50.0

    def perf_counter(self) -> float:
        return self.now


def alone(others: bool = True) -> SimpleNamespace:
    """A trainer whose other processes answer ``others``."""
    strategy = SimpleNamespace(reduce_boolean_decision=lambda mine, all: mine and others)
    return SimpleNamespace(strategy=strategy)


def record(pace: Pace, clock: Clock, seconds: float) -> None:
    with pace.taking():
        clock.now += seconds


def test_a_number_of_iterations_is_obeyed():
    pace = Pace(3)
    assert [step for step in range(1, 8) if pace.due(alone(), step)] == [3, 6]


@pytest.mark.parametrize("every", [0, -1])
def test_no_such_number(every):
    with pytest.raises(ValueError, match=f"every must be 1 iteration or more, or null; found {every}"):
        Pace(every)


def test_records_take_their_share_of_the_time_and_no_more(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    pace, taken = Pace(None), 0.0
    pace.start()
    for _ in range(20_000):  # of 10 ms each, with records of half a second
        clock.now += 0.01
        if pace.due(alone(), 1):
            record(pace, clock, 0.5)
            taken += 0.5
    passed = clock.now - 50
    assert SHARE * passed - 0.5 <= taken <= SHARE * passed + 0.5


def test_what_is_shown_at_the_start_is_not_counted_but_tells_what_the_next_takes(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(module, "time", clock)
    pace = Pace(None)
    record(pace, clock, 2.0)
    pace.start()
    clock.now += 0.99 * 2.0 / SHARE
    assert not pace.due(alone(), 1)
    clock.now += 0.02 * 2.0 / SHARE
    assert pace.due(alone(), 1)


def test_processes_agree():
    pace = Pace(None)
    pace.start()
    assert pace.due(alone(), 1)
    assert not pace.due(alone(others=False), 1)
