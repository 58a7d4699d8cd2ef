"""What a run or a diagnosis leaves to look at: ``view.npz``, and ``explore.html`` made from it."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from nlos_lit.capture import Capture
from nlos_lit.capture.volume_grid import VolumeGrid
from nlos_lit.io.meshes import read_mesh
from nlos_lit.io.points import Points
from nlos_lit.io.views import FILE as VIEW
from nlos_lit.io.views import Mesh, View, read_view, write_view
from nlos_lit.report.explore import write_page
from nlos_lit.runtime.command_line import this_command
from nlos_lit.training.shown import scanned_points
from nlos_lit.training.summary import git_state, versions

SPOTS = 1024  # kept of a fitted surface, which is quick to render
RAYED_SPOTS, LIVE_SPOTS = 256, 36  # kept of a volume that rays are marched through: at the end, on the way
BINS = 256
POINTS = 20_000
TRIANGLES = 20_000
VOXELS = (128, 64, 64)  # along z, x, y
BLOCK = 64  # spots rendered at once

Expected = Callable[[torch.Tensor], torch.Tensor]


@dataclass(frozen=True)
class Scene:
    """A hidden scene, as far as one is known.

    Args:
        clouds: name → points of the surface.
        meshes: name → triangles.
        volume: ``[nz, nx, ny]`` and its grid; None where there is none.
    """

    clouds: Mapping[str, Points] = field(default_factory=dict)
    meshes: Mapping[str, Mesh] = field(default_factory=dict)
    volume: tuple[np.ndarray, VolumeGrid] | None = None


def view_of(
    capture: Capture,
    models: Mapping[str, Expected],
    scene: Scene,
    facts: Mapping[str, Any],
    most_spots: int = SPOTS,
) -> View:
    """The present state, thinned out to what a page can hold; the facts say by how much.

    Args:
        capture: the measurement.
        models: name → ``[B, T_gate]`` expected counts of spots ``[B]``.
        scene: as far as it is known.
        facts: what else the page says: name, status, what was found.
        most_spots: spots that are kept.

    Returns:
        The view.
    """
    spots = chosen_spots(scanned_points(capture)[:, :2], most_spots)
    bins = -(-(capture.gate[1] - capture.gate[0]) // BINS)
    seen = capture.gated_observed()
    counts = capture.gated_counts()[spots].astype(np.float64)
    if seen is not None:
        counts[~seen[spots]] = np.nan
    rendered = {name: _summed(_rendered(expected, spots), bins) for name, expected in models.items()}
    clouds, thinned = {}, {}
    for name, points in scene.clouds.items():
        step = max(1, -(-len(points) // POINTS))
        clouds[name] = Points(points.positions[::step], points.normals[::step], points.albedo[::step])
        thinned[name] = f"every {step}. point" if step > 1 else "all points"
    volume = None if scene.volume is None else pooled(*scene.volume)
    kept = {
        "spots": f"{len(spots)} of {capture.n_spots}",
        "bins": f"each is {bins} of the gate's, {bins * capture.bin_width_ps:.4g} ps",
        **thinned,
    }
    if volume is not None and scene.volume is not None:
        full, small = scene.volume[1].shape, volume[1].shape
        kept["volume"] = "{} × {} × {} voxels of {} × {} × {} (brightest of each block)".format(*small, *full)
    return View(
        facts={**facts, "kept": kept, "counts": capture.is_counts},
        spots=spots,
        places=scanned_points(capture)[spots, :2],
        path=(capture.path_gate[0], capture.bin_length * bins),
        counts=_summed(counts, bins),
        models=rendered,
        clouds=clouds,
        meshes=scene.meshes,
        volume=volume,
    )


def facts_of(
    scene: Mapping[str, Any], capture: Capture, status: str, said: Sequence[str], **more: Any
) -> dict[str, Any]:
    """What a page says besides arrays: what was found, and where it came from.

    Args:
        scene: its settings.
        capture: the measurement.
        status: running, interrupted or finished.
        said: sentences on what was found so far.
        more: further entries.

    Returns:
        JSON-serialisable facts, with the command of this process, versions and commit.
    """
    now = datetime.datetime.now().astimezone()
    origin = {
        "file": scene.get("path") or (scene.get("source") or {}).get("file"),
        "command": this_command(),
        "capture": {"spots": capture.n_spots, "bins": capture.n_bins, "sha256": capture.digest()},
        "provenance": capture.provenance,
        "git": git_state(),
        "versions": versions(),
    }
    return {
        "name": scene["name"], "status": status, "at": now.isoformat(timespec="seconds"),
        "said": list(said), "origin": origin, **more,
    }  # fmt: skip


def keep(folder: Path, view: View) -> Path:
    """Write ``view.npz`` and the page that shows it.

    Args:
        folder: of the run, or of the diagnosis.
        view: its present state.

    Returns:
        path of ``explore.html``.
    """
    write_view(folder, view)
    return write_page(folder, view)


def mark_interrupted(folder: Path) -> None:
    """Say on the page of a folder, where there is one, that its run was stopped."""
    if (folder / VIEW).is_file():
        view = read_view(folder)
        if view.facts["status"] == "running":
            keep(folder, dataclasses.replace(view, facts={**view.facts, "status": "interrupted"}))


def kept_mesh(file: Path) -> dict[str, Mesh]:
    """A mesh of a run's folder, with few triangles.

    Args:
        file: PLY file.

    Returns:
        ``mesh``, or nothing where there is none.
    """
    found = read_mesh(file, TRIANGLES)
    return {} if found is None else {"mesh": found}


def chosen_spots(places: np.ndarray, most: int) -> np.ndarray:
    """Spots evenly over the wall: every k-th row and column of a grid, every k-th of irregular ones.

    Args:
        places: ``[S, 2]`` scanned points, m.
        most: how many at most.

    Returns:
        rows of ``places`` in rising order, one for each place.

    Examples:
        >>> x, y = np.meshgrid(np.arange(4.0), np.arange(4.0), indexing="ij")
        >>> chosen_spots(np.stack([x.ravel(), y.ravel()], axis=1), 4)
        array([ 0,  2,  8, 10])
    """
    rounded = np.round(places, 5)
    _, first = np.unique(rounded, axis=0, return_index=True)
    first = np.sort(first)
    if len(first) <= most:
        return first
    levels = [np.unique(rounded[first, k]) for k in (0, 1)]
    if len(levels[0]) * len(levels[1]) > 4 * len(first):  # not the rows and columns of a scan
        return first[:: -(-len(first) // most)]
    step = int(np.ceil(np.sqrt(len(first) / most)))
    kept = [np.isin(rounded[first, k], levels[k][::step]) for k in (0, 1)]
    return first[kept[0] & kept[1]]


def pooled(values: np.ndarray, grid: VolumeGrid) -> tuple[np.ndarray, VolumeGrid]:
    """A volume in larger voxels, each as bright as the brightest in it.

    Args:
        values: ``[nz, nx, ny]``, 0 or more.
        grid: where the voxels lie.

    Returns:
        At most ``VOXELS`` of them, and their grid.

    Examples:
        >>> grid = VolumeGrid((0.0, 0.0, 0.5), (1.0, 1.0, 0.01), (256, 1, 1))
        >>> small, where = pooled(np.arange(256.0).reshape(256, 1, 1), grid)
        >>> small[:2, 0, 0].tolist(), where.pitch, round(where.origin[2], 3)
        ([1.0, 3.0], (1.0, 1.0, 0.02), 0.505)
    """
    steps = [-(-n // most) for n, most in zip(values.shape, VOXELS, strict=True)]
    room = [(0, -n % step) for n, step in zip(values.shape, steps, strict=True)]
    padded = np.pad(values, room)
    nz, nx, ny = (n // step for n, step in zip(padded.shape, steps, strict=True))
    small = padded.reshape(nz, steps[0], nx, steps[1], ny, steps[2]).max(axis=(1, 3, 5))
    along = (steps[1], steps[2], steps[0])
    origin = [o + p * (s - 1) / 2 for o, p, s in zip(grid.origin, grid.pitch, along, strict=True)]
    pitch = [p * s for p, s in zip(grid.pitch, along, strict=True)]
    return small, VolumeGrid((origin[0], origin[1], origin[2]), (pitch[0], pitch[1], pitch[2]), (nz, nx, ny))


@torch.no_grad()
def _rendered(expected: Expected, spots: np.ndarray) -> np.ndarray:
    parts = torch.from_numpy(spots).split(BLOCK)
    return np.concatenate([expected(part).double().cpu().numpy() for part in parts])


def _summed(values: np.ndarray, bins: int) -> np.ndarray:
    """Over so many neighbouring bins; a last, incomplete group is left out."""
    whole = values.shape[1] // bins * bins
    return values[:, :whole].reshape(len(values), -1, bins).sum(2)
