"""Score tests of every effect at its null, without a refit: which would explain the residual, after all the
base can do itself?

With weighted columns ``X`` (nuisance), ``Z`` (effect) and residual ``r`` (:mod:`nlos_lit.inference.problem`),
projected off the nuisance, ``Z⊥ = Z - X(XᵀX + Λ)⁻¹XᵀZ`` and ``r⊥`` likewise:

    score s = Z⊥ᵀ r⊥,  information F = Z⊥ᵀ Z⊥,  statistic sᵀ F⁻¹ s,  one-step estimate F⁻¹ s.

The *predicted gain* is cross-validated over wall blocks: θ from all other blocks, its gain θᵀs_b - ½ θᵀF_bθ
in nats on block b. It weighs effects with one and with thirty coefficients on the same scale, and misfit that
is not the effect's does not transfer. (C. R. Rao's score test; the projection is the efficient score, e.g.
van der Vaart, *Asymptotic Statistics*, ch. 25.)
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import torch
from scipy import stats
from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.inference.per_spot import best_width, coefficients, sparse
from nlos_lit.inference.problem import Problem, weighted_columns

FOLDS = 6
KEPT = 16  # shapes of one effect that are tested in full
TOGETHER = 128  # columns from which on no more effects are projected along
Tried = tuple[Effect, list[tuple[dict[str, float], Tensor]]]
PRIOR_SCALES = (1.0, 0.25)  # of the deviations of priors on coefficients


@dataclass(frozen=True)
class Candidate:
    """One effect (at its best shape) as the score test sees it.

    ``gain`` nats, cross-validated; ``step`` ``[k]`` one-step change of the stored amplitudes; ``direction``
    ``[N]`` unit vector: what the step changes, projected off the nuisance, for comparison with rivals.
    ``beside`` ``[P]``: what the base does at the same time, coefficients of the nuisance columns; None where
    that is not known.
    """

    effect: Effect
    statistic: float
    p_value: float
    retained: float
    gain: float
    step: Tensor
    error: Tensor
    shape: dict[str, float]
    direction: Tensor = field(repr=False)
    beside: Tensor | None = field(default=None, repr=False)

    @property
    def degrees(self) -> int:
        """Of freedom: width and share of a per-spot effect, else one an amplitude."""
        return 2 if self.effect.per_spot else len(self.step)


class Projector:
    """Takes from any columns what the base can explain by itself."""

    def __init__(self, problem: Problem, ridge: float = 1e-6) -> None:
        x = problem.nuisance
        gram = half_products(x).double()
        if not bool(torch.isfinite(gram).all()):
            raise ValueError("the model's sensitivities are not finite: this fit cannot be criticised")
        diagonal = gram.diagonal().clone().clamp_min(float(gram.diagonal().mean()) * 1e-6)
        failed = 1
        while failed:  # single-precision products of nearly dependent columns may need more
            self.factor, failed = torch.linalg.cholesky_ex(
                gram + torch.diag(problem.prior.double() + ridge * diagonal)
            )
            ridge *= 10
        self.nuisance = x
        residual, own = self.apart(problem.residual[:, None])
        self.residual, self.own = (
            residual[:, 0],
            own[:, 0],
        )  # own [P]: the step that the base asks for by itself

    def off(self, columns: Tensor) -> Tensor:
        """``columns`` ``[N, k]`` without their projection on the nuisance."""
        return self.apart(columns)[0]

    def apart(self, columns: Tensor) -> tuple[Tensor, Tensor]:
        """:meth:`off`, and the coefficients ``[P, k]`` of the nuisance that were taken off."""
        weights = torch.cholesky_solve((self.nuisance.T @ columns).double(), self.factor).float()
        return columns - self.nuisance @ weights, weights


def half_products(x: Tensor, block: int = 512) -> Tensor:
    """``xᵀx`` with little more than half of its multiplications, which are most of a screening's work.

    Args:
        x: ``[N, P]``.
        block: columns at a time.

    Returns:
        ``[P, P]``.

    Examples:
        >>> half_products(torch.tensor([[1.0, 2.0], [3.0, 4.0]]), block=1)
        tensor([[10., 14.],
                [14., 20.]])
    """
    gram = x.new_empty(x.shape[1], x.shape[1])
    for start in range(0, x.shape[1], block):
        part = x[:, start:].T @ x[:, start : start + block]
        gram[start:, start : start + block] = part
        gram[start : start + block, start:] = part.T
    return gram


def screen(problem: Problem, projector: Projector, effects: list[Effect], folds: Tensor) -> list[Candidate]:
    """Test every effect; the largest predicted gain first.

    Args:
        problem: of the tested spots.
        projector: takes off what the base can explain.
        effects: at their nulls; they stay there.
        folds: ``[S]`` number of the fold (0 … FOLDS-1) that each spot's wall block belongs to.

    Returns:
        one candidate an effect, with a copy of it at its best shape.
    """
    effects = [copy.deepcopy(e) for e in effects]
    found = [_per_spot(problem, projector, e) for e in effects if e.per_spot]
    others = (e for e in effects if not e.per_spot)
    for group in _groups((e, _worthwhile(problem, projector, e)) for e in others):
        raw = torch.cat([columns for _, kept in group for _, columns in kept], 1)
        z, weights = projector.apart(raw)
        start = 0
        for effect, kept in group:
            tested = []
            for shape, columns in kept:
                part = slice(start, start := start + columns.shape[1])
                tested.append((shape, columns, z[:, part].contiguous(), weights[:, part]))
            found.append(_score(problem, projector, effect, tested, folds))
    return sorted(found, key=lambda c: -c.gain)


def _groups(tried: Iterable[Tried]) -> Iterator[list[Tried]]:
    """Effects whose columns are projected together.

    A projection passes over all nuisance columns, however few it projects.
    """
    group, width = [], 0
    for effect, kept in tried:
        group.append((effect, kept))
        width += sum(columns.shape[1] for _, columns in kept)
        if width >= TOGETHER:
            yield group
            group, width = [], 0
    if group:
        yield group


def _score(
    problem: Problem,
    projector: Projector,
    effect: Effect,
    tested: list[tuple[dict[str, float], Tensor, Tensor, Tensor]],
    folds: Tensor,
) -> Candidate:
    """The best shape's score test; its p-value pays for the shapes tried.

    ``tested``: shape, its columns, its projected columns, what was taken off them.
    """
    shapes = effect.shape_grid()
    spots, bins = problem.expected.shape
    lower, upper = _bounds(effect)
    prior = effect.precision()[: len(lower)].double()
    scales = PRIOR_SCALES if bool(prior.any()) else (1.0,)
    best: Candidate | None = None
    for shape, raw, z, weights in tested:
        k = z.shape[1]
        by_spot = z.view(spots, bins, k)
        score = torch.einsum("sbk,sb->sk", by_spot, projector.residual.view(spots, bins)).double()
        information = torch.einsum("sbk,sbl->skl", by_spot, by_spot).double()
        s = torch.zeros(FOLDS, k, dtype=torch.float64).index_add_(0, folds, score)
        f = torch.zeros(FOLDS, k, k, dtype=torch.float64).index_add_(0, folds, information)
        whole = (raw.T @ raw).double()
        total = f.sum(0)
        floor = torch.diag(1e-9 * whole.diagonal() + 1e-30)
        gain, scale = max(
            (_predicted(s, f, floor + torch.diag(prior / scale**2), lower, upper), scale) for scale in scales
        )
        if best is None or gain > best.gain:
            effect.prior_scale = scale
            known = total + floor + torch.diag(prior / scale**2)
            step = torch.linalg.solve(known, s.sum(0)).clamp(lower, upper)
            free = torch.linalg.solve(total + floor, s.sum(0)).clamp(lower, upper)
            # Bounds may spoil a free step whose coefficients balance one another: the held-back one then says
            # more.
            statistic = max(0.0, *(float(2 * t @ s.sum(0) - t @ total @ t) for t in (free, step)))
            retained = float(torch.linalg.solve(whole + floor, total).diagonal().mean())
            p = min(1.0, len(shapes) * float(stats.chi2.sf(statistic, k)))
            direction = (z @ step.float()) if float(step.abs().max()) > 0 else z.sum(1)
            direction = direction / direction.norm().clamp_min(1e-30)
            error = torch.linalg.inv(known).diagonal().sqrt()
            beside = projector.own - weights @ step.float()
            best = Candidate(
                effect, statistic, p, retained, gain, step.float(), error.float(), shape, direction, beside
            )
    assert best is not None  # every effect has a shape, though it be empty
    effect.set_all(best.shape)
    return best


def _bounds(effect: Effect) -> tuple[Tensor, Tensor]:
    """``[k]`` least and largest steps of the stored amplitudes from their nulls."""
    lower, upper = [], []
    for p in effect.amplitudes:
        assert p.null is not None  # what makes an amplitude
        lower.append(torch.full((p.size,), (p.lower - p.null) / p.scale))
        upper.append(torch.full((p.size,), (p.upper - p.null) / p.scale))
    return torch.cat(lower).double(), torch.cat(upper).double()


def _predicted(score: Tensor, information: Tensor, ridge: Tensor, lower: Tensor, upper: Tensor) -> float:
    """Nats that each fold ``[FOLDS, k]`` gains by the step that the others ask for, added up."""
    whole, every, gain = information.sum(0), score.sum(0), 0.0
    for s, f in zip(score, information, strict=True):
        step = torch.linalg.solve(whole - f + ridge, every - s).clamp(lower, upper)
        gain += float(step @ s - 0.5 * step @ f @ step)
    return gain


def _worthwhile(
    problem: Problem, projector: Projector, effect: Effect
) -> list[tuple[dict[str, float], Tensor]]:
    """The ``KEPT`` most promising shapes with their columns.

    Zᵀr⊥ is the score already; only the information needs the projection, whose passes over all of X are what
    costs. So shapes are ranked by the score over the unprojected information.
    """
    shapes, ranked = effect.shape_grid(), []
    for shape in shapes:
        effect.set_all(shape)
        z = weighted_columns(problem, effect)
        score, information = (z.T @ projector.residual).double(), (z.T @ z).double()
        floor = 1e-9 * information.diagonal().mean() + 1e-30
        worth = float(score @ torch.linalg.solve(information + floor * torch.eye(len(score)), score))
        ranked.append((worth, shape, z if len(shapes) <= KEPT else None))
    ranked.sort(key=lambda entry: -entry[0])
    kept = []
    for _, shape, known in ranked[:KEPT]:
        effect.set_all(shape)
        kept.append((shape, weighted_columns(problem, effect) if known is None else known))
    return kept


def _per_spot(problem: Problem, projector: Projector, effect: Effect) -> Candidate:
    """One random coefficient a spot: do the spots' own scores scatter more than counts alone let them?"""
    column = weighted_columns(problem, effect)[:, 0].view(problem.expected.shape)
    score = (column * projector.residual.view_as(column)).sum(1).double()
    information = (column**2).sum(1).double().clamp_min(1e-30)
    positive = sparse(effect)
    gain, effect.width, effect.share = best_width(score, information, positive)
    full = torch.zeros(len(problem.model.laser))
    full[problem.spots] = coefficients(score, information, effect.width, positive).float()
    error = torch.full_like(full, float("nan"))
    error[problem.spots] = information.rsqrt().float()
    direction = (column * full[problem.spots, None]).reshape(-1)
    direction = direction / direction.norm().clamp_min(1e-30)
    p = float(stats.chi2.sf(2 * gain, 1 + positive))
    beside = projector.apart((problem.residual - (column * full[problem.spots, None]).reshape(-1))[:, None])[
        1
    ][:, 0]
    return Candidate(effect, 2 * gain, p, 1.0, gain, full, error, {}, direction, beside)
