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
from gaussian_swaying.geometry.linalg_triton import add3, axpy9, chosen, matmul, read, rotation, scale3, transpose
from gaussian_swaying.kernels.language import tl, triton


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

    def keys(self, frame: SimFrame | None = None) -> Tensor:
        """Rows for :func:`pose` [s, m, rad], float64, shape (K + 1, 7); converted to metres if a frame is given."""
        times = torch.tensor(self.times, dtype=torch.float64)[:, None]
        moves, turns = (_vectors(keys, len(times)) for keys in (self.moves, self.turns))
        turns = torch.deg2rad(turns)
        if frame is not None:
            moves = frame.direction_to_sim(moves) * frame.metres_per_unit
            turns = frame.direction_to_sim(turns)
        rows = torch.cat([times, moves, turns], 1)
        return torch.cat([rows, rows[-1:] + torch.eye(1, 7, dtype=torch.float64)])

    @property
    def speed(self) -> float:
        """Largest speed of the moves [scene units/s]."""
        keys = self.keys()
        return fastest(keys[:, 0], keys[:, 1:4])


def _vectors(keys: Sequence[Sequence[float]], count: int) -> Tensor:
    return torch.tensor(keys, dtype=torch.float64) if keys else torch.zeros(count, 3, dtype=torch.float64)


def fastest(times: Tensor, values: Tensor, start: float = -math.inf, end: float = math.inf) -> float:
    """Largest rate of change of values (K, 3) between keys, over intervals that overlap [start, end] [s]."""
    if len(times) < 2:
        return 0.0
    meets = (times[1:] > start) & (times[:-1] < end)
    rate = values.diff(dim=0).norm(dim=-1) / times.diff()
    return float(torch.where(meets, rate, 0.0).amax())


def keys_before(keys: Tensor, time: Tensor) -> Tensor:
    """The number of the key before each time, or of the first, in the shape of the times."""
    found = torch.searchsorted(keys[:-1, 0].contiguous(), time.reshape(-1), right=True) - 1
    return found.clamp(min=0).reshape(time.shape)


def picked(values: Tensor, index: Tensor) -> Tensor:
    """Index a tensor (N, ...) with an integer tensor of any shape, without a GPU synchronisation.

    ``values[index]`` with a scalar on a GPU would read it on the host, which a CUDA graph cannot record.
    """
    return values.index_select(0, index.reshape(-1)).reshape((*index.shape, *values.shape[1:]))


@triton.jit
def pose(keys, k, t):
    """Displacement and rotation (twelve numbers) at times t, interpolated after the k-th key.

    ``keys`` has rows of the time, the displacement and the turn; the last is followed by a later one that is the same.
    """
    key = keys + 7 * k
    start = tl.load(key)
    share = tl.minimum(tl.maximum((t - start) / (tl.load(key + 7) - start), 0.0), 1.0)
    move = add3(read(key, 1, 3), share, add3(read(key, 8, 3), -1.0, read(key, 1, 3)))
    turn = add3(read(key, 4, 3), share, add3(read(key, 11, 3), -1.0, read(key, 4, 3)))
    return move + rotation(turn)


@triton.jit
def rigid_motion(keys, k, later, t, dt, centre):
    """Centre and rotation at times t, and the velocity field: a matrix times the offset, plus a vector.

    It takes each place to where it is ``dt`` later; k and ``later`` are the keys before both times.
    """
    here = pose(keys, k, t)
    there = pose(keys, later, t + dt)
    turn = matmul(chosen(there, 3, 9), transpose(chosen(here, 3, 9)))
    one = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    speed = add3(chosen(there, 0, 3), -1.0, chosen(here, 0, 3))
    return add3(centre, 1.0, here) + chosen(here, 3, 9) + axpy9(1 / dt, turn, -1 / dt, one) + scale3(1 / dt, speed)


@triton.jit(do_not_specialize=("count", "steps"))
def rigid_motions(keys, count, centre, time, dt, out, steps, BLOCK: tl.constexpr):
    """:func:`rigid_motion` at the start of some substeps, a row of 32 each."""
    n = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    step = tl.load(dt)
    t = tl.load(time) + step * n
    k = n * 0
    later = n * 0
    for j in range(1, count):
        key = tl.load(keys + 7 * j)
        k += (t >= key).to(tl.int32)
        later += (t + step >= key).to(tl.int32)
    found = rigid_motion(keys, k, later, t, step, read(centre, 0, 3))
    for c in tl.static_range(24):
        tl.store(out + n * 32 + c, found[c], n < steps)
