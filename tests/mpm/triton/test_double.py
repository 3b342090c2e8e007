"""The compiled substep in double precision agrees with torch to round-off, so both compute the same formulas."""

import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from shared import solid

from gaussian_swaying import AeroForce, Box, MPMSolver, PinnedRegion, UniformGust, WindField, WindForce

CASES = [
    ("total", "corotated", "hinge"),
    ("total", "corotated", "nodes"),
    ("total", "neo-hookean", "clamp"),
    ("total", "hencky", None),
    ("total", "springs", None),
    *(("updated", law, None) for law in ("corotated", "sand", "snow", "metal", "foam", "fluid")),
]


def _moved(formulation, law, transfer, held=()):
    """A rippled sheet after 30 substeps in a gusty wind."""
    axis = (torch.arange(20, dtype=torch.float64) + 0.5) / 20 * 0.9
    x, y = (g.reshape(-1) for g in torch.meshgrid(axis, axis, indexing="ij"))
    position = torch.stack([x, y, 0.5 + 0.003 * torch.sin(9 * x)], dim=-1)
    points = solid(position, 2e-5, 50.0, 5e3, law=law)
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


@pytest.mark.parametrize(("formulation", "law", "kind"), CASES)
def test_kernels_agree_with_torch_to_round_off(formulation, law, kind):
    held = [PinnedRegion(Box([-1, -1, -1], [0.1, 1, 1]), kind=kind)] if kind else []
    one, other = (_moved(formulation, (ELASTIC | PLASTIC)[law], transfer, held) for transfer in ("auto", "torch"))
    for name in ("position", "velocity", "F_elastic", "work", "impulse"):
        a, b = getattr(one, name), getattr(other, name)
        scale = float(b.abs().max()) if b.numel() else 0.0
        torch.testing.assert_close(a, b, rtol=0, atol=1e-12 * scale, msg=name)
