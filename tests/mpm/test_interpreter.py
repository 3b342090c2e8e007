"""Tests run Triton's interpreter with shortcuts (`quick_interpreter.py`): the same bits as without them."""

import pytest
import torch

from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints


@pytest.mark.parametrize("kernel_device", ["interpreted"], indirect=True)
@pytest.mark.parametrize("formulation", ["total", "updated"])
def test_shortcuts_change_no_bit(kernel_device, formulation, as_triton_interprets):
    """Of a body in wind, with a boundary and in `updated` a return map."""
    generator = torch.Generator().manual_seed(0)
    place, normal = (torch.rand(5, 3, generator=generator) for _ in range(2))
    law = Sand() if formulation == "updated" else None
    points = MaterialPoints.create(
        0.06 + 0.18 * place, volume=1e-4, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3, law=law
    )
    boundary = PinnedRegion(Box([None] * 3, [0.12, None, None])) if law is None else Plane([0, 0, 0.13], [0.1, 0, 1.0])

    def run():
        solver = MPMSolver(dx=0.1, formulation=formulation, damping=0.3, transfer="triton", boundaries=[boundary])
        load = WindForce(AeroForce(C_L=0.3), WindField([5.0, 2.0, -1.0]), normal, torch.full((5,), 0.02))
        with torch.no_grad():
            return solver.rollout(solver.init_state(points, 10 * normal), 1e-3, 2, load)

    quick, plain = run(), as_triton_interprets(run)
    assert float((plain.velocity - 10 * normal).abs().max()) > 0.1
    for name in ("position", "velocity", "affine", "F_elastic", "F_total", "work", "impulse", "lost"):
        assert torch.equal(getattr(quick, name), getattr(plain, name)), name
