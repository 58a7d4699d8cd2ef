"""Compiled loops: how they are made, and what they take.

Tensor by tensor each operation passes once through memory, and small scenes wait for the calls. A compiled
loop keeps what it works on in registers. It takes contiguous arrays of single precision. On other devices,
and within :func:`tensor_by_tensor`, the same is said by operations of torch beside it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Tensor

_plainly = ContextVar("plainly", default=False)
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
