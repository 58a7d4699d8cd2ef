"""The surface as a LightningModule: surfels, response and effects fitted to the raw counts."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch
from lightning.pytorch.core.optimizer import LightningOptimizer
from torch import Tensor

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.strengths import report
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.report import figures
from nlos_lit.report.surface_figures import Front, FrontImage, overview
from nlos_lit.surfels.fit import SurfelFit
from nlos_lit.surfels.model import SurfelModel
from nlos_lit.training.capture_fit import CaptureFit
from nlos_lit.training.explored import Expected, Scene
from nlos_lit.training.shown import shown_spots, spot_residuals, transients_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LOOKED_AT = 512  # spots whose residuals are shown while the fit goes on
SOLID = 0.2  # share of the bright albedo from which on a surfel belongs to the front


class SurfaceFitting(CaptureFit):
    """A :class:`~nlos_lit.surfels.fit.SurfelFit` as a Trainer drives it: one batch an epoch.

    The fit draws its own batches, and a checkpoint holds all of its state, so that a resumed run repeats the
    uninterrupted one and both repeat :meth:`~nlos_lit.surfels.fit.SurfelFit.finish`. The number of batches
    shows on the way: ``trainer.max_epochs`` is -1, and the module stops the Trainer.

    Args:
        fit: with its rounds ahead; it is fitted in place.
        scale: counts of one unit of the paper's mean squared error.
        image: that the surface was seeded from, for the overview.
    """

    what = "surface, batches"

    def __init__(self, fit: SurfelFit, scale: float, image: FrontImage) -> None:
        super().__init__(scale)
        self.automatic_optimization = False
        self.strict_loading = False  # the fit's own state holds the surfels, see on_save_checkpoint
        self.fit, self.image = fit, image
        self.model, self.extension = fit.model, fit.extension

    @property
    def planned(self) -> int:
        """Batches of all rounds that are planned at present, those that are done included."""
        return self.fit.done + self.fit.ahead

    def setup(self, stage: str) -> None:
        """Move all that the fit needs to the Trainer's device."""
        self.fit.to(self.trainer.strategy.root_device)

    def teardown(self, stage: str) -> None:
        """Move it back: Lightning does so with the surfels."""
        self.fit.to("cpu")

    def configure_optimizers(self) -> torch.optim.Optimizer:
        """Of the round that the fit is in or begins."""
        if self.fit.finished:  # resumed from its last checkpoint: nothing is left to step
            return torch.optim.Adam(self.model.parameters())
        if not self.fit.in_round:
            self.fit.begin_round()
        return cast(torch.optim.Optimizer, self.fit.optimizer)

    def on_train_start(self) -> None:
        """Stop at once where nothing is left to do."""
        self.trainer.should_stop = self.fit.finished

    def on_train_batch_start(self, batch: Any, batch_idx: int) -> None:
        """Begin a round where one has ended; it has an optimiser of its own.

        Args:
            batch: not looked at.
            batch_idx: not looked at.
        """
        if not self.fit.in_round:
            self.fit.begin_round()
            self.trainer.optimizers = [cast(torch.optim.Optimizer, self.fit.optimizer)]

    def training_step(self, batch: dict[str, Tensor], batch_idx: int) -> dict[str, Tensor]:
        """One batch of the fit; its terms go to the loggers.

        Args:
            batch: not looked at: the fit draws its own rows.
            batch_idx: always 0, an epoch is one batch.

        Returns:
            ``loss`` and its terms, see :meth:`~nlos_lit.surfels.fit.SurfelFit.loss`.
        """
        fit, optimizer = self.fit, cast(LightningOptimizer, self.optimizers())
        rows = fit.next_rows()
        terms = fit.loss(rows)
        optimizer.zero_grad()
        self.manual_backward(terms["loss"])
        optimizer.step()
        fit.stepped(terms)
        if fit.round_done:
            fit.end_round()
            self.model = fit.model  # another one where a round was undone
            self.trainer.should_stop = fit.finished
        counts = fit.counts[rows]
        least = (counts - torch.xlogy(counts, counts)).mean()  # the same term where every bin is met exactly
        shown = {("loss/total" if name == "loss" else f"loss/{name}"): value for name, value in terms.items()}
        shown |= {"deviance": 2 * (terms["counts"] - least), "surfels": torch.tensor(float(len(fit.model)))}
        for name, value in shown.items():
            self.log(name, value.detach(), on_step=False, on_epoch=True, batch_size=1)
        return terms

    def imaging_parameters(self) -> dict[str, dict[str, Any]]:
        """Response, and quantities of the effects as ``EFFECT.QUANTITY``."""
        response = self.fit.model.laser_sensor.named_children()
        found: dict[str, dict[str, Any]] = {
            name: {"value": p().item(), "unit": p.unit}
            for name, p in response
            if isinstance(p, BoundedParameter)
        }
        for effect, quantities in report(self.fit.extension.effects).items():
            found |= {f"{effect}.{name}": dict(entry) for name, entry in quantities.items()}
        return found

    def expected(self, spots: Tensor) -> Tensor:
        """``[B, T_gate]`` expected counts of spots ``[B]``, through all effects."""
        return self.fit.model.expected(spots, self.fit.extension)

    def loss_of(self, train: dict[str, float]) -> dict[str, float]:
        """Poisson deviance per bin of the training spots."""
        return {"loss": train["deviance_per_bin"]}

    def explored(self) -> tuple[dict[str, Expected], Scene]:
        """Counts expected of the surfels, where effects are fitted without and with them, and the surfels."""
        model, extension = self.fit.model, self.fit.extension

        def without(spots: Tensor) -> Tensor:
            return model.expected(spots.to(model.laser.device), Extension([]))

        def with_all(spots: Tensor) -> Tensor:
            return model.expected(spots.to(model.laser.device), extension)

        names = ", ".join(effect.name for effect in extension.effects)
        models: dict[str, Expected]
        models = {"rendered": without, f"extended by {names}": with_all} if names else {"rendered": with_all}
        return models, Scene(clouds={"surfels": model.points()})

    def figures(self, capture: Capture, spots: np.ndarray) -> dict[str, Figure]:
        """Overview, points, transients and response of the present state.

        Args:
            capture: what is fitted.
            spots: ``[K]`` spots whose transients are shown.

        Returns:
            ``overview``, ``surface``, ``transients``, ``laser_sensor`` → figure.
        """
        model, expected = self.fit.model, self.expected(torch.from_numpy(spots).to(self.device))
        sensor = model.laser_sensor
        with torch.no_grad():
            psi = sensor.kernel().cpu().numpy()
        title = f"{len(model)} surfels after {self.fit.done} batches"
        return {
            "overview": self.overview(shown_spots(capture.n_spots, LOOKED_AT), title),
            "surface": figures.surface_plot(model.points()),
            "transients": transients_of(capture, spots, expected),
            "laser_sensor": figures.laser_sensor_plot(
                psi, capture.bin_length, first=-sensor.lead * capture.bin_length
            ),
        }

    def overview(self, spots: np.ndarray, title: str) -> Figure:
        """Phasor image, albedo, depth, normals and residuals of the present state, side by side.

        Args:
            spots: ``[K]`` whose residuals are shown.
            title: of the figure.

        Returns:
            a figure, see :func:`~nlos_lit.report.surface_figures.overview`.
        """
        places, residuals = spot_residuals(
            self.fit.capture, spots, lambda part: self.expected(part.to(self.fit.model.laser.device))
        )
        return overview(self.image, front(self.fit.model), places, residuals, title)

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep the fit's whole state, and it alone: surfels and optimiser are part of it."""
        super().on_save_checkpoint(checkpoint)
        checkpoint["fit"] = self.fit.state()
        checkpoint["state_dict"], checkpoint["optimizer_states"] = {}, []

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Take it back.

        Raises:
            UserError: it is no checkpoint of a surface, or one with other effects.
        """
        if "fit" not in checkpoint:
            raise UserError("this is not the checkpoint of a surface fit; those are in refined/checkpoints")
        super().on_load_checkpoint(checkpoint)
        self.fit.restore(checkpoint["fit"])
        self.model = self.fit.model


def front(model: SurfelModel) -> Front:
    """What the wall sees of surfels that are not faint: in each lateral cell the nearest."""
    points, cells = model.points(), model.lateral
    x, y = (o + p * np.arange(n) for o, p, n in zip(cells.origin, cells.pitch, cells.shape, strict=True))
    index = np.round((points.positions[:, :2] - cells.origin) / cells.pitch).astype(np.int64)
    bright = SOLID * np.quantile(points.albedo, 0.98)
    seen = np.flatnonzero((points.albedo >= bright) & ((index >= 0) & (index < cells.shape)).all(1))
    order = seen[np.argsort(-points.positions[seen, 2], kind="stable")]  # the nearest comes last

    def on_lattice(values: np.ndarray) -> np.ndarray:
        drawn = np.full((*cells.shape, *values.shape[1:]), np.nan)
        drawn[tuple(index[order].T)] = values[order]
        return drawn

    return Front(
        on_lattice(points.albedo), on_lattice(points.positions[:, 2]), on_lattice(points.normals), x, y
    )
