"""Batches of spots: which are held out, which come in which iteration."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError

log = logging.getLogger(__name__)


def heldout_mask(capture: Capture, block: int, every: int) -> np.ndarray:
    """Which spots are held out: every n-th patch of the wall, patches staggered row by row.

    Contiguous patches, because random spots would leak through their neighbours. Without a scanned grid, runs
    of ``block²`` neighbouring rows of the capture take the place of patches.

    Args:
        capture: S spots.
        block: spots on a side of a patch.
        every: n; 0 holds out nothing.

    Returns:
        ``[S]`` True where a spot is held out.

    Raises:
        UserError: impossible numbers, or all spots or none would be held out.
    """
    if every == 0:
        return np.zeros(capture.n_spots, dtype=bool)
    if block < 1 or every < 2:
        raise UserError(
            f"heldout.block must be at least 1 and heldout.every 0 or at least 2; found {block} and {every}"
        )
    if capture.scan_shape is None:
        patch = np.arange(capture.n_spots) // block**2
    else:
        nx, ny = capture.scan_shape[-2:]
        # A stride coprime to `every` puts held-out patches into every row and every column of patches.
        stride = next(k for k in range(2, every + 2) if math.gcd(k, every) == 1)
        patch = np.arange(nx)[:, None] // block + stride * (np.arange(ny) // block)
        patch = np.broadcast_to(patch.reshape(-1), (capture.n_spots // (nx * ny), nx * ny)).reshape(-1)
    held = patch % every == every - 1
    if not held.any() or held.all():
        raise UserError(
            f"heldout.block={block}, heldout.every={every} hold out {int(held.sum())} of "
            f"{capture.n_spots} spots; choose smaller blocks, or heldout.every=0 to train on all"
        )
    return held


class SpotDataset(Dataset):
    """Item ``[s, …]`` is the batch of those spots: their numbers and gated counts ``[S, T]`` as float32.

    ``observed`` ``[S, T]`` bool is with them where not all of the capture's gated bins were recorded.
    """

    def __init__(self, capture: Capture) -> None:
        self.counts = torch.from_numpy(capture.gated_counts())
        observed = capture.gated_observed()
        self.observed = None if observed is None else torch.from_numpy(observed)

    def __len__(self) -> int:
        return len(self.counts)

    def __getitem__(self, spots: list[int]) -> dict[str, torch.Tensor]:
        index = torch.tensor(spots)
        batch = {"spots": index, "counts": self.counts[index]}
        return batch if self.observed is None else batch | {"observed": self.observed[index]}


class SpotSchedule(Sampler[list[int]]):
    """One batch an epoch, from a rolling random permutation of ``spots``: a function of the epoch alone.

    Every rank takes its share of the same batch, so the ranks together see what one process would.

    Args:
        spots: ``[N]`` rows of the capture.
        batch: spots an epoch, over all ranks together.
        seed: of the permutations.
        rank: of this process.
        ranks: number of processes.

    Raises:
        UserError: the ranks cannot share a batch evenly.
    """

    def __init__(self, spots: np.ndarray, batch: int, seed: int, rank: int = 0, ranks: int = 1) -> None:
        if batch % ranks:
            raise UserError(
                f"a batch of {batch} spots cannot be shared evenly by {ranks} processes; "
                f"choose a multiple of {ranks}"
            )
        self.spots, self.batch, self.seed = spots, min(batch, len(spots) // ranks * ranks), seed
        self.rank, self.ranks, self.epoch = rank, ranks, 0

    def set_epoch(self, epoch: int) -> None:
        """Choose the iteration whose batch comes next; Lightning calls it."""
        self.epoch = epoch

    def __len__(self) -> int:
        return 1

    def __iter__(self) -> Iterator[list[int]]:
        per_pass = len(self.spots) // self.batch
        turn, place = divmod(self.epoch, per_pass)
        order = np.random.default_rng([self.seed, turn]).permutation(self.spots)
        chosen = order[place * self.batch : (place + 1) * self.batch]
        yield chosen[self.rank :: self.ranks].tolist()


class SpotBatches(Sampler[list[int]]):
    """All of ``spots`` once, in order, in batches; every ``ranks``-th batch for this rank.

    Args:
        spots: ``[N]`` rows of the capture.
        batch: spots at once.
        rank: of this process.
        ranks: number of processes.

    Examples:
        >>> list(SpotBatches(np.arange(5), batch=2, rank=1, ranks=2))
        [[2, 3]]
    """

    def __init__(self, spots: np.ndarray, batch: int, rank: int = 0, ranks: int = 1) -> None:
        self.batches = [spots[i : i + batch].tolist() for i in range(0, len(spots), batch)][rank::ranks]

    def __len__(self) -> int:
        return len(self.batches)

    def __iter__(self) -> Iterator[list[int]]:
        return iter(self.batches)


class CaptureDataModule(L.LightningDataModule):
    """Training batches and held-out spots of one capture.

    Args:
        capture: what is fitted.
        batch: spots an iteration, over all ranks together.
        block: spots on a side of a held-out patch.
        every: every n-th patch is held out; 0 holds out nothing.
        monitor_spots: held-out spots scored while training; all of them are scored before and after.
        seed: of the schedule.
    """

    def __init__(
        self, capture: Capture, *, batch: int, block: int, every: int, monitor_spots: int, seed: int
    ) -> None:
        super().__init__()
        self.capture, self.batch, self.seed = capture, batch, seed
        self.dataset = SpotDataset(capture)
        held = heldout_mask(capture, block, every)
        # A spot without a single gated count says nothing about a model: it was not recorded, as the reader
        # may have found (figure 4 has a hole of 100), or it is dead.
        measured = self.dataset.counts.sum(1).numpy() > 0
        if not measured.all():
            empty = int((~measured).sum())
            log.warning(
                "%d of %d spots hold no counts inside the gate; they are neither fitted nor scored",
                empty,
                len(held),
            )
        self.train_spots = np.flatnonzero(~held & measured)
        self.heldout_spots = np.flatnonzero(held & measured if every else measured)
        for name, spots in (("to train on", self.train_spots), ("to hold out", self.heldout_spots)):
            if len(spots) == 0:
                raise UserError(
                    f"no measured spots are left {name}; check the gate and heldout.block, heldout.every"
                )
        rng = np.random.default_rng(seed)
        self.monitored = np.sort(rng.permutation(self.heldout_spots)[:monitor_spots])
        self.reference = np.sort(rng.permutation(self.train_spots)[:monitor_spots])

    def _loader(self, sampler: Sampler) -> DataLoader:
        # As `sampler` (not `batch_sampler`), because that is where Lightning announces the epoch.
        return DataLoader(self.dataset, sampler=sampler, batch_size=None)

    def _place(self) -> tuple[int, int]:
        return (self.trainer.global_rank, self.trainer.world_size) if self.trainer is not None else (0, 1)

    def train_dataloader(self) -> DataLoader:
        """One batch of training spots an epoch, this rank's share."""
        return self._loader(SpotSchedule(self.train_spots, self.batch, self.seed, *self._place()))

    def val_dataloader(self) -> DataLoader:
        """The monitored held-out spots, this rank's share."""
        return self._loader(SpotBatches(self.monitored, self.batch, *self._place()))

    def heldout_dataloader(self) -> DataLoader:
        """All held-out spots, this rank's share; every spot where nothing is held out."""
        return self._loader(SpotBatches(self.heldout_spots, self.batch, *self._place()))

    def reference_dataloader(self) -> DataLoader:
        """Fixed training spots, for a loss that can be compared between iterations."""
        return self._loader(SpotBatches(self.reference, self.batch, *self._place()))
