"""What a run says about itself: ``summary.json``'s content, package versions, git state, peak memory."""

from __future__ import annotations

import platform
import subprocess
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

import nlos_lit
from nlos_lit.places import ABOVE
from nlos_lit.runtime.memory import peak_bytes

PACKAGES = ("torch", "lightning", "numpy", "open3d", "hydra-core", "omegaconf", "h5py", "scipy", "matplotlib")


def build_summary(
    *,
    scene: str,
    seed: int,
    loss: tuple[float, float],
    nmse: tuple[float, float, float],
    deviance_per_bin: tuple[float, float, float],
    parameters: Mapping[str, tuple[float, str]],
    seconds: tuple[float, float, float],
    geometry: Mapping[str, Any] | None = None,
    **more: Any,
) -> dict[str, Any]:
    """The content of ``summary.json``.

    Args:
        scene: the scene's name.
        seed: the run's seed.
        loss: (initial, final) training loss.
        nmse: (initial, final, noise floor) of held-out spots, Σ(H−H_R)²/ΣH² over gated bins.
        deviance_per_bin: (initial, final, pure Poisson noise) of held-out spots.
        parameters: imaging parameter name → (value, unit).
        seconds: (setup, one iteration, total).
        geometry: errors against truth; null where truth is not known.
        more: further entries, for example the mesh's report.

    Returns:
        What :func:`~nlos_lit.io.files.write_json` writes, with versions, git state and peak memory.
    """
    return {
        "scene": scene,
        "loss": dict(zip(("initial", "final"), loss, strict=True)),
        "heldout": {
            "nmse": dict(zip(("initial", "final", "noise_floor"), nmse, strict=True)),
            "deviance_per_bin": dict(zip(("initial", "final", "noise"), deviance_per_bin, strict=True)),
        },
        "parameters": {name: {"value": value, "unit": unit} for name, (value, unit) in parameters.items()},
        "geometry": None if geometry is None else dict(geometry),
        "seconds": dict(zip(("setup", "per_iteration", "total"), seconds, strict=True)),
        "peak_memory_bytes": peak_bytes(),
        "peak_gpu_memory_bytes": peak_gpu_memory_bytes(),
        "versions": versions(),
        "git": git_state(),
        "seed": seed,
        **more,
    }


def versions() -> dict[str, str | None]:
    """Versions of Python, the project and the packages that results depend on; None: not installed."""
    found: dict[str, str | None] = {"python": platform.python_version(), "nlos_lit": nlos_lit.__version__}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = None
    return found


def git_state(root: Path = ABOVE) -> dict[str, Any] | None:
    """``{"commit", "dirty"}`` of a checkout; dirty: a tracked file differs.

    None where ``root`` is not the top of one.
    """
    top = _git(root, "rev-parse", "--show-toplevel")
    if top is None or Path(top).resolve() != Path(root).resolve():
        return None
    commit, changes = (
        _git(root, "rev-parse", "HEAD"),
        _git(root, "status", "--porcelain", "--untracked-files=no"),
    )
    return None if commit is None or changes is None else {"commit": commit, "dirty": bool(changes)}


def _git(root: Path, *arguments: str) -> str | None:
    """Output of a git command; None where git is not installed or refuses."""
    try:
        done = subprocess.run(
            ["git", "-C", str(root), *arguments], capture_output=True, text=True, check=True, timeout=30
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


def peak_gpu_memory_bytes() -> int | None:
    """Largest memory torch has held on any one GPU; None when none was used."""
    if not (torch.cuda.is_available() and torch.cuda.is_initialized()):
        return None
    return max(torch.cuda.max_memory_allocated(device) for device in range(torch.cuda.device_count()))
