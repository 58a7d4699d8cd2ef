"""What every effect must keep to: :class:`EffectContract` runs over the registry."""

from __future__ import annotations

import re
from functools import lru_cache

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from nlos_lit.capture import Capture
from nlos_lit.capture.errors import UserError
from nlos_lit.capture.scan import Scan
from nlos_lit.effects import EFFECTS
from nlos_lit.effects.effect import STAGES, Effect
from nlos_lit.effects.extension import Extension
from nlos_lit.effects.free_terms import FREE_NAMES
from nlos_lit.effects.hooks import HOOKS
from nlos_lit.effects.nominal import numbers_of
from nlos_lit.effects.page import sections
from nlos_lit.effects.strengths import effects_at
from nlos_lit.functional.compiled import tensor_by_tensor
from nlos_lit.model.parameters import BoundedParameter
from nlos_lit.surfels.model import Lateral, SurfelModel, spline_sensor

BIN, T_START, GATE, SPOTS = 0.02, 0.62, (6, 64), 10
HOOKS_OF_STAGE = {
    "path": {"path", "transients"},
    "time": {"time", "path", "walls"},
    "response": {"response"},
    "spot": {"gain", "background"},
    "counting": {"counting"},
}


def capture(kind: str) -> Capture:
    """Ten scattered spots, ``confocal``, ``single`` (one laser point) or ``exhaustive`` (both points vary);
    64 bins.
    """
    rng = np.random.default_rng(5)
    wall = rng.uniform(-0.4, 0.4, (2, SPOTS, 3)) * [1, 0.7, 0] + [0.1, -0.05, 0]
    laser = {
        "confocal": wall[0],
        "single": np.broadcast_to([0.2, 0.1, 0.0], (SPOTS, 3)),
        "exhaustive": wall[1],
    }[kind]
    up = np.broadcast_to([0.0, 0.0, 1.0], (SPOTS, 3))
    counts = rng.poisson(20, (SPOTS, GATE[1])).astype(np.uint16)
    order = rng.permutation(SPOTS)
    return Capture(
        counts, laser, wall[0], up, up, bin_length=BIN, t_start=T_START, gate=GATE, scan_order=order
    )


def surfels(scene: Capture) -> SurfelModel:
    """Twelve surfels on the two sides of a valley."""
    rng = np.random.default_rng(6)
    xy = rng.uniform(-0.25, 0.25, (12, 2))
    centre = np.column_stack([xy, 0.7 - 0.8 * np.abs(xy[:, 0])])
    normal = np.column_stack([-0.6 * np.sign(xy[:, 0]), 0.1 * xy[:, 1], np.full(12, -0.75)])
    sensor = spline_sensor(
        scene,
        {
            "sigma_ls": BoundedParameter(1.1 * BIN, 0.59 * BIN, 3 * BIN, "m"),
            "kappa_s": BoundedParameter(0.6 / BIN, 0.1 / BIN, 50 / BIN, "1/m"),
            "intensity": BoundedParameter(2000.0, 1.0, 1e5, "counts m2"),
            "background": BoundedParameter(0.4, 1e-3, 10.0, "counts/bin"),
        },
    )
    return SurfelModel(
        scene,
        centre=torch.tensor(centre),
        normal=torch.tensor(normal),
        albedo=torch.tensor(rng.uniform(0.3, 1.2, 12)),
        lateral=Lateral((-0.5, -0.5), (0.08, 0.08), (13, 13)),
        laser_sensor=sensor,
    )


@lru_cache
def scene(kind: str) -> tuple[SurfelModel, Scan]:
    measured = capture(kind)
    return surfels(measured), Scan.of(measured)


class Rendered(nn.Module):
    """A model with one effect: ``[B, T_gate]`` expected counts."""

    def __init__(self, model: SurfelModel, effect: Effect) -> None:
        super().__init__()
        self.model, self.extension = model, Extension([effect])

    def forward(self, spots: Tensor) -> Tensor:
        return self.model.render(spots, self.extension)


def probe(shape: torch.Size, seed: int = 1) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def away(effect: Effect) -> Effect:
    """Every parameter well away from its null, at the typical strength if there is one; shapes off grids."""
    effect.draw(effect.typical(effect.scan), np.random.default_rng(3))
    for p in effect.shapes:
        effect.set(p.name, 1.013 * p.grid[len(p.grid) // 2])
    for p in effect.amplitudes:
        if bool((effect.value(p.name) == p.null).all()):
            effect.set(p.name, p.null + p.scale * (1 if p.upper > p.null else -1))
    return effect


@pytest.mark.filterwarnings("ignore:.torch.jit.script. is deprecated:DeprecationWarning")
class EffectContract:
    """A subclass has a fixture ``built``: the effect's class, which is in the registry."""

    @pytest.fixture(params=["confocal", "exhaustive"])
    def model(self, request: pytest.FixtureRequest) -> SurfelModel:
        return scene(request.param)[0]

    @pytest.fixture
    def at_null(self, built: type[Effect], model: SurfelModel) -> Effect:
        return built(next(scan for one, scan in map(scene, ("confocal", "exhaustive")) if one is model))

    @pytest.fixture
    def fresh(self, at_null: Effect) -> Effect:
        """The effect away from its null."""
        return away(at_null)

    spots = torch.arange(SPOTS)

    def test_declaration(self, at_null: Effect) -> None:
        assert at_null.stage in STAGES
        assert at_null.needs_paths == (at_null.stage in ("path", "time"))
        assert at_null.hooks
        assert at_null.hooks <= HOOKS
        assert at_null.hooks <= HOOKS_OF_STAGE[at_null.stage]
        assert at_null.amplitudes
        for p in at_null.declared.values():
            assert p.lower < p.upper
            assert p.scale > 0
            assert (p.null is None) == bool(p.grid)
            assert p.lower <= (p.grid[0] if p.null is None else p.null) <= p.upper
        if at_null.per_spot:
            assert [p.size for p in at_null.amplitudes] == [SPOTS]
            assert all(p.size == 1 for p in at_null.shapes)
        if at_null.witness == "energy":
            assert "gain" in at_null.hooks
        if at_null.witness == "tail":
            assert at_null.declared["decay"].unit == "m"
        if at_null.witness == "delay":
            assert at_null.per_spot
            assert at_null.declared["offset"].unit == "m"

    def test_docstring(self, built: type[Effect]) -> None:
        told = sections(built)
        assert set(told) == {"what", "equation", "Parameters", "Signature", "Degenerate with", "Source"}
        assert all(told.values())
        assert "`" in told["equation"]
        for name in numbers_of(built):
            assert f"`{name}`" in told["Parameters"], name

    def test_words(self, built: type[Effect]) -> None:
        assert built.words is not None
        assert built.words.phrase[0].islower()
        for sentence in (built.words.cause, built.words.remedy):
            assert sentence.endswith(".")
        fields = set(re.findall(r"{(\w+)}", built.words.headline))
        assert fields
        assert fields <= set(numbers_of(built))

    def test_what_would_tell_it_apart_is_said_once_of_each_pair(self, built: type[Effect]) -> None:
        for other, measurement in built.split_by.items():
            there = EFFECTS.named(other)
            assert there is not None, f"{other} is not in the registry"
            assert built.name not in there.split_by
            assert EFFECTS.splitting(built.name, other) == EFFECTS.splitting(other, built.name) == measurement

    def test_which_free_terms_do_what_it_does(self, built: type[Effect]) -> None:
        assert set(built.followed_by) <= FREE_NAMES
        assert bool(built.followed_by) != built.per_spot, "but for numbers of single spots there are some"

    def test_typical_strength(self, at_null: Effect) -> None:
        """It can be given, as each of its numbers alone can, and says what was given."""
        typical, settable = at_null.typical(at_null.scan), at_null.settable()
        assert typical
        assert set(typical) <= set(settable)
        shapes = {p.name for p in at_null.shapes}
        assert set(typical).isdisjoint(shapes), "shapes are at the middle of their grids"
        null = {name: value.clone() for name, value in at_null.state_dict().items()}
        at_null.draw(typical, np.random.default_rng(0))
        assert any(not torch.equal(value, null[name]) for name, value in at_null.state_dict().items())
        numbers = at_null.quantities()
        for name in set(settable) & set(numbers):
            assert numbers[name].unit == settable[name], name
        (again,) = effects_at([at_null.name], {}, at_null.scan, seed=1)
        (same,) = effects_at([at_null.name], {}, at_null.scan, seed=1)
        for name, value in again.state_dict().items():
            assert torch.equal(value, same.state_dict()[name])

    def test_too_strong_is_refused(self, at_null: Effect) -> None:
        for name in at_null.typical(at_null.scan):
            with pytest.raises(UserError, match=rf"{at_null.name}\.{name} must"):
                effects_at([at_null.name], {f"{at_null.name}.{name}": 1e9}, at_null.scan)

    def test_numbers_do_not_hang_on_the_scan(self, built: type[Effect], at_null: Effect) -> None:
        with torch.no_grad():
            assert at_null.numbers() == numbers_of(built)

    def test_null_is_identity(self, model: SurfelModel, at_null: Effect) -> None:
        plain, changed = model.expected(self.spots), model.expected(self.spots, Extension([at_null]))
        assert torch.allclose(changed, plain, rtol=1e-6, atol=1e-6 * float(plain.max()))

    def test_values_change_the_image(self, model: SurfelModel, fresh: Effect) -> None:
        plain, changed = model.expected(self.spots), model.expected(self.spots, Extension([fresh]))
        assert float((changed - plain).abs().max()) > 1e-3 * float(plain.max())

    @pytest.mark.parametrize("where", ["null", "values"])
    def test_gradients(self, model: SurfelModel, at_null: Effect, where: str) -> None:
        """Backward against central differences and forward mode, for every parameter and surfels' depths."""
        effect = at_null if where == "null" else away(at_null)
        rendered = _double(model, effect)
        weights = probe(rendered(self.spots).shape)
        names = [
            f"extension.effects.0.raw_{p.name}"
            for p in (effect.amplitudes if where == "null" else effect.declared.values())
        ]
        for name in [*names, "model.raw_depth"]:
            value = rendered.get_parameter(name)
            direction = probe(value.shape, seed=2).sign() * (0.1 if name == "model.raw_depth" else 1.0)
            start, direction = value.detach().clone(), direction.to(value.dtype)

            def along(
                v: Tensor,
                rendered: Rendered = rendered,
                name: str = name,
                start: Tensor = start,
                direction: Tensor = direction,
            ) -> Tensor:
                return torch.func.functional_call(rendered, {name: start + v * direction}, (self.spots,))

            (gradient,) = torch.autograd.grad((rendered(self.spots) * weights).sum(), value)
            backward = float((gradient * direction).sum())
            zero, one = torch.zeros((), dtype=torch.float64), torch.ones((), dtype=torch.float64)
            with tensor_by_tensor():
                forward = torch.func.jvp(along, (zero,), (one,))[1].detach()
            with torch.no_grad():
                difference = (along(zero + 2e-3) - along(zero - 2e-3)) / 4e-3
            size = float(difference.abs().max())
            assert float((forward - difference).abs().max()) < 3e-3 * size + 1e-6, name
            assert backward == pytest.approx(
                float((forward * weights).sum()), rel=1e-5, abs=1e-5 * size + 1e-9
            ), name
            assert where == "values" or name == "model.raw_depth" or size > 0, f"{name} does nothing"

    def test_finite_and_not_negative_over_the_bounds(self, model: SurfelModel, at_null: Effect) -> None:
        for end in ("lower", "upper"):
            for shapes in (
                at_null.shape_grid()[0],
                at_null.shape_grid()[-1],
                dict.fromkeys(at_null.shape_grid()[0]),
            ):
                for p in at_null.declared.values():
                    value = shapes.get(p.name)
                    at_null.set(p.name, getattr(p, end) if value is None else value)
                changed = model.expected(self.spots, Extension([at_null]))
                assert torch.isfinite(changed).all()
                assert float(changed.min()) >= -1e-6 * float(changed.max())

    def test_a_batch_is_its_spots_one_by_one(self, model: SurfelModel, fresh: Effect) -> None:
        batch, extension = torch.tensor([7, 0, 3]), Extension([fresh])
        single = torch.cat([model.expected(s[None], extension) for s in batch])
        whole = model.expected(batch, extension)
        assert torch.allclose(whole, single, rtol=1e-5, atol=1e-6 * float(whole.max()))

    def test_two_processes_see_what_one_sees(self, model: SurfelModel, fresh: Effect) -> None:
        """Counts and gradients of two shares of the spots are those of all."""
        extension, parameters = Extension([fresh]), list(fresh.parameters())
        weights = probe(model.expected(self.spots, extension).shape, seed=3).float()
        both = []
        for shares in ([self.spots], [self.spots[::2], self.spots[1::2]]):
            total = sum((model.render(s, extension) * weights[s]).sum() for s in shares)
            both.append(torch.cat([g.reshape(-1) for g in torch.autograd.grad(total, parameters)]))
        assert torch.allclose(both[0], both[1], rtol=1e-4, atol=1e-4 * float(both[0].abs().max()))

    def test_clamp_keeps_the_bounds(self, fresh: Effect) -> None:
        for sign in (-1e3, 1e3):
            with torch.no_grad():
                for parameter in fresh.parameters():
                    parameter.fill_(sign)
            fresh.clamp()
            for p in fresh.declared.values():
                value = fresh.value(p.name)
                slack = 1e-5 * max(abs(p.lower), abs(p.upper))
                assert float(value.detach().min()) >= p.lower - slack
                assert float(value.detach().max()) <= p.upper + slack

    def test_scanned_shapes_lie_in_their_bounds(self, at_null: Effect) -> None:
        grid = at_null.shape_grid()
        assert len(grid) <= 220 or type(at_null).likely_shapes is not Effect.likely_shapes
        for p in at_null.shapes:
            assert all(p.lower <= combination[p.name] <= p.upper for combination in grid)
        assert set(grid[0]) == {p.name for p in at_null.shapes}

    def test_quantities(self, fresh: Effect) -> None:
        """Finite at values and at the null, with units; differentiable."""
        for _ in range(2):
            quantities = fresh.quantities()
            assert quantities
            for name, quantity in quantities.items():
                assert quantity.unit, name
                assert torch.isfinite(quantity.value), name
                if quantity.value.requires_grad:
                    gradients = torch.autograd.grad(
                        quantity.value, list(fresh.parameters()), allow_unused=True, retain_graph=True
                    )
                    assert all(torch.isfinite(g).all() for g in gradients if g is not None), name
            fresh.reset()

    def test_state_restores_the_effect(self, model: SurfelModel, fresh: Effect) -> None:
        again = type(fresh)(fresh.scan)
        again.load_state_dict(fresh.state_dict())
        assert torch.equal(
            model.render(self.spots, Extension([again])), model.render(self.spots, Extension([fresh]))
        )


def _double(model: SurfelModel, effect: Effect) -> Rendered:
    measured = capture("confocal" if model.confocal else "exhaustive")
    copy = surfels(measured)
    copy.load_state_dict(model.state_dict())
    return Rendered(copy, effect).double()


def registered(name: str) -> type[Effect]:
    effect = EFFECTS.named(name)
    assert effect is not None
    return effect
