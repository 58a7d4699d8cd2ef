"""The page to explore: all in one file, small, what it holds is what was kept; the command that opens it."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import ROOT
from view_cases import irregular, view

from nlos_lit.capture.errors import UserError
from nlos_lit.commands import view as command
from nlos_lit.io.files import whole_file
from nlos_lit.io.views import FILE, LEVELS, read_view, write_view
from nlos_lit.report.explore import LARGEST, page_html, wall_lattice, write_page


@pytest.fixture(scope="module")
def page() -> str:
    return page_html(view())


def test_a_view_comes_back_as_it_was_kept(tmp_path):
    kept = view()
    write_view(tmp_path, kept)
    back = read_view(tmp_path)
    np.testing.assert_array_equal(back.counts, kept.counts)  # whole numbers, and what was not recorded
    largest = np.nanmax(kept.counts)
    for name, values in kept.models.items():
        error = np.abs(back.models[name] - values) / np.sqrt(values)
        assert error.max() < 1.01 * np.sqrt(largest) / LEVELS  # standard deviations of the counting noise
    np.testing.assert_array_equal(back.spots, kept.spots)
    np.testing.assert_allclose(back.clouds["surfels"].positions, kept.clouds["surfels"].positions, atol=1e-7)
    np.testing.assert_array_equal(back.meshes["mesh"].triangles, [[0, 1, 2]])
    values, grid = back.volume
    assert grid.shape == (8, 4, 6)
    np.testing.assert_allclose(values, kept.volume[0], atol=2.0 / 255 / 2 + 1e-6)
    assert (back.path, back.facts) == (kept.path, kept.facts)


def test_a_damaged_or_missing_view_is_said_in_a_sentence(tmp_path):
    with pytest.raises(UserError, match=r"holds no view\.npz"):
        read_view(tmp_path)
    write_view(tmp_path, view())
    whole = (tmp_path / FILE).read_bytes()
    for part in (whole[: len(whole) // 2], b"no archive", whole[:-40] + b"0" * 40):
        (tmp_path / FILE).write_bytes(part)
        with pytest.raises(UserError, match="is damaged"):
            read_view(tmp_path)


def test_the_page_needs_nothing_but_itself(page):
    own = page[: page.index('<script type="text/plain" id="data">')]
    assert not re.search(r"(?:src|href)=[\"']?(?:https?:|//)", own)
    assert len(page.encode()) < LARGEST
    assert "<main>" in page
    assert 'lang="en"' in page


def test_every_control_has_a_name(page):
    for tag in re.findall(r"<(?:input|select)\b[^>]*>", page):
        place = page.index(tag)
        assert (
            page.rindex("<label>", 0, place) > page.rindex("</label>", 0, place)
            if "</label>" in page[:place]
            else "<label>" in page[:place]
        )
    for plot in re.findall(r'<div class="plot"[^>]*>', page):
        assert "aria-label=" in plot


def test_what_is_said_is_escaped():
    text = page_html(view(name="<b>&", said=["a < b"], origin={"command": "</script><b>"}))
    assert "<title>&lt;b&gt;&amp;" in text
    assert "a &lt; b" in text
    assert "</script><b>" not in text


EVIL = "<!--<script></script><b onload='x'>\" onload=\"x"


def test_nothing_that_a_view_says_becomes_part_of_the_page():
    facts = {
        "name": EVIL,
        "said": [EVIL, EVIL],
        "tone": EVIL,
        "next": {"text": EVIL, "command": EVIL},
        "origin": {"command": EVIL, "capture": {EVIL: EVIL}, "provenance": {EVIL: [EVIL], "a": EVIL}},
        "kept": {EVIL: EVIL},
        "profiles": [{"axis": EVIL}],
    }
    kept = view(**facts)
    kept = dataclasses.replace(kept, models={EVIL: kept.counts}, clouds={EVIL: kept.clouds["surfels"]})
    text = page_html(kept)
    own = text[: text.index('<script type="text/plain" id="data">')]
    assert "<!--" not in own
    assert "<b " not in own
    assert own.count("<script") == own.count("</script>") == 1
    assert not re.search(r"<[^>]*[\"']\s*onload=", own)
    header = json.loads(own[own.index('id="header">') + 12 : own.index("</script>")])
    assert header["facts"]["name"] == EVIL


def test_the_command_opens_no_page_of_a_stranger(tmp_path):
    write_view(tmp_path, view())
    (tmp_path / "explore.html").write_text("<script>stranger</script>")
    assert "stranger" not in command.page_of(tmp_path).read_text(encoding="utf-8")


def test_an_effect_that_came_with_a_folder_is_not_run(tmp_path):
    write_view(tmp_path / "diagnosis", view())
    for name in ("effects/irf_tail.py", "effects/__init__.py", "numpy.py"):
        file = tmp_path / "diagnosis" / name
        file.parent.mkdir(exist_ok=True)
        file.write_text(f"open({str(tmp_path / 'ran')!r}, 'w')")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [sys.executable, str(ROOT / "view.py"), str(tmp_path), "--no-open"],
        cwd=tmp_path / "diagnosis", env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize(
    "facts",
    [{"status": "x"}, {"said": [3]}, {"said": None}, {"profiles": [4]}, {"tone": 3}, {"at": "\ud800"}],
)
def test_the_command_says_in_a_sentence_that_a_view_holds_something_else(tmp_path, facts):
    write_view(tmp_path, view(**facts))
    with pytest.raises(UserError, match=r"view\.npz is damaged"):
        command.page_of(tmp_path)


@pytest.mark.parametrize("status", ["running", "finished"])
def test_a_folder_that_nothing_may_be_written_to_is_shown_from_elsewhere(tmp_path, monkeypatch, status):
    write_view(tmp_path, view(status=status))
    before = sorted(tmp_path.iterdir())

    def refuses(path, *_, **__):
        if Path(path).is_relative_to(tmp_path):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return opened(path, *_, **__)

    opened = os.open
    monkeypatch.setattr(os, "open", refuses)
    monkeypatch.setattr(
        "nlos_lit.report.explore.whole_file",
        lambda file: refuses(file) if tmp_path in file.parents else whole_file(file),
    )
    page = command.page_of(tmp_path)
    assert not page.is_relative_to(tmp_path)
    assert "<main>" in page.read_text(encoding="utf-8")
    assert sorted(tmp_path.iterdir()) == before
    shutil.rmtree(page.parent)


def test_a_page_that_is_too_large_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("nlos_lit.report.explore.LARGEST", 10_000)
    with pytest.raises(ValueError, match="at most 10000"):
        write_page(tmp_path, view())
    assert list(tmp_path.iterdir()) == []


def test_irregular_spots_are_shown_by_the_nearest():
    places = irregular().places
    x, y, nearest = wall_lattice(places)
    assert nearest.shape == (12, 12)
    shown = np.stack(np.meshgrid(x, y), axis=-1)[nearest >= 0]
    distances = np.linalg.norm(shown[:, None] - places, axis=2)
    np.testing.assert_array_equal(distances.argmin(1), nearest[nearest >= 0])


@pytest.mark.parametrize("status", ["running", "finished"])
def test_the_command_makes_a_missing_page_and_tells_of_a_stopped_run(tmp_path, capsys, status):
    write_view(tmp_path, view(status=status))
    assert command.main([str(tmp_path), "--no-open"]) == 0
    assert capsys.readouterr().out.strip() == str(tmp_path / "explore.html")
    text = (tmp_path / "explore.html").read_text(encoding="utf-8")
    assert ("interrupted:" in text) == (status == "running")
    assert read_view(tmp_path).facts["status"] == ("interrupted" if status == "running" else "finished")


def test_the_command_leaves_a_run_alone_that_another_process_works_on(tmp_path):
    write_view(tmp_path, view(status="running"))
    write_page(tmp_path, view(status="running"))
    code = (
        "import sys; from pathlib import Path; from nlos_lit.runtime.claim import claim; "
        "claim(Path(sys.argv[1])); print('held', flush=True); sys.stdin.read()"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    with subprocess.Popen(
        [sys.executable, "-c", code, str(tmp_path)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
    ) as other:
        assert other.stdout.readline() == b"held\n"
        assert command.page_of(tmp_path) == tmp_path / "explore.html"
        assert read_view(tmp_path).facts["status"] == "running"
        other.stdin.close()


def test_the_command_prefers_the_diagnosis_and_says_what_is_no_run(tmp_path, capsys):
    write_view(tmp_path, view())
    write_view(tmp_path / "diagnosis", dataclasses.replace(view(), models={}))
    assert command.page_of(tmp_path) == tmp_path / "diagnosis" / "explore.html"
    with pytest.raises(SystemExit):
        command.main([str(tmp_path / "nowhere"), "--no-open"])
    assert "it is no run's folder" in capsys.readouterr().err


def test_the_door_prints_its_options():
    done = subprocess.run(
        [sys.executable, "view.py", "--help"], cwd=Path(ROOT), capture_output=True, text=True, check=False
    )
    assert done.returncode == 0
    assert "--no-open" in done.stdout
