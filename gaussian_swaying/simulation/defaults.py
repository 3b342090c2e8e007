"""Short forms that the constructor of a simulation accepts in Python, and defaults for missing components."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal

import torch
from torch import nn

from gaussian_swaying._checks import check_vector
from gaussian_swaying.aero.wind import SpatialWind, WindField
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.selection import select_simulated
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Region
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.scenes.procedural import GivenScene, ProceduralScene
from gaussian_swaying.simulation.preview.suggest import particle_spacing, suggest_spacing
from gaussian_swaying.simulation.scene import Scene

if TYPE_CHECKING:
    SceneLike = Scene | ProceduralScene | GaussianCloud | str | os.PathLike[str]
    WindLike = WindField | SpatialWind | Sequence[float]
    DeviceLike = torch.device | str
else:  # what a YAML file can contain: the annotations of the constructor are its schema
    SceneLike, WindLike, DeviceLike = Scene, WindField, Literal["auto", "cpu", "cuda"]

CELLS = 32
"""Largest number of grid cells along the longest side if no solver is given."""


def resolve_device(device: DeviceLike) -> torch.device:
    """``auto``, ``cpu`` or ``cuda`` as a device; ValueError if CUDA is requested but not available."""
    if isinstance(device, torch.device):
        return device
    if device != "auto" and not device.startswith("cuda"):
        return torch.device(device)
    if torch.cuda.is_available():
        return torch.device("cuda" if device == "auto" else device)
    if device != "auto":
        raise ValueError(
            "`--device cuda` needs a CUDA GPU and a CUDA build of torch, but found none: use --device auto or cpu."
        )
    return torch.device("cpu")


def as_scene(source: SceneLike, up: Sequence[float] | None = None) -> Scene:
    """Make a scene from settings, a file, Gaussians or a scene made in code.

    Args:
        source: What to simulate.
        up: Direction that points up in it; z if None.

    Returns:
        A :class:`Scene` as it is. Anything else is simulated as a whole, with points chosen for the grid.

    Raises:
        ValueError: If ``up`` is given twice.
    """
    if isinstance(source, Scene):
        if up is not None:
            raise ValueError("`up` belongs to the scene: write Scene(..., up=...), and leave out the separate `up`.")
        return source
    direction = [0.0, 0.0, 1.0] if up is None else list(check_vector("up", up))
    if isinstance(source, ProceduralScene | GaussianCloud):
        generator = GivenScene(source) if isinstance(source, GaussianCloud) else source
        return Scene(generator=generator, up=direction, sampling="grid")
    return Scene(ply=source, up=direction, sampling="grid")


def as_solver(solver: MPMSolver | None, hold: Region | None, scene: Scene) -> MPMSolver:
    """Return the given solver, or make one whose grid suits the size of the scene.

    What is held has no gravity then, as in the starters of the preview: its shape at rest is one in balance with its
    weight. What is not held falls.

    Raises:
        ValueError: If ``hold`` is given together with a solver.
    """
    if solver is None:
        pins = [] if hold is None else [PinnedRegion(hold)]
        cloud = scene.cloud()
        chosen = select_simulated(cloud.means, torch.sigmoid(cloud.opacities), scene.region, scene.opacity_threshold)
        means = cloud.means[chosen]
        frame = SimFrame.fit(means, scene.up, scene.longest_side, scene.metres_per_unit)
        side = float((means.amax(0) - means.amin(0)).amax()) * frame.metres_per_unit
        spacing = particle_spacing(means) * frame.metres_per_unit
        gravity = (0.0, 0.0, -9.8) if hold is None else (0.0, 0.0, 0.0)  # what is held was captured in balance
        return MPMSolver(dx=suggest_spacing(side, spacing, CELLS), gravity=gravity, boundaries=pins)
    if hold is not None:
        raise ValueError(
            "`hold` only works without a solver: add PinnedRegion(...) to the `boundaries` of the solver, and leave "
            "out `hold`."
        )
    return solver


def as_wind(wind: WindLike | None) -> WindField | SpatialWind:
    """Return the given wind, a steady wind from three numbers [m/s], or still air for None."""
    if isinstance(wind, WindField | SpatialWind):
        return wind
    if isinstance(wind, nn.Module):
        raise TypeError(f"Expected `wind` to be a WindField, a SpatialWind or three numbers, but got {wind!r}.")
    return WindField([0.0, 0.0, 0.0] if wind is None else list(check_vector("wind", wind)))
