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

from gaussian_swaying.gaussians.measures import Array
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


Motion = tuple[Array, Callable[[Array, int], Array]]
"""Displacement in a long record, (S, 3), and what is left of it in samples after some (W,), (W, T, 3)."""


def rate_for(frequency: float) -> float:
    """Sampling rate [1/s] of the record for a first frequency [Hz]."""
    return min(max(PER_PERIOD * frequency, LEAST_RATE), RATE)


class Response(NamedTuple):
    """Slow vibrations of a tip under loads on modes.

    Attributes:
        root: Their complex frequencies [1/s], shape (K,).
        out: The motion of the tip by their amplitudes, shape (3, K).
        taken: Real and imaginary loads on them, and what the tip moves at once, by loads on the modes, (M, 2 K + 3).
    """

    root: Array
    out: Array
    taken: Array


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
    begin = np.arange(settled, len(moved) - length, max(1, round(STEP * rate)))
    faults = []
    for some in np.array_split(begin, max(1, len(begin) // TOGETHER)):
        part = moved[some[:, None] + np.arange(length)] - ringing(some, length)
        faults.append(_faults(part[:, skipped:], moved[settled:], frequency / rate if tonal else math.inf))
    return float(begin[np.concatenate(faults).argmin()] / rate)


def linear_motion(bound: Modes, force: WindForce, wind: WindField, top: torch.Tensor, rate: float) -> Motion:
    """Mean displacement [m] of the top of a body in a long record of a wind, without rotation.

    The air's damping is that in the mean wind, twice as strong along it as across.

    Args:
        top: Weight of each site in the mean, shape (S,).
    """
    from scipy.cluster.vq import kmeans2

    grouped, aero = bound._grouped(force), force.aero
    assert isinstance(grouped, WindForce)
    assert grouped.sums is not None
    tensor, area = (of.double().cpu().numpy() for of in (grouped.sums.tensor, grouped.sums.area))
    drag, friction, eye = float(aero.C_D), float(aero.C_F), np.eye(3)
    pressed = 0.5 * aero.air_density * ((drag - friction) * tensor + friction * area[:, None, None] * eye)
    shape = bound.site_shape.double().cpu().unflatten(0, (-1, 3)).numpy()  # (S, 3, M)
    square, flow = bound.square.double().cpu().numpy(), wind.flows[0].double().cpu().numpy()
    speed = np.linalg.norm(flow)
    weight = pressed @ (speed * eye + np.outer(flow, flow) / speed)
    flat = shape.reshape(-1, len(square))
    damping = np.diag(2 * bound.ratio.double().cpu().numpy() * np.sqrt(square))
    damping += flat.T @ (weight @ shape).reshape(flat.shape)
    centre, label = kmeans2(bound.site_rest.double().cpu().numpy(), min(PLACES, len(shape)), seed=0, minit="++")
    response = _response(square, damping, np.tensordot(top.numpy(), shape, 1), FASTEST * bound.first)
    pull = pressed @ shape @ response.taken  # of a unit of |u| u
    of_place = np.zeros((len(centre), *pull.shape[1:]))
    np.add.at(of_place, label, pull)
    return _motion(_push(wind, centre, of_place, rate), response, rate)


def cloth_motion(wind: WindField, places: torch.Tensor, frequency: float, ratio: float) -> Motion:
    """Motion of a hanging cloth as one oscillator per axis, in the mean wind of some places.

    Args:
        places: Places [m], shape (K, 3).
        frequency: Frequency [Hz].
    """
    rate, omega = rate_for(frequency), 2 * math.pi * frequency
    push = _pressed(_air(wind, places.double().cpu().numpy(), rate, SAMPLES, 0).mean(1))
    response = _response(np.full(3, omega**2), 2 * ratio * omega * np.eye(3), np.eye(3), math.inf)
    return _motion(push @ response.taken, response, rate)


def _pressed(air: Array) -> Array:
    return np.linalg.norm(air, axis=-1, keepdims=True) * air


def _push(wind: WindField, places: Array, pull: Array, rate: float) -> Array:
    """Loads in a long record, (T, C), by places (K, 3) and what |u| u pulls there, (K, 3, C).

    What the wind carries comes to the places on one line along it one after the other.
    """
    from scipy.cluster.vq import kmeans2

    flow = wind.flows[0].double().cpu().numpy()
    speed = np.linalg.norm(flow)
    down = places @ flow / speed
    across = places - down[:, None] * flow / speed
    line, label = kmeans2(across, min(LINES, len(places)), seed=0, minit="++")
    late = down / speed * rate  # in samples
    before, whole = math.ceil(late.max()) + 1, np.floor(late).astype(int)
    pressed = _pressed(_air(wind, line, rate, SAMPLES + before - whole.min(), before))
    push = np.zeros((SAMPLES, pull.shape[-1]))
    for some in np.array_split(np.arange(len(late)), max(1, len(late) // BLOCK)):
        at = []
        for k in some:
            begin, share, here = before - whole[k], late[k] - whole[k], pressed[:, label[k]]
            at.append((1 - share) * here[begin : begin + SAMPLES] + share * here[begin - 1 : begin - 1 + SAMPLES])
        push += np.concatenate(at, 1) @ pull[some].reshape(-1, pull.shape[-1])
    return push


def _air(wind: WindField, places: Array, rate: float, samples: int, before: int) -> Array:
    """Wind at places (K, 3) in a record that begins some samples ``before`` time zero [m/s], shape (T, K, 3)."""
    times = (np.arange(samples) - before) / rate  # the flow carries the turbulence, so an earlier place is a later time
    where = places - times[:, None, None] * wind.flows[0].double().cpu().numpy()
    found = wind.at(torch.zeros((), dtype=torch.float64), torch.from_numpy(where.reshape(-1, 3)).float())
    return found.double().numpy().reshape(where.shape)


def _response(square: Array, damping: Array, tip: Array, fastest: float) -> Response:
    """How a tip (3, M) answers to loads on modes of squares of frequencies (M,) and damping [1/s], (M, M).

    Vibrations faster than some circular frequency follow the load at once.
    """
    zero = np.zeros(damping.shape)
    root, left = np.linalg.eig(np.block([[zero, np.eye(len(zero))], [-np.diag(square), -damping]]))
    into, out = np.linalg.inv(left)[:, len(zero) :], tip @ left[: len(zero)]
    out = out * np.where(root.imag > 0, 2.0, 1.0)  # with its conjugate
    slow, own = np.abs(root) < fastest, root.imag >= 0
    fast, slow = own & ~slow, own & slow
    at_once = (out[:, fast] / -root[fast]) @ into[fast]
    return Response(root[slow], out[:, slow], np.concatenate([into[slow].real, into[slow].imag, at_once.real]).T)


def _motion(load: Array, response: Response, rate: float) -> Motion:
    """The motion of a tip under the loads of a response, (T, 2 K + 3)."""
    from scipy.signal import lfilter

    count, dt = len(response.root), 1 / rate
    moved, free = load[:, 2 * count :].copy(), []
    for k, (root, way) in enumerate(zip(response.root, response.out.T, strict=True)):
        step = np.exp(root * dt)  # exact for steps of the load, which acts from the next sample on
        amplitude = lfilter([0, (step - 1) / root], [1, -step], load[:, k] + 1j * load[:, count + k])
        moved += (amplitude[:, None] * way).real
        free.append((amplitude.std() * np.linalg.norm(way), root, amplitude, way))
    free.sort(key=lambda mode: -mode[0])

    def ringing(start: Array, samples: int) -> Array:
        time, left = np.arange(samples) * dt, np.zeros((len(start), samples, 3))
        for _, root, amplitude, way in free[:RINGING]:
            left += ((amplitude[start][:, None] * np.exp(root * time))[..., None] * way).real
        return left

    return moved, ringing


def _fault(value: Any, allowed: tuple[float, float, float]) -> Any:
    low, high, size = allowed
    apart = np.maximum(np.maximum(low - value, value - high), 0.0) / size
    return np.minimum(apart, 1.0) + 0.5 * apart


def _faults(part: Array, whole: Array, frequency: float) -> Array:
    """Faults of stretches (W, T, 3) of a record (S, 3): means, size and roundness of the fluctuation, and its spectrum.

    The frequency is that for each sample; where it is infinite, only the means count.
    """
    count, mean, own_mean = part.shape[1], np.linalg.norm(whole.mean(0)), part.mean(1)
    halves = part[:, : count // 2].mean(1) - part[:, count // 2 :].mean(1)
    drift, off = (np.linalg.norm(apart, axis=1) / mean for apart in (halves, own_mean - whole.mean(0)))
    if math.isinf(frequency):
        return drift / DRIFT[2] + off / OFF[2]
    apart = part - own_mean[:, None]
    square, axes = np.linalg.eigh(np.swapaxes(apart, 1, 2) @ apart / count)
    size = np.sqrt(square.sum(1))
    found = _fault(drift, DRIFT) + _fault(off, OFF) + _fault(size / mean, RESTLESS)
    found = found + _fault(abs(np.log(size / np.linalg.norm(whole.std(0)))), EVEN)
    found = found + _fault(np.sqrt(np.maximum(square[:, 1], 0) / square[:, 2]), ROUND)
    if 1.15 * frequency > 0.5:  # its own vibration is not in the record
        return found
    from scipy.signal import detrend

    line = detrend(np.swapaxes(axes[:, :, 1:], 1, 2) @ np.swapaxes(apart, 1, 2))
    power = np.abs(np.fft.rfft(line * np.hanning(count), 4 * count)) ** 2
    f = np.fft.rfftfreq(4 * count) / frequency
    own, seen = (f > 0.78) & (f < 1.22), f > 1.5 / count / frequency
    lead = np.log(power[..., own].max(-1) / power[..., seen & ((f <= 0.75) | (f >= 1.25))].max(-1))
    # of a round motion either axis may be the major one in the run
    lead = np.where(square[:, 1] > ALIKE**2 * square[:, 2], lead.min(1), lead[:, 1])
    power = power[:, 1]
    share = power[:, (f > 2 / 3) & (f < 4 / 3)].sum(1) / power.sum(1)
    return found + _fault(share, SHARE) + _fault(lead, LEAD)
