"""Classical baselines in the project's frame."""

from __future__ import annotations

import logging
import time

from omegaconf import DictConfig

from data_modules.load import load_scene
from nlos_lit.baselines import estimate_bytes, reconstruct_directed
from nlos_lit.baselines.surface import front_points
from nlos_lit.capture.volume_grid import volume_grid
from nlos_lit.commands.composed import compose_and_run
from nlos_lit.io.files import write_json
from nlos_lit.io.points import write_points
from nlos_lit.io.volumes import write_volume
from nlos_lit.metrics.geometry import geometry_errors
from nlos_lit.report import figures
from nlos_lit.report.style import save_figure
from nlos_lit.runtime.command_line import output_folder, quote_numbers, sentence_errors
from nlos_lit.runtime.memory import check_disk, check_machine, parse_bytes, peak_bytes
from nlos_lit.runtime.threads import choose_threads
from nlos_lit.training.folder import register_names, resolved, take_folder, take_given_folder, write_config
from nlos_lit.training.summary import git_state, versions

log = logging.getLogger(__name__)


def main(arguments: list[str]) -> int:
    """Run the command with the arguments of its command line; the exit status."""
    return compose_and_run("reconstruct", prepare, reconstruct, arguments)


@sentence_errors
def prepare(arguments: list[str]) -> None:
    """What must be done before Hydra reads the command line ``arguments``, in place."""
    quote_numbers(arguments)
    take_given_folder(arguments[1:])
    register_names()


def reconstruct(config: DictConfig) -> None:
    """Reconstruct by one method as ``conf/reconstruct.yaml`` says; write volume, points, figures, summary.

    Raises:
        UserError: the data, the geometry or the settings cannot work.
    """
    began = time.perf_counter()
    folder = output_folder()
    take_folder(folder)
    settings = resolved(config)
    choose_threads(settings["threads"])
    write_config(settings, folder)
    scene, method = settings["scene"], settings["method"]
    capture, truth = load_scene(scene, settings["data_dir"], settings["seed"], settings["force"])
    grid = volume_grid(capture, **scene["volume"])
    needed = estimate_bytes(capture, grid, method["name"])
    check_machine(needed, f"method={method['name']}")
    check_disk(folder, 4 * grid.n_voxels, "volume.h5")
    log.info(
        "%s: volume %d x %d x %d voxels, about %.2f GiB",
        method["name"],
        *grid.shape[1:],
        grid.shape[0],
        needed / 2**30,
    )
    setup = time.perf_counter() - began
    budget = parse_bytes(settings["memory_budget"])
    volume, field = reconstruct_directed(
        capture, grid, method["name"], budget_bytes=budget, **method["options"]
    )
    seconds = time.perf_counter() - began - setup
    values = (volume / volume.max().clamp_min(1e-30)).numpy()
    write_volume(folder / "volume.h5", values, grid)
    shown = figures.volume_projections(
        values, grid, threshold=scene["threshold"], title=f"{scene['name']}, {method['name']}"
    )
    save_figure(shown, folder / "figures" / "volume.png")
    points = front_points(values, grid, scene["threshold"], None if field is None else field.numpy())
    write_points(folder / "points.ply", points)
    save_figure(figures.surface_plot(points), folder / "figures" / "surface.png")
    geometry = None
    if truth is not None:
        spacing = max(abs(step) for step in grid.pitch[:2])
        geometry = geometry_errors(points, truth, lateral_tolerance=spacing).to_dict()
    summary = {
        "scene": scene["name"],
        "method": method,
        "geometry": geometry,
        "seconds": {"setup": setup, "method": seconds, "total": time.perf_counter() - began},
        "peak_memory_bytes": peak_bytes(),
        "estimated_memory_bytes": needed,
        "versions": versions(),
        "git": git_state(),
        "seed": settings["seed"],
    }
    write_json(folder / "summary.json", summary)
    log.info("%.1f s; results in %s", seconds, folder)
