"""Solver and wind law together, against closed forms of the law itself (quasi-steady drag on a free plate)."""

import math

import pytest
import torch

from gaussian_swaying.aero.force import AeroForce
from gaussian_swaying.data.procedural import FlagScene
from gaussian_swaying.gaussians.surface import GaussianSurfaceModel, deform_patch
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints

SIDE, SPACING, THICKNESS, DENSITY, AIR, C = 0.4, 0.05, 0.01, 20.0, 1.225, 1.2


def _plate(formulation, gravity):
    """A stiff square plate in the x-z plane, normal along y."""
    axis = (torch.arange(round(SIDE / SPACING), dtype=torch.float64) + 0.5) * SPACING
    x, z = (g.reshape(-1) for g in torch.meshgrid(axis, axis, indexing="ij"))
    points = MaterialPoints.create(
        torch.stack([x, torch.zeros_like(x), z], dim=-1),
        volume=SPACING**2 * THICKNESS,
        density=DENSITY,
        youngs_modulus=1e4,
        poisson_ratio=0.3,
    )
    solver = MPMSolver(dx=0.1, formulation=formulation, gravity=gravity)
    return solver, points


def _fly(formulation, law, wind, gravity, seconds):
    """Mean velocity along y after some time in wind along y."""
    solver, points = _plate(formulation, gravity)
    aero = AeroForce(C_D=C, C_F=0.0, C_L=0.0, air_density=AIR, law=law)
    normal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand(points.count, 3)
    area = torch.full((points.count,), SPACING**2, dtype=torch.float64)
    flow = torch.tensor([0.0, wind, 0.0], dtype=torch.float64)
    state = solver.init_state(points)
    frames = round(seconds / 0.04)
    for _ in range(frames):
        steps = solver.substeps(state, 0.04)
        state = solver.fit_grid(state, 0.04)
        for _ in range(steps):
            n, a = deform_patch(state.F_total, normal, area)
            state = solver.step(state, 0.04 / steps, aero(flow, state.velocity, n, a))
    return float((points.mass * state.velocity[:, 1]).sum() / points.mass.sum())


@pytest.mark.parametrize("formulation", ["total", "updated"])
@pytest.mark.parametrize("law", ["paper", "projected"])
def test_a_free_plate_approaches_the_speed_of_the_wind(formulation, law):
    """v = U - U / (1 + U t / L) with L = 2 m / (rho A C), from rest and without gravity: within 1 %."""
    length = 2 * DENSITY * THICKNESS / (AIR * C)
    for seconds in (0.08, 0.4):
        expected = 5.0 - 5.0 / (1 + 5.0 * seconds / length)
        assert _fly(formulation, law, 5.0, (0, 0, 0), seconds) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("law", ["paper", "projected"])
def test_a_falling_plate_reaches_its_terminal_velocity(law):
    """v = v_t tanh(g t / v_t) with v_t² = 2 m g / (rho A C), in still air, broadside: within 1 %."""
    terminal = math.sqrt(2 * DENSITY * THICKNESS * 9.8 / (AIR * C))
    for seconds in (0.12, 0.8):
        expected = terminal * math.tanh(9.8 * seconds / terminal)
        assert _fly("total", law, 0.0, (0, -9.8, 0), seconds) == pytest.approx(-expected, rel=0.01)


@pytest.mark.parametrize("law", ["paper", "projected"])
def test_force_on_a_plate_does_not_depend_on_the_gaussians_that_carry_it(law):
    """Number and overlap of the Gaussians vary: the force stays within 3 % with `coverage`, not with `paper`."""
    forces = {"coverage": [], "paper": []}
    for spacing, overlap in ((0.05, 0.5), (0.02, 0.3), (0.02, 1.0), (0.0125, 0.6)):
        cloud = FlagScene(width=0.8, height=0.8, spacing=spacing, overlap=overlap, ripple=0.0).generate()
        model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False)
        for mode, found in forces.items():
            area = model.areas(mode)
            aero = AeroForce(C_D=C, C_F=0.0, C_L=0.0, air_density=AIR, law=law)
            force = aero(torch.tensor([0.0, 3.0, 0.0]), torch.zeros(len(cloud), 3), model.normals(), area)
            found.append(float(force[:, 1].sum()))
    exact = 0.5 * AIR * 9.0 * 0.64 * C
    assert forces["coverage"] == pytest.approx([exact] * 4, rel=0.03)
    assert max(forces["paper"]) > 3 * min(forces["paper"])
