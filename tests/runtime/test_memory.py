"""Sizes are read as people write them, and what the machine cannot hold is refused."""

from __future__ import annotations

import json
import subprocess
import sys

import psutil
import pytest
from conftest import ROOT

from nlos_lit.capture.errors import MemoryBudgetError, UserError
from nlos_lit.runtime.memory import check_machine, parse_bytes


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("8GiB", 8 << 30),
        ("500 MB", 500_000_000),
        ("1.5KiB", 1536),
        (1024, 1024),
        ("2e9", 2_000_000_000),
        ("7B", 7),
    ],
)
def test_sizes(text, size):
    assert parse_bytes(text) == size


@pytest.mark.parametrize("text", ["lots", "8 gigs", "-1GiB", "", "GiB"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(UserError, match="must be a size such as 8GiB"):
        parse_bytes(text)


def test_more_than_the_machine_has_is_refused():
    free = psutil.virtual_memory().available
    check_machine(free // 2, "half")
    with pytest.raises(
        MemoryBudgetError, match=r"twice needs about .* GiB, this machine has .* GiB free; sum spots"
    ):
        check_machine(2 * free, "twice")


MEASURE = """
import json, sys
sys.path.insert(0, "benchmarks")
import torch
torch.set_num_threads(1)
from table2 import measure
from workload import Workload
row = measure(Workload({sizes}, iterations=2), 1e9)
print(json.dumps(dict(estimate=row["estimate_bytes"], peak=row["peak_bytes"])))
"""
SIZES = {
    "many frequencies": '"a", (80, 80), 512, 1 / 64, 0.01, 0.5, 60, 0.01, rays=64',
    "many voxels": '"b", (48, 48), 256, 1 / 48, 0.01, 0.4, 700, 0.001, rays=64',
    "many rays": '"c", (32, 32), 256, 1 / 32, 0.01, 0.4, 60, 0.01, rays=200',
    "one sensor": '"d", (40, 60), 512, 0.02, 0.008, 0.5, 150, 0.008, confocal=False, rays=100',
}


@pytest.mark.parametrize("name", SIZES)
def test_estimate_lies_within_a_fifth_of_the_measured_peak(name):
    script = MEASURE.format(sizes=SIZES[name])
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, timeout=300
    )
    assert done.returncode == 0, done.stderr[-2000:]
    row = json.loads(done.stdout.splitlines()[-1])
    assert 0.8 * row["peak"] < row["estimate"] < 1.25 * row["peak"]
