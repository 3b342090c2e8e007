"""The plan of a sweep: the configuration that all runs share, and the axes along which they differ."""

from __future__ import annotations

import itertools
import json
import math
import os
import random
from argparse import ArgumentError
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gaussian_swaying._checks import check_choice, check_whole
from gaussian_swaying._files import sha256
from gaussian_swaying._inputs import check_regular
from gaussian_swaying._yaml_limits import read_fields
from gaussian_swaying.config.parser import check_settings, config_text, option, parse_text
from gaussian_swaying.simulation.model import POLAR, in_settings
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

MOST_RUNS = 100_000
FIELDS = ("base", "settings", "axes", "draws", "seed")
NOT_HERE = ("config", "output", "resume", "device", "preset")
Axis = list[Any] | Callable[[random.Random], Any]  # the values of an option, or one from a random stream


def read_axis(name: str, given: Any) -> Axis:
    """An axis from its entry in a sweep file.

    Args:
        given: A list of values; a range ``{from, to, count, scale}``, ends included, with ``scale: log`` for equal
            ratios; or a draw ``{draw, low, high}``, where ``draw`` is ``uniform``, ``log`` (the logarithm is uniform)
            or ``integer`` (both ends included), or ``{draw: choice, of: [...]}``.

    Example:
        >>> read_axis("material.E", {"from": 100, "to": 10000, "count": 3, "scale": "log"})
        [100.0, 1000.0, 10000.0]
    """
    where = f"axes.{name}"
    if isinstance(given, list) and given:
        return given
    if not isinstance(given, Mapping):
        raise ValueError(
            f"Expected `{where}` to be a list of values, not empty, a range such as {{from: 1, to: 9, count: 5}}, or a "
            f"draw such as {{draw: uniform, low: 1, high: 9}}, but got {given!r}: for one value write [{given}]."
        )
    drawn, kind = "draw" in given, given.get("draw", given.get("scale", "linear"))
    ends = ("low", "high") if drawn else ("from", "to")
    fields = ("draw", "of") if kind == "choice" else ("draw", *ends) if drawn else (*ends, "count", "scale")
    kinds = ("uniform", "log", "integer", "choice") if drawn else ("linear", "log")
    check_choice(f"{where}.{'draw' if drawn else 'scale'}", kind, kinds)
    for entry in given:
        if entry not in fields:
            raise ValueError(f"`{where}` has an unknown entry `{entry}`: use {', '.join(fields)}.")
    if kind == "choice":
        choices = given.get("of")
        if not isinstance(choices, list) or not choices:
            raise ValueError(f"Expected `{where}.of` to be a list of values to choose from, but got {choices!r}.")
        return lambda stream: choices[stream.randrange(len(choices))]
    low, high = (_finite(f"{where}.{end}", given.get(end)) for end in ends)
    if kind == "log" and min(low, high) <= 0:
        raise ValueError(
            f"Expected `{where}.{ends[0]}` and `{ends[1]}` to be positive on a logarithmic scale, but got {low} and "
            f"{high}: use {'draw: uniform' if drawn else 'scale: linear'}."
        )

    def between(part: float) -> float:
        """To 12 digits, as C libraries differ in powers."""
        return float(f"{low * (high / low) ** part if kind == 'log' else low + (high - low) * part:.12g}")

    if not drawn:
        check_whole(f"{where}.count", given.get("count"), 2, MOST_RUNS)
        last = given["count"] - 1
        return [low, *(between(index / last) for index in range(1, last)), high]
    if low > high:
        raise ValueError(f"Expected `{where}.low` to be at most `high`, but got {low} and {high}: exchange them.")
    if kind == "integer":
        for end in ends:
            check_whole(f"{where}.{end}", given[end], -(1 << 63))
        return lambda stream: stream.randint(given["low"], given["high"])
    return lambda stream: between(stream.random())


def _finite(where: str, value: Any) -> float:
    with suppress(ValueError, TypeError, OverflowError):
        if not isinstance(value, bool) and math.isfinite(float(value)):
            return float(value)
    raise ValueError(f"Expected `{where}` to be a finite number, but got {value!r}: set it.")


def runs_of(axes: Mapping[str, Axis], draws: int = 1, seed: int = 0) -> list[dict[str, Any]]:
    """The settings of every run: all combinations of lists and ranges, the first axis slowest, each drawn some times.

    A drawn value is a function of seed, axis and number of the run, so that it stays when other axes change.

    Example:
        >>> runs_of({"a": [1, 2], "b": [3, 4]})
        [{'a': 1, 'b': 3}, {'a': 1, 'b': 4}, {'a': 2, 'b': 3}, {'a': 2, 'b': 4}]
    """
    lists = {name: axis for name, axis in axes.items() if isinstance(axis, list)}
    if draws > 1 and len(lists) == len(axes):
        raise ValueError(f"Expected an axis with a `draw`, as `draws` is {draws}: add one, or set `draws` to 1.")
    count = math.prod(map(len, lists.values())) * draws
    if count > MOST_RUNS:
        raise ValueError(f"The axes make {count:,} runs, more than the limit of {MOST_RUNS:,}: give fewer values.")
    runs = []
    for number, (*values, _) in enumerate(itertools.product(*lists.values(), range(draws))):
        run = dict(zip(lists, values, strict=True))
        drawn = {n: axis(random.Random(f"{seed}/{n}/{number}")) for n, axis in axes.items() if callable(axis)}
        runs.append({name: (run | drawn)[name] for name in axes})
    return runs


@dataclass(frozen=True)
class Plan:
    """A sweep whose settings were checked: the YAML that the runs share, and the value of every axis in each.

    ``frames`` are those of a run, unless it is an axis; ``splats`` the SHA-256 of the files that they read, by path.
    """

    config: str
    frames: int
    runs: tuple[Mapping[str, Any], ...]
    splats: Mapping[str, str]

    @property
    def names(self) -> list[str]:
        """Names of the runs and their folders: 00000, 00001 ..."""
        return [f"{number:05d}" for number in range(len(self.runs))]


def read_sweep(
    path: str | os.PathLike[str], find: Callable[[str], str] = str, parser: ArgumentParser | None = None
) -> Plan:
    """The plan of a sweep file, which docs/many.md describes; ``find`` gives the file of a name in ``base``."""
    file = Path(path)
    given = read_fields(file, "the sweep file", FIELDS)
    base = [given["base"]] if isinstance(given.get("base"), str) else given.get("base")
    if not isinstance(base, list) or not base or not all(isinstance(name, str) for name in base):
        raise ValueError(f"Expected `base` in {file} to be a file or a shipped name such as flag, but got {base!r}.")
    settings, axes = (_options(file, name, given.get(name)) for name in ("settings", "axes"))
    if not axes:
        raise ValueError(f"Expected `axes` in {file} to have an option that differs between the runs: add it.")
    for name in axes.keys() & settings.keys():
        raise ValueError(f"`{name}` is in `settings` and in `axes` of {file}: remove one of the two.")
    draws, seed = given.get("draws", 1), given.get("seed", 0)
    check_whole("draws", draws, 1)
    check_whole("seed", seed, -(1 << 63))
    runs = runs_of({name: read_axis(name, entry) for name, entry in axes.items()}, draws, seed)
    return make_plan([find(name) for name in base], runs, settings, parser or Simulation.parser())


def make_plan(
    base: Sequence[str], runs: Sequence[Mapping[str, Any]], settings: Mapping[str, Any], parser: ArgumentParser
) -> Plan:
    """Check the settings of a sweep as ``sim`` does: configurations, and every value of every axis in its runs.

    What a run can only find out when it begins (a pin that holds nothing, a damaged file) is reported by that run.
    """
    files = [word for name in base for word in ("--config", name)]
    shared = parser.parse_args([*files, *(option(name, value) for name, value in settings.items())])
    check_settings(Simulation, shared)
    config, splats = config_text(parser, shared), set()
    for number in _telling(runs):
        try:
            own = parse_run(parser, config, shared.frames, runs[number])
        except (ArgumentError, ValueError) as error:
            shown = ", ".join(f"{name}: {value}" for name, value in runs[number].items())
            told = f"Run {number:05d} ({shown}): {error}"
            raise (ArgumentError(None, told) if isinstance(error, ArgumentError) else type(error)(told)) from error
        splats.add(own.scene.ply)
    checksums = {path: sha256(check_regular(path, "the splat")) for path in sorted(filter(None, splats))}
    return Plan(config, shared.frames, tuple(runs), checksums)


def parse_run(parser: ArgumentParser, config: str, frames: int, run: Mapping[str, Any]) -> Namespace:
    """The settings of one run."""
    # parameters that are no options
    own = {n: v for n, v in run.items() if n in POLAR or n.startswith(("forces.", "wind.modulations."))}
    options = [option(name, value) for name, value in {"frames": frames, **run}.items() if name not in own]
    settings = parse_text(parser, config, options)
    in_settings(settings, own)
    check_settings(Simulation, settings)
    return settings


def _telling(runs: Sequence[Mapping[str, Any]]) -> list[int]:
    """The runs in which a value appears for the first time; of more than a hundred seeds or draws, the first."""
    many = {name: len({json.dumps(run[name]) for run in runs}) == len(runs) > 100 for name in runs[0]}
    first: dict[tuple[str, str], int] = {}
    for number, run in enumerate(runs):
        for name, value in run.items():
            first.setdefault((name, "" if many[name] else json.dumps(value)), number)
    return sorted(set(first.values()))


def _options(file: Path, field_: str, given: Any) -> dict[str, Any]:
    given = {} if given is None else given
    if not isinstance(given, dict) or not all(isinstance(name, str) for name in given):
        raise ValueError(f"Expected `{field_}` in {file} to name options of `sim` (wind.flow), but got {given!r:.60}.")
    for name in given:
        if name in NOT_HERE or name.startswith("-"):
            raise ValueError(
                f"`{field_}` of {file} has `{name}`: remove it, as the sweep has its own, or the dashes before it."
            )
    try:
        json.dumps(given, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{field_}` of {file} has a value that is no number, text or list ({error}).") from None
    return given
