"""The plan of a fit: what is sought, what is known, and how."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaussian_swaying._arguments import check_arguments, is_number
from gaussian_swaying._checks import check_choice, check_whole
from gaussian_swaying._yaml_limits import read_fields
from gaussian_swaying.config.gone import refuse_gone
from gaussian_swaying.config.parser import check_settings, import_forces, option
from gaussian_swaying.inverse.unknowns import Unknown, default_scale
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

LISTS = ("base", "videos", "cameras", "assumed", "also_moves")
ASSUMED = ("length", "mass", "camera")


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
    file, names = Path(path), [entry.name for entry in fields(Plan)]
    read = read_fields(file, "the fit file", names, partial(refuse_gone, within="fit"))
    given: dict[str, Any] = {
        name: [value] if name in LISTS and isinstance(value, str) else value
        for name, value in read.items()
        if value is not None
    }
    sought, known = given.pop("unknowns", None), given.pop("known", {})
    check_arguments(Plan.__init__, given | {"known": known}, str(file))
    if not isinstance(sought, dict) or not sought:
        raise ValueError(
            f"Expected `unknowns` in {file} to have entries such as wind.speed: {{range: [1, 10]}}, but got "
            f"{sought!r:.60}."
        )
    for name in ("base", "videos"):
        if not given.get(name):
            raise ValueError(f"Expected `{name}` in {file} to be a name or a list of names: add it.")

    def beside(value: Any) -> Any:
        there = isinstance(value, str) and (file.parent / value).exists()
        return str(file.parent / value) if there else value

    base = [beside(name) if beside(name) != name else find(name) for name in given.pop("base")]
    import_forces(base)
    videos = given.pop("videos")
    videos = [beside(name) if Path(beside(name)).exists() else str(file.parent / name) for name in videos]
    unknowns = [read_unknown(name, entry) for name, entry in sought.items()]
    return Plan(base, videos, unknowns, {name: beside(value) for name, value in known.items()}, **given)


def read_unknown(name: str, given: Any) -> Unknown:
    """An unknown from its entry: ``{range: [low, high], scale: log, start: 3}``; scale and start may be left out.

    Example:
        >>> read_unknown("material.E", {"range": [1e3, 1e5]}).scale
        'log'
    """
    where = f"unknowns.{name}"
    further = dict(given) if isinstance(given, Mapping) else {"range": given}
    ends, start = further.get("range"), further.get("start")
    if not isinstance(ends, list | tuple) or len(ends) != 2 or not all(map(is_number, ends)):
        raise ValueError(f"Expected `{where}` to be {{range: [low, high]}}, but got {given!r:.60}.")
    for key in further:
        if key not in ("range", "scale", "start"):
            raise ValueError(f"`{where}` has an unknown entry `{key}`: use range, scale and start.")
    if start is not None and not is_number(start):
        raise ValueError(f"Expected `{where}.start` to be a number, but got {start!r}.")
    low, high = map(float, ends)
    scale = str(further.get("scale") or default_scale(str(name), low))
    return Unknown(str(name), low, high, scale, None if start is None else float(start))


def parse_base(plan: Plan, parser: ArgumentParser) -> Namespace:
    """The settings of the base, with the known options."""
    files = [word for name in plan.base for word in ("--config", name)]
    settings = parser.parse_args([*files, *(option(name, value) for name, value in plan.known.items())])
    check_settings(Simulation, settings)
    return settings
