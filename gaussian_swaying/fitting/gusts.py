r"""Gusts as a spectrum: mean, intensity and time scale of a wind whose speed was fitted at some times of a film.

The speed is taken for a process of Ornstein and Uhlenbeck, with the covariance :math:`\sigma^2 e^{-t/\tau}`, which was
seen for a while and with errors. All that it may have been is weighed by its likelihood, so that the intervals contain
both the errors of the fit and that a short film shows few gusts.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.fitting.unknowns import CHANGES, Unknown

STEPS = 24
"""Values of each of intensity and time scale that are weighed."""
WEAKEST, STRONGEST, LONGEST = 0.005, 2.0, 5.0
"""Range of the intensity, and longest time scale per length of the film; all are as likely beforehand on a logarithmic
scale."""
APART = 5.0
"""Largest ratio of the ends of an interval within which a time scale counts as told."""
QUANTILES = (0.5, 0.16, 0.84)
_NORMAL = torch.distributions.Normal(0.0, 1.0).icdf((torch.arange(9, dtype=torch.float64) + 0.5) / 9)

Interval = tuple[float, float, float]
"""Median, and the ends of the middle 68 %."""


@dataclass(frozen=True)
class Gusts:
    """The spectrum of a wind.

    Attributes:
        mean: Mean speed [m/s].
        intensity: Standard deviation of the speed over its mean.
        time_scale: Time after which the speed is alike by 1/e [s].
        seconds: For which the wind was seen [s].
    """

    mean: Interval
    intensity: Interval
    time_scale: Interval
    seconds: float

    @property
    def told(self) -> bool:
        _, low, high = self.time_scale
        return high < min(APART * low, self.seconds)

    def sentence(self) -> str:
        mean, intensity, time = (
            "{:.2g} ({:.2g} to {:.2g})".format(*own) for own in (self.mean, self.intensity, self.time_scale)
        )
        scale = f"their time scale {time} s"
        if not self.told:
            scale = f"{self.seconds:.2g} s are too short to tell {scale}: film longer"
        return f"gusts: the mean speed is {mean} m/s, their intensity {intensity}, and {scale}"


def spectrum(times: Sequence[float], speeds: Tensor, covariance: Tensor) -> Gusts:
    """Mean, intensity and time scale of a speed that is known at some times.

    Args:
        times: The times [s], ascending, N of them.
        speeds: The speeds [m/s], float64, shape (N,).
        covariance: Covariance of their errors [m²/s²], shape (N, N).
    """
    moments = torch.tensor(times, dtype=torch.float64)
    length, closest = float(moments[-1] - moments[0]), float(moments.diff().amin())
    scale = torch.logspace(math.log10(0.5 * closest), math.log10(LONGEST * length), STEPS, dtype=torch.float64)
    share = torch.logspace(math.log10(WEAKEST), math.log10(STRONGEST), STEPS, dtype=torch.float64)
    tau, sigma = scale.repeat(STEPS), (share * float(speeds.mean())).repeat_interleave(STEPS)
    apart = (moments[:, None] - moments).abs()
    matrix = sigma.square()[:, None, None] * torch.exp(-apart / tau[:, None, None]) + covariance
    matrix = matrix + 1e-9 * float(speeds.square().mean()) * torch.eye(len(moments), dtype=torch.float64)
    root = torch.linalg.cholesky(matrix)
    white = torch.linalg.solve_triangular(root, torch.stack([speeds, torch.ones_like(speeds)], -1), upper=False)
    known = white[..., 1].square().sum(-1)  # one over the variance of the mean
    mean = (white[..., 0] * white[..., 1]).sum(-1) / known
    left = (white[..., 0] - mean[:, None] * white[..., 1]).square().sum(-1)
    weight = torch.softmax(-root.diagonal(dim1=-2, dim2=-1).log().sum(-1) - 0.5 * (known.log() + left), 0)
    means = mean[:, None] + _NORMAL / known.sqrt()[:, None]
    each = weight[:, None].expand_as(means) / len(_NORMAL)
    return Gusts(
        _quantiles(means.flatten(), each.flatten()),
        _quantiles((sigma[:, None] / means.abs()).flatten(), each.flatten()),
        _quantiles(tau, weight),
        length,
    )


def gusts_of(unknowns: Sequence[Unknown], place: Sequence[float], covariance: Tensor) -> Gusts | None:
    """The gusts of a fitted wind; None if its speed was not fitted at several times.

    Args:
        unknowns: The unknowns.
        place: Their values, as shares of the ranges.
        covariance: Covariance of the shares, shape (U, U).
    """
    names = [u.name for u in unknowns]
    knots = sorted((float(name.split("@")[1]), k) for k, name in enumerate(names) if name.startswith(CHANGES[0]))
    if not knots or "wind.speed" not in names:
        return None
    first = names.index("wind.speed")
    base, slope = unknowns[first].value(place[first]), unknowns[first].slope(place[first])
    speeds, slopes = [base], torch.zeros(1 + len(knots), len(names), dtype=torch.float64)
    slopes[0, first] = slope
    for row, (_, k) in enumerate(knots, start=1):
        factor = unknowns[k].value(place[k])
        speeds.append(base * factor)
        slopes[row, first], slopes[row, k] = factor * slope, base * unknowns[k].slope(place[k])
    times = [0.0, *(time for time, _ in knots)]
    return spectrum(times, torch.tensor(speeds, dtype=torch.float64), slopes @ covariance.double() @ slopes.T)


def _quantiles(values: Tensor, weight: Tensor) -> Interval:
    order = values.argsort()
    total = weight[order].cumsum(0)
    found = [float(values[order[min(int((total < q).sum()), len(order) - 1)]]) for q in QUANTILES]
    return found[0], found[1], found[2]
