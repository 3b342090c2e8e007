"""The grid of a page without a server: the finest one that the machine of its visitors simulates in real time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from gaussian_swaying.player.live_web.block import check
from gaussian_swaying.player.session import changed_settings, finest_within
from gaussian_swaying.simulation.simulation import Simulation

if TYPE_CHECKING:
    from jsonargparse import ArgumentParser, Namespace

TARGETS = {"phone": 1.1e6, "laptop": 3e6, "desktop": 4.4e6}
"""Material points times substeps of a run in a second that a kind of machine computes, with room for drawing."""

SWAYING = 3.0
"""Factor by which a substep by modes takes longer."""


TOUCHING = 2.0
"""The same by contact of the material with itself."""


def load_of(simulation: Simulation) -> float:
    """Cost of a simulation at rest, as points times substeps that WebAssembly would do each second [1/s]."""
    surface = simulation.scene.surface_places
    slower = SWAYING if simulation.solver.formulation == "modes" else 1.0
    slower *= TOUCHING if surface is not None and surface.contact is not None else 1.0
    steps = simulation.solver.substeps(simulation.start(), simulation.frame_dt)
    return slower * simulation.model.points.count * steps / simulation.frame_dt


def fitted(parser: ArgumentParser, settings: Namespace, target: str) -> tuple[Simulation, str]:
    """Choose points and grid for a kind of machine."""
    configured, budget = float(settings.solver.dx), TARGETS[target]
    made: dict[float, Simulation] = {}

    def load(dx: float) -> float:
        changes: dict[str, Any] = {"solver.dx": dx, "scene.points": "grid"}
        changed = settings if dx == configured and settings.scene.points != "gaussian" else None
        changed = changed_settings(parser, settings, changes) if changed is None else changed
        made[dx] = Simulation.from_settings(parser, changed)
        check(made[dx])
        return load_of(made[dx])

    dx, tried = finest_within(load, budget, configured)
    speed, points = budget / tried[dx], made[dx].model.points.count
    what = "Kept the configured grid" if dx == configured else f"Chose a grid of {dx:.3g} m instead of {configured:g} m"
    if settings.scene.points == "gaussian":
        what += ", with `scene.points: grid`,"
    fast = f"about {speed:.2g} x real time" if speed < 1 else "real time"
    return made[dx], f"{what} for a {target}: {points:,} points, {fast} expected."
