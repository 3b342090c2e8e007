import dataclasses

import pytest
import torch
from bench.problems.settings import Settings, block
from shared import EYE, double, near, rand, solid
from torch.testing import assert_close

VARIANTS = [Settings(), Settings("updated")]
EACH = pytest.mark.parametrize("settings", VARIANTS, ids=["total", "updated"])
DX, RATE = 0.1, ((0.5, -0.8, -0.5), (0.8, 0.5, -0.3), (0.5, 0.3, 0.5))


def _scattered(count=200):
    position = 0.4 * rand(count, 3)
    return solid(position, 0.4**3 / count)


def _affine(settings, points, rate, velocity=(0.2, 0.2, 0.2)):
    """Solver and state of a body that spins and grows: v = V + A (X - centre), exactly so at the nodes too."""
    solver = settings.solver(DX)
    a = double(rate)
    centre, drift = points.position.mean(0), double(velocity)
    state = solver.init_state(points, (points.position - centre) @ a.T + drift)
    if settings.formulation == "total":
        return solver, state.replace(node_velocity=(state.grid.node_positions(centre) - centre) @ a.T + drift)
    return solver, state.replace(affine=a.expand_as(state.affine))


def _drift(solver, state, steps, tamper=lambda state: state):
    before, largest = solver.momenta(state), 0.0
    with torch.inference_mode():
        for _ in range(steps):
            state = tamper(solver.step(state, 1e-3))
            largest = max(largest, float(solver.energies(state)["elastic"]))
    after = solver.momenta(state)
    assert largest > 1e-5 * solver.points.mass.sum()  # J/kg: it did deform
    return {name: float((after[name] - before[name]).norm() / before[name].norm()) for name in before}


@EACH
def test_steps_conserve_both_momenta(settings):
    drift = _drift(*_affine(settings, _scattered(), RATE), 200)
    assert drift["linear"] < 1e-12
    assert drift["angular"] < 1e-12


def test_without_the_affine_velocity_angular_momentum_is_lost():
    """PIC as the negative control: the test above sees a defect when there is one."""
    solver, state = _affine(Settings("updated"), _scattered(), RATE)
    drift = _drift(solver, state, 200, lambda s: s.replace(affine=torch.zeros_like(s.affine)))
    assert drift["linear"] < 1e-12
    assert drift["angular"] > 0.01


@EACH
def test_affine_velocity_is_reproduced(settings):
    points = _scattered()
    solver, state = _affine(settings, points, RATE)
    end = solver.step(state, 1e-3)
    rate = double(RATE)
    expected = (points.position - points.position.mean(0)) @ rate.T + 0.2
    near(end.velocity, expected, 1e-13)
    near(end.affine, rate.expand_as(end.affine), 1e-12)
    near(end.position, points.position + 1e-3 * expected, 1e-12)
    F = EYE + 1e-3 * rate
    near(end.F_elastic, F.expand_as(end.F_elastic), 1e-12)


def _elsewhere(settings, shift, rate, steps):
    points = block(DX, (0, 0, 0), (3, 3, 3), settings, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3)
    moved = dataclasses.replace(points, position=points.position + DX * double(shift))
    solver, state = _affine(settings, moved, rate)
    return solver.rollout(state, 1e-3, steps).position - moved.position


@EACH
def test_motion_does_not_depend_on_the_place_by_whole_cells(settings):
    a, b = (_elsewhere(settings, shift, RATE, 100) for shift in ((0.0, 0.0, 0.0), (7.0, -3.0, 12.0)))
    near(a, b, 1e-12)


@EACH
def test_flight_without_stress_does_not_depend_on_the_place(settings):
    """Parts of a cell too, to round-off; with stress, to the error of the discretisation."""
    places, still = ((0.0, 0.0, 0.0), (0.3, 0.41, 0.77)), ((0.0,) * 3,) * 3
    assert_close(*(_elsewhere(settings, at, still, 100) for at in places), rtol=0, atol=1e-13)
    a, b = (_elsewhere(settings, at, RATE, 100) for at in places)
    difference = float((a - b).norm() / a.norm())
    assert 1e-6 < difference < 0.05, difference
