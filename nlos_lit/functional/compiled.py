"""Compiled loops: how they are made, what they take, and how threads share them.

Tensor by tensor each operation passes once through memory, and small scenes wait for the calls. A compiled
loop keeps what it works on in registers. It takes contiguous arrays of single precision. On other devices,
and within :func:`tensor_by_tensor`, the same is said by operations of torch beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any, TypeVar

import numpy as np
import torch
from numba import njit
from torch import Tensor

Of = TypeVar("Of")  # what is found
_plainly = ContextVar("plainly", default=False)
WORTH = 1 << 16  # steps of a loop from which on a second thread is asked
# Sums in any order; what is no number stays none.
LOOSE = {"reassoc", "contract", "arcp", "nsz"}


def loop(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function of arrays and numbers, compiled when it is first called, and kept on disk.

    Args:
        function: in the part of Python that numba knows. Calls of it let other threads go on.

    Returns:
        the same function.
    """
    return njit(cache=True, nogil=True, fastmath=LOOSE)(function)


def inlined(function: Callable[..., Any]) -> Callable[..., Any]:
    """A function that loops call with numbers; arrays among them would keep a loop from working on eight
    numbers at a time.

    Args:
        function: as for :func:`loop`.

    Returns:
        the same function.
    """
    return njit(inline="always")(function)


def for_loops(values: Tensor) -> bool:
    """Loops take such values: single precision on the CPU."""
    return values.device.type == "cpu" and values.dtype == torch.float32


def compiled(values: Tensor) -> bool:
    """Functions of such values whose gradients are loops, too, are compiled."""
    return for_loops(values) and not _plainly.get()


@contextmanager
def tensor_by_tensor() -> Iterator[None]:
    """Within it torch sees every operation, as it must for derivatives in forward mode."""
    token = _plainly.set(True)
    try:
        yield
    finally:
        _plainly.reset(token)


def numpy_of(values: Tensor) -> np.ndarray:
    """The same memory where it is contiguous, without gradients."""
    return values.detach().contiguous().numpy()


def in_threads(
    loop: Callable[..., None],
    paths: int,
    rows: Sequence[np.ndarray],
    fixed: Sequence[Any] = (),
    sums: Sequence[np.ndarray] = (),
) -> None:
    """Run a loop over the rows of arrays, by as many threads as torch may have.

    Args:
        loop: called with some of ``rows``, all of ``fixed``, and ``sums`` to which it adds.
        paths: in all rows; few are not worth a thread.
        rows: arrays whose first axis is divided; those of no rows are empty for all.
        fixed: whole for all.
        sums: over all rows; each thread has its own until it ends.
    """
    number = len(rows[0])
    parts = min(torch.get_num_threads(), number) if paths > WORTH else 1
    if parts == 1:
        loop(*rows, *fixed, *sums)
        return
    cuts = [round(k * number / parts) for k in range(parts + 1)]
    own = [sums, *([np.zeros_like(s) for s in sums] for _ in range(parts - 1))]
    jobs = [
        _pool(parts).submit(loop, *(a[low:high] for a in rows), *fixed, *mine)
        for low, high, mine in zip(cuts, cuts[1:], own, strict=False)
    ]
    for job in jobs:
        job.result()
    for mine in own[1:]:
        for whole, part in zip(sums, mine, strict=True):
            whole += part


def side_by_side(work: Callable[..., Of], *given: Sequence[Any]) -> list[Of]:
    """``[work(a, b, …), …]`` by as many threads as torch may have, each of which has torch for itself.

    Args:
        work: called with one of each.
        given: of one length.

    Returns:
        in the order of ``given``.
    """
    threads = min(torch.get_num_threads(), len(given[0]))
    if threads == 1:
        return list(map(work, *given))

    def alone(*one: Any) -> Of:
        torch.set_num_threads(1)  # of this thread
        return work(*one)

    return list(_pool(threads).map(alone, *given))


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads)
