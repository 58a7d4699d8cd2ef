"""Seconds, bytes, and on what they were measured."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from typing import Any

import torch


def seconds(work: Callable[[], Any]) -> float:
    """Of the process's own time: with one thread what a core of its own would take, whatever else the machine
    does.
    """
    began = time.process_time()
    work()
    return time.process_time() - began


def median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]


def copy_bandwidth(device: torch.device | str = "cpu", size: int = 1 << 28) -> float:
    """Bytes a second of a large copy, reads and writes counted."""
    source = torch.ones(size // 4, device=device)
    target = torch.empty_like(source)
    cuda = torch.device(device).type == "cuda"
    best = float("inf")
    for _ in range(6):
        if cuda:
            torch.cuda.synchronize()
        began = time.perf_counter()
        target.copy_(source)
        if cuda:
            torch.cuda.synchronize()
        best = min(best, time.perf_counter() - began)
    return 2 * source.numel() * 4 / best


def machine() -> dict[str, Any]:
    """Threads, versions, and how busy the machine was."""
    return {
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "load": round(os.getloadavg()[0], 1),
        "torch": torch.__version__,
        "python": platform.python_version(),
        "device": torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU",
    }
