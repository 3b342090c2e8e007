"""The plan of a fit: unknowns and settings, what a film cannot tell apart, and other values that may explain it."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._arguments import check_arguments, is_number
from gaussian_swaying._checks import check_choice, check_whole
from gaussian_swaying._live import Live
from gaussian_swaying._yaml_limits import read_fields
from gaussian_swaying.config.gone import refuse_gone
from gaussian_swaying.config.parser import import_forces
from gaussian_swaying.simulation.model import Model, find, names

Values = Mapping[str, float]  # values of the unknowns, by name
FILM_START = "film.start"  # an unknown: start of the motion [s]; below 0, the wind has blown before
FLAT = 0.8  # mean square of the area that faces one way, from which the wind may be mirrored
TURN = 5.0  # least angle between wind and mirror image [degrees]
LARGE = 0.25  # share of the largest part of a direction below which an unknown is not named
LISTS = ("base", "videos", "cameras", "assumed", "also_moves")
ASSUMED = ("length", "mass", "camera")


@dataclass(frozen=True)
class Unknown:
    """An unknown of a fit.

    Args:
        name: A number of :class:`~gaussian_swaying.simulation.model.Model`, such as ``material.E`` or ``wind.speed``,
            or ``film.start``.
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
        check_choice(f"{where}.scale", self.scale, ("log", "linear"))
        for end in (self.low, self.high):
            number_of(self.name).check(f"{where}.range", end)
        if not self.low < self.high:
            raise ValueError(f"Expected `{where}.range` to be [low, high], but got [{self.low}, {self.high}].")
        if self.scale == "log" and self.low <= 0:
            raise ValueError(f"Expected `{where}.range` above 0 with `scale: log`, but got {self.low}.")
        if self.start is not None and not self.low <= self.start <= self.high:
            raise ValueError(f"Expected `{where}.start` within its range, but got {self.start}.")

    @property
    def unit(self) -> str:
        return number_of(self.name).unit

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


def number_of(name: str) -> Live:
    """The number that an unknown is; ValueError if it cannot be sought."""
    known = Live("s") if name == FILM_START else find(name)
    if known is None or known.kind != "number":
        sought = [n for n in names() if (one := find(n.replace("*", "0"))) and one.kind == "number"]
        raise ValueError(f"`{name}` cannot be sought: use {', '.join([FILM_START, *sought])}, or put it into `known`.")
    return known


def values_at(unknowns: Sequence[Unknown], place: Iterable[float]) -> dict[str, float]:
    """Values of unknowns at a place, given as shares of their ranges."""
    return {u.name: u.value(float(share)) for u, share in zip(unknowns, place, strict=True)}


def of_simulation(values: Values) -> dict[str, float]:
    """The values that are numbers of the simulation."""
    return {name: value for name, value in values.items() if name != FILM_START}


def check_apart(matrix: Tensor, unknowns: Sequence[Unknown], place: Tensor, limit: float) -> None:
    """Raise ValueError if a film cannot tell unknowns apart at a place (U,), from the sensitivities J^T W J (U, U).

    That is where the largest singular value is over ``limit`` times the smallest.
    """
    squares, vectors = torch.linalg.eigh(matrix)
    condition = math.sqrt(max(float(squares[-1]), 0.0) / max(float(squares[0]), 1e-300))
    if len(unknowns) < 2 or condition <= limit:
        return
    told, weakest, words = f"(condition {condition:.3g}, limit {limit:g})", vectors[:, 0].tolist(), {}
    lead = max(range(len(unknowns)), key=lambda k: abs(weakest[k]))
    first, share = unknowns[lead], float(place[lead])
    # how far until the largest part has changed by a tenth of its value, or of its range
    far = 0.1 * abs(first.value(share) / first.slope(share)) if first.scale == "log" else 0.1
    for u, part, share in zip(unknowns, weakest, place.tolist(), strict=True):
        if abs(part) > LARGE * abs(weakest[lead]):
            change = far * part / weakest[lead] * u.slope(share)
            amount = (
                f"{abs(change / u.value(share)):.0%}" if u.scale == "log" else f"{abs(change):.2g} {u.unit}".strip()
            )
            words[f"`{u.name}`"] = f"{'raising' if change > 0 else 'lowering'} {u.name} by {amount}"
    *names, last = words
    if not names:
        raise ValueError(f"The video does not tell {last} {told}: put it into `known`, or raise `limit`.")
    raise ValueError(
        f"The video cannot tell {', '.join(names)} and {last} apart: {' and '.join(words.values())} changes nothing "
        f"that is seen {told}. Put one of them into `known`, or raise `limit`."
    )


def apart_by(unknowns: Sequence[Unknown], one: Sequence[float], other: Sequence[float]) -> float:
    """Return the largest distance of two places, as a share of a range; azimuths 360 degrees apart are the same."""
    most = 0.0
    for unknown, a, b in zip(unknowns, one, other, strict=True):
        wide = unknown.high - unknown.low
        most = max(most, abs(turn(wide * (a - b))) / wide if unknown.name == "wind.azimuth" else abs(a - b))
    return most


def turn(angle: float) -> float:
    """An angle between -180 and 180 degrees."""
    return (angle + 180) % 360 - 180


def mirror_of(model: Model, unknowns: Sequence[Unknown], place: Sequence[float]) -> list[list[float]]:
    """The place with the mirrored wind, as shares of the ranges; none if there is none within them."""
    for k, unknown in enumerate(unknowns):
        azimuth = mirrored(model, unknown.value(place[k])) if unknown.name == "wind.azimuth" else None
        if azimuth is not None:
            middle = 0.5 * (unknown.low + unknown.high)
            share = unknown.share(middle + turn(azimuth - middle))
            return [[*place[:k], share, *place[k + 1 :]]] if 0 <= share <= 1 else []
    return []


def mirrored(model: Model, azimuth: float) -> float | None:
    r"""Return the azimuth of a wind mirrored at the normal of a sheet at rest [degrees]; None if nothing is flat.

    The pressure on a sheet with normal n depends on :math:`w \cdot n` and the speed, which the mirror image
    :math:`2 (w \cdot n) n - w` leaves. Level with the ground, that is the azimuth :math:`2 \beta - \alpha`, with the
    azimuth :math:`\beta` of n.
    """
    patches = model.scene.patches
    normal = patches.normal.double()[:, :2]
    weight = patches.area.double() / patches.area.double().sum()
    shares, axes = torch.linalg.eigh((weight[:, None, None] * normal[:, :, None] * normal[:, None, :]).sum(0).cpu())
    if not float(shares[-1]) >= FLAT:
        return None
    facing = math.degrees(math.atan2(float(axes[1, -1]), float(axes[0, -1])))
    other = 2 * facing - azimuth
    return other if abs(turn(other - azimuth)) >= TURN else None


@dataclass(frozen=True)
class Plan:
    """The settings of a fit, which docs/fit.md describes."""

    base: Sequence[str]
    videos: Sequence[str]
    unknowns: Sequence[Unknown]
    known: Mapping[str, Any] = field(default_factory=dict)
    until: float | None = None
    search: int = 64
    iterations: int = 8
    tracks: int = 400
    limit: float = 1e3
    cameras: Sequence[str] | None = None
    assumed: Sequence[str] = ()
    hand_held: bool | None = None
    also_moves: Sequence[str] = ()

    def __post_init__(self) -> None:
        for given in self.assumed:
            check_choice("assumed", given, ASSUMED)
        for name, least in (("search", 0), ("iterations", 1), ("tracks", 4)):
            check_whole(name, getattr(self, name), least)
        if not self.limit > 1:
            raise ValueError(f"Expected `limit` above 1, but got {self.limit}.")


def read_plan(path: str | os.PathLike[str], find: Callable[[str], str] = str) -> Plan:
    """Read a ``fit.yaml``, see docs/fit.md; ``find`` gives the file of a name in ``base`` that is not beside it."""
    names, gone = [entry.name for entry in fields(Plan)], partial(refuse_gone, within="fit")
    return make_plan(read_fields(path, "the fit file", names, gone), str(path), find, Path(path).parent)


def make_plan(given: Mapping[str, Any], where: str, find: Callable[[str], str] = str, folder: Path = Path()) -> Plan:
    """A plan from its fields, whose unknowns are as for :func:`read_unknown`, of a file or a call (``where``).

    Names of files count from a folder; ``find`` gives the file of a name in ``base`` that is not there.
    """
    own: dict[str, Any] = {
        name: [str(value)] if name in LISTS and isinstance(value, str | os.PathLike) else value
        for name, value in given.items()
        if value is not None
    }
    sought, known = own.pop("unknowns", None), own.pop("known", {})
    check_arguments(Plan.__init__, own | {"known": known}, where)
    if not isinstance(sought, Mapping) or not sought:
        raise ValueError(
            f"Expected `unknowns` in {where} to have entries such as wind.speed: {{range: [1, 10]}}, but got "
            f"{sought!r:.60}."
        )

    for name in ("base", "videos"):
        if not own.get(name):
            raise ValueError(f"Expected `{name}` in {where} to be a name or a list of names: add it.")
    base = [str(folder / name) if (folder / name).exists() else find(name) for name in own.pop("base")]
    import_forces(base)
    videos = [str(folder / name) for name in own.pop("videos")]
    unknowns = [read_unknown(name, entry) for name, entry in sought.items()]
    files = {n: str(folder / v) for n, v in known.items() if isinstance(v, str) and (folder / v).exists()}
    return Plan(base, videos, unknowns, known | files, **own)


def read_unknown(name: str, given: Any) -> Unknown:
    """An unknown from its entry: ``{range: [low, high], scale: log, start: 3}``; scale and start may be left out.

    Example:
        >>> read_unknown("material.E", {"range": [1e3, 1e5]}).scale
        'log'
    """
    further = dict(given) if isinstance(given, Mapping) else {"range": given}
    ends, start, scale = (further.pop(key, None) for key in ("range", "start", "scale"))
    numbers = [*ends, *([] if start is None else [start])] if isinstance(ends, list | tuple) and len(ends) == 2 else []
    if further or not numbers or not all(map(is_number, numbers)):
        raise ValueError(
            f"Expected `unknowns.{name}` to be {{range: [low, high]}}, if needed with scale and start, a number, but "
            f"got {given!r:.60}."
        )
    low, high, *begin = map(float, numbers)
    scale = str(scale or ("log" if low > 0 and number_of(str(name)).scale == "log" else "linear"))
    return Unknown(str(name), low, high, scale, *begin)
