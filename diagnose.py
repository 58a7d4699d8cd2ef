"""Say what the simulation gets wrong about a capture: ``python diagnose.py scene=su``, or ``run=FOLDER`` of a
finished run.
"""

from __future__ import annotations

import json
import logging
import shutil
import sys
import time
from pathlib import Path

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from data_modules.load import load_scene
from nlos_lit.capture.errors import UserError
from nlos_lit.inference.base_pipeline import BasePipeline
from nlos_lit.inference.criticise import CriticismSettings
from nlos_lit.inference.diagnose import diagnose
from nlos_lit.report.diagnosis_figures import diagnosis_figures
from nlos_lit.report.page import log_figures, write_report
from nlos_lit.report.verdict import verdict
from nlos_lit.runtime.command_line import (
    quote_numbers,
    refuse_finished_folder,
    sentence_errors,
    stay_in_run,
    write_config,
)
from nlos_lit.runtime.memory import parse_bytes
from nlos_lit.runtime.progress import StepTicker
from nlos_lit.surfels.fit import RefineSettings
from nlos_lit.training.run_folder import open_run, pipeline_settings

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path="conf", config_name="diagnose")
@sentence_errors
def main(config: DictConfig) -> None:
    began = time.perf_counter()
    folder = Path(HydraConfig.get().runtime.output_dir)
    if config.threads:
        torch.set_num_threads(config.threads)
    run = None
    if config.run is not None:
        folder = Path(config.run)
        if (folder / "diagnosis" / "diagnosis.json").exists():
            raise UserError(
                f"{folder} already holds a diagnosis; move {folder / 'diagnosis'} away to diagnose it anew"
            )
        run = open_run(folder)
    settings = (
        OmegaConf.to_container(config, resolve=True) if run is not None else write_config(config, folder)
    )
    scene, model = (
        (settings["scene"], settings["model"]) if run is None else (run.config["scene"], run.config["model"])
    )
    capture = run.capture if run is not None else load_scene(scene, settings["data_dir"], settings["seed"])[0]
    options = CriticismSettings(**settings["criticism"])
    pipeline = BasePipeline(
        volume=scene["volume"],
        model=pipeline_settings(model),
        surfels=RefineSettings(**settings["surfels"]),
        budget=parse_bytes(settings["memory_budget"]),
    )
    image = None
    if run is not None:
        with torch.no_grad():
            image = run.module.pipeline.phasor().cpu(), run.module.pipeline.phasor.grid
    kept = {
        "scene": scene,
        "model": model,
        **{key: settings[key] for key in ("surfels", "criticism", "seed")},
    }
    try:
        with StepTicker("diagnosis") as ticker:
            diagnosis, _ = diagnose(
                capture, pipeline, options, name=scene["name"], seed=settings["seed"], image=image,
                folder=folder / "diagnosis", settings=json.dumps(kept, indent=1, default=str), report=ticker.step,
            )  # fmt: skip
    except KeyboardInterrupt:
        log.warning("interrupted; the same command with hydra.run.dir=%s goes on where it was", folder)
        sys.exit(130)
    page = write_report(diagnosis, folder / "diagnosis")
    shutil.rmtree(folder / "diagnosis" / "steps")
    log_figures(folder, diagnosis_figures(diagnosis))
    log.info("%s", verdict(diagnosis))
    log.info("%.0f s; %s", time.perf_counter() - began, page)


if __name__ == "__main__":
    quote_numbers(sys.argv)
    refuse_finished_folder(sys.argv[1:], diagnosis=True)
    stay_in_run(sys.argv)
    main()
