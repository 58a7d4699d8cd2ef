"""The LightningModule: which parameters are optimised, by which loss, at which rate."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import Any

import lightning as L
import torch
from torch import Tensor

from nlos_lit.functional.sharded import leave_buffers
from nlos_lit.metrics.transients import expected_deviance, nmse_noise_floor, poisson_deviance
from nlos_lit.model.objective import Objective, parameter_groups, rated_groups
from nlos_lit.model.pipeline import Pipeline

log = logging.getLogger(__name__)


class SelfCalibration(L.LightningModule):
    """Minimise Eq. 11-14 over Θ = {Θ_pf, Θ_ls, Θ_G}.

    One epoch is one iteration (one batch of spots), so that every checkpoint lies between two optimiser steps
    and a resumed run repeats the uninterrupted one.

    Args:
        pipeline: the simulated measurement, its phasor field prepared (or by ``prepare``).
        objective: what an iteration minimises.
        optimise: which of ``phasor``, ``sensor``, ``albedo`` are fitted; the others keep their start values.
        optimizer: makes the optimiser of parameter groups with their rates, such as ``torch.optim.Adam``.
        rates: learning rate per group, on the unconstrained parameters.
        prepare: makes the phasor field once the processes that share it know each other; None where it is
            made.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        objective: Objective,
        *,
        optimise: Mapping[str, bool],
        optimizer: Callable[[list[dict[str, Any]]], torch.optim.Optimizer],
        rates: Mapping[str, float],
        prepare: Callable[[], None] | None = None,
    ) -> None:
        super().__init__()
        self.pipeline, self.criterion, self.rates, self.make_optimizer = pipeline, objective, rates, optimizer
        self.optimised = [name for name in parameter_groups(pipeline) if optimise[name]]
        self.scores: dict[str, dict[str, float]] = {}
        self._prepare = prepare
        self._freeze()

    def setup(self, stage: str) -> None:
        """Make what the processes share, once they know each other."""
        if self._prepare is not None:
            self.pipeline.to(self.trainer.strategy.root_device)
            self._prepare()
            self._prepare = None
            self._freeze()  # matching the energy makes a new parameter
        leave_buffers(self)

    def imaging_parameters(self) -> dict[str, dict[str, Any]]:
        """The six imaging parameters by the paper's names: ``{name: {"value", "unit"}}``."""
        phasor, sensor = self.pipeline.phasor, self.pipeline.laser_sensor
        parameters = {
            "omega_pf": phasor.omega_pf,
            "sigma_pf": phasor.sigma_pf,
            "sigma_ls": sensor.sigma_ls,
            "I_l": sensor.intensity,
            "kappa_s": sensor.kappa_s,
            "eta_s": sensor.background,
        }
        return {name: {"value": float(p().detach()), "unit": p.unit} for name, p in parameters.items()}

    def objective(self, batch: dict[str, Tensor]) -> dict[str, Tensor]:
        """Loss terms of a batch: ``spots`` ``[S]`` and gated ``counts`` ``[S, T]``."""
        return self.criterion.terms(self.pipeline, batch["spots"], batch["counts"], self.global_step)

    def regularisation(self, intensity: Tensor, albedo: Tensor) -> dict[str, Tensor]:
        """E_Ipf and E_ρ with their factors.

        Args:
            intensity: ``[nz, nx, ny]`` I_pf.
            albedo: ``[m, nx, ny]`` ρ, or planes of it.

        Returns:
            ``sparsity`` and ``albedo``, scalars.
        """
        return self.criterion.regularisation(intensity, albedo)

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> dict[str, Tensor]:
        """One iteration; its terms go to the loggers.

        Args:
            batch: ``spots`` ``[S]`` and gated ``counts`` ``[S, T]``.
            batch_idx: always 0, an epoch is one batch.

        Returns:
            Loss terms as :meth:`objective` gives them; Lightning descends along ``loss``.
        """
        terms = self.objective(batch)
        if self.global_step % 10 == 0 and self.pipeline.geometry.renew_capacity():
            log.warning(
                "iteration %d: more rays met a surface than there was room for; some were left out",
                self.global_step,
            )
        for name, value in terms.items():
            label = "loss/total" if name == "loss" else f"loss/{name}"
            self.log(label, value.detach(), on_step=False, on_epoch=True, sync_dist=True, batch_size=1)
        return terms

    def validation_step(self, batch: dict[str, Tensor], batch_idx: int) -> None:
        """Add a batch of monitored held-out spots to the scores.

        Args:
            batch: as in :meth:`training_step`.
            batch_idx: not looked at.
        """
        self._add_score(batch)

    def on_validation_epoch_start(self) -> None:
        """Empty the sums, keep the volume: parameters stand still meanwhile."""
        self.pipeline.phasor.hold()
        self._sums = torch.zeros(6, dtype=torch.float64, device=self.device)

    def on_validation_epoch_end(self) -> None:
        """Send the scores to the loggers as ``heldout/NAME``."""
        for name, value in self._finish_score().items():
            self.log(f"heldout/{name}", value)

    @torch.no_grad()
    def score(self, batches: Any) -> dict[str, float]:
        """NMSE, deviance per bin and their noise levels over this rank's ``batches``, summed over ranks."""
        self.on_validation_epoch_start()
        for batch in batches:
            self._add_score({name: value.to(self.device) for name, value in batch.items()})
        return self._finish_score()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Of the groups that are optimised; Lightning calls it when the fit begins."""
        return self.make_optimizer(rated_groups(self.pipeline, self.rates, self.optimised))

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the scores from before the first iteration."""
        checkpoint["scores"] = self.scores

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take them back."""
        self.scores = checkpoint["scores"]

    def _freeze(self) -> None:
        """What is not optimised keeps its value."""
        self.groups = parameter_groups(self.pipeline)
        for name, parameters in self.groups.items():
            for parameter in parameters:
                parameter.requires_grad_(name in self.optimised)

    def _add_score(self, batch: dict[str, Tensor]) -> None:
        counts, expected = batch["counts"], self.pipeline(batch["spots"]).expected
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
        self.pipeline.phasor.release()
        sums = self._sums
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(sums)
        error, energy, floor, deviance, noise, bins = sums.tolist()
        return {
            "nmse": error / energy,
            "nmse_noise_floor": floor / energy,
            "mse": error / bins / self.criterion.scale**2,
            "deviance_per_bin": deviance / bins,
            "deviance_noise": noise / bins,
        }
