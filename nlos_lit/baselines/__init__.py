"""Classical reconstructions in the project's frame, for comparison and quick looks.

Each method is a function of a capture and a volume grid, ``method(capture, grid, **options) -> [nz, nx, ny]``
float32, nonnegative; ``METHODS`` names them. Equations, options, sources and measured errors:
``docs/baselines.md``.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch

from nlos_lit.baselines.backprojection import bp, bp_bytes, fbp, fbp_bytes
from nlos_lit.baselines.dlct import directed_volume, dlct, dlct_bytes, dlct_field
from nlos_lit.baselines.light_cone import lct, lct_bytes
from nlos_lit.baselines.migration import fk, fk_bytes
from nlos_lit.baselines.rsd import rsd, rsd_bytes
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import CaptureError, MemoryBudgetError, UserError
from nlos_lit.capture.volume_grid import VolumeGrid

METHODS: dict[str, Callable[..., torch.Tensor]] = {
    "bp": bp,
    "fbp": fbp,
    "lct": lct,
    "dlct": dlct,
    "fk": fk,
    "rsd": rsd,
}
# Methods that find the surface's direction as well.
FIELDS: dict[str, Callable[..., torch.Tensor]] = {"dlct": dlct_field}
_BYTES: dict[str, Callable[[Capture, VolumeGrid], int]] = {
    "bp": bp_bytes,
    "fbp": fbp_bytes,
    "lct": lct_bytes,
    "dlct": dlct_bytes,
    "fk": fk_bytes,
    "rsd": rsd_bytes,
}


def reconstruct(
    capture: Capture, grid: VolumeGrid, method: str, *, budget_bytes: int | None = None, **options: Any
) -> torch.Tensor:
    """Run one of ``METHODS``.

    Args:
        capture: what was measured.
        grid: where to reconstruct.
        method: a name in ``METHODS``.
        budget_bytes: memory the method may allocate beyond the capture's counts; None sets no limit.
        options: of that method, by name.

    Returns:
        ``[nz, nx, ny]`` float32, nonnegative.

    Raises:
        UserError: unknown method or option.
        CaptureError: the method cannot work on this capture, the volume lies outside its gate, or it came out
            NaN or infinite.
        MemoryBudgetError: the estimate is above the budget; nothing was allocated.

    Examples:
        >>> import numpy as np
        >>> spot, up = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
        >>> capture = Capture(np.ones((1, 50)), spot, spot, up, up, bin_length=0.05)
        >>> grid = VolumeGrid((0.0, 0.0, 0.5), (0.1, 0.1, 0.1), (3, 2, 2))
        >>> reconstruct(capture, grid, "bp").shape
        torch.Size([3, 2, 2])
        >>> reconstruct(capture, grid, "lct")
        Traceback (most recent call last):
        nlos_lit.capture.errors.CaptureError: lct needs a confocal scan on a regular planar grid; ...
    """
    return reconstruct_directed(capture, grid, method, budget_bytes=budget_bytes, **options)[0]


def reconstruct_directed(
    capture: Capture, grid: VolumeGrid, method: str, *, budget_bytes: int | None = None, **options: Any
) -> tuple[torch.Tensor, torch.Tensor | None]:
    """As :func:`reconstruct`, with the surface's directions where the method finds them.

    Args:
        capture: what was measured.
        grid: where to reconstruct.
        method: a name in ``METHODS``.
        budget_bytes: memory the method may allocate beyond the capture's counts; None sets no limit.
        options: of that method, by name.

    Returns:
        ``[nz, nx, ny]`` float32, nonnegative; and vectors ``[3, nz, nx, ny]`` along the surface's normal of a
        method in ``FIELDS``, None of the others.

    Raises:
        UserError: unknown method or option.
        CaptureError: the method cannot work on this capture, the volume lies outside its gate, or it came out
            NaN or infinite.
        MemoryBudgetError: the estimate is above the budget; nothing was allocated.
    """
    function = _checked(capture, grid, method, budget_bytes, options)
    field = FIELDS[method](capture, grid, **options) if method in FIELDS else None
    volume = function(capture, grid, **options) if field is None else directed_volume(field)
    if not torch.isfinite(volume).all():
        raise CaptureError(
            f"method {method} has left the numbers (NaN or infinite voxels), which is no result: look for "
            "damaged values in the capture"
        )
    return volume, field


def _checked(
    capture: Capture, grid: VolumeGrid, method: str, budget_bytes: int | None, options: dict[str, Any]
) -> Callable[..., torch.Tensor]:
    function = _known(method)
    allowed = [p.name for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]
    if unknown := sorted(set(options) - set(allowed)):
        raise UserError(f"method {method} has no option {unknown[0]!r}; it takes {', '.join(allowed)}")
    if budget_bytes is not None and (need := estimate_bytes(capture, grid, method)) > budget_bytes:
        raise MemoryBudgetError(
            f"method {method} needs {need / 2**30:.2f} GiB, above the budget of "
            f"{budget_bytes / 2**30:.2f} GiB; sum time bins or spots of the capture, make the volume "
            "smaller, or raise the budget"
        )
    return function


def estimate_bytes(capture: Capture, grid: VolumeGrid, method: str) -> int:
    """Bytes that a method will allocate at its peak; allocates nothing of that size.

    Args:
        capture: what was measured.
        grid: where to reconstruct.
        method: a name in ``METHODS``.

    Returns:
        Bytes, beyond the capture's own counts.

    Raises:
        UserError: unknown method.
        CaptureError: the method cannot work on this capture, or the volume lies outside its gate.
    """
    _known(method)
    return _BYTES[method](capture, grid)


def _known(method: str) -> Callable[..., torch.Tensor]:
    if method not in METHODS:
        raise UserError(f"unknown method {method!r}; choose one of {', '.join(METHODS)}")
    return METHODS[method]
