"""The timed problems (a sheet in wind and a block of sand), and the fewest bytes that a substep must move."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import UniformGust, WindField
from gaussian_swaying.aero.wind_batch import WindBatch
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.state import GridSpec, MaterialPoints

CUBE = GridSpec(0.01, (0, 0, 0), (100, 100, 100))
"""Grid of ``updated`` around the sheet."""


def sheet(particles: int, device: torch.device, width: float = 0.9) -> MaterialPoints:
    """A square sheet, 0.9 m wide within a cube of 1 m, level except for a ripple."""
    side = round(particles**0.5)
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) / side * width + 0.05
    x, y = (g.reshape(-1) for g in torch.meshgrid(axis, axis, indexing="ij"))
    position = torch.stack([x, y, 0.5 + 0.003 * torch.sin(9 * x)], dim=-1)
    area = (width / side) ** 2
    return MaterialPoints.create(position, volume=area * 0.01, density=50.0, youngs_modulus=5e3, poisson_ratio=0.3)


def block(particles: int, device: torch.device) -> MaterialPoints:
    """A cube of sand: 0.9 m wide for a million particles, smaller for fewer, denser for more."""
    side = round(particles ** (1 / 3))
    spacing = 0.9 / max(side, 100)
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) * spacing + 0.05
    position = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), dim=-1).reshape(-1, 3)
    return MaterialPoints.create(
        position, volume=spacing**3, density=1600.0, youngs_modulus=1e6, poisson_ratio=0.3, law=Sand()
    )


def cube(particles: int, device: torch.device) -> MaterialPoints:
    """An elastic cube with eight points in a cell of 1/128 m."""
    side, spacing = round(particles ** (1 / 3)), 1 / 256
    axis = (torch.arange(side, device=device, dtype=torch.float32) + 0.5) * spacing + 0.1
    position = torch.cartesian_prod(axis, axis, axis)
    return MaterialPoints.create(position, volume=spacing**3, density=1000.0, youngs_modulus=1e5, poisson_ratio=0.3)


def spin(position: Tensor) -> Tensor:
    """Velocity of a body that turns with 2.3 rad/s and drifts with 0.5 m/s: its points soon enter other cells."""
    arm = position - position.mean(0)
    axis = torch.tensor([0.6, 1.0, 2.0], device=position.device).expand_as(arm)
    return torch.linalg.cross(axis, arm) + torch.tensor([0.5, 0.0, 0.0], device=position.device)


def waves(position: Tensor) -> Tensor:
    """A smooth velocity across the sheet, up to 1 m/s, so that the motion is larger than round-off."""
    x, y, _ = position.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, zero, torch.sin(2 * math.pi * x) * torch.cos(2 * math.pi * y)], dim=-1)


def wind_load(points: MaterialPoints, winds: WindField | WindBatch | list[WindField]) -> WindForce:
    """Wind on every particle of one or several sheets."""
    slope = 0.027 * torch.cos(9 * points.position[..., 0])
    normal = torch.stack([-slope, torch.zeros_like(slope), torch.ones_like(slope)], dim=-1)
    device = points.position.device
    area = (points.volume / 0.01).contiguous()
    return WindForce(AeroForce().to(device), winds, torch.nn.functional.normalize(normal, dim=-1), area)


def wind(number: int, gusts: bool, device: torch.device) -> WindField:
    """A wind that is different for each number."""
    modulations = [UniformGust()] if gusts else []
    return WindField([2.0, 0.0, 1.0 + 0.01 * number], modulations=modulations, seed=number).to(device)


def nodes_in_reach(position: Tensor, dx: float) -> int:
    """Number of grid nodes in the stencil of any particle, which are the nodes that get mass."""
    low = torch.floor(position.reshape(-1, 3).double() / dx - 0.5).long()
    low = low - low.amin(0)
    shape = [int(n) + 3 for n in low.amax(0)]
    cells = torch.unique((low[:, 0] * shape[1] + low[:, 1]) * shape[2] + low[:, 2])
    steps = [(i * shape[1] + j) * shape[2] + k for i in range(3) for j in range(3) for k in range(3)]
    return len(torch.unique(cells[:, None] + torch.tensor(steps, device=cells.device)))


TRAFFIC: dict[str, dict[str, tuple[int, int]]] = {
    "total": {"a particle": (6, 0), "a node": (7, 6)},
    "updated": {"a particle": (16, 12), "a node": (7, 7)},
}
"""How many numbers a substep reads and writes; docs/benchmarks.md says which."""

WIND_TRAFFIC, PLASTIC_TRAFFIC = (4, 0), (9, 9)  # extra numbers for a particle


def fewest_bytes(formulation: str, particles: int, nodes: int, wind: bool = False, plastic: bool = False) -> int:
    """Fewest bytes that a substep in float32 must move through device memory.

    Each input of a particle is read once, each output written once; the fields of the nodes that have mass are read
    once and written once.

    Args:
        formulation: ``total`` or ``updated``.
        particles: Number of particles.
        nodes: Number of nodes that have mass.
        wind: Whether wind acts on the particles.
        plastic: Whether their law is plastic.

    Returns:
        Bytes.
    """
    per_particle = sum(TRAFFIC[formulation]["a particle"])
    per_particle += sum(WIND_TRAFFIC) if wind else 0
    per_particle += sum(PLASTIC_TRAFFIC) if plastic else 0
    return 4 * (particles * per_particle + nodes * sum(TRAFFIC[formulation]["a node"]))
