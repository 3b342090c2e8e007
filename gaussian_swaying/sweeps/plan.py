"""The plan of a sweep: the configuration that all runs share, and the axes along which they differ."""

from __future__ import annotations

import json
import os
from argparse import ArgumentError
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaussian_swaying._files import sha256
from gaussian_swaying._inputs import check_regular
from gaussian_swaying._yaml_limits import read_fields
from gaussian_swaying.config.parser import check_settings, config_text, option, parse_text
from gaussian_swaying.simulation.model import POLAR, in_settings
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.sweeps.axes import read_axis, runs_of

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

FIELDS = ("base", "settings", "axes", "draws", "seed")
NOT_HERE = ("config", "output", "resume", "device", "preset")


@dataclass(frozen=True)
class Sweep:
    """A sweep file as it is written.

    Args:
        base: Configuration files of ``sim``; later ones override earlier ones.
        settings: Options of ``sim`` for all runs, by their names on the command line.
        runs: The value of every axis in each run, see :func:`~gaussian_swaying.sweeps.axes.runs_of`.
    """

    base: Sequence[str]
    runs: Sequence[Mapping[str, Any]]
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Plan:
    """A sweep whose settings were checked.

    Args:
        config: The whole configuration that the runs share, as YAML.
        frames: Frames of a run, unless it is an axis.
        runs: The value of every axis in each run.
        splats: SHA-256 of every splat file that a run reads, by its path.
    """

    config: str
    frames: int
    runs: tuple[Mapping[str, Any], ...]
    splats: Mapping[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the runs and their folders: 00000, 00001 ..."""
        return [f"{number:05d}" for number in range(len(self.runs))]

    @property
    def axes(self) -> list[str]:
        return list(self.runs[0])


def read_sweep(path: str | os.PathLike[str], find: Callable[[str], str] = str) -> Sweep:
    """Read a sweep file.

    Args:
        path: YAML with ``base``, ``axes`` and, if needed, ``settings``, ``draws`` and ``seed``; docs/many.md describes
            them.
        find: Gives the file of a name in ``base``.
    """
    file = Path(path)
    given = read_fields(file, "the sweep file", FIELDS)
    base = given.get("base")
    base = [base] if isinstance(base, str) else base
    if not isinstance(base, list) or not base or not all(isinstance(name, str) for name in base):
        raise ValueError(
            f"Expected `base` in {file} to be a configuration of `sim` or a list of them, but got {base!r}: set it to "
            "a file or a shipped name such as flag."
        )
    settings, axes = (_options(file, name, given.get(name)) for name in ("settings", "axes"))
    if not axes:
        raise ValueError(
            f"Expected `axes` in {file} to have at least one option that differs between the runs: add it."
        )
    both = [name for name in axes if name in settings]
    if both:
        raise ValueError(f"`{both[0]}` is in `settings` and in `axes` of {file}: remove one of the two.")
    draws, seed = (_whole(file, name, given.get(name, start)) for name, start in (("draws", 1), ("seed", 0)))
    if draws < 1:
        raise ValueError(f"Expected `draws` in {file} to be at least 1, but got {draws}.")
    runs = runs_of([read_axis(name, entry) for name, entry in axes.items()], draws, seed)
    return Sweep([find(name) for name in base], runs, settings)


def make_plan(sweep: Sweep, parser: ArgumentParser | None = None) -> Plan:
    """Check the settings of a sweep: the base, and every value of every axis.

    Values are parsed as ``sim`` does. What a run can only find out when it begins (a pin that holds nothing, a file
    that is damaged) is reported by that run.

    Args:
        sweep: The sweep.
        parser: From :meth:`Simulation.parser`; made here if None.
    """
    parser = parser or Simulation.parser()
    files = [word for name in sweep.base for word in ("--config", name)]
    shared = parser.parse_args([*files, *(option(name, value) for name, value in sweep.settings.items())])
    check_settings(Simulation, shared)
    config, splats = config_text(parser, shared), set()
    for number in _telling(sweep.runs):
        try:
            settings = parse_run(parser, config, shared.frames, sweep.runs[number])
        except (ArgumentError, ValueError) as error:
            shown = ", ".join(f"{name}: {value}" for name, value in sweep.runs[number].items())
            raise type(error)(*_located(error, f"Run {number:05d} ({shown}): ")) from error
        splats.add(settings.scene.ply)
    checksums = {path: sha256(check_regular(path, "the splat")) for path in sorted(filter(None, splats))}
    return Plan(config, shared.frames, tuple(sweep.runs), checksums)


def parse_run(parser: ArgumentParser, config: str, frames: int, run: Mapping[str, Any]) -> Namespace:
    """The settings of one run.

    Args:
        parser: From :meth:`Simulation.parser`.
        config: Configuration that all runs share, as YAML.
        frames: Frames, unless ``run`` has others.
        run: The value of every axis.
    """
    # parameters that are no options
    own = {n: v for n, v in run.items() if n in POLAR or n.startswith(("forces.", "wind.modulations."))}
    options = [option(name, value) for name, value in {"frames": frames, **run}.items() if name not in own]
    settings = parse_text(parser, config, options)
    in_settings(settings, own)
    check_settings(Simulation, settings)
    return settings


def _located(error: Exception, where: str) -> tuple[Any, ...]:
    """Return the arguments of the same error, with a message that begins with a location."""
    return (None, f"{where}{error}") if isinstance(error, ArgumentError) else (f"{where}{error}",)


def _telling(runs: Sequence[Mapping[str, Any]]) -> list[int]:
    """The runs in which a value appears for the first time; of axes with a number in every run, the first one.

    Those are seeds and draws, all alike: with more than a hundred of them, to check each would take long.
    """
    many = {name: len({json.dumps(run[name]) for run in runs}) == len(runs) > 100 for name in runs[0]}
    seen: set[tuple[str, str]] = set()
    numbers = []
    for number, run in enumerate(runs):
        new = {(name, "" if many[name] else json.dumps(value)) for name, value in run.items()} - seen
        if new:
            seen |= new
            numbers.append(number)
    return numbers


def _options(file: Path, field_: str, given: Any) -> dict[str, Any]:
    given = {} if given is None else given
    if not isinstance(given, dict) or not all(isinstance(name, str) for name in given):
        raise ValueError(
            f"Expected `{field_}` in {file} to have options of `sim` as names (wind.flow), but got {given!r:.60}."
        )
    for name in given:
        if name in NOT_HERE or name.startswith("-"):
            raise ValueError(
                f"`{field_}` of {file} has `{name}`, which is no option of a run in a sweep: remove it"
                + (" and the dashes." if name.startswith("-") else "; the sweep has options of its own.")
            )
    try:
        json.dumps(given, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{field_}` of {file} has a value that is no number, text or list ({error}).") from None
    return given


def _whole(file: Path, name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"Expected `{name}` in {file} to be a whole number, but got {value!r}: set it.")
    return value
