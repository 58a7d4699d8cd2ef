"""How much the counts ask for a term of the model, after all that the scene can do itself: one number in nats
for a scalar, a map, a number for each spot and a free axis.

With weighted columns ``X`` (scene, response, effects that are there), ``Z`` (the term) and residual ``r``
(:mod:`nlos_lit.inference.problem`), all projected off X, the term's coefficients c ~ N(0, τ²C) have the log
Bayes factor against none

    ½ Σ_i [τ² w_i / (1 + τ² λ_i) - ln(1 + τ² λ_i)],

λ_i the eigenvalues of the information ``C^½ Z⊥ᵀZ⊥ C^½``, w_i the squares of the scores in its eigenbasis. τ
is where it is largest (type-II likelihood; M. Tipping, *JMLR* 1, 2001). Scanned shapes are equally likely
beforehand, so that the mean of their Bayes factors counts. Coefficients stay within their bounds: one that
cannot be negative has no evidence where the counts want it to be.

What X may do only so much of has a prior, N(0, 1/p). It is one more row of X, √p in its own column and 0 in
Z and r: least squares with that row is the posterior mean, and the projections of Z and r keep what they
would ask of it. (Without that row Z⊥ᵀZ⊥ counts the prior twice.)

How uneven the scene's patches look from the wall, U, is a random effect like a term: its coefficients are
N(0, u²), and u is where the likelihood is largest, without the term and with it. The first is what the
second is held against: light that changes over the wall alike for all patches is cheaper as a gain of the
wall than as what each patch happens to do, the more so the more even the scene is.

A base that is wrong in places leaves scores that no common coefficient explains. Their scatter φ_i, where it
exceeds that of counts, divides scores and information (the sandwich of P. Huber, 1967, and of K.-Y. Liang and
S. Zeger, *Biometrika* 73, 1986). It is the larger of two: between wall blocks, and between the parts of each
block that are early, later and late. The second holds maps over the wall and numbers of single spots to
account, which could follow any block: what scales a spot's light scales all of it. A prior's row is a block
by itself: what several patches of the scene would all have to do counts for a term, what one would, against.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nlos_lit.effects.effect import Effect
from nlos_lit.functional.log_factor import log_factor
from nlos_lit.inference.problem import Problem

SEGMENTS = 4  # parts of a wall block along time
VARIANCES = np.exp(np.linspace(-14.0, 8.0, 45))  # τ² that are tried, of C
ROUNDS, LEAST = 30, 0.01  # of several widths that are improved, and the least over τ
UNEVENNESS = np.exp(np.linspace(math.log(2e-3), math.log(0.5), 24))  # u that are tried


class Rows(NamedTuple):
    """One weighted least-squares problem: what a :class:`~nlos_lit.inference.problem.Problem` holds of it."""

    nuisance: Tensor  # [N, P] X
    prior: Tensor  # [P] precision of each of its coefficients
    uneven: Tensor  # [N, Q] U
    residual: Tensor  # [N]
    lit: Tensor  # [n ≤ N] share of the scene's light in each row of bins


class Freed(NamedTuple):
    """Columns without what the base can explain of them."""

    z: Tensor  # [N + H, k] Projector.free
    across: Tensor  # [Q, k] Projector.along of z
    off: Tensor  # [N + H + Q, k] Projector.even of z, at the width without any term


class Projector:
    """Takes from any columns what the base can explain by itself.

    In two steps: :meth:`free` takes off what is free or has a known prior, :meth:`even` what patches of the
    scene do by looking uneven, with one of the deviations ``UNEVENNESS``. Columns grow by a row for each
    nuisance column that has a prior, then by one for each column of U.

    Attributes:
        width: which of ``UNEVENNESS`` the counts ask for without any term. levels: nats of each below it.
        residual: after both steps, at that width.
    """

    def __init__(self, problem: Problem | Rows, ridge: float = 1e-6) -> None:
        x = problem.nuisance
        gram = half_products(x).double()
        if not bool(torch.isfinite(gram).all()):
            raise ValueError("the model's sensitivities are not finite: this fit cannot be criticised")
        diagonal = gram.diagonal().clone()
        if len(gram):
            diagonal = diagonal.clamp_min(float(diagonal.mean()) * 1e-6)
        failed = 1
        while failed:  # single-precision products of nearly dependent columns may need more
            self.factor, failed = torch.linalg.cholesky_ex(
                gram + torch.diag(problem.prior.double() + ridge * diagonal)
            )
            ridge *= 10
        self.nuisance, self.lit, self.held = x, problem.lit, problem.prior.nonzero()[:, 0]
        self.strength = problem.prior[self.held, None].sqrt()
        self.uneven, self.left = self.free(problem.uneven), self.free(problem.residual[:, None])
        values, self.axes = torch.linalg.eigh((self.uneven.T @ self.uneven).double())
        self.values = values.clamp_min(0.0)
        self.variances = torch.from_numpy(UNEVENNESS**2)
        self.asked = self.along(self.left)[:, 0]
        levels = log_factor(self.values, self.asked**2, self.variances)
        self.width = int(levels.argmax())
        self.levels = levels - levels[self.width]
        self.residuals: dict[int, Tensor] = {}
        self.residual = self.residual_at(self.width)

    def beside(self, columns: Tensor, precision: Tensor, residual: Tensor | None = None) -> Projector:
        """Takes off some terms, too; its columns are :meth:`free` of this one.

        Args:
            columns: ``[N + H, k]`` of the terms, :meth:`free`; there may be none.
            precision: ``[k]`` of their coefficients' prior.
            residual: ``[N + H]`` in place of this one's.

        Returns:
            another projector.
        """
        left = self.left[:, 0] if residual is None else residual
        return Projector(Rows(columns, precision, self.uneven, left, self.lit))

    def free(self, columns: Tensor) -> Tensor:
        """``[N + H, k]``: ``columns`` ``[N, k]`` without their projection on the nuisance."""
        weights = torch.cholesky_solve((columns.T @ self.nuisance).T.double(), self.factor).float()
        return _less(columns, self.nuisance, weights, self.strength * weights[self.held])

    def even(self, z: Tensor, width: int, across: Tensor | None = None) -> Tensor:
        """Without what patches do that look uneven.

        Args:
            z: ``[N + H, k]`` :meth:`free` columns.
            width: how uneven, an index of ``UNEVENNESS``.
            across: ``[Q, k]`` :meth:`along` of z, where it is known.

        Returns:
            ``[N + H + Q, k]``.
        """
        variance = self.variances[width]
        shrink = variance / (1 + variance * self.values)
        weights = (self.axes @ (shrink[:, None] * (self.along(z) if across is None else across))).float()
        return _less(z, self.uneven, weights, weights / variance.sqrt().float())

    def freed(self, columns: Tensor) -> Freed:
        """``columns`` ``[N, k]`` after both steps, at the width without any term.

        Each step passes over all of X, or of U, however few columns are given.
        """
        z = self.free(columns)
        across = self.along(z)
        return Freed(z, across, self.even(z, self.width, across))

    def off(self, columns: Tensor) -> Tensor:
        """``[N + H + Q, k]``: ``columns`` ``[N, k]`` after both steps, at the width without any term."""
        return self.freed(columns).off

    def residual_at(self, width: int) -> Tensor:
        """``[N + H + Q]`` residual at another width."""
        if width not in self.residuals:
            self.residuals[width] = self.even(self.left, width)[:, 0]
        return self.residuals[width]

    def width_beside(self, z: Tensor, across: Tensor, deviation: Tensor) -> int:
        """How uneven patches look beside a term.

        Args:
            z: ``[N + H, k]`` :meth:`free` columns of the term.
            across: ``[Q, k]`` :meth:`along` of z.
            deviation: ``[k]`` C^½.

        Returns:
            which of ``UNEVENNESS`` the counts ask for.
        """
        across, scale = across * deviation, torch.outer(deviation, deviation)
        shrink = self.variances[:, None] / (1 + self.variances[:, None] * self.values)
        information = (z.T @ z).double() * scale - torch.einsum("qk,vq,ql->vkl", across, shrink, across)
        score = (z.T @ self.left)[:, 0].double() * deviation - (shrink * self.asked) @ across
        values, vectors = torch.linalg.eigh(information)
        values = values.clamp_min(1e-12 * float(values.max().clamp_min(1e-30)))
        squares = torch.einsum("vk,vkl->vl", score, vectors) ** 2
        nats = log_factor(values, squares, torch.from_numpy(VARIANCES)).amax(1)
        return int((self.levels + nats).argmax())

    def along(self, z: Tensor) -> Tensor:
        """Scores ``[Q, k]`` of the uneven columns' eigenvectors, of ``[N + H, k]`` :meth:`free` columns."""
        return self.axes.T @ (z.T @ self.uneven).T.double()


def _less(columns: Tensor, x: Tensor, weights: Tensor, further: Tensor) -> Tensor:
    """``[N + n, k]`` ``columns`` ``[N, k]`` less x @ weights, and 0 less ``further`` ``[n, k]``."""
    found = columns.new_empty(len(columns) + len(further), columns.shape[1])
    torch.addmm(columns, x, weights, alpha=-1, out=found[: len(columns)])
    torch.neg(further, out=found[len(columns) :])
    return found


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


@dataclass(frozen=True)
class Evidence:
    """What one term at one shape is worth.

    Args:
        nats: log Bayes factor against no such term; at least 0, which τ = 0 gives.
        scale: τ.
        step: ``[k]`` posterior mean of the stored amplitudes' change.
        error: ``[k]`` standard deviation of each by counts alone, where the others stay as they are.
        retained: share of the term's information that the base cannot imitate.
        scatter: φ, mean over the directions weighted by their scores.
        loud: nats if all of the scatter were the term's own.
        lit: share of what is left of its information that lies where the scene's light falls.
        relative: ``[k]`` deviations that the counts ask for over τC^½, where groups of coefficients may have
            widths of their own; the step is that of these.
    """

    nats: float
    scale: float
    step: Tensor = field(repr=False)
    error: Tensor = field(repr=False)
    retained: float
    scatter: float
    loud: float
    lit: float = 1.0
    relative: Tensor | None = field(default=None, repr=False)


def prior_deviations(effect: Effect) -> Tensor:
    """``[k]`` deviations C^½ of the stored amplitudes at τ = 1: of their prior, else a noticeable step."""
    known = [torch.tensor(p.prior) / p.scale if p.prior else torch.ones(p.size) for p in effect.amplitudes]
    return torch.cat(known).double()


def evidence(
    raw: Tensor,
    z: Tensor,
    residual: Tensor,
    block: Tensor,
    deviation: Tensor,
    bounds: tuple[Tensor, Tensor] | None = None,
    width_of: Tensor | None = None,
) -> Evidence:
    """The log Bayes factor of a term, the base projected off.

    Args:
        raw: ``[S, T, k]`` weighted columns.
        z: ``[S·T + Q, k]``, the same with the base projected off.
        residual: ``[S·T + Q]``, projected.
        block: ``[S]`` number of each spot's wall block.
        deviation: ``[k]`` C^½.
        bounds: ``[k]`` least and largest coefficients.
        width_of: ``[k]`` which of them have a width in common; None where all have.

    Returns:
        what the counts say of it.
    """
    z, rows = z * deviation.float(), raw.shape[0] * raw.shape[1]
    s, f = by_cells(z[:rows].view(raw.shape), residual[:rows].view(raw.shape[:2]), block)
    last = len(s)
    held = z[rows:].double()
    s = torch.cat([s, held * residual[rows:, None]])
    f = torch.cat([f, held[:, :, None] * held[:, None]])
    values, vectors = torch.linalg.eigh(f.sum(0))
    values = values.clamp_min(1e-12 * float(values[-1].clamp_min(1e-30)))
    u, tried = s.sum(0) @ vectors, torch.from_numpy(VARIANCES)[:, None]

    def within(mean: Tensor, bounds: tuple[Tensor, Tensor] | None) -> Tensor:
        return mean if bounds is None else mean.clamp(bounds[0] / deviation, bounds[1] / deviation)

    def best(scatter: Tensor, bounds: tuple[Tensor, Tensor] | None) -> tuple[float, float, Tensor]:
        """Nats, τ² and the coefficients ``[k]``, where the likelihood counts as its φ-th root."""
        grown = 1 + tried * values / scatter
        mean = within((tried * u / scatter / grown) @ vectors.T, bounds)
        along = mean @ vectors
        gain = (along * u - 0.5 * values * along**2) / scatter - 0.5 * along**2 / tried
        nats = (gain - 0.5 * grown.log()).sum(1)
        k = int(nats.argmax())
        return (float(nats[k]), float(tried[k]), mean[k]) if nats[k] > 0 else (0.0, 0.0, torch.zeros_like(u))

    loud, _, mean = best(torch.ones_like(u), None)
    left = (s - f @ mean) @ vectors
    blocks = torch.cat([left[:last].view(-1, SEGMENTS, left.shape[1]).sum(1), left[last:]])
    scatter = torch.maximum(left.square().sum(0), blocks.square().sum(0)).div(values).clamp_min(1.0)
    share = u.square() / values
    nats, variance, mean = best(scatter, bounds)
    mean_scatter, relative = float((scatter * share).sum() / share.sum().clamp_min(1e-30)), None
    if width_of is not None and nats > 0:
        score, information = s.sum(0) / mean_scatter, f.sum(0) / mean_scatter
        mean, relative = by_width(score, information, width_of, variance)
        mean = within(mean, bounds)
    whole = raw.square().sum(1).double().sum(0) * deviation**2
    does = whole > 1e-12 * whole.max()  # coefficients that change anything at this shape
    return Evidence(
        nats=nats,
        scale=variance**0.5,
        step=(mean * deviation).float(),
        error=((vectors.square() @ (values / scatter)).rsqrt() * deviation).float(),
        retained=float((f.sum(0).diagonal() / whole)[does].mean()) if bool(does.any()) else 0.0,
        scatter=mean_scatter,
        loud=loud,
        relative=relative,
    )


def by_width(score: Tensor, information: Tensor, width_of: Tensor, variance: float) -> tuple[Tensor, Tensor]:
    """Coefficients whose groups have widths of their own, where the likelihood is largest.

    Args:
        score: ``[k]`` of coefficients that are all as likely beforehand.
        information: ``[k, k]`` of them.
        width_of: ``[k]`` number of each one's group.
        variance: τ², where all have one.

    Returns:
        ``[k]`` posterior means, and each one's deviation over τ; none is below a hundredth of it.

    Examples:
        Two that are 3 ± 0.1 and two that are nothing:

        >>> mean, relative = by_width(
        ...     torch.tensor([300.0, -300.0, 5.0, 5.0]).double(),
        ...     100 * torch.eye(4).double(),
        ...     torch.tensor([0, 0, 1, 1]),
        ...     4.0,
        ... )
        >>> mean.round(decimals=2).tolist(), relative.round(decimals=2).tolist()
        ([3.0, -3.0, 0.0, 0.0], [1.5, 1.5, 0.01, 0.01])
    """
    widths = score.new_full((int(width_of.max()) + 1,), variance)
    for _ in range(ROUNDS):
        prior = widths[width_of]
        covariance = torch.linalg.inv(information + torch.diag(prior.reciprocal()))
        mean = covariance @ score
        told = 1 - covariance.diagonal() / prior  # how much of each the counts settle
        squares = torch.zeros_like(widths).index_add_(0, width_of, mean.square())
        number = torch.zeros_like(widths).index_add_(0, width_of, told)
        widths = (squares / number.clamp_min(1e-12)).clamp_min(LEAST**2 * variance)
    return mean, (widths[width_of] / variance).sqrt()


def best_evidence(
    projector: Projector,
    raw: Tensor,
    freed: Freed,
    block: Tensor,
    deviation: Tensor,
    bounds: tuple[Tensor, Tensor] | None = None,
    width_of: Tensor | None = None,
) -> Evidence:
    """The log Bayes factor of a term, the scene as uneven as the counts ask for without it, or with it.

    Args:
        projector: of the base.
        raw: ``[S, T, k]`` weighted columns.
        freed: the same as :meth:`Projector.freed` leaves them.
        block: ``[S]`` number of each spot's wall block.
        deviation: ``[k]`` C^½.
        bounds: ``[k]`` least and largest coefficients.
        width_of: ``[k]`` which of them have a width in common; None where all have.

    Returns:
        what the counts say of it, at the width where they say most.
    """
    found, (z, across, known) = [], freed
    for width in sorted({projector.width, projector.width_beside(z, across, deviation)}):
        off = known if width == projector.width else projector.even(z, width, across)
        level = float(projector.levels[width])
        one = evidence(raw, off, projector.residual_at(width), block, deviation, bounds, width_of)
        found.append((replace(one, nats=one.nats + level, loud=max(0.0, one.loud + level)), off))
    best, off = max(found, key=lambda pair: pair[0].nats)
    return replace(best, lit=lit_share(off[: len(projector.lit)] * deviation.float(), projector.lit))


def lit_share(columns: Tensor, lit: Tensor) -> float:
    """Share of a term's information that lies where the scene's light falls.

    Args:
        columns: ``[N, k]`` weighted columns.
        lit: ``[N]`` share of the scene's light in each row.

    Returns:
        from 0 to 1.

    Examples:
        >>> round(lit_share(torch.tensor([[1.0], [2.0]]), torch.tensor([0.0, 1.0])), 3)
        0.8
    """
    told = columns.square().sum(1).double()
    return float(told @ lit.double() / told.sum().clamp_min(1e-30))


def by_cells(z: Tensor, residual: Tensor, block: Tensor) -> tuple[Tensor, Tensor]:
    """Scores and information of each part along time of each wall block.

    Args:
        z: ``[S, T, k]`` columns.
        residual: ``[S, T]``.
        block: ``[S]`` number of each spot's wall block.

    Returns:
        ``[C, k]`` and ``[C, k, k]``, the ``SEGMENTS`` parts of a block one after the other.

    Examples:
        Two spots of four bins, of blocks 1 and 0:

        >>> residual = torch.tensor([3.0, 5.0])[:, None].expand(2, 4)
        >>> scores, information = by_cells(torch.ones(2, 4, 1), residual, torch.tensor([1, 0]))
        >>> scores.view(2, SEGMENTS).sum(1).tolist(), information.view(2, SEGMENTS).sum(1).tolist()
        ([20.0, 12.0], [4.0, 4.0])
    """
    order, sizes = block.argsort(stable=True), torch.bincount(block).tolist()
    parts = [
        zip(each.split(sizes), left.split(sizes), strict=True)
        for each, left in segments(z[order], residual[order])
    ]
    s, f = list[Tensor](), list[Tensor]()
    for cells in zip(*parts, strict=True):
        for each, left in cells:
            rows = each.flatten(0, 1)
            s.append(rows.T @ left.flatten())
            f.append(rows.T @ rows)
    return torch.stack(s).double(), torch.stack(f).double()


def segments(z: Tensor, residual: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
    """Columns and residual in ``SEGMENTS`` parts along time that hold about as much information each.

    Args:
        z: ``[S, T, k]``.
        residual: ``[S, T]``.

    Yields:
        their parts.
    """
    told = z.square().sum((0, 2)).double().cumsum(0)
    cuts = torch.searchsorted(told, told[-1] * torch.arange(1, SEGMENTS) / SEGMENTS).tolist()
    yield from zip(z.tensor_split(cuts, 1), residual.tensor_split(cuts, 1), strict=True)
