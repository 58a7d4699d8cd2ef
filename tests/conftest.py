"""What every test shares: where the real captures lie, a quiet machine, a browser."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
WITHOUT_GPU = (
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--disable-gpu-sandbox",
)

# Files that take longer than a quarter of a minute, the longest first.
LONGEST = (
    "paper/test_results.py",
    "training/test_train.py",
    "inference/test_diagnose.py",
    "training/test_surface_fitting.py",
    "blind/test_blind_screening.py",
    "runtime/test_memory.py",
    "surfels/test_surface.py",
    "blind/test_blind_diagnosis.py",
    "training/test_sharded.py",
    "inference/test_free_terms.py",
    "blind/test_blind_further.py",
    "test_benchmarks.py",
    "training/test_configs.py",
    "baselines/test_reconstruct.py",
    "runtime/test_steps.py",
)

torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the files that take longest, so that at the end no process waits long for another."""
    place = {ROOT / "tests" / name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path, len(place)))


def real_file(name: str) -> Path:
    """Path of a real capture or independent render beside the checkout; skips the test where it is absent."""
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{name} is not beside this checkout (looked in ../shared/data)")
    return path


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """An installed Chromium or Chrome, driven by playwright; skips the test where one of them is missing."""
    play = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")
    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        pytest.skip("no Chromium or Chrome is installed")
    with play.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=program, args=[*WITHOUT_GPU])
        yield opened
        opened.close()
