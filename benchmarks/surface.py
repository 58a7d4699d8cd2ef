"""How near the noise the surface fit comes: real captures with and without effects, drawn scenes, seeds.

    python benchmarks/surface.py draw=0,1,2 seeds=3            # effect-free scenes of curved bodies
    python benchmarks/surface.py scene=su path=FILE seeds=3 effects=wall_reflectance,irf_tail

Prints one JSON line a fit. For drawn scenes the noise is the deviance of the same counts under the true
expectation; for real captures that of counts drawn from the fit. One thread.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time

import numpy as np
import torch

from data_modules.load import load_scene
from data_modules.simulate import draw_scene, simulate_capture
from data_modules.spots import heldout_mask
from nlos_lit.capture import Capture
from nlos_lit.capture.scan import Scan
from nlos_lit.capture.volume_grid import VolumeGrid, volume_grid
from nlos_lit.effects import build_effects
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.strengths import report
from nlos_lit.metrics.transients import poisson_deviance
from nlos_lit.model.build import PipelineSettings, build_pipeline
from nlos_lit.surfels.fit import SurfelSettings
from nlos_lit.surfels.fitted import fit_surfels, score_spots
from nlos_lit.training.configs import compose, settings_of


def image_of(capture: Capture, grid: VolumeGrid, settings: PipelineSettings) -> torch.Tensor:
    """The phasor image at the start values."""
    phasor = build_pipeline(capture, grid, settings).phasor
    phasor.prepare(capture, phasor.plan(capture, 4 * 2**30))
    with torch.no_grad():
        return phasor().cpu()


def fit_rows(
    name: str, capture: Capture, grid: VolumeGrid, image: torch.Tensor, truth, options: dict
) -> None:
    """One line a seed."""
    block = 8 if capture.n_spots >= 4096 else 4
    held = heldout_mask(capture, block, 4) & capture.gated_counts().any(1)
    train = np.flatnonzero(~heldout_mask(capture, block, 4) & capture.gated_counts().any(1))
    for seed in range(int(options.get("seeds", 1))):
        names = [e for e in options.get("effects", "").split(",") if e]
        extension = Extension(build_effects(names, Scan.of(capture)))
        began = time.process_time()
        found = fit_surfels(
            capture,
            image,
            grid,
            SurfelSettings(),
            train,
            extension=extension,
            seed=seed,
            scan_shapes=bool(names),
        )
        seconds = time.process_time() - began
        spots = torch.from_numpy(np.flatnonzero(held))
        scores = score_spots(found.model, capture, spots, extension)
        noise = scores.deviance_noise
        if truth is not None:
            counts = torch.from_numpy(capture.gated_counts()[held].astype(np.float32))
            noise = poisson_deviance(counts, truth[spots].clamp_min(1e-9)).mean().item()
        row = {
            "scene": name,
            "seed": seed,
            "over_noise": scores.deviance_per_bin / noise,
            **dataclasses.asdict(scores),
            "surfels": len(found.model),
            "rounds": len(found.history),
            "cpu_seconds": seconds,
            "counts_per_spot": float(capture.gated_counts().sum() / capture.n_spots),
            "effects": report(extension.effects),
        }
        print(json.dumps(row), flush=True)


def main(arguments: list[str]) -> None:
    """Read ``name=value`` arguments and print the rows."""
    torch.set_num_threads(1)
    options = dict(argument.split("=", 1) for argument in arguments)
    if "draw" in options:
        for number in options["draw"].split(","):
            drawn = draw_scene(int(number))
            capture, truth = drawn.measure()
            expected, _ = simulate_capture(drawn.mesh(), drawn.scan, drawn.sensor, None, detail=0.5)
            first, last = capture.gate
            means = torch.from_numpy(expected.counts[:, first:last].astype(np.float32))
            lowest = float(np.nanmin(truth.depth))
            grid = volume_grid(capture, depth=(max(0.1, lowest - 0.15), lowest + 1.0))
            image = image_of(capture, grid, PipelineSettings(0.1))
            fit_rows(f"drawn {number}", capture, grid, image, means, options)
        return
    config = compose("train", [f"scene={options['scene']}", f"scene.path={options['path']}"])
    capture, _ = load_scene(config["scene"], "data", 0)
    grid = volume_grid(capture, **config["scene"]["volume"])
    image = image_of(capture, grid, settings_of(PipelineSettings, config["model"], "model"))
    fit_rows(options["scene"], capture, grid, image, None, options)


if __name__ == "__main__":
    main(sys.argv[1:])
