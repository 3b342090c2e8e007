"""The winds of many scenes at once: one for each scene of a batch, computed together."""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy

import torch
from torch import Tensor, nn

from gaussian_swaying.kernels.graphs import Recordable
from gaussian_swaying.wind.field import GaussianGust, Modulation, SineSway, UniformGust, WindField

NUMBERS: dict[type[Modulation], dict[str, bool]] = {
    SineSway: {"amplitude": False, "period": False, "phase": False},
    UniformGust: {"delta": True, "interval": False},
    GaussianGust: {"std": True, "interval": False},
}
"""The numbers of the modulations that can be computed together; True for those that multiply a vector."""


class WindBatch(Recordable, nn.Module):
    """Uniform winds with the same kinds of modulations, one for each scene of a batch.

    A list of winds does the same, but the host then goes through all of them before every rollout. This copies their
    numbers: later changes of the winds have no effect.

    Args:
        winds: The winds, all on one device.

    Raises:
        ValueError: If the winds cannot be computed together.

    Example:
        >>> WindBatch([WindField([2.0, 0.0, 0.0]), WindField([3.0, 0.0, 0.0])])(torch.zeros(1, dtype=torch.float64))
        tensor([[[2., 0., 0.],
                 [3., 0., 0.]]], dtype=torch.float64)
    """

    recordable = True
    uniform = True

    def __init__(self, winds: Sequence[WindField]) -> None:
        super().__init__()
        if not winds:
            raise ValueError("Expected at least one of `winds`.")
        why = why_apart(winds)
        if why is not None:
            raise ValueError(why)
        self.linear = winds[0].interpolation == "linear"
        longest = max(len(wind.times) for wind in winds)
        self.register_buffer("times", torch.stack([_longer(wind.times, longest, math.inf) for wind in winds]))
        self.register_buffer("flows", torch.stack([_longer(wind.flows, longest) for wind in winds]))
        self.register_buffer("seeds", torch.tensor([_wrapped(wind.seed) for wind in winds]).to(self.times.device))
        parts = zip(*[wind.modulations for wind in winds], strict=True)
        self.modulations = nn.ModuleList(_joined(list(part), self.times.device) for part in parts)
        self.times: Tensor
        self.flows: Tensor
        self.seeds: Tensor

    def __len__(self) -> int:
        return len(self.seeds)

    def forward(self, time: Tensor) -> Tensor:
        """Velocities [m/s], shape (n, B, 3), at times [s], shape (n,), float64."""
        velocity, when = self.mean_flow(time), time[:, None].expand(-1, len(self))
        for stream, modulation in enumerate(self.modulations):
            velocity = modulation(velocity, when, self.seeds, stream)
        return velocity

    def mean_flow(self, time: Tensor) -> Tensor:
        """The flows without modulations [m/s], shape (n, B, 3); as ``WindField.mean_flow``."""
        last = self.times.shape[1] - 1
        if last == 0:
            return self.flows[:, 0].expand(len(time), -1, 3)
        when = time.expand(len(self), -1).contiguous()
        key = (torch.searchsorted(self.times, when, right=True) - 1).clamp(0, last)

        def at(place: Tensor) -> tuple[Tensor, Tensor]:
            return self.times.gather(1, place), self.flows.gather(1, place[..., None].expand(-1, -1, 3))

        begin, flow = at(key)
        if self.linear:
            end, after = at((key + 1).clamp(max=last))
            share = ((when - begin) / (end - begin).clamp(min=1e-12)).clamp(0, 1)[..., None]
            flow = torch.lerp(flow, after, share)
        return flow.transpose(0, 1)


def why_apart(winds: Sequence[nn.Module]) -> str | None:
    """Return a sentence on why winds cannot be computed together; None if they can."""
    first = winds[0]
    kinds = [type(part) for part in first.modulations] if isinstance(first, WindField) else []
    for wind in winds:
        same = type(wind) is WindField and [type(part) for part in wind.modulations] == kinds
        if not same or wind.interpolation != first.interpolation or not wind.uniform:
            return (
                "Expected `winds` to be uniform, with the same `interpolation` and modulations of the same kinds: "
                "leave out `effects`, or simulate the scenes one by one."
            )
    unknown = [kind.__name__ for kind in kinds if kind not in NUMBERS]
    return f"The modulation {unknown[0]} cannot be computed for several winds at once." if unknown else None


def _longer(values: Tensor, count: int, fill: float | None = None) -> Tensor:
    """Values with more rows at the end: copies of the last one, or of ``fill``."""
    row = values[-1:] if fill is None else torch.full_like(values[-1:], fill)
    return torch.cat([values, row.expand(count - len(values), *values.shape[1:])])


def _wrapped(seed: int) -> int:
    """A seed as a signed number of 64 bits: the generator only uses these."""
    return (seed + (1 << 63)) % (1 << 64) - (1 << 63)


def _joined(parts: list[Modulation], device: torch.device) -> nn.Module:
    joined = copy(parts[0])
    vars(joined).pop("_made")
    joined._buffers = {}
    for name, vector in NUMBERS[type(joined)].items():
        values = torch.tensor([getattr(part, name) for part in parts], dtype=torch.float64, device=device)
        delattr(joined, name)
        joined.register_buffer(name, values[:, None] if vector else values)
    return joined
