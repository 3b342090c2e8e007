"""The plan of a sweep: the configuration that all runs share, and the axes along which they differ."""

from __future__ import annotations

import itertools
import json
import math
import os
import random
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

MOST_RUNS = 100_000
SCALES = ("linear", "log")
DRAWS = ("uniform", "log", "integer", "choice")


@dataclass(frozen=True)
class Axis:
    """One option of ``sim`` that differs between the runs.

    Args:
        name: The option as on the command line, without the dashes: ``wind.flow``.
        values: Its values, which are combined with those of the other axes; empty for a random draw.
        draw: For a random draw, a value from a random stream; None otherwise.
    """

    name: str
    values: tuple[Any, ...] = ()
    draw: Callable[[random.Random], Any] | None = None


def read_axis(name: str, given: Any) -> Axis:
    """An axis from its entry in a sweep file.

    Args:
        name: The option.
        given: A list of values; a range ``{from, to, count, scale}``, ends included, with ``scale: log`` for equal
            ratios; or a draw ``{draw, low, high}``, where ``draw`` is ``uniform``, ``log`` (the logarithm is uniform)
            or ``integer`` (both ends included), or ``{draw: choice, of: [...]}``.

    Example:
        >>> read_axis("material.E", {"from": 100, "to": 10000, "count": 3, "scale": "log"}).values
        (100.0, 1000.0, 10000.0)
    """
    where = f"axes.{name}"
    if isinstance(given, list):
        if not given:
            raise ValueError(f"Expected `{where}` to have values, but it is empty: give some, or remove the axis.")
        return Axis(name, tuple(given))
    if not isinstance(given, Mapping):
        raise ValueError(
            f"Expected `{where}` to be a list of values, a range such as {{from: 1, to: 9, count: 5}}, or a draw such "
            f"as {{draw: uniform, low: 1, high: 9}}, but got {given!r}: for one value write [{given}]."
        )
    if "draw" in given:
        return Axis(name, draw=_draw(where, given))
    return Axis(name, _range(where, given))


def runs_of(axes: list[Axis], draws: int = 1, seed: int = 0) -> list[dict[str, Any]]:
    """The settings of every run: all combinations of lists and ranges, the first axis slowest, each drawn some times.

    A drawn value is a function of seed, axis and number of the run, so that it stays when other axes change.

    Args:
        axes: The axes.
        draws: Runs of each combination.
        seed: Seed of the draws.

    Returns:
        For each run the value of every axis, in the order of the axes.

    Example:
        >>> runs_of([Axis("a", (1, 2)), Axis("b", (3, 4))])
        [{'a': 1, 'b': 3}, {'a': 1, 'b': 4}, {'a': 2, 'b': 3}, {'a': 2, 'b': 4}]
    """
    drawn = [axis for axis in axes if axis.draw is not None]
    if draws > 1 and not drawn:
        raise ValueError(f"Expected an axis with a `draw`, as `draws` is {draws}: add one, or set `draws` to 1.")
    count = math.prod(len(axis.values) for axis in axes if axis.draw is None) * draws
    if count > MOST_RUNS:
        raise ValueError(f"The axes make {count:,} runs, more than the limit of {MOST_RUNS:,}: give fewer values.")
    choices = [range(draws) if axis.draw is not None else axis.values for axis in axes]
    fixed = [choice for choice, axis in zip(choices, axes, strict=True) if axis.draw is None]
    runs = []
    for number, (*values, _) in enumerate(itertools.product(*fixed, range(draws))):
        left = iter(values)
        run = {}
        for axis in axes:
            if axis.draw is None:
                run[axis.name] = next(left)
            else:
                run[axis.name] = axis.draw(random.Random(f"{seed}/{axis.name}/{number}"))
        runs.append(run)
    return runs


def _range(where: str, given: Mapping[str, Any]) -> tuple[float, ...]:
    _only(where, given, "from", "to", "count", "scale")
    low, high, count = _number(where, given, "from"), _number(where, given, "to"), _whole(where, given, "count")
    if not 1 < count <= MOST_RUNS:
        raise ValueError(
            f"Expected `{where}.count` to be between 2 and {MOST_RUNS:,}, but got {count}: for one value use a list."
        )
    scale = _one_of(where, given, "scale", SCALES, "linear")
    parts = [index / (count - 1) for index in range(count)]
    if scale == "log":
        _check_logarithm(where, "from", low, "to", high, "scale: linear")
        inner = [low * (high / low) ** part for part in parts]
    else:
        inner = [low + (high - low) * part for part in parts]
    return (low, *(_tidy(value) for value in inner[1:-1]), high)


def _draw(where: str, given: Mapping[str, Any]) -> Callable[[random.Random], Any]:
    kind = _one_of(where, given, "draw", DRAWS)
    if kind == "choice":
        _only(where, given, "draw", "of")
        choices = given.get("of")
        if not isinstance(choices, list) or not choices:
            raise ValueError(f"Expected `{where}.of` to be a list of values to choose from, but got {choices!r}.")
        return lambda stream: choices[stream.randrange(len(choices))]
    _only(where, given, "draw", "low", "high")
    take = _whole if kind == "integer" else _number
    low, high = take(where, given, "low"), take(where, given, "high")
    if low > high:
        raise ValueError(f"Expected `{where}.low` to be at most `high`, but got {low} and {high}: exchange them.")
    if kind == "integer":
        return lambda stream: stream.randint(int(low), int(high))
    if kind == "log":
        _check_logarithm(where, "low", low, "high", high, "draw: uniform")
        return lambda stream: _tidy(low * (high / low) ** stream.random())
    return lambda stream: _tidy(low + (high - low) * stream.random())


def _tidy(value: float) -> float:
    """Round to 12 digits, so that powers computed by another machine's C library give the same number."""
    return float(f"{value:.12g}")


def _check_logarithm(where: str, first: str, low: float, second: str, high: float, remedy: str) -> None:
    if low <= 0 or high <= 0:
        raise ValueError(
            f"Expected `{where}.{first}` and `{second}` to be positive on a logarithmic scale, but got {low} and "
            f"{high}: use {remedy}."
        )


def _only(where: str, given: Mapping[str, Any], *known: str) -> None:
    for name in given:
        if name not in known:
            raise ValueError(f"`{where}` has an unknown entry `{name}`: use {', '.join(known)}.")


def _number(where: str, given: Mapping[str, Any], name: str) -> float:
    value = given.get(name)
    try:
        if isinstance(value, bool) or not isinstance(value, (int, float, str)):  # YAML reads 1e3 as text
            raise ValueError
        number = float(value)
        if not math.isfinite(number):
            raise ValueError
    except (ValueError, OverflowError):
        raise ValueError(f"Expected `{where}.{name}` to be a finite number, but got {value!r}: set it.") from None
    return number


def _whole(where: str, given: Mapping[str, Any], name: str) -> int:
    value = given.get(name)
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"Expected `{where}.{name}` to be a whole number, but got {value!r}: set it.")
    return value


def _one_of(where: str, given: Mapping[str, Any], name: str, known: tuple[str, ...], default: str | None = None) -> str:
    value = given.get(name, default)
    if value not in known:
        raise ValueError(f"Expected `{where}.{name}` to be one of {', '.join(known)}, but got {value!r}.")
    return str(value)


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
        runs: The value of every axis in each run, see :func:`~gaussian_swaying.sweeps.plan.runs_of`.
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
    draws, seed = (_count(file, name, given.get(name, start)) for name, start in (("draws", 1), ("seed", 0)))
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


def _count(file: Path, name: str, value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f"Expected `{name}` in {file} to be a whole number, but got {value!r}: set it.")
    return value
