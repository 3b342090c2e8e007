"""Measures of motion: does a thing sway?"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from torch import Tensor

Array: TypeAlias = np.ndarray | Tensor

MOVES = 0.1  # a point moves if its largest displacement is over this share of the scale of all
FEWEST = 8  # frames


@dataclass(frozen=True)
class SwayScore:
    """Motion of a thing in the wind, by :func:`sway_score`.

    A *moving* point has a largest displacement over a tenth of that which 98 % of all points stay below. The *side* is
    the longest side of the box around the moving points at rest, without 1 % of them at each end. All else is measured
    after the first seconds, which are skipped. The *top* is the tenth of the moving points for which the length of the
    mean displacement plus the RMS (root mean square) of the fluctuation about it is largest.

    Attributes:
        lean: Mean over the top of the length of the mean displacement, over the side.
        sway: RMS of the fluctuation of the top, over the side.
        ratio: ``sway`` over ``lean``. A natural wind gives some 0.2 to 0.6; below 0.1 a thing leans and stands still.
        peak: Frequency at which the fluctuation of the mean of the top has most power along its main axis [Hz].
        peak_share: Share of the power above 0.05 Hz that lies between 2/3 and 4/3 of ``peak``.
        drift: Change of the mean displacement of the top from the first half of the time to the second, over that
            length that ``lean`` is a share of: a thing that still creeps.
        cross: Minor over major axis of the fluctuation of the mean of the top, by its two largest standard deviations.
            Nature's is some 0.4 to 0.9; a sine along one line has 0.
        stiller: Median of the largest displacements of the points that do not move, over the side; 0 if all move.
        moving_share: Share of the points that move.
        side: The side [unit of the positions].
    """

    lean: float
    sway: float
    ratio: float
    peak: float
    peak_share: float
    drift: float
    cross: float
    stiller: float
    moving_share: float
    side: float


def sway_score(rest: Array, displacement: Array, times: Array, skip: float = 2.0) -> SwayScore:
    """Measure whether a thing sways, or leans, rocks, trembles or creeps.

    Args:
        rest: Positions of points at rest, in any unit, shape (N, 3).
        displacement: Displacements from there in each frame, shape (T, N, 3).
        times: Times of the frames, evenly spaced [s], shape (T,).
        skip: Time before which frames are ignored, as the wind still pushes the thing over [s].

    Returns:
        The score, without units but for ``peak`` [Hz] and ``side``. If nothing moves, all is 0 or NaN.
    """
    rest, displacement, times = _numbers(rest), _numbers(displacement), _numbers(times)
    if rest.ndim != 2 or displacement.shape != (len(times), *rest.shape):
        raise ValueError(
            "Expected `rest` (N, 3), `displacement` (T, N, 3) and `times` (T,), but got shapes "
            f"{rest.shape}, {displacement.shape} and {times.shape}."
        )
    late = times >= skip
    if late.sum() < FEWEST:
        raise ValueError(
            f"Expected at least {FEWEST} frames from `skip` = {skip:g} s on, but got {late.sum()}: give more frames."
        )
    step = _step(times[late])
    farthest = np.linalg.norm(displacement, axis=2).max(axis=0)
    moving = farthest > MOVES * np.quantile(farthest, 0.98)
    if not moving.any():
        nan = math.nan
        return SwayScore(0.0, 0.0, nan, nan, nan, nan, nan, 0.0, 0.0, nan)
    low, high = np.quantile(rest[moving], [0.01, 0.99], axis=0)
    side = max(float((high - low).max()), np.finfo(np.float64).tiny)

    moved = displacement[late][:, moving]
    mean = moved.mean(axis=0)
    fluctuation = moved - mean
    rms = np.sqrt(np.square(fluctuation).sum(axis=2).mean(axis=0))
    activity = np.linalg.norm(mean, axis=1) + rms
    top = activity >= np.quantile(activity, 0.9)
    leaning = max(float(np.linalg.norm(mean[top], axis=1).mean()), 1e-9 * side)
    swaying = float(np.sqrt(np.square(rms[top]).mean()))

    of_top = moved[:, top].mean(axis=1)
    first, second = np.split(of_top, [len(of_top) // 2])
    along, spreads, _ = np.linalg.svd(of_top - of_top.mean(axis=0), full_matrices=False)
    peak, share = _peak(along[:, 0] * spreads[0], step)
    return SwayScore(
        lean=leaning / side,
        sway=swaying / side,
        ratio=swaying / leaning,
        peak=peak,
        peak_share=share,
        drift=float(np.linalg.norm(second.mean(axis=0) - first.mean(axis=0))) / leaning,
        cross=float(spreads[1] / spreads[0]) if spreads[0] > 0 else 0.0,
        stiller=float(np.median(farthest[~moving])) / side if not moving.all() else 0.0,
        moving_share=float(moving.mean()),
        side=side,
    )


def _numbers(values: Array) -> np.ndarray:
    """Plain float64 numbers of an array or a tensor on any device."""
    return np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values, dtype=np.float64)


def _step(times: np.ndarray) -> float:
    """The time from frame to frame, which must be the same throughout [s]."""
    steps = np.diff(times)
    step = float(steps.mean())
    if step <= 0 or np.abs(steps - step).max() > 0.01 * step:
        raise ValueError("Expected `times` that increase evenly, but they do not: give frames of one interval.")
    return step


def _peak(line: np.ndarray, step: float) -> tuple[float, float]:
    """Frequency of most power [Hz], and the share of the power near it.

    A straight line is removed, the rest weighted by a Hann window and filled up with zeros to four times its length.
    Frequencies with fewer than 1.5 periods in the whole time cannot be the peak.
    """
    count, duration = len(line), (len(line) - 1) * step
    time = np.arange(count) * step
    level = line - np.polyval(np.polyfit(time, line, deg=1), time)
    power = np.square(np.abs(np.fft.rfft(level * np.hanning(count), n=4 * count)))
    frequency = np.fft.rfftfreq(4 * count, step)
    peak = float(frequency[np.argmax(np.where(frequency > 1.5 / duration, power, -1.0))])
    near = (frequency > peak * 2 / 3) & (frequency < peak * 4 / 3)
    total = float(power[frequency > 0.05].sum())
    return peak, float(power[near].sum()) / total if total > 0 else math.nan
