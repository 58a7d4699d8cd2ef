"""What two processes send each other in an iteration: ``python benchmarks/ddp.py [names=SU] [sizes=tiny]``.

Spots are shared by the processes, each holds the whole phasor field, and DistributedDataParallel sums the gradients: 4 bytes for
each voxel's albedo and for each of the six imaging parameters. A hook counts the bytes that are really handed over, and the
gradients are compared with those of one process that sees all spots.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from workload import TABLE_2, Training, Workload, synthetic_capture, tiny

from nlos_lit.objective import communicated_bytes

RANKS = 2


class Loss(nn.Module):
    """The objective as a module, which is what DistributedDataParallel wraps."""

    def __init__(self, training: Training) -> None:
        super().__init__()
        self.pipeline, self.criterion = training.pipeline, training.criterion

    def forward(self, spots: Tensor, counts: Tensor) -> Tensor:
        return self.criterion.terms(self.pipeline, spots, counts, 0)["loss"]


def work(rank: int, workload: Workload, folder: str) -> None:
    """One process: its share of the batch, its count of bytes."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=RANKS)
    training = Training(workload, synthetic_capture(workload))
    training.prepare()
    spots, counts = training.batch()
    loss = Loss(training)
    loss(spots, counts).backward()
    alone = torch.cat([p.grad.reshape(-1).clone() for p in loss.parameters()])
    training.optimiser.zero_grad()
    sent = [0]

    def count(_, bucket):  # DDP reads annotations of hooks, and does not take them as text
        sent[0] += bucket.buffer().numel() * bucket.buffer().element_size()
        future = dist.all_reduce(bucket.buffer(), async_op=True).get_future()
        return future.then(lambda done: done.value()[0] / RANKS)

    shared = DistributedDataParallel(loss)
    shared.register_comm_hook(None, count)
    shared(spots[rank::RANKS], counts[rank::RANKS]).backward()
    together = torch.cat([p.grad.reshape(-1) for p in loss.parameters()])
    if rank == 0:
        difference = float((together - alone).norm() / alone.norm())
        row = {
            "name": workload.name,
            "counted_bytes": sent[0],
            "expected_bytes": communicated_bytes(training.pipeline),
            "difference": difference,
        }
        Path(folder, "row.json").write_text(json.dumps(row))
    del shared  # its hooks hold on to the group's threads
    dist.barrier()  # neither leaves while the other still sends
    dist.destroy_process_group()


def main(arguments: list[str]) -> None:
    given = dict(a.split("=", 1) for a in arguments)
    workload = next(w for w in TABLE_2 if w.name == given.get("names", "SU"))
    if given.get("sizes") == "tiny":
        workload = tiny(workload)
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(work, (workload, folder), nprocs=RANKS)
        print(Path(folder, "row.json").read_text())


if __name__ == "__main__":
    main(sys.argv[1:])
