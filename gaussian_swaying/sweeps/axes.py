"""Axes of a sweep: lists, ranges and random draws, and the settings of every run that they make."""

from __future__ import annotations

import itertools
import math
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

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
