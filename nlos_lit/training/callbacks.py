"""What a run shows while it goes on: scores, parameters, figures, progress."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, cast

import lightning as L
import torch
from lightning.pytorch.loggers import TensorBoardLogger

from data_modules.spots import CaptureDataModule
from nlos_lit.functional.losses import sparsity
from nlos_lit.report import figures
from nlos_lit.report.style import save_figure
from nlos_lit.runtime.progress import Ticker
from nlos_lit.training.self_calibration import SelfCalibration
from nlos_lit.training.shown import run_figures, shown_spots


def _data(trainer: L.Trainer) -> CaptureDataModule:
    return cast(CaptureDataModule, trainer.datamodule)  # type: ignore[attr-defined]  # set by trainer.fit


class ScoreHeldout(L.Callback):
    """Loss and held-out scores over fixed spots, before the first and after the last iteration.

    They stay in ``module.scores`` and are kept through checkpoints.
    """

    def on_fit_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Score the start values, unless the run goes on from a checkpoint that holds these scores.

        Args:
            trainer: its data module holds the spots.
            module: what is scored; gets ``scores["initial"]``.
        """
        module = cast(SelfCalibration, module)
        if not module.scores:
            module.scores = {"initial": self._score(trainer, module)}

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Score what was fitted.

        Args:
            trainer: its data module holds the spots.
            module: what is scored; gets ``scores["final"]``.
        """
        module = cast(SelfCalibration, module)
        module.scores["final"] = self._score(trainer, module)

    def _score(self, trainer: L.Trainer, module: SelfCalibration) -> dict[str, float]:
        data = _data(trainer)
        heldout = module.score(data.heldout_dataloader())
        train = module.score(data.reference_dataloader())
        with torch.no_grad():
            volume = module.pipeline.phasor()
            regular = module.regularisation(volume, module.pipeline.albedo(volume))
            clean = float(sparsity(volume))
        loss = train["mse"] + sum(float(term) for term in regular.values())
        return {**heldout, "loss": loss, "sparsity": clean, "train_mse": train["mse"]}


class History(L.Callback):
    """Loss terms and imaging parameters of every iteration, kept through checkpoints, sent to the loggers.

    ``values``: ``loss/NAME`` and ``parameters/NAME`` → a number an iteration. ``seconds``: of each iteration.
    """

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = {}
        self.seconds: list[float] = []

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps."""
        return {"values": self.values, "seconds": self.seconds}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what a checkpoint kept."""
        self.values, self.seconds = state["values"], state["seconds"]

    def on_train_batch_start(self, *_: Any) -> None:
        """Start the clock."""
        self.began = time.perf_counter()

    def on_train_batch_end(
        self, trainer: L.Trainer, module: L.LightningModule, outputs: Any, *_: Any
    ) -> None:
        """Note the iteration.

        Args:
            trainer: not looked at.
            module: the run's; its imaging parameters are noted.
            outputs: loss terms, as ``training_step`` returns them.
        """
        module = cast(SelfCalibration, module)
        for name, value in outputs.items():
            self.values.setdefault(f"loss/{name}", []).append(float(value.detach()))
        for name, entry in module.imaging_parameters().items():
            self.values.setdefault(f"parameters/{name}", []).append(entry["value"])
            module.log(f"parameters/{name}", entry["value"], batch_size=1)
        self.seconds.append(time.perf_counter() - self.began)


class ProgressBar(L.Callback):
    """Iterations done, the latest loss and held-out error, the time left."""

    def __init__(self) -> None:
        self.ticker: Ticker | None = None

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show the bar, in one of several processes."""
        if trainer.is_global_zero:
            assert trainer.max_epochs is not None  # Lightning sets it when a fit begins
            self.ticker = Ticker("iterations", trainer.max_epochs, trainer.current_epoch)

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Move it on."""
        metrics = trainer.callback_metrics  # asked by every process: it waits for the others
        if self.ticker is not None:
            parts = [f"loss {float(metrics['loss/total']):.3e}"] if "loss/total" in metrics else []
            parts += (
                [f"held-out NMSE {float(metrics['heldout/nmse']):.4f}"] if "heldout/nmse" in metrics else []
            )
            self.ticker.update(trainer.current_epoch + 1, ", ".join(parts))

    def on_train_end(self, *_: Any) -> None:
        """Close it."""
        self._close()

    def on_exception(self, *_: Any) -> None:
        """Close it."""
        self._close()

    def _close(self) -> None:
        if self.ticker is not None:
            self.ticker.close()


class Figures(L.Callback):
    """Figures in TensorBoard: kernel, transients, volume, albedo, surface; the first volume also as a file.

    The file is ``figures/volume_first.png`` below the trainer's ``default_root_dir``.

    Args:
        every: iterations between figures; also before the first and after the last.
        transients: spots whose transients are shown, spread over the scan.
    """

    def __init__(self, every: int, transients: int) -> None:
        self.every, self.transients = every, transients

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show what the fit starts from."""
        module = cast(SelfCalibration, module)
        phasor = module.pipeline.phasor
        phasor.hold()
        self._show(trainer, module)
        if trainer.is_global_zero and trainer.current_epoch == 0:
            with torch.no_grad():
                volume = phasor().cpu().numpy()
            grid, threshold = phasor.grid, module.pipeline.geometry.threshold
            shown = figures.volume_projections(
                volume, grid, threshold=threshold, title="intensity before the first iteration"
            )
            save_figure(shown, Path(trainer.default_root_dir) / "figures" / "volume_first.png")
        phasor.release()

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show the state after every ``every`` iterations and after the last."""
        step = trainer.current_epoch + 1
        if step % self.every == 0 or step == trainer.max_epochs:
            module = cast(SelfCalibration, module)
            module.pipeline.phasor.hold()
            self._show(trainer, module)
            module.pipeline.phasor.release()

    def _show(self, trainer: L.Trainer, module: SelfCalibration) -> None:
        boards = [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]
        if trainer.is_global_zero and boards:
            capture = _data(trainer).capture
            spots = shown_spots(capture.n_spots, self.transients)
            for name, figure in run_figures(module, capture, spots).items():
                for board in boards:
                    board.experiment.add_figure(name, figure, global_step=trainer.current_epoch)
