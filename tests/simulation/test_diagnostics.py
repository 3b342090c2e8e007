"""Numbers of known states, and who is to blame for bad ones."""

import math

import pytest
import torch

from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.diagnostics import SimulationDiverged, check_state, diagnose


def _solver(**settings):
    position = torch.rand(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = MaterialPoints.create(position, volume=0.02, density=100.0, youngs_modulus=1e4, poisson_ratio=0.0)
    solver = MPMSolver(dx=0.2, formulation="updated", **settings)
    return solver, solver.init_state(points)


def test_numbers_of_a_known_state():
    """Stretched by 2, 1, 0.25, moved by (3, 0, 4), all with velocity (0, 0, 2)."""
    solver, state = _solver()
    F = torch.diag(torch.tensor([2.0, 1.0, 0.25], dtype=torch.float64)).expand(30, 3, 3)
    shift = torch.tensor([3.0, 0.0, 4.0], dtype=torch.float64)
    shift = shift * torch.linspace(0, 1, 30, dtype=torch.float64)[:, None]
    velocity = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64).expand(30, 3)
    lost = torch.zeros(30, dtype=torch.bool)
    lost[[3, 7]] = True
    state = state.replace(
        position=state.position + shift,
        velocity=velocity,
        F_total=F,
        F_elastic=F,
        lost=lost,
        time=torch.tensor(0.6, dtype=torch.float64),
    )
    health = diagnose(solver, state, 12, 1e-3)
    assert health.time == pytest.approx(0.6)
    assert (health.substeps, health.lost) == (12, 2)
    assert health.kinetic == pytest.approx(0.5 * 30 * 2.0 * 4.0)
    assert health.potential == pytest.approx(9.8 * 2.0 * float(state.position[:, 2].sum()))
    # nu = 0: lambda = 0, mu = E / 2, energy density = mu |Sigma - I|²
    assert health.elastic == pytest.approx(30 * 0.02 * 5e3 * (1.0 + 0.75**2), rel=1e-9)
    assert (health.J_min, health.J_max) == (pytest.approx(0.5), pytest.approx(0.5))
    assert (health.stretch_min, health.stretch_max) == (pytest.approx(0.25), pytest.approx(2.0))
    assert (health.displacement_mean, health.displacement_max) == (pytest.approx(2.5), pytest.approx(5.0))
    # c = sqrt(2 mu / rho) = 10 m/s, twice that in a cell stretched by 2, and 2 m/s of motion
    assert health.cfl == pytest.approx(1e-3 * (2 * 10.0 + 2.0) / 0.2)
    assert health.as_dict()["kinetic"] == health.kinetic
    assert set(health.as_dict()) == set(health.__slots__ if hasattr(health, "__slots__") else vars(health))


def test_extremes_are_those_of_single_particles():
    solver, state = _solver()
    F = state.F_total.clone()
    F[4, 0, 0], F[9, 1, 1] = 3.0, -0.5
    health = diagnose(solver, state.replace(F_total=F), 1, 1e-3)
    assert (health.J_min, health.J_max) == (pytest.approx(-0.5), pytest.approx(3.0))


def test_a_healthy_state_passes():
    solver, state = _solver()
    check_state(solver, state)
    check_state(solver, state.replace(position=state.position + 100.0))


@pytest.mark.parametrize("name", ["position", "velocity", "F_elastic"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_particle_that_is_not_finite_is_named(name, value):
    solver, state = _solver()
    field = getattr(state, name).clone()
    field[17] = value
    field[21] = value
    state = state.replace(**{name: field}, time=torch.tensor(0.25, dtype=torch.float64))
    with pytest.raises(
        SimulationDiverged, match=r"t = 0\.25 s, particle 17: .*NaN.*Remedy: lower `solver\.cfl`"
    ) as info:
        check_state(solver, state)
    assert (info.value.particle, info.value.time) == (17, 0.25)


def test_the_remedy_of_a_fixed_substep_gives_the_stable_one():
    solver, state = _solver(substep=1e-3)
    with pytest.raises(
        SimulationDiverged, match=rf"`solver.substep` \(stable at rest: {solver.stable_substep():.3g} s\)"
    ):
        check_state(solver, state.replace(velocity=state.velocity * math.nan))


def test_a_lost_particle_is_named():
    solver, state = _solver()
    lost = torch.zeros(30, dtype=torch.bool)
    lost[[5, 6]] = True
    with pytest.raises(SimulationDiverged, match=r"particle 5: it left the grid \(2 particles did\).*EnclosingBox"):
        check_state(solver, state.replace(lost=lost))


def test_a_particle_far_away_is_named():
    solver, state = _solver()
    position = state.position.clone()
    position[11, 2] += 2000.0
    with pytest.raises(SimulationDiverged, match=r"particle 11: it is more than 1000 object sizes"):
        check_state(solver, state.replace(position=position))


def test_without_a_particle_none_is_named():
    assert "particle" not in str(SimulationDiverged(1.0, None, "cause", "remedy"))
