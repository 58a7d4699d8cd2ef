"""What every test shares: where the real captures lie, and a quiet machine."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"

torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)


def real_file(name: str) -> Path:
    """Path of a real capture or independent render beside the checkout; skips the test where it is absent."""
    path = SHARED / name
    if not path.exists():
        pytest.skip(f"{name} is not beside this checkout (looked in ../shared/data)")
    return path
