"""Data of a wind with effects for the kernels: numbers that change with the substep, and a table of all others."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

from gaussian_swaying._graphs import fingerprint, tensors_in
from gaussian_swaying.aero.carried import CarriedField, Turbulence
from gaussian_swaying.aero.effects import LogProfile, PowerProfile, WindEffect
from gaussian_swaying.aero.obstacle_flow import ellipsoid_strength, wake_start
from gaussian_swaying.aero.obstacles import CylinderObstacle, EllipsoidObstacle, Obstacle, SphereObstacle
from gaussian_swaying.aero.recorded import FrozenWind
from gaussian_swaying.aero.shelter import Shelter
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.mpm.forces import TWIN_VECTOR

LOG, POWER, CARRIED, SHELTER, SPHERE, CYLINDER, ELLIPSOID = range(7)  # as in `effects_triton`
KINDS: dict[type[WindEffect], int] = {
    LogProfile: LOG,
    PowerProfile: POWER,
    CarriedField: CARRIED,
    Turbulence: CARRIED,
    FrozenWind: CARRIED,
    Shelter: SHELTER,
    SphereObstacle: SPHERE,
    CylinderObstacle: CYLINDER,
    EllipsoidObstacle: ELLIPSOID,
}
HEADER = 32
STREETS = 10
"""Index of the first vortex street in the numbers of a substep; those before it include the mean flow."""


class Packed(NamedTuple):
    """A wind as the kernels read it.

    Attributes:
        kinds: The number of effects, and five for each: its kind, where its table starts, and whether that repeats
            along each axis; of an obstacle, whether it has a wake, and where its street is.
        space: A header for each effect, and then their tables, float32, shape (n,).
        keys: Key of each effect; its numbers are valid as long as the key does not change.
    """

    kinds: tuple[int, ...]
    space: Tensor
    keys: tuple[object, ...]


def has_twin(wind: WindField) -> bool:
    """True if the kernels can compute a wind: they know its effects, and at most one is a carried field.

    The kernels know no subclass of an effect, as it may compute something else. The obstacles that shed vortices must
    fit into the numbers of a substep (``TWIN_VECTOR``).
    """
    kinds = [KINDS.get(type(effect)) for effect in wind.effects]  # type: ignore[arg-type]
    fits = STREETS + len(_streets(wind)) <= TWIN_VECTOR
    return type(wind) is WindField and None not in kinds and kinds.count(CARRIED) <= 1 and fits


def _streets(wind: WindField) -> list[CylinderObstacle]:
    """The poles that shed vortices."""
    poles = [effect for effect in wind.effects if isinstance(effect, CylinderObstacle)]
    return [pole for pole in poles if pole.street and pole.drag > 0]


def packed(wind: WindField, device: torch.device, before: Packed | None = None) -> Packed:
    """Return the constants that the kernels are compiled for, and the numbers that they read.

    Args:
        wind: The wind.
        device: Device of the numbers.
        before: The earlier result, if any: only numbers of effects that have changed since are written, in place if
            they fit.
    """
    effects = list(wind.effects)
    keys = [_key(effect) for effect in effects]
    sizes = [effect.table.numel() if isinstance(effect, CarriedField | Shelter) else 0 for effect in effects]
    streets, kinds, start = _streets(wind), [len(effects)], HEADER * len(effects)
    for effect, size in zip(effects, sizes, strict=True):
        flags = (0, 0, 0)
        if isinstance(effect, CarriedField):
            flags = (int(effect.wraps[0]), int(effect.wraps[1]), int(effect.wraps[2]))
        elif isinstance(effect, Obstacle):
            street = STREETS + streets.index(effect) if effect in streets else 0
            flags = (int(effect.drag > 0), street, 0)
        kinds += [KINDS[type(effect)], start, *flags]  # type: ignore[index]
        start += size
    if before is None or before.kinds != tuple(kinds) or len(before.space) != start:
        space, known = torch.zeros(start, device=device), [None] * len(effects)
    else:
        space, known = before.space, list(before.keys)  # type: ignore[arg-type]
    for number, (effect, size) in enumerate(zip(effects, sizes, strict=True)):
        first = kinds[2 + 5 * number]
        if known[number] is None or known[number] != keys[number]:
            head = space[HEADER * number : HEADER * (number + 1)]
            _write(effect, head, space[first : first + size])  # type: ignore[arg-type]
    return Packed(tuple(kinds), space, tuple(keys))


def _key(effect: nn.Module) -> object:
    """Return a key that changes when the numbers of an effect change; None if changes cannot be detected."""
    tensors = tensors_in([effect])
    if any(tensor.is_inference() for tensor in tensors):
        return None
    return effect, fingerprint([effect]), tuple(tensor._version for tensor in tensors)


def _write(effect: WindEffect, head: Tensor, table: Tensor) -> None:
    """Write the header of an effect, shape (32,), and its table."""
    if isinstance(effect, LogProfile):
        scale = 1 / math.log(effect.height / effect.roughness)
        head[:3] = torch.tensor([effect.ground[2], effect.roughness, scale])
    elif isinstance(effect, PowerProfile):
        head[:3] = torch.tensor([effect.ground[2], 1 / effect.height, effect.exponent])
    elif isinstance(effect, CarriedField):
        head[:9] = (effect.axes / effect.step[:, None]).reshape(-1)
        head[9:18] = effect.axes.T.reshape(-1)
        head[18:21] = torch.tensor(effect.table.shape[:3])
        table.copy_(effect.table.reshape(-1))
    elif isinstance(effect, Shelter):
        head[:9] = effect.turn.reshape(-1)
        head[9:12] = effect.shift
        head[18:21] = effect.cells
        table.copy_(effect.table.reshape(-1))
    elif isinstance(effect, CylinderObstacle):
        head[:3], head[5:8] = effect.middle, effect.axis
        head[3], head[4], head[8] = effect.radius, effect.drag, effect.strouhal
    elif isinstance(effect, SphereObstacle):
        head[:3], head[3], head[4], head[5] = effect.middle, effect.radius, effect.drag, wake_start(effect.drag)
    elif isinstance(effect, EllipsoidObstacle):
        radii = tuple(map(float, effect.radii))
        head[:3], head[3], head[4], head[5] = effect.middle, max(radii), effect.drag, wake_start(effect.drag)
        head[6:15] = effect.axes.reshape(-1)
        head[15:21] = torch.tensor([*(radius / max(radii) for radius in radii), *ellipsoid_strength(radii)])


def vectors(wind: WindField, velocity: Tensor, times: Tensor) -> Tensor:
    """Return the numbers of a wind that change with time, as the kernels read them.

    Args:
        wind: The wind.
        velocity: Its velocity without effects at these times [m/s], shape (n, 3).
        times: The times [s], shape (n,), float64.

    Returns:
        Velocity, place of the object's centre in a carried field [cells], its strength [m/s], and if the flow matters
        the mean flow [m/s] and the phase of each vortex street; shape (n, 7), or (n, 10 + streets).
    """
    place, strength = torch.zeros_like(velocity), torch.zeros_like(velocity[:, :1])
    if not any(isinstance(effect, CarriedField | Obstacle) for effect in wind.effects):
        return torch.cat([velocity, place, strength], dim=-1)
    flow, carried = wind.mean_flow(times), wind.carried(times)
    for effect in wind.effects:
        if isinstance(effect, CarriedField):
            place = effect.offset(carried)
            found = effect.strength(flow)
            strength = found if isinstance(found, Tensor) else strength + found
    turns = [pole.turns(flow, carried)[:, None] for pole in _streets(wind)]
    return torch.cat([velocity, place, strength, flow, *turns], dim=-1)
