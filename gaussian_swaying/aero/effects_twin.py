"""What the kernels read of a wind with effects: numbers that change with the substep, and a table of all others."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.aero.carried import CarriedField, Turbulence
from gaussian_swaying.aero.effects import LogProfile, PowerProfile, WindEffect
from gaussian_swaying.aero.recorded import FrozenWind
from gaussian_swaying.aero.shelter import Shelter
from gaussian_swaying.aero.wind import WindField

LOG, POWER, CARRIED, SHELTER = range(4)  # as in `effects_triton`
HEADER = 32


def kind_of(effect: WindEffect) -> int | None:
    """Kind of an effect, or None if the kernels do not know it; a subclass may compute something else."""
    if type(effect) is LogProfile:
        return LOG
    if type(effect) is PowerProfile:
        return POWER
    if type(effect) is Shelter:
        return SHELTER
    return CARRIED if type(effect) in (CarriedField, Turbulence, FrozenWind) else None


def has_twin(wind: WindField) -> bool:
    """Whether the kernels know all effects of a wind, of which at most one is carried."""
    kinds = [kind_of(effect) for effect in wind.effects]  # type: ignore[arg-type]
    return type(wind) is WindField and None not in kinds and kinds.count(CARRIED) <= 1


def packed(wind: WindField, device: torch.device) -> tuple[tuple[int, ...], Tensor]:
    """What the kernels are compiled for, and the numbers that they read.

    Returns:
        The number of effects, and five for each (its kind, where its table starts, whether that repeats along each
        axis); and their numbers: a header for each, and then their tables, float32, shape (n,).
    """
    effects = list(wind.effects)
    sizes = [effect.table.numel() if isinstance(effect, CarriedField | Shelter) else 0 for effect in effects]
    space = torch.zeros(HEADER * len(effects) + sum(sizes), device=device)
    start, kinds = HEADER * len(effects), [len(effects)]
    for number, (effect, size) in enumerate(zip(effects, sizes, strict=True)):
        wraps, head = (False, False, False), space[HEADER * number : HEADER * (number + 1)]
        if isinstance(effect, LogProfile):
            scale = 1 / math.log(effect.height / effect.roughness)
            head[:3] = torch.tensor([effect.ground[2], effect.roughness, scale])
        elif isinstance(effect, PowerProfile):
            head[:3] = torch.tensor([effect.ground[2], 1 / effect.height, effect.exponent])
        elif isinstance(effect, CarriedField):
            head[:9] = (effect.axes / effect.step[:, None]).reshape(-1)
            head[9:18] = effect.axes.T.reshape(-1)
            head[18:21] = torch.tensor(effect.table.shape[:3])
            space[start : start + size] = effect.table.reshape(-1)
            wraps = effect.wraps
        elif isinstance(effect, Shelter):
            head[:9] = effect.turn.reshape(-1)
            head[9:12] = effect.shift
            head[18:21] = effect.cells
            space[start : start + size] = effect.table.reshape(-1)
        kinds += [kind_of(effect) or 0, start, *map(int, wraps)]  # type: ignore[arg-type]
        start += size
    return tuple(kinds), space


def vectors(wind: WindField, velocity: Tensor, times: Tensor) -> Tensor:
    """What the kernels read of a wind at some times.

    Args:
        wind: The wind.
        velocity: Its velocity without effects at these times [m/s], shape (n, 3).
        times: The times [s], shape (n,), float64.

    Returns:
        Velocity, place of the object's centre in a carried field [cells] and its strength [m/s], shape (n, 7).
    """
    place, strength = torch.zeros_like(velocity), torch.zeros_like(velocity[:, :1])
    for effect in wind.effects:
        if isinstance(effect, CarriedField):
            place = effect.offset(wind.carried(times))
            found = effect.strength(wind.mean_flow(times))
            strength = found if isinstance(found, Tensor) else strength + found
    return torch.cat([velocity, place, strength], dim=-1)
