"""The compiled substep in double precision agrees with torch to round-off, so both compute the same formulas."""

import pytest
import torch

from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import UniformGust, WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.fluid import Fluid
from gaussian_swaying.mpm.laws.foam import Foam
from gaussian_swaying.mpm.laws.hencky import StVKHencky
from gaussian_swaying.mpm.laws.metal import Metal
from gaussian_swaying.mpm.laws.neo_hookean import NeoHookean
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.laws.snow import Snow
from gaussian_swaying.mpm.laws.spring_network import SpringNetwork
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints

ELASTIC = [NeoHookean(), FixedCorotated(), StVKHencky(), SpringNetwork()]
PLASTIC = [Sand(), Snow(), Metal(100.0), Foam(100.0, 0.1), Fluid()]
CASES = [("total", law) for law in ELASTIC] + [("updated", law) for law in ELASTIC + PLASTIC]


def _moved(formulation, law, transfer, held=()):
    """A rippled sheet after 30 substeps in a gusty wind."""
    axis = (torch.arange(20, dtype=torch.float64) + 0.5) / 20 * 0.9
    x, y = (g.reshape(-1) for g in torch.meshgrid(axis, axis, indexing="ij"))
    position = torch.stack([x, y, 0.5 + 0.003 * torch.sin(9 * x)], dim=-1)
    points = MaterialPoints.create(position, volume=2e-5, density=50.0, youngs_modulus=5e3, poisson_ratio=0.3, law=law)
    solver = MPMSolver(dx=0.1, formulation=formulation, transfer=transfer, boundaries=held)
    velocity = torch.stack([0 * x, 0 * x, 2 * torch.sin(6 * x) * torch.cos(6 * y)], dim=-1)
    state = solver.init_state(points, velocity)
    if formulation == "updated":
        state = solver.fit_grid(state, 0.1)
    normal = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(position)
    wind = WindField([2.0, 0.0, 1.0], modulations=[UniformGust()], seed=3)
    area = torch.full((400,), 2e-3, dtype=torch.float64)
    end = solver.rollout(state, 2e-4, 30, [WindForce(AeroForce(), wind, normal, area)])
    assert (solver.fused() is not None) == (transfer == "auto")
    return end


def _agree(one, other):
    for name in ("position", "velocity", "F_elastic", "work", "impulse"):
        a, b = getattr(one, name), getattr(other, name)
        scale = float(b.abs().max()) if b.numel() else 0.0
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12 * scale, msg=name)


@pytest.mark.parametrize(
    ("formulation", "law"), CASES, ids=lambda case: case if isinstance(case, str) else type(case).__name__
)
def test_laws(formulation, law):
    _agree(_moved(formulation, law, "auto"), _moved(formulation, law, "torch"))


@pytest.mark.parametrize("kind", ["hinge", "clamp", "nodes"])
def test_pins(kind):
    held = [PinnedRegion(Box([-1, -1, -1], [0.1, 1, 1]), kind=kind)]
    _agree(_moved("total", FixedCorotated(), "auto", held), _moved("total", FixedCorotated(), "torch", held))
