"""A flag of one's own, read from a YAML file for ``make_flag_dataset.py --flag``."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml
from flag_reference import PINNED, FlagPattern

NAMES = {"E": "youngs_modulus", "nu": "poisson_ratio", "pins": "pinned"}
"""Fields of the file that have another name in :class:`FlagPattern`."""
NEEDED = {"size": "[1.2, 0.8], in m", "E": "in Pa", "density": "in kg/m³", "pins": f"one of {', '.join(PINNED)}"}
NUMBERS = ("nu", "thickness", "yaw", "drag", "damping", "ripple", "corner", "gravity", "air_density", "self_distance")
FIELDS = (*NEEDED, "flow", *NUMBERS, "cells", "frames", "fps", "self_collision", "texture")
"""All fields of such a file."""


def read_flag(path: str | os.PathLike[str]) -> FlagPattern:
    """Read a flag; docs/flag_dataset.md lists the fields. The path of a texture is relative to the file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file or a field is invalid; the message names the field.
    """
    file = Path(path)
    given = yaml.safe_load(file.read_text(encoding="utf-8"))
    if not isinstance(given, dict) or (unknown := set(given) - set(FIELDS)):
        wrong = f"`{sorted(unknown)[0]}`" if isinstance(given, dict) else repr(given)
        raise ValueError(f"Expected the fields {', '.join(FIELDS)} in {file}, but got {wrong}.")
    for name, example in NEEDED.items():
        if given.get(name) is None:
            raise ValueError(f"{file} has no `{name}`: add it, {example}.")
    fields: dict[str, Any] = {"poisson_ratio": 0.3, "flow": (0.0, 0.0, 0.0), "paper_drag": None}
    for name, value in ((name, value) for name, value in given.items() if value is not None):
        try:
            if name == "size":
                fields["width"], fields["height"] = map(float, value)
            elif name == "flow":
                x, y, z = map(float, value)
                fields["flow"] = x, y, z
            else:  # YAML reads 4e3, without a point, as text
                fields[NAMES.get(name, name)] = float(value) if name in (*NUMBERS, "E", "density") else value
        except (TypeError, ValueError) as error:
            raise ValueError(f"Expected numbers for `{name}` in {file}, but got {value!r}.") from error
    if (texture := fields.get("texture")) and (file.parent / texture).is_file():
        fields["texture"] = str(file.parent / texture)
    return FlagPattern(**fields)
