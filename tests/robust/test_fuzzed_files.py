"""Damaged files of every format, a short share of what ``make fuzz`` tries, and all that it ever found."""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest
import scipy.io
from conftest import ROOT

sys.path.append(str(ROOT / "tests" / "readers"))

import fuzzed_files as files
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

CORPUS = Path(__file__).parent / "corpus"
FOUND = sorted(CORPUS.glob("*/*"))
SEVERAL = {name: fmt for fmt, (names, _) in files.FORMATS.items() for name in names}
OPENED = settings(max_examples=25, deadline=None, suppress_health_check=list(HealthCheck))
VALUES = st.one_of(
    st.none(),
    st.floats(width=64),
    st.integers(-(2**40), 2**40),
    st.text("ab\x1b°", max_size=5),
    arrays(
        np.float64, st.sampled_from([(1,), (3,), (2, 3), (3, 2, 3), (60, 3, 2)]), elements=st.floats(width=64)
    ),
)


@pytest.mark.parametrize("file", FOUND, ids=lambda file: f"{file.parent.name}-{file.name}")
def test_what_was_found_is_mended(tmp_path, file):
    fmt, name = file.parent.name, file.name.split("-")[0]
    files.beside(fmt, tmp_path)
    assert files.outcome_of_file(fmt, name, file.read_bytes(), tmp_path) in ("read", "refused")


@pytest.mark.parametrize("fmt", files.FORMATS)
def test_each_array_missing_or_of_another_kind(tmp_path, fmt):
    files.beside(fmt, tmp_path)
    came = [files.outcome_of_file(fmt, name, blob, tmp_path) for name, blob in files.seeds(fmt)]
    assert came[0] == "read"
    assert "refused" in came


@pytest.mark.parametrize("fmt", files.FORMATS)
@OPENED
@given(data=st.binary(min_size=6, max_size=60))
def test_any_change_is_read_or_refused(fmt, data):
    with tempfile.TemporaryDirectory() as folder:
        files.beside(fmt, Path(folder))
        assert files.outcome(fmt, data, Path(folder)) in ("read", "refused")


@pytest.mark.parametrize("name", [name for name in SEVERAL if name != "chen"])
@OPENED
@given(data=st.data(), value=VALUES)
def test_any_header_is_read_or_refused(name, data, value):
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        key = data.draw(st.sampled_from(files.arrays_of(name, place)))
        blob = files.replaced(name, key, value, place)
        files.beside(SEVERAL[name], place)
        assert files.outcome_of_file(SEVERAL[name], name, blob, place) in ("read", "refused")


LIMITED = """
import resource, sys
from data_modules.readers import read_capture
from nlos_lit.capture.errors import CaptureError

read_capture(sys.argv[1])
held = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (held + 2**25, held + 2**25))
try:
    read_capture(sys.argv[2])
except CaptureError as error:
    print(error)
"""


@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="reads the size of a process from /proc")
def test_a_packed_file_beyond_the_memory_limit_is_refused(tmp_path):
    """A file of 60 kB that holds 60 MB of zeros, where 32 MB may be taken."""
    assert resource.RLIMIT_AS
    for name, bins in (("small.mat", 40), ("large.mat", 3000)):
        counts = np.zeros((100, 100, bins), np.uint16) if bins > 40 else np.zeros((4, 2, bins), np.uint16)
        counts[1, 1, 30] = 7
        scipy.io.savemat(tmp_path / name, {"rect_data": counts, "width": 0.4}, do_compression=True)
    assert (tmp_path / "large.mat").stat().st_size < 100_000
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(tmp_path / "small.mat"), str(tmp_path / "large.mat")],
        cwd=ROOT, capture_output=True, text=True, timeout=100,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.startswith("large.mat")
