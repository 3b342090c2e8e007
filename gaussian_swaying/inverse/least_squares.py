"""Robust least squares over batches of models: scipy's trust region, and what its end tells of errors."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from scipy.optimize import least_squares
from scipy.stats import chi
from torch import Tensor

STEP = 0.004  # step of the finite differences, as a share of the range
HUBER = 1.345  # standard deviations above which a residual counts less (Huber 1981: 95 % efficiency)
REACH = 0.25  # longest first step, as a share of each range
CLOSELY, ROUGHLY = (3e-4, 1e-4), (9e-3, 3e-3)  # shortest step, and least gain per cost, of the last stage and others
ROBUSTLY: dict[str, Any] = {"method": "dogbox", "x_scale": REACH, "loss": "huber", "f_scale": HUBER}
ALIKE = 1.1  # ratio of standard deviations of the residuals below which they stay
LEAST = 0.05  # least standard deviation of the residuals [pixels]
NO_STEP = "no step is better"
DIVERGED = "Every simulation of a step diverged: narrow the ranges of `unknowns`."


@dataclass(frozen=True, eq=False)
class Block:
    """Residuals of some variants [pixels], float64, shape (B, R, D), and their clusters by place and by time, (R,)."""

    values: Tensor
    cluster: Tensor
    moment: Tensor | None = None


Residuals = Callable[[Tensor], Block]  # residuals at some points (B, U), each a share of every range


class DivergedError(ValueError):
    """No simulation of a step is finite."""


@dataclass(frozen=True, eq=False)
class Solved:
    """An end: its place (U,), its residuals and their standard deviation, and why it is one; empty if steps ran out."""

    place: Tensor
    block: Block
    scale: float
    ended: str
    steps: int


def cost_of(block: Block, scale: float) -> Tensor:
    """Cost of each variant, shape (B,): mean of Huber's function of residuals per ``scale``; infinite if not finite."""
    size = (block.values / scale).abs().flatten(1)
    total = torch.where(size < HUBER, 0.5 * size.square(), HUBER * (size - 0.5 * HUBER)).sum(1)
    return torch.where(torch.isfinite(total), total, float("inf")) / max(block.values.shape[1], 1)


def scale_of(block: Block, least: float = LEAST) -> float:
    """Robust standard deviation of the residuals of the first variant, from the median of their lengths."""
    size = block.values[0].norm(dim=-1)
    middle = float(size.nanmedian()) if len(size) else 0.0
    return max(0.0 if math.isnan(middle) else middle / chi.median(block.values.shape[-1]), least)


def solve(
    residuals: Residuals, place: Tensor, most: int, closely: bool = False, scale: Callable[[Block], float] = scale_of
) -> Solved:
    """Minimise the cost from a place by so many steps of SciPy's dogleg; ``closely`` if small ones count.

    The standard deviation of the residuals is that of the place, and is estimated anew where it ends, until it stays.
    """
    xtol, ftol = CLOSELY if closely else ROUGHLY
    begin = place.double()
    known = {begin.numpy().tobytes(): residuals(begin[None])}
    first = known[begin.numpy().tobytes()]
    sigma, used = scale(first), first.values[0].flatten().isfinite()
    if not bool(used.any()):
        raise DivergedError(DIVERGED)

    def at(shift: Any) -> Any:
        there = begin + torch.from_numpy(shift)
        key = there.numpy().tobytes()
        known[key] = known.get(key) or residuals(there[None])
        return (known[key].values[0].flatten()[used].double() / sigma).numpy()

    def slopes(shift: Any) -> Any:
        both, widths = beside(begin + torch.from_numpy(shift))
        high, low = (residuals(both).values.flatten(1)[:, used].double() / sigma).chunk(2)
        return torch.nan_to_num((high - low) / widths[:, None], posinf=0.0, neginf=0.0).T.numpy()

    ends = {"xtol": xtol, "ftol": ftol, "gtol": None, "max_nfev": 1 + most}
    bounds = ((-begin).numpy(), (1 - begin).numpy())  # of shifts, as the first step is then no longer than `x_scale`
    found = least_squares(at, 0 * begin.numpy(), slopes, bounds, **ROBUSTLY, **ends)
    end = (begin + torch.from_numpy(found.x)).clamp(0.0, 1.0)
    block = known.get(end.numpy().tobytes()) or residuals(end[None])
    ended = {0: "", 2: f"the last step lowered the cost by less than {ftol:.2%}"}.get(
        found.status, f"the last step was below {xtol:g} of every range"
    )
    now, tried = scale(block), found.nfev - 1
    if float((end - begin).abs().amax()) >= xtol and max(now / sigma, sigma / now) >= ALIKE and tried < most:
        again = solve(residuals, end, most - tried, closely, scale)
        return replace(again, steps=tried + again.steps)
    return Solved(end, block, now, NO_STEP if ended and torch.equal(end, begin) else ended, tried)


def beside(place: Tensor) -> tuple[Tensor, Tensor]:
    """Places on both sides of one in each unknown, shape (2U, U), and how far they are apart, (U,).

    One-sided differences bias the gradient: in a narrow valley, such as that of wind, stiffness and density raised
    together, they find no lower cost even far from the minimum.
    """
    up, down = (place + STEP).clamp(max=1.0), (place - STEP).clamp(min=0.0)
    return torch.cat([place + torch.diag(end - place) for end in (up, down)]), up - down


def covariance(matrix: Tensor, scores: Sequence[Tensor]) -> Tensor:
    r"""Covariance of the unknowns in shares of their ranges, shape (U, U), from what :func:`normal` returns.

    :math:`A^{-1} \bigl(\sum \tfrac{C}{C - 1} \sum_c g_c g_c^T\bigr) A^{-1} + A^{-1}`, where the gradients are summed
    over clusters of correlated residuals: the sandwich of White (1980) and Liang & Zeger (1986). The usual
    :math:`s^2 A^{-1}` takes all residuals for independent, and is far too small alone. It is added, as the sandwich of
    few clusters, or of residuals below the lower bound of the standard deviation, may be near zero.
    """
    inverse = torch.linalg.pinv(matrix, hermitian=True)
    middle = torch.zeros_like(matrix)
    for own in scores:
        clusters = int((own.abs().sum(-1) > 0).sum())
        middle = middle + clusters / max(clusters - 1, 1) * own.mT @ own
    return inverse @ middle @ inverse + inverse


def normal(
    residuals: Residuals, place: Tensor, scale: Callable[[Block], float] = scale_of
) -> tuple[Tensor, list[Tensor]]:
    """Normal equations at a place, from central differences of one batch.

    J^T W J, shape (U, U), and the parts of J^T W r of both kinds of clusters, each (C, U).
    """
    both, widths = beside(place)
    block, unknowns = residuals(torch.cat([place[None], both])), len(place)
    sigma = scale(block)
    values = block.values.double() / sigma
    residual, change = values[0], (values[1 : 1 + unknowns] - values[1 + unknowns :]) / widths[:, None, None]
    usable = torch.isfinite(residual).all(-1) & torch.isfinite(change).all(-1).all(0)
    if not bool(usable.any()):
        raise DivergedError(DIVERGED)
    weight = usable[:, None] * (HUBER / residual.abs().clamp(min=HUBER).nan_to_num(1.0))
    residual, change = residual.nan_to_num(0.0), change.nan_to_num(0.0)
    own = (change * residual * weight).sum(-1).mT  # (R, U)
    flat = (change * weight.sqrt()).flatten(1)
    moment = torch.zeros_like(block.cluster) if block.moment is None else block.moment
    scores = [own.new_zeros(1 + int(one.max()), unknowns).index_add(0, one, own) for one in (block.cluster, moment)]
    return flat @ flat.mT, scores
