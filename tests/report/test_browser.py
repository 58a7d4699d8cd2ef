"""The page to explore in a real browser: it turns, slides and tells the numbers that were kept.

Needs the package playwright and an installed Chromium or Chrome; skipped where one is missing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from report_cases import profiles
from view_cases import EXTENDED, RENDERED, irregular, view

from nlos_lit.io.files import plain
from nlos_lit.io.views import read_view, write_view
from nlos_lit.report.explore import write_page
from nlos_lit.report.page import report_html

DESKTOP, PHONE = {"width": 1366, "height": 900}, {"width": 390, "height": 844}
READY = "body[data-ready]"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("explore")
    write_view(folder, view(profiles=plain(profiles(9.0)), next={"text": "Count longer.", "command": "x"}))
    write_page(folder, read_view(folder))
    write_page(folder / "begun", irregular())
    return folder


@pytest.fixture(scope="module")
def page(browser, folder) -> Iterator[Any]:
    """Opened from the disk, without a network; what goes wrong in it fails the test."""
    opened, wrong = shown(browser, folder / "explore.html", DESKTOP)
    yield opened
    assert wrong == []
    opened.close()


def shown(browser, file: Path, size: dict) -> tuple[Any, list[str]]:
    opened = browser.new_context(viewport=size, offline=True).new_page()
    wrong: list[str] = []
    opened.on("pageerror", lambda error: wrong.append(str(error)))
    opened.on("console", lambda told: wrong.append(told.text) if told.type == "error" else None)
    opened.goto(file.as_uri())
    opened.wait_for_selector(READY, timeout=60_000)
    return opened, wrong


def numbers(page) -> dict[str, tuple[float, float]]:
    rows = page.eval_on_selector_all(
        "#numbers tr", "rows => rows.map(r => [r.dataset.row, r.dataset.value, r.dataset.residual])"
    )
    return {name: (float(value), float(left) if left else math.nan) for name, value, left in rows}


def expected(kept, spot: int, bins: slice) -> dict[str, tuple[float, float]]:
    """What the table must say, from ``view.npz``."""
    seen = np.isfinite(kept.counts[spot, bins])
    counted = kept.counts[spot, bins][seen].sum()
    said = {"measured": (counted, math.nan)}
    for name, values in kept.models.items():
        meant = values[spot, bins][seen].sum()
        said[name] = (meant, (counted - meant) / math.sqrt(meant))
    return said


def agree(page, kept, spot: int, bins: slice) -> None:
    found, right = numbers(page), expected(kept, spot, bins)
    assert list(found) == ["measured", RENDERED, EXTENDED]
    for name, pair in right.items():
        assert found[name] == pytest.approx(pair, rel=1e-6, abs=1e-9, nan_ok=True), name


def set_range(page, selector: str, value: int) -> None:
    page.eval_on_selector(
        selector, "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", str(value)
    )


def click_spot(page, spot: int, kept) -> None:
    """With the mouse, where the map shows the spot."""
    x, y = kept.places[spot]
    place = page.evaluate(
        """([x, y]) => { const l = document.getElementById("wall")._fullLayout,
            box = document.querySelector("#wall .nsewdrag").getBoundingClientRect();
            return [box.left + l.xaxis.d2p(x), box.top + l.yaxis.d2p(y)]; }""",
        [float(x), float(y)],
    )
    page.mouse.move(*place)
    page.wait_for_timeout(100)
    page.mouse.click(*place)


def test_a_click_on_a_spot_tells_its_numbers(page, folder):
    kept = read_view(folder)
    page.locator("#wall").scroll_into_view_if_needed()
    for spot in (8, 3):  # of the third a bin was not recorded
        click_spot(page, spot, kept)
        page.wait_for_function(f"document.getElementById('spot').value === '{spot}'")
        assert f"spot {kept.spots[spot]} of the capture" in page.inner_text("#where")
        agree(page, kept, spot, slice(None))


def test_the_time_slider_shows_one_bin(page, folder):
    kept = read_view(folder)
    page.uncheck("#all")
    page.fill("#spot", "12")
    page.press("#spot", "Enter")
    set_range(page, "#time", 20)
    agree(page, kept, 12, slice(20, 21))
    assert "path 1.615 m" in page.inner_text("#time-value")  # 1 + 20.5 · 0.03
    drawn = np.array(page.evaluate("document.getElementById('wall').data[0].z"), dtype=float)
    np.testing.assert_allclose(drawn, kept.counts[:, 20].reshape(6, 5).T)
    page.select_option("#what", label=f"residual, {RENDERED}")
    left = np.array(page.evaluate("document.getElementById('wall').data[0].z"), dtype=float)
    meant = kept.models[RENDERED][:, 20]
    np.testing.assert_allclose(left, ((kept.counts[:, 20] - meant) / np.sqrt(meant)).reshape(6, 5).T)
    page.check("#all")


def test_keys_move_the_spot_as_the_eye_expects(page):
    page.fill("#spot", "12")
    page.press("#spot", "Enter")
    page.focus("#wall")
    page.keyboard.press("ArrowRight")  # +x is to the left, seen from the wall
    assert page.input_value("#spot") == "7"
    page.keyboard.press("ArrowUp")
    assert page.input_value("#spot") == "8"


def eye(page) -> np.ndarray:
    camera = page.evaluate("document.getElementById('hidden')._fullLayout.scene._scene.getCamera().eye")
    return np.array([camera[axis] for axis in "xyz"])


def test_the_scene_turns_by_button_and_by_hand(page):
    assert page.evaluate("document.getElementById('hidden')._fullLayout.scene._scene !== undefined")
    page.get_by_role("button", name="From the wall").click()
    np.testing.assert_allclose(eye(page), [0, 0, -2], atol=1e-9)
    page.get_by_role("button", name="Turn to the right").click()
    turned = eye(page)
    np.testing.assert_allclose(np.hypot(turned[0], turned[2]), 2)
    assert abs(turned[0]) == pytest.approx(2 * math.sin(math.pi / 12))
    page.locator("#hidden").scroll_into_view_if_needed()
    box = page.locator("#hidden").bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x, y)
    page.mouse.down()
    for step in range(8):  # a hand is slower than a frame
        page.mouse.move(x + 10 * step, y + 3 * step)
        page.wait_for_timeout(60)
    page.mouse.up()
    assert np.abs(eye(page) - turned).max() > 0.1


def test_layers_slices_and_before_and_after(page, folder):
    kept = read_view(folder)
    page.get_by_label("mesh", exact=True).check()
    names = page.evaluate("document.getElementById('hidden').data.map(t => [t.name, t.visible])")
    assert dict(names)["mesh"] is True
    assert dict(names)["volume"] is False
    page.select_option("#axis", "x")
    assert page.input_value("#slice") == "1"  # begins at the brightest voxel
    drawn = np.array(page.evaluate("document.getElementById('slices').data[0].z"), dtype=float)
    np.testing.assert_allclose(drawn, kept.volume[0][:, 1, :].T, rtol=1e-5)
    page.select_option("#profile", "time")
    lines = page.evaluate("document.getElementById('change').data.map(t => t.y)")
    time = next(p for p in kept.facts["profiles"] if p["axis"] == "time")
    assert lines == [time["before"], time["after"]]


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_names_of_curves_stand_above_them(browser, folder, size):
    opened, _ = shown(browser, folder / "explore.html", size)
    low, high = opened.evaluate(
        """() => [document.querySelector("#transient .legend").getBoundingClientRect().bottom,
            document.querySelector("#transient .nsewdrag").getBoundingClientRect().top]"""
    )
    assert low <= high + 1
    opened.close()


@pytest.mark.parametrize("size", [DESKTOP, PHONE], ids=["desktop", "phone"])
def test_a_run_that_has_only_begun_opens(browser, folder, size):
    opened, wrong = shown(browser, folder / "begun" / "explore.html", size)
    assert wrong == []
    assert "running" in opened.inner_text(".status")
    assert list(numbers(opened)) == ["measured"]
    assert opened.evaluate("document.documentElement.scrollWidth") <= size["width"]
    opened.close()


def test_reading_aids(browser, page, folder, tmp_path):
    """Contrast, names, keyboard reach: axe-core's rules where its package is there."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-core is not installed")
    from report_cases import CASES

    (tmp_path / "report.html").write_text(report_html(CASES["both"], {}), encoding="utf-8")
    opened = browser.new_page(viewport=PHONE)
    opened.goto((tmp_path / "report.html").as_uri())
    phone, _ = shown(browser, folder / "explore.html", PHONE)
    for one in (page, phone, opened):
        broken = axe.Axe().run(one).response["violations"]
        assert [(rule["id"], rule["nodes"][0]["html"][:100]) for rule in broken] == []
        assert one.evaluate("document.documentElement.scrollWidth <= innerWidth")
    phone.close()
    opened.close()


def test_a_reload_keeps_what_the_reader_looks_at(browser, tmp_path):
    """As the page does by itself every ten seconds while a run goes on."""
    write_page(tmp_path, view(status="running", profiles=plain(profiles(9.0))))
    opened, wrong = shown(browser, tmp_path / "explore.html", PHONE)
    opened.get_by_role("button", name="From the side").click()
    opened.get_by_role("button", name="Turn to the right").click()
    opened.get_by_label("mesh", exact=True).check()
    opened.select_option("#what", label=f"residual, {RENDERED}")
    opened.select_option("#profile", "time")
    opened.uncheck("#all")
    set_range(opened, "#time", 20)
    opened.fill("#spot", "8")
    opened.press("#spot", "Enter")
    opened.evaluate("window.scrollTo(0, 900)")
    turned = eye(opened)
    opened.reload()
    opened.wait_for_selector(READY, timeout=60_000)
    np.testing.assert_allclose(eye(opened), turned, atol=1e-6)
    assert opened.get_by_label("mesh", exact=True).is_checked()
    assert [opened.input_value(f"#{name}") for name in ("what", "profile", "time", "spot")] == [
        "residual:0", "time", "20", "8",
    ]  # fmt: skip
    assert not opened.is_checked("#all")
    assert opened.evaluate("scrollY") == 900
    assert opened.evaluate("document.activeElement.id") == "spot"
    assert wrong == []
    opened.close()
