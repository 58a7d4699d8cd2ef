"""What two processes send each other in an iteration: ``python benchmarks/ddp.py [names=SU] [sizes=tiny]``.

Spots are shared by the processes, and DistributedDataParallel sums the gradients: 4 bytes for each voxel's
albedo and for each of the six imaging parameters. The phasor field is whole in each process, or divided among
them by depth (``shard_field=true`` of train.py): then each also hands over its slab of the volume, 4 bytes a
voxel, and its gradient of the whole volume. Hooks count the bytes that are really handed over, and the
gradients are compared with those of one process that holds everything and sees all spots. On Linux the bytes
that really crossed the loopback device, of both processes together, stand beside them, counts of anything
else that uses it included. Rows go to benchmarks/results/speed/ddp/, and to standard output.
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from pathlib import Path

import torch
import torch.distributed as dist
from report import store
from timing import machine
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from workload import TABLE_2, Training, Workload, synthetic_capture, tiny

from nlos_lit.functional.sharded import leave_buffers
from nlos_lit.model.objective import communicated_bytes

RANKS = 2


class Loss(nn.Module):
    """The objective as a module, which is what DistributedDataParallel wraps."""

    def __init__(self, training: Training) -> None:
        super().__init__()
        self.pipeline, self.criterion = training.pipeline, training.criterion

    def forward(self, spots: Tensor, counts: Tensor) -> Tensor:
        return self.criterion.terms(self.pipeline, spots, counts, 0)["loss"]


def loopback_bytes() -> int | None:
    """What the loopback device has received so far; None where the system does not tell."""
    devices = Path("/proc/net/dev")
    found = re.search(r"\blo:\s*(\d+)", devices.read_text()) if devices.exists() else None
    return int(found[1]) if found else None


class Counter:
    """Bytes handed to collectives: by DistributedDataParallel through its hook, and while it is open by the
    shared field.
    """

    def __init__(self) -> None:
        self.bytes = 0

    def bucket(self, _, bucket):  # DDP reads annotations of hooks, and does not take them as text
        self.add(bucket.buffer())
        future = dist.all_reduce(bucket.buffer(), async_op=True).get_future()
        return future.then(lambda done: done.value()[0] / RANKS)

    def add(self, *tensors: Tensor) -> None:
        self.bytes += sum(t.numel() * t.element_size() for t in tensors)

    def __enter__(self) -> Counter:
        self.collectives = gather, scatter = dist.all_gather, dist.reduce_scatter

        def all_gather(found, own, **options):
            self.add(own)
            return gather(found, own, **options)

        def reduce_scatter(own, parts, **options):
            self.add(*parts)
            return scatter(own, parts, **options)

        dist.all_gather, dist.reduce_scatter = all_gather, reduce_scatter
        return self

    def __exit__(self, *_: object) -> None:
        dist.all_gather, dist.reduce_scatter = self.collectives


def gradients(module: nn.Module) -> Tensor:
    return torch.cat([p.grad.reshape(-1).clone() for p in module.parameters()])


def work(rank: int, workload: Workload, folder: str) -> None:
    """One process: its share of the batch, with the whole field and with its share of that; its count of
    bytes.
    """
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=RANKS)
    capture = synthetic_capture(workload)
    training = Training(workload, capture)
    training.prepare()
    spots, counts = training.batch()
    alone = Loss(training)
    alone(spots, counts).backward()
    expected = gradients(alone)
    row = {"name": workload.name, "ranks": RANKS}
    for kind, shards in (("whole", 1), ("divided", RANKS)):
        training = Training(workload, capture, shards=shards)
        training.prepare()
        loss = Loss(training)
        leave_buffers(loss)
        shared, counter = DistributedDataParallel(loss), Counter()
        shared.register_comm_hook(None, counter.bucket)
        mine = spots[rank::RANKS], counts[rank::RANKS]
        shared(*mine).backward()  # makes buckets and connections
        training.optimiser.zero_grad()
        dist.barrier()
        before = loopback_bytes()
        dist.barrier()
        with counter:
            counter.bytes = 0
            shared(*mine).backward()
        dist.barrier()
        after = loopback_bytes()
        row[kind] = {
            "field_bytes": training.plan.field_bytes,
            "counted_bytes": counter.bytes,
            "expected_bytes": communicated_bytes(training.pipeline),
            "loopback_bytes": None if before is None else after - before,
            "difference": float((gradients(loss) - expected).norm() / expected.norm()),
        }
        del shared  # its hooks hold on to the group's threads
        dist.barrier()  # neither leaves while the other still sends
    if rank == 0:
        Path(folder, "row.json").write_text(json.dumps(row))
    dist.destroy_process_group()


def main(arguments: list[str]) -> None:
    given = dict(a.split("=", 1) for a in arguments)
    workload = next(w for w in TABLE_2 if w.name == given.get("names", "SU"))
    small = given.get("sizes") == "tiny"
    with tempfile.TemporaryDirectory() as folder:
        torch.multiprocessing.spawn(work, (tiny(workload) if small else workload, folder), nprocs=RANKS)
        row = json.loads(Path(folder, "row.json").read_text())
    store("ddp", workload.name + (" tiny" if small else ""), row | {"machine": machine()})
    print(json.dumps(row))


if __name__ == "__main__":
    main(sys.argv[1:])
