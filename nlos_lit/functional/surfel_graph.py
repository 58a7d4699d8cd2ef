"""How surfels hang together: neighbours on the same sheet, and how well they fit one surface."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nlos_lit.functional import sheet_loops
from nlos_lit.functional.compiled import compiled, numpy_of

NEAR = 1.2  # cells at which the weight of a neighbour in a plane has fallen to exp(-1/2)
RIDGE = 0.3  # of a cell's square: two of the next neighbours outweigh a present normal by far, none do not
AVERAGES = 6  # over neighbours, by which a shift is carried along a sheet
STIFFNESS = 0.3  # how much a turn of the normals costs beside a step of the places
BEND = 0.05  # rad, misfit at which neighbours on a sheet cost half a nat, at most
FLATTEST = 0.002  # rad, misfit that no sheet is held to fall below
EDGE = 0.3  # of the scene's level: differences of albedo beyond it are edges, and cost little more
ALIKE = 0.05  # … below it are none, and cost next to nothing
LEVEL = 0.75  # of the light comes from surfels no brighter than the scene's own level
CURVED = 1.0  # rad by which a surfel turns from one side to the other, at most
THERE = 0.1  # of the level: at so little albedo a surfel has half of what it costs to be there
BRIGHT = 0.2  # deviation of ln(albedo) above that level


def neighbour_pairs(
    centre: Tensor, normal: Tensor, reach: float | Tensor, agree: float = 0.3
) -> tuple[Tensor, Tensor]:
    """Directed pairs (i, j) of surfels that are near each other and face alike.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        reach: largest distance of a pair, m, or ``[M]`` for a reach of each first surfel.
        agree: least cosine between a pair's normals.

    Returns:
        i and j ``[P]`` long, i ≠ j; ordered by i, then by j.

    Examples:
        >>> import torch
        >>> centre = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.9, 0.0, 1.0]])
        >>> normal = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
        >>> neighbour_pairs(centre, normal, reach=0.2)
        (tensor([0, 1]), tensor([1, 0]))
    """
    reaches = torch.as_tensor(reach, device=centre.device).expand(len(centre))
    if not len(centre):
        return reaches.new_zeros(0, dtype=torch.long), reaches.new_zeros(0, dtype=torch.long)
    near = cKDTree(centre.detach().cpu().double().numpy()).query_pairs(
        float(reaches.max()), output_type="ndarray"
    )
    once = torch.from_numpy(near).to(centre.device)
    both = torch.cat([once, once.flip(1)])
    i, j = both[torch.argsort(both[:, 0] * len(centre) + both[:, 1])].T
    distance = (centre[i] - centre[j]).norm(dim=1)
    kept = (distance < reaches[i]) & ((normal[i] * normal[j]).sum(1) > agree)
    return i[kept], j[kept]


class Sheet(NamedTuple):
    """How each of M surfels follows its neighbours while these move: with its normal, and with its place."""

    pairs: tuple[Tensor, Tensor]  # i and j [P], from neighbour_pairs
    normal: Tensor  # [M, 3] unit, about which surfaces lean
    first: Tensor  # [M, 3] unit, across the normal
    second: Tensor  # [M, 3] unit, across both
    share: Tensor  # [P, 2] slopes along both, per metre that j stands out of i's plane, beyond
    rest: Tensor  # [P] m, as far as it may while i keeps this normal
    bow: Tensor  # [P] m, as far as an arc from i to j leaves i's plane, that is at rest
    mean: Tensor  # [P] share of j in the average about i
    own: Tensor  # [M] share of i in it
    outward: Tensor  # [M, 3] away from where neighbours lie: 0 all around, length 1 where half are missing

    @property
    def as_it_was(self) -> bool:
        """Normals began as they were before."""
        return bool(self.rest.any())


def lay_sheet(
    centre: Tensor,
    normal: Tensor,
    weight: Tensor,
    pairs: tuple[Tensor, Tensor],
    cell: float,
    as_it_is: bool = False,
) -> Sheet:
    """Planes through the neighbours of each surfel, by weighted least squares.

    Neighbours count less with their distance and with how far they stand out of the surfel's own plane; a
    surfel with few of them keeps some of its present normal (a ridge), one with none all of it.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit, at present.
        weight: ``[M]`` trust in each surfel.
        pairs: i and j ``[P]`` from :func:`neighbour_pairs`.
        cell: lateral extent of a surfel, m.
        as_it_is: normals begin as they are, and turn as those of the planes do from here on.

    Returns:
        what :func:`sheet_normals` and :func:`carry_along` need.
    """
    i, j = pairs
    helper = torch.where(
        normal[:, :1].abs() < 0.9, centre.new_tensor([[1.0, 0.0, 0.0]]), centre.new_tensor([[0.0, 1.0, 0.0]])
    )
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, helper), dim=1)
    second = torch.linalg.cross(normal, first)
    d = centre[j] - centre[i]
    along = torch.stack([(d * first[i]).sum(1), (d * second[i]).sum(1)], 1)
    height = (d * normal[i]).sum(1)
    near = torch.exp(-(d**2).sum(1) / (2 * (NEAR * cell) ** 2) - (height / cell) ** 2 / 2)
    trust = weight[j] * near
    square = trust[:, None, None] * along[:, :, None] * along[:, None, :]
    normal_equations = torch.zeros(len(centre), 2, 2, device=centre.device).index_add(0, i, square)
    normal_equations = normal_equations + RIDGE * cell**2 * torch.eye(2, device=centre.device)
    share = torch.linalg.solve(normal_equations[i], trust[:, None] * along)
    total = weight.clamp_min(1e-6).index_add(0, i, trust)
    rest = height if as_it_is else torch.zeros_like(height)
    bow = _bow(normal, d, pairs) if as_it_is else torch.zeros_like(height)
    mean, own = trust / total[i], weight.clamp_min(1e-6) / total
    aside = torch.zeros_like(normal[:, :2]).index_add(0, i, trust[:, None] * along)
    reach = torch.zeros_like(total).index_add(0, i, trust * along.norm(dim=1)).clamp_min(1e-12)
    missing = -math.pi / 2 * aside / reach[:, None]
    missing = missing / missing.norm(dim=1, keepdim=True).clamp_min(1.0)
    outward = missing[:, :1] * first + missing[:, 1:] * second
    return Sheet(pairs, normal, first, second, share, rest, bow, mean, own, outward)


def curvature_of(sheet: Sheet, normal: Tensor, cell: float) -> Tensor:
    """How surfels curve: the change of the normal from each to its neighbours, by weighted least squares.

    The weights are those of the planes (:func:`lay_sheet`), so that a surfel with few neighbours is flat.

    Args:
        sheet: from :func:`lay_sheet`.
        normal: ``[M, 3]`` unit.
        cell: lateral extent of a surfel, m, over which none turns by more than ``CURVED``.

    Returns:
        ``[M, 3, 3]`` 1/m, symmetric, in the tangent planes.

    Examples:
        >>> import torch
        >>> row = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.2, 0.0, 1.0]])
        >>> turning = torch.tensor([[-0.1, 0.0, -1.0], [0.0, 0.0, -1.0], [0.1, 0.0, -1.0]])
        >>> sheet = lay_sheet(row, turning, torch.ones(3), neighbour_pairs(row, turning, 0.15), 0.1)
        >>> round(float(curvature_of(sheet, turning, 0.1)[1, 0, 0]), 2)  # 1 but for the ridge
        0.82
    """
    i, j = sheet.pairs
    change = sheet.share[:, :, None] * (normal[j] - normal[i])[:, None]
    slope = torch.zeros(len(normal), 2, 3, device=normal.device).index_add(0, i, change)
    turn = torch.einsum("ma,mb->mba", sheet.first, slope[:, 0])
    turn = turn + torch.einsum("ma,mb->mba", sheet.second, slope[:, 1])
    plane = torch.eye(3, device=normal.device) - normal[:, :, None] * normal[:, None]
    turn = plane @ (turn + turn.mT) @ plane / 2
    size = turn.flatten(1).norm(dim=1) * cell / CURVED
    return turn / size.clamp_min(1.0)[:, None, None]


def carry_along(sheet: Sheet, shift: Tensor) -> Tensor:
    """What shifts of single surfels move when neighbours come along: ``AVERAGES`` averages over neighbours.

    A shift of all surfels of a sheet stays what it is; that of a single one is spread over those within
    about three cells. Gradients are summed over as many, so that what they agree on moves the sheet as one.

    Args:
        sheet: from :func:`lay_sheet`.
        shift: ``[M]``, differentiable.

    Returns:
        ``[M]``.

    Examples:
        >>> import torch
        >>> row = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.9, 0.0, 1.0]])
        >>> facing = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
        >>> sheet = lay_sheet(row, facing, torch.ones(3), neighbour_pairs(row, facing, 0.2), 0.1)
        >>> [round(x, 2) for x in carry_along(sheet, torch.tensor([1.0, 0.0, 2.0])).tolist()]
        [0.5, 0.5, 2.0]
    """
    if compiled(shift):
        return _Carried.apply(shift, sheet)
    i, j = sheet.pairs
    for _ in range(AVERAGES):
        shift = (sheet.own * shift).index_add(0, i, sheet.mean * shift.index_select(0, j))
    return shift


def sheet_normals(sheet: Sheet, centre: Tensor) -> Tensor:
    """Normals of surfels whose neighbours are where they are now.

    A plane through the neighbours on one side of a surfel, at the rim of a round body, is turned towards
    them by half of what the surface bends. So it is laid again, through neighbours as far out of it as an arc
    that has both normals would take them. Where neighbours are all around their bends cancel, and would bring
    nothing but the noise of their normals.

    Args:
        sheet: from :func:`lay_sheet`.
        centre: ``[M, 3]`` m, differentiable.

    Returns:
        ``[M, 3]`` unit.

    Examples:
        Three surfels in a row that rise by 0.1 a step of 0.1 lean by 45° but for the ridge:

        >>> import torch
        >>> flat = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.2, 0.0, 1.0]])
        >>> pairs = torch.tensor([0, 1, 1, 2]), torch.tensor([1, 0, 2, 1])
        >>> facing = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
        >>> sheet = lay_sheet(flat, facing, torch.ones(3), pairs, 0.1)
        >>> sheet_normals(sheet, flat)[1].abs()
        tensor([0., 0., 1.])
        >>> risen = flat + torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 0.1], [0.0, 0.0, 0.2]])
        >>> [round(x, 2) for x in sheet_normals(sheet, risen)[1].tolist()]
        [0.64, 0.0, -0.77]
    """
    if compiled(centre):
        return _Normals.apply(centre, sheet)
    i, j = sheet.pairs
    d = centre.index_select(0, j) - centre.index_select(0, i)
    height = (d * sheet.normal.index_select(0, i)).sum(1) - sheet.rest
    planes = _leaning(sheet, height)
    rim = sheet.outward.norm(dim=1).index_select(0, i)
    bow = rim * (_bow(planes, d, sheet.pairs) - sheet.bow)
    return _leaning(sheet, height + bow)


class _Carried(torch.autograd.Function):
    """:func:`carry_along`, compiled."""

    @staticmethod
    def forward(ctx: Any, shift: Tensor, sheet: Sheet) -> Tensor:
        ctx.i, ctx.j, *ctx.shares = (numpy_of(x) for x in (*sheet.pairs, sheet.mean, sheet.own))
        return torch.from_numpy(sheet_loops.carried(ctx.i, ctx.j, *ctx.shares, numpy_of(shift), AVERAGES))

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        pulled = sheet_loops.carried(ctx.j, ctx.i, *ctx.shares, numpy_of(grad), AVERAGES)
        return torch.from_numpy(pulled), None


class _Normals(torch.autograd.Function):
    """:func:`sheet_normals`, compiled."""

    @staticmethod
    def forward(ctx: Any, centre: Tensor, sheet: Sheet) -> Tensor:
        given = (*sheet.pairs, centre, sheet.normal, sheet.first, sheet.second, sheet.share)
        ctx.given, rim = [numpy_of(x) for x in given], numpy_of(sheet.outward.norm(dim=1))
        found = sheet_loops.normals(*ctx.given, numpy_of(sheet.rest), numpy_of(sheet.bow), rim)
        ctx.given += [rim, *found]
        return torch.from_numpy(found[0])

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(sheet_loops.pull_normals(*ctx.given, numpy_of(grad))), None


class _Known(torch.autograd.Function):
    """A cost whose gradients were worked out with it."""

    @staticmethod
    def forward(ctx: Any, cost: float, gradients: tuple[Tensor, ...], *of: Tensor) -> Tensor:
        ctx.save_for_backward(*gradients)
        return torch.tensor(cost, dtype=of[0].dtype)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        return (None, None, *(grad * gradient for gradient in ctx.saved_tensors))


def rolled_off(normal: Tensor, outward: Tensor, roll: Tensor) -> Tensor:
    """Normals that lean outwards at rims, as round bodies turn away from the wall within a cell.

    Places of neighbours on one side do not say how a surface goes on at the other; how bright it is from
    where on the wall does.

    Args:
        normal: ``[M, 3]`` unit.
        outward: ``[M, 3]`` from :func:`lay_sheet`.
        roll: tangent of the angle where half of the neighbours are missing, a scalar.

    Returns:
        ``[M, 3]`` unit, differentiable.

    Examples:
        >>> facing = torch.tensor([[0.0, 0.0, -1.0]])
        >>> leaning = rolled_off(facing, torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor(1.0))
        >>> [round(x, 2) for x in leaning[0].tolist()]
        [0.71, 0.0, -0.71]
    """
    return torch.nn.functional.normalize(normal + roll * outward, dim=1)


def _leaning(sheet: Sheet, height: Tensor) -> Tensor:
    """``[M, 3]`` normals of planes through neighbours that stand out by ``height`` ``[P]``."""
    slope = height.new_zeros(len(sheet.own), 2).index_add(0, sheet.pairs[0], sheet.share * height[:, None])
    leaning = sheet.normal - slope[:, :1] * sheet.first - slope[:, 1:] * sheet.second
    return torch.nn.functional.normalize(leaning, dim=1)


def _bow(normal: Tensor, d: Tensor, pairs: tuple[Tensor, Tensor]) -> Tensor:
    """``[P]`` m by which an arc with both normals leaves the first one's plane along ``d`` ``[P, 3]``.

    On it ``(n_i + n_j)·d = 0``, so that ``-n_i·d`` is half of ``(n_j - n_i)·d``.
    """
    i, j = pairs
    return ((normal.index_select(0, j) - normal.index_select(0, i)) * d).sum(1) / 2


def misfits(centre: Tensor, normal: Tensor, pairs: tuple[Tensor, Tensor]) -> Tensor:
    """How badly each pair fits one surface, in squared radians.

    ``r² = (n̄·d)² + STIFFNESS·|n_i - n_j|²/4``, n̄ the mean of the two normals, d the unit vector between the
    centres. On any arc of constant curvature n̄·d = 0, so that curved surfaces cost little.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        pairs: i and j ``[P]`` from :func:`neighbour_pairs`.

    Returns:
        ``[P]`` r², differentiable.
    """
    i, j = pairs
    d = centre.index_select(0, j) - centre.index_select(0, i)
    of_i, of_j = normal.index_select(0, i), normal.index_select(0, j)
    mean, half = (of_i + of_j) / 2, (of_i - of_j) / 2
    out = (mean * d).sum(1) ** 2 / (d**2).sum(1).clamp_min(1e-12)
    return out + STIFFNESS * (half**2).sum(1)


def bend_of(centre: Tensor, normal: Tensor, weight: Tensor, pairs: tuple[Tensor, Tensor]) -> float:
    """How much neighbours misfit: the median r, for which a Cauchy density makes them likeliest.

    Flat boards misfit by a few thousandths, round bodies by as much as their normals turn within a cell.

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        weight: ``[M]`` trust in each surfel; a pair counts their product.
        pairs: i and j ``[P]`` from :func:`neighbour_pairs`.

    Returns:
        rad, from ``FLATTEST`` to ``BEND``, which it is where there are no pairs.

    Examples:
        >>> import torch
        >>> centre = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0], [0.2, 0.0, 1.002]])
        >>> flat = torch.tensor([0.0, 0.0, -1.0]).expand(3, 3)
        >>> pairs = torch.tensor([1, 2, 0]), torch.tensor([2, 1, 1])  # two of three are of a step of 1 : 50
        >>> round(bend_of(centre, flat, torch.ones(3), pairs), 3)
        0.02
    """
    i, j = pairs
    if not len(i):
        return BEND
    median = _quantile(misfits(centre, normal, pairs).sqrt(), weight[i] * weight[j], 0.5)
    return min(max(float(median), FLATTEST), BEND)


def _quantile(value: Tensor, weight: Tensor, share: float) -> Tensor:
    """The value up to which a share of the weight comes; both ``[N]``."""
    ordered, of = value.sort()
    told = weight[of].double().cumsum(0)
    return ordered[(told < share * told[-1]).sum()]


def bending(
    centre: Tensor, normal: Tensor, weight: Tensor, pairs: tuple[Tensor, Tensor], bend: float
) -> Tensor:
    """Cost of misfits between neighbours: ``½ Σ w_i w_j ln(1 + r²/bend²)`` over directed pairs.

    It is the negative logarithm of a Cauchy density: a surface as rough as it is, so that a smooth sheet is
    stiff and an edge costs a few nats only (r² from :func:`misfits`).

    Args:
        centre: ``[M, 3]`` m.
        normal: ``[M, 3]`` unit.
        weight: ``[M]`` trust in each surfel, a constant; a pair counts their product.
        pairs: i and j ``[P]`` from :func:`neighbour_pairs`.
        bend: rad at which a pair costs half a nat.

    Returns:
        A scalar, differentiable in places and normals.

    Examples:
        >>> import torch
        >>> centre = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
        >>> flat = torch.tensor([0.0, 0.0, -1.0]).expand(2, 3)
        >>> pairs = torch.tensor([0, 1]), torch.tensor([1, 0])
        >>> bending(centre, flat, torch.ones(2), pairs, BEND)
        tensor(0.)
    """
    if compiled(centre):
        given = (numpy_of(x) for x in (*pairs, centre, normal, weight))
        cost, *gradients = sheet_loops.bending(*given, bend, STIFFNESS)
        return _Known.apply(cost, tuple(torch.from_numpy(g) for g in gradients), centre, normal)
    i, j = pairs
    trust = weight.index_select(0, i) * weight.index_select(0, j)
    return (trust * torch.log1p(misfits(centre, normal, pairs) / bend**2)).sum() / 2


def level_of(albedo: Tensor) -> Tensor:
    """The scene's own level of albedo: three quarters of its light come from no brighter surfels.

    However many dark surfels lie around a sheet, they send no light, and do not change it. No gradient
    passes.

    Args:
        albedo: ``[M]`` ≥ 0.

    Returns:
        a scalar > 0.

    Examples:
        >>> import torch
        >>> level_of(torch.tensor([0.5, 0.5, 0.5, 0.0, 0.0, 0.0, 0.0])).item()
        0.5
    """
    light = albedo.detach()
    return _quantile(light, light, LEVEL).clamp_min(1e-7)


def albedo_cost(
    albedo: Tensor, pairs: tuple[Tensor, Tensor], level: Tensor, evenness: float, bright: float, there: float
) -> Tensor:
    """The sum of what albedos cost, each with its weight.

    Args:
        albedo: ``[M]`` ≥ 0.
        pairs: i and j ``[P]`` from :func:`neighbour_pairs`, both directions.
        level: of the scene, from :func:`level_of`.
        evenness: weight of :func:`albedo_steps` …
        bright: … of :func:`brightness` …
        there: … and of :func:`presence`.

    Returns:
        A scalar, differentiable in the albedos.
    """
    if not compiled(albedo):
        steps = albedo_steps(albedo, pairs, level)
        return evenness * steps + bright * brightness(albedo, level) + there * presence(albedo, level)
    given = (numpy_of(x) for x in (*pairs, albedo))
    constants = (float(level), evenness, bright, there, EDGE, ALIKE, BRIGHT, THERE)
    cost, gradient = sheet_loops.albedo_costs(*given, *constants)
    return _Known.apply(cost, (torch.from_numpy(gradient),), albedo)


def albedo_steps(albedo: Tensor, pairs: tuple[Tensor, Tensor], level: Tensor) -> Tensor:
    """Cost of albedos that differ between neighbours: ``½ Σ EDGE ln(1 + size/EDGE)`` over directed pairs.

    ``size`` is the difference in units of the level, smooth about zero (``√(x² + ALIKE²) - ALIKE``). A sheet
    is evenly bright, and ends, or changes its paint, at an edge: its cost hardly depends on its height.

    Args:
        albedo: ``[M]`` ≥ 0.
        pairs: i and j ``[P]`` from :func:`neighbour_pairs`, both directions.
        level: of the scene, from :func:`level_of`.

    Returns:
        A scalar, differentiable.

    Examples:
        >>> import torch
        >>> both = torch.tensor([0, 1]), torch.tensor([1, 0])
        >>> one = torch.tensor(1.0)
        >>> albedo_steps(torch.tensor([0.4, 0.4]), both, one)
        tensor(0.)
        >>> [round(albedo_steps(torch.tensor([0.0, x]), both, one).item(), 2) for x in (0.1, 0.5, 1.0)]
        [0.06, 0.28, 0.43]
    """
    i, j = pairs
    step = (albedo.index_select(0, i) - albedo.index_select(0, j)) / level
    size = torch.sqrt(step**2 + ALIKE**2) - ALIKE
    return EDGE * torch.log1p(size / EDGE).sum() / 2


def brightness(albedo: Tensor, level: Tensor) -> Tensor:
    """Cost of albedos above the scene's own level: half a normal density of ln(albedo), of deviation BRIGHT.

    Light that the model has no place for gathers on surfels that few spots see, many times brighter than
    anything else.

    Args:
        albedo: ``[M]`` ≥ 0.
        level: of the scene, from :func:`level_of`.

    Returns:
        A scalar, differentiable in the albedos.

    Examples:
        >>> import torch
        >>> half = torch.tensor(0.5)
        >>> brightness(torch.tensor([0.0, 0.5, 0.5, 0.5]), half)
        tensor(0.)
        >>> round(brightness(torch.tensor([0.5, 0.5, 0.5, 0.5 * 2.71828**0.2]), half).item(), 3)
        0.5
    """
    over = torch.log((albedo / level).clamp_min(1.0))
    return ((over / BRIGHT) ** 2).sum() / 2


def presence(albedo: Tensor, level: Tensor) -> Tensor:
    """How many surfels are there: ``Σ ρ/(ρ + THERE·level)``.

    A surfel that is there costs the same however bright it is, so that what many faint ones would explain
    together stays unexplained, unless it is worth so much.

    Args:
        albedo: ``[M]`` ≥ 0.
        level: of the scene, from :func:`level_of`.

    Returns:
        A scalar, differentiable.

    Examples:
        >>> import torch
        >>> presence(torch.tensor([0.0, 0.1, 0.9]), torch.tensor(1.0))
        tensor(1.4000)
    """
    return (albedo / (albedo + THERE * level)).sum()
