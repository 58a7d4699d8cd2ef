"""Effects on response, spots and counts, grids and bases, against numbers worked out by hand."""

from __future__ import annotations

import copy
import dataclasses
import math

import numpy as np
import pytest
import torch
from effect_contract import BIN, GATE, SPOTS, away, capture, registered, scene
from effect_hand import SPOT, effect, hand_scan

from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.ghost_pulse import repeats_after
from nlos_lit.effects.hot_spots import HOT
from nlos_lit.effects.scan_pieces import lines
from nlos_lit.effects.strengths import bound_notes
from nlos_lit.effects.tcspc_nonlinearity import waves_at
from nlos_lit.functional.smooth_basis import smooth_basis, smooth_map_basis, spline_basis

FIRST, LAST = GATE


def test_irf_tail_keeps_the_energy_and_delays_it():
    scan = dataclasses.replace(scene("confocal")[1], n_bins=4000)
    tail = effect("irf_tail", scan=scan, fraction=0.3, decay=10 * BIN)
    kernel = torch.zeros(30)
    kernel[5] = 1.0
    late = tail.response(kernel, 5).detach()
    assert late.sum().item() == pytest.approx(1, abs=1e-5)
    # Bin k behind the peak holds e^{-k/10} - e^{-(k+1)/10} of the tail.
    assert late[5].item() == pytest.approx(0.7 + 0.3 * (1 - math.exp(-0.1)), abs=1e-6)
    assert late[25].item() == pytest.approx(0.3 * (math.exp(-2) - math.exp(-2.1)), abs=1e-6)
    assert late[:5].abs().max().item() < 1e-6


def test_late_photons_decay_in_two_parts():
    """Of 0.3 a quarter decays over 4 bins; afterpulses of two kinds of traps alike, but a bin later."""
    scan = dataclasses.replace(scene("confocal")[1], n_bins=4000)
    values = {"decay": 10 * BIN, "quick": 0.25, "quick_decay": 4 * BIN}
    tail = effect("irf_tail", scan=scan, fraction=0.3, **values)
    kernel = torch.zeros(30)
    kernel[5] = 1.0
    late = tail.response(kernel, 5).detach()
    parts = 0.75 * (math.exp(-2) - math.exp(-2.1)), 0.25 * (math.exp(-5) - math.exp(-5.25))
    assert late[25].item() == pytest.approx(0.3 * sum(parts), abs=1e-6)
    assert late.sum().item() == pytest.approx(1, abs=1e-5)
    assert tail.quantities()["slow"].value.item() == pytest.approx(0.225)
    after = effect("afterpulsing", scan=scan, probability=0.3, **values)
    counts = torch.zeros(1, 4000)
    counts[0, 5] = 1.0
    seen = after.counting(counts, SPOT)[0].detach()
    assert seen[26].item() == pytest.approx(0.3 * sum(parts), abs=1e-6)
    assert seen.sum().item() == pytest.approx(1.3, abs=1e-5)
    assert after.quantities()["slow"].value.item() == pytest.approx(0.225)


def test_echoes_stand_at_their_delays():
    """Each at a multiple of the delay, and less by the same share; what comes after the record is cut."""
    kernel = torch.zeros(6)
    kernel[2] = 1.0
    for again in (0.0, 0.5):
        ghost = effect("ghost_pulse", fraction=0.2, delay=7.25 * BIN, again=again)
        found = ghost.response(kernel, 2).detach()
        expected = torch.zeros(2 + LAST)
        expected[2] = 1.0
        for k in range(1, LAST // 7 + 1):
            whole = int(7.25 * k)
            for late, share in ((whole, whole + 1 - 7.25 * k), (whole + 1, 7.25 * k - whole)):
                if late < LAST:
                    expected[2 + late] += 0.2 * again ** (k - 1) * share
        assert found == pytest.approx(expected, abs=1e-5)
    assert expected[16:18] == pytest.approx([0.2 * 0.5 * 0.5, 0.2 * 0.5 * 0.5]), "the second, 14.5 bins late"


def test_echoes_may_be_every_second_one_of_others():
    """What lies between them is what the scene may have taken up."""
    kernel = torch.zeros(6)
    kernel[2] = 1.0
    ghost = effect("ghost_pulse", fraction=0.03, delay=12 * BIN, again=0.25)
    seen = ghost.response(kernel, 2).detach()
    ghost.set_all(ghost.part_of())
    whole = ghost.response(kernel, 2).detach()
    between = whole - seen
    assert between[8 : 2 + LAST : 12] == pytest.approx(
        0.06 * 0.25 ** torch.arange(len(between[8::12])), abs=1e-8
    )
    between[8 : 2 + LAST : 12] = 0
    assert between.abs().max().item() < 1e-7
    assert ghost.part_of() == {}, "the next would come three bins late"
    for name in ("fraction", "again"):
        assert (
            effect("ghost_pulse", **{"fraction": 0.1, "delay": 8 * BIN, "again": 0.2, name: 0}).part_of()
            == {}
        )


class Response(torch.nn.Module):
    """What an effect makes of a response."""

    def __init__(self, changing: Effect) -> None:
        super().__init__()
        self.effect = changing

    def forward(self, kernel: torch.Tensor) -> torch.Tensor:
        return self.effect.response(kernel, 2)


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
@pytest.mark.parametrize("name", [e.name for e in EFFECTS if "response" in e(scene("confocal")[1]).hooks])
def test_responses_are_derived_in_single_precision(name):
    """As the pool derives them: whole numbers times a dual number would be one of double precision."""
    kernel, changing = torch.rand(6), Response(away(effect(name)))
    for p in changing.effect.declared.values():
        raw = getattr(changing.effect, f"raw_{p.name}").detach()

        def response(v: torch.Tensor, name: str = f"raw_{p.name}") -> torch.Tensor:
            return torch.func.functional_call(changing, {f"effect.{name}": v}, (kernel,))

        found = torch.func.jvp(response, (raw,), (torch.ones_like(raw),))
        assert [x.dtype for x in found] == [torch.float32] * 2


def test_gains_of_spots():
    signal, spots = torch.full((2, LAST), 3.0), torch.tensor([4, 1])
    scan = scene("confocal")[1]
    place = scan.places[0]
    aside = scan.half * torch.tensor([0.5, -0.25])
    at = dict(zip("xy", (scan.centre + aside).tolist(), strict=True))
    for where, axis in (({}, [0.0, 0.0]), (at, [0.5, -0.25])):
        vignetting = effect("vignetting", strength=0.3, **where).gain(signal, spots).detach()
        angle = torch.atan(((place[spots] - torch.tensor(axis)) ** 2).sum(1).sqrt() * 0.15**0.5)
        assert vignetting[:, 7] == pytest.approx(3 * torch.cos(angle) ** 4, rel=1e-5)
    drift = effect("power_drift")
    values = torch.zeros(drift.declared["drift"].size)
    values[:5] = torch.tensor([0.1, -0.2, 0.0, 0.3, 0.05])
    drift.set("drift", values)
    assert drift.gain(signal, spots)[:, 3].detach() == pytest.approx(
        3 * torch.exp(drift.field()[spots]).detach(), rel=1e-5
    )
    assert drift.field().mean().item() == pytest.approx(0, abs=1e-6)
    assert drift.quantities()["rms"].value.item() == pytest.approx(
        math.sqrt(0.01 + 0.04 + 0.09 + 0.0025), abs=1e-4
    )


def grid_scan(n: int) -> Scan:
    line = torch.linspace(-1, 1, n)
    places = torch.cartesian_prod(line, line)
    return dataclasses.replace(scene("confocal")[1], places=(places,), rank=torch.linspace(-1, 1, n * n))


@pytest.mark.parametrize(("name", "pieces"), [("wall_reflectance", 12), ("ambient_map", 5)])
def test_maps_hold_every_smooth_function_of_the_wall_but_the_constant(name, pieces):
    built = effect(name, scan=grid_scan(24))
    assert built.functions.shape == (576, pieces**2 - 1)
    x, y = built.scan.places[0].T
    smooth = x + 0.5 * y**2 - 0.7 * x * y**3
    smooth = smooth - smooth.mean()
    fitted = built.functions @ (built.functions.T @ smooth) / 576
    assert fitted == pytest.approx(smooth, abs=1e-4)
    built.set(built.coefficients, 0.1)
    # Orthonormal: rms 0.1 · √(number of functions).
    assert built.quantities()["rms"].value.item() == pytest.approx(0.1 * math.sqrt(pieces**2 - 1), rel=1e-3)


def test_a_map_of_the_wall_follows_a_scratch():
    """A line 0.1 in [-1, 1] wide (standard deviation), some two spots; a tenth of its variance is left."""
    wall = effect("wall_reflectance", scan=grid_scan(24))
    x, y = wall.scan.places[0].T
    for angle in (0.0, 0.6):
        line = torch.exp(-0.5 * ((math.cos(angle) * x + math.sin(angle) * y - 0.2) / 0.1) ** 2)
        line = line - line.mean()
        left = line - wall.functions @ torch.linalg.lstsq(wall.functions, line[:, None]).solution[:, 0]
        assert left.square().mean() < 0.1 * line.square().mean()


def test_drawn_fields_are_smooth():
    """The eight smoothest of 143 functions hold most of a map that is drawn; its size is the one given."""
    wall = effect("wall_reflectance", scan=grid_scan(24))
    wall.draw({"rms": 0.2}, np.random.default_rng(0))
    drawn = wall.value("gain_map").detach().square()
    assert drawn[:8].sum() > 0.8 * drawn.sum()
    assert wall.quantities()["rms"].value.item() == pytest.approx(0.2, rel=1e-3)


def test_ambient_drift_is_a_step_of_the_background_along_the_scan():
    """A lamp that is on for the second half of the scan: e^{±0.2} of the mean level, whatever the wall."""
    scan = grid_scan(16)  # 256 spots in 21 stretches
    drift = effect("ambient_drift", scan=scan)
    stretch = torch.arange(256) * 21 // 256
    drift.set("level", torch.where(torch.arange(21) < 10, -0.2, 0.2))
    background = drift.background(torch.full((5,), 3.0), torch.arange(256)).detach()
    level = torch.where(stretch < 10, -0.2, 0.2)
    assert background == pytest.approx(3 * torch.exp(level - level.mean())[:, None].expand(-1, 5), rel=1e-5)
    assert drift.quantities()["peak_to_peak"].value.item() == pytest.approx(0.4, abs=1e-5)
    assert effect("ambient_drift", scan=grid_scan(48)).functions.shape == (2304, 128)


def test_lines_of_a_scan_end_at_flybacks_and_turns():
    forth = torch.arange(16).reshape(4, 4)
    back = forth.clone()
    back[1::2] = back[1::2].flip(1)
    for order, number, place in [
        (forth, forth // 4, (forth % 4) / 1.5 - 1),
        (forth.T, forth.T // 4, (forth.T % 4) / 1.5 - 1),
        (back, forth // 4, (back % 4) / 1.5 - 1),
    ]:
        scan = dataclasses.replace(grid_scan(4), rank=order.flatten() / 7.5 - 1)
        found, within = lines(scan)
        assert found.tolist() == number.flatten().tolist()
        assert within == pytest.approx(place.flatten(), abs=1e-6)


def test_a_scan_without_lines_is_cut_into_stretches():
    scattered = torch.rand(100, 2, generator=torch.Generator().manual_seed(3))
    number, place = lines(
        dataclasses.replace(grid_scan(10), places=(scattered,), rank=torch.linspace(-1, 1, 100))
    )
    assert number.tolist() == [k // 10 for k in range(100)]
    assert place[:10] == pytest.approx(torch.linspace(-1, 1, 10))


def test_line_delay_shifts_whole_lines_and_drifts_within_them():
    delay = effect("line_delay", scan=grid_scan(4))
    values = torch.zeros(8)
    values[1], values[4 + 2] = 0.03, 0.015  # line 1 late, line 2 early at first and late at last
    delay.set("delay", values)
    shift = torch.zeros(4, 4)
    shift[1] = 0.03
    shift[2] = 0.015 * torch.linspace(-1, 1, 4)
    shift = (shift - shift.mean()).flatten()
    length = torch.full((16, 2, 1), 1.5)
    late = delay.time(length, None, torch.arange(16)).detach()
    assert late[:, 0, 0] - 1.5 == pytest.approx(shift, abs=1e-6)
    assert delay.quantities()["peak_to_peak"].value.item() == pytest.approx(0.045, abs=1e-6)


def test_reflectance_is_one_map_of_both_wall_points():
    """A spot with laser at a, sensor at b has the gain of that with laser at b, sensor at a: f(a) + f(b)."""
    generator = torch.Generator().manual_seed(0)
    a, b = torch.rand(2, 40, 2, generator=generator) * 2 - 1
    points = [torch.cat([p / 2, torch.zeros(40, 1)], 1) for p in (a, b)]
    scan = hand_scan(torch.cat(points).tolist(), torch.cat(points[::-1]).tolist())
    wall = effect("wall_reflectance", scan=scan)
    wall.set("gain_map", torch.linspace(-0.1, 0.2, wall.declared["gain_map"].size))
    field = wall.field().detach()
    assert field[:40] == pytest.approx(field[40:], abs=1e-5)
    assert field.abs().max() > 0.05
    # Both points at one place: the gain of that place twice, e^{2f}, so functions of mean square 4.
    twice = effect("wall_reflectance", scan=hand_scan(points[0].tolist(), points[0].tolist()))
    assert twice.functions.square().mean(0) == pytest.approx(
        torch.full((twice.functions.shape[1],), 4.0), rel=1e-4
    )


def test_backgrounds():
    level, spots = torch.tensor(2.0), torch.tensor([3, 0])
    sloped = effect("background_slope", slope=0.4).background(level, spots).detach()
    # The gate's bins 6 … 63 have middles at τ = ∓(1 - 1/58); before the gate τ = -1.
    end = 1 - 1 / 58
    assert sloped[[6, 63]].tolist() == pytest.approx([2 * math.exp(-0.4 * end), 2 * math.exp(0.4 * end)])
    assert sloped[0].item() == pytest.approx(2 * math.exp(-0.4), rel=1e-5)
    bent = effect("background_slope", slope=0.4, bend=0.3).background(level, spots).detach()
    by_hand = [2 * math.exp(sign * 0.4 * end + 0.3 * (end**2 - 1 / 3)) for sign in (-1, 1)]
    assert bent[[6, 63]].tolist() == pytest.approx(by_hand, rel=1e-5)
    extra = torch.zeros(SPOTS)
    extra[3], extra[5], extra[6] = 4.0, 2.0, 0.01
    hot = effect("hot_spots", extra=extra)
    assert hot.background(level, spots)[:, 0].tolist() == pytest.approx([6.0, 2.0])
    assert {n: q.value.item() for n, q in hot.quantities().items()} == pytest.approx(
        {"level": 3.0, "number": 2.0}
    )
    assert effect("hot_spots").quantities()["number"].value.item() == 0
    leak = effect("direct_leak", amplitude=5.0, decay=4 * BIN).background(level, spots).detach()
    assert leak[[0, 6, 10]].tolist() == pytest.approx([7.0, 7.0, 2 + 5 / math.e], rel=1e-5)
    two = effect("direct_leak", amplitude=5.0, decay=8 * BIN, quick=0.4, quick_decay=4 * BIN)
    left = 5 * (0.6 * math.exp(-1) + 0.4 * math.exp(-2))
    assert two.background(level, spots)[14].item() == pytest.approx(2 + left, rel=1e-5)
    ambient = effect("ambient_map", level_map=0.1)
    assert ambient.background(level, spots)[:, 0].detach() == pytest.approx(
        2 * torch.exp(ambient.field()[spots]).detach(), rel=1e-5
    )


@pytest.mark.parametrize("usual", [0.0, 1.0])
def test_spots_are_hot_that_exceed_the_others_by_three_errors_of_their_background(usual):
    """What all spots have is their background, whichever of both a fit gives it to."""
    none = effect("hot_spots")
    error = ((none.scan.background + usual) / none.scan.n_bins) ** 0.5
    extra = torch.full((SPOTS,), usual)
    extra[:3] += torch.tensor([30.0, HOT + 0.1, HOT - 0.1]) * error
    found = effect("hot_spots", extra=extra).quantities()
    assert found["number"].value == 2
    assert found["level"].value.item() == pytest.approx((30 + HOT + 0.1) / 2 * error, rel=1e-4)


def test_hum_swings_in_the_order_of_acquisition():
    """Five spots taken in the order 0, 4, 1, 3, 2: at two periods each is half a period later."""
    rank = torch.tensor([0.0, 2, 4, 3, 1]) / 2 - 1
    hum = effect("hum", scan=dataclasses.replace(scene("confocal")[1], rank=rank), cosine=0.3, sine=0.4)
    hum.set("frequency", 2.0)
    seen = hum.background(torch.tensor(2.0), torch.arange(5)).detach()
    assert seen[:, 0].tolist() == pytest.approx([2.6, 2.6, 2.6, 1.4, 1.4], rel=1e-5)
    hum.set("frequency", 1.0)
    seen = hum.background(torch.ones(5, LAST), torch.arange(5)).detach()
    assert seen[:, 9].tolist() == pytest.approx([1.3, 0.7, 1.3, 0.6, 1.4], rel=1e-5)
    assert hum.quantities()["amplitude"].value.item() == pytest.approx(0.5, abs=1e-4)
    # Overtones: cosines and sines of twice and thrice the phase, which is 0, π, 0, 3π/2, π/2 here.
    hum.set("overtones", torch.tensor([0.1, 0.0, 0.0, 0.2]))
    seen = hum.background(torch.ones(5, LAST), torch.arange(5)).detach()
    assert seen[:, 9].tolist() == pytest.approx([1.4, 0.8, 1.4, 0.7, 1.1], rel=1e-5)
    hum.set_all({"cosine": -0.7, "sine": 0.0, "overtones": -0.3})  # no less than nothing
    assert hum.background(torch.ones(5, LAST), torch.arange(5)).min() == 0
    assert set(hum.settable()) == {"cosine", "sine", "frequency"}


def test_a_frequency_of_the_hum_keeps_most_of_its_power_on_the_grid():
    scan = dataclasses.replace(scene("confocal")[1], rank=torch.linspace(-1, 1, 1024))
    f = torch.tensor(effect("hum", scan=scan).declared["frequency"].grid)
    assert (f[0].item(), f[-1].item(), len(f)) == (2.0, 64.0, 125)
    u = (scan.rank.double() + 1) / 2
    for true in (2.25, 10.23, 63.7):
        wave = torch.sin(2 * math.pi * true * u + 0.4)
        nearest = f[(f - true).abs().argmin()]
        basis = torch.stack([torch.cos(2 * math.pi * nearest * u), torch.sin(2 * math.pi * nearest * u)], 1)
        kept = (basis.T @ wave).square().sum() / (wave.square().sum() * len(u) / 2)
        assert kept > 0.78
    # Few spots: no more than one period in two of them.
    assert effect("hum", "confocal").declared["frequency"].grid[-1] == 4.5


def test_the_direct_tail_falls_off_with_distance():
    """Laser points 0, 0.3 and 0.5 m from the sensor's. The gate opens at 0.62 + 6.5 · 0.02 = 0.75 m, so that
    t - d is 0.25 m at least.
    """
    sensor = [[0.0, 0.0, 0.0]] * 3
    scan = hand_scan([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.3, 0.4, 0.0]], sensor)
    tail = effect("direct_tail", scan=scan, amplitude=9.0, decay=0.25, reach=0.5)
    assert tail.same_as() == ""
    seen = tail.background(torch.tensor(1.0), torch.arange(3)).detach()
    falloff = [1.0, (0.5 / 0.8) ** 2, 0.25]
    by_hand = [1 + 9 * k * math.exp(-late / 0.25) for k, late in zip(falloff, (0.5, 0.2, 0.0), strict=True)]
    assert seen[:, FIRST].tolist() == pytest.approx(by_hand, rel=1e-5)
    later = [1 + (v - 1) * math.exp(-0.2 / 0.25) for v in by_hand]
    assert seen[:, FIRST + 10].tolist() == pytest.approx(later, rel=1e-5)
    # Before t0 it stays as it is there.
    assert seen[:, 0].tolist() == pytest.approx(
        [1 + 9 * math.exp(-0.38 / 0.25), 1 + 9 * falloff[1] * math.exp(-0.08 / 0.25), 1 + 9 * 0.25], rel=1e-4
    )
    assert tail.quantities()["strongest"].value.item() == pytest.approx(max(by_hand) - 1, rel=1e-5)


def test_light_that_has_not_arrived_has_no_tail():
    """Points 1.0 m apart see the pulse at bin (1.0 - 0.62)/0.02 = 19."""
    scan = hand_scan([[1.0, 0.0, 0.0], [0.1, 0.0, 0.0]], [[0.0, 0.0, 0.0]] * 2)
    tail = effect("direct_tail", scan=scan, amplitude=9.0, decay=0.25, reach=0.5)
    seen = tail.background(torch.tensor(0.0), torch.arange(2)).detach()
    assert seen[0, :19].tolist() == [0.0] * 19
    assert seen[0, 19].item() == pytest.approx(9 / 9 * math.exp(-0.01 / 0.25), rel=1e-4)
    assert (seen[1] > 0).all()


def test_the_direct_tail_of_a_confocal_scan_is_a_leak():
    both = {"amplitude": 5.0, "decay": 0.3, "quick": 0.4, "quick_decay": 0.1}
    leak = effect("direct_leak", **both).background(torch.tensor(2.0), torch.arange(3))
    tail = effect("direct_tail", reach=0.1, **both)
    seen = tail.background(torch.tensor(2.0), torch.arange(3)).detach()
    assert seen[:, FIRST:] == pytest.approx(leak[FIRST:].detach().expand(3, -1), rel=1e-5)
    assert tail.declared["reach"].grid == (tail.scan.half,)
    assert tail.same_as() == "direct_leak"
    assert tail.twin_of(effect("direct_leak"))
    assert effect("direct_leak").twin_of(tail)
    assert not tail.twin_of(effect("background_slope"))


def test_a_gate_of_its_own_closes_what_is_before():
    lost = torch.zeros(SPOTS)
    lost[2], lost[7], lost[8] = 1.0, 0.5, 0.1
    gate = effect("spot_gate", lost=lost, start=20.25)
    seen = gate.counting(torch.full((3, LAST), 8.0), torch.tensor([2, 7, 0])).detach()
    assert seen[:, [0, 19, 20, 21]].tolist() == [[0, 0, 6, 8], [4, 4, 7, 8], [8, 8, 8, 8]]
    told = {n: q.value.item() for n, q in gate.quantities().items()}
    assert told == {"share": 0.75, "number": 2, "start": 20.25}
    grid = gate.declared["start"].grid
    assert grid == tuple(range(FIRST + 1, LAST)), "every bin of a short gate"
    long = effect("spot_gate", scan=dataclasses.replace(gate.scan, n_bins=1010, gate=(10, 1010)))
    assert len(long.declared["start"].grid) == 200
    assert np.diff(long.declared["start"].grid) == pytest.approx(1000 / 201)


def test_crosstalk_follows_the_order_of_acquisition():
    """Spots are taken in the order 2, 0, 3, 1; their records hold 1, 10, 100 and 1000 in that order."""
    rank = torch.tensor([1.0, 3.0, 0.0, 2.0]) * 2 / 3 - 1
    counts = np.repeat(np.array([[10], [1000], [1], [100]], dtype=np.uint16), LAST + 3, axis=1)
    scan = dataclasses.replace(scene("confocal")[1], rank=rank, light=counts)
    talk = effect("crosstalk", scan=scan, leak=0.5, lag=1.0)
    dark = torch.zeros(4, LAST)
    assert talk.counting(dark, torch.arange(4))[:, 5].tolist() == pytest.approx([0.5, 50.0, 0.0, 5.0])
    assert talk.counting(dark[:2] + 3, torch.tensor([1, 2]))[:, 5].tolist() == pytest.approx([53.0, 3.0])
    talk.set("lag", 2.25)  # three quarters of the spot two before, a quarter of the one before that
    assert talk.counting(dark, torch.arange(4))[:, 0].tolist() == pytest.approx(
        [0.0, 0.5 * (7.5 + 0.25), 0.0, 0.375]
    )
    talk.set("lag", 3.0)
    talk.settle(torch.full((4, LAST - FIRST), 8.0))
    assert talk.counting(dark, torch.arange(4))[:, FIRST].tolist() == pytest.approx([0.0, 4.0, 0.0, 0.0])
    assert talk.counting(dark, torch.arange(4))[1, FIRST - 1].item() == 0


def test_copies_share_what_is_known_of_all_spots():
    talk = effect("crosstalk", leak=0.2)
    again = copy.deepcopy(talk)
    assert again.light is talk.light
    assert again.scan is talk.scan
    again.set("leak", 0.5)
    again.settle(torch.ones(SPOTS, LAST))
    assert talk.value("leak").item() == pytest.approx(0.2)
    assert not torch.equal(again.light, talk.light)
    assert "light" not in talk.state_dict()


def test_afterpulsing_by_hand():
    scan = dataclasses.replace(scene("confocal")[1], n_bins=400)
    after = effect("afterpulsing", scan=scan, probability=0.25, decay=5 * BIN)
    counts = torch.zeros(1, 400)
    counts[0, 3], counts[0, 4] = 100.0, 40.0
    seen = after.counting(counts, SPOT)[0].detach()
    # p_k = (e^{0.2} - 1) e^{-0.2 k}: bin 4 gets p_1 of bin 3 and nothing of itself.
    p1, p2 = ((math.exp(0.2) - 1) * math.exp(-0.2 * k) for k in (1, 2))
    assert seen[3:6].tolist() == pytest.approx([100.0, 40 + 25 * p1, 25 * p2 + 10 * p1], rel=1e-5)
    assert seen.sum().item() == pytest.approx(140 * 1.25, rel=1e-5)


def test_pile_up_is_coates_formula():
    scan = dataclasses.replace(scene("confocal")[1], mean_counts=300.0)
    pile = effect("pile_up", scan=scan, detections=0.3)  # 1000 cycles
    seen = pile.counting(torch.tensor([[200.0, 700.0, 0.05]]), SPOT)[0].tolist()
    free = math.exp(-0.2)
    by_hand = [1000 * (1 - free), 1000 * (1 - math.exp(-0.7)) * free, 0.05 * math.exp(-0.9)]
    assert seen == pytest.approx(by_hand, rel=1e-4)
    # Drawn cycle by cycle: the first photon is kept.
    rng = np.random.default_rng(0)
    photons = rng.poisson([0.2, 0.7], (200_000, 2)) > 0
    assert photons[:, 0].mean() == pytest.approx(seen[0] / 1000, abs=4e-3)
    assert (photons[:, 1] & ~photons[:, 0]).mean() == pytest.approx(seen[1] / 1000, abs=4e-3)


def test_ripple_and_edges_of_the_gate():
    counts = torch.full((1, LAST), 10.0)
    ripple = effect("tcspc_nonlinearity", sine=0.3, cosine=0.4, period=8.0)
    seen = ripple.counting(counts, SPOT)[0].detach()
    assert seen[[0, 2, 4, 6, 8]].tolist() == pytest.approx([14, 13, 6, 7, 14], rel=1e-5)
    bins = np.arange(FIRST, LAST)
    wave = 0.3 * np.sin(bins * np.pi / 4) + 0.4 * np.cos(bins * np.pi / 4)
    assert ripple.quantities()["rms"].value.item() == pytest.approx((wave**2).mean() ** 0.5, abs=1e-5)
    edges = effect("gate_edges", start=0.5, end=0.2, width=2.0)
    seen = edges.counting(counts, SPOT)[0].detach()
    by_hand = [10, 5, 10 * (1 - 0.5 / math.e), 10 * (1 - 0.2 / math.e), 8]
    assert seen[[FIRST - 1, FIRST, FIRST + 2, LAST - 3, LAST - 1]].tolist() == pytest.approx(
        by_hand, rel=1e-5
    )


@pytest.mark.parametrize("period", range(3, 17))
def test_any_widths_that_repeat_are_a_pattern(period):
    """Up to 16 of them, whose mean is none; and no wave is a sum of the others."""
    widths = np.random.default_rng(period).standard_normal(period)
    widths -= widths.mean()
    bins = torch.arange(240.0, dtype=torch.float64)
    waves = waves_at(bins, torch.tensor(float(period), dtype=torch.float64)).numpy()
    told = waves[:, (waves**2).mean(0) > 1e-12]
    assert np.linalg.matrix_rank(told) == told.shape[1] == period - 1
    wanted = widths[bins.long().numpy() % period]
    found = np.linalg.lstsq(told, wanted, rcond=None)[0]
    assert told @ found == pytest.approx(wanted, abs=1e-9)


def test_no_frequency_of_a_pattern_is_missed():
    """In phase in the middle of the gate, no wave is off by more than a sixth of its period at the ends."""
    for width in (58, 300, 2000):
        scan = dataclasses.replace(scene("confocal")[1], gate=(10, 10 + width), n_bins=10 + width)
        f = 1 / np.array(effect("tcspc_nonlinearity", scan=scan).declared["period"].grid)
        assert f[0] == pytest.approx(max(1 / 40, 2 / width))
        assert f[-1] == pytest.approx(1 / 2.2)
        highest = np.clip(1 / (2 * f[:-1]), 1, 8)
        off = np.diff(f) / 2 * highest * width / 2
        assert off.max() <= 1.01 / 6 or (len(f) == 2000 and width == 2000)


def test_likely_periods_are_those_that_the_counts_repeat_with():
    """Fourteen random widths, of which no wave has much; a bin more of the period loses them."""
    scan = dataclasses.replace(scene("confocal")[1], gate=(10, 310), n_bins=310)
    pattern, rng = effect("tcspc_nonlinearity", scan=scan), np.random.default_rng(4)
    light = torch.from_numpy(4e5 * np.exp(-np.arange(300) / 150) + 1e4)
    widths = rng.standard_normal(14)
    excess = light * torch.from_numpy(0.02 * (widths - widths.mean()))[torch.arange(10, 310) % 14]
    noise = light.sqrt() * torch.from_numpy(rng.standard_normal(300))
    found = [shape["period"] for shape in pattern.likely_in_time(excess + noise, light)]
    assert found[0] == pytest.approx(14, abs=0.03)
    assert 1 < len(found) <= 8
    assert len(set(found)) == len(found)
    assert max(found) == found[0]


def test_the_shortest_period_goes_before_its_multiples():
    """Three widths beside a light that is wrong in places: twelve could follow some of that."""
    scan = dataclasses.replace(scene("confocal")[1], gate=(10, 310), n_bins=310)
    light = torch.full((300,), 1e5, dtype=torch.float64)
    bins = torch.arange(10, 310, dtype=torch.float64)
    wrong = 0.004 * torch.sin(2 * math.pi * bins / 12)
    widths = torch.tensor([0.02, 0.0, -0.02], dtype=torch.float64)[bins.long() % 3]
    pattern = effect("tcspc_nonlinearity", scan=scan)
    found = pattern.likely_in_time(light * (widths + wrong), light)
    assert found[0]["period"] == pytest.approx(3, abs=0.005)
    assert {round(shape["period"]) for shape in pattern.likely_in_time(light * wrong, light)} >= {12}


def test_a_residual_with_no_noise_has_likely_periods_too():
    """Of which each is worth nothing: a fit may be as near to the counts as that."""
    scan = dataclasses.replace(scene("confocal")[1], gate=(10, 310), n_bins=310)
    light = torch.full((300,), 1e5, dtype=torch.float64)
    found = effect("tcspc_nonlinearity", scan=scan).likely_in_time(1e-6 * light.sqrt(), light)
    assert 1 <= len(found) <= 8


def test_delays_of_ghosts_are_scanned_densely():
    scan = dataclasses.replace(scene("confocal")[1], n_bins=512)
    bins = np.array(effect("ghost_pulse", scan=scan).declared["delay"].grid) / BIN
    assert bins[0] == pytest.approx(4)
    assert np.diff(bins)[bins[:-1] < 37] == pytest.approx(3.0)
    assert 0.56 * 512 < bins[-1] <= 0.6 * 512
    assert (bins[1:] / bins[:-1])[bins[:-1] > 42] == pytest.approx(1.06)


def two_sheets(fraction: float, delay: int, spots: int = 300) -> torch.Tensor:
    """[spots, 120] photons of two sheets, 5 - 40 bins apart, and of all that again after ``delay`` bins."""
    rng = np.random.default_rng(3)
    bins, near = np.arange(120), rng.uniform(15, 25, (spots, 1))
    apart = rng.uniform(5, 40, (spots, 1))
    light = sum(a * np.exp(-(((bins - at) / 1.2) ** 2)) for a, at in ((150, near), (60, near + apart)))
    light[:, delay:] += fraction * light[:, :-delay]
    return torch.from_numpy(rng.poisson(light + 0.5)).float()


@pytest.mark.parametrize("delay", [8, 11, 30, 71])
def test_an_echo_shows_where_the_counts_repeat(delay):
    """Whatever the scene does, which is another thing at each spot; however many spectra are held at once."""
    assert repeats_after(two_sheets(0.1, delay)) == delay
    assert repeats_after(two_sheets(0.1, delay, 1500)) == delay


def test_no_echo_is_looked_for_where_the_record_ends():
    """It must come before 0.6 of it, and not before 8 bins; a record too short for that is no error."""
    for delay in (6, 74):
        assert 8 <= repeats_after(two_sheets(0.5, delay)) < 72
    assert repeats_after(two_sheets(0.5, 30)[:, :6]) == 8


def test_a_scene_begins_with_a_weak_echo_where_the_counts_repeat():
    """What is scanned elsewhere stands where it shows; other effects begin at their nulls."""
    counts = two_sheets(0.1, 30)
    ghost = effect("ghost_pulse", scan=dataclasses.replace(scene("confocal")[1], n_bins=120))
    ghost.begin(counts)
    assert ghost.value("fraction").item() == pytest.approx(0.05)
    assert ghost.value("delay").item() == pytest.approx(30 * BIN)
    tail = effect("irf_tail", fraction=0.3)
    tail.begin(counts)
    assert tail.value("fraction").item() == 0


def test_splines_sum_to_one_and_are_smooth():
    u = torch.linspace(-1, 1, 201, dtype=torch.float64)
    basis = spline_basis(u, 6)
    assert basis.sum(1) == pytest.approx(torch.ones(201), abs=1e-12)
    functions, share = smooth_basis(u, 6)
    assert functions.shape == (201, 5)
    assert functions.T @ functions / 201 == pytest.approx(torch.eye(5, dtype=torch.float64), abs=1e-9)
    assert functions.mean(0).abs().max() < 1e-9
    # Slopes fall as those of half and whole cosines do, as far as six splines follow them.
    assert share[:3] == pytest.approx([1, 1 / 4, 1 / 9], rel=0.02)
    assert share.diff().max() < 0
    # Few points: as many functions as they can tell apart.
    assert smooth_map_basis(torch.rand(4, 2, generator=torch.Generator().manual_seed(1)) * 2 - 1, 6)[
        0
    ].shape == (4, 3)
    assert smooth_basis(torch.zeros(1), 6)[0].shape == (1, 0)


def test_smooth_maps_do_not_hang_on_rounding():
    """On a square scan half-waves along x and along y would be equally smooth, and any mixture of them an
    answer.
    """
    u = torch.linspace(-1, 1, 24, dtype=torch.float64)
    place = torch.stack(torch.meshgrid(u, u, indexing="ij"), -1).reshape(-1, 2)
    noise = torch.randn(place.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    functions, other = (smooth_map_basis(p, 6)[0] for p in (place, place + 1e-9 * noise))
    assert functions.shape == (576, 35)
    assert other == pytest.approx(functions, abs=1e-4)
    assert functions[:, 0].view(24, 24).std(1).max() < 0.05  # along x alone


def test_priors_count_nats():
    drift = effect("power_drift")
    assert drift.penalty().item() == 0
    deviations = torch.tensor(drift.declared["drift"].prior)
    drift.set("drift", torch.cat([2 * deviations[:1], deviations[1:2], 0 * deviations[2:]]))
    assert drift.penalty().item() == pytest.approx((4 + 1) / 2, rel=1e-5)
    drift.prior_scale = 0.5
    assert drift.penalty().item() == pytest.approx(4 * (4 + 1) / 2, rel=1e-5)
    assert drift.precision() == pytest.approx((0.05 / (0.5 * deviations)) ** 2, rel=1e-5)
    assert float(effect("irf_tail").precision().sum()) == 0


@pytest.mark.parametrize("name", ["power_drift", "time_drift", "scene_motion"])
def test_what_swings_in_the_mean_more_than_twelve_times_is_no_drift(name):
    drift = effect(name, scan=grid_scan(24))
    n = drift.amplitudes[0].size

    def step(**powers: float) -> torch.Tensor:
        """Functions with so many half periods (``_24``) over the scan, and so much power."""
        values = torch.zeros(n)
        for half_periods, power in powers.items():
            values[drift.components * (int(half_periods[1:]) - 1)] = power**0.5
        return values

    assert drift.is_meant(torch.zeros(n))
    assert drift.is_meant(step(_23=1.0))
    assert not drift.is_meant(step(_26=1.0))
    assert drift.is_meant(step(_2=0.7, _70=0.3))
    assert not drift.is_meant(step(_2=0.6, _70=0.4))
    assert effect("ambient_drift", scan=grid_scan(24)).is_meant(torch.ones(1))


@pytest.mark.parametrize("kind", ["single", "exhaustive"])
def test_scan_knows_its_centre(kind):
    scan = scene(kind)[1]
    moving = scan.sensor if kind == "single" else torch.cat([scan.laser, scan.sensor])
    low, high = moving[:, :2].aminmax(dim=0)
    assert scan.centre == pytest.approx((low + high) / 2, abs=1e-6)
    assert scan.middle == pytest.approx(0.62 + 0.02 * 35)


@pytest.mark.parametrize("built", EFFECTS, ids=lambda e: e.name)
def test_a_fixed_laser_works(built):
    """Single-laser scans, all effects at their nulls: nothing changes."""
    model, scan = scene("single")
    spots = torch.arange(SPOTS)
    assert model.expected(spots, Extension([built(scan)])) == pytest.approx(
        model.expected(spots), rel=1e-5, abs=1e-4
    )


def test_one_spot_is_enough():
    whole = capture("confocal")
    points = {name: getattr(whole, name)[:1] for name in ("laser", "sensor", "laser_normal", "sensor_normal")}
    alone = dataclasses.replace(whole, counts=whole.counts[:1], scan_order=None, **points)
    scan = Scan.of(alone)
    for built in EFFECTS:
        assert built(scan).quantities() is not None


def test_numbers_that_lie_at_a_bound_are_told():
    """Not those at their null, even where that is a bound (an entrance loss of 0), nor of single echoes."""
    assert bound_notes([effect("retroreflection"), effect("irf_tail"), effect("wall_reflectance")]) == []
    inside = effect("retroreflection", falloff=1.51, cosine=2.99, entrance=7.9)
    assert bound_notes([inside, effect("ghost_pulse", fraction=0.1, again=0.0)]) == []
    beyond = effect("retroreflection", falloff=1.0, cosine=9.0, entrance=0.0)
    said = [note.split(":")[0] for note in bound_notes([beyond])]
    assert said == [
        "falloff of retroreflection is 1.5, the least that it may be",
        "cosine of retroreflection is 3, the most that it may be",
    ]
    scan = scene("confocal")[1]
    decay = next(p for p in registered("irf_tail").declare(scan) if p.name == "decay")
    (slow,) = bound_notes([effect("irf_tail", fraction=0.1, decay=10 * decay.upper)])
    assert slow.startswith(f"decay of irf_tail is {decay.upper:g}, the most")
