"""What a run shows while it goes on: scores, parameters, figures, progress."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, cast

import lightning as L
from lightning.pytorch import callbacks
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.plugins import TorchCheckpointIO

from data_modules.spots import CaptureDataModule
from nlos_lit.io.tensors import write_tensors
from nlos_lit.report.style import save_figure
from nlos_lit.runtime.progress import Ticker
from nlos_lit.training.capture_fit import CaptureFit
from nlos_lit.training.explored import LIVE_SPOTS, SPOTS, facts_of, keep, view_of
from nlos_lit.training.pace import Pace
from nlos_lit.training.shown import shown_spots


def _data(trainer: L.Trainer) -> CaptureDataModule:
    return cast(CaptureDataModule, trainer.datamodule)  # type: ignore[attr-defined]  # set by trainer.fit


class WholeCheckpoints(TorchCheckpointIO):
    """Checkpoints written beside their target and renamed; Lightning's pass through the temporary folder.

    Where that lies on another disk, a full one leaves half a checkpoint under the name of a whole one.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: Any, storage_options: Any = None) -> None:
        """Write a checkpoint.

        Args:
            checkpoint: what is kept.
            path: the target, written whole or not at all.
            storage_options: not looked at.
        """
        write_tensors(path, checkpoint)


class Checkpoint(callbacks.Checkpoint):
    """The fit as it stands, in ``last.ckpt``.

    Args:
        dirpath: folder of the file.
        each: whether one for each iteration is kept as well, ``epoch=N.ckpt``.
        every: iterations between checkpoints; None goes by the time that they take, see
            :class:`~nlos_lit.training.pace.Pace`.
    """

    def __init__(self, dirpath: str | Path, each: bool, every: int | None) -> None:
        self.folder, self.each, self.pace = Path(dirpath), each, Pace(every)

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Start the clock."""
        self.pace.start()

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Write the checkpoint where it is due; Lightning calls this after all other callbacks'."""
        trial = trainer.fast_dev_run  # type: ignore[attr-defined]  # set by Lightning, not declared
        if trial or not self.pace.due(trainer, trainer.current_epoch + 1):
            return
        with self.pace.taking():
            if self.each:
                trainer.save_checkpoint(self.folder / f"epoch={trainer.current_epoch}.ckpt")
            trainer.save_checkpoint(self.folder / "last.ckpt")


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
        module = cast(CaptureFit, module)
        if not module.scores:
            module.scores = {"initial": module.all_scores(_data(trainer))}

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """There is something to fit: earlier final scores are none any more.

        Args:
            trainer: not looked at.
            module: loses ``scores["final"]``.
        """
        cast(CaptureFit, module).scores.pop("final", None)

    def on_train_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Score what was fitted.

        Args:
            trainer: its data module holds the spots.
            module: what is scored; gets ``scores["final"]``.
        """
        module = cast(CaptureFit, module)
        module.scores["final"] = module.all_scores(_data(trainer))

    def on_fit_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Score what was fitted where nothing was left to fit: the run was stopped after its last iteration.

        Args:
            trainer: its data module holds the spots.
            module: as in :meth:`on_train_end`.
        """
        if "final" not in cast(CaptureFit, module).scores:
            self.on_train_end(trainer, module)


class History(L.Callback):
    """Loss terms and imaging parameters of every iteration, kept through checkpoints, sent to the loggers.

    ``values``: ``loss/NAME`` and ``parameters/NAME`` → a number an iteration. ``seconds``: of each iteration.
    ``ran``: iterations of this process, without those of a checkpoint.
    """

    def __init__(self) -> None:
        self.ran = 0
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
        module = cast(CaptureFit, module)
        for name, value in outputs.items():
            self.values.setdefault(f"loss/{name}", []).append(float(value.detach()))
        for name, entry in module.imaging_parameters().items():
            self.values.setdefault(f"parameters/{name}", []).append(entry["value"])
            module.log(f"parameters/{name}", entry["value"], batch_size=1)
        self.seconds.append(time.perf_counter() - self.began)
        self.ran += 1


class ProgressBar(L.Callback):
    """Batches done, the latest loss and held-out error, the time left."""

    def __init__(self) -> None:
        self.ticker: Ticker | None = None

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show the bar, in one of several processes."""
        if trainer.is_global_zero:
            module = cast(CaptureFit, module)
            self.ticker = Ticker(module.what, module.planned, trainer.current_epoch)

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Move it on."""
        metrics = trainer.callback_metrics  # asked by every process: it waits for the others
        if self.ticker is not None:
            parts = [f"loss {float(metrics['loss/total']):.3e}"] if "loss/total" in metrics else []
            parts += (
                [f"held-out NMSE {float(metrics['heldout/nmse']):.4f}"] if "heldout/nmse" in metrics else []
            )
            planned = cast(CaptureFit, module).planned
            self.ticker.update(trainer.current_epoch + 1, ", ".join(parts), total=planned)

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
    """Figures of the present state in TensorBoard; those of the very start also as files in ``figures/``.

    That folder is below the trainer's ``default_root_dir``.

    Args:
        transients: spots whose transients are shown, spread over the scan.
        every: iterations between figures, None goes by the time that they take; also before the first
            iteration and after the last.
    """

    def __init__(self, transients: int, every: int | None) -> None:
        self.pace, self.transients = Pace(every), transients

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show what the fit starts from."""
        module = cast(CaptureFit, module)
        module.hold()
        with self.pace.taking():
            self._show(trainer, module)
        if trainer.is_global_zero and trainer.current_epoch == 0:
            for name, figure in module.first_figures().items():
                save_figure(figure, Path(trainer.default_root_dir) / "figures" / f"{name}.png")
        module.release()
        self.pace.start()

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show the state where that is due and after the last iteration."""
        module, step = cast(CaptureFit, module), trainer.current_epoch + 1
        if self._boards(trainer) and (self.pace.due(trainer, step) or step == module.planned):
            with self.pace.taking():
                module.hold()
                self._show(trainer, module)
                module.release()

    def _boards(self, trainer: L.Trainer) -> list[TensorBoardLogger]:
        return [logger for logger in trainer.loggers if isinstance(logger, TensorBoardLogger)]

    def _show(self, trainer: L.Trainer, module: CaptureFit) -> None:
        boards = self._boards(trainer)
        if trainer.is_global_zero and boards:
            capture = _data(trainer).capture
            for name, figure in module.figures(
                capture, shown_spots(capture.n_spots, self.transients)
            ).items():
                for board in boards:
                    board.experiment.add_figure(name, figure, global_step=trainer.current_epoch)


class Explore(L.Callback):
    """The page ``explore.html`` of a run while it goes on, see :mod:`nlos_lit.training.explored`.

    Args:
        every: iterations between pages, None goes by the time that they take; the first is made before the
            first iteration.
    """

    def __init__(self, every: int | None) -> None:
        self.pace = Pace(every)

    def on_train_start(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show what the fit starts from."""
        self._keep(trainer, cast(CaptureFit, module), trainer.current_epoch)
        self.pace.start()

    def on_train_epoch_end(self, trainer: L.Trainer, module: L.LightningModule) -> None:
        """Show the state where that is due; the last is shown by the command itself."""
        module, step = cast(CaptureFit, module), trainer.current_epoch + 1
        if self.pace.due(trainer, step) and step != module.planned:
            self._keep(trainer, module, step)

    def _keep(self, trainer: L.Trainer, module: CaptureFit, step: int) -> None:
        with self.pace.taking():
            module.hold()
            if trainer.is_global_zero:
                capture, error = _data(trainer).capture, trainer.callback_metrics.get("heldout/nmse")
                said = f"{module.what}: {step} of {module.planned}"
                said += "" if error is None else f", held-out NMSE {float(error):.4f}"
                folder = Path(trainer.default_root_dir)
                folder = folder.parent if folder.name == "refined" else folder
                models, scene = module.explored()
                kept = module.origin.get("settings", {})
                settings = {"name": kept.get("scene.name", "capture"), "path": kept.get("scene.path")}
                facts = facts_of(settings, capture, "running", [said])
                spots = SPOTS if scene.volume is None else LIVE_SPOTS
                keep(folder, view_of(capture, models, scene, facts, spots))
            module.release()
