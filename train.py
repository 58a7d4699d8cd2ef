"""Reconstruct a hidden scene by self-calibration: ``python train.py scene=su``."""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path

import hydra
import lightning as L
import torch
from hydra.core.hydra_config import HydraConfig
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.loggers import TensorBoardLogger
from omegaconf import DictConfig

from nlos_lit.runtime.command_line import (
    quiet_libraries,
    quote_numbers,
    refuse_finished_folder,
    sentence_errors,
    write_config,
)
from nlos_lit.training.callbacks import Bar, Figures, History, Scores
from nlos_lit.training.outcome import refine_run, shown_spots, write_results
from nlos_lit.training.run_folder import field_shards, find_checkpoint, prepare_run

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path="conf", config_name="train")
@sentence_errors
def main(config: DictConfig) -> None:
    began = time.perf_counter()
    quiet_libraries()
    folder = Path(HydraConfig.get().runtime.output_dir)
    checkpoint = find_checkpoint(config.ckpt_path, folder, config.scene.name)
    settings = write_config(config, folder)
    L.seed_everything(settings["seed"], verbose=False)
    if settings["trainer"]["threads"]:
        torch.set_num_threads(settings["trainer"]["threads"])
    device = "cuda" if settings["trainer"]["accelerator"] == "gpu" else "cpu"
    run = prepare_run(settings, device, field_shards(settings))
    monitor, history = settings["monitor"], History()
    trainer = L.Trainer(
        accelerator=settings["trainer"]["accelerator"],
        devices=settings["trainer"]["devices"],
        strategy=settings["trainer"]["strategy"],
        max_epochs=settings["scene"]["iterations"],
        check_val_every_n_epoch=monitor["every"],
        log_every_n_steps=1,
        num_sanity_val_steps=0,
        use_distributed_sampler=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        logger=TensorBoardLogger(folder, name="", version="tensorboard")
        if settings["logger"]["tensorboard"]
        else False,
        callbacks=[
            Scores(),
            history,
            Bar(),
            Figures(
                monitor["figures_every"],
                shown_spots(run.capture.n_spots, monitor["spots"]),
                folder / "figures",
            ),
            ModelCheckpoint(
                folder / "checkpoints",
                filename="iteration",
                save_last=True,
                every_n_epochs=monitor["checkpoint_every"],
                save_on_train_epoch_end=True,  # not only where the held-out spots are scored
            ),
        ],
    )
    try:
        trainer.fit(
            run.module, datamodule=run.data, ckpt_path=checkpoint, weights_only=True if checkpoint else None
        )
    except SystemExit:  # Lightning's answer to Ctrl-C
        name = settings["scene"]["name"]
        log.info(
            "interrupted; go on with: python train.py scene=%s ckpt_path=last hydra.run.dir=%s", name, folder
        )
        sys.exit(130)
    run.module.pipeline.phasor.hold()  # with the processes that end here
    if not trainer.is_global_zero:
        return
    refined = refine_run(run, folder) if settings["refine"] or settings["effects"] else None
    summary = write_results(run, history, folder, time.perf_counter() - began, refined)
    nmse = summary["heldout"]["nmse"]
    log.info(
        "held-out NMSE %.4f -> %.4f (noise %.4f), loss %.3e -> %.3e; results in %s",
        nmse["initial"], nmse["final"], nmse["noise_floor"], summary["loss"]["initial"], summary["loss"]["final"], folder,
    )  # fmt: skip
    if refined is not None:
        log.info("refined by %d surfels: held-out NMSE %.4f", refined["surfels"], refined["heldout"]["nmse"])
        for effect, reported in refined["effects"].items():
            values = (
                f"{name} {q['value']:.4g} {q['unit'].removeprefix('1')}".rstrip()
                for name, q in reported.items()
            )
            log.info("%s: %s", effect, ", ".join(values))


if __name__ == "__main__":
    quote_numbers(sys.argv)
    refuse_finished_folder(sys.argv[1:])
    main()
