"""Two processes that share the phasor field: same volume, loss and gradients as one, bytes as stated, and
what cannot work.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
import torch.distributed as dist
from literal_scenes import CASES, NAMES, build
from test_train import state, train
from torch.nn.parallel import DistributedDataParallel

from nlos_lit.capture.errors import UserError
from nlos_lit.functional import sharded
from nlos_lit.functional.sharded import Slabs, leave_buffers, most_planes
from nlos_lit.model.objective import Objective, communicated_bytes
from nlos_lit.training.run_folder import field_shards

CRITERION = Objective(400.0, 0.01, 0.005, albedo_planes=5, seed=3)
SCANS = {
    "even slabs": "confocal",
    "uneven slabs": "exhaustive",
    "residual albedo": "one sensor",
    "direct sum": "curved wall",
    "streamed": "upsampled",
}
TOLERANCE = {
    "volume": 0.0,
    "loss": 1e-6,
    "omega_pf": 2e-4,
}  # a gradient that nearly cancels keeps fewer digits


def test_slabs_by_hand():
    assert [Slabs(7, 3, r).own for r in range(3)] == [slice(0, 2), slice(2, 4), slice(4, 7)]
    assert most_planes(7, 3) == Slabs(7, 3, 0).most == 3
    # 10 voxels a plane, 4 bytes: 3 planes of its own (one of them to fill up) and the gradient of three such
    # slabs
    assert Slabs(7, 3, 0).handed_over(10) == 4 * 10 * (3 + 9)


def test_the_plan_divides_the_field():
    made = build(CASES["confocal"])
    phasor, planes = made.pipeline.phasor, made.grid.shape[0]
    whole, half = phasor.plan(made.capture, 1 << 32), phasor.plan(made.capture, 1 << 32, shards=2)
    assert planes == 22
    assert 2 * half.field_bytes == whole.field_bytes
    assert 5 * phasor.plan(made.capture, 1 << 32, shards=5).field_bytes == whole.field_bytes * 25 / 22
    assert str(half).endswith("in each of 2 processes")
    with pytest.raises(
        UserError, match="gives each of 23 processes a slab of depth planes, the volume has 22"
    ):
        phasor.plan(made.capture, 1 << 32, shards=23)
    with pytest.raises(UserError, match="divided among 2 processes, 1 are running"):
        phasor.prepare(made.capture, half)


class Loss(torch.nn.Module):
    def __init__(self, made) -> None:
        super().__init__()
        self.pipeline = made.pipeline

    def forward(self, spots: torch.Tensor, counts: torch.Tensor) -> torch.Tensor:
        return CRITERION.terms(self.pipeline, spots, counts, 0)["loss"]


def prepared(name: str, shards: int):
    made = build(CASES[name])
    phasor = made.pipeline.phasor
    plan = phasor.plan(made.capture, 1 << 32, shards)
    phasor.prepare(made.capture, replace(plan, on_disk=name == "upsampled"))
    made.spots = torch.arange(4) * 9 + 2
    made.counts = torch.from_numpy(made.capture.gated_counts())[made.spots]
    return made


def alone(name: str) -> dict[str, torch.Tensor]:
    made = prepared(name, 1)
    loss = Loss(made)(made.spots, made.counts)
    found = {"volume": made.pipeline.phasor().detach(), "loss": loss.detach()}
    return found | dict(
        zip(NAMES, torch.autograd.grad(loss, [made.raw[n] for n in NAMES], allow_unused=True), strict=True)
    )


def work(rank: int, folder: str) -> None:
    """One of two processes: half the spots, its own planes of the field."""
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meet", rank=rank, world_size=2)
    sent = [0]
    gather, scatter = dist.all_gather, dist.reduce_scatter

    def counted(of, collective, tensors_at):
        def call(*args, **kwargs):
            tensors = args[tensors_at] if isinstance(args[tensors_at], list) else [args[tensors_at]]
            of[0] += sum(t.numel() * t.element_size() for t in tensors)
            return collective(*args, **kwargs)

        return call

    sharded.dist.all_gather, sharded.dist.reduce_scatter = counted(sent, gather, 1), counted(sent, scatter, 1)
    results = {}
    for name in SCANS.values():
        made = prepared(name, 2)
        phasor = made.pipeline.phasor
        rows = phasor.file.shape[0] if phasor.file else len(phasor.field)
        loss = Loss(made)
        leave_buffers(loss)
        wrapped = DistributedDataParallel(loss, find_unused_parameters=name == "one sensor")
        before = sent[0]
        value = wrapped(made.spots[rank::2], made.counts[rank::2])
        value.backward()
        value = value.detach()
        bytes_sent = sent[0] - before
        dist.all_reduce(value)
        with torch.no_grad():
            volume = phasor()
        phasor.hold()
        calls = sent[0]
        with torch.no_grad():
            assert torch.equal(phasor(), volume)
        assert sent[0] == calls  # a held volume needs nobody
        assert phasor().requires_grad  # but a fit is not held
        phasor.release()
        gradients = {n: made.raw[n].grad for n in NAMES}
        stated = communicated_bytes(made.pipeline) - 4 * sum(p.numel() for p in loss.parameters())
        results[name] = {
            "volume": volume,
            "loss": value / 2,
            "rows": rows,
            "bytes": (bytes_sent, stated),
        } | gradients
        del wrapped
    torch.save(results, f"{folder}/{rank}.pt")
    dist.barrier()
    dist.destroy_process_group()


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    folder = tmp_path_factory.mktemp("two")
    torch.multiprocessing.spawn(work, (str(folder),), nprocs=2)
    return [torch.load(folder / f"{rank}.pt") for rank in range(2)]


@pytest.mark.parametrize("what", SCANS)
def test_two_processes_with_half_the_field_each_find_what_one_does(what, shared):
    expected = alone(SCANS[what])
    for rank in range(2):
        found = shared[rank][SCANS[what]]
        for name, value in expected.items():
            if value is None:
                assert found[name] is None
            else:
                assert (found[name] - value).norm() <= TOLERANCE.get(name, 3e-5) * value.norm(), name
    sizes = [shared[rank][SCANS[what]]["rows"] for rank in range(2)]
    assert sum(sizes) == expected["volume"].numel()
    assert max(sizes) - min(sizes) in (0, expected["volume"][0].numel())


@pytest.mark.parametrize("what", SCANS)
def test_bytes_are_those_stated(what, shared):
    voxels = shared[0][SCANS[what]]["volume"].shape
    most = -(-voxels[0] // 2)
    assert shared[0][SCANS[what]]["bytes"] == (4 * 3 * most * voxels[1] * voxels[2],) * 2


def test_the_command_shares_the_field(tmp_path):
    """As a user runs it; later commands open the run in one process."""
    folders = [tmp_path / name for name in ("alone", "shared")]
    for folder, more in zip(folders, ([], ["trainer=ddp", "shard_field=true"]), strict=True):
        done = train("scene.iterations=2", "logger=none", *more, folder=folder)
        assert ("in each of 2 processes" in done.stdout + done.stderr) == bool(more)
    one, two = (state(folder)["state_dict"] for folder in folders)
    for name in one:
        assert (two[name] - one[name]).norm() <= 1e-3 * one[name].norm(), name
    for name in ("summary.json", "volume.h5", "figures/volume_first.png"):
        assert (folders[1] / name).exists()


@pytest.mark.parametrize("devices", [1, "auto", 0])
def test_one_process_shares_with_nobody(devices):
    assert field_shards({"trainer": {"devices": 3}, "shard_field": True}) == 3
    assert field_shards({"trainer": {"devices": devices}, "shard_field": False}) == 1
    with pytest.raises(
        UserError, match=f"needs trainer=ddp and trainer.devices=2 or more; found trainer.devices={devices}"
    ):
        field_shards({"trainer": {"devices": devices}, "shard_field": True})
