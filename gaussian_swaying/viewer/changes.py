"""Changes of a configuration while its simulation runs: what can be changed in motion, and what needs a new one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import torch
import yaml

from gaussian_swaying.mpm.formulations.total import Total
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.simulation.edits import Edit
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

MATERIAL = ("E", "nu", "density")
MOTION = ("gravity", "damping")


def changed_settings(parser: ArgumentParser, settings: Namespace, values: Mapping[str, Any]) -> Namespace:
    """Settings with other values.

    Args:
        parser: From :meth:`Simulation.parser`.
        settings: What it parsed.
        values: New values by the names of their fields, with dots.

    Raises:
        ArgumentError: If a value has the wrong type.
        ValueError: If there is no such field.
    """
    data = yaml.safe_load(parser.dump(settings, skip_validation=True))
    for name, value in values.items():
        *path, last = name.split(".")
        part = data
        for key in path:
            if not isinstance(part.get(key), dict):
                part[key] = {}
            part = part[key]
        part[last] = value
    return parser.parse_object(data)


def take(
    simulation: Simulation, state: MPMState, parser: ArgumentParser, settings: Namespace, names: Sequence[str]
) -> MPMState | None:
    """Change a simulation between two steps.

    Wind, aerodynamic coefficients, stiffness, density, gravity, damping, shading, background and length of a frame
    change in motion; the material only if it is the same everywhere.

    Args:
        simulation: The simulation.
        state: Its state now.
        parser: From :meth:`Simulation.parser`.
        settings: The settings with all changes.
        names: The fields that have changed, with dots.

    Returns:
        The state to go on from; None if another field has changed, so that the simulation has to be made anew.

    Raises:
        ValueError: If a value is out of range; the simulation then stays as it was.
    """
    heads = {name.split(".")[0] for name in names}
    material = [name.split(".")[1] for name in names if name.startswith("material.")]
    motion = [name.split(".")[1] for name in names if name.startswith("solver.")]
    known = {"wind", "aero", "shader", "background", "frame_dt", "material", "solver"}
    if not (heads <= known and set(material) <= set(MATERIAL) and set(motion) <= set(MOTION)):
        return None
    if material and (settings.material.regions or settings.edits):  # each part has its own
        return None
    parts = parser.instantiate(settings)
    device, painter = simulation.device, simulation.painter
    edit = Edit(**{name: settings.material[name] for name in material}) if material else None
    if "wind" in heads:
        simulation.wind = parts["wind"]
    if "aero" in heads:
        simulation.aero = parts["aero"]
    if "shader" in heads:
        painter.shader = None if parts["shader"] is None else parts["shader"].to(device)
    if "background" in heads:
        painter.background = torch.tensor(parts["background"], dtype=torch.float32, device=device)
    if "frame_dt" in heads:
        simulation.frame_dt = float(settings.frame_dt)
    if motion:
        solver, scene = simulation.solver, simulation.scene
        solver.settings = replace(solver.settings, **{name: getattr(parts["solver"], name) for name in motion})
        solver.init_state(
            scene.points, frame=scene.frame, surface=scene.surface_places
        )  # takes the settings; the state stays
    return state if edit is None else simulation.edit(state, edit)


def carry_over(old: Simulation, state: MPMState, new: Simulation, start: MPMState) -> MPMState | None:
    """The motion of a simulation as a state of another with the same nodes, such as the same one with other pins.

    Args:
        old: The simulation.
        state: Its state.
        new: The other simulation.
        start: Its state at rest.

    Returns:
        The state; None if the formulation is not ``total``, or if a node has mass that had none, as it did not move.
    """
    before, after = old.solver.bound, new.solver.bound
    if not (isinstance(before, Total) and isinstance(after, Total)) or state.grid != start.grid:
        return None
    if bool(((after.node_inverse_mass > 0) & (before.node_inverse_mass == 0)).any()):
        return None
    assert state.node_displacement is not None
    assert state.node_velocity is not None
    moved = start.replace(time=state.time, substep=state.substep, work=state.work)
    return after.read_particles(moved, state.node_displacement, state.node_velocity)
