"""Robust nonlinear least squares by Levenberg and Marquardt's method, with a batch of simulations for each step.

A step takes two batches: one for the residuals and their sensitivities by finite differences, one for the trial steps
of several damping factors at once. Residuals are divided by their robust standard deviation, and weighed by Huber's
function, so that tracks that went astray count little.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gaussian_swaying.fitting.evidence import Block

STEP = 0.004
"""Step of the finite differences, as a share of the range."""
HUBER = 1.345
"""Standard deviations above which a residual counts less (Huber 1981: 95 % efficiency)."""
DAMPINGS = (0.0, 0.1, 1.0, 10.0)
"""Trial steps of an iteration: factors of the damping of the last accepted step; 0 is the Gauss-Newton step."""
MOST_DAMPING = 1e4
"""Damping at which the search for a better place ends."""
LEAST_GAIN = 1e-4
REACH = 0.25
"""Longest step, as a share of each range."""

Residuals = Callable[[Tensor], list[Block]]
"""Residuals at some points (B, U), each a share of every range."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Residuals and their sensitivities at a point, as sums.

    Attributes:
        cost: Mean of Huber's function over all residuals, each in standard deviations.
        gradient: Weighed sum of sensitivity times residual, shape (U,).
        matrix: Weighed sum of sensitivity times sensitivity, J^T W J, shape (U, U).
        scores: The gradient of each cluster of like errors, shape (C, U).
        count: Number of residuals.
    """

    cost: float
    gradient: Tensor
    matrix: Tensor
    scores: Tensor
    count: int

    def covariance(self) -> Tensor:
        r"""Covariance of the unknowns in shares of their ranges, shape (U, U).

        :math:`A^{-1} \bigl(\tfrac{C}{C - 1} \sum_c g_c g_c^T\bigr) A^{-1}`, where the gradients are summed over
        clusters of residuals whose errors are alike (neighbouring tracks at all times): the sandwich of White (1980)
        and Liang & Zeger (1986). The usual :math:`s^2 A^{-1}` takes all residuals for independent, and is far too
        small.
        """
        inverse = torch.linalg.pinv(self.matrix, hermitian=True)
        clusters = int((self.scores.abs().sum(-1) > 0).sum())
        factor = clusters / max(clusters - 1, 1)
        middle = factor * self.scores.mT @ self.scores
        return inverse @ middle @ inverse + inverse


@dataclass
class Progress:
    """Where an optimisation stands; enough to continue it.

    Attributes:
        place: Shares of the ranges, shape (U,).
        damping: Damping of the last accepted step.
        iteration: Iterations done.
        cost: Cost at ``place``.
        scales: Standard deviations of each kind of residual, from the last residuals.
        done: Why it ended; empty if it did not.
    """

    place: Tensor
    damping: float = 1e-2
    iteration: int = 0
    cost: float = float("inf")
    scales: dict[str, float] = field(default_factory=dict)
    done: str = ""


def huber(blocks: Sequence[Block], scales: Mapping[str, float]) -> Tensor:
    """Cost of each variant, shape (B,); infinite for one that is not finite."""
    total, count = torch.zeros(len(blocks[0].values), dtype=torch.float64), 0
    for block in blocks:
        size = block.values.norm(dim=-1) / scales[block.kind]
        loss = torch.where(size < HUBER, 0.5 * size.square(), HUBER * (size - 0.5 * HUBER))
        total, count = total + loss.sum(-1), count + size.shape[-1]
    return torch.where(torch.isfinite(total), total, float("inf")) / max(count, 1)


def normal_equations(blocks: Sequence[Block], scales: Mapping[str, float], steps: Tensor) -> Normal:
    """Sums of the residuals of the first variant and of their sensitivities, from the differences of the others.

    Args:
        blocks: Residuals of 1 + U variants; variant 1 + u differs from the first in unknown u.
        scales: Standard deviation of each kind.
        steps: By how much of its range, shape (U,).
    """
    unknowns, gradient, matrix, count = len(steps), 0.0, 0.0, 0
    clusters = sum(int(block.cluster.max()) + 1 if len(block.cluster) else 0 for block in blocks)
    scores, first = torch.zeros(clusters, unknowns, dtype=torch.float64), 0
    for block in blocks:
        sigma = scales[block.kind]
        residual = block.values[0] / sigma
        change = (block.values[1:] - block.values[:1]) / (sigma * steps[:, None, None])
        usable = torch.isfinite(residual).all(-1) & torch.isfinite(change).all(-1).all(0)
        residual, change, cluster = residual[usable], change[:, usable], block.cluster[usable]
        weight = HUBER / residual.norm(dim=-1).clamp(min=HUBER)
        own = ((change * residual).sum(-1) * weight).mT  # (R, U)
        gradient = gradient + own.sum(0)
        flat = (change * weight.sqrt()[:, None]).flatten(1)
        matrix = matrix + flat @ flat.mT
        scores.index_add_(0, cluster + first, own)
        first, count = first + (int(block.cluster.max()) + 1 if len(block.cluster) else 0), count + len(residual)
    assert isinstance(gradient, Tensor)
    assert isinstance(matrix, Tensor)
    base = [Block(b.kind, b.values[:1], b.cluster) for b in blocks]
    return Normal(float(huber(base, scales)[0]), gradient, matrix, scores, count)


def sensitivities(residuals: Residuals, place: Tensor) -> tuple[list[Block], Tensor]:
    """Residuals at a point and next to it, and the steps between, shape (U,); steps point into the range."""
    steps = torch.where(place > 1 - STEP, -STEP, STEP)
    return residuals(torch.cat([place[None], place + torch.diag(steps)])), steps


def central_sensitivities(residuals: Residuals, place: Tensor) -> tuple[list[Block], Tensor]:
    """As :func:`sensitivities`, from steps to both sides: exact to second order, for nearly twice the simulations."""
    unknowns = len(place)
    place = place.clamp(STEP, 1 - STEP)
    steps = torch.diag(torch.full_like(place, STEP))
    found = []
    for block in residuals(torch.cat([place[None], place + steps, place - steps])):
        here, up, down = block.values.split([1, unknowns, unknowns])
        found.append(Block(block.kind, torch.cat([here, here + 0.5 * (up - down)]), block.cluster))
    return found, steps.diagonal()


def iterate(
    residuals: Residuals,
    rescale: Callable[[Sequence[Block]], dict[str, float]],
    progress: Progress,
    tolerance: float,
    least_gain: float = LEAST_GAIN,
) -> Normal:
    """One iteration; ``progress`` is updated, also with the reason to stop.

    Args:
        residuals: Computes residuals.
        rescale: Standard deviations of the first variant's residuals.
        progress: Where to start.
        tolerance: Smallest step worth another iteration, as a share of the ranges.
        least_gain: Smallest share of the cost worth another iteration.

    Returns:
        The sums at the place where the iteration started.
    """
    place = progress.place
    blocks, steps = sensitivities(residuals, place)
    progress.scales = rescale(blocks)
    normal = normal_equations(blocks, progress.scales, steps)
    if normal.count == 0:
        raise ValueError("Every simulation of a step diverged: narrow the ranges of `unknowns`, or lower `solver.cfl`.")
    progress.cost, progress.iteration = normal.cost, progress.iteration + 1
    trials = torch.stack([_step(normal, place, factor * progress.damping) for factor in DAMPINGS])
    found = huber(residuals(trials), progress.scales)
    best = int(found.argmin())
    gain = normal.cost - float(found[best])
    if not gain > 0:
        progress.damping = max(progress.damping, 1e-3) * 100
        if float((trials[0] - place).abs().amax()) < 10 * tolerance or progress.damping > MOST_DAMPING:
            progress.done = "no step is better"
        return normal
    moved = float((trials[best] - place).abs().amax())
    progress.place, progress.cost = trials[best], float(found[best])
    progress.damping = max(DAMPINGS[best], 0.1) * progress.damping
    if moved < tolerance:
        progress.done = f"the last step was below {tolerance:g} of every range"
    elif gain < least_gain * normal.cost:
        progress.done = f"the last step lowered the cost by less than {least_gain:.2%}"
    return normal


def _step(normal: Normal, place: Tensor, damping: float) -> Tensor:
    """The place after a damped step that stays in the ranges; an unknown at its end that would leave it is kept."""
    free = torch.ones_like(place, dtype=torch.bool)
    for _ in range(len(place) + 1):
        matrix = normal.matrix[free][:, free]
        damped = matrix + (damping + 1e-12) * torch.diag(matrix.diagonal().clamp(min=1e-12))
        step = torch.zeros_like(place)
        step[free] = -torch.linalg.solve(damped, normal.gradient[free])
        blocked = free & (((place <= 0) & (step < 0)) | ((place >= 1) & (step > 0)))
        if not bool(blocked.any()) or not bool((free & ~blocked).any()):
            break
        free &= ~blocked
    longest = float(step.abs().amax())
    return (place + step * min(1.0, REACH / max(longest, 1e-12))).clamp(0.0, 1.0)


__all__ = ["Normal", "Progress", "central_sensitivities", "huber", "iterate", "normal_equations", "sensitivities"]
