"""Which spots are trained on, in which iteration, by which process."""

from __future__ import annotations

import dataclasses

import lightning as L
import numpy as np
import pytest
import torch

from data_modules.spots import CaptureDataModule, SpotBatches, SpotSchedule, heldout_mask
from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.runtime.command_line import quiet_libraries


def capture(nx: int = 8, ny: int = 8, bins: int = 4) -> Capture:
    x, y = np.meshgrid(np.arange(nx) * 0.1, np.arange(ny) * 0.1, indexing="ij")
    points = np.stack([x, y, 0 * x], -1).reshape(-1, 3)
    normals = np.tile([0.0, 0.0, 1.0], (nx * ny, 1))
    counts = np.arange(1, nx * ny * bins + 1, dtype=np.uint16).reshape(nx * ny, bins)
    return Capture(counts, points, points, normals, normals, 0.01, scan_shape=(nx, ny))


def module(measured: Capture, **changes) -> CaptureDataModule:
    settings = {"batch": 6, "block": 2, "every": 4, "monitor_spots": 5, "seed": 3} | changes
    return CaptureDataModule(measured, **settings)


def test_every_fourth_patch_is_held_out_staggered():
    held = heldout_mask(capture(), 2, 4).reshape(4, 2, 4, 2)
    patches = held[:, 0, :, 0]
    assert (held == patches[:, None, :, None]).all()
    assert patches.astype(int).tolist() == [[0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1], [1, 0, 0, 0]]


def test_a_quarter_is_held_out_on_a_large_scan():
    held = heldout_mask(capture(64, 64), 8, 4)
    assert held.mean() == pytest.approx(0.25)
    rows = held.reshape(64, 64)
    assert rows.any(0).all()
    assert rows.any(1).all()


@pytest.mark.parametrize(("block", "every"), [(50, 4), (2, 1), (0, 4)])
def test_impossible_splits_are_refused(block, every):
    with pytest.raises(UserError):
        heldout_mask(capture(), block, every)


def test_training_never_sees_held_out_spots():
    data = module(capture())
    held = set(data.heldout_spots.tolist())
    schedule = SpotSchedule(data.train_spots, 6, seed=0)
    seen: set[int] = set()
    for epoch in range(40):
        schedule.set_epoch(epoch)
        (batch,) = list(schedule)
        seen |= set(batch)
    assert seen == set(data.train_spots.tolist())
    assert not seen & held
    assert set(data.monitored.tolist()) <= held
    assert set(data.reference.tolist()) <= set(data.train_spots.tolist())


def test_a_pass_visits_every_spot_once_and_passes_differ():
    schedule = SpotSchedule(np.arange(12), 4, seed=0)
    orders = []
    for turn in range(2):
        order = []
        for place in range(3):
            schedule.set_epoch(3 * turn + place)
            order += next(iter(schedule))
        assert sorted(order) == list(range(12))
        orders.append(order)
    assert orders[0] != orders[1]


def test_ranks_share_the_batch_of_one_process():
    alone = SpotSchedule(np.arange(50), 8, seed=5)
    ranks = [SpotSchedule(np.arange(50), 8, seed=5, rank=r, ranks=2) for r in range(2)]
    for epoch in (0, 7, 23):
        for schedule in (alone, *ranks):
            schedule.set_epoch(epoch)
        assert sorted(next(iter(ranks[0])) + next(iter(ranks[1]))) == sorted(next(iter(alone)))
    with pytest.raises(UserError, match="multiple of 3"):
        SpotSchedule(np.arange(50), 8, seed=5, rank=0, ranks=3)


class Recorder(L.LightningModule):
    """A model that notes which spots each iteration brought."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.ones(()))
        self.seen: list[list[int]] = []

    def training_step(self, batch: dict[str, torch.Tensor], _: int) -> torch.Tensor:
        self.seen.append(batch["spots"].tolist())
        return self.weight * batch["counts"].mean()

    def validation_step(self, *_: object) -> None:
        """Nothing to score."""

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.SGD(self.parameters(), lr=0.1)


def test_a_trainer_brings_another_batch_each_iteration(tmp_path):
    data, recorder = module(capture()), Recorder()
    quiet_libraries()
    trainer = L.Trainer(
        max_epochs=5, accelerator="cpu", logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, use_distributed_sampler=False,
        limit_val_batches=0, default_root_dir=tmp_path,
    )  # fmt: skip
    trainer.fit(recorder, datamodule=data)
    schedule = SpotSchedule(data.train_spots, 6, seed=3)
    expected = []
    for epoch in range(5):
        schedule.set_epoch(epoch)
        expected += list(schedule)
    assert recorder.seen == expected
    assert len({tuple(batch) for batch in expected}) == 5


def test_scoring_visits_every_spot_once_over_the_ranks():
    parts = [list(SpotBatches(np.arange(17), 4, rank=r, ranks=2)) for r in range(2)]
    assert sorted(s for part in parts for batch in part for s in batch) == list(range(17))


def test_batches_hold_the_gated_counts_of_their_spots():
    measured = capture().with_gate(1, 3)
    batch = module(measured).dataset[[5, 2]]
    assert batch["counts"].tolist() == [[22, 23], [10, 11]]
    assert batch["spots"].tolist() == [5, 2]


def test_batches_say_what_was_recorded_where_not_all_was():
    whole = capture()
    assert "observed" not in module(whole).dataset[[0]]
    observed = np.ones((64, 4), dtype=bool)
    observed[5, 2:] = observed[9] = False
    data = module(dataclasses.replace(whole, counts=whole.counts * observed, observed=observed).with_gate(1))
    assert data.dataset[[5, 2]]["observed"].tolist() == [[True, False, False], [True] * 3]
    assert 9 not in [*data.train_spots, *data.heldout_spots]


def test_spots_without_counts_are_left_out():
    whole = capture()
    counts = whole.counts.copy()
    counts[[0, 18]] = 0
    data = module(dataclasses.replace(whole, counts=counts))
    used = np.concatenate([data.train_spots, data.heldout_spots])
    assert sorted(used.tolist()) == [s for s in range(64) if s not in (0, 18)]
