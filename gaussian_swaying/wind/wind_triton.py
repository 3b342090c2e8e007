"""The air velocity of a ``WindField`` at many times in one kernel; the reference is ``wind.field``.

In torch, sway and gusts take some seventy small kernels, which take longer to start than to run.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import torch
from torch import Tensor, nn

from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.wind.field import GaussianGust, SineSway, UniformGust, WindField, stream_start

SWAY, UNIFORM, GAUSSIAN = 0, 1, 2

_numbers: WeakKeyDictionary[nn.Module, tuple[tuple[object, ...], Tensor, Tensor]] = WeakKeyDictionary()
"""For each wind: the key that its numbers were made from, and the numbers that the kernel reads, on the device."""


@triton.jit
def _mix(x):
    """As ``wind._mix``: the finaliser of SplitMix64."""
    x = (x ^ ((x >> 30) & ((1 << 34) - 1))) * -4658895280553007687  # 0xBF58476D1CE4E5B9
    x = (x ^ ((x >> 27) & ((1 << 37) - 1))) * -7723592293110705685  # 0x94D049BB133111EB
    return x ^ ((x >> 31) & ((1 << 33) - 1))


@triton.jit
def _uniform(start, counter, lane):
    wide = start * 0 + lane  # 64 bits, so that the product wraps around
    bits = _mix(_mix(_mix(start) + counter * -7046029254386353131) + wide * -3335678366873096957)
    return (((bits >> 11) & ((1 << 53) - 1)).to(tl.float64) + 0.5) / 9007199254740992.0


@triton.jit
def _normal(start, counter, lane):
    first = tl.sqrt(-2 * tl.log(_uniform(start, counter, lane)))
    return first * tl.cos(6.283185307179586 * _uniform(start, counter, lane + 3))


@triton.jit(do_not_specialize=("count", "last"))
def _blow(
    times, keys, flows, numbers, starts, out, count, last,
    KINDS: tl.constexpr, MODULATIONS: tl.constexpr, LINEAR: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    time = tl.load(times + index, mask, 0.0)
    key = tl.zeros([BLOCK], tl.int32)
    for k in range(1, last + 1):
        key += tl.where(tl.load(keys + k) <= time, 1, 0)
    v0 = tl.load(flows + 3 * key)
    v1 = tl.load(flows + 3 * key + 1)
    v2 = tl.load(flows + 3 * key + 2)
    if LINEAR:
        after = tl.minimum(key + 1, last)
        begin = tl.load(keys + key)
        span = tl.load(keys + after) - begin
        share = (time - begin) / tl.where(span > 1e-12, span, 1e-12)
        share = tl.where(share > 0, tl.where(share < 1, share, 1.0), 0.0)
        v0 += share * (tl.load(flows + 3 * after) - v0)
        v1 += share * (tl.load(flows + 3 * after + 1) - v1)
        v2 += share * (tl.load(flows + 3 * after + 2) - v2)
    for m in tl.static_range(MODULATIONS):
        a = tl.load(numbers + 3 * m)
        b = tl.load(numbers + 3 * m + 1)
        start = tl.load(starts + m)
        if KINDS[m] == 0:
            sway = 1 + a * tl.sin(6.283185307179586 * time / b + tl.load(numbers + 3 * m + 2))
            first = (tl.abs(v0) >= tl.abs(v1)) & (tl.abs(v0) >= tl.abs(v2))
            second = tl.abs(v1) >= tl.abs(v2)
            w0 = tl.where(first, sway, 1.0)
            w1 = tl.where(first, 1.0, tl.where(second, sway, 1.0))
            w2 = tl.where(first, 1.0, tl.where(second, 1.0, sway))
            v0 = v0 * w0
            v1 = v1 * w1
            v2 = v2 * w2
        else:
            counter = tl.floor(time / b + 1e-6).to(tl.int64)
            if KINDS[m] == 1:
                gust = 1 + a * (2 * _uniform(start, counter, 0) - 1)
                v0 = v0 * gust
                v1 = v1 * gust
                v2 = v2 * gust
            else:
                v0 += a * _normal(start, counter, 0)
                v1 += a * _normal(start, counter, 1)
                v2 += a * _normal(start, counter, 2)
    tl.store(out + 3 * index, v0, mask)
    tl.store(out + 3 * index + 1, v1, mask)
    tl.store(out + 3 * index + 2, v2, mask)


def blow(wind: nn.Module, times: Tensor) -> Tensor | None:
    """Air velocity of a wind; None if the kernel does not know one of its parts.

    Also None while a CUDA graph is recorded, if the numbers of the wind are not on the device yet.

    Args:
        wind: The wind, on the device of the times.
        times: Times [s], float64, shape (n,).

    Returns:
        Velocity [m/s], float64, shape (n, 3).
    """
    if times.ndim > 1 or wind.scenes is not None or isinstance(wind.seed, Tensor):
        return None
    if type(wind) is not WindField or wind.flows.device != times.device or wind.flows.dtype != torch.float64:
        return None
    rows = [_row(part) for part in wind.modulations]
    known = [row for row in rows if row is not None]
    if len(known) < len(rows):
        return None
    key = (times.device, wind.seed, *known)
    if wind not in _numbers or _numbers[wind][0] != key:
        if times.is_cuda and torch.cuda.is_current_stream_capturing():
            return None
        with torch.inference_mode(False):  # it outlives the call
            numbers = torch.tensor([row[1:] for row in known] or [(0.0,) * 3], dtype=torch.float64)
            starts = torch.tensor([stream_start(wind.seed, stream) for stream in range(max(len(known), 1))])
            _numbers[wind] = key, numbers.to(times.device), starts.to(times.device)
    _, numbers, starts = _numbers[wind]
    out, block = times.new_empty(len(times), 3), lanes(times.device, 64)
    with torch.cuda.device_of(times):
        launch(_blow, (triton.cdiv(len(times), block),))(
            times.contiguous(), wind.times, wind.flows.contiguous(), numbers, starts, out, len(times),
            len(wind.times) - 1, KINDS=tuple(row[0] for row in known), MODULATIONS=len(known),
            LINEAR=wind.interpolation == "linear" and len(wind.times) > 1, BLOCK=block, num_warps=2,
        )  # fmt: skip
    return out


def _row(part: nn.Module) -> tuple[int, float, float, float] | None:
    """Kind of a modulation and its numbers; None if the kernel does not know it."""
    if type(part) is SineSway:
        return SWAY, part.amplitude, part.period, part.phase
    if type(part) is UniformGust:
        return UNIFORM, part.delta, part.interval, 0.0
    if type(part) is GaussianGust:
        return GAUSSIAN, part.std, part.interval, 0.0
    return None
