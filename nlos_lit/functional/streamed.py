"""The phasor product of a propagated field larger than memory: it lies in a file and is read slab by slab."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.functional.phasor import sum_of_rows

SLAB_BYTES = 64 * 2**20


class FieldFile:
    """A field ``[V, 2, R]`` float32 in an unnamed temporary file, which is gone when the process ends.

    Args:
        shape: ``(V, 2, R)``.
        device: where slabs are wanted.

    Examples:
        >>> import torch
        >>> file = FieldFile((3, 2, 4), torch.device("cpu"))
        >>> file.append(torch.ones(2, 2, 4))
        >>> file.append(torch.zeros(1, 2, 4))
        >>> [(rows, slab.sum().item()) for rows, slab in file.slabs()]
        [(slice(0, 3, None), 16.0)]
    """

    def __init__(self, shape: tuple[int, int, int], device: torch.device) -> None:
        self.shape, self.device = shape, device
        self.file = tempfile.TemporaryFile()  # noqa: SIM115
        weakref.finalize(self, self.file.close)
        self.rows = max(1, SLAB_BYTES // (8 * shape[2]))

    def append(self, block: Tensor) -> None:
        """The next voxels, ``[≤ V, 2, R]``."""
        self.file.write(block.to(torch.float32).contiguous().cpu().numpy().tobytes())

    def slabs(self) -> Iterator[tuple[slice, Tensor]]:
        """Go through the field from its first voxel to its last.

        Yields:
            Rows, and their part ``[n, 2, R]`` of the field; the tensor is used again for the next.

        Raises:
            OSError: the file holds less than the field.
        """
        voxels, _, rank = self.shape
        buffer = np.empty((min(self.rows, voxels), 2, rank), dtype=np.float32)
        self.file.seek(0)
        for begin in range(0, voxels, self.rows):
            part = buffer[: min(self.rows, voxels - begin)]
            if self.file.readinto(part.data) != part.nbytes:
                raise OSError(
                    "the file of the phasor field is shorter than what was written; is the disk full?"
                )
            yield slice(begin, begin + len(part)), torch.from_numpy(part).to(self.device)


class StreamedMagnitude(torch.autograd.Function):
    """:class:`~nlos_lit.functional.phasor.PhasorMagnitude` of a :class:`FieldFile`.

    Inputs: weights ``[R]`` and the file. Output ``[V]`` float32; the weights' gradient is float64.
    """

    @staticmethod
    def forward(ctx: Any, weights: Tensor, field: FieldFile) -> Tensor:
        """``[V]`` magnitudes ``|Σ_r w_r A[v, r]|``."""
        weights = weights.to(torch.float32)
        parts = torch.empty(field.shape[0], 2, device=weights.device)
        for rows, slab in field.slabs():
            torch.matmul(slab, weights, out=parts[rows])
        magnitude = torch.linalg.vector_norm(parts, dim=1)
        ctx.field = field
        ctx.save_for_backward(parts, magnitude)
        return magnitude

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """``[R]`` float64 gradient of the weights from ``[V]`` of the magnitudes."""
        parts, magnitude = ctx.saved_tensors
        pull = parts * torch.where(magnitude > 0, grad / magnitude, 0.0)[:, None]
        result = parts.new_zeros(ctx.field.shape[2], dtype=torch.float64)
        for rows, slab in ctx.field.slabs():
            result += sum_of_rows(pull[rows].reshape(-1), slab.reshape(-1, len(result)))
        return result, None
