"""A typical stretch of turbulence: ten seconds of wind in which a thing moves as it does in the long run.

Ten seconds of real wind are seldom typical: their mean may lie a third off. The motion in a long record follows from
the modes and the wind at some places, linearly, and the stretch is taken whose motion is closest to that of the record.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch

from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.formulations.modes import Modes

SAMPLES, RATE, LEAST_RATE, PER_PERIOD = 22_500, 25.0, 8.0, 14.0  # of a record; in a second; in a period
PLACES = 24  # at which the wind is taken
SKIPPED, SHORTEST, PERIODS = 2.0, 10.0, 10.0  # s at the start; s, and periods, of a stretch
RINGING = 12  # modes whose motion before the start is taken off
STEP, COMPARED = 0.24, 700  # s between stretches; those with the best means whose fluctuation is compared
DRIFT, OFF = 0.01, 0.03  # small differences of the halves, and from the record, over the mean
RESTLESS = 0.65  # fluctuation over the mean, at most
LEAD = 2.5  # power at the frequency over that below, at least
SHARE = (0.2, 0.65)  # share of the power near the frequency
ROUND = (0.5, 0.85)  # minor over major axis


Motion = tuple[np.ndarray, Callable[[int, int], np.ndarray]]
"""Displacement in a long record, (T, 3), and what remains of it from before a sample, in the samples after it."""


def rate_for(frequency: float) -> float:
    """Samples in a second of the record of a thing with a first frequency [Hz]."""
    return min(max(PER_PERIOD * frequency, LEAST_RATE), RATE)


def typical_start(motion: Motion, frequency: float) -> float:
    """Time at which a typical stretch begins [s].

    The stretch lasts ten seconds or ten periods, whichever is longer, after two seconds. In it the top has the mean and
    the fluctuation of the whole record, the same mean in both halves, and more power at its frequency than below.

    Args:
        motion: The motion at :func:`rate_for` the frequency.
        frequency: First frequency [Hz].
    """
    rate, (moved, ringing) = rate_for(frequency), motion
    length = round(max(SHORTEST, PERIODS / frequency) * rate)
    skipped, settled = round(SKIPPED * rate), round(min(20 / frequency, 60.0) * rate)
    whole = moved[settled:]
    mean, spread = np.linalg.norm(whole.mean(0)), float(np.linalg.norm(whole.std(0)))
    begin = np.arange(settled, len(moved) - length, max(1, round(STEP * rate)))
    sums = np.concatenate([np.zeros((1, 3)), moved.cumsum(0)])
    half = (length - skipped) // 2
    first, second = (
        (sums[begin + skipped + k * half + half] - sums[begin + skipped + k * half]) / half for k in range(2)
    )
    drift = np.linalg.norm(first - second, axis=1) / mean / DRIFT
    off = np.linalg.norm(0.5 * (first + second) - whole.mean(0), axis=1) / mean / OFF
    chosen = begin[(drift + off).argsort()[:COMPARED]]
    faults = []
    for k in chosen:
        part = (moved[k : k + length] - ringing(k, length))[skipped:]
        apart = np.linalg.norm(part[:half].mean(0) - part[half:].mean(0)) / DRIFT
        away = np.linalg.norm(part.mean(0) - whole.mean(0)) / OFF
        restless = max(float(np.linalg.norm(part.std(0))) / mean - RESTLESS, 0.0) / 0.1
        faults.append((apart + away) / mean + restless + _fault(part, spread, frequency / rate))
    return float(chosen[int(np.argmin(faults))] / rate)


def linear_motion(bound: Modes, force: WindForce, wind: WindField, top: np.ndarray, rate: float) -> Motion:
    """Mean displacement of some sites in a long record of a wind, without turns [m].

    The air's damping is that in the mean wind, as a diagonal: three quarters of that along it.

    Args:
        bound: The modes of the body, of one scene.
        force: The force of the wind on it.
        wind: The turbulent wind.
        top: The sites whose motion counts, shape (K,).
        rate: Samples in a second.
    """
    from scipy.cluster.vq import kmeans2

    grouped, aero = bound._grouped(force), force.aero
    assert isinstance(grouped, WindForce)
    assert grouped.sums is not None
    tensor, area = grouped.sums.tensor.double().cpu(), grouped.sums.area.double().cpu()
    eye = torch.eye(3, dtype=torch.float64)
    drag, friction = float(aero.C_D), float(aero.C_F)
    pressed = 0.5 * aero.air_density * (drag * tensor + friction * (area[:, None, None] * eye - tensor))
    shape = bound.site_shape.double().cpu().unflatten(0, (-1, 3))
    pull = pressed @ shape  # of a unit of |u| u, shape (S, 3, M)
    place = bound.site_rest.double().cpu()
    centre, label = kmeans2(place.numpy(), min(PLACES, len(place)), seed=0, minit="++")
    of_place = torch.zeros(len(centre), 3, pull.shape[-1], dtype=torch.float64)
    of_place.index_add_(0, torch.from_numpy(label).long(), pull)
    air = _air(wind, torch.from_numpy(centre), rate)
    push = (air.norm(dim=-1, keepdim=True) * air).flatten(1) @ of_place.flatten(0, 1)
    square, speed = bound.square.double().cpu(), float(wind.flows[0].norm())
    omega = square.sqrt()
    weight = (pressed * speed) @ shape
    alpha = bound.ratio.double().cpu() * omega + 0.75 * (shape * weight).sum((0, 1))
    tip = shape[torch.from_numpy(top)].mean(0)
    return _motion(push.numpy(), square.numpy(), torch.minimum(alpha, 0.95 * omega).numpy(), tip.numpy(), rate)


def cloth_motion(wind: WindField, places: torch.Tensor, frequency: float, ratio: float) -> Motion:
    """Motion of one oscillator along each axis in the mean wind of some places, as that of a hanging cloth.

    Args:
        wind: The turbulent wind.
        places: Places [m], shape (K, 3).
        frequency: Frequency [Hz].
        ratio: Damping ratio, with that of the air.
    """
    rate, omega = rate_for(frequency), 2 * math.pi * frequency
    air = _air(wind, places.double().cpu(), rate).mean(1)
    push = (air.norm(dim=-1, keepdim=True) * air).numpy()
    return _motion(push, np.full(3, omega**2), np.full(3, ratio * omega), np.eye(3), rate)


def _air(wind: WindField, places: torch.Tensor, rate: float) -> torch.Tensor:
    """Wind at places (K, 3) in a long record [m/s], shape (T, K, 3)."""
    times = torch.arange(SAMPLES, dtype=torch.float64) / rate
    flow = wind.flows[0].double().cpu()  # carries the turbulence, so an earlier place is a later time
    where = (places - times[:, None, None] * flow).reshape(-1, 3)
    return wind.at(times[0], where).double().reshape(len(times), -1, 3)


def _motion(push: np.ndarray, square: np.ndarray, alpha: np.ndarray, tip: np.ndarray, rate: float) -> Motion:
    """The motion of a tip by modes of given loads (T, M), squares of frequencies, decay rates and shapes (3, M)."""
    from scipy.signal import lfilter

    dt, moved = 1 / rate, np.zeros((len(push), 3))
    free = []  # decay, frequency, amplitudes and tip of each mode that matters
    for k in range(len(square)):
        a, w = float(alpha[k]), math.sqrt(float(square[k] - alpha[k] ** 2))
        decay, sine, cosine = math.exp(-a * dt), math.sin(w * dt), math.cos(w * dt)
        # exact for steps of the load: q + 2 poles
        b1 = 1 - decay * (cosine + a / w * sine)
        b2 = decay * (decay + a / w * sine - cosine)
        amplitude = lfilter([0.0, b1, b2], [1.0, -2 * decay * cosine, decay**2], push[:, k]) / float(square[k])
        moved += amplitude[:, None] * tip[:, k]
        free.append((a, w, amplitude, tip[:, k], float(amplitude.std() * np.linalg.norm(tip[:, k]))))
    free.sort(key=lambda mode: -mode[-1])

    def ringing(start: int, samples: int) -> np.ndarray:
        time, left = np.arange(samples) * dt, np.zeros((samples, 3))
        for a, w, amplitude, way, _ in free[:RINGING]:
            q, p = amplitude[start], (amplitude[start + 1] - amplitude[start - 1]) / (2 * dt)
            swing = q * np.cos(w * time) + (p + a * q) / w * np.sin(w * time)
            left += (np.exp(-a * time) * swing)[:, None] * way
        return left

    return moved, ringing


def _fault(part: np.ndarray, spread: float, frequency: float) -> float:
    """Distance of the fluctuation of a stretch (T, 3) from a typical one: the sum of its faults, each over a small one.

    The frequency is that for each sample.
    """
    apart = part - part.mean(0)
    uneven = abs(np.log(np.linalg.norm(apart.std(0)) / spread))
    left, sizes, _ = np.linalg.svd(apart, full_matrices=False)
    narrow = max(ROUND[0] - sizes[1] / sizes[0], sizes[1] / sizes[0] - ROUND[1], 0.0)
    if 1.15 * frequency > 0.5:  # it follows the wind: its own vibration is not in the record
        return float(uneven / 0.2 + narrow / 0.1)
    line, time = left[:, 0], np.arange(len(part))
    line = line - np.polyval(np.polyfit(time, line, 1), time)
    power = np.abs(np.fft.rfft(line * np.hanning(len(line)), 4 * len(line))) ** 2
    f = np.fft.rfftfreq(4 * len(line)) / frequency
    own, below = (f > 0.85) & (f < 1.15), (f > 1.5 / len(line) / frequency) & (f <= 0.75)
    lead = power[own].max() / max(power[below].max(initial=0.0), 1e-300)
    share = power[(f > 2 / 3) & (f < 4 / 3)].sum() / power.sum()
    tonal = max(share - SHARE[1], SHARE[0] - share, 0.0)
    return uneven / 0.2 + (narrow + tonal) / 0.1 + max(np.log(LEAD / lead), 0.0) / 0.1


__all__ = ["Motion", "cloth_motion", "linear_motion", "rate_for", "typical_start"]
