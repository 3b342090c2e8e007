"""What whole steps of a free body conserve: momenta, energy, affine motion, and the same answer wherever it lies."""

import dataclasses
import math

import pytest
import torch
from bench.problems.bars import free_block
from bench.problems.settings import Settings, block
from shared import solid
from torch.testing import assert_close

VARIANTS = [Settings(), Settings("updated")]
EACH = pytest.mark.parametrize("settings", VARIANTS, ids=["total", "updated"])
DX, RATE = 0.1, ((0.5, -0.8, -0.5), (0.8, 0.5, -0.3), (0.5, 0.3, 0.5))


def _scattered(count=200):
    position = 0.4 * torch.rand(count, 3, dtype=torch.float64)
    return solid(position, 0.4**3 / count)


def _affine(settings, points, rate, velocity=(0.2, 0.2, 0.2)):
    """Solver and state of a body that spins and grows: v = V + A (X - centre), exactly so at the nodes too."""
    solver = settings.solver(DX)
    a = torch.tensor(rate, dtype=torch.float64)
    centre, drift = points.position.mean(0), torch.tensor(velocity, dtype=torch.float64)
    state = solver.init_state(points, (points.position - centre) @ a.T + drift)
    if settings.formulation == "total":
        return solver, state.replace(node_velocity=(state.grid.node_positions(centre) - centre) @ a.T + drift)
    return solver, state.replace(affine=a.expand_as(state.affine))


def _drift(solver, state, steps, tamper=lambda state: state):
    """Relative change of the linear and of the angular momentum."""
    before, largest = solver.momenta(state), 0.0
    with torch.inference_mode():
        for _ in range(steps):
            state = tamper(solver.step(state, 1e-3))
            largest = max(largest, float(solver.energies(state)["elastic"]))
    after = solver.momenta(state)
    assert largest > 1e-5 * float(solver.points.mass.sum())  # J/kg: it did deform
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
    """The first step has no stress: velocities and their gradient come back as they were, and F is I + dt A."""
    points = _scattered()
    solver, state = _affine(settings, points, RATE)
    end = solver.step(state, 1e-3)
    rate = torch.tensor(RATE, dtype=torch.float64)
    expected = (points.position - points.position.mean(0)) @ rate.T + 0.2
    assert_close(end.velocity, expected, rtol=0, atol=1e-13)
    assert_close(end.affine, rate.expand_as(end.affine), rtol=0, atol=1e-12)
    assert_close(end.position, points.position + 1e-3 * expected, rtol=0, atol=1e-12)
    F = torch.eye(3, dtype=torch.float64) + 1e-3 * rate
    assert_close(end.F_elastic, F.expand_as(end.F_elastic), rtol=0, atol=1e-12)


def _elsewhere(settings, shift, rate, steps):
    """Displacements of a body moved by a number of cells, and how far its size changed."""
    points = block(DX, (0, 0, 0), (3, 3, 3), settings, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3)
    moved = dataclasses.replace(points, position=points.position + DX * torch.tensor(shift, dtype=torch.float64))
    solver, state = _affine(settings, moved, rate)
    return solver.rollout(state, 1e-3, steps).position - moved.position


@EACH
def test_motion_does_not_depend_on_the_place_by_whole_cells(settings):
    a, b = (_elsewhere(settings, shift, RATE, 100) for shift in ((0.0, 0.0, 0.0), (7.0, -3.0, 12.0)))
    assert_close(a, b, rtol=0, atol=1e-12)


@EACH
def test_flight_without_stress_does_not_depend_on_the_place(settings):
    """Parts of a cell too, to round-off; with stress, to the error of the discretisation."""
    places, still = ((0.0, 0.0, 0.0), (0.3, 0.41, 0.77)), ((0.0,) * 3,) * 3
    assert_close(*(_elsewhere(settings, at, still, 100) for at in places), rtol=0, atol=1e-13)
    a, b = (_elsewhere(settings, at, RATE, 100) for at in places)
    difference = float((a - b).norm() / a.norm())
    assert 1e-6 < difference < 0.05, difference


@pytest.mark.parametrize("periods", [30, pytest.param(100, marks=pytest.mark.slow)])
def test_energy_of_a_free_block_in_total_stays(periods):
    """Periods of a wave to and fro: the mean over ten of them changes by less than 0.1 %, momenta by round-off."""
    run = free_block(Settings(), cells=3, periods=periods)
    assert run["error"] < 1e-3
    assert run["growth"] < run["swing"]
    assert run["linear"] < 1e-12
    assert run["angular"] < 1e-12


def test_energy_of_a_free_block_in_updated_never_grows():
    """Mean energies only fall, to that of the rigid motion with the momenta of the start (Koenig's theorem).

    Single ones may exceed the first by the swing of symplectic Euler, omega dt / 2. What vibrates is lost in the
    transfers: 99/4096 of the slowest wave, of half a length in three cells, in each (``keeps`` in test_bars.py).
    """
    cells, mass, window = 3, 100.0, 2
    run = free_block(Settings("updated"), periods=10, cells=cells, window=window)
    assert run["rise"] < 0
    assert run["growth"] < run["swing"]
    speed = math.sqrt(1e4 * 0.7 / (1.3 * 0.4) / mass)  # of the wave; drift and spin are those of free_block
    spin = 0.0038 * (math.pi * speed) ** 2
    points = mass / 6 * (1 - 1 / (2 * cells) ** 2)  # moment of inertia of the lattice
    affine = mass / cells**2 / 2  # what APIC adds to it; at the start no affine velocity carries momentum
    rigid = 0.5 * mass * 3 * (0.01 * speed) ** 2 + 0.5 * points**2 * spin / (points + affine)
    # spin strains the cube by (spin L)^2 / 12 c^2, which raises its inertia by less than a hundredth
    assert run["last_J"] > 0.99 * rigid
    transfers = run["substeps"] * (1 - window / 10)  # from the middle of the first mean to that of the last
    # the outer half cells, a third of the block, couple to fewer points: half the rate is the least that is left
    left = math.exp(-0.5 * 99 / 4096 * transfers)
    assert run["last_J"] - rigid < left * (run["last_J"] / run["kept"] - rigid)
    assert run["linear"] < 1e-12
    assert run["angular"] < 1e-12


def test_adaptive_and_fixed_substeps_agree():
    """The same block with the substep fixed at what the adaptive one takes."""
    adaptive = free_block(Settings(), periods=2, window=1)
    speed = math.sqrt(1e4 * 0.7 / (1.3 * 0.4) / 100)
    substep = adaptive["simulated_s"] / adaptive["substeps"]
    assert substep * speed * 4 == pytest.approx(1 / 3, rel=1e-12)  # cfl 0.4 takes 2.5 of them in a frame, rounded up
    fixed = free_block(Settings(substep=substep), periods=2, window=1)
    assert fixed["kept"] == pytest.approx(adaptive["kept"], abs=1e-9)
