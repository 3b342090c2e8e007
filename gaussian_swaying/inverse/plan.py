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

STAGES = ("tracks", "silhouettes", "matches", "pixels")
"""Stages of a fit, in this order: tracks from frame to frame; silhouettes; Gaussians matched from rendered frames to
frames of the video; colours."""

ASSUMED = ("length", "mass", "camera")
"""Things in a base that nobody measured, perhaps."""


@dataclass(frozen=True)
class Plan:
    """The settings of a fit.

    Args:
        base: Configuration files of ``sim``: the splat, the solver, and first values.
        videos: Folders with transforms.json.
        unknowns: The unknowns.
        known: Options of ``sim`` that replace those of the base.
        stages: The stages, see :data:`STAGES`; silhouettes are left out if the video has none.
        fit_share: Share of the frames that is fitted; the rest is predicted.
        until: Fit the frames up to this time [s] instead of a share of them.
        search: Number of simulations of the coarse search; 0 starts at ``start`` or in the middle of the ranges.
        starts: Number of starts that the search gives to short solves, of which the best goes on.
        iterations: Most iterations of a stage at each horizon.
        tracks: Most tracks of a camera.
        limit: Largest condition number of the sensitivities; above it the fit is refused.
        seed: Seed of the coarse search.
        cameras: Names of the cameras that are used; None for all.
        assumed: What nobody measured, of :data:`ASSUMED`; the result says what follows.
        hand_held: Whether the cameras move otherwise than the videos say; None if their background is to tell.
        also_moves: Names of parts of the splat that move in the videos, though the simulation does not move them.
    """

    base: Sequence[str]
    videos: Sequence[str]
    unknowns: Sequence[Unknown]
    known: Mapping[str, Any] = field(default_factory=dict)
    stages: Sequence[str] = ("tracks", "matches")
    fit_share: float = 0.5
    until: float | None = None
    search: int = 64
    starts: int = 3
    iterations: int = 8
    tracks: int = 400
    limit: float = 1e3
    seed: int = 0
    cameras: Sequence[str] | None = None
    assumed: Sequence[str] = ()
    hand_held: bool | None = None
    also_moves: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name, known in (("stages", STAGES), ("assumed", ASSUMED)):
            for given in getattr(self, name):
                check_choice(name, given, known)
        if not self.stages:
            raise ValueError(f"Expected `stages` to have at least one of {', '.join(STAGES)}.")
        if not 0 < self.fit_share <= 1:
            raise ValueError(f"Expected `fit_share` above 0 and at most 1, but got {self.fit_share}.")
        for name, least in (("search", 0), ("starts", 1), ("iterations", 1), ("tracks", 4), ("seed", 0)):
            check_whole(name, getattr(self, name), least)
        if not self.limit > 1:
            raise ValueError(f"Expected `limit` above 1, but got {self.limit}.")


def read_plan(path: str | os.PathLike[str], find: Callable[[str], str] = str) -> Plan:
    """Read a ``fit.yaml``; docs/fit.md describes it.

    Args:
        path: The file. Paths in ``base``, ``videos`` and ``known`` are relative to its folder if they exist there, else
            to the working directory.
        find: Gives the file of a name in ``base`` that is not there.
    """
    file, names = Path(path), [entry.name for entry in fields(Plan)]
    given = read_fields(file, "the fit file", names, partial(refuse_gone, within="fit"))
    sought, known = given.get("unknowns"), given.get("known") or {}
    if not isinstance(sought, dict) or not sought:
        raise ValueError(
            f"Expected `unknowns` in {file} to have entries such as wind.speed: {{range: [1, 10]}}, but got "
            f"{sought!r:.60}."
        )
    if not isinstance(known, dict) or not all(isinstance(name, str) for name in known):
        raise ValueError(
            f"Expected `known` in {file} to have options of `sim` as names (material.E), but got {known!r:.60}."
        )
    settings = {name: given[name] for name in names[4:] if given.get(name) is not None}
    listed = {name: _names(file, name, given.get(name)) for name in ("base", "videos")}
    for name in ("stages", "cameras", "assumed", "also_moves"):
        if name in settings:
            settings[name] = _names(file, name, settings[name])
    check_arguments(Plan.__init__, settings, str(file))

    def beside(value: Any) -> Any:
        there = isinstance(value, str) and (file.parent / value).exists()
        return str(file.parent / value) if there else value

    base = [beside(name) if beside(name) != name else find(name) for name in listed["base"]]
    import_forces(base)
    videos = [beside(name) if Path(beside(name)).exists() else str(file.parent / name) for name in listed["videos"]]
    known = {name: beside(value) for name, value in known.items()}
    return Plan(base, videos, [read_unknown(name, entry) for name, entry in sought.items()], known, **settings)


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


def _names(file: Path, name: str, given: Any) -> list[str]:
    several = [given] if isinstance(given, str) else given
    if not isinstance(several, list) or not several or not all(isinstance(item, str) for item in several):
        raise ValueError(f"Expected `{name}` in {file} to be a name or a list of names, but got {given!r:.60}.")
    return several
