"""What steps return comes back from its file as it was: fits go on to the same digits."""

from __future__ import annotations

import pytest
import torch
from inference_scenes import (
    FORWARD_MODE,
    capture_of,
    drawn,
    effect_of,
    fit_of,
    hide_some,
    raster,
    surfels,
    uneven,
)

from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE
from nlos_lit.effects.smooth import SeveralWidths
from nlos_lit.inference.candidates import Pool, Taken
from nlos_lit.inference.kept import kinds
from nlos_lit.inference.problem import build_problem
from nlos_lit.inference.scenes import begun_with
from nlos_lit.inference.screening import screen
from nlos_lit.runtime.plain_file import read_plain, write_plain
from nlos_lit.surfels.fit import SurfelFit

pytestmark = FORWARD_MODE


def kept(value, scan, tmp_path, **shared):
    write_plain(tmp_path / "x.npz", value, kinds(scan), shared)
    return read_plain(tmp_path / "x.npz", kinds(scan), shared)


@pytest.mark.parametrize("kind", [*EFFECTS, *FREE], ids=lambda kind: kind.name)
def test_effects_come_back(kind, tmp_path):
    scan = Scan.of(capture_of(raster(6)))
    effect = uneven(kind(scan))
    effect.width, effect.share, effect.prior_scale = 0.3, 0.7, 0.25
    if isinstance(effect, SeveralWidths):
        effect.relative.uniform_(0.1, 2.0)
    for trained in (True, False):
        again = kept(effect.requires_grad_(trained), scan, tmp_path)
        assert type(again) is kind
        assert (again.width, again.share, again.prior_scale) == (0.3, 0.7, 0.25)
        assert again.scan is scan
        for (name, old), (other, new) in zip(effect.named_buffers(), again.named_buffers(), strict=True):
            assert name == other
            assert torch.equal(old, new)
        for (name, old), (other, new) in zip(
            effect.named_parameters(), again.named_parameters(), strict=True
        ):
            assert name == other
            assert torch.equal(old, new)
            assert new.requires_grad == trained


def test_values_of_another_effect_are_refused(tmp_path):
    scan = Scan.of(capture_of(raster(6)))
    effect = effect_of("irf_tail", scan)
    effect.name = "power_drift"
    with pytest.raises(UserError, match="damaged"):
        kept(effect, scan, tmp_path)


def same(first: SurfelFit, second: SurfelFit) -> None:
    states = [{**f.model.state_dict(), **f.extension.state_dict()} for f in (first, second)]
    assert states[0].keys() == states[1].keys()
    for name, value in states[0].items():
        assert torch.equal(value, states[1][name]) if torch.is_tensor(value) else value == states[1][name]
    assert torch.equal(first.order, second.order)
    assert torch.equal(first.tested, second.tested)
    assert torch.equal(first.model.pairs[0], second.model.pairs[0])
    assert torch.equal(first.generator.get_state(), second.generator.get_state())
    assert (first.place, first.done) == (second.place, second.done)


def test_a_fit_goes_on_to_the_same_digits(tmp_path):
    """In the middle of an epoch, with hidden surfels, one effect held, one free, and a free term."""
    scene = capture_of(raster(10))
    scan, model = Scan.of(scene), surfels(scene)
    hide_some(model)
    extension = Extension(
        [
            effect_of("irf_tail", scan, fraction=0.2, decay=0.1),
            effect_of("hot_spots", scan),
            uneven(effect_of("free_wall", scan)),
        ]
    )
    extension.effects[1].requires_grad_(False)
    fit = fit_of(model, drawn(model, extension, scene), extension)
    shared = {"capture": fit.capture, "counts": fit.counts, "settings": fit.settings}
    same(fit, kept(fit, scan, tmp_path, **shared))  # before anything is done
    fit.go_on(4)
    again = kept(fit, scan, tmp_path, **shared)
    same(fit, again)
    assert again.capture is fit.capture
    assert again.counts is fit.counts
    assert again.settings is fit.settings
    for each in (fit, again):
        each.go_on(6)
        each.copy(Extension([]), 1).go_on(4)
    same(fit, again)


def test_a_pool_comes_back(tmp_path):
    """And fits that begin with what is in it go on to the same digits."""
    scene = capture_of(raster(8))
    scan, model = Scan.of(scene), surfels(scene)
    scene = drawn(model, Extension([effect_of("irf_tail", scan, fraction=0.4, decay=0.1)]), scene)
    fit, spots = fit_of(model, scene), torch.arange(64)
    problem = build_problem(model, fit.extension, spots, fit.counts)
    names = ("irf_tail", "hot_spots", "power_drift", "free_time", "free_wall_delay", "free_spot_gain")
    found = screen(problem, [effect_of(name, scan) for name in names], spots % 6)
    pool = kept(Pool(found, [Taken(found[1], found[2:4])]), scan, tmp_path)
    again, (taken,) = pool.candidates, pool.together
    assert [taken.candidate.name, *(c.name for c in taken.rivals)] == [c.name for c in found[1:4]]
    assert [type(c) for c in again] == [type(c) for c in found]
    for old, new in zip(found, again, strict=True):
        numbers = ("name", "evidence", "retained", "scatter", "shape", "loud", "lit", "scale")
        assert [getattr(new, n) for n in numbers] == [getattr(old, n) for n in numbers]
        assert (new.effect.prior_scale, new.effect.width) == (old.effect.prior_scale, old.effect.width)
        for name in ("step", "error"):
            assert torch.allclose(getattr(new, name), getattr(old, name), rtol=0, atol=0, equal_nan=True)
        fits = [fit.copy(begun_with(fit, [c]), 0) for c in (old, new)]
        for one in fits:
            one.go_on(4)
        same(*fits)


def test_a_rebuild_that_left_nothing_comes_back(tmp_path):
    assert kept(None, Scan.of(capture_of(raster(6))), tmp_path) is None


@pytest.mark.parametrize("where", ["name", "stored"])
def test_a_damaged_pool_is_refused(tmp_path, where):
    """A term that no registry has, and coefficients of another number."""
    scan = Scan.of(capture_of(raster(6)))
    wide = effect_of("free_rate", scan)
    if where == "name":
        wide.name = "free_will"
    else:
        wide.raw_field = torch.nn.Parameter(torch.zeros(3))
    with pytest.raises(UserError, match="damaged"):
        kept(wide, scan, tmp_path)
