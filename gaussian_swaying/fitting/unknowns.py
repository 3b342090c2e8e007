"""An unknown of a fit: a number of the simulation with a range, and how variants of a simulation get its value."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from gaussian_swaying._checks import check_choice
from gaussian_swaying.fitting.scale import SCALE, at_scale
from gaussian_swaying.simulation.model import find, names, number
from gaussian_swaying.simulation.simulation import Simulation

SCALES = ("log", "linear")
FILM_START = "film.start"
"""Time in the film at which the motion starts, at rest until then [s]; below 0, the wind has blown for so long when the
film begins. It is no number of the simulation."""

CHANGES = ("wind.speed@", "wind.azimuth@")
"""Begins of the names of the wind at a time of the film, see :mod:`~gaussian_swaying.fitting.changing`."""


def is_change(name: str) -> bool:
    """True for an unknown of a wind that changes: no number of the simulation."""
    return name.startswith(CHANGES)


@dataclass(frozen=True)
class Unknown:
    """An unknown of a fit.

    Args:
        name: The option of ``sim``, such as ``material.E``; or ``wind.speed`` [m/s], ``wind.azimuth`` [degrees, from +x
            towards +y] and ``wind.elevation`` [degrees above the ground], which together are ``wind.flow``; or
            :data:`FILM_START` [s], or :data:`~gaussian_swaying.fitting.scale.SCALE` [m].
        low: Smallest value.
        high: Largest value.
        scale: ``log`` or ``linear``.
        start: First value; None for a coarse search over the range.

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
        known = find(self.name)
        own = self.name in (FILM_START, SCALE) or is_change(self.name)
        if not own and (known is None or known.kind != "number"):
            numbers = (name for name in names() if number(name.replace("*", "0")).kind == "number")
            sought = [FILM_START, SCALE, *numbers]
            raise ValueError(f"`{self.name}` cannot be sought: use {', '.join(sought)}, or put it into `known`.")
        if not (math.isfinite(self.low) and math.isfinite(self.high) and self.low < self.high):
            raise ValueError(f"Expected `{where}.range` to be [low, high], but got [{self.low}, {self.high}].")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"Expected `{where}.range` above 0 with `scale: log`, but got {self.low}.")
        if known is not None:
            known.check(f"{where}.range", self.low)
            known.check(f"{where}.range", self.high)
        if self.start is not None and not self.low <= self.start <= self.high:
            raise ValueError(f"Expected `{where}.start` within its range, but got {self.start}.")

    @property
    def unit(self) -> str:
        if is_change(self.name):
            return "" if self.name.startswith(CHANGES[0]) else "degrees"
        own = {FILM_START: "s", SCALE: "m"}
        return own[self.name] if self.name in own else number(self.name).unit

    def value(self, share: float) -> float:
        """The value at a share of the range, 0 at ``low`` and 1 at ``high``."""
        if self.scale == "log":
            return self.low * (self.high / self.low) ** share
        return self.low + share * (self.high - self.low)

    def share(self, value: float) -> float:
        """Return the share of the range at which a value lies, 0 to 1; logarithmic if ``scale`` is."""
        if self.scale == "log":
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def slope(self, share: float) -> float:
        """Change of the value per share of the range."""
        return self.value(share) * math.log(self.high / self.low) if self.scale == "log" else self.high - self.low


def of_simulation(values: Mapping[str, float]) -> dict[str, float]:
    """The values that are numbers of the simulation."""
    return {n: value for n, value in values.items() if n not in (FILM_START, SCALE) and not is_change(n)}


def default_scale(name: str, low: float) -> str:
    """``log`` for positive sizes, ``linear`` for angles, Poisson's ratio and ranges that reach zero."""
    known = find(name)
    return "log" if low > 0 and name != FILM_START and (known is None or known.scale == "log") else "linear"


def values_at(unknowns: Sequence[Unknown], place: Iterable[float]) -> dict[str, float]:
    """Values of unknowns at a place, given as shares of their ranges."""
    return {u.name: u.value(float(share)) for u, share in zip(unknowns, place, strict=True)}


def check_unknowns(simulation: Simulation, unknowns: Sequence[Unknown]) -> None:
    """Raise ValueError if a simulation has no such parameter as an unknown; the message names it and the remedy."""
    names = [unknown.name for unknown in unknowns]
    if not names:
        raise ValueError("Expected `unknowns` to have at least one entry, such as wind.speed: add it.")
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"`{name}` is in `unknowns` twice: remove one.")
    values = {unknown.name: unknown.value(0.5) for unknown in unknowns}
    model = simulation.model.at(of_simulation(values))
    if SCALE in values:
        at_scale(model, values[SCALE])
