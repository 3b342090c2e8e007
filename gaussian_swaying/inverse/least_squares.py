"""Robust least squares over batches of models: scipy's trust region, and what its end tells of errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

STEP = 0.004
"""Step of the finite differences, as a share of the range."""

HUBER = 1.345
"""Standard deviations above which a residual counts less (Huber 1981: 95 % efficiency)."""

REACH = 0.25
"""Longest first step, as a share of each range."""

CLOSELY, ROUGHLY = (3e-4, 1e-4), (9e-3, 3e-3)
"""Shortest step, as a share of the ranges, and least gain, as a share of the cost, that are worth another one: of the
last stage, and of the others."""

RESCALED, ALIKE = 4, 1.1
"""Most times that the standard deviations of the residuals are estimated, and ratio below which they stay."""

NO_STEP = "no step is better"


@dataclass(frozen=True, eq=False)
class Block:
    """Residuals of one kind.

    Attributes:
        kind: ``tracks``, ``silhouettes`` or ``pixels``.
        values: Differences between simulation and video for each variant, float64, shape (B, R, D); in pixels for
            tracks, else in grey levels from 0 to 1.
        cluster: Index of the cluster of correlated residuals that each belongs to, shape (R,).
        moment: Index of the part of the time that each belongs to, shape (R,); None if all are of one.
    """

    kind: str
    values: Tensor
    cluster: Tensor
    moment: Tensor | None = None


Residuals = Callable[[Tensor], list[Block]]
"""Residuals at some points (B, U), each a share of every range."""

Rescale = Callable[[Sequence[Block]], dict[str, float]]
"""Robust standard deviation of the first variant's residuals, for each kind."""


class DivergedError(ValueError):
    """No simulation of a step is finite."""


@dataclass(frozen=True, eq=False)
class Solved:
    """An end: its place (U,), its residuals and their standard deviations, and why no more steps were tried.

    ``ended`` is empty if their number ran out; ``steps`` counts them.
    """

    place: Tensor
    blocks: list[Block]
    scales: dict[str, float]
    ended: str
    steps: int

    @property
    def cost(self) -> float:
        """Mean of Huber's function over all residuals, each in standard deviations."""
        return float(cost_of(self.blocks, self.scales)[0])


def cost_of(blocks: Sequence[Block], scales: Mapping[str, float]) -> Tensor:
    """Cost of each variant, shape (B,); infinite for one that is not finite."""
    size = torch.cat([(block.values / scales[block.kind]).abs().flatten(1) for block in blocks], 1)
    total = torch.where(size < HUBER, 0.5 * size.square(), HUBER * (size - 0.5 * HUBER)).sum(1)
    count = sum(block.values.shape[1] for block in blocks)
    return torch.where(torch.isfinite(total), total, float("inf")) / max(count, 1)


def solve(residuals: Residuals, rescale: Rescale, place: Tensor, most: int, closely: bool = False) -> Solved:
    """Minimise the cost from a place by SciPy's dogleg within the ranges.

    Standard deviations of the residuals are estimated anew where it ends, until they stay.

    Args:
        residuals: Computes residuals.
        rescale: Standard deviations of the first variant's residuals.
        place: Where to begin, shape (U,).
        most: Most steps that are tried.
        closely: Whether small steps count.
    """
    from scipy.optimize import least_squares

    xtol, ftol = CLOSELY if closely else ROUGHLY
    begin, tried, ended = place.double(), 0, ""
    blocks = residuals(begin[None])
    for _ in range(RESCALED):
        scales = rescale(blocks)
        known: dict[bytes, list[Block]] = {begin.numpy().tobytes(): blocks}
        used = _flat(blocks, scales)[0].isfinite()
        if not bool(used.any()):
            raise DivergedError("Every simulation of a step diverged: narrow the ranges of `unknowns`.")

        def at(shift: Any, begin: Tensor, scales: dict[str, float], used: Tensor, known: dict[bytes, Any]) -> Any:
            there = begin + torch.from_numpy(shift)
            key = there.numpy().tobytes()
            known[key] = known.get(key) or residuals(there[None])
            return _flat(known[key], scales)[0, used].numpy()

        def slopes(shift: Any, begin: Tensor, scales: dict[str, float], used: Tensor) -> Any:
            both, widths = _beside(begin + torch.from_numpy(shift))
            high, low = _flat(residuals(both), scales)[:, used].chunk(2)
            return torch.nan_to_num((high - low) / widths[:, None], posinf=0.0, neginf=0.0).T.numpy()

        found = least_squares(
            partial(at, begin=begin, scales=scales, used=used, known=known),
            0 * begin.numpy(),
            partial(slopes, begin=begin, scales=scales, used=used),
            bounds=((-begin).numpy(), (1 - begin).numpy()),
            method="dogbox",
            x_scale=REACH,
            loss="huber",
            f_scale=HUBER,
            xtol=xtol,
            ftol=ftol,
            gtol=None,
            max_nfev=1 + most - tried,
        )
        tried += found.nfev - 1
        end = (begin + torch.from_numpy(found.x)).clamp(0.0, 1.0)
        moved, begin = float((end - begin).abs().amax()), end
        blocks = known.get(end.numpy().tobytes()) or residuals(end[None])
        ended = {0: "", 2: f"the last step lowered the cost by less than {ftol:.2%}"}.get(
            found.status, f"the last step was below {xtol:g} of every range"
        )
        now = rescale(blocks)
        alike = all(max(now[k] / scales[k], scales[k] / now[k]) < ALIKE for k in scales)
        if moved < xtol or alike or tried >= most:
            break
    return Solved(begin, blocks, rescale(blocks), NO_STEP if ended and moved == 0 else ended, tried)


def _flat(blocks: Sequence[Block], scales: Mapping[str, float]) -> Tensor:
    """All residuals in standard deviations, shape (B, N)."""
    return torch.cat([(block.values / scales[block.kind]).flatten(1) for block in blocks], 1).double()


def _beside(place: Tensor) -> tuple[Tensor, Tensor]:
    """Places on both sides of one in each unknown, shape (2U, U), and how far they are apart, (U,).

    One-sided differences bias the gradient: in a narrow valley, such as that of wind, stiffness and density raised
    together, they find no lower cost even far from the minimum.
    """
    up, down = (place + STEP).clamp(max=1.0), (place - STEP).clamp(min=0.0)
    return torch.cat([place + torch.diag(end - place) for end in (up, down)]), up - down


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations: sums over the residuals and their sensitivities at a point.

    Attributes:
        cost: Mean of Huber's function over all residuals, each in standard deviations.
        gradient: Weighed sum of sensitivity times residual, shape (U,).
        matrix: Weighed sum of sensitivity times sensitivity, J^T W J, shape (U, U).
        scores: The gradient of each cluster of correlated residuals, shape (C, U): patches of the object at all times,
            and parts of the time all over the object.
        count: Number of residuals.
    """

    cost: float
    gradient: Tensor
    matrix: Tensor
    scores: tuple[Tensor, Tensor]
    count: int

    def covariance(self) -> Tensor:
        r"""Covariance of the unknowns in shares of their ranges, shape (U, U).

        :math:`A^{-1} \bigl(\sum \tfrac{C}{C - 1} \sum_c g_c g_c^T\bigr) A^{-1} + A^{-1}`, where the gradients are
        summed over clusters of correlated residuals: the sandwich of White (1980) and Liang & Zeger (1986).
        The usual :math:`s^2 A^{-1}` takes all residuals for independent, and is far too small alone. It is added, as
        the sandwich of few clusters, or of residuals below the lower bound of the standard deviation, may be near zero.
        """
        inverse = torch.linalg.pinv(self.matrix, hermitian=True)
        middle = torch.zeros_like(self.matrix)
        for scores in self.scores:
            clusters = int((scores.abs().sum(-1) > 0).sum())
            middle = middle + clusters / max(clusters - 1, 1) * scores.mT @ scores
        return inverse @ middle @ inverse + inverse


def linearised(residuals: Residuals, rescale: Rescale, place: Tensor) -> Normal:
    """Normal equations at a place, from central differences of one batch."""
    both, widths = _beside(place)
    blocks = residuals(torch.cat([place[None], both]))
    scales, unknowns, count = rescale(blocks), len(place), 0
    gradient, matrix = torch.zeros(unknowns).double(), torch.zeros(unknowns, unknowns).double()
    sums: tuple[list[Tensor], list[Tensor]] = ([], [])
    for block in blocks:
        values = block.values.double() / scales[block.kind]
        residual, change = values[0], (values[1 : 1 + unknowns] - values[1 + unknowns :]) / widths[:, None, None]
        usable = torch.isfinite(residual).all(-1) & torch.isfinite(change).all(-1).all(0)
        weight = usable[:, None] * (HUBER / residual.abs().clamp(min=HUBER).nan_to_num(1.0))
        residual, change = residual.nan_to_num(0.0), change.nan_to_num(0.0)
        own = (change * residual * weight).sum(-1).mT  # (R, U)
        flat = (change * weight.sqrt()).flatten(1)
        gradient, matrix, count = gradient + own.sum(0), matrix + flat @ flat.mT, count + int(usable.sum())
        moment = torch.zeros_like(block.cluster) if block.moment is None else block.moment
        for several, index in zip(sums, (block.cluster, moment), strict=True):
            several.append(own.new_zeros(1 + int(index.max()) if len(index) else 0, unknowns).index_add(0, index, own))
    moments = torch.zeros(max(map(len, sums[1])), unknowns).double()
    for one in sums[1]:
        moments[: len(one)] += one
    if count == 0:
        raise DivergedError("Every simulation of a step diverged: narrow the ranges of `unknowns`.")
    return Normal(float(cost_of(blocks, scales)[0]), gradient, matrix, (torch.cat(sums[0]), moments), count)


def step_from(normal: Normal, place: Tensor) -> Tensor:
    """Return the end of a Gauss-Newton step within the ranges, of :data:`REACH` at most."""
    from scipy.optimize import lsq_linear

    values, vectors = torch.linalg.eigh(normal.matrix)
    root = values.clamp(min=1e-12 * max(float(values[-1]), 1e-300)).sqrt()
    low, high = (-place).clamp(min=-REACH), (1 - place).clamp(max=REACH)
    wanted = -(vectors.mT @ normal.gradient) / root
    found = lsq_linear((root[:, None] * vectors.mT).numpy(), wanted.numpy(), bounds=(low.numpy(), high.numpy()))
    return (place + torch.from_numpy(found.x)).clamp(0.0, 1.0)


def expected_gain(normal: Normal, step: Tensor) -> float:
    """Expected relative decrease of the cost for a step, with linearised residuals."""
    fall = -(normal.gradient @ step + 0.5 * step @ normal.matrix @ step) / max(normal.count, 1)
    return float(fall) / max(normal.cost, 1e-300)


def scales_of(blocks: Sequence[Block], floors: Mapping[str, float]) -> dict[str, float]:
    """Robust standard deviation of the residuals of the first variant, for each kind: from the median of their sizes.

    ``floors`` are the least ones.
    """
    found = {}
    for block in blocks:
        size = block.values[0].norm(dim=-1)
        # median of the norm of D standard normal numbers, to within a percent
        middle = {1: 0.6745, 2: 1.1774, 3: 1.5382}[block.values.shape[-1]]
        sigma = float(size.nanmedian()) / middle if size.numel() else 0.0
        found[block.kind] = max(0.0 if math.isnan(sigma) else sigma, floors[block.kind])
    return found
