"""A handle moves and rotates the particles that it holds."""

import math

import pytest
import torch
from scipy.spatial.transform import Rotation
from shared import solid
from torch.testing import assert_close

from gaussian_swaying import Box, MPMSolver, PinnedRegion, SimFrame, Sphere
from gaussian_swaying.mpm.pins import Handle

from .bodies import block, march, run_for

FORMULATIONS = ["total", "updated"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_carries_its_particles_and_the_others_follow(formulation):
    """At rest before the window; then exactly velocity * t; released after it."""
    points = block()
    rest, velocity = points.position, torch.tensor([0.4, -0.2, 0.3], dtype=torch.float64)
    top = rest[:, 2] > 0.3
    handle = Handle(
        Box([None, None, 0.3], [None] * 3), velocity.tolist(), kind="nodes", held_share=0.0, start=0.0099, end=0.0499
    )
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[handle], gravity=(0, 0, 0))
    dt = 2e-3
    states = march(solver, points, dt, 50)
    for k in (1, 4, 5):
        assert float(states[k].velocity.abs().max()) == 0.0
    for k in (6, 15, 25):  # substeps 5 to 24 begin within the window
        expected = rest[top] + velocity * dt * (k - 5)
        assert_close(states[k].position[top], expected, rtol=0, atol=1e-13)
        assert_close(states[k].velocity[top], velocity.expand_as(rest[top]), rtol=0, atol=1e-13)
    first, last = (states[k].velocity[~top].mean(0) for k in (6, 25))
    assert float(last @ velocity) > max(2 * float(first @ velocity), 0.3 * float(velocity @ velocity))
    bottom = rest[:, 2] < 0.1
    assert float((states[6].velocity[bottom]).abs().max()) < 0.01 * float(velocity.norm())
    released = states[26:]
    assert float((released[0].velocity[top] - velocity).abs().max()) > 1e-3
    momenta = torch.stack([solver.momenta(state)["linear"] for state in released])
    assert_close(momenta, momenta[:1].expand_as(momenta), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_turns_twice_without_growing(formulation):
    """720 degrees in 160 substeps. A tangent velocity would swell the block by (1 + 0.0785²)^80 = 1.64."""
    points = block(per_side=3, side=0.3, e=2e3)  # what is held does not deform
    spin, pivot = torch.tensor([[1.0, 2.0, -2.0], [0.1, 0.3, 0.2]], dtype=torch.float64)
    rate, substeps = 3.0, 160
    handle = Handle(Sphere([0, 0, 0], 9.0), angular_velocity=spin.tolist(), pivot=pivot.tolist(), kind="nodes")
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[handle])
    dt = 4 * math.pi / rate / substeps
    states = march(solver, points, dt, substeps)
    arm = points.position - pivot
    for k in (20, 50, 160):  # a quarter turn, 225 degrees, two turns
        turn = torch.tensor(Rotation.from_rotvec(dt * k * spin.numpy()).as_matrix())
        assert_close(states[k].position, pivot + arm @ turn.T, rtol=0, atol=1e-12)
        assert_close(states[k].F_elastic, turn.expand(27, 3, 3), rtol=0, atol=1e-11)
    assert_close(states[160].position, points.position, rtol=0, atol=1e-12)
    assert float((states[20].position - points.position).norm(dim=-1).max()) > 0.2


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_in_a_frame_that_scales_and_turns(formulation):
    """Region and pivot in scene units and axes; velocities in m/s, z up, and unscaled, from its start on."""
    scene = torch.stack([block(per_side=3, side=0.6).position, block((3, 0, 0), 0.6, per_side=3).position])
    scene = scene.reshape(-1, 3) + 7.0
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    position = frame.point_to_sim(scene)
    points = solid(position, 1e-3)
    pivot, velocity = [7.1, 7.2, 6.5], torch.tensor([0.2, 0.4, -0.6], dtype=torch.float64)
    handle = Handle(Box([6, 6, 6], [8, 8, 8]), velocity.tolist(), [0.0, 0.0, 4.0], pivot, start=0.04)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[handle], gravity=(0, 0, 0))
    dt = 4e-3
    states = march(solver, points, dt, 60, frame=frame)
    first, state = next(k for k, state in enumerate(states) if float(state.time) >= 0.04), states[-1]
    assert torch.equal(states[first].position, position)
    steps = 60 - first
    near = scene[:, 0] < 8
    assert int(near.sum()) == 27
    turn = torch.tensor(Rotation.from_rotvec([0.0, 0.0, 4.0 * dt * steps]).as_matrix())
    centre = frame.point_to_sim(torch.tensor(pivot, dtype=torch.float64))
    expected = centre + velocity * dt * steps + (position[near] - centre) @ turn.T
    assert_close(state.position[near], expected, rtol=0, atol=1e-12)
    assert torch.equal(state.position[~near], position[~near])


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_without_any_motion_is_a_pin(formulation):
    """To the bit in torch; the kernels of `total` hold a pin themselves, and leave a handle to torch."""
    points, region = block(), Box([None, None, 0.3], [None] * 3)
    for transfer, tolerance in (("torch", 0.0), ("kernels", 1e-12)):
        handle = run_for(formulation, [Handle(region)], points, 0.1, transfer=transfer)
        pin = run_for(formulation, [PinnedRegion(region)], points, 0.1, transfer=transfer)
        assert_close(handle.position, pin.position, rtol=0, atol=tolerance)
        assert_close(handle.F_elastic, pin.F_elastic, rtol=0, atol=tolerance)
