"""A typical stretch of turbulence: ten seconds of wind whose mean and gusts are those of a long record.

Ten seconds of real wind are seldom typical: their mean may lie a third off. What is typical is judged by the motion of
one oscillator in the wind at the middle of the object.
"""

from __future__ import annotations

import numpy as np
import torch

from gaussian_swaying.aero.wind import SpatialWind, WindField

RECORD, RATE = 240.0, 25.0  # s; samples in a second
SKIPPED, SHORTEST, PERIODS = 2.0, 10.0, 10.0  # s at the start; s, and periods, of a stretch
LEAD = 2.5  # power at the frequency over that below, at least
STEP = 0.2  # s between stretches that are compared


def typical_start(
    wind: WindField | SpatialWind, places: torch.Tensor, frequency: float, damping_ratio: float
) -> float:
    """Time at which a typical stretch begins [s].

    The stretch lasts ten seconds or ten periods, whichever is longer, after two seconds. In it the oscillator has the
    mean and the fluctuation of the whole record, the same mean in both halves, and more power at its frequency than below.

    Args:
        wind: The wind.
        places: Some places of the object, of whose winds the mean counts [m], shape (K, 3).
        frequency: Frequency of the oscillator [Hz].
        damping_ratio: Its damping ratio, with that of the air.
    """
    if not isinstance(wind, WindField) or wind.uniform or not bool(wind.flows.any()):
        return 0.0
    times = torch.arange(round(RECORD * RATE), dtype=torch.float64) / RATE
    flow = wind.flows[0].cpu()  # carries the turbulence, so an earlier place is a later time
    where = (places.double().cpu() - times[:, None, None] * flow).reshape(-1, 3)
    velocity = wind.at(times[0], where).double().reshape(len(times), -1, 3).mean(1).numpy()
    along = flow.numpy()
    along = along / np.linalg.norm(along)
    across = np.array([-along[1], along[0], 0.0])
    push = np.linalg.norm(velocity, axis=1)[:, None] * np.stack([velocity @ along, velocity @ across], 1)
    moved = _oscillator(push, frequency, damping_ratio)
    length = round(max(SHORTEST, PERIODS / frequency) * RATE)
    skipped, settled = round(SKIPPED * RATE), round(min(10 / frequency, 20.0) * RATE)
    whole = moved[settled:]
    mean, spread = float(whole[:, 0].mean()), float(whole[:, 0].std())
    least, best = np.inf, 0
    for begin in range(settled, len(moved) - length, round(STEP * RATE)):
        part = moved[begin + skipped : begin + length]
        fault = _fault(part, mean, spread, frequency)
        if fault < least:
            least, best = fault, begin
    return best / RATE


def _oscillator(push: np.ndarray, frequency: float, ratio: float) -> np.ndarray:
    """Displacement of an oscillator of unit stiffness under forces, shape (T, 2), exact for steps of them."""
    omega, dt = 2 * np.pi * frequency, 1 / RATE
    ratio = min(ratio, 0.95)
    damped, decay = omega * np.sqrt(1 - ratio**2), np.exp(-ratio * omega * dt)
    cosine, sine = np.cos(damped * dt), np.sin(damped * dt) / damped
    place, speed, found = push[0].copy(), np.zeros(2), np.empty_like(push)
    for k, force in enumerate(push):
        found[k] = place
        apart, alpha = place - force, ratio * omega
        place = force + decay * (apart * (cosine + alpha * sine) + speed * sine)
        speed = decay * (speed * (cosine - alpha * sine) - apart * omega**2 * sine)
    return found


def _fault(part: np.ndarray, mean: float, spread: float, frequency: float) -> float:
    """How far a stretch (T, 2) is from a typical one: the sum of its faults, each over what is small."""
    half = len(part) // 2
    drift = abs(part[:half, 0].mean() - part[half:, 0].mean()) / mean
    off = abs(part[:, 0].mean() / mean - 1)
    apart = part - part.mean(0)
    uneven = abs(np.log(apart[:, 0].std() / spread))
    sizes = np.sqrt(np.linalg.eigvalsh(np.cov(apart.T)).clip(0))
    narrow = max(0.5 - sizes[0] / sizes[1], 0.0, sizes[0] / sizes[1] - 0.85)
    line = np.linalg.svd(apart, full_matrices=False)[0][:, 0]
    time = np.arange(len(line))
    line = line - np.polyval(np.polyfit(time, line, 1), time)
    power = np.abs(np.fft.rfft(line * np.hanning(len(line)), 4 * len(line))) ** 2
    f = np.fft.rfftfreq(4 * len(line), 1 / RATE) / frequency
    own, below = (f > 0.85) & (f < 1.15), (f > 1.5 * RATE / len(line) / frequency) & (f <= 0.75)
    lead = power[own].max() / max(power[below].max(initial=0.0), 1e-300)
    return drift / 0.01 + off / 0.1 + uneven / 0.2 + narrow / 0.1 + max(np.log(LEAD / lead), 0.0) / 0.1


__all__ = ["typical_start"]
