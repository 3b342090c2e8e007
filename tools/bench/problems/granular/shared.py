"""Shared by layers and columns of sand: constants, the initial state, and the formulation.

The runs are in metres, seconds and kilograms, and in the ``updated`` formulation whatever the settings say.
"""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from bench.problems.settings import Settings
from gaussian_swaying.mpm.laws.law import lame_parameters
from gaussian_swaying.mpm.state import MaterialPoints, MPMState

GRAVITY, DENSITY, POISSON = 9.81, 1600.0, 0.3
LENGTH = 0.1  # half width or radius of the column, and depth of the layer [m]
FRAMES = 50
COMPRESSION = 1e-2  # weight over Young's modulus


def updated(settings: Settings | None) -> Settings:
    """The given or default settings with the ``updated`` formulation."""
    return dataclasses.replace(Settings() if settings is None else settings, formulation="updated")


def consolidated(state: MPMState, points: MaterialPoints, height: float) -> MPMState:
    """The state with the vertical strain of a layer of the given height under its weight, without lateral strain."""
    mu, lam = lame_parameters(points.youngs_modulus, points.poisson_ratio)
    strain = -DENSITY * GRAVITY * (height - state.position[..., 2]) / (lam + 2 * mu)
    stretch = torch.stack([torch.ones_like(strain), torch.ones_like(strain), strain.exp()], dim=-1)
    F = stretch.diag_embed()
    return state.replace(F_elastic=F, F_total=F)


def kinetic_energy(state: MPMState, points: MaterialPoints) -> Tensor:
    """Kinetic energy of all particles [J]."""
    return 0.5 * (points.mass * state.velocity.square().sum(-1)).sum(-1)
