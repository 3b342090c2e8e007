"""Robust nonlinear least squares by Levenberg and Marquardt's method, with a batch of simulations for each step.

A step takes one batch: the residuals at its end and their sensitivities, by central differences. If it does not lower
the cost, one more batch tries shorter ones. Residuals are divided by their robust standard deviation, and weighed by
Huber's function, so that wrong tracks count little.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from gaussian_swaying.fitting.evidence import Block
from gaussian_swaying.fitting.identifiability import changes
from gaussian_swaying.fitting.unknowns import Unknown

STEP = 0.004
"""Step of the finite differences, as a share of the range."""
HUBER = 1.345
"""Standard deviations above which a residual counts less (Huber 1981: 95 % efficiency)."""
START = 1e-6
"""Damping of the first step: nearly none, as damping mostly slows combinations that the video hardly determines."""
BETTER, WORSE, LEAST_DAMPING = 0.03, 30.0, 1e-3
"""Factor on the damping after a step that lowered the cost at once and as expected, that between the shorter steps that
are tried after one that did not lower it, and their least damping."""
SHORTER = 5
"""Shorter steps that are tried at once."""
AS_EXPECTED = 0.5
"""Least share of the fall of the cost that linear residuals have, with which the damping is lowered."""
LEAST_GAIN = 1e-4
NO_STEP = "no step is better"
REACH = 0.25
"""Longest step, as a share of each range."""

Residuals = Callable[[Tensor], list[Block]]
"""Residuals at some points (B, U), each a share of every range."""
Rescale = Callable[[Sequence[Block]], dict[str, float]]
"""Robust standard deviation of the first variant's residuals, for each kind."""
Retract = Callable[[Tensor, Tensor], Tensor]
"""The end of a step from a place, both in shares of the ranges (U,): the sum, or along what is straight otherwise."""


class DivergedError(ValueError):
    """No simulation of a step is finite."""


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
        Neighbouring tracks at all times are clusters, and so are all tracks in a part of the time, as a fault of the
        model is alike all over the object. The usual :math:`s^2 A^{-1}` takes all residuals for
        independent, and is far too small alone. It is added, as the sandwich of few clusters, or of residuals below the
        lower bound of the standard deviation, may be near zero.
        """
        inverse = torch.linalg.pinv(self.matrix, hermitian=True)
        middle = torch.zeros_like(self.matrix)
        for scores in self.scores:
            clusters = int((scores.abs().sum(-1) > 0).sum())
            middle = middle + clusters / max(clusters - 1, 1) * scores.mT @ scores
        return inverse @ middle @ inverse + inverse


@dataclass
class Progress:
    """The state of an optimisation; enough to continue it.

    Attributes:
        place: Values of the unknowns, as shares of their ranges, shape (U,).
        damping: Damping of the next step.
        iteration: Iterations done.
        normal: The normal equations at ``place``; None if they are to be computed.
        scales: Standard deviations of each kind of residual there.
        done: The reason why it ended; empty if it did not.
    """

    place: Tensor
    damping: float = START
    iteration: int = 0
    normal: Normal | None = None
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
    """Normal equations, from the residuals of the first variant and the differences of the others.

    Args:
        blocks: Residuals of 1 + U variants; variant 1 + u differs from the first in unknown u.
        scales: Standard deviation of each kind.
        steps: The difference in each unknown, as a share of its range, shape (U,).
    """
    unknowns, gradient, matrix, count = len(steps), 0.0, 0.0, 0
    clusters = sum(int(block.cluster.max()) + 1 if len(block.cluster) else 0 for block in blocks)
    scores, first = torch.zeros(clusters, unknowns, dtype=torch.float64), 0
    times = torch.zeros(1 + max(int(_moment(block).amax()) for block in blocks), unknowns, dtype=torch.float64)
    for block in blocks:
        sigma = scales[block.kind]
        residual = block.values[0] / sigma
        change = (block.values[1:] - block.values[:1]) / (sigma * steps[:, None, None])
        usable = torch.isfinite(residual).all(-1) & torch.isfinite(change).all(-1).all(0)
        residual, change, cluster = residual[usable], change[:, usable], block.cluster[usable]
        moment = _moment(block)[usable]
        weight = HUBER / residual.norm(dim=-1).clamp(min=HUBER)
        own = ((change * residual).sum(-1) * weight).mT  # (R, U)
        gradient = gradient + own.sum(0)
        flat = (change * weight.sqrt()[:, None]).flatten(1)
        matrix = matrix + flat @ flat.mT
        scores.index_add_(0, cluster + first, own)
        times.index_add_(0, moment, own)
        first, count = first + (int(block.cluster.max()) + 1 if len(block.cluster) else 0), count + len(residual)
    assert isinstance(gradient, Tensor)
    assert isinstance(matrix, Tensor)
    base = [block.of(block.values[:1]) for block in blocks]
    return Normal(float(huber(base, scales)[0]), gradient, matrix, (scores, times), count)


def _moment(block: Block) -> Tensor:
    return torch.zeros_like(block.cluster, dtype=torch.long) if block.moment is None else block.moment


def sensitivities(residuals: Residuals, place: Tensor) -> tuple[list[Block], Tensor]:
    """Return the residuals at a point with their central differences, and the widths of these, shape (U,).

    Steps go to both sides, as far as the range allows: one-sided differences bias the gradient, and in a narrow valley,
    such as that of wind, stiffness and density raised together, one-sided steps find no lower cost even far from the
    minimum.
    """
    unknowns = len(place)
    up, down = (place + STEP).clamp(max=1.0), (place - STEP).clamp(min=0.0)
    beside = [place + torch.diag(end - place) for end in (up, down)]
    found = []
    for block in residuals(torch.cat([place[None], *beside])):
        here, high, low = block.values.split([1, unknowns, unknowns])
        found.append(block.of(torch.cat([here, here + high - low])))
    return found, up - down


def linearised(residuals: Residuals, rescale: Rescale, place: Tensor) -> tuple[Normal, dict[str, float], list[Block]]:
    """Return the normal equations at a place, the standard deviations of its residuals, and the residuals."""
    blocks, steps = sensitivities(residuals, place)
    scales = rescale(blocks)
    return normal_equations(blocks, scales, steps), scales, blocks


def iterate(
    residuals: Residuals,
    rescale: Rescale,
    progress: Progress,
    tolerance: float,
    least_gain: float = LEAST_GAIN,
    retract: Retract = torch.add,
) -> None:
    """One iteration; ``progress`` is updated, also with the reason to stop.

    Args:
        residuals: Computes residuals.
        rescale: Standard deviations of the first variant's residuals.
        progress: The state to start from.
        tolerance: Smallest step worth another iteration, as a share of the ranges.
        least_gain: Smallest share of the cost worth another iteration.
        retract: Takes a step.
    """
    if progress.normal is None:
        progress.normal, progress.scales, _ = linearised(residuals, rescale, progress.place)
        if progress.normal.count == 0:
            raise DivergedError("Every simulation of a step diverged: narrow the ranges of `unknowns`.")
    normal, place = progress.normal, progress.place
    progress.iteration += 1

    def end_with(damping: float) -> Tensor:
        return retract(place, step_from(normal, place, damping) - place).clamp(0.0, 1.0)

    trial = end_with(progress.damping)
    there, scales, blocks = linearised(residuals, rescale, trial)
    cost = float(huber([block.of(block.values[:1]) for block in blocks], progress.scales)[0])
    shortened = not cost < normal.cost
    if shortened and float((trial - place).abs().amax()) < tolerance:  # a shorter one is none either
        progress.done = NO_STEP
        return
    if shortened:
        least = max(progress.damping * WORSE, LEAST_DAMPING)
        dampings = [least * WORSE**k for k in range(SHORTER)]
        trials = torch.stack([end_with(damping) for damping in dampings])
        costs = huber(residuals(trials), progress.scales)
        best = int(costs.argmin())
        cost, trial, progress.damping = float(costs[best]), trials[best], dampings[best]
        if not cost < normal.cost:
            progress.done = NO_STEP
            return
        there, scales, _ = linearised(residuals, rescale, trial)
    moved, gain = float((trial - place).abs().amax()), normal.cost - cost
    progress.place, progress.normal, progress.scales = trial, there, scales
    damped = progress.damping > LEAST_DAMPING
    if not shortened and gain > AS_EXPECTED * normal.cost * expected_gain(normal, trial - place):
        progress.damping *= BETTER
    if damped:  # a short step says nothing, but if it is the best
        progress.done = NO_STEP if shortened and moved < tolerance else ""
        return
    if moved < tolerance:
        progress.done = f"the last step was below {tolerance:g} of every range"
    elif gain < least_gain * normal.cost:
        progress.done = f"the last step lowered the cost by less than {least_gain:.2%}"


def step_from(normal: Normal, place: Tensor, damping: float = 0.0) -> Tensor:
    """Return the values after a damped step; an unknown at an end of its range that would leave it is kept."""
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


def expected_gain(normal: Normal, step: Tensor) -> float:
    """Expected relative decrease of the cost for a step, with linearised residuals."""
    fall = -(normal.gradient @ step + 0.5 * step @ normal.matrix @ step) / max(normal.count, 1)
    return float(fall) / max(normal.cost, 1e-300)


FAR = 0.005
"""Step, as a share of a range, above which the values have not settled."""
GAIN = 0.003
"""Least expected relative decrease of the cost by such a step; below it, the step would change nothing visible."""

_BEGIN = "put `pixels` last in `stages`, raise `search`, or give a `start` that is nearer"


def unsettled(normal: Normal, place: Tensor, unknowns: Sequence[Unknown], ended: str) -> str:
    """Return a sentence that says why the end of a fit is not a local minimum; empty if it is one.

    The sentence names what the next Gauss-Newton step would change, and the remedy. A lower minimum elsewhere is not
    detected.

    Args:
        normal: The normal equations at the end.
        place: The values at the end, as shares of the ranges, shape (U,).
        unknowns: The unknowns.
        ended: The reason why the last iterations ended, see :class:`~gaussian_swaying.fitting.least_squares.Progress`;
            empty if their number ran out.
    """
    step = step_from(normal, place) - place
    gain = expected_gain(normal, step)
    if float(step.abs().amax()) <= FAR or gain <= GAIN:
        return ""
    why = {"": "`iterations` ran out", NO_STEP: "no step lowered the cost"}.get(ended, ended)
    remedy = _BEGIN if ended else "raise `iterations` and continue with --resume"
    told = f"{changes(step.tolist(), unknowns, place)}, to lower the cost by {gain:.2g} of itself"
    return f"The values have not settled: {why}, but the sensitivities ask for {told}: {remedy}."
