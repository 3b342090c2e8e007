"""Drag at the end of the substep: unconditionally stable, and without effect if nothing moves."""

import pytest
import torch
from shared import solid

from gaussian_swaying import AeroForce, Box, MPMSolver, PinnedRegion

FORMULATIONS = ["total", "updated"]
AERO = AeroForce(C_D=1.2, C_F=0.0, C_L=0.0, drag_step="semi_implicit")
ALONG = AeroForce(C_D=0.0, C_F=1.2, C_L=0.0, drag_step="semi_implicit")  # a sheet edge-on only stretches


def _sheet(areal, e=1e4):
    """A sheet in the x-z plane, areal density in kg/m²."""
    x = (torch.arange(8, dtype=torch.float64) + 0.5) * 0.05
    gx, gz = (g.reshape(-1) for g in torch.meshgrid(x, x, indexing="ij"))
    position = torch.stack([gx, torch.full_like(gx, 0.02), gz], dim=-1)
    return solid(position, 0.05**2 * 0.01, areal / 0.01, e, 0.0)


def _run(solver, state, wind, dt, steps, aero=AERO):
    wind = torch.tensor(wind, dtype=torch.float64)
    normal = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64).expand_as(state.position)
    area = torch.full_like(solver.points.mass, 0.05**2)
    fastest = 0.0
    for k in range(steps):
        force = aero(wind, state.velocity, normal, area)
        drag = aero.resistance(wind, state.velocity, area)
        state = solver.fit_grid(state, min(20, steps) * dt) if k % 20 == 0 else state
        state = solver.step(state, dt, force=force, drag=drag)
        fastest = max(fastest, float(state.velocity.norm(dim=-1).max()))
    return state, fastest


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("dt", [1e-4, 1e-2, 0.1])
def test_one_step_is_the_implicit_one(formulation, dt):
    """v+ = (v + k u) / (1 + k), k = dt rho A C v_r / 2m, for a free sheet in a wind too strong for explicit steps."""
    points = _sheet(0.02, e=1.0)  # soft, or the long substeps would be refused; a free sheet does not deform
    solver = MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0))
    velocity = torch.tensor([0.0, -10.0, 0.0], dtype=torch.float64).expand_as(points.position)
    state, _ = _run(solver, solver.init_state(points, velocity), [0.0, 30.0, 0.0], dt, 1)
    k = dt * 1.225 * 1.2 * 40.0 / (2 * 0.02)
    expected = (-10.0 + k * 30.0) / (1 + k)
    torch.testing.assert_close(state.velocity[:, 1], torch.full_like(points.mass, expected))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_free_sheet_never_overtakes_the_wind(formulation):
    """A jump from calm to 100 m/s, with a substep that shrinks at the same moment."""
    points = _sheet(0.02)
    solver = MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0))
    state, _ = _run(solver, solver.init_state(points), [0.0, 0.0, 0.0], 4e-4, 3)
    state, fastest = _run(solver, state, [0.0, 100.0, 0.0], 1e-4, 60)
    assert fastest <= 100.0 * (1 + 1e-9)
    assert float(state.velocity[:, 1].mean()) > 90.0


@pytest.mark.slow(gate=["total"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_what_hangs_still_feels_all_of_its_weight_and_wind(formulation):
    """In equilibrium nothing moves, so the drag equals the explicit one for any substep: the same sag, with weight."""
    places = []
    for dt in (2e-4, 6e-4):
        points = _sheet(0.02, e=3e4)
        pin = PinnedRegion(Box([None, None, 0.35], [None, None, None]))
        solver = MPMSolver(dx=0.1, formulation=formulation, damping=30.0, boundaries=[pin])
        state, _ = _run(solver, solver.init_state(points), [0.0, 0.0, -15.0], dt, round(0.24 / dt), ALONG)
        assert float(state.velocity.abs().max()) < 1e-3
        places.append(state.position - points.position)
    sag = float(places[0].abs().max())
    assert sag > 2e-4
    torch.testing.assert_close(places[1], places[0], rtol=0, atol=0.01 * sag)
