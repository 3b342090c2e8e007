"""The wind: a flow, steady or scheduled, modulations that make it sway and gust, and effects that depend on the place.

Everything is a pure function of time and seed. Random samples are drawn at fixed times from a counter-based generator,
so they do not depend on the substep, on the device, or on where a run was resumed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import (
    VectorLike,
    check_positive,
    check_shape,
    check_vector,
    number_of,
    requires_grad,
)
from gaussian_swaying._fixed import Fixed, FixedList, changed, fixed
from gaussian_swaying._live import SAME, SIZE, TOGETHER, live_numbers
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import picked
from gaussian_swaying.geometry.linalg import vectors
from gaussian_swaying.geometry.linalg_triton import add3, load3, scale3, store3
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.graphs import Component
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch, replaces
from gaussian_swaying.wind.effects import Moment, WindEffect
from gaussian_swaying.wind.wind_files import read_anemometer

M = TypeVar("M", bound=nn.Module)


def _signed(value: int) -> int:
    """A 64-bit pattern as the signed integer that torch stores."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >= 1 << 63 else value


def stream_start(seed: int | Tensor, stream: int, device: torch.device | str = "cpu") -> Tensor:
    """The first value of a generator's counter, int64, made on the device, so that a CUDA graph can record it."""
    if isinstance(seed, Tensor):
        return seed * _signed(0x9E3779B97F4A7C15) + (stream + 1)
    start = _signed(seed * 0x9E3779B97F4A7C15 + stream + 1)
    return torch.full((), start, dtype=torch.int64, device=device)


@triton.jit
def _mix(x):
    """Finaliser of SplitMix64 (Steele, Lea & Flood 2014), with wrap-around arithmetic."""
    x = (x ^ ((x >> 30) & ((1 << 34) - 1))) * -4658895280553007687  # 0xBF58476D1CE4E5B9
    x = (x ^ ((x >> 27) & ((1 << 37) - 1))) * -7723592293110705685  # 0x94D049BB133111EB
    return x ^ ((x >> 31) & ((1 << 33) - 1))


@triton.jit
def counter_uniform(start, counter, lane):
    """Uniform numbers in (0, 1), float64, that depend only on the start of a stream, the counter and the lane."""
    wide = start * 0 + lane  # 64 bits, so that the product wraps around
    bits = _mix(_mix(_mix(start) + counter * -7046029254386353131) + wide * -3335678366873096957)
    return (((bits >> 11) & ((1 << 53) - 1)).to(tl.float64) + 0.5) / 9007199254740992.0


@triton.jit
def counter_normal(start, counter, lane):
    """Standard normal numbers by Box-Muller from :func:`counter_uniform`; of the lanes 0 to 2."""
    first = tl.sqrt(-2 * tl.log(counter_uniform(start, counter, lane)))
    return first * tl.cos(6.283185307179586 * counter_uniform(start, counter, lane + 3))


@triton.jit
def _sample(time, interval):
    """Index of the sample at a time [s]; a time less than 1e-6 intervals before the next sample belongs to that one."""
    return tl.floor(time / interval + 1e-6).to(tl.int64)


@triton.jit
def swayed(v, time, numbers, start):
    """``SineSway``; arguments as for all modulations: velocity, time, numbers, start of the random stream."""
    sway = 1 + numbers[0] * tl.sin(6.283185307179586 * time / numbers[1] + numbers[2])
    first = (tl.abs(v[0]) >= tl.abs(v[1])) & (tl.abs(v[0]) >= tl.abs(v[2]))
    second = tl.abs(v[1]) >= tl.abs(v[2])
    return (
        v[0] * tl.where(first, sway, 1.0),
        v[1] * tl.where(first, 1.0, tl.where(second, sway, 1.0)),
        v[2] * tl.where(first, 1.0, tl.where(second, 1.0, sway)),
    )


@triton.jit
def scaled(v, time, numbers, start):
    """``UniformGust``."""
    gust = 1 + numbers[0] * (2 * counter_uniform(start, _sample(time, numbers[1]), 0) - 1)
    return scale3(gust, v)


@triton.jit
def shaken(v, time, numbers, start):
    """``GaussianGust``."""
    counter = _sample(time, numbers[1])
    x = counter_normal(start, counter, 0)
    y = counter_normal(start, counter, 1)
    return add3(v, numbers[0], (x, y, counter_normal(start, counter, 2)))


@triton.jit
def strengthened(v, mean, gusts):
    """A modulated velocity with `gusts` times as much of what was added to the mean; with 1 it stays, to the bit."""
    return add3(v, gusts - 1, add3(v, -1.0, mean))


@triton.jit(do_not_specialize=("count", "scenes"))
def _modulate(
    velocity, times, gusts, numbers, starts, count, scenes, KINDS: tl.constexpr, MODULATIONS: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Change velocities (count, 3) of winds of several scenes, one after the other, in place."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    time = tl.load(times + index, mask, 0.0)
    mean = load3(velocity, 1, 3 * index, mask)
    v = mean
    for m in tl.static_range(MODULATIONS):
        row = (index % scenes) * MODULATIONS + m
        own = load3(numbers, 1, 3 * row, mask)
        start = tl.load(starts + row, mask, 0)
        if KINDS[m] == 0:
            v = swayed(v, time, own, start)
        elif KINDS[m] == 1:
            v = scaled(v, time, (own[0], tl.where(mask, own[1], 1.0)), start)
        else:
            v = shaken(v, time, (own[0], tl.where(mask, own[1], 1.0)), start)
    v = strengthened(v, mean, tl.load(gusts + index, mask, 0.0))
    store3(velocity, 1, 3 * index, v, mask)


class Modulation(Component, nn.Module, ABC):
    """Base of all modulations, which change the wind velocity at a given time."""

    live_as, live = "wind.modulations.*", live_numbers()
    numbers: tuple[str, ...] = ()
    """Names of its numbers, if it has a device function; those of several scenes can be tensors of shape (B,)."""
    function: Any = None

    def forward(self, velocity: Tensor, time: Tensor, seed: int | Tensor, stream: int) -> Tensor:
        """Return the modulated velocity, that of the device function; one of your own replaces this.

        Args:
            velocity: Air velocity [m/s], shape (..., 3), float64.
            time: Time [s], shape (...), float64.
            seed: Seed of the run; of several scenes, one for each, shape (B,).
        """
        numbers = tuple(getattr(self, name) for name in self.numbers)
        given = velocity.unbind(-1), time, numbers, stream_start(seed, stream, velocity.device)
        return vectors(on_tensors(self.function)(*given))


class SineSway(Modulation):
    """Lets the largest component of the wind sway about its mean (paper, supplement, "More Details on Parameters").

    Args:
        amplitude: Amplitude as a fraction of the component; the paper uses 0.5.
        period: Period [s]; not given in the paper.
        phase: Phase at time zero [rad].
    """

    recordable = True
    numbers = ("amplitude", "period", "phase")
    function = swayed
    live = live_numbers(amplitude=SIZE | TOGETHER, period=SIZE | TOGETHER, phase=TOGETHER)

    def __init__(self, amplitude: float = 0.5, period: float = 2.0, phase: float = 0.0) -> None:
        super().__init__()
        check_positive("amplitude", amplitude, allow_zero=True)
        check_positive("period", period)
        check_vector("phase", [phase], 1)
        self.amplitude, self.period, self.phase = float(amplitude), float(period), float(phase)


class UniformGust(Modulation):
    """Multiplies the wind by 1 + U(-delta, delta) (paper, "Aerodynamics").

    Args:
        delta: Half width of the distribution; not given in the paper.
        interval: Time between samples [s]; each applies until the next.
    """

    recordable = True
    numbers = ("delta", "interval")
    function = scaled
    live = live_numbers(delta=SIZE | TOGETHER, interval=SIZE | TOGETHER)

    def __init__(self, delta: float = 0.3, interval: float = 0.04) -> None:
        super().__init__()
        check_positive("delta", delta, allow_zero=True)
        check_positive("interval", interval)
        self.delta, self.interval = float(delta), float(interval)


class GaussianGust(Modulation):
    """Adds N(0, std²) to each component (paper, supplement, "More Details on Parameters").

    Args:
        std: Standard deviation [m/s]; the paper uses 0.3.
        interval: Time between samples [s]; each applies until the next. Not given in the paper. White noise drawn once
            per substep would fade as substeps get shorter, so samples are drawn at fixed times instead.
    """

    recordable = True
    numbers = ("std", "interval")
    function = shaken
    live = live_numbers(std=SIZE | TOGETHER, interval=SIZE | TOGETHER)

    def __init__(self, std: float = 0.3, interval: float = 0.04) -> None:
        super().__init__()
        check_positive("std", std, allow_zero=True)
        check_positive("interval", interval)
        self.std, self.interval = float(std), float(interval)


KINDS = (SineSway, UniformGust, GaussianGust)


@fixed
@dataclass
class FlowKey:
    """One entry of a schedule: the wind at a time, or some of its numbers, which may be tensors in Python.

    Args:
        time: Time of the key [s].
        flow: Air velocity [m/s], z up; or give ``speed`` and ``azimuth``.
        speed: Speed of the air [m/s].
        azimuth: Direction in which it blows [degrees], from x towards y; it turns the shorter way to the next.
        gusts: Factor of sway, gusts, ``Turbulence`` and ``FrozenWind``.
    """

    time: float
    flow: list[float] | None = None
    speed: float | None = None
    azimuth: float | None = None
    gusts: float | None = None


class SpatialWind(Component, nn.Module, ABC):
    """Base of winds that vary in space: a jet, a boundary layer, a travelling gust.

    For a custom wind, write a subclass with a ``forward``. If it can be recorded in a CUDA graph (see ``Force``), set
    ``recordable = True``.
    """

    uniform: bool = False

    @abstractmethod
    def forward(self, time: Tensor, position: Tensor) -> Tensor:
        """Air velocity at given positions.

        Args:
            time: Time [s], scalar float64 tensor.
            position: Positions [m], z up, shape (..., P, 3).

        Returns:
            Velocity [m/s], broadcastable to (..., P, 3).
        """


def flow_rows(name: str, flows: Sequence[VectorLike]) -> Tensor:
    """Flows [m/s] as one tensor, shape (K, 3), float64, with the gradients that are required.

    Args:
        flows: K flows, each a tensor of shape (3,), or three numbers of which some may be tensors.
    """
    rows = [_row(name, flow) for flow in flows]
    if any(isinstance(row, Tensor) for row in rows):
        return torch.stack([torch.as_tensor(row, dtype=torch.float64) for row in rows])
    return torch.tensor(rows, dtype=torch.float64)


def _row(name: str, flow: VectorLike) -> Tensor | tuple[float, ...]:
    """Three plain numbers, or a tensor (3,) if a gradient is required."""
    if isinstance(flow, Tensor):
        plain = check_vector(name, flow.detach())
        return flow.double() if flow.requires_grad else plain
    if isinstance(flow, list | tuple) and any(map(requires_grad, flow)):
        check_vector(name, [number_of(part) for part in flow])
        return torch.stack([torch.as_tensor(part, dtype=torch.float64).reshape(()) for part in flow])
    return check_vector(name, flow)


Curve = tuple[Tensor, Tensor]
"""Times [s], shape (K,), and values, shape (K, ...); float64."""

CURVES, BUFFERS = ("flow", "speed", "azimuth", "gusts"), ("times", "flows", "gust_times", "gusts")

WITHIN = 1e-4
"""Largest error of a turn that consists of straight pieces, as a share of the larger speed."""


def _around(times: Tensor, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The keys before and after times (...), and the time since the former [s]."""
    last = times.numel() - 1
    key = (torch.searchsorted(times, time.contiguous(), right=True) - 1).clamp(0, last)
    return key, (key + 1).clamp(max=last), time - picked(times, key)


def keyed(curve: Curve, time: Tensor, interpolation: str) -> Tensor:
    """Values of a curve at times [s] of shape (...), with the axes of a value after them; constant outside its keys."""
    times, values = curve
    if times.numel() == 1:
        return values[0].expand(time.shape + values.shape[1:])
    key, after, past = _around(times, time)
    before = picked(values, key)
    if interpolation == "step":
        return before
    share = (past / (picked(times, after) - picked(times, key)).clamp(min=1e-12)).clamp(0, 1)
    return torch.lerp(before, picked(values, after), share.reshape(share.shape + (1,) * (values.ndim - 1)))


def _curve(keys: Sequence[FlowKey], name: str) -> Curve | None:
    """The keys that give a number, or the flow, with the gradients that are required."""
    given = [(float(key.time), getattr(key, name)) for key in keys if getattr(key, name) is not None]
    if not given:
        return None
    times, values = zip(*given, strict=True)
    if name == "flow":
        return _double(times), flow_rows("schedule.flow", values)
    plain = check_vector(f"schedule.{name}", [number_of(value) for value in values], len(values))
    kept = [value if requires_grad(value) else own for value, own in zip(values, plain, strict=True)]
    return _double(times), torch.stack([torch.as_tensor(value, dtype=torch.float64).reshape(()) for value in kept])


def _double(values: Sequence[float] | float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def _turning(speeds: Curve | None, azimuths: Curve | None, flow: VectorLike | None, interpolation: str) -> Curve:
    """The flows of keys of speed and azimuth; what no key gives is that of a steady flow."""
    base = check_vector("flow", (0.0, 0.0, 0.0) if flow is None else flow)
    missing = "speed" if speeds is None else "azimuth"
    if (speeds is None or azimuths is None) and not any(base):
        raise ValueError(f"No key of `schedule` gives `{missing}`, and `flow` is zero: give one of the two.")
    speed, azimuth, elevation = angles_of(base)
    speeds, azimuths = speeds or (_double([0.0]), _double([speed])), azimuths or (_double([0.0]), _double([azimuth]))
    times, angles = azimuths
    turns = 180 - (180 - angles.diff()).remainder(360)
    azimuths = times, torch.cat([angles[:1], angles[:1] + turns.cumsum(0)])
    at = torch.cat([speeds[0], times]).unique()
    if interpolation == "linear":
        turn = keyed(azimuths, at, interpolation).detach().diff().abs().deg2rad()
        pieces = (turn * (1 + turn / 2) / (4 * WITHIN)).sqrt().ceil().clamp(min=1).int().tolist()
        spans = zip(pairwise(at.tolist()), pieces, strict=True)
        at = _double([a + (b - a) * k / n for (a, b), n in spans for k in range(n)] + at[-1:].tolist())
    rows = [keyed(curve, at, interpolation) for curve in (speeds, azimuths)]
    return at, _from_angles(rows[0], rows[1].deg2rad(), _double(math.radians(elevation)))


def _from_angles(speed: Tensor, azimuth: Tensor, elevation: Tensor) -> Tensor:
    """Flows (..., 3) with angles in radians."""
    level = speed * elevation.cos()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), speed * elevation.sin()], dim=-1)


def flow_of(base: Sequence[float], values: Mapping[str, float]) -> list[float]:
    """A flow [m/s] with ``wind.speed``, ``wind.azimuth`` or ``wind.elevation`` replaced.

    Example:
        >>> [round(x, 3) for x in flow_of([2.0, 0.0, 0.0], {"wind.azimuth": 90.0})]
        [0.0, 2.0, 0.0]
    """
    x, y, z = base
    speed = values.get("wind.speed", math.hypot(x, y, z))
    azimuth = math.radians(values["wind.azimuth"]) if "wind.azimuth" in values else math.atan2(y, x)
    rise = math.radians(values["wind.elevation"]) if "wind.elevation" in values else math.atan2(z, math.hypot(x, y))
    flow: list[float] = _from_angles(*_double([speed, azimuth, rise])).tolist()
    return flow


def angles_of(flow: Sequence[float]) -> tuple[float, float, float]:
    """Speed [m/s], azimuth from x towards y and elevation [degrees] of a flow."""
    x, y, z = flow
    return math.hypot(x, y, z), math.degrees(math.atan2(y, x)), math.degrees(math.atan2(z, math.hypot(x, y)))


class WindField(Fixed, nn.Module):
    """Air velocity over time; the same everywhere in the scene, unless it has effects.

    :meth:`together` makes one of the winds of several scenes: ``flows``, ``gusts`` and the numbers of the modulations
    then have an axis of B scenes, and so has every velocity.

    Args:
        flow: Steady air velocity [m/s], z up. In Python also a tensor of shape (3,), which keeps its gradient.
        schedule: Keys of curves over time; the first of a curve also applies before its time. They give ``flow``, or
            ``speed`` and ``azimuth``, and ``gusts``; what none gives is that of ``flow``, and gusts are as they are.
            Or the CSV of an anemometer (:func:`~gaussian_swaying.wind.wind_files.read_anemometer`), with linear
            interpolation.
        interpolation: Between keys: ``step`` (constant until the next) or ``linear``.
        modulations: Sway and gusts, applied in order.
        seed: Seed of the gusts.
        effects: Effects, which make the wind differ from place to place, applied in order after the modulations: a
            profile, turbulence, obstacles, shelter. See docs/wind.md.

    Example:
        >>> wind = WindField(flow=[2.0, 0.0, 0.0], modulations=[UniformGust(delta=0.0)])
        >>> wind(0.5)
        tensor([2., 0., 0.], dtype=torch.float64)
    """

    times: Tensor
    flows: Tensor
    gust_times: Tensor
    gusts: Tensor
    live_as = "wind"
    live = live_numbers(
        flow=SAME | {"kind": "vector"}, seed=TOGETHER | {"kind": "whole"}, speed=SIZE | TOGETHER, azimuth=TOGETHER,
        elevation=TOGETHER,
    )  # fmt: skip

    def __init__(
        self,
        flow: VectorLike | None = (0.0, 0.0, 0.0),
        schedule: list[FlowKey] | str | None = None,
        *,
        interpolation: Literal["step", "linear"] = "step",
        modulations: Sequence[Modulation] = (),
        seed: int = 0,
        effects: Sequence[WindEffect] = (),
    ) -> None:
        super().__init__()
        if isinstance(schedule, str):
            schedule, interpolation = list(map(FlowKey, *read_anemometer(schedule))), "linear"
        keys = schedule or []
        given = [float(key.time) for key in keys]
        if any(a >= b for a, b in pairwise(given)):
            raise ValueError(f"Expected the times of `schedule` to increase, but got {given}.")
        for key in keys:
            if all(getattr(key, name) is None for name in CURVES):
                raise ValueError(f"The `schedule` has only a time at {key.time:g} s: add one of {', '.join(CURVES)}.")
        found, speeds, azimuths, strength = (_curve(keys, name) for name in CURVES)
        if speeds or azimuths:
            if found:
                raise ValueError("Expected keys of `schedule` with either `flow`, or `speed` and `azimuth`, not both.")
            found = _turning(speeds, azimuths, flow, interpolation)
        times, flows = found or (_double([0.0]), flow_rows("flow", [flow]))  # type: ignore[list-item]
        gust_times, gusts = strength or (_double([0.0]), _double([1.0]))
        for name, value in zip(BUFFERS, (times, flows, gust_times, gusts), strict=True):
            self.register_buffer(name, value)
        self.interpolation = interpolation
        self.seed: int | Tensor = int(seed)
        self.modulations = FixedList(modulations)
        self._rows: tuple[Any, Any, Tensor, Tensor] | None = (
            None  # numbers of the modulations, with what they are made from
        )
        self._in_metres = False  # whether `in_frame` made it
        moving = [row.detach() for row in flows if bool(row.any())]
        first = moving[0] if moving else torch.zeros(3, dtype=torch.float64)
        self.effects = FixedList(effect.along(first) for effect in effects)

    @staticmethod
    def together(winds: Sequence[nn.Module]) -> WindField | None:
        """Combine uniform winds of the same kind, one for each scene of a batch; None if they cannot be combined.

        A list of winds does the same, but the host then goes through all of them before every rollout. Their numbers
        are copied: later changes of the winds have no effect.

        Example:
            >>> both = WindField.together([WindField([2.0, 0.0, 0.0]), WindField([3.0, 0.0, 0.0])])
            >>> both(0.0)
            tensor([[2., 0., 0.],
                    [3., 0., 0.]], dtype=torch.float64)
        """
        fields = [wind for wind in winds if isinstance(wind, WindField) and wind._known]
        kinds = {(wind.interpolation, *map(type, wind.modulations)) for wind in fields}
        if len(fields) < len(winds) or len(kinds) != 1:
            return None
        times, gust_times = (torch.cat([getattr(wind, n) for wind in fields]).unique() for n in BUFFERS[::2])
        seeds = _seeds([int(wind.seed) for wind in fields], times)
        flows = torch.stack([wind.mean_flow(times) for wind in fields], dim=1)
        gusts = torch.stack([wind.strength(gust_times) for wind in fields], dim=1)
        parts = []
        for same in zip(*[wind.modulations for wind in fields], strict=True):
            numbers = {name: times.new_tensor([getattr(part, name) for part in same]) for name in same[0].numbers}
            parts.append(_with_buffers(same[0], **numbers))
        curves = dict(zip(BUFFERS, (times, flows, gust_times, gusts), strict=True))
        return changed(_with_buffers(fields[0], **curves, seed=seeds), modulations=FixedList(parts))

    def with_seeds(self, seeds: Sequence[int]) -> WindField | list[WindField]:
        """Return the wind with a seed of its own for each scene of a batch, combined into one wind where possible."""
        if self._known:
            return _with_buffers(self, seed=_seeds(seeds, self.times))
        return [changed(self, seed=seed) for seed in seeds]

    @property
    def _known(self) -> bool:
        parts = all("numbers" in vars(type(part)) for part in self.modulations)
        return type(self) is WindField and self.uniform and isinstance(self.seed, int) and parts

    @property
    def flow(self) -> Tensor | None:
        """The flow [m/s] if it is steady, shape (3,); else None."""
        return self.flows[0] if len(self.flows) == 1 else None

    @property
    def scenes(self) -> int | None:
        """Number of scenes with winds of their own; None for one wind."""
        return self.flows.shape[1] if self.flows.ndim > 2 else None

    @property
    def uniform(self) -> bool:
        """True if the wind is the same everywhere."""
        return len(self.effects) == 0

    @property
    def recordable(self) -> bool:
        """True if all modulations and effects can be recorded in a CUDA graph."""
        return all(getattr(part, "recordable", False) for part in (*self.modulations, *self.effects))

    def in_frame(self, frame: SimFrame) -> WindField:
        """The same wind with its places converted from scene units to metres, z up; itself if it has none."""
        if self.uniform or self._in_metres:
            return self
        effects = FixedList(effect.in_frame(frame) for effect in self.effects)  # type: ignore[operator]
        return changed(self, effects=effects, _in_metres=True)

    def with_flow(self, flow: VectorLike) -> WindField:
        """The wind with another steady flow [m/s] in place of all keys of it; a tensor keeps its gradient."""
        return changed(self, flows=flow_rows("flow", [flow]), times=self.times.new_zeros(1))

    def _wide(self, value: Tensor) -> Tensor:
        """Numbers (...) as factors of flows (..., 3) or (..., B, 3)."""
        return value.reshape(*value.shape, *[1] * (self.flows.ndim - 1))

    def mean_flow(self, time: Tensor) -> Tensor:
        """The flow without modulations [m/s] at times [s] of shape (...); shape (..., 3), float64."""
        return keyed((self.times, self.flows), time, self.interpolation)

    def strength(self, time: Tensor) -> Tensor:
        """The factor of the gusts at times [s] of shape (...); (...) or, of several scenes, (..., B), float64."""
        return keyed((self.gust_times, self.gusts), time, self.interpolation)

    def moment(self, time: Tensor) -> Moment:
        """What the effects get at times [s]."""
        return Moment(time, self.mean_flow(time), self.carried(time), self.strength(time))

    def carried(self, time: Tensor) -> Tensor:
        """Return the displacement of the air by the flow without modulations since time zero [m].

        Args:
            time: Times [s], shape (...), float64.

        Returns:
            Shape (..., 3), float64.
        """
        if self.times.numel() == 1:
            return self._wide(time) * self.flows[0]
        span = self._wide(self.times[1:] - self.times[:-1])
        mean = self.flows[:-1] if self.interpolation == "step" else 0.5 * (self.flows[:-1] + self.flows[1:])
        sums = torch.cat([torch.zeros_like(self.flows[:1]), (span * mean).cumsum(0)])
        key, after, past = _around(self.times, torch.stack([torch.zeros_like(time), time]))
        past = self._wide(past)
        found = sums[key] + past * self.flows[key]
        if self.interpolation == "linear":
            length = self._wide((self.times[after] - self.times[key]).clamp(min=1e-12))
            found = found + 0.5 * past.clamp(min=0) ** 2 / length * (self.flows[after] - self.flows[key])
        return found[1] - found[0]

    def at(self, time: Tensor, position: Tensor) -> Tensor:
        """Air velocity at one time and given places [m/s].

        Args:
            time: Time [s], scalar float64 tensor.
            position: Places [m], z up, shape (..., P, 3).

        Returns:
            Broadcastable to (..., P, 3).
        """
        return self.shaped(self(time), position, self.moment(time))

    def shaped(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        """Apply the effects to a uniform velocity at some places.

        Args:
            velocity: Velocity with modulations [m/s], shape (3,).
            position: Places [m], z up, shape (..., P, 3).
            moment: The time, and the flow.

        Returns:
            Broadcastable to (..., P, 3), in the dtype of ``position`` if there are effects.

        Raises:
            TypeError: If an effect returned no tensor.
            ValueError: If its velocity has another shape.
        """
        if not self.uniform:
            velocity = velocity.to(position)
        for effect in self.effects:
            velocity = effect(velocity, position, moment)
            check_shape(f"velocity of {type(effect).__name__}", velocity, 3)
            rows = velocity.shape[-2:-1]
            if rows and rows[0] != 1 and rows != position.shape[-2:-1]:
                check_shape(f"velocity of {type(effect).__name__}", velocity, *position.shape[-2:])
        return velocity

    def forward(self, time: Tensor | float) -> Tensor:
        """Air velocity at one or many times, without the effects.

        Args:
            time: Time [s], shape (...), or a number.

        Returns:
            Velocity [m/s], z up, shape (..., 3) or, of several scenes, (..., B, 3); float64.
        """
        time = torch.as_tensor(time, dtype=torch.float64, device=self.times.device)
        velocity = mean = self.mean_flow(time)
        if not len(self.modulations):
            return velocity
        gusts = self.strength(time).expand(mean.shape[:-1])
        time = self._wide(time)[..., 0].expand(mean.shape[:-1])
        if self._known_rows(time) and replaces((mean, gusts), dtype=None):
            return self.modulated(mean, time, gusts)
        for stream, modulation in enumerate(self.modulations):
            velocity = modulation(velocity, time, self.seed, stream)
        return vectors(on_tensors(strengthened)(velocity.unbind(-1), mean.unbind(-1), gusts))

    def _known_rows(self, time: Tensor) -> bool:
        parts = all("function" in vars(type(part)) for part in self.modulations)
        if not (len(self.modulations) and parts and type(self) is WindField and self.flows.dtype == torch.float64):
            return False
        numbers = [getattr(part, name) for part in self.modulations for name in part.numbers]  # type: ignore[union-attr]
        made = (self.seed, *numbers)
        key = (time.device, *(id(value) if isinstance(value, Tensor) else value for value in made))
        if self._rows is None or self._rows[0] != key:
            if time.is_cuda and torch.cuda.is_current_stream_capturing():
                return False
            with torch.inference_mode(False):  # they outlive the call
                self._rows = (key, made, *self._made_rows(time.device))
        return True

    def _made_rows(self, device: torch.device) -> tuple[Tensor, Tensor]:
        """Numbers (B, M, 3) and starts (B, M) of the modulations, for one scene or all, on a device."""
        rows, starts = [], []
        for stream, part in enumerate(self.modulations):
            own = [getattr(part, name) for name in part.numbers]  # type: ignore[union-attr]
            rows += [torch.as_tensor(value, dtype=torch.float64, device=device) for value in (own + [0.0])[:3]]
            starts.append(stream_start(self.seed, stream, device))
        count = len(starts)
        found = torch.broadcast_tensors(*rows, *starts)
        numbers, first = torch.stack(found[:-count], -1), torch.stack(found[-count:], -1)
        return numbers.reshape(-1, count, 3), first.reshape(-1, count)

    def modulated(self, velocity: Tensor, time: Tensor, gusts: Tensor) -> Tensor:
        """Velocities (..., 3) at times (...) with all modulations, in one kernel; in torch they take some seventy.

        Args:
            gusts: :meth:`strength` at these times, shape (...).
        """
        assert self._rows is not None
        *_, numbers, starts = self._rows
        found, block = velocity.contiguous().clone(), lanes(velocity.device, 64)
        kinds = tuple(KINDS.index(type(part)) for part in self.modulations)
        with torch.cuda.device_of(found):
            launch(_modulate, (triton.cdiv(time.numel(), block),))(
                found, time.contiguous(), gusts.contiguous(), numbers, starts, time.numel(), len(starts), KINDS=kinds,
                MODULATIONS=len(kinds), BLOCK=block, num_warps=2,
            )  # fmt: skip
        return found


def _seeds(seeds: Sequence[int], like: Tensor) -> Tensor:
    """Seeds as signed numbers of 64 bits on the device of a tensor: the generator only uses these."""
    return torch.tensor(list(map(_signed, seeds)), device=like.device)


def _with_buffers(module: M, **tensors: Tensor) -> M:
    other = changed(module)
    for name in tensors:
        vars(other).pop(name, None)
    other._buffers.update(tensors)
    return other
