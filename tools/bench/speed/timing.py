"""Times of calls, and the sheet that most timings are of."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from bench.runner import Row
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints
from gaussian_swaying.wind.field import UniformGust, WindField
from gaussian_swaying.wind.force import AeroForce, WindForce

CUBE = GridSpec(0.01, (0, 0, 0), (100, 100, 100))
"""Grid of ``updated`` around the sheet."""
DT, STEPS = 1e-4, 64


def seconds(call: Callable[[], object], device: str) -> float:
    """Seconds of a call, with what it leaves to a GPU."""
    begin = time.perf_counter()
    call()
    if device != "cpu":
        torch.cuda.synchronize()
    return time.perf_counter() - begin


def timed(call: Callable[[], object], device: str, repeats: int = 7, steps: int = 1) -> Row:
    """Median and quartiles of the time of a step [ms], after three calls that compile and record."""
    for _ in range(3):
        seconds(call, device)
    samples = [1e3 * seconds(call, device) / steps for _ in range(repeats)]
    low, middle, high = statistics.quantiles(samples, n=4)
    return {"median_ms": middle, "quartile_low_ms": low, "quartile_high_ms": high, "repeats": repeats}


def in_turns(calls: dict[str, Callable[[], object]], device: str, rounds: int, steps: int) -> dict[str, Row]:
    """Times of a step [ms] of several calls, in turns, and the median of their ratios to the first in each round."""
    for call in calls.values():
        for _ in range(3):
            seconds(call, device)
    took = [{name: 1e3 * seconds(call, device) / steps for name, call in calls.items()} for _ in range(rounds)]
    first = next(iter(calls))
    return {
        name: {"median_ms": statistics.median(one[name] for one in took),
               "ratio": statistics.median(one[name] / one[first] for one in took)}
        for name in calls
    }  # fmt: skip


def sheet(points: int, device: str, width: float = 0.9) -> MaterialPoints:
    """A square sheet, 0.9 m wide within a cube of 1 m, level except for a ripple."""
    side = round(points**0.5)
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) / side * width + 0.05
    x, y = (g.reshape(-1) for g in torch.meshgrid(axis, axis, indexing="ij"))
    position = torch.stack([x, y, 0.5 + 0.003 * torch.sin(9 * x)], dim=-1)
    volume = (width / side) ** 2 * 0.01
    return MaterialPoints.create(position, volume=volume, density=50.0, youngs_modulus=5e3, poisson_ratio=0.3)


def waves(position: Tensor) -> Tensor:
    """A smooth velocity across the sheet, up to 1 m/s, so that the motion is larger than rounding."""
    x, y, _ = position.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, zero, torch.sin(2 * math.pi * x) * torch.cos(2 * math.pi * y)], dim=-1)


def wind(number: int, gusts: bool, device: str) -> WindField:
    """A wind that is different for each number."""
    modulations = [UniformGust()] if gusts else []
    return WindField([2.0, 0.0, 1.0 + 0.01 * number], modulations=modulations, seed=number).to(device)


def load(points: MaterialPoints, winds: WindField) -> WindForce:
    """Wind on every point of one or several sheets."""
    slope = 0.027 * torch.cos(9 * points.position[..., 0])
    normal = torch.stack([-slope, torch.zeros_like(slope), torch.ones_like(slope)], dim=-1)
    area = (points.volume / 0.01).contiguous()
    return WindForce(AeroForce().to(slope.device), winds, torch.nn.functional.normalize(normal, dim=-1), area)
