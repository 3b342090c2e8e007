"""What is sought: an option of the simulation with a range, and how its value gets into a variant of a simulation."""

from __future__ import annotations

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_poisson_ratio
from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.simulation import Simulation

SCALES = ("log", "linear")
POLAR = ("wind.speed", "wind.azimuth", "wind.elevation")
MATERIAL = ("material.E", "material.nu", "material.density", "material.thickness")
AERO = ("aero.C_D", "aero.C_F", "aero.C_L")
SOLVER = ("solver.damping", "solver.stiffness_damping")
NAMES = (*POLAR, "wind.modulations.0.amplitude", *MATERIAL, *AERO, *SOLVER)
"""What can be sought; also any number of any modulation of the wind, by its place in the list."""

_UNITS = {
    "speed": "m/s",
    "azimuth": "degrees",
    "elevation": "degrees",
    "E": "Pa",
    "density": "kg/m³",
    "thickness": "m",
    "damping": "1/s",
    "stiffness_damping": "s",
    "std": "m/s",
    "period": "s",
    "phase": "rad",
}
_LINEAR = ("azimuth", "elevation", "nu", "phase")
_NOT_NEGATIVE = ("speed", "C_D", "C_F", "damping", "stiffness_damping", "amplitude", "std", "delta")
_POSITIVE = ("E", "density", "thickness", "period", "interval")


@dataclass(frozen=True)
class Unknown:
    """A number that is sought.

    Args:
        name: The option of ``sim``, such as ``material.E``; or ``wind.speed`` [m/s], ``wind.azimuth`` [degrees, from +x
            towards +y] and ``wind.elevation`` [degrees above the ground], which together are ``wind.flow``.
        low: Smallest value.
        high: Largest value.
        scale: ``log`` or ``linear``.
        start: Where to start; None for a coarse search over the range.

    Raises:
        ValueError: If the name is unknown or the range makes no sense; the message names the unknown.
    """

    name: str
    low: float
    high: float
    scale: str = "linear"
    start: float | None = None

    def __post_init__(self) -> None:
        where = f"unknowns.{self.name}"
        check_choice(f"{where}.scale", self.scale, SCALES)
        parts = self.name.split(".")
        modulation = parts[:2] == ["wind", "modulations"] and len(parts) == 4 and parts[2].isdecimal()
        if self.name not in NAMES and not modulation:
            raise ValueError(f"`{self.name}` cannot be sought: use {', '.join(NAMES)}, or put it into `known`.")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"Expected `{where}.range` to be [low, high], but got [{self.low}, {self.high}].")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"Expected `{where}.range` above 0 with `scale: log`, but got {self.low}.")
        last = parts[-1]
        if (last in _POSITIVE and self.low <= 0) or (last in _NOT_NEGATIVE and self.low < 0):
            raise ValueError(f"Expected `{where}.range` to be {'above' if last in _POSITIVE else 'at least'} 0.")
        if last == "nu":
            check_poisson_ratio(f"{where}.range", self.low)
            check_poisson_ratio(f"{where}.range", self.high)
        if self.start is not None and not self.low <= self.start <= self.high:
            raise ValueError(f"Expected `{where}.start` within its range, but got {self.start}.")

    @property
    def unit(self) -> str:
        """Its unit, empty for a pure number."""
        return _UNITS.get(self.name.split(".")[-1], "")

    def value(self, share: float) -> float:
        """The value at a share of the range, 0 at ``low`` and 1 at ``high``."""
        if self.scale == "log":
            return self.low * (self.high / self.low) ** share
        return self.low + share * (self.high - self.low)

    def share(self, value: float) -> float:
        """Where in the range a value lies."""
        if self.scale == "log":
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def slope(self, share: float) -> float:
        """Change of the value per share of the range."""
        return self.value(share) * math.log(self.high / self.low) if self.scale == "log" else self.high - self.low


def default_scale(name: str, low: float) -> str:
    """``log`` for positive sizes, ``linear`` for angles, Poisson's ratio and ranges that reach zero."""
    return "linear" if name.split(".")[-1] in _LINEAR or low <= 0 else "log"


@dataclass(frozen=True)
class Variant:
    """What distinguishes a simulation with some values from the base.

    Attributes:
        points: Its material.
        wind: Its wind.
        aero: C_D, C_F and C_L.
        damping: Rate of the damping [1/s], and the time constant of the stiffness damping [s].
    """

    points: MaterialPoints
    wind: WindField
    aero: tuple[float, float, float]
    damping: tuple[float, float]


def check_unknowns(simulation: Simulation, unknowns: Sequence[Unknown]) -> None:
    """Raise ValueError if a simulation has no place for an unknown; the message names it and the remedy."""
    names = [unknown.name for unknown in unknowns]
    if not names:
        raise ValueError("Expected `unknowns` to have at least one entry, such as wind.speed: add it.")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"`{name}` is in `unknowns` twice: remove one.")
    variant_of(simulation, {unknown.name: unknown.value(0.5) for unknown in unknowns})


def flow_of(base: Sequence[float], values: Mapping[str, float]) -> list[float]:
    """The flow [m/s] with some of speed, azimuth and elevation replaced.

    Example:
        >>> [round(x, 3) for x in flow_of([2.0, 0.0, 0.0], {"wind.azimuth": 90.0})]
        [0.0, 2.0, 0.0]
    """
    x, y, z = base
    speed = values.get("wind.speed", math.hypot(x, y, z))
    azimuth = math.radians(values["wind.azimuth"]) if "wind.azimuth" in values else math.atan2(y, x)
    rise = math.radians(values["wind.elevation"]) if "wind.elevation" in values else math.atan2(z, math.hypot(x, y))
    level = speed * math.cos(rise)
    return [level * math.cos(azimuth), level * math.sin(azimuth), speed * math.sin(rise)]


def variant_of(simulation: Simulation, values: Mapping[str, float]) -> Variant:
    """A variant of a simulation.

    Args:
        simulation: The base.
        values: The values that replace its own.

    Raises:
        ValueError: If the simulation has no place for one of them.
    """
    solver = simulation.solver
    own = {
        "solver.damping": solver.damping,
        "solver.stiffness_damping": solver.stiffness_damping,
        **{name: float(getattr(simulation.aero, name[5:])) for name in AERO},
    }
    own |= {name: value for name, value in values.items() if name in own}
    return Variant(
        _points(simulation, values),
        _wind(simulation, values),
        (own["aero.C_D"], own["aero.C_F"], own["aero.C_L"]),
        (own["solver.damping"], own["solver.stiffness_damping"]),
    )


def _points(simulation: Simulation, values: Mapping[str, float]) -> MaterialPoints:
    points, material = simulation.scene.points, simulation.material
    for name in MATERIAL:
        if name in values and any(getattr(part, name[9:]) is not None for part in material.regions):
            raise ValueError(f"`{name}` is sought, but `material.regions` gives it too: remove it there.")
    if "material.thickness" in values:
        if (
            material.volume != "patch"
            or simulation.scene.filled
            or simulation.scene.points.count != _layers(simulation)
        ):
            raise ValueError(
                "`material.thickness` can be sought only of a sheet of one layer (`scene.layers: 1`): seek "
                "`material.E` and `material.density` instead."
            )
        ratio = values["material.thickness"] / material.thickness
        points = replace(points, mass=points.mass * ratio, volume=points.volume * ratio)
    if "material.E" in values:
        points = replace(points, youngs_modulus=torch.full_like(points.youngs_modulus, values["material.E"]))
    if "material.nu" in values:
        points = replace(points, poisson_ratio=torch.full_like(points.poisson_ratio, values["material.nu"]))
    if "material.density" in values:
        points = replace(points, mass=points.volume * values["material.density"])
    return points


def _layers(simulation: Simulation) -> int:
    """Number of points of a scene with one layer."""
    return simulation.scene.on_surface + simulation.scene.filled


def _wind(simulation: Simulation, values: Mapping[str, float]) -> WindField:
    wind = simulation.wind
    if not isinstance(wind, WindField):
        raise ValueError("Expected `wind` to be a WindField: a custom wind has no numbers that could be sought.")
    polar = {name: value for name, value in values.items() if name in POLAR}
    further = {name: value for name, value in values.items() if name.startswith("wind.modulations.")}
    if not polar and not further:
        return wind
    wind = copy.deepcopy(wind)
    if polar:
        if len(wind.flows) > 1:
            raise ValueError("`wind.schedule` gives the flow: remove it, or do not seek `wind.speed` and its angles.")
        base = wind.flows[0].tolist()
        if not any(base) and len(polar) < 2:
            raise ValueError("The base has no `wind.flow`: give one, or seek `wind.speed` and `wind.azimuth`.")
        wind.flows = torch.tensor([flow_of(base, polar)], dtype=torch.float64, device=wind.flows.device)
    for name, value in further.items():
        place, field = int(name.split(".")[2]), name.split(".")[3]
        if place >= len(wind.modulations) or not isinstance(getattr(wind.modulations[place], field, None), float):
            raise ValueError(f"`{name}` is sought, but the wind of the base has no such number: add the modulation.")
        setattr(wind.modulations[place], field, float(value))
    return wind


def aero_like(base: AeroForce, coefficients: tuple[float, float, float]) -> AeroForce:
    """The same force with other C_D, C_F and C_L."""
    other = copy.deepcopy(base)
    for name, value in zip(("C_D", "C_F", "C_L"), coefficients, strict=True):
        getattr(other, name).fill_(value)
    return other


def stacked(points: Sequence[MaterialPoints]) -> MaterialPoints:
    """Several bodies of equal shape as a batch."""
    first = points[0]

    def batch(name: str) -> Tensor:
        return torch.stack([getattr(part, name) for part in points])

    fields = {name: batch(name) for name in ("position", "mass", "volume", "youngs_modulus", "poisson_ratio")}
    return MaterialPoints(**fields, laws=first.laws, law_index=None if first.law_index is None else batch("law_index"))


__all__ = ["NAMES", "Unknown", "Variant", "check_unknowns", "default_scale", "flow_of", "variant_of"]
