"""Changes of a configuration while its simulation runs: those possible in motion, and those that need a new one."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import torch
import yaml

from gaussian_swaying.simulation.model import find, in_settings, number
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

PICTURE = ("shader", "background")
"""Fields besides the numbers that change in motion."""

SHADER = "shader.init_args."


def changed_settings(parser: ArgumentParser, settings: Namespace, values: Mapping[str, Any]) -> Namespace:
    """Settings with other values. Parameters are checked and set; only other fields are parsed anew.

    Args:
        parser: From :meth:`Simulation.parser`.
        settings: Settings from it.
        values: New values by the names of their fields, with dots, or of parameters.
    """
    numbers = {name: value for name, value in values.items() if find(name) is not None}
    shader = {name: value for name, value in values.items() if name.startswith(SHADER)}
    further = {name: value for name, value in values.items() if name not in numbers and name not in shader}
    if further:
        data = yaml.safe_load(parser.dump(settings, skip_validation=True))
        for name, value in further.items():
            *path, last = name.split(".")
            part = data
            for key in path:
                if not isinstance(part.get(key), dict):
                    part[key] = {}
                part = part[key]
            part[last] = value
        settings = parser.parse_object(data)
    else:
        settings = copy.deepcopy(settings)
    for name, value in shader.items():
        settings[name] = value
    in_settings(settings, numbers)
    return settings


def take(simulation: Simulation, parser: ArgumentParser, settings: Namespace, values: Mapping[str, Any]) -> bool:
    """Change a simulation between two steps.

    Parameters, the wind, aerodynamic coefficients, shading, background and length of a frame change in motion; the
    material only if it is the same everywhere.

    Args:
        simulation: The simulation.
        parser: From :meth:`Simulation.parser`.
        settings: The settings with all changes.
        values: New values of numbers by their names, and the other fields that have changed, with dots.

    Returns:
        False if another field has changed, so that the simulation has to be made anew.
    """
    numbers = {name: value for name, value in values.items() if find(name) is not None}
    heads = {name.split(".")[0] for name in values if name not in numbers}
    if not heads <= {"wind", "aero", *PICTURE}:
        return False
    if "frame_dt" in numbers and simulation.model.air is not None:
        return False  # computed air has one length of the frame
    if any(name.startswith("material.") for name in numbers) and (simulation.material.regions or settings.edits):
        return False  # each part has its own
    if not all(number(name).same_points for name in numbers):
        return False
    if settings.wind.schedule is not None or heads & {"wind", "aero"}:  # as a whole
        heads |= {name.split(".")[0] for name in numbers} & {"wind", "aero"}
        numbers = {name: value for name, value in numbers.items() if name.split(".")[0] not in heads}
    parts = parser.instantiate(settings) if heads else {}
    painter = simulation.painter
    if numbers:
        simulation.change(numbers)
    if "wind" in heads:
        simulation.wind = parts["wind"]
    if "aero" in heads:
        simulation.aero = parts["aero"]
    if "shader" in heads:
        painter.shader = None if parts["shader"] is None else parts["shader"].to(simulation.device)
    if "background" in heads:
        painter.background = torch.tensor(parts["background"], dtype=torch.float32, device=simulation.device)
    return True
