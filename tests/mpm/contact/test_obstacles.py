import math

import pytest
import torch
from shared import ZERO, double, in_both, longest, near, solid, value_error

from gaussian_swaying import MPMSolver
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.regions import Box, Capsule, HalfSpace, Sphere
from gaussian_swaying.mpm.colliders import Obstacle

from .bodies import march, scene, sheet


def _block(side=0.3, per_side=6, bottom=0.0):
    axis = (torch.arange(per_side).double() + 0.5) * side / per_side - side / 2
    place = torch.cartesian_prod(axis, axis, axis)
    place[:, 2] += bottom - float(place[:, 2].min())
    return solid(place, (side / per_side) ** 3, 500.0, 2e5)


def _mean_velocity(solver, state):
    mass = solver.points.mass
    return (mass[:, None] * state.velocity).sum(0) / mass.sum()


def _roll(solver, state, frames, frame=0.04):
    for _ in range(frames):
        steps = solver.substeps(state, frame)
        state = solver.rollout(solver.fit_grid(state, frame), frame / steps, steps)
    return state


@pytest.mark.slow(gate=["0.5-total-0.5", "-0.5-updated-0.5"])
@pytest.mark.parametrize("friction", [0.2, 0.5])
@in_both
@pytest.mark.parametrize("degrees", [-0.5, 0.5])
def test_a_block_slides_beyond_the_angle_of_friction(formulation, friction, degrees):
    """Half a degree above arctan(mu) it gains g (sin a - mu cos a), half a degree below it loses as much, or rests.

    The block settles for 0.4 s first; 3 % of the acceleration is 0.015 degrees. At rest it creeps by a few mm/s, as the
    impulses of a substep are not iterated to the end.
    """
    angle = math.atan(friction) + math.radians(degrees)
    gravity = (9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle))
    ground = Obstacle(HalfSpace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), friction)
    solver = MPMSolver(0.1, formulation, gravity=gravity, stiffness_damping=2e-3, boundaries=[ground])
    settled = _roll(solver, solver.init_state(_block()), 10)
    end = _roll(solver, settled, 8)
    before, after = (float(_mean_velocity(solver, state)[0]) for state in (settled, end))
    expected = 9.8 * (math.sin(angle) - friction * math.cos(angle)) * 8 * 0.04
    if degrees > 0:
        assert abs(after - before - expected) < 0.03 * abs(expected)
    else:
        assert after < 0.005 or abs(after - before - expected) < 0.03 * abs(expected)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["ground", "block", "capsule"])
@in_both
def test_a_moving_obstacle_moves_what_lies_on_it(formulation, shape):
    """A lift that rises at 0.5 m/s with much friction also carries the block sideways; all start at rest."""
    keys = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.05], [0.5, 0.0, 0.25]]
    path = KeyedPath([0.0, 0.4, 1.2], keys)
    obstacle = {
        "ground": lambda: Obstacle(HalfSpace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), 2.0, path=path),
        "block": lambda: Obstacle(Box([-0.6, -0.6, -0.3], [0.6, 0.6, 0.0]), friction=2.0, path=path),
        "capsule": lambda: Obstacle(Capsule([-9.0, 0.0, -4.0], [9.0, 0.0, -4.0], 4.0), 2.0, path=path),
    }[shape]()
    solver = MPMSolver(0.1, formulation, stiffness_damping=2e-3, boundaries=[obstacle])
    state = _roll(solver, solver.init_state(_block()), 22)
    near(_mean_velocity(solver, state), double([0.5, 0.0, 0.25]), 0.05)


@pytest.mark.parametrize("frames", [8, pytest.param(20, marks=pytest.mark.slow)])
def test_a_block_that_rests_stays_where_it_is(frames):
    """In `total` the lowest points lie on the ground within the overlap that carries their weight, of order g dt²."""
    ground = Obstacle(HalfSpace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    solver = MPMSolver(0.1, stiffness_damping=5e-3, boundaries=[ground])
    state = _roll(solver, solver.init_state(_block(bottom=0.005)), frames)
    lowest = state.position[:, 2].min()
    assert abs(float(lowest)) < 1e-4
    assert longest(state.velocity) < 1e-3
    assert state.position[:, 2].mean() > 0.1


def test_a_fast_sheet_does_not_pass_a_thin_rod():
    """50 m/s onto a rod of 4 cm: three times its width in a frame."""
    points = sheet(16, 16)
    velocity = double([0.0, 0.0, -50.0]).expand(points.count, 3)
    rod = Obstacle(Capsule([0.15, -1.0, -0.05], [0.15, 2.0, -0.05], 0.02))
    solver, state = scene(points, boundaries=[rod], velocity=velocity, gravity=ZERO)
    below = double([0.15, 0.0, -0.05])
    for later in march(solver, state, 0.01, frame=0.001):
        arm = (later.position - below)[:, [0, 2]]
        assert torch.isfinite(later.position).all()
        assert arm.norm(dim=-1).min() > 0.02


def _flying_ball(speed=1e4, turns=(), **settings):
    """A ball that crosses a free sheet within one frame of 4e-5 s, in ``updated``; it was still before."""
    times, moves = [0.0, 1.0, 1.0 + 0.4 / speed], [[0, 0, -0.2], [0, 0, -0.2], [0, 0, 0.2]]
    ball = Obstacle(Sphere([0.1, 0.1, 0.0], 0.18), friction=0.0, path=KeyedPath(times, moves, list(turns)))
    points = sheet(11, 11)
    solver = MPMSolver(0.044, "updated", gravity=ZERO, boundaries=[ball], **settings)
    state = solver.init_state(points)
    return solver, state, state.replace(time=state.time + 1.0)


def test_a_ball_at_ten_kilometres_a_second_does_not_pass_a_sheet():
    solver, still, state = _flying_ball()
    frame = 4e-5
    assert solver.substeps(still, frame) == 1  # no obstacle moves yet
    assert solver.bound.obstacle_cells(still, frame) == 0.0
    steps = solver.substeps(state, frame)
    assert solver.bound.obstacle_cells(state, frame) == pytest.approx(1e4 / 0.044)
    assert steps == math.ceil(1e4 * frame / 0.044 / solver.cfl)
    end = solver.rollout(solver.fit_grid(state, frame, margin=10), frame / steps, steps)
    hit = (state.position - state.position.mean(0))[:, :2].norm(dim=-1) < 0.05
    assert end.position[hit, 2].min() > 0.2  # ahead of its centre
    away = (end.position - double([0.1, 0.1, 0.2])).norm(dim=-1)
    assert away.min() > 0.18 - 0.044  # outside, to a cell
    through = solver.rollout(solver.fit_grid(state, frame, margin=10), frame, 1, check=False)
    assert through.position[hit, 2].max() < 0.1  # the ball is past them
    assert solver.bound.obstacle_cells(end.replace(time=end.time + frame), frame) == 0.0  # its motion is over


def test_substeps_in_which_an_obstacle_would_jump_are_refused():
    solver, still, state = _flying_ball()
    solver.rollout(still, 4e-5, 2)
    for call in (lambda: solver.step(state, 4e-5), lambda: solver.rollout(state, 4e-5, 2)):
        with value_error(r"moves by 9.09 cells in a substep of 4e-05 s.* lower `dt` to at most 4.4e-06"):
            call()
    fixed, _, state = _flying_ball(substep=4e-5)
    with value_error(r"An obstacle moves by 9.09 cells .* lower `solver.substep` to at most 4.4e-06"):
        fixed.substeps(state, 4e-4)


def test_an_obstacle_that_turns_counts_at_the_farthest_place():
    """180 degrees in 0.4 s, at the corner of the sheet, and the way of its centre."""
    turning, _, state = _flying_ball(1.0, [[0, 0, 0], [0, 0, 0], [0, 0, 180]])
    far = math.hypot(0.1, 0.1, 0.2)
    assert turning.bound.obstacle_cells(state, 0.1) == pytest.approx((1.0 + math.pi / 0.4 * far) / 0.044)
