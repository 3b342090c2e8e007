"""A typical stretch of turbulence: ten seconds of wind in which a thing moves as it does in the long run.

Ten seconds of real wind are seldom typical: their mean may lie a third off. The motion in a long record follows from
the modes and the wind at some places, linearly, and the stretch is taken whose motion is closest to that of the record.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch

from gaussian_swaying.mpm.modes import Modes
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import WindForce

SAMPLES, RATE, LEAST_RATE, PER_PERIOD = 60_000, 25.0, 6.0, 10.0  # of a record; in a second; in a period
PLACES, LINES, BLOCK = 96, 20, 12  # at which the wind is taken; lines along it on which they lie; added at once
SKIPPED, SHORTEST, PERIODS = 2.0, 10.0, 10.0  # s at the start; s, and periods, of a stretch
FASTEST, RINGING = 3.0, 12  # frequency over the first above which a mode does not swing; modes that ring on
STEP, TOGETHER = 0.32, 256  # s between stretches; stretches that are compared at once
# what a typical stretch has, and how far off counts as a fault: over the mean, in the last three as a ratio or its log
DRIFT, OFF, RESTLESS = (0.0, 0.03, 0.02), (0.0, 0.12, 0.08), (0.25, 0.68, 0.07)
EVEN, ROUND, SHARE, LEAD = (0.0, 0.2, 0.2), (0.47, 0.85, 0.05), (0.2, 0.65, 0.1), (0.2, math.inf, 0.3)
ALIKE = 0.8  # minor over major axis of a motion, above which the two may be exchanged


Motion = tuple[np.ndarray, Callable[[np.ndarray, int], np.ndarray]]
"""Displacement in a long record, (S, 3), and what is left of it in samples after some (W,), (W, T, 3)."""


def rate_for(frequency: float) -> float:
    """Samples in a second of the record of a thing with a first frequency [Hz]."""
    return min(max(PER_PERIOD * frequency, LEAST_RATE), RATE)


class Response(NamedTuple):
    """Slow complex vibrations of a tip, and what of a load on the modes each takes.

    Attributes:
        root: Their complex frequencies [1/s], shape (K,).
        out: The motion of the tip by their amplitudes, shape (3, K).
        taken: Real and imaginary loads on them, and what the tip moves at once, by loads on the modes, (M, 2 K + 3).
    """

    root: np.ndarray
    out: np.ndarray
    taken: np.ndarray


def typical_start(motion: Motion, frequency: float, tonal: bool = True) -> float:
    """Time at which a typical stretch begins [s].

    The stretch lasts ten seconds or ten periods, whichever is longer, after two seconds. In it the top has the mean and
    the fluctuation of the whole record, the same mean in both halves, and more power at its frequency than below.

    Args:
        motion: The motion at :func:`rate_for` the frequency.
        frequency: First frequency [Hz].
        tonal: Whether its vibration is that of the record; otherwise only the means count, as for a cloth that flaps.
    """
    rate, (moved, ringing) = rate_for(frequency), motion
    length = round(max(SHORTEST, PERIODS / frequency) * rate)
    skipped, settled = round(SKIPPED * rate), round(min(20 / frequency, 60.0) * rate)
    whole = moved[settled:]
    begin = np.arange(settled, len(moved) - length, max(1, round(STEP * rate)))
    faults = []
    for some in np.array_split(begin, max(1, len(begin) // TOGETHER)):
        part = moved[some[:, None] + np.arange(length)] - ringing(some, length)
        faults.append(_faults(part[:, skipped:], whole, frequency / rate if tonal else math.inf))
    return float(begin[int(np.argmin(np.concatenate(faults)))] / rate)


def linear_motion(bound: Modes, force: WindForce, wind: WindField, top: torch.Tensor, rate: float) -> Motion:
    """Mean displacement of some sites in a long record of a wind, without turns [m].

    The air's damping is that in the mean wind, twice as strong along it as across.

    Args:
        bound: The modes of the body, of one scene.
        force: The force of the wind on it.
        wind: The turbulent wind.
        top: Share of each site in the top, shape (S,).
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
    square, flow = bound.square.double().cpu(), wind.flows[0].double().cpu()
    along = torch.nn.functional.normalize(flow, dim=0)
    weight = pressed * flow.norm() @ (eye + torch.outer(along, along))
    damping = torch.diag(2 * bound.ratio.double().cpu() * square.sqrt())
    damping = damping + shape.flatten(0, 1).T @ (weight @ shape).flatten(0, 1)
    tip = (top[:, None, None] * shape).sum(0)
    centre, label = kmeans2(place.numpy(), min(PLACES, len(place)), seed=0, minit="++")
    response = _response(square.numpy(), damping.numpy(), tip.numpy(), FASTEST * bound.first)
    pull = pull @ torch.from_numpy(response.taken)
    of_place = torch.zeros(len(centre), 3, pull.shape[-1], dtype=torch.float64)
    of_place.index_add_(0, torch.from_numpy(label).long(), pull)
    return _motion(_push(wind, torch.from_numpy(centre), of_place, rate), response, rate)


def cloth_motion(wind: WindField, places: torch.Tensor, frequency: float, ratio: float) -> Motion:
    """Motion of one oscillator along each axis in the mean wind of some places, as that of a hanging cloth.

    Args:
        wind: The turbulent wind.
        places: Places [m], shape (K, 3).
        frequency: Frequency [Hz].
        ratio: Damping ratio, with that of the air.
    """
    rate, omega = rate_for(frequency), 2 * math.pi * frequency
    air = _air(wind, places.double().cpu(), rate, SAMPLES, 0).mean(1)
    push = (air.norm(dim=-1, keepdim=True) * air).numpy()
    response = _response(np.full(3, omega**2), 2 * ratio * omega * np.eye(3), np.eye(3), math.inf)
    return _motion(push @ response.taken, response, rate)


def _push(wind: WindField, places: torch.Tensor, pull: torch.Tensor, rate: float) -> np.ndarray:
    """Loads in a long record, (T, C), by places (K, 3) and what |u| u pulls there, (K, 3, C).

    What the wind carries comes to the places on one line along it one after the other.
    """
    from scipy.cluster.vq import kmeans2

    flow = wind.flows[0].double().cpu()
    along = torch.nn.functional.normalize(flow, dim=0)
    down = places @ along
    across = places - down[:, None] * along
    line, label = kmeans2(across.numpy(), min(LINES, len(places)), seed=0, minit="++")
    late = (down / flow.norm() * rate).numpy()  # in samples
    before, first = math.ceil(late.max()) + 1, math.floor(late.min())
    air = _air(wind, torch.from_numpy(line), rate, SAMPLES + before - first, before)
    pressed = (air.norm(dim=-1, keepdim=True) * air).numpy()
    push = np.zeros((SAMPLES, pull.shape[-1]))
    for some in np.array_split(np.arange(len(late)), max(1, len(late) // BLOCK)):
        at = []
        for k in some:
            n, here = math.floor(late[k]), pressed[:, label[k]]
            begin, share = before - n, late[k] - n
            at.append((1 - share) * here[begin : begin + SAMPLES] + share * here[begin - 1 : begin - 1 + SAMPLES])
        push += np.concatenate(at, 1) @ pull[some].flatten(0, 1).numpy()
    return push


def _air(wind: WindField, places: torch.Tensor, rate: float, samples: int, before: int) -> torch.Tensor:
    """Wind at places (K, 3) in a record that begins some samples ``before`` time zero [m/s], shape (T, K, 3)."""
    times = (torch.arange(samples, dtype=torch.float64) - before) / rate
    flow = wind.flows[0].double().cpu()  # carries the turbulence, so an earlier place is a later time
    where = (places - times[:, None, None] * flow).reshape(-1, 3).float()
    return wind.at(torch.zeros((), dtype=torch.float64), where).double().reshape(len(times), -1, 3)


def _response(square: np.ndarray, damping: np.ndarray, tip: np.ndarray, fastest: float) -> Response:
    """How a tip (3, M) answers to loads on modes of squares of frequencies (M,) and damping [1/s], (M, M).

    Vibrations faster than some circular frequency follow the load at once.
    """
    zero = np.zeros(damping.shape)
    root, left = np.linalg.eig(np.block([[zero, np.eye(len(zero))], [-np.diag(square), -damping]]))
    into, out = np.linalg.inv(left)[:, len(zero) :], tip @ left[: len(zero)]
    out = out * np.where(root.imag > 0, 2.0, 1.0)  # with its conjugate
    slow = (root.imag >= 0) & (abs(root) < fastest)
    fast = (root.imag >= 0) & ~slow
    at_once = (out[:, fast] / -root[fast]) @ into[fast]
    return Response(root[slow], out[:, slow], np.concatenate([into[slow].real, into[slow].imag, at_once.real]).T)


def _motion(load: np.ndarray, response: Response, rate: float) -> Motion:
    """The motion of a tip under the loads of a response, (T, 2 K + 3)."""
    count, dt = len(response.root), 1 / rate
    moved, free = load[:, 2 * count :].copy(), []
    for k, root in enumerate(response.root):
        decay = np.exp(root * dt * np.arange(len(load)))  # exact for steps of the load
        amplitude = _convolved(load[:, k] + 1j * load[:, count + k], decay * (decay[1] - 1) / root)
        moved += (amplitude[:, None] * response.out[:, k]).real
        free.append((float(amplitude.std() * np.linalg.norm(response.out[:, k])), root, amplitude, response.out[:, k]))
    free.sort(key=lambda mode: -mode[0])

    def ringing(start: np.ndarray, samples: int) -> np.ndarray:
        time, left = np.arange(samples) * dt, np.zeros((len(start), samples, 3))
        for _, root, amplitude, way in free[:RINGING]:
            left += ((amplitude[start][:, None] * np.exp(root * time))[..., None] * way).real
        return left

    return moved, ringing


def _convolved(load: np.ndarray, answer: np.ndarray) -> np.ndarray:
    """The sum over past samples of a load (T,) times the answer (T,) to each, from the next sample on."""
    samples = len(load)
    both = np.fft.ifft(np.fft.fft(load, 2 * samples) * np.fft.fft(answer, 2 * samples))[: samples - 1]
    return np.concatenate([np.zeros(1), both])


def _fault(value: Any, allowed: tuple[float, float, float]) -> Any:
    """One for a value outside its range by the last number or more, and a little more the farther it is."""
    low, high, size = allowed
    apart = np.maximum(np.maximum(low - value, value - high), 0.0) / size
    return np.minimum(apart, 1.0) + 0.5 * apart


def _faults(part: np.ndarray, whole: np.ndarray, frequency: float) -> np.ndarray:
    """Faults of stretches (W, T, 3) of a record (S, 3): means, size and roundness of the fluctuation, and its spectrum.

    The frequency is that for each sample; where it is infinite, only the means count.
    """
    count, half = part.shape[1], part.shape[1] // 2
    mean, spread = np.linalg.norm(whole.mean(0)), np.linalg.norm(whole.std(0))
    own_mean = part.mean(1)
    apart = part - own_mean[:, None]
    drift = np.linalg.norm(part[:, :half].mean(1) - part[:, half:].mean(1), axis=1) / mean
    off = np.linalg.norm(own_mean - whole.mean(0), axis=1) / mean
    if math.isinf(frequency):
        return drift / DRIFT[2] + off / OFF[2]
    square, axes = np.linalg.eigh(np.swapaxes(apart, 1, 2) @ apart / count)
    size = np.sqrt(square.sum(1))
    found = _fault(drift, DRIFT) + _fault(off, OFF) + _fault(size / mean, RESTLESS)
    found = found + _fault(abs(np.log(size / spread)), EVEN)
    found = found + _fault(np.sqrt(np.maximum(square[:, 1], 0) / square[:, 2]), ROUND)
    if 1.15 * frequency > 0.5:  # its own vibration is not in the record
        return found
    time = np.linspace(-1.0, 1.0, count)
    line = np.swapaxes(axes[:, :, 1:], 1, 2) @ np.swapaxes(apart, 1, 2)
    line = line - (line @ time / (time @ time))[..., None] * time
    power = np.abs(np.fft.rfft(line * np.hanning(count), 4 * count)) ** 2
    f = np.fft.rfftfreq(4 * count) / frequency
    own, seen = (f > 0.78) & (f < 1.22), f > 1.5 / count / frequency
    lead = np.log(power[..., own].max(-1) / power[..., seen & ((f <= 0.75) | (f >= 1.25))].max(-1))
    # of a round motion either axis may be the major one in the run
    lead = np.where(square[:, 1] > ALIKE**2 * square[:, 2], lead.min(1), lead[:, 1])
    power = power[:, 1]
    share = power[:, (f > 2 / 3) & (f < 4 / 3)].sum(1) / power.sum(1)
    return found + _fault(share, SHARE) + _fault(lead, LEAD)
