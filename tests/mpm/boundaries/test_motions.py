"""A handle moves what it holds, a front releases it, and an impulse is applied in full and pushes only its region."""

import dataclasses
import math

import pytest
import torch
from shared import ZERO, alike, beyond, double, in_both, near, peak, solid, turned_by, up_to
from torch.testing import assert_close

from gaussian_swaying import Box, MaterialPoints, MPMSolver, PinnedRegion, Sphere
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.pins import Impulse

from .bodies import block, lone, march, run_for


@in_both
def test_handle_carries_its_particles_and_the_others_follow(formulation):
    """At rest before the window; then exactly velocity * t; released after it."""
    points = block()
    rest, velocity = points.position, double([0.4, -0.2, 0.3])
    top = rest[:, 2] > 0.3
    above, times = beyond(z=0.3), {"start": 0.0099, "end": 0.0499}
    handle = changed(PinnedRegion(above, "nodes", velocity=velocity.tolist(), **times), pinned_share=0.0)
    solver = MPMSolver(0.1, formulation, boundaries=[handle], gravity=ZERO)
    dt = 2e-3
    states = march(solver, points, dt, 50)
    for k in (1, 4, 5):
        assert float(peak(states[k].velocity)) == 0.0
    for k in (6, 15, 25):  # substeps 5 to 24 begin within the window
        expected = rest[top] + velocity * dt * (k - 5)
        near(states[k].position[top], expected, 1e-13)
        near(states[k].velocity[top], velocity.expand_as(rest[top]), 1e-13)
    first, last = (states[k].velocity[~top].mean(0) for k in (6, 25))
    assert float(last @ velocity) > max(2 * float(first @ velocity), 0.3 * float(velocity @ velocity))
    bottom = rest[:, 2] < 0.1
    assert peak(states[6].velocity[bottom]) < 0.01 * velocity.norm()
    released = states[26:]
    assert peak(released[0].velocity[top] - velocity) > 1e-3
    momenta = torch.stack([solver.momenta(state)["linear"] for state in released])
    assert_close(momenta, momenta[:1].expand_as(momenta), rtol=1e-10, atol=1e-12)


@in_both
def test_handle_in_a_frame_that_scales_and_turns(formulation):
    """Region and pivot in scene units and axes; velocities in m/s, z up, and unscaled, from its start on."""
    scene = torch.stack([block(per_side=3, side=0.6).position, block((3, 0, 0), 0.6, per_side=3).position])
    scene = scene.reshape(-1, 3) + 7.0
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    position = frame.point_to_sim(scene)
    points = solid(position, 1e-3)
    pivot, velocity = [7.1, 7.2, 6.5], double([0.2, 0.4, -0.6])
    handle = PinnedRegion(
        Box([6, 6, 6], [8, 8, 8]), velocity=velocity.tolist(), angular_velocity=[0.0, 0.0, 4.0], pivot=pivot, start=0.04
    )
    solver = MPMSolver(0.1, formulation, boundaries=[handle], gravity=ZERO)
    dt = 4e-3
    states = march(solver, points, dt, 60, frame=frame)
    first, state = next(k for k, state in enumerate(states) if float(state.time) >= 0.04), states[-1]
    assert torch.equal(states[first].position, position)
    steps = 60 - first
    own = scene[:, 0] < 8
    assert int(own.sum()) == 27
    turn = turned_by(math.degrees(4.0 * dt * steps))
    centre = frame.point_to_sim(double(pivot))
    expected = centre + velocity * dt * steps + (position[own] - centre) @ turn.T
    near(state.position[own], expected, 1e-12)
    assert torch.equal(state.position[~own], position[~own])


@in_both
def test_scenes_of_a_batch_have_their_own_front(formulation):
    one = lone([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    shifts = double([[0, 0, 0], [3, 0, 0], [0, 0, 1]])
    position = torch.stack([k * one.position + shift for k, shift in zip((1, 2, 1), shifts, strict=True)])
    points = solid(position, 1e-3, 100.0, 1e3)
    region = Box([None, None, -0.5], [None, None, 0.5])
    release = PinnedRegion(region, front=[[1, 0, 0]], start=0.0, end=0.04)
    solver = MPMSolver(0.1, formulation, boundaries=[release])
    fall = march(solver, points, 0.01, 3)[-1].velocity[..., 2]
    # at 0.03 s the first of three has fallen for 3 substeps and the second, released at 0.02 s, for 1
    counts = double([[3.0, 1, 0], [3, 1, 0], [3, 3, 3]])
    near(fall, -0.098 * counts, 1e-12)


@in_both
@pytest.mark.parametrize("direction", [(2.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 2.5, 0.0)])
def test_release_passes_over_lone_particles_in_order(formulation, direction):
    """Each falls for exactly the substeps since the front met it; the others fall from the beginning."""
    points = lone([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [1, 1, 0], [0, 9, 0]])
    release = PinnedRegion(up_to(y=5), "nodes", front=[direction], start=0.055, end=0.355)
    solver = MPMSolver(0.1, formulation, boundaries=[release])
    along = points.position[:5] @ double(direction)
    part = (along - along.min()) / (along.max() - along.min())
    times = torch.cat([0.055 + 0.3 * part, torch.zeros(1).double()])
    dt = 0.01
    for k, state in enumerate(march(solver, points, dt, 45)):
        begins = dt * torch.arange(k).double()[:, None]
        falling = (begins >= times - 1e-9).sum(0).double()
        near(state.velocity[:, 2], -9.8 * dt * falling, 1e-10)
    assert (falling > 0).all()


def test_release_of_a_single_layer_is_at_its_start():
    release = PinnedRegion(Sphere([0, 0, 0], 9.0), front=[[0, 0, 1]], start=0.25, end=2.0)
    assert release.release_time(torch.rand(5, 3) * torch.tensor([1.0, 1, 0])).tolist() == [0.25] * 5


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_release_between_given_points(up):
    scene = double([[-1.0, 5, 0], [0.5, 0, 1], [1.0, 2, 9], [2.0, 0, 0], [3.5, 0, 0]])
    frame = SimFrame.fit(scene, up=up, metres_per_unit=0.5)
    release = PinnedRegion(Sphere([0, 0, 0], 99.0), front=[[0, 0, 0], [2, 0, 0]], start=1.0, end=3.0).in_frame(frame)
    expected = [0.0, 1.5, 2.0, 3.0, 4.5]
    assert release.release_time(frame.point_to_sim(scene)).tolist() == pytest.approx(expected)
    assert release.release_time(frame.point_to_sim(scene[1:2])).tolist() == pytest.approx([1.5])


@in_both
def test_an_impulse_does_not_move_what_is_pinned(formulation):
    """In either order of the two."""
    points, ends = block(), []
    pin = PinnedRegion(beyond(z=0.34))
    knock = Impulse(Box([None] * 3, [None] * 3), [0.5, 0.0, 0.0], end=0.02)
    for boundaries in ([pin, knock], [knock, pin]):
        ends.append(run_for(formulation, boundaries, points, 0.04, gravity=ZERO).position)
    near(ends[0], ends[1], 0)
    assert peak(ends[0] - points.position) > 1e-4


@in_both
@pytest.mark.parametrize(
    ("dt", "start", "end"), [(1e-3, 0.0105, 0.0382), (3e-3, 0.0105, 0.0382), (2e-3, 0.0123, 0.0124)]
)
def test_impulse_arrives_whole_whatever_the_substep(formulation, dt, start, end):
    points = block(per_side=4)
    impulse = double([0.3, -0.2, 0.5])
    knock = Impulse(beyond(z=0.2), impulse.tolist(), start, end)
    solver = MPMSolver(0.1, formulation, boundaries=[knock], gravity=ZERO)
    for state in march(solver, points, dt, math.ceil(0.05 / dt)):
        part = min(max((float(state.time) - start) / (end - start), 0.0), 1.0)
        near(solver.momenta(state)["linear"], part * impulse, 1e-13)
        if part == 0:
            assert float(peak(state.velocity)) == 0.0


@in_both
def test_impulse_pushes_by_mass_and_only_its_region(formulation):
    """A far body is not affected. The others get the same change of velocity at any mass, so the moment is that of the
    impulse at the region's centre of mass."""
    points = MaterialPoints.join([block(per_side=4), block(low=(2, 0, 0), per_side=4)])
    points = dataclasses.replace(points, mass=points.mass * torch.linspace(1, 3, 128, dtype=torch.float64))
    region = Box([None, None, 0.15], [1.0, None, None])
    impulse = double([0.3, 0.1, -0.4])
    solver = MPMSolver(0.1, formulation, boundaries=[Impulse(region, impulse.tolist(), 0.0, 2e-3)], gravity=ZERO)
    states = march(solver, points, 2e-3, 20)
    pushed = region.contains(points.position)
    mass, place = points.mass[pushed], points.position[pushed]
    centre = (mass[:, None] * place).sum(0) / mass.sum()
    for state in states[1:]:
        found = solver.momenta(state)
        near(found["linear"], impulse, 1e-12)
        near(found["angular"], torch.linalg.cross(centre, impulse), 1e-12)
        assert torch.equal(state.position[64:], points.position[64:])
    # at first only particles that share nodes with the region move; its top, with only nodes of the region, moves as
    # one
    first = states[1].velocity[:64]
    assert peak(first[points.position[:64, 2] < 0.06]) < 0.3 * peak(first[pushed[:64]])
    top = first[points.position[:64, 2] > 0.3]
    alike(top, (impulse / mass.sum()).expand_as(top), 1e-9)


@in_both
def test_impulse_per_particle_grows_with_their_number(formulation):
    knock = Impulse(beyond(z=0.2), [0.01, -0.02, 0.03], end=2e-3, per_particle=True)
    solver = MPMSolver(0.1, formulation, boundaries=[knock], gravity=ZERO)
    impulse = double([0.01, -0.02, 0.03])
    for per_side, count in ((4, 32), (6, 108)):  # the upper half
        end = march(solver, block(per_side=per_side), 2e-3, 3)[-1]
        alike(solver.momenta(end)["linear"], count * impulse, 1e-12)
    one = lone([[0, 0, 0], [1, 0, 0.5], [2, 0, 1]])
    position = torch.stack([one.position, one.position + torch.tensor([0, 0, 5.0])])
    points = solid(position, 1e-3, 100.0, 1e3)
    end = march(solver, points, 2e-3, 3)[-1]
    expected = torch.stack([2 * impulse, 3 * impulse])
    alike(solver.momenta(end)["linear"], expected, 1e-12)
