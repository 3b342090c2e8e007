"""The settings of a fit: the file ``fit.yaml``, checked."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaussian_swaying._checks import check_whole
from gaussian_swaying._yaml_limits import read_fields
from gaussian_swaying.config.parser import check_settings, import_forces, option
from gaussian_swaying.fitting.unknowns import Unknown, default_scale
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

STAGES = ("tracks", "silhouettes", "matches", "pixels")
"""Stages of a fit, in this order: tracks from frame to frame; silhouettes; Gaussians matched from rendered frames to
frames of the video, three rounds; colours."""
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
        wind_changes: Whether the wind may change during the film; it does if that predicts the last fifth of the fitted
            frames better.
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
    wind_changes: bool = False
    limit: float = 1e3
    seed: int = 0
    cameras: Sequence[str] | None = None
    assumed: Sequence[str] = ()
    hand_held: bool | None = None
    also_moves: Sequence[str] = ()

    def __post_init__(self) -> None:
        for name in self.stages:
            if name not in STAGES:
                raise ValueError(f"Expected `stages` to be of {', '.join(STAGES)}, but got {name!r}.")
        for name in self.assumed:
            if name not in ASSUMED:
                raise ValueError(f"Expected `assumed` to be of {', '.join(ASSUMED)}, but got {name!r}.")
        if not self.stages:
            raise ValueError(f"Expected `stages` to have at least one of {', '.join(STAGES)}.")
        if not 0 < self.fit_share <= 1:
            raise ValueError(f"Expected `fit_share` above 0 and at most 1, but got {self.fit_share}.")
        for name, least in (("search", 0), ("starts", 1), ("iterations", 1), ("tracks", 4), ("seed", 0)):
            check_whole(name, getattr(self, name), least)
        if self.wind_changes and "wind.speed" not in {u.name for u in self.unknowns}:
            raise ValueError("Expected `wind.speed` in `unknowns` with `wind_changes`: add it.")
        if not self.limit > 1:
            raise ValueError(f"Expected `limit` above 1, but got {self.limit}.")


def read_plan(path: str | os.PathLike[str], find: Callable[[str], str] = str) -> Plan:
    """Read a ``fit.yaml``; docs/fit.md describes it.

    Args:
        path: The file. Names in ``base`` and ``videos`` are relative to its folder if they exist there, else to the
            working directory.
        find: Gives the file of a name in ``base``.
    """
    file = Path(path)
    names = [entry.name for entry in fields(Plan)]
    given = read_fields(file, "the fit file", names)
    sought = given.get("unknowns")
    if not isinstance(sought, dict) or not sought:
        raise ValueError(
            f"Expected `unknowns` in {file} to have entries such as wind.speed: {{range: [1, 10]}}, but got "
            f"{sought!r:.60}."
        )
    known = given.get("known") or {}
    if not isinstance(known, dict) or not all(isinstance(name, str) for name in known):
        raise ValueError(
            f"Expected `known` in {file} to have options of `sim` as names (material.E), but got {known!r:.60}."
        )
    settings = {name: given[name] for name in names[4:] if given.get(name) is not None}
    for name in ("stages", "cameras", "assumed", "also_moves"):
        if name in settings:
            settings[name] = _names(file, name, settings[name])
    for name in ("fit_share", "until", "limit"):
        if name in settings and (isinstance(settings[name], bool) or not isinstance(settings[name], int | float)):
            raise ValueError(f"Expected `{name}` in {file} to be a number, but got {settings[name]!r}.")
    for name in ("hand_held", "wind_changes"):
        if not isinstance(settings.get(name, True), bool):
            raise ValueError(f"Expected `{name}` in {file} to be true or false, but got {settings[name]!r}.")
    base = [_beside(file, name) or find(name) for name in _names(file, "base", given.get("base"))]
    import_forces(base)
    return Plan(
        base,
        [_beside(file, name) or name for name in _names(file, "videos", given.get("videos"))],
        [read_unknown(name, entry) for name, entry in sought.items()],
        known,
        **settings,
    )


def read_unknown(name: str, given: Any) -> Unknown:
    """An unknown from its entry: ``{range: [low, high], scale: log, start: 3}``; scale and start may be left out.

    Example:
        >>> read_unknown("material.E", {"range": [1e3, 1e5]}).scale
        'log'
    """
    where = f"unknowns.{name}"
    ends = given.get("range") if isinstance(given, Mapping) else given
    if not isinstance(ends, list | tuple) or len(ends) != 2 or not all(_is_number(end) for end in ends):
        raise ValueError(f"Expected `{where}` to be {{range: [low, high]}}, but got {given!r:.60}.")
    further = dict(given) if isinstance(given, Mapping) else {}
    for key in further:
        if key not in ("range", "scale", "start"):
            raise ValueError(f"`{where}` has an unknown entry `{key}`: use range, scale and start.")
    start = further.get("start")
    if start is not None and not _is_number(start):
        raise ValueError(f"Expected `{where}.start` to be a number, but got {start!r}.")
    low, high = map(float, ends)
    scale = further.get("scale") or default_scale(str(name), low)
    return Unknown(str(name), low, high, str(scale), None if start is None else float(start))


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


def _beside(file: Path, name: str) -> str | None:
    """A file or folder beside another file; None if there is none."""
    return str(file.parent / name) if (file.parent / name).exists() else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)
