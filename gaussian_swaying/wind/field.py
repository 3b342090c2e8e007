"""The wind: a flow, steady or scheduled, modulations that make it sway and gust, and effects that depend on the place.

Everything is a pure function of time and seed. Random samples are drawn at fixed times from a counter-based generator,
so they do not depend on the substep, on the device, or on where a run was resumed.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal, TypeVar

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
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.kernels.graphs import Recordable
from gaussian_swaying.wind.effects import Moment, WindEffect
from gaussian_swaying.wind.wind_files import read_anemometer

M = TypeVar("M", bound=nn.Module)


def _signed(value: int) -> int:
    """A 64-bit pattern as the signed integer that torch stores."""
    value &= (1 << 64) - 1
    return value - (1 << 64) if value >= 1 << 63 else value


def _mix(x: Tensor) -> Tensor:
    """Finaliser of SplitMix64 (Steele, Lea & Flood 2014) on int64 tensors, with wrap-around arithmetic."""
    x = (x ^ ((x >> 30) & ((1 << 34) - 1))) * _signed(0xBF58476D1CE4E5B9)
    x = (x ^ ((x >> 27) & ((1 << 37) - 1))) * _signed(0x94D049BB133111EB)
    return x ^ ((x >> 31) & ((1 << 33) - 1))


def stream_start(seed: int, stream: int) -> int:
    """Return the first value of a generator's counter, as a signed 64-bit number."""
    return _signed(seed * 0x9E3779B97F4A7C15 + stream + 1)


def _stream_key(seed: int | Tensor, stream: int, device: torch.device) -> Tensor:
    """Return the first values of the counters, made on the device, so that a CUDA graph can record it."""
    if isinstance(seed, Tensor):
        return (seed * _signed(0x9E3779B97F4A7C15) + (stream + 1))[..., None]
    return torch.full((), stream_start(seed, stream), dtype=torch.int64, device=device)


def counter_uniform(seed: int | Tensor, stream: int, counter: Tensor, lanes: int) -> Tensor:
    """Uniform numbers in (0, 1) that depend only on seed, stream, counter and lane.

    Args:
        seed: Seed of the run; or of each of several runs, int64, shape (B,), for counters of shape (..., B).
        stream: Number of the generator within the run.
        counter: Integers, shape (...), int64.
        lanes: Independent numbers per counter.

    Returns:
        float64, shape (..., lanes).
    """
    key = _mix(_stream_key(seed, stream, counter.device))
    lane = torch.arange(lanes, device=counter.device)
    bits = _mix(_mix(key + counter[..., None] * _signed(0x9E3779B97F4A7C15)) + lane * _signed(0xD1B54A32D192ED03))
    return (((bits >> 11) & ((1 << 53) - 1)).double() + 0.5) / float(1 << 53)


def counter_normal(seed: int | Tensor, stream: int, counter: Tensor, lanes: int) -> Tensor:
    """Standard normal numbers, shape (..., lanes), float64, by Box-Muller from :func:`counter_uniform`."""
    u = counter_uniform(seed, stream, counter, 2 * lanes)
    return (-2 * u[..., :lanes].log()).sqrt() * (2 * math.pi * u[..., lanes:]).cos()


def sample_index(time: Tensor, interval: float | Tensor) -> Tensor:
    """Index of the sample at a time [s]; a time less than 1e-6 intervals before the next sample belongs to that one."""
    return torch.floor(time / interval + 1e-6).long()


def picked(values: Tensor, index: Tensor) -> Tensor:
    """Rows of a tensor (N, ...) by integers of any shape, also of none, without making the host wait.

    ``values[index]`` with a scalar on a GPU would read it on the host, which a CUDA graph cannot record.
    """
    return values.index_select(0, index.reshape(-1)).reshape((*index.shape, *values.shape[1:]))


class Modulation(Recordable, nn.Module, ABC):
    """Base of all modulations, which change the wind velocity at a given time."""

    live_as = "wind.modulations.*"
    numbers: tuple[str, ...] = ()
    """Names of its numbers, if those of several scenes can be tensors of shape (B,)."""

    @abstractmethod
    def forward(self, velocity: Tensor, time: Tensor, seed: int | Tensor, stream: int) -> Tensor:
        """Return the modulated velocity.

        Args:
            velocity: Air velocity [m/s], shape (..., 3), float64.
            time: Time [s], shape (...), float64.
            seed: Seed of the run; of several scenes, one for each, shape (B,).
            stream: Position of this modulation in the list of its WindField.
        """


class SineSway(Modulation):
    """Lets the largest component of the wind sway about its mean (paper, supplement, "More Details on Parameters").

    Args:
        amplitude: Amplitude as a fraction of the component; the paper uses 0.5.
        period: Period [s]; not given in the paper.
        phase: Phase at time zero [rad].
    """

    recordable = True
    numbers = ("amplitude", "period", "phase")

    def __init__(self, amplitude: float = 0.5, period: float = 2.0, phase: float = 0.0) -> None:
        super().__init__()
        check_positive("amplitude", amplitude, allow_zero=True)
        check_positive("period", period)
        check_vector("phase", [phase], 1)
        self.amplitude, self.period, self.phase = float(amplitude), float(period), float(phase)

    def forward(self, velocity: Tensor, time: Tensor, seed: int | Tensor, stream: int) -> Tensor:
        """Scale the largest component by ``1 + amplitude sin(2 pi t / period + phase)``."""
        largest = nn.functional.one_hot(velocity.detach().abs().argmax(-1), 3)
        sway = self.amplitude * torch.sin(2 * math.pi * time / self.period + self.phase)
        return velocity * (1 + largest * sway[..., None])


class UniformGust(Modulation):
    """Multiplies the wind by 1 + U(-delta, delta) (paper, "Aerodynamics").

    Args:
        delta: Half width of the distribution; not given in the paper.
        interval: Time between samples [s]; each applies until the next.
    """

    recordable = True
    numbers = ("delta", "interval")

    def __init__(self, delta: float = 0.3, interval: float = 0.04) -> None:
        super().__init__()
        check_positive("delta", delta, allow_zero=True)
        check_positive("interval", interval)
        self.delta, self.interval = float(delta), float(interval)

    def forward(self, velocity: Tensor, time: Tensor, seed: int | Tensor, stream: int) -> Tensor:
        """Scale all components by one random factor."""
        u = counter_uniform(seed, stream, sample_index(time, self.interval), 1)[..., 0]
        return velocity * (1 + self.delta * (2 * u - 1))[..., None]


class GaussianGust(Modulation):
    """Adds N(0, std²) to each component (paper, supplement, "More Details on Parameters").

    Args:
        std: Standard deviation [m/s]; the paper uses 0.3.
        interval: Time between samples [s]; each applies until the next. Not given in the paper. White noise drawn once
            per substep would fade as substeps get shorter, so samples are drawn at fixed times instead.
    """

    recordable = True
    numbers = ("std", "interval")

    def __init__(self, std: float = 0.3, interval: float = 0.04) -> None:
        super().__init__()
        check_positive("std", std, allow_zero=True)
        check_positive("interval", interval)
        self.std, self.interval = float(std), float(interval)

    def forward(self, velocity: Tensor, time: Tensor, seed: int | Tensor, stream: int) -> Tensor:
        """Add independent noise to the three components."""
        noise = counter_normal(seed, stream, sample_index(time, self.interval), 3)
        return velocity + (self.std * noise.movedim(-1, 0)).movedim(0, -1)


@fixed
@dataclass
class FlowKey:
    """One entry of a schedule.

    Args:
        time: Time from which the flow applies [s].
        flow: Air velocity [m/s], z up; in Python also a tensor, as in a :class:`WindField`.
    """

    time: float
    flow: list[float]


class SpatialWind(Recordable, nn.Module, ABC):
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
        name: Name of the argument, for messages.
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


class WindField(Fixed, nn.Module):
    """Air velocity over time; the same everywhere in the scene, unless it has effects.

    :meth:`together` makes one of the winds of several scenes: ``flows`` and the numbers of the modulations then have an
    axis of B scenes, and so has every velocity.

    Args:
        flow: Steady air velocity [m/s], z up; null with a ``schedule``. In Python also a tensor of shape (3,), which
            keeps its gradient.
        schedule: Flow that changes over time, used instead of ``flow``; the first entry also applies before its time.
            Or the CSV of an anemometer (:func:`~gaussian_swaying.wind.wind_files.read_anemometer`), with linear
            interpolation.
        interpolation: Between entries of the schedule: ``step`` (constant until the next) or ``linear``.
        modulations: Sway and gusts, applied in order.
        seed: Seed of the gusts.
        effects: Effects, which make the wind differ from place to place, applied in order after the modulations: a
            profile, turbulence, obstacles, shelter. See docs/wind.md.

    Example:
        >>> wind = WindField(flow=[2.0, 0.0, 0.0], modulations=[UniformGust(delta=0.0)])
        >>> wind(0.5)
        tensor([2., 0., 0.], dtype=torch.float64)
    """

    live_as = "wind"

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
        keys = schedule or [FlowKey(0.0, flow)]  # type: ignore[arg-type]
        times = [float(key.time) for key in keys]
        if any(a >= b for a, b in pairwise(times)):
            raise ValueError(f"Expected the times of `schedule` to increase, but got {times}.")
        name = "schedule.flow" if schedule else "flow"
        flows = flow_rows(name, [key.flow for key in keys])
        self.register_buffer("times", torch.tensor(times, dtype=torch.float64))
        self.register_buffer("flows", flows)
        self.times: Tensor
        self.flows: Tensor
        self.interpolation = interpolation
        self.seed: int | Tensor = int(seed)
        self.modulations = FixedList(modulations)
        self._in_metres = False  # whether `in_frame` made it
        moving = [row.detach() for row in flows if bool(row.any())]
        first = moving[0] if moving else torch.zeros(3, dtype=torch.float64)
        self.effects = FixedList(effect.along(first) for effect in effects)

    @staticmethod
    def together(winds: Sequence[nn.Module]) -> WindField | None:
        """Uniform winds of the same kind, one for each scene of a batch, as one; None if they cannot be.

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
        times = torch.cat([wind.times for wind in fields]).unique()
        seeds = _seeds([int(wind.seed) for wind in fields], times)
        flows = torch.stack([wind.mean_flow(times) for wind in fields], dim=1)
        parts = []
        for same in zip(*[wind.modulations for wind in fields], strict=True):
            numbers = {name: times.new_tensor([getattr(part, name) for part in same]) for name in same[0].numbers}
            parts.append(_with_buffers(same[0], **numbers))
        return changed(_with_buffers(fields[0], times=times, flows=flows, seed=seeds), modulations=FixedList(parts))

    def with_seeds(self, seeds: Sequence[int]) -> WindField | list[WindField]:
        """The same wind with other gusts for each of several scenes; as one wind if it can be."""
        if self._known:
            return _with_buffers(self, seed=_seeds(seeds, self.times))
        return [changed(self, seed=seed) for seed in seeds]

    @property
    def _known(self) -> bool:
        """Whether its numbers can be those of several scenes."""
        parts = all("numbers" in vars(type(part)) for part in self.modulations)
        return type(self) is WindField and self.uniform and isinstance(self.seed, int) and parts

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
        """The same wind with another steady flow [m/s], in place of a schedule, too; a tensor keeps its gradient."""
        return changed(self, flows=flow_rows("flow", [flow]), times=self.times.new_zeros(1))

    def with_schedule(self, times: Sequence[float], flows: Sequence[VectorLike]) -> WindField:
        """The same wind with other flows [m/s] at some times [s], ascending, and linear between them."""
        rows = flow_rows("flow", flows)
        return changed(self, flows=rows, times=self.times.new_tensor(times), interpolation="linear")

    def _keys(self, time: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The entries of the schedule before and after times (...), and the time since the former [s]."""
        last = self.times.numel() - 1
        key = (torch.searchsorted(self.times, time.contiguous(), right=True) - 1).clamp(0, last)
        return key, (key + 1).clamp(max=last), self._wide(time - picked(self.times, key))

    def _wide(self, value: Tensor) -> Tensor:
        """Numbers (...) as factors of flows (..., 3) or (..., B, 3)."""
        return value.reshape(*value.shape, *[1] * (self.flows.ndim - 1))

    def mean_flow(self, time: Tensor) -> Tensor:
        """The flow without modulations [m/s] at times [s] of shape (...); shape (..., 3), float64."""
        if self.times.numel() == 1:
            return self.flows[0].expand(*time.shape, *self.flows.shape[1:])
        key, after, past = self._keys(time)
        before = picked(self.flows, key)
        if self.interpolation == "step":
            return before
        span = (picked(self.times, after) - picked(self.times, key)).clamp(min=1e-12)
        return torch.lerp(before, picked(self.flows, after), (past / self._wide(span)).clamp(0, 1))

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
        key, after, past = self._keys(torch.stack([torch.zeros_like(time), time]))
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
        return self.shaped(self(time), position, Moment(time, self.mean_flow(time), self.carried(time)))

    def shaped(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        """Return the velocity at some places: the effects applied to one that is the same everywhere.

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
        velocity = self.mean_flow(time)
        time = self._wide(time)[..., 0].expand(velocity.shape[:-1])
        for stream, modulation in enumerate(self.modulations):
            velocity = modulation(velocity, time, self.seed, stream)
        return velocity


def _seeds(seeds: Sequence[int], like: Tensor) -> Tensor:
    """Seeds as signed numbers of 64 bits on the device of a tensor: the generator only uses these."""
    return torch.tensor(list(map(_signed, seeds)), device=like.device)


def _with_buffers(module: M, **tensors: Tensor) -> M:
    """A copy of a module with tensors in place of numbers."""
    other = changed(module)
    for name in tensors:
        vars(other).pop(name, None)
    other._buffers.update(tensors)
    return other
