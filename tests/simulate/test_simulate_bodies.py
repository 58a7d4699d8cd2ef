"""Bodies: closed, of the right area and volume, posed, painted, seen and lit as worked out by hand."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from conftest import ROOT
from numpy import pi

from data_modules.simulate.bodies import (
    BODIES,
    Bend,
    Body,
    Capsule,
    Cone,
    Cylinder,
    Fold,
    Person,
    Plate,
    Sphere,
    Text,
    Torus,
    assemble,
    bodies_from,
    body_from,
    one_line,
)
from data_modules.simulate.mesh import Mesh
from data_modules.simulate.transients import simulate_transients
from data_modules.simulate.truth import view_from_wall
from nlos_lit.capture.errors import UserError

SOLID = [body() for body in BODIES if body not in (Plate, Fold, Bend, Text)] + [
    Text(depth=0.03),
    Cone(top=0.05),
]
SHEETS = [Plate(), Fold(), Fold(creases=4, angle=230), Bend(), Bend(angle=-90), Text()]
ALL = SOLID + SHEETS
each_body = pytest.mark.parametrize("body", ALL, ids=lambda body: body.kind)
CURVED = [
    (Sphere(radius=0.1), 4 * pi * 0.01, 4 / 3 * pi * 1e-3),
    (Capsule(radius=0.1, length=0.2), 2 * pi * 0.1 * 0.4, pi * 0.01 * 0.2 + 4 / 3 * pi * 1e-3),
    (Cylinder(radius=0.1, height=0.3), 2 * pi * 0.1 * 0.4, pi * 0.01 * 0.3),
    (Cone(radius=0.3, height=0.4), pi * 0.3 * (0.3 + 0.5), pi * 0.09 * 0.4 / 3),
    # Cut at half its height: a quarter of the large cone's side is gone, an eighth of its volume.
    (
        Cone(radius=0.3, top=0.15, height=0.2),
        pi * (0.09 + 0.15**2 + 0.3 * 0.5 * 0.75),
        pi * 0.09 * 0.4 / 3 * 7 / 8,
    ),
    (Torus(radius=0.2, tube=0.1), 4 * pi**2 * 0.02, 2 * pi**2 * 0.2 * 0.01),
    (
        Text(text="-", size=0.6, pen=0.1, depth=0.2),
        2 * (0.02 + pi * 0.0025) + 0.2 * (0.4 + pi * 0.1),
        0.2 * (0.02 + pi * 0.0025),
    ),
]


def is_closed(mesh: Mesh) -> bool:
    """Every edge is walked once in either direction."""
    edges = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    walked = {(a, b) for a, b in edges.tolist()}
    return len(walked) == len(edges) and all((b, a) in walked for a, b in walked)


@pytest.mark.parametrize("body", SOLID, ids=lambda body: body.kind)
def test_solids_are_closed_with_their_normals_outside(body):
    assert is_closed(body.shape())
    assert body.shape().volume > 0


@pytest.mark.parametrize("body", SHEETS, ids=lambda body: body.kind)
def test_sheets_look_to_the_wall(body):
    assert (body.shape().face_vectors[:, 2] < 0).all()
    assert not is_closed(body.shape())


@pytest.mark.parametrize(("body", "area", "volume"), CURVED, ids=lambda value: getattr(value, "kind", ""))
def test_area_and_volume_converge_with_the_square_of_the_cell(body, area, volume):
    coarse, fine = (dataclasses.replace(body, cell=cell).shape() for cell in (0.02, 0.005))
    for name, true in (("area", area), ("volume", volume)):
        errors = [abs(getattr(mesh, name) / true - 1) for mesh in (coarse, fine)]
        assert errors[0] < 0.02
        assert errors[1] < errors[0] / 8  # second order: a sixteenth; first order: a quarter


def test_sheets_have_the_size_of_their_paper():
    assert Plate(width=0.3, height=0.2).shape().area == pytest.approx(0.06, rel=1e-12)
    fold = Fold(width=0.4, height=0.5, creases=3, angle=60).shape()
    assert fold.area == pytest.approx(0.2, rel=1e-12)
    # Four panels of 0.1 m that lean by 60° from the wall.
    assert np.ptp(fold.vertices, axis=0) == pytest.approx([0.2, 0.5, 0.1 * np.sqrt(0.75)])
    bend = Bend(width=0.2 * pi, height=0.5, angle=180, cell=0.002).shape()
    assert bend.area == pytest.approx(0.1 * pi, rel=1e-5)
    assert np.ptp(bend.vertices, axis=0) == pytest.approx([0.4, 0.5, 0.2], rel=3e-5)


def test_a_letters_strokes_are_counted_once_where_they_meet():
    """Two strokes of 0.6 and 0.4 m; they share a square of the pen's radius and three quarters of a disc."""
    true = 0.1 - 0.05**2 + 1.25 * pi * 0.05**2
    coarse, fine = (Text(text="L", size=0.6, pen=0.1, cell=cell).shape().area for cell in (0.02, 0.005))
    assert coarse == pytest.approx(true, rel=0.01)
    assert abs(fine - true) < abs(coarse - true) / 8


def test_folds_and_bends_go_the_way_they_say():
    """A ridge is nearest to the wall in its middle, a valley at its edges."""
    for ridge, valley in ((Fold(angle=90), Fold(angle=270)), (Bend(angle=90), Bend(angle=-90))):
        x, y = np.array([-0.1, 0.0, 0.1]), np.array([0.0])
        near, far = (view_from_wall(body.mesh(), x, y).depth[:, 0] for body in (ridge, valley))
        assert near[1] < near[0] == pytest.approx(near[2])
        assert far[1] > far[0] == pytest.approx(far[2])
    assert near[0] - near[1] == pytest.approx(far[1] - far[0])


def test_a_person_is_seven_closed_parts_that_touch():
    mesh = Person(height=0.6).shape()
    label = np.arange(len(mesh.vertices))
    while True:
        least = label.copy()
        for i in range(3):
            np.minimum.at(least, mesh.faces[:, i], label[mesh.faces].min(axis=1))
        if np.array_equal(least, label):
            break
        label = least
    assert len(np.unique(label)) == 7
    assert np.ptp(mesh.vertices[:, 1]) == pytest.approx(0.6, rel=3e-4)
    seen = view_from_wall(Person().mesh(), np.linspace(-0.4, 0.4, 161), np.linspace(-0.4, 0.4, 161)).depth
    from scipy.ndimage import label as regions

    assert regions(np.isfinite(seen))[1] == 1


def test_a_turn_goes_about_x_then_y_then_z():
    tip = np.array([0.0, 0.2, 0.0])
    cone = Cone(height=0.4, at=(0.1, 0.2, 0.7))
    for turn, place in [
        ((0, 0, 0), tip),
        ((-90, 0, 0), [0, 0, -0.2]),
        ((90, 90, 0), [0.2, 0, 0]),
        ((90, 90, 90), [0, 0.2, 0]),
        ((0, 0, 30), [-0.1, 0.2 * np.sqrt(0.75), 0]),
    ]:
        vertices = dataclasses.replace(cone, turn=turn).mesh().vertices
        assert np.linalg.norm(vertices - np.add([0.1, 0.2, 0.7], place), axis=1).min() < 1e-12


@each_body
@pytest.mark.parametrize("texture", ["gradient", "halves", "stripes", "checker"])
def test_textures_leave_the_shape_alone(body, texture):
    plain = body.mesh()
    painted = dataclasses.replace(body, texture=texture, albedo=(0.2, 0.9)).mesh()
    assert painted.area == pytest.approx(plain.area, rel=1e-9)
    assert painted.volume == pytest.approx(plain.volume, rel=1e-9)
    assert painted.albedo.min() >= 0.2
    assert painted.albedo.max() <= 0.9
    assert np.ptp(painted.albedo) > 0.5


def albedo_at(body: Body, x: float, y: float) -> float:
    return float(view_from_wall(body.mesh(), np.array([x]), np.array([y])).albedo[0, 0])


def test_textures_lie_where_they_should():
    square = Plate(width=0.4, height=0.4)

    def painted(texture: str, along: str = "x") -> Body:
        return dataclasses.replace(square, texture=texture, albedo=(0.2, 0.8), along=along, period=0.2)

    assert albedo_at(painted("halves"), -0.01, 0.1) == pytest.approx(0.2)
    assert albedo_at(painted("halves"), 0.01, 0.1) == pytest.approx(0.8)
    assert albedo_at(painted("gradient", "y"), 0.05, -0.1) == pytest.approx(0.35)
    for x, y, stripes, checker in [
        (0.0, 0.0, 0.2, 0.2),
        (0.049, 0.0, 0.2, 0.2),
        (0.051, 0.0, 0.8, 0.8),
        (0.149, 0.1, 0.8, 0.2),
        (-0.051, 0.049, 0.8, 0.8),
        (0.0, 0.051, 0.2, 0.8),
    ]:
        assert albedo_at(painted("stripes"), x, y) == pytest.approx(stripes)
        assert albedo_at(painted("checker"), x, y) == pytest.approx(checker)
    turned = dataclasses.replace(painted("halves"), turn=(0, 0, 180))
    assert albedo_at(turned, -0.01, 0.1) == pytest.approx(0.8)


def test_what_the_wall_sees():
    zero = np.array([0.0])

    def depth(body: Body, x: float, y: float) -> float:
        return float(view_from_wall(body.mesh(), zero + x, zero + y).depth[0, 0])

    assert depth(Sphere(radius=0.1, cell=0.003), 0.06, 0.0) == pytest.approx(0.6 - 0.08, abs=1e-4)
    assert np.isnan(depth(Torus(), 0.0, 0.0))
    assert depth(Torus(radius=0.12, tube=0.04, cell=0.003), 0.0, -0.12) == pytest.approx(0.56, abs=1e-4)
    assert depth(Cylinder(radius=0.1, turn=(90, 0, 0), height=0.2), 0.05, 0.05) == pytest.approx(0.5)
    letter = Text(text="L", size=0.3, pen=0.05)  # from the wall, +x is left
    assert [np.isfinite(depth(letter, x, y)) for x, y in [(0.1, 0.14), (-0.1, -0.15), (-0.1, 0.1)]] == [
        True,
        True,
        False,
    ]


def at_origin(mesh: Mesh, detail: float = 1.0) -> np.ndarray:
    """Transient of the wall point (0, 0, 0), lit and seen."""
    point, normal = np.zeros((1, 3)), np.array([[0.0, 0.0, 1.0]])
    return simulate_transients(
        mesh, point, point, normal, normal, bin_length=0.01, n_bins=300, detail=detail
    )[0]


def ring_energy(z: float, inner: float, outer: float) -> float:
    """∫ 2πr z⁴ / (r² + z²)⁴ dr / π³, a flat ring parallel to the wall, straight ahead, albedo 1."""
    return z**4 / (3 * pi**2) * ((inner**2 + z**2) ** -3 - (outer**2 + z**2) ** -3)


def test_a_cans_lid_is_as_bright_as_worked_out():
    can = Cylinder(radius=0.1, height=0.2, at=(0, 0, 0.6), turn=(90, 0, 0), albedo=0.5, cell=0.004)
    seen = at_origin(can.mesh())
    assert seen.sum() == pytest.approx(0.5 * ring_energy(0.5, 0, 0.1), rel=1e-3)
    # From 2·0.5 m to 2·sqrt(0.5² + 0.1²) = 1.0198 m.
    assert np.flatnonzero(seen).tolist() == [100, 101]


def test_a_cone_agrees_with_its_one_dimensional_integral():
    """Its tip points to the wall: the distance of every tangent plane from the wall's point is the tip's."""
    radius, height, tip, n = 0.15, 0.3, 0.45, 20_000
    slant = np.hypot(radius, height)
    s = slant * (np.arange(n) + 0.5) / n
    r, z = s * radius / slant, tip + s * height / slant
    distance = np.hypot(r, z)
    value = 2 * pi * r * slant / n * (tip * radius / slant) ** 2 * z**2 / distance**8 / pi**3
    reference = np.histogram(2 * distance, bins=0.01 * np.arange(301), weights=value)[0]
    cone = Cone(radius=radius, height=height, at=(0, 0, tip + height / 2), turn=(-90, 0, 0), albedo=1.0)
    seen = at_origin(dataclasses.replace(cone, cell=0.005).mesh())
    assert seen.sum() == pytest.approx(value.sum(), rel=2e-3)
    assert np.linalg.norm(seen - reference) < 0.01 * np.linalg.norm(reference)


def test_a_ball_hides_the_middle_of_what_is_behind_it():
    """A black ball before a plate: its shadow's edge is where the tangent from the wall's point meets it."""
    ball = Sphere(radius=0.1, at=(0, 0, 0.4), albedo=0.0, cell=0.004)
    plate = Plate(width=0.6, height=0.6, at=(0, 0, 0.8), albedo=1.0)
    hidden = at_origin(plate.mesh(), 3).sum() - at_origin(assemble([ball, plate]), 3).sum()
    shadow = 0.8 * np.tan(np.arcsin(0.1 / 0.4))
    assert hidden == pytest.approx(ring_energy(0.8, 0, shadow), rel=5e-3)


def test_bodies_that_touch_hide_where_they_touch():
    """A can that stands on a plate: its lid shines, its sides do not, and its shadow is missing."""
    plate = Plate(width=0.6, height=0.6, at=(0, 0, 0.8), albedo=1.0)
    can = Cylinder(radius=0.1, height=0.1, at=(0, 0, 0.75), turn=(90, 0, 0), albedo=0.5, cell=0.008)
    change = at_origin(assemble([plate, can]), 3).sum() - at_origin(plate.mesh(), 3).sum()
    shadow = 0.1 * 0.8 / 0.7
    assert change == pytest.approx(0.5 * ring_energy(0.7, 0, 0.1) - ring_energy(0.8, 0, shadow), rel=5e-3)


@each_body
def test_a_body_comes_back_from_its_config(body):
    moved = dataclasses.replace(body, at=(0.1, -0.2, 0.7), texture="stripes", albedo=(0.25, 0.5), along="x")
    assert body_from(moved.config()) == moved
    assert body_from({"kind": body.kind}) == type(body)()


@pytest.mark.parametrize(
    ("config", "words"),
    [
        ("sphere", "body 1 must be KEY: VALUE pairs"),
        ({"radius": 1}, "body 1 must be KEY: VALUE pairs"),
        ({"kind:sphere": None}, "blanks after colons"),
        ({"kind": "ball"}, "body 1 has no known kind: found 'ball'; the kinds are sphere, capsule"),
        ({"kind": "sphere", "radus": 1}, r"body 1 \(sphere\) has no key 'radus'; its keys.*radius: 0.1"),
        ({"kind": "sphere", "radius": "big"}, r"body 1 \(sphere\): radius must be a number; found big"),
        ({"kind": "sphere", "radius": -1}, "radius must be above 0; found -1"),
        ({"kind": "sphere", "radius": True}, "radius must be a number; found True"),
        ({"kind": "sphere", "at": [0, 0]}, r"at must be 3 numbers; found \[0, 0\]"),
        ({"kind": "sphere", "at": [0, 0, float("nan")]}, "must be finite"),
        ({"kind": "sphere", "albedo": [0.1, 0.2]}, "texture plain takes one albedo"),
        ({"kind": "sphere", "texture": "stripes"}, r"two albedos, as albedo: \[0.3, 0.9\]; found 0.8"),
        ({"kind": "sphere", "albedo": 1.5}, r"albedo must lie in \[0, 1\]; found 1.5"),
        ({"kind": "sphere", "texture": "dots"}, "texture is one of plain, gradient"),
        ({"kind": "sphere", "along": "xy"}, "along is x, y or z; found 'xy'"),
        ({"kind": "cone", "top": -0.1}, "top must be 0 or above"),
        ({"kind": "torus", "tube": 0.2}, "tube must be below radius; found 0.2 and 0.12"),
        ({"kind": "fold", "creases": 1.5}, "creases must be a whole number; found 1.5"),
        ({"kind": "fold", "creases": float("inf")}, "creases must be a whole number; found inf"),
        ({"kind": "fold", "creases": 101}, "creases may be 100 at most; found 101"),
        ({"kind": "fold", "angle": 0}, "angle must lie between 0 and 360"),
        ({"kind": "bend", "angle": 0}, "angle must lie within"),
        ({"kind": "text", "text": "Hi!"}, "no strokes for ! i"),
        ({"kind": "text", "text": " "}, "cannot be drawn"),
        ({"kind": "text", "text": False}, "write it in quotes"),
        ({"kind": "text", "depth": -1}, "depth must be 0 or above"),
        ({"kind": "person", "arms": 200}, "arms must lie in 0 … 180"),
    ],
)
def test_configs_that_make_no_sense_are_explained(config, words):
    with pytest.raises(UserError, match=words):
        bodies_from([config])


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "torus", "bend", "text", "person"])
def test_cells_too_fine_to_hold_are_refused(kind):
    with pytest.raises(UserError, match=r"cell=1e-06 cuts .* pieces; 2000 are the most"):
        body_from({"kind": kind, "cell": 1e-6}).shape()


def test_textures_too_fine_to_cut_are_refused():
    fine = Plate(texture="stripes", albedo=(0.2, 0.9), period=0.001)
    with pytest.raises(UserError, match="600 steps across the body; give 500 at most"):
        fine.mesh()


def test_a_line_names_what_differs_from_the_defaults():
    line = one_line([Torus(tube=0.05, turn=(0, 30, 0)), Text(text="NO")])
    assert line == "bodies=[{kind: torus, turn: [0, 30, 0], tube: 0.05}, {kind: text, text: 'NO'}]"


def test_the_page_names_every_kind_and_key_with_its_default():
    page = (ROOT / "docs" / "simulator.md").read_text(encoding="utf-8")
    rows = {row.split("|")[1].strip(" `"): row for row in page.splitlines() if row.startswith("| `")}
    shared = {field.name for field in dataclasses.fields(Body)}
    assert shared <= set(rows)
    for body in BODIES:
        for field in dataclasses.fields(body):
            default = f"{field.default:g}" if isinstance(field.default, float) else field.default
            assert field.name in shared or f"`{field.name}: {default}`" in rows[body.kind]
