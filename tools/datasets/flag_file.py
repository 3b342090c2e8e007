"""A flag of one's own, read from a YAML file for ``make_flag_dataset.py --flag``."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from flag_reference import PINNED, FlagPattern

from gaussian_swaying._yaml_limits import read_fields

_NUMBERS = {  # field: its name in FlagPattern, and its unit
    "E": ("youngs_modulus", "Pa"),
    "nu": ("poisson_ratio", ""),
    "density": ("density", "kg/m³"),
    "thickness": ("thickness", "m"),
    "yaw": ("yaw", "degrees"),
    "drag": ("drag", ""),
    "damping": ("damping", "1/s"),
    "ripple": ("ripple", "m"),
    "corner": ("corner", "m"),
    "gravity": ("gravity", "m/s²"),
    "air_density": ("air_density", "kg/m³"),
    "self_distance": ("self_distance", "m"),
}
_WHOLE = ("cells", "frames", "fps")
_LISTS = {"size": (2, "width and height in m"), "flow": (3, "the velocity of the air in m/s")}
_NEEDED = {"size": "[1.2, 0.8], in m", "E": "in Pa", "density": "in kg/m³", "pins": f"one of {', '.join(PINNED)}"}

FIELDS = (*_NEEDED, "flow", *(name for name in _NUMBERS if name not in _NEEDED), *_WHOLE, "self_collision", "texture")
"""All fields of such a file."""


def read_flag(path: str | os.PathLike[str]) -> FlagPattern:
    """Read a flag; docs/flag_dataset.md lists the fields.

    Args:
        path: The YAML file. ``size``, ``E``, ``density`` and ``pins`` are needed; a ``texture`` is a name or the path
            of an image, relative to the folder of the file if it exists there.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file or a field is invalid; the message names the field and the remedy.
    """
    given, file = read_fields(path, "the file of the flag", FIELDS), Path(path)
    for name, example in _NEEDED.items():
        if given.get(name) is None:
            raise ValueError(f"{file} has no `{name}`: add it, {example}.")
    chosen = {name: value for name, value in given.items() if value is not None}
    fields: dict[str, Any] = {"poisson_ratio": 0.3, "flow": (0.0, 0.0, 0.0), "paper_drag": None}
    for name, value in chosen.items():
        fields |= _field(file, name, value)
    try:
        return FlagPattern(**fields)
    except ValueError as error:
        raise ValueError(f"{file}: {_renamed(str(error))}") from error


def _field(file: Path, name: str, value: Any) -> dict[str, Any]:
    """A field of the file as fields of :class:`FlagPattern`."""
    if name in _NUMBERS:
        own, unit = _NUMBERS[name]
        return {own: _number(file, name, value, f"a number{f' in {unit}' if unit else ''}")}
    if name in _LISTS:
        count, what = _LISTS[name]
        if not isinstance(value, list) or len(value) != count:
            raise ValueError(f"Expected `{name}` in {file} to be a list of {count} numbers, {what}, but got {value!r}.")
        numbers = tuple(_number(file, name, one, f"a list of {count} numbers, {what}") for one in value)
        return {"width": numbers[0], "height": numbers[1]} if name == "size" else {name: numbers}
    if name in _WHOLE:
        if isinstance(value, bool) or not isinstance(value, int):
            raise ValueError(f"Expected `{name}` in {file} to be a whole number, but got {value!r}.")
        return {name: value}
    if name == "self_collision":
        if not isinstance(value, bool):
            raise ValueError(f"Expected `{name}` in {file} to be true or false, but got {value!r}.")
        return {name: value}
    if not isinstance(value, str):
        example = f"one of {', '.join(PINNED)}" if name == "pins" else "white, stripes, or the path of an image"
        raise ValueError(f"Expected `{name}` in {file} to be {example}, but got {value!r}.")
    if name == "texture" and (file.parent / value).is_file():
        value = str(file.parent / value)
    return {"pinned" if name == "pins" else name: value}


def _number(file: Path, name: str, value: Any, what: str) -> float:
    """A finite number; YAML reads 4e3, without a point, as text."""
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"Expected `{name}` in {file} to be {what}, but got {value!r}.")
    return number


def _renamed(message: str) -> str:
    """A message of :class:`FlagPattern` with the names of the file."""
    names = {own: name for name, (own, _) in _NUMBERS.items()} | {"pinned": "pins", "width": "size", "height": "size"}
    for own, name in names.items():
        message = message.replace(f"`{own}`", f"`{name}`")
    return message
