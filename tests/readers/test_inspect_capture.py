"""The command that shows a capture before a long run."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import reader_files as files
import scipy.io

from data_modules.examine import describe, examine
from data_modules.readers import READERS, read_capture
from nlos_lit.commands.inspect_capture import main as inspect_capture
from nlos_lit.commands.simulate import simulate

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("name", [name for name in files.WRITERS if name not in ("tsai", "cube")])
def test_every_format_is_told_and_drawn(tmp_path, capsys, name):
    path = files.WRITERS[name](tmp_path)
    assert inspect_capture([str(path), "--out", str(tmp_path / "out")]) == 0
    told = capsys.readouterr().out
    fmt = read_capture(path).provenance["format"]
    assert told.startswith(f"format       {fmt} (")
    for word in (
        "kind",
        "spots",
        "wall",
        "bins",
        "time",
        "gate",
        "counts",
        "recorded",
        "direct pulse",
        "first return",
        "done",
    ):
        assert f"\n{word}" in told
    picture = tmp_path / "out" / f"{path.stem}_capture.png"
    assert picture.read_bytes()[:4] == b"\x89PNG"


def _lct(folder: Path, scene_bin: int = 1200) -> Path:
    bins = np.arange(2048)
    mean = 3000 * np.exp(-bins / 40.0) + 60 * np.exp(-((bins - scene_bin) ** 2) / 200.0) + 0.2
    rng = np.random.default_rng(1)
    path = folder / "capture.mat"
    scipy.io.savemat(
        path, {"rect_data": rng.poisson(np.broadcast_to(mean, (6, 6, 2048))).astype(np.uint16), "width": 0.35}
    )
    return path


def test_depth_of_the_first_return_and_the_direct_pulse(tmp_path):
    capture = read_capture(_lct(tmp_path))
    findings = examine(capture)
    # the scene's pulse rises past a fifth of its peak 18 bins before bin 1200: half of 1182 · 1.199 mm
    assert np.median(findings.first_returns) == pytest.approx(0.709, abs=0.012)
    assert findings.pulse == 0
    assert findings.pulse_share == pytest.approx(1 - 60 * 25.07 / (3000 * 40.5 + 60 * 25.07), abs=0.01)
    assert findings.warnings == ()


def test_depths_that_are_all_but_equal_are_told(tmp_path):
    """Between neighbouring numbers there is no room for eight rows of a histogram; in eight bins there is."""
    capture = read_capture(_lct(tmp_path))
    close = np.array([1e5, np.nextafter(1e5, 2e5)])
    told = describe(capture, "lct", replace(examine(capture), first_returns=close))
    assert told.count("#" * 40) == 1


@pytest.mark.parametrize(
    ("arguments", "warning"),
    [
        (["--gate", "0", "2048"], "direct pulse"),
        (["--gate", "60", "2048"], "before the direct pulse has decayed"),
        (["--bin-width-ps", "100"], "scene 1[78] m away"),
        (["--wall-size", "30"], "42.*across|3[0-9].*across"),
    ],
)
def test_what_looks_wrong_is_said(tmp_path, capsys, arguments, warning):
    assert inspect_capture([str(_lct(tmp_path)), "--out", str(tmp_path), *arguments]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("LOOK AT")]
    assert any(__import__("re").search(warning, line) for line in lines), lines


def test_what_was_not_recorded_is_told_and_is_no_first_return(tmp_path, capsys):
    path = _lct(tmp_path)
    data = scipy.io.loadmat(path)["rect_data"]
    data[2, 3, 700:1201] = 0  # up to the scene's peak
    data[4, 1] = 0
    scipy.io.savemat(path, {"rect_data": data, "width": 0.35})
    assert inspect_capture([str(path), "--gate", "650", "2048", "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    share = (36 * 1398 - 1398 - 501) / (36 * 1398)
    assert (
        f"recorded     {share:.1%} of the gate's bins; 1 of 36 spots have none of them, 1 only some" in told
    )
    assert [line for line in told.splitlines() if line.startswith("LOOK AT")] == [
        "LOOK AT      1 of 36 spots are dead; left out",
        "LOOK AT      1 of 36 spots are cropped inside the gate; bins 1201 to 2047 are whole; the bins that "
        "were not recorded are left out",
    ]
    findings = examine(read_capture(path))
    assert len(findings.first_returns) == 34
    assert np.ptp(findings.first_returns) < 0.02
    assert np.isnan(findings.totals).sum() == 1
    assert inspect_capture([str(path), "--observed", "all", "--no-counts", "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    assert "recorded     every bin of the gate" in told
    assert "expected values, not counts" in told


def test_an_error_is_one_sentence_and_status_2(tmp_path):
    run = subprocess.run(
        [sys.executable, "inspect_capture.py", str(tmp_path / "nothing.mat")],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert run.returncode == 2
    assert run.stdout == ""
    assert run.stderr == f"error: {tmp_path / 'nothing.mat'} does not exist; give a capture file\n"


@pytest.mark.parametrize("name", ["é" * 124, "a\x1b[2Jb", "日本 'x\" $(b);<b>"])
def test_any_name_that_a_file_can_have_is_taken(name, tmp_path, capsys):
    capture = tmp_path / f"{name}.hdf5"
    simulate([f"out={tmp_path}/a.hdf5", "nx=4", "ny=4", "n_bins=256", "bin_length=0.01"])
    (tmp_path / "a.hdf5").rename(capture)
    capsys.readouterr()
    assert inspect_capture([str(capture), "--out", str(tmp_path)]) == 0
    said = capsys.readouterr()
    assert "\x1b" not in said.out + said.err
    assert [p.name for p in tmp_path.glob("*.png")] == [f"{name[:60]}_capture.png"]


def test_the_help_names_every_format(capsys):
    with pytest.raises(SystemExit):
        inspect_capture(["--help"])
    told = capsys.readouterr().out
    assert all(reader.NAME in told for reader in READERS)
