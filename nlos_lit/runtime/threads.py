"""How many threads a command takes: as many as there are cores that nobody else is using."""

from __future__ import annotations

import logging
import os

import psutil
import torch

log = logging.getLogger(__name__)

SAMPLE = 0.2  # s that the cores are watched for


def choose_threads(wanted: int | None, processes: int = 1) -> None:
    """Set torch's number of threads and say so in one line.

    Two threads that wait for each other on a core that a third process wants are several times slower than
    one. ``OMP_NUM_THREADS`` stands where it is set, and so does what Lightning gives each of several
    processes.

    Args:
        wanted: number of threads; None leaves it to the machine.
        processes: that share the work.
    """
    if wanted is not None:
        torch.set_num_threads(wanted)
    elif processes == 1 and "OMP_NUM_THREADS" not in os.environ:
        cores, taken = allowed_cores(), busy_cores()
        threads = free_threads(cores, taken)
        torch.set_num_threads(threads)
        log.info(
            "%d thread%s: of %d core%s others keep %.1f busy; threads=N overrides it",
            threads, "s" * (threads > 1), cores, "s" * (cores > 1), taken,
        )  # fmt: skip


def free_threads(cores: int, taken: float) -> int:
    """Threads for the cores that are free, at least one.

    Args:
        cores: that this process may run on.
        taken: how many of them others keep busy.

    Returns:
        Their number.

    Examples:
        >>> free_threads(2, 0.1), free_threads(2, 0.9), free_threads(16, 3.2), free_threads(2, 7.0)
        (2, 1, 13, 1)
    """
    return max(1, min(cores, round(cores - taken)))


def allowed_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def busy_cores() -> float:
    """Of the cores that this process may run on, how many others keep busy.

    A core counts as taken where both say so: the load of the last minute, which also holds what has just
    ended, and the work done while one looks, which may be a moment's.
    """
    cores = allowed_cores()
    load = os.getloadavg()[0] * cores / (os.cpu_count() or 1)
    if load < 0.5:
        return load
    shares = psutil.cpu_percent(SAMPLE, percpu=True)
    mine = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else range(len(shares))
    return min(load, sum(shares[core] for core in mine if core < len(shares)) / 100)
