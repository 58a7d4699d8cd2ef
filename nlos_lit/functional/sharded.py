"""One volume made by several processes: each images a slab of depth planes and hands it to the others."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from nlos_lit.capture.errors import UserError


@dataclass(frozen=True)
class Slabs:
    """Depth planes shared by ``ranks`` processes, numbers that differ by one at most.

    Args:
        planes: of the whole volume, at least one a process.
        rank: this process.
        group: of the processes; collectives of their own, so that they keep out of the order of
            DistributedDataParallel's.
    """

    planes: int
    ranks: int
    rank: int
    group: dist.ProcessGroup | None = field(default=None, compare=False)

    @classmethod
    def join(cls, planes: int, ranks: int) -> Slabs:
        """This process's place among those that run; called by all of them.

        Args:
            planes: depth planes of the whole volume.
            ranks: processes that the plan of the field counts on.

        Returns:
            The slabs, with a process group of their own.

        Raises:
            UserError: not ``ranks`` processes are running.
        """
        running = dist.get_world_size() if dist.is_available() and dist.is_initialized() else 1
        if running != ranks:
            raise UserError(
                f"the phasor field was divided among {ranks} processes, {running} are running; start as many"
            )
        return cls(planes, ranks, dist.get_rank(), dist.new_group())

    def slab(self, rank: int) -> slice:
        """Planes of process ``rank``.

        Examples:
            >>> [Slabs(planes=7, ranks=3, rank=0).slab(rank) for rank in range(3)]
            [slice(0, 2, None), slice(2, 4, None), slice(4, 7, None)]
        """
        return slice(rank * self.planes // self.ranks, (rank + 1) * self.planes // self.ranks)

    @property
    def own(self) -> slice:
        """Planes of this process."""
        return self.slab(self.rank)

    @property
    def most(self) -> int:
        """Planes of the largest slab; the others are sent filled up with zeros."""
        return most_planes(self.planes, self.ranks)

    def handed_over(self, plane: int) -> int:
        """Bytes each process hands over in an iteration: its slab, and its gradient of all slabs.

        Args:
            plane: voxels of a depth plane.
        """
        return 4 * plane * self.most * (1 + self.ranks)


def most_planes(planes: int, ranks: int) -> int:
    """Planes of the largest slab.

    Args:
        planes: of the whole volume.
        ranks: processes that share them.

    Returns:
        ``planes/ranks``, rounded up.

    Raises:
        UserError: there are more processes than planes.

    Examples:
        >>> most_planes(7, 3)
        3
    """
    if ranks > planes:
        raise UserError(
            f"shard_field=true gives each of {ranks} processes a slab of depth planes, the volume has "
            f"{planes}; use fewer processes (trainer.devices), more planes (scene.volume.depth_pitch) or "
            "shard_field=false"
        )
    return -(-planes // ranks)


class GatherPlanes(torch.autograd.Function):
    """``[own planes, …]`` of every process → ``[planes, …]``, the same in all.

    Backward each slab's owner gets the sum of what all processes' losses say about it, so that
    DistributedDataParallel's mean of the gradients over processes is that of one process that holds
    everything.
    """

    @staticmethod
    def forward(ctx: Any, own: Tensor, slabs: Slabs) -> Tensor:
        """``[planes, …]`` from this process's slab ``[own planes, …]`` and those of the others."""
        ctx.slabs = slabs
        found = own.new_empty(slabs.ranks, slabs.most, *own.shape[1:])
        dist.all_gather(list(found), _filled(own, slabs.most), group=slabs.group)
        if slabs.planes == slabs.ranks * slabs.most:
            return found.flatten(0, 1)
        return torch.cat([found[rank, : _length(slabs.slab(rank))] for rank in range(slabs.ranks)])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        """The slab's gradient, summed over processes."""
        slabs = ctx.slabs
        parts = [_filled(grad[slabs.slab(rank)].contiguous(), slabs.most) for rank in range(slabs.ranks)]
        own = torch.empty_like(parts[0])
        dist.reduce_scatter(own, parts, group=slabs.group)
        return own[: _length(slabs.own)], None


def leave_buffers(module: nn.Module) -> None:
    """Keep DistributedDataParallel from copying all buffers from the first process in every iteration.

    The phasor field is one of them. They never change once they are made, and a slab is its process's own.
    """
    DistributedDataParallel._set_params_and_buffers_to_ignore_for_model(
        module, [name for name, _ in module.named_buffers()]
    )


def _length(part: slice) -> int:
    return part.stop - part.start


def _filled(part: Tensor, planes: int) -> Tensor:
    """``part`` with planes of zeros at its end."""
    return (
        part
        if len(part) == planes
        else torch.cat([part, part.new_zeros(planes - len(part), *part.shape[1:])])
    )
