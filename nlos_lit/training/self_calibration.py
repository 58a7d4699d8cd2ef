"""The LightningModule: which parameters are optimised, by which loss, at which rate."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.functional.losses import sparsity
from nlos_lit.functional.sharded import leave_buffers
from nlos_lit.model.objective import Objective, parameter_groups, rated_groups
from nlos_lit.model.pipeline import Pipeline
from nlos_lit.training.capture_fit import CaptureFit
from nlos_lit.training.explored import Expected, Scene
from nlos_lit.training.shown import first_volume, run_figures

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)


class SelfCalibration(CaptureFit):
    """Minimise Eq. 11-14 over Θ = {Θ_pf, Θ_ls, Θ_G}.

    One epoch is one iteration (one batch of spots), and a resumed run repeats the uninterrupted one.

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
        super().__init__(objective.scale)
        self.pipeline, self.criterion, self.rates, self.make_optimizer = pipeline, objective, rates, optimizer
        self.optimised = [name for name in parameter_groups(pipeline) if optimise[name]]
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

    @property
    def planned(self) -> int:
        """Iterations in all."""
        assert self.trainer.max_epochs is not None  # Lightning sets it when a fit begins
        return self.trainer.max_epochs

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

    @torch.no_grad()
    def expected(self, spots: Tensor) -> Tensor:
        """``[B, T_gate]`` rendered counts of spots ``[B]``."""
        return self.pipeline(spots).expected

    def loss_of(self, train: dict[str, float]) -> dict[str, float]:
        """Loss over training spots with these scores, and E_Ipf without its factor."""
        with torch.no_grad():
            volume = self.pipeline.phasor()
            regular = self.regularisation(volume, self.pipeline.albedo(volume))
            clean = float(sparsity(volume))
        return {"loss": train["mse"] + sum(float(term) for term in regular.values()), "sparsity": clean}

    @torch.no_grad()
    def explored(self) -> tuple[dict[str, Expected], Scene]:
        """Rendered counts, and the volume."""
        volume = self.pipeline.phasor().cpu().numpy()

        def rendered(spots: Tensor) -> Tensor:
            return self.expected(spots.to(self.device))

        return {"rendered": rendered}, Scene(volume=(volume, self.pipeline.phasor.grid))

    def figures(self, capture: Capture, spots: np.ndarray) -> dict[str, Figure]:
        """Kernel, transients, volume, albedo, surface: :func:`~nlos_lit.training.shown.run_figures`."""
        return run_figures(self.pipeline, capture, spots)

    def hold(self) -> None:
        """Keep the volume; processes that share its field do so together."""
        self.pipeline.phasor.hold()

    def release(self) -> None:
        """Let it go."""
        self.pipeline.phasor.release()

    def first_figures(self) -> dict[str, Figure]:
        """The volume before the first iteration."""
        return {"volume_first": first_volume(self.pipeline)}

    def on_validation_epoch_start(self) -> None:
        """Empty the sums, keep the volume: parameters stand still meanwhile."""
        self.hold()
        super().on_validation_epoch_start()

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Of the groups that are optimised; Lightning calls it when the fit begins."""
        return self.make_optimizer(rated_groups(self.pipeline, self.rates, self.optimised))

    def on_train_start(self) -> None:
        """Take the rates of this run: an optimiser's state brings those of the checkpoint."""
        for group in self.trainer.optimizers[0].param_groups:
            group["lr"] = self.rates[group["name"]]

    def _freeze(self) -> None:
        """What is not optimised keeps its value."""
        self.groups = parameter_groups(self.pipeline)
        for name, parameters in self.groups.items():
            for parameter in parameters:
                parameter.requires_grad_(name in self.optimised)

    def _summed(self, sums: Tensor) -> Tensor:
        self.release()
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            torch.distributed.all_reduce(sums)
        return sums
