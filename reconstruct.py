"""Classical baselines in the project's frame: ``python reconstruct.py scene=su method=lct``."""

from __future__ import annotations

import logging
import sys
import time
from pathlib import Path

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from data_modules.scenes import load_scene
from nlos_lit import figures
from nlos_lit.baselines import estimate_bytes, reconstruct
from nlos_lit.command import quote_numbers, refuse_finished_folder, sentence_errors, write_config
from nlos_lit.export import write_json, write_volume
from nlos_lit.geometry_metrics import depth_at
from nlos_lit.memory import check_machine, parse_bytes
from nlos_lit.scan import volume_grid
from nlos_lit.summary import git_state, peak_memory_bytes, versions

log = logging.getLogger(__name__)


@hydra.main(version_base="1.3", config_path="conf", config_name="reconstruct")
@sentence_errors
def main(config: DictConfig) -> None:
    began = time.perf_counter()
    folder = Path(HydraConfig.get().runtime.output_dir)
    settings = write_config(config, folder)
    scene, method = settings["scene"], settings["method"]
    capture, truth = load_scene(scene, settings["data_dir"], settings["seed"])
    grid = volume_grid(capture, **scene["volume"])
    needed = estimate_bytes(capture, grid, method["name"])
    check_machine(needed, f"method={method['name']}")
    log.info("%s: volume %d x %d x %d voxels, about %.2f GiB", method["name"], *grid.shape[1:], grid.shape[0], needed / 2**30)
    setup = time.perf_counter() - began
    volume = reconstruct(capture, grid, method["name"], budget_bytes=parse_bytes(settings["memory_budget"]), **method["options"])
    seconds = time.perf_counter() - began - setup
    values = (volume / volume.max().clamp_min(1e-30)).numpy()
    write_volume(folder / "volume.h5", values, grid)
    shown = figures.volume_projections(values, grid, threshold=scene["threshold"], title=f"{scene['name']}, {method['name']}")
    figures.save_figure(shown, folder / "figures" / "volume.png")
    summary = {
        "scene": scene["name"],
        "method": method,
        "geometry": None,
        "seconds": {"setup": setup, "method": seconds, "total": time.perf_counter() - began},
        "peak_memory_bytes": peak_memory_bytes(),
        "estimated_memory_bytes": needed,
        "versions": versions(),
        "git": git_state(),
        "seed": settings["seed"],
    }
    if truth is not None:
        front = np.where(values.max(0) >= scene["threshold"], grid.z[values.argmax(0)], np.nan)
        summary["geometry"] = front_errors(front, truth, grid)
    write_json(folder / "summary.json", summary)
    log.info("%.1f s; results in %s", seconds, folder)


def front_errors(front: np.ndarray, truth, grid) -> dict[str, float]:
    """Errors of the depth of the maximum along z, ``[nx, ny]`` m with NaN where nothing was found, against the truth."""
    x, y = np.meshgrid(grid.x, grid.y, indexing="ij")
    depth = depth_at(truth, np.stack([x.ravel(), y.ravel()], axis=1))[0].reshape(x.shape)
    both = np.isfinite(front) & np.isfinite(depth)
    error = front[both] - depth[both]
    return {
        "depth_median_abs": float(np.median(np.abs(error))),
        "depth_p95_abs": float(np.quantile(np.abs(error), 0.95)),
        "depth_bias": float(error.mean()),
        "coverage": float(both.sum() / np.isfinite(depth).sum()),
        "off_truth": float((np.isfinite(front) & ~np.isfinite(depth)).sum() / np.isfinite(front).sum()),
    }


if __name__ == "__main__":
    quote_numbers(sys.argv)
    refuse_finished_folder(sys.argv[1:])
    main()
