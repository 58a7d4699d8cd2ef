"""What every fit to a capture shows of itself while it goes on: scores, parameters, figures, progress."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import lightning as L
import numpy as np
import torch
from torch import Tensor

from data_modules.spots import CaptureDataModule
from nlos_lit.capture import Capture
from nlos_lit.metrics.transients import expected_deviance, nmse_noise_floor, poisson_deviance

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from nlos_lit.training.explored import Expected, Scene


class CaptureFit(L.LightningModule):
    """A fit to the counts of a capture, one batch of spots an epoch.

    Every checkpoint then lies between two optimiser steps.

    Args:
        scale: counts of one unit of the paper's mean squared error.

    Attributes:
        what: one batch is called, in the plural.
        scores: ``initial`` and ``final``, set by :class:`~nlos_lit.training.callbacks.ScoreHeldout`.
        origin: what is fitted and how, see :func:`~nlos_lit.training.origin.origin_of`; checkpoints keep it.
    """

    what = "iterations"

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = scale
        self.scores: dict[str, dict[str, float]] = {}
        self.origin: dict[str, Any] = {}

    @property
    @abstractmethod
    def planned(self) -> int:
        """Batches in all, those that are done included."""

    @abstractmethod
    def imaging_parameters(self) -> dict[str, dict[str, Any]]:
        """What is fitted besides the scene: ``{name: {"value", "unit"}}``."""

    @abstractmethod
    def expected(self, spots: Tensor) -> Tensor:
        """``[B, T_gate]`` expected counts of spots ``[B]``, without gradients."""

    @abstractmethod
    def figures(self, capture: Capture, spots: np.ndarray) -> dict[str, Figure]:
        """The present state in figures.

        Args:
            capture: what is fitted.
            spots: ``[K]`` spots whose transients are shown.

        Returns:
            name → figure.
        """

    @abstractmethod
    def explored(self) -> tuple[dict[str, Expected], Scene]:
        """What a page shows of the present state: expected counts by the model's name, and the scene."""

    def hold(self) -> None:
        """Called by all processes before figures are made: the state stands still until :meth:`release`."""

    def release(self) -> None:
        """The opposite of :meth:`hold`."""

    def first_figures(self) -> dict[str, Figure]:
        """Figures of what the fit starts from that are kept as files."""
        return {}

    def all_scores(self, data: CaptureDataModule) -> dict[str, float]:
        """Held-out scores over all held-out spots, loss and error over fixed training spots.

        Args:
            data: whose spots are scored.

        Returns:
            ``nmse``, ``mse``, ``deviance_per_bin``, noise levels, ``loss``, ``train_mse``.
        """
        heldout = self.score(data.heldout_dataloader())
        train = self.score(data.reference_dataloader())
        return {**heldout, **self.loss_of(train), "train_mse": train["mse"]}

    @abstractmethod
    def loss_of(self, train: dict[str, float]) -> dict[str, float]:
        """``loss`` of training spots with these scores, and what else belongs to it."""

    def validation_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """Add a batch of monitored held-out spots to the scores.

        Args:
            batch: ``spots`` ``[S]`` and gated ``counts`` ``[S, T]``.
            batch_idx: not looked at.
        """
        self._add_score(batch)

    def on_validation_epoch_start(self) -> None:
        """Empty the sums."""
        self._sums = torch.zeros(6, dtype=torch.float64, device=self.device)

    def on_validation_epoch_end(self) -> None:
        """Send the scores to the loggers as ``heldout/NAME``."""
        for name, value in self._finish_score().items():
            self.log(f"heldout/{name}", value)

    @torch.no_grad()
    def score(self, batches: Iterable[dict[str, Tensor]]) -> dict[str, float]:
        """NMSE, deviance per bin and their noise levels over this rank's ``batches``, summed over ranks."""
        self.on_validation_epoch_start()
        for batch in batches:
            self._add_score({name: value.to(self.device) for name, value in batch.items()})
        return self._finish_score()

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the scores, and what they are of."""
        checkpoint["scores"], checkpoint["origin"] = self.scores, self.origin

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take them back."""
        self.scores = checkpoint["scores"]

    def _add_score(self, batch: dict[str, Tensor]) -> None:
        counts, expected = batch["counts"], self.expected(batch["spots"])
        if "observed" in batch:
            counts, expected = counts[batch["observed"]], expected[batch["observed"]]
        noise = expected_deviance(expected) * counts.numel()
        floor = nmse_noise_floor(counts) * (counts.double() ** 2).sum()
        self._sums += torch.stack(
            [
                ((counts - expected).double() ** 2).sum(),
                (counts.double() ** 2).sum(),
                floor,
                poisson_deviance(counts, expected).sum(),
                noise,
                torch.tensor(float(counts.numel()), dtype=torch.float64, device=counts.device),
            ]
        )

    def _finish_score(self) -> dict[str, float]:
        error, energy, floor, deviance, noise, bins = self._summed(self._sums).tolist()
        return {
            "nmse": error / energy,
            "nmse_noise_floor": floor / energy,
            "mse": error / bins / self.scale**2,
            "deviance_per_bin": deviance / bins,
            "deviance_noise": noise / bins,
        }

    def _summed(self, sums: Tensor) -> Tensor:
        """Over the processes that share the fit."""
        return sums
