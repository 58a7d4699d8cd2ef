"""What a run shows while it goes on: scores, parameters, figures, progress."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.functional.losses import sparsity
from nlos_lit.functional.march import trilinear
from nlos_lit.io.points import Points
from nlos_lit.report import figures
from nlos_lit.runtime.progress import Ticker
from nlos_lit.training.self_calibration import SelfCalibration


class Scores(L.Callback):
    """Loss and held-out scores over fixed spots before the first and after the last iteration, kept through
    checkpoints.
    """

    def on_fit_start(self, trainer: L.Trainer, module: SelfCalibration) -> None:
        if not module.scores:
            module.scores = {"initial": self._score(trainer, module)}

    def on_train_end(self, trainer: L.Trainer, module: SelfCalibration) -> None:
        module.scores["final"] = self._score(trainer, module)

    def _score(self, trainer: L.Trainer, module: SelfCalibration) -> dict[str, float]:
        data = trainer.datamodule
        heldout = module.score(data.heldout_dataloader())
        train = module.score(data.reference_dataloader())
        with torch.no_grad():
            volume = module.pipeline.phasor()
            regular = module.regularisation(volume, module.pipeline.albedo(volume))
            clean = float(sparsity(volume))
        loss = train["mse"] + sum(float(term) for term in regular.values())
        return {**heldout, "loss": loss, "sparsity": clean, "train_mse": train["mse"]}


class History(L.Callback):
    """Loss terms and imaging parameters of every iteration, kept through checkpoints, sent to the logger."""

    def __init__(self) -> None:
        self.values: dict[str, list[float]] = {}
        self.seconds: list[float] = []

    def state_dict(self) -> dict[str, Any]:
        return {"values": self.values, "seconds": self.seconds}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.values, self.seconds = state["values"], state["seconds"]

    def on_train_batch_start(self, *_: Any) -> None:
        self.began = time.perf_counter()

    def on_train_batch_end(self, trainer: L.Trainer, module: SelfCalibration, outputs: Any, *_: Any) -> None:
        for name, value in outputs.items():
            self.values.setdefault(f"loss/{name}", []).append(float(value.detach()))
        for name, entry in module.imaging_parameters().items():
            self.values.setdefault(f"parameters/{name}", []).append(entry["value"])
            module.log(f"parameters/{name}", entry["value"], batch_size=1)
        self.seconds.append(time.perf_counter() - self.began)


class Bar(L.Callback):
    """Iterations done, the latest loss and held-out error, the time left."""

    def __init__(self) -> None:
        self.ticker: Ticker | None = None

    def on_train_start(self, trainer: L.Trainer, module: SelfCalibration) -> None:
        if trainer.is_global_zero:
            self.ticker = Ticker("iterations", trainer.max_epochs, trainer.current_epoch)

    def on_train_epoch_end(self, trainer: L.Trainer, module: SelfCalibration) -> None:
        metrics = trainer.callback_metrics  # asked by every process: it waits for the others
        if self.ticker is not None:
            parts = [f"loss {float(metrics['loss/total']):.3e}"] if "loss/total" in metrics else []
            parts += (
                [f"held-out NMSE {float(metrics['heldout/nmse']):.4f}"] if "heldout/nmse" in metrics else []
            )
            self.ticker.update(trainer.current_epoch + 1, ", ".join(parts))

    def on_train_end(self, *_: Any) -> None:
        self._close()

    def on_exception(self, *_: Any) -> None:
        self._close()

    def _close(self) -> None:
        if self.ticker is not None:
            self.ticker.close()


class Figures(L.Callback):
    """Figures in TensorBoard: kernel, transients, volume, albedo, surface; the first volume also as a file.

    Args:
        every: iterations between figures; also before the first and after the last.
        spots: ``[K]`` spots whose transients are shown.
        folder: where ``volume_first.png`` goes.
    """

    def __init__(self, every: int, spots: np.ndarray, folder: Path) -> None:
        self.every, self.spots, self.folder = every, spots, folder

    def on_train_start(self, trainer: L.Trainer, module: SelfCalibration) -> None:
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
            figures.save_figure(shown, self.folder / "volume_first.png")
        phasor.release()

    def on_train_epoch_end(self, trainer: L.Trainer, module: SelfCalibration) -> None:
        step = trainer.current_epoch + 1
        if step % self.every == 0 or step == trainer.max_epochs:
            module.pipeline.phasor.hold()
            self._show(trainer, module)
            module.pipeline.phasor.release()

    def _show(self, trainer: L.Trainer, module: SelfCalibration) -> None:
        if trainer.is_global_zero and isinstance(trainer.logger, L.pytorch.loggers.TensorBoardLogger):
            board = trainer.logger.experiment
            for name, figure in run_figures(module, trainer.datamodule.capture, self.spots).items():
                board.add_figure(name, figure, global_step=trainer.current_epoch)


@torch.no_grad()
def run_figures(module: SelfCalibration, capture: Capture, spots: np.ndarray) -> dict[str, Any]:
    """Name → Figure of the present state of a run."""
    pipeline = module.pipeline
    index = torch.from_numpy(spots).to(module.device)
    rendering = pipeline(index)
    grid = pipeline.phasor.grid
    volume, albedo = rendering.intensity.cpu().numpy(), rendering.albedo.cpu().numpy()
    sensor = pipeline.laser_sensor
    psi = sensor.kernel().cpu().numpy()
    start = capture.path_gate[0]
    path = start + (np.arange(rendering.expected.shape[1]) + 0.5) * capture.bin_length
    measured = capture.gated_counts()[spots]
    threshold = pipeline.geometry.threshold
    return {
        "volume": figures.volume_projections(volume, grid, threshold=threshold, title="intensity"),
        "albedo": figures.albedo_projection(albedo, volume >= threshold, grid),
        "transients": figures.transients_plot(
            measured, rendering.expected.cpu().numpy(), path, spot_labels(capture, spots)
        ),
        "kernel": figures.kernel_plot(float(pipeline.phasor.omega_pf()), float(pipeline.phasor.sigma_pf())),
        "laser_sensor": figures.laser_sensor_plot(
            psi, capture.bin_length, first=-sensor.lead * capture.bin_length
        ),
        "surface": figures.surface_plot(surface_points(module, capture, spots)),
    }


def spot_labels(capture: Capture, spots: np.ndarray) -> list[str]:
    """Where each spot is on the wall, for panels of transients."""
    scanned, name = (capture.laser, "laser") if capture.kind == "single_sensor" else (capture.sensor, "spot")
    return [f"{name} at x = {scanned[s, 0]:.2f}, y = {scanned[s, 1]:.2f} m" for s in spots]


@torch.no_grad()
def surface_points(module: SelfCalibration, capture: Capture, spots: np.ndarray, block: int = 16) -> Points:
    """The surface seen from the scanned wall points of ``spots``, in world coordinates.

    Where one sensor point serves all spots, the laser points look in its stead: the volume can be seen from
    anywhere.
    """
    pipeline = module.pipeline
    volume = pipeline.phasor()
    albedo = pipeline.albedo(volume)
    end = "laser" if capture.kind == "single_sensor" else "sensor"
    origins, normals = getattr(pipeline, end), getattr(pipeline, f"{end}_normal")
    parts: list[tuple[np.ndarray, ...]] = []
    for first in range(0, len(spots), block):
        index = torch.from_numpy(spots[first : first + block]).to(module.device)
        surface = pipeline.surface(volume, origins[index], normals[index])
        values = trilinear(albedo, surface.point, pipeline.geometry.lattice)
        parts.append(
            tuple(t.cpu().numpy().astype(np.float64) for t in (surface.point, surface.normal, values))
        )
    return Points(*(np.concatenate(column) for column in zip(*parts, strict=True)))
