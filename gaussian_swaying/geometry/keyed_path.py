"""Rigid motion along keys: places and rotations at given times."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector
from gaussian_swaying._fixed import fixed
from gaussian_swaying.geometry.frame import SimFrame


@fixed
@dataclass
class KeyedPath:
    """A rigid motion given at some times, and linear in between.

    Args:
        times: Times of the keys [s], rising.
        moves: Displacement from the place at rest at each, in scene units; none if empty.
        turns: Rotation about the centre of what moves at each, as axis times angle [degrees], in scene axes; none if
            empty.

    Raises:
        ValueError: If times do not rise, or there is not one move or turn for each.

    Example:
        >>> KeyedPath([0.0, 2.0], moves=[[0, 0, 0], [0, 0, 0.5]]).speed
        0.25
    """

    times: list[float]
    moves: list[list[float]] = field(default_factory=list)
    turns: list[list[float]] = field(default_factory=list)

    def __post_init__(self) -> None:
        times = [float(t) for t in self.times]
        check_vector("times", times, len(times))
        if not times or any(b <= a for a, b in pairwise(times)):
            raise ValueError(f"Expected `times` of the path to rise, with at least one, but got {self.times}.")
        for name in ("moves", "turns"):
            keys = getattr(self, name)
            if keys and len(keys) != len(times):
                raise ValueError(
                    f"Expected `{name}` of the path to have one entry for each of its {len(times)} `times`, but got "
                    f"{len(keys)}."
                )
            for key in keys:
                check_vector(name, key)

    def keys(self, frame: SimFrame | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Times [s], shape (K,), moves [m] and turns [rad], shape (K, 3), float64, in metres if a frame is given."""
        count = len(self.times)
        times = torch.tensor(self.times, dtype=torch.float64)
        moves, turns = (_vectors(keys, count) for keys in (self.moves, self.turns))
        turns = torch.deg2rad(turns)
        if frame is not None:
            moves = frame.direction_to_sim(moves) * frame.metres_per_unit
            turns = frame.direction_to_sim(turns)
        return times, moves.clone(), turns.clone()

    @property
    def speed(self) -> float:
        """Largest speed of the moves [scene units/s]."""
        times, moves, _ = self.keys()
        return fastest(times, moves)


def _vectors(keys: Sequence[Sequence[float]], count: int) -> Tensor:
    return torch.tensor(keys, dtype=torch.float64) if keys else torch.zeros(count, 3, dtype=torch.float64)


def fastest(times: Tensor, values: Tensor, start: float = -math.inf, end: float = math.inf) -> float:
    """Largest rate of values (K, 3) between keys, over the intervals that overlap the time from start to end [s]."""
    if len(times) < 2:
        return 0.0
    meets = (times[1:] > start) & (times[:-1] < end)
    rate = values.diff(dim=0).norm(dim=-1) / times.diff()
    return float(torch.where(meets, rate, 0.0).amax())


def picked(values: Tensor, index: Tensor) -> Tensor:
    """Rows of a tensor (N, ...) by integers of any shape, also of none, without making the host wait.

    ``values[index]`` with a scalar on a GPU would read it on the host, which a CUDA graph cannot record.
    """
    return values.index_select(0, index.reshape(-1)).reshape((*index.shape, *values.shape[1:]))


def between(times: Tensor, values: Tensor, time: Tensor) -> Tensor:
    """Values (K, 3) at times (...), linear between the keys and constant before and after, shape (..., 3)."""
    if len(times) == 1:
        return values[0].expand(*time.shape, 3)
    time = time.to(times)
    last = (torch.searchsorted(times, time.reshape(-1), right=True) - 1).clamp(0, len(times) - 2).reshape(time.shape)
    start, end = picked(times, last), picked(times, last + 1)
    f = ((time - start) / (end - start)).clamp(0.0, 1.0)[..., None]
    low = picked(values, last)
    return low + f * (picked(values, last + 1) - low)
