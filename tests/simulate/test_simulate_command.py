"""The command: what it writes reads back, and what it cannot do is one sentence."""

from __future__ import annotations

import re

import numpy as np
import pytest

from data_modules.readers import read_capture
from data_modules.simulate import draw_scene, load_truth
from nlos_lit.capture.errors import UserError
from nlos_lit.commands.simulate import Options, build, parse, simulate
from nlos_lit.runtime.command_line import sentence_errors

main = sentence_errors(simulate)  # as the door does it
SMALL = ["nx=3", "ny=4", "bin_length=0.02", "n_bins=100", "width=0.6", "height=0.8"]


def test_writes_a_capture_and_its_truth(tmp_path, capsys):
    out = tmp_path / "made" / "letters.hdf5"
    main(["scene=letters", f"out={out}", "seed=3", "kind=single", "fixed_point=[0.1,-0.1]", *SMALL])
    assert "single_laser, 12 spots × 100 bins" in capsys.readouterr().out
    capture = read_capture(out)
    assert capture.kind == "single_laser"
    assert capture.scan_shape == (3, 4)
    assert capture.n_bins == 100
    assert capture.laser == pytest.approx(np.tile([0.1, -0.1, 0.0], (12, 1)))
    assert capture.counts.sum() == pytest.approx(12 * 1500, rel=0.05)
    assert np.isfinite(load_truth(out.with_name("letters_truth.h5")).depth).any()


def test_effects_and_exposure_are_simulated_and_written_down(tmp_path):
    out = tmp_path / "x.hdf5"
    small = [*SMALL, "sigma=0.02", "scene=letters", "seed=1"]
    main(
        [
            f"out={out}",
            "effects=[pile_up,hot_spots]",
            "pile_up.detections=0.4",
            "hot_spots.level=2",
            "exposure=3",
            *small,
        ]
    )
    capture = read_capture(out)
    told = capture.provenance["effects"]
    assert told["pile_up"]["detections"]["value"] == pytest.approx(0.4)
    assert told["hot_spots"]["level"]["value"] == pytest.approx(6)
    assert capture.provenance["exposure"] == 3
    main([f"out={tmp_path / 'y.hdf5'}", "exposure=3", *small])
    plain = read_capture(tmp_path / "y.hdf5")
    assert plain.counts.sum() == pytest.approx(3 * 12 * (1500 + 10), rel=0.02)
    assert plain.provenance["sensor"]["background"] == pytest.approx(0.3)
    # Cycles that record one photon at most: 0.4 a cycle of the -ln(1 - 0.4) that arrive, if all spots were
    # equally bright.
    hot = 6 * 100
    assert capture.counts.sum() == pytest.approx((plain.counts.sum() + hot) * 0.4 / -np.log(0.6), rel=0.05)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["pile_up.detections=0.3"], "name them: effects=.pile_up."),
        (["effects=[pile_up]", "pile_up.detections=lots"], "must be a number; found 'lots'"),
        (["effects=pileup"], "no effect 'pileup'"),
        (["effects=[pile_up]", "irf_tail.fraction=0.3"], "not among effects"),
        (["exposure=0"], "exposure must be a number above 0"),
    ],
)
def test_effects_that_make_no_sense_are_one_sentence(arguments, words, tmp_path, capsys):
    out = tmp_path / "a.hdf5"
    with pytest.raises(SystemExit) as end:
        main([f"out={out}", *SMALL, *arguments])
    assert end.value.code == 2
    assert re.search(words, capsys.readouterr().err)
    assert not out.exists()


def test_keeps_what_is_already_there(tmp_path, capsys):
    out = tmp_path / "a.hdf5"
    out.write_text("precious")
    with pytest.raises(SystemExit) as end:
        main([f"out={out}", *SMALL])
    assert end.value.code == 2
    assert "already there" in capsys.readouterr().err
    assert out.read_text() == "precious"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nx=many"], "nx must be .*; found many"),
        (["spots=3"], "no option 'spots'"),
        (["help"], "--help lists the keys"),
        (["kind=spiral"], "confocal"),
        (["kappa=-1"], "kappa"),
        (["kappa="], "kappa"),
    ],
)
def test_arguments_that_make_no_sense_are_explained(arguments, words):
    with pytest.raises(UserError, match=words):
        parse(arguments)


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"scene": "castle"}, "scene is one of default, letters"),
        ({"scene": "mesh"}, "scene is one of default, letters"),
        ({"scene": "letters", "mesh": "x.obj"}, "scene is one of default, letters"),
        ({"mesh": "x.obj"}, "without scene=mesh"),
        ({"bodies": ({"kind": "sphere"},), "mesh": "x.obj"}, "without scene=mesh"),
        ({"bodies": ({"kind": "sphere"},), "random": 0}, "found bodies and random; .* give one of them"),
        ({"bodies": ({"kind": "sphere"},), "scene": "letters"}, "found scene and bodies"),
        ({"bodies": ()}, "found no bodies; give at least one"),
        ({"bodies": ({"kind": "cube"},)}, "body 1 has no known kind"),
    ],
)
def test_scenes_that_do_not_exist_are_explained(given, words):
    with pytest.raises(UserError, match=words):
        build(Options(**given))


def test_bodies_are_one_argument_and_are_written_down(tmp_path):
    out = tmp_path / "a.hdf5"
    ball = "{kind: sphere, radius: 0.12, at: [0.1, 0, 0.5]}"
    word = "{kind: text, text: 'NO', at: [-0.1, 0, 0.7], texture: halves, albedo: [0.3, 0.9]}"
    main([f"out={out}", f"bodies=[{ball}, {word}]", *SMALL])
    told = read_capture(out).provenance["bodies"]
    assert [body["kind"] for body in told] == ["sphere", "text"]
    assert told[0] == {"kind": "sphere", "radius": 0.12, "at": [0.1, 0, 0.5]}
    truth = load_truth(out.with_name("a_truth.h5"))
    assert np.nanmin(truth.depth) == pytest.approx(0.38, abs=1e-3)
    assert np.nanmax(truth.depth) == pytest.approx(0.7, abs=1e-3)
    assert set(np.unique(truth.albedo[np.isfinite(truth.albedo)]).round(6)) == {0.3, 0.8, 0.9}


def test_one_body_needs_no_list():
    options, _, _ = parse(["bodies={kind: cone, height: 0.3}"])
    assert list(options.bodies) == [{"kind": "cone", "height": 0.3}]


def test_brackets_that_do_not_match_are_explained():
    with pytest.raises(UserError, match=r"cannot read bodies=\[\{kind: sphere: brackets"):
        parse(["bodies=[{kind: sphere"])


def test_a_random_scene_is_as_drawn_but_for_what_is_given(tmp_path, capsys):
    drawn = draw_scene(3)
    options, scan, sensor = parse(["random=3", "nx=5", "background=0.4"])
    assert build(options)[1] == drawn.bodies
    assert (scan.nx, scan.ny, scan.n_bins) == (5, drawn.scan.ny, drawn.scan.n_bins)
    assert (sensor.background, sensor.mean_counts) == (0.4, drawn.sensor.mean_counts)
    main([f"out={tmp_path / 'a.hdf5'}", "random=3", "nx=3", "ny=4"])
    line = capsys.readouterr().out.splitlines()[0]
    assert build(parse([line])[0])[1] == drawn.bodies


@pytest.mark.parametrize("seed", range(6))
def test_hydra_reads_the_same_line(seed):
    from hydra.core.override_parser.overrides_parser import OverridesParser

    line = draw_scene(seed).line()
    (override,) = OverridesParser.create().parse_overrides([line])
    assert build(Options(bodies=tuple(override.value())))[1] == draw_scene(seed).bodies
