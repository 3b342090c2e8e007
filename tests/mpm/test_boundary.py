"""Each boundary acts where and when it says, and nowhere else."""

import copy
import dataclasses
import math

import pytest
import torch

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.regions import Box, Cylinder, Everything, Not, Sphere, Union
from gaussian_swaying.mpm.boundary import (
    EnclosingBox,
    Handle,
    Impulse,
    Nodes,
    PinnedRegion,
    Plane,
    SequentialRelease,
    VelocityBox,
    plane_velocity,
)
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints

FORMULATIONS = ["total", "updated"]
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def _block(low=(0.0, 0.0, 0.0), side=0.4, e=2e4, per_side=6):
    axis = (torch.arange(per_side, dtype=torch.float64) + 0.5) * side / per_side
    position = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).reshape(-1, 3)
    return MaterialPoints.create(
        position + torch.tensor(low, dtype=torch.float64),
        volume=(side / per_side) ** 3,
        density=100.0,
        youngs_modulus=e,
        poisson_ratio=0.3,
    )


def _run(formulation, boundaries, points, seconds, velocity=None, gravity=(0, 0, -9.8), dx=0.1, damping=0.0):
    solver = MPMSolver(dx=dx, formulation=formulation, boundaries=boundaries, gravity=gravity, damping=damping)
    state = solver.init_state(points, velocity)
    for _ in range(round(seconds / 0.02)):
        steps = solver.substeps(state, 0.02)
        state = solver.rollout(solver.fit_grid(state, 0.02), 0.02 / steps, steps)
    assert not bool(state.lost.any())
    return state


def _lone(places, **material):
    """Particles without neighbours: no stencil meets another."""
    position = torch.tensor(places, dtype=torch.float64)
    given = {"volume": 1e-3, "density": 100.0, "youngs_modulus": 1e3, "poisson_ratio": 0.3}
    return MaterialPoints.create(position, **(given | material))


def _march(solver, points, dt, steps, velocity=None, frame=None):
    """All states from the first to the last, on a grid that has room."""
    states = [solver.init_state(points, velocity, margin=12, frame=frame)]
    for _ in range(steps):
        states.append(solver.step(states[-1], dt))
    assert not bool(states[-1].lost.any())
    return states


def _rotation(axis, angle):
    """Rodrigues' rotation matrix."""
    x, y, z = torch.tensor(axis, dtype=torch.float64) / math.sqrt(sum(c * c for c in axis))
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    return torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def test_plane_velocity_kinds():
    into = torch.tensor([[3.0, 0.0, -2.0]], dtype=torch.float64)
    away = torch.tensor([[3.0, 0.0, 2.0]], dtype=torch.float64)
    assert plane_velocity(into, UP, "sticky", 0.0).tolist() == [[0, 0, 0]]
    assert plane_velocity(away, UP, "sticky", 0.0).tolist() == [[0, 0, 0]]
    assert plane_velocity(into, UP, "slip", 0.0).tolist() == [[3, 0, 0]]
    assert plane_velocity(away, UP, "slip", 0.0).tolist() == [[3, 0, 0]]
    assert plane_velocity(into, UP, "separate", 0.0).tolist() == [[3, 0, 0]]
    assert plane_velocity(away, UP, "separate", 0.5).tolist() == [[3, 0, 2]]
    # Coulomb: the tangential speed loses mu times the normal speed taken away, and never turns round
    torch.testing.assert_close(plane_velocity(into, UP, "separate", 0.5), torch.tensor([[2.0, 0, 0]]).double())
    assert plane_velocity(into, UP, "separate", 5.0).tolist() == [[0, 0, 0]]
    assert plane_velocity(torch.zeros(1, 3), UP.float(), "separate", 0.5).tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_plane_holds_a_falling_block_on_its_free_side(formulation, kind):
    points = _block(low=(0, 0, 0.05))
    state = _run(formulation, [Plane([0, 0, 0], [0, 0, 1], kind)], points, 0.6)
    assert -0.1 < float(state.position[:, 2].min()) < 0.12
    assert float(state.position[:, 2].max()) > 0.25


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_plane_does_not_act_on_the_free_side(formulation):
    """One far below leaves free fall alone."""
    points = _block(low=(0, 0, 1.0))
    state = _run(formulation, [Plane([0, 0, -5], [0, 0, 1], "sticky")], points, 0.2)
    free = _run(formulation, [], points, 0.2)
    torch.testing.assert_close(state.position, free.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_slip_slides_and_sticky_sticks(formulation):
    """PhysGaussian's slip planes stick; ours keep the tangential speed."""
    points = _block(low=(0, 0, 0.05))
    velocity = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand_as(points.position)
    speed = {}
    for kind, friction in (("slip", 0.0), ("separate", 0.0), ("separate", 0.6), ("sticky", 0.0)):
        state = _run(formulation, [Plane([0, 0, 0], [0, 0, 1], kind, friction)], points, 0.4, velocity)
        speed[kind, friction] = float(state.velocity[:, 0].mean())
    assert speed["slip", 0.0] == pytest.approx(1.0, abs=1e-6)
    assert speed["separate", 0.0] == pytest.approx(1.0, abs=1e-6)
    assert speed["separate", 0.6] < 0.5
    assert abs(speed["sticky", 0.0]) < 0.5


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_block_slides_down_an_incline_with_coulombs_acceleration(formulation):
    """Static below the friction angle; a = g (sin - mu cos) above. Gravity is tilted instead of the plane."""
    angle, points = math.radians(30), _block()
    gravity = (9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle))
    seconds = 0.4
    for friction in (0.2, 1.0):
        # the lowest nodes are in contact from the start, so nothing bounces
        plane = Plane([0, 0, 0.06], [0, 0, 1], "separate", friction)
        state = _run(formulation, [plane], points, seconds, gravity=gravity)
        expected = 9.8 * seconds * max(math.sin(angle) - friction * math.cos(angle), 0.0)
        assert float(state.velocity[:, 0].mean()) == pytest.approx(expected, abs=0.12 * 9.8 * seconds * math.sin(angle))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_enclosing_box_keeps_everything_in(formulation):
    points = _block(low=(0.3, 0.3, 0.3))
    velocity = torch.tensor([4.0, -3.0, 2.0], dtype=torch.float64).expand_as(points.position)
    box = EnclosingBox([0, 0, 0], [1, 1, 1])
    state = _run(formulation, [box], points, 1.0, velocity)
    # contact is resolved to one cell
    assert float(state.position.min()) > -0.1
    assert float(state.position.max()) < 1.1


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_velocity_box_drives_what_is_inside_and_nothing_else(formulation):
    inside, outside = _block(low=(0, 0, 0)), _block(low=(3, 0, 0))
    points = MaterialPoints.join([inside, outside])
    drive = VelocityBox(Box([-0.5, -0.5, -0.5], [1.5, 1, 1]), [0.5, 0.0, 0.0])
    state = _run(formulation, [drive], points, 0.2, gravity=(0, 0, 0))
    half = inside.count
    torch.testing.assert_close(state.velocity[:half, 0], torch.full((half,), 0.5, dtype=torch.float64))
    assert float(state.velocity[half:].abs().max()) == 0.0


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    "make",
    [
        lambda start, end: PinnedRegion(Sphere([0.2, 0.2, 0.2], 2.0), start=start, end=end),
        lambda start, end: Handle(Sphere([0.2, 0.2, 0.2], 2.0), start=start, end=end),
        lambda start, end: Plane([0, 0, 5], [0, 0, 1], "sticky", start=start, end=end),
        lambda start, end: Plane([0, 0, 5], [0, 0, 1], "slip", start=start, end=end),
        lambda start, end: Plane([0, 0, 5], [0, 0, 1], "separate", 0.4, start=start, end=end),
        lambda start, end: VelocityBox(Box([-9, -9, -9], [9, 9, 9]), [0, 0, 0], start=start, end=end),
        lambda start, end: EnclosingBox([-9, -9, 5], [9, 9, 9], "sticky", start=start, end=end),
        lambda start, end: EnclosingBox([-9, -9, 5], [9, 9, 9], "slip", 0.4, start=start, end=end),
        lambda start, end: EnclosingBox([-9, -9, 5], [9, 9, 9], "separate", start=start, end=end),
    ],
    ids=["pin", "handle", "sticky", "slip", "friction", "velocity", "box-sticky", "box-slip", "box-separate"],
)
def test_time_windows(formulation, make):
    """Each of these stops everything: so the block falls only while the window is closed."""
    points = _block()
    assert float(_run(formulation, [make(0.0, 0.1)], points, 0.1).velocity.abs().max()) == 0.0
    falling = torch.full((216,), -0.98, dtype=torch.float64)
    released = _run(formulation, [make(0.0, 0.1)], points, 0.2)
    torch.testing.assert_close(released.velocity[:, 2], falling, rtol=1e-6, atol=0)
    later = _run(formulation, [make(0.1, None)], points, 0.1)
    torch.testing.assert_close(later.velocity[:, 2], falling, rtol=1e-6, atol=0)
    assert float(_run(formulation, [make(0.1, None)], points, 0.12).velocity.abs().max()) < 1e-14


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_an_impulse_does_not_move_what_is_pinned(formulation):
    """Whichever of the two was given first."""
    points, ends = _block(), []
    pin = PinnedRegion(Box([None, None, 0.34], [None, None, None]))
    knock = Impulse(Box([None] * 3, [None] * 3), [0.5, 0.0, 0.0], end=0.02)
    for boundaries in ([pin, knock], [knock, pin]):
        ends.append(_run(formulation, boundaries, points, 0.04, gravity=(0, 0, 0)).position)
    torch.testing.assert_close(ends[0], ends[1], rtol=0, atol=0)
    assert float((ends[0] - points.position).abs().max()) > 1e-4


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_pin_holds_only_its_end(formulation):
    points = _block()
    pin = PinnedRegion(Box([None, None, 0.34], [None, None, None]))
    state = _run(formulation, [pin], points, 0.3)
    held = points.position[:, 2] > 0.34
    moved = (state.position - points.position).norm(dim=-1)
    assert float(moved[held].max()) < 0.01
    # the static sag of a rod this long is 2 to 4 mm; `updated` holds all nodes that the pinned layer touches
    assert float(moved[~held].max()) > 0.001


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
@pytest.mark.parametrize("friction", [0.0, 0.7])
def test_plane_and_box_leave_alone_what_is_near_but_free(formulation, kind, friction):
    """Less than 1.5 cells away and coming closer, yet no node at or behind the plane: a rigid flight."""
    points = _block(low=(0.16, 0.16, 0.16), per_side=4)
    low, high = 0.05, 0.65
    plane = Plane([0, 0, low], [0, 0, 2], kind, friction)
    ceiling = Plane([0, 0, high], [0, 0, -1], kind, friction)
    for boundary in (plane, ceiling, EnclosingBox([low] * 3, [high] * 3, kind, friction)):
        for sign in (1.0, -1.0):
            velocity = sign * torch.tensor([0.3, -0.2, 0.25], dtype=torch.float64).expand_as(points.position)
            state = _run(formulation, [boundary], points, 0.04, velocity, gravity=(0, 0, 0))
            torch.testing.assert_close(state.velocity, velocity, rtol=0, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    "make", [Plane, lambda _, n, *a: EnclosingBox([-9, -9, 0.11 if n[2] > 0 else -9], [9] * 3, *a)]
)
def test_separate_lets_go_of_what_moves_away_and_slip_does_not(formulation, make):
    points = _block(low=(0, 0, 0.05))
    low = 0.11  # behind it lie the lowest nodes of either formulation
    velocity = torch.tensor([0.3, 0.0, 1.0], dtype=torch.float64).expand_as(points.position)

    def run(kind, friction=0.0):
        boundary = make([0, 0, low], [0, 0, 1], kind, friction)
        return _run(formulation, [boundary], points, 0.02, velocity, gravity=(0, 0, 0)).velocity

    torch.testing.assert_close(run("separate"), velocity, rtol=0, atol=1e-12)
    torch.testing.assert_close(run("separate", 0.8), velocity, rtol=0, atol=1e-12)
    slip = run("slip")
    assert float(slip[:, 2].mean()) < 0.8
    assert float(slip[:, 0].mean()) == pytest.approx(0.3, rel=1e-9)
    assert float(run("slip", 0.8)[:, 0].mean()) < 0.29  # what it takes away along the normal, it rubs with
    assert float(run("sticky").mean(0)[0]) < 0.29


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_velocity_box_drives_only_its_side(formulation):
    """Two lone particles on either side of a face: the nodes inside are driven, the others are not."""
    points = _lone([[0.0, 0.0, 0.05], [0.0, 0.0, -0.25]])
    drive = VelocityBox(Box([-9, -9, -0.05], [9, 9, 9]), [0.5, 0.0, -0.3], start=0.02, end=0.05)
    ends = _march(MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0), boundaries=[drive]), points, 0.01, 8)
    speed = torch.stack([state.velocity for state in ends])
    assert float(speed[:, 1].abs().max()) == 0.0
    assert float(speed[:3, 0].abs().max()) == 0.0  # states 0 to 2 lie before the window
    torch.testing.assert_close(speed[3, 0], torch.tensor([0.5, 0.0, -0.3], dtype=torch.float64))


# ---- handle


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_carries_its_particles_and_the_others_follow(formulation):
    """At rest before the window; then exactly velocity * t; let go after it."""
    points = _block()
    rest, velocity = points.position, torch.tensor([0.4, -0.2, 0.3], dtype=torch.float64)
    top = rest[:, 2] > 0.3
    handle = Handle(Box([None, None, 0.3], [None] * 3), velocity.tolist(), held_share=0.0, start=0.0099, end=0.0499)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[handle], gravity=(0, 0, 0))
    dt = 2e-3
    states = _march(solver, points, dt, 50)
    for k in (1, 4, 5):
        assert float(states[k].velocity.abs().max()) == 0.0
    for k in (6, 15, 25):  # substeps 5 to 24 begin within the window
        expected = rest[top] + velocity * dt * (k - 5)
        torch.testing.assert_close(states[k].position[top], expected, rtol=0, atol=1e-13)
        torch.testing.assert_close(states[k].velocity[top], velocity.expand_as(rest[top]), rtol=0, atol=1e-13)
    first, last = (states[k].velocity[~top].mean(0) for k in (6, 25))
    assert float(last @ velocity) > max(2 * float(first @ velocity), 0.3 * float(velocity @ velocity))
    bottom = rest[:, 2] < 0.1
    assert float((states[6].velocity[bottom]).abs().max()) < 0.01 * float(velocity.norm())
    released = states[26:]
    assert float((released[0].velocity[top] - velocity).abs().max()) > 1e-3
    momenta = torch.stack([solver.momenta(state)["linear"] for state in released])
    torch.testing.assert_close(momenta, momenta[:1].expand_as(momenta), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_holds_nothing_outside_its_region(formulation):
    points = MaterialPoints.join([_block(), _block(low=(2, 0, 0))])
    handle = Handle(Box([-1, -1, -1], [1, 1, 1]), [0.5, 0.0, 0.0], [0.0, 0.0, 2.0])
    state = _run(formulation, [handle], points, 0.1, gravity=(0, 0, 0))
    far = points.position[:, 0] > 1
    assert float(state.velocity[far].abs().max()) == 0.0
    assert float((state.position - points.position)[~far].norm(dim=-1).min()) > 1e-3


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_turns_twice_without_growing(formulation):
    """720 degrees in 160 substeps. A tangent velocity would swell the block by (1 + 0.0785²)^80 = 1.64."""
    points = _block(per_side=3, side=0.3)
    axis, pivot = [1.0, 2.0, -2.0], torch.tensor([0.1, 0.3, 0.2], dtype=torch.float64)
    rate, substeps = 3.0, 160
    spin = [rate * c / 3 for c in axis]
    handle = Handle(Sphere([0, 0, 0], 9.0), angular_velocity=spin, pivot=pivot.tolist())
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[handle])
    dt = 4 * math.pi / rate / substeps
    states = _march(solver, points, dt, substeps)
    arm = points.position - pivot
    for k in (20, 50, 160):  # a quarter turn, 225 degrees, two turns
        turn = _rotation(axis, rate * dt * k)
        torch.testing.assert_close(states[k].position, pivot + arm @ turn.T, rtol=0, atol=1e-12)
        torch.testing.assert_close(states[k].F_elastic, turn.expand(27, 3, 3), rtol=0, atol=1e-11)
    torch.testing.assert_close(states[160].position, points.position, rtol=0, atol=1e-12)
    assert float((states[20].position - points.position).norm(dim=-1).max()) > 0.2


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_pivot_travels(formulation):
    """Turning and moving from a start later than zero: x = pivot + v t + R(t) (x0 - pivot)."""
    points = _block(per_side=3, side=0.3)
    pivot, velocity = torch.tensor([[0.4, 0.0, 0.1], [0.5, -1.0, 0.25]], dtype=torch.float64)
    handle = Handle(Sphere([0, 0, 0], 9.0), velocity.tolist(), [0.0, 0.0, -5.0], pivot.tolist(), start=0.1, end=9.0)
    dt = 5e-3
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[handle], gravity=(0, 0, 0))
    states = _march(solver, points, dt, 80)
    first = next(k for k, state in enumerate(states) if float(state.time) >= 0.1)
    assert torch.equal(states[first].position, points.position)
    for k in (first + 1, 80):
        seconds = dt * (k - first)
        turn = _rotation([0.0, 0.0, -1.0], 5.0 * seconds)
        expected = pivot + velocity * seconds + (points.position - pivot) @ turn.T
        torch.testing.assert_close(states[k].position, expected, rtol=0, atol=1e-12)
    assert float(states[80].time) == pytest.approx(0.4)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_in_a_frame_that_scales_and_turns(formulation):
    """Region and pivot in scene units and axes; velocities in m/s, z up, and unscaled."""
    scene = torch.stack([_block(per_side=3, side=0.6).position, _block((3, 0, 0), 0.6, per_side=3).position])
    scene = scene.reshape(-1, 3) + 7.0
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    position = frame.point_to_sim(scene)
    points = MaterialPoints.create(position, volume=1e-3, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3)
    pivot, velocity = [7.1, 7.2, 6.5], torch.tensor([0.2, 0.4, -0.6], dtype=torch.float64)
    handle = Handle(Box([6, 6, 6], [8, 8, 8]), velocity.tolist(), [0.0, 0.0, 4.0], pivot)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[handle], gravity=(0, 0, 0))
    dt, steps = 4e-3, 50
    state = _march(solver, points, dt, steps, frame=frame)[-1]
    near = scene[:, 0] < 8
    assert int(near.sum()) == 27
    turn = _rotation([0.0, 0.0, 1.0], 4.0 * dt * steps)
    centre = frame.point_to_sim(torch.tensor(pivot, dtype=torch.float64))
    expected = centre + velocity * dt * steps + (position[near] - centre) @ turn.T
    torch.testing.assert_close(state.position[near], expected, rtol=0, atol=1e-12)
    assert torch.equal(state.position[~near], position[~near])


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_handle_without_any_motion_is_a_pin(formulation):
    points, region = _block(), Box([None, None, 0.3], [None] * 3)
    handle = _run(formulation, [Handle(region)], points, 0.1)
    pin = _run(formulation, [PinnedRegion(region)], points, 0.1)
    assert torch.equal(handle.position, pin.position)
    assert torch.equal(handle.F_elastic, pin.F_elastic)


# ---- impulse


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("dt", [1e-3, 1.7e-3, 3e-3])
def test_impulse_arrives_whole_whatever_the_substep(formulation, dt):
    """In proportion to the time gone by within the window; substeps that straddle its ends take their part."""
    points = _block(per_side=4)
    impulse = torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64)
    start, end = 0.0105, 0.0382
    knock = Impulse(Box([None, None, 0.2], [None] * 3), impulse.tolist(), start, end)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[knock], gravity=(0, 0, 0))
    for state in _march(solver, points, dt, math.ceil(0.05 / dt)):
        part = min(max((float(state.time) - start) / (end - start), 0.0), 1.0)
        torch.testing.assert_close(solver.momenta(state)["linear"], part * impulse, rtol=0, atol=1e-13)
        if part == 0:
            assert float(state.velocity.abs().max()) == 0.0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_impulse_shorter_than_a_substep(formulation):
    points = _block(per_side=4)
    knock = Impulse(Sphere([0, 0, 0], 9.0), [0.0, 0.0, 1.5], start=0.0123, end=0.0124)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[knock], gravity=(0, 0, 0))
    states = _march(solver, points, 2e-3, 10)
    assert float(states[6].velocity.abs().max()) == 0.0
    speed = 1.5 / float(points.mass.sum())
    for state in states[7:]:
        torch.testing.assert_close(state.velocity[:, 2], torch.full((64,), speed).double(), rtol=1e-11, atol=0)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_impulse_pushes_by_mass_and_only_its_region(formulation):
    """A far body never feels it. The others: the same change of velocity at any mass, so the moment is that of the
    impulse at the region's centre of mass."""
    near, far = _block(per_side=4), _block(low=(2, 0, 0), per_side=4)
    points = MaterialPoints.join([near, far])
    points = dataclasses.replace(points, mass=points.mass * torch.linspace(1, 3, 128, dtype=torch.float64))
    region = Box([None, None, 0.15], [1.0, None, None])
    impulse = torch.tensor([0.3, 0.1, -0.4], dtype=torch.float64)
    solver = MPMSolver(
        dx=0.1, formulation=formulation, boundaries=[Impulse(region, impulse.tolist(), 0.0, 2e-3)], gravity=(0, 0, 0)
    )
    states = _march(solver, points, 2e-3, 20)
    pushed = region.contains(points.position)
    mass, place = points.mass[pushed], points.position[pushed]
    centre = (mass[:, None] * place).sum(0) / mass.sum()
    for state in states[1:]:
        found = solver.momenta(state)
        torch.testing.assert_close(found["linear"], impulse, rtol=0, atol=1e-12)
        torch.testing.assert_close(found["angular"], torch.linalg.cross(centre, impulse), rtol=0, atol=1e-12)
        assert torch.equal(state.position[64:], points.position[64:])
    # at first only what shares nodes with the region moves, and its top, all of whose nodes are the region's, as one
    first = states[1].velocity[:64]
    assert float(first[points.position[:64, 2] < 0.06].abs().max()) < 0.3 * float(first[pushed[:64]].abs().max())
    top = first[points.position[:64, 2] > 0.3]
    torch.testing.assert_close(top, (impulse / mass.sum()).expand_as(top), rtol=1e-9, atol=0)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_scenes_of_a_batch_have_their_own_impulse_and_front(formulation):
    """The impulse is on each scene; one without a particle in the region feels none. Each front starts at its scene."""
    one = _lone([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    shifts = torch.tensor([[0, 0, 0], [3, 0, 0], [0, 0, 1]], dtype=torch.float64)
    position = torch.stack([k * one.position + shift for k, shift in zip((1, 2, 1), shifts, strict=True)])
    points = MaterialPoints.create(position, volume=1e-3, density=100.0, youngs_modulus=1e3, poisson_ratio=0.3)
    region = Box([None, None, -0.5], [None, None, 0.5])
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[Impulse(region, [1, 0, 0])], gravity=(0, 0, 0))
    states = _march(solver, points, 0.01, 5)
    expected = torch.tensor([[1.0, 0, 0], [1, 0, 0], [0, 0, 0]], dtype=torch.float64)
    torch.testing.assert_close(solver.momenta(states[-1])["linear"], expected, rtol=0, atol=1e-12)
    release = SequentialRelease(region, [1, 0, 0], 0.0, 0.04)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[release])
    fall = _march(solver, points, 0.01, 3)[-1].velocity[..., 2]
    # at 0.03 s the first of three has fallen for 3 substeps and the second, let go at 0.02 s, for 1
    counts = torch.tensor([[3.0, 1, 0], [3, 1, 0], [3, 3, 3]], dtype=torch.float64)
    torch.testing.assert_close(fall, -0.098 * counts, rtol=0, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_impulse_per_particle_grows_with_their_number(formulation):
    """And with that of each scene of a batch, whatever their mass; counted anew for another material."""
    knock = Impulse(Box([None, None, 0.2], [None] * 3), [0.01, -0.02, 0.03], end=2e-3, per_particle=True)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[knock], gravity=(0, 0, 0))
    impulse = torch.tensor([0.01, -0.02, 0.03], dtype=torch.float64)
    for per_side, count in ((4, 32), (6, 108)):  # the upper half
        end = _march(solver, _block(per_side=per_side), 2e-3, 3)[-1]
        torch.testing.assert_close(solver.momenta(end)["linear"], count * impulse, rtol=1e-12, atol=0)
    one = _lone([[0, 0, 0], [1, 0, 0.5], [2, 0, 1]])
    position = torch.stack([one.position, one.position + torch.tensor([0, 0, 5.0])])
    points = MaterialPoints.create(position, volume=1e-3, density=100.0, youngs_modulus=1e3, poisson_ratio=0.3)
    end = _march(solver, points, 2e-3, 3)[-1]
    expected = torch.stack([2 * impulse, 3 * impulse])
    torch.testing.assert_close(solver.momenta(end)["linear"], expected, rtol=1e-12, atol=0)


# ---- boxes of velocity that travel


def test_a_travelling_box_takes_its_nodes_from_where_it_is():
    """From its start on, in the metres of a frame that scales and turns; one that stays has none of it."""
    frame = SimFrame.fit(_block().position, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    box = Box([0.0, 0.0, 0.0], [0.2, 0.4, 0.4])
    drift = frame.direction_to_sim(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    move = (0.3 * drift).tolist()
    boxes = [VelocityBox(box, move, start=0.1, end=9.0, travels=travels).in_frame(frame) for travels in (True, False)]
    place = torch.rand(500, 3, dtype=torch.float64) * torch.tensor([1.0, 0.6, 0.6])
    for time in (0.1, 0.4):
        nodes = Nodes(torch.tensor(time, dtype=torch.float64), 1e-3, frame.point_to_sim(place))
        driven = [(b(torch.zeros_like(place), nodes) != 0).any(-1) for b in boxes]
        # 0.3 m/s are 0.6 scene units a second
        gone = place - torch.tensor([0.6 * (time - 0.1), 0, 0], dtype=torch.float64)
        assert torch.equal(driven[0], box.contains(gone))
        assert torch.equal(driven[1], box.contains(place))
        assert torch.equal(driven[0], driven[1]) == (time == 0.1)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_travelling_box_carries_a_block(formulation):
    """Far beyond where it began, as the box goes along; one that stays leaves the block behind."""
    region, ways = Box([-0.1, -0.1, -0.1], [0.5, 0.5, 0.5]), []
    for travels in (True, False):
        drive = VelocityBox(region, [1.0, 0.0, 0.0], end=0.8, travels=travels)
        state = _run(formulation, [drive], _block(), 0.8, gravity=(0, 0, 0), damping=5.0)
        ways.append(float((state.position - _block().position)[:, 0].mean()))
    assert ways[0] == pytest.approx(0.8, rel=1e-6)
    assert ways[1] < 0.75


# ---- sequential release


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("direction", [(2.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (1.0, 2.5, 0.0)])
def test_release_passes_over_lone_particles_in_order(formulation, direction):
    """Each falls for exactly the substeps since the front met it; what lies outside the region from the beginning."""
    points = _lone([[0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [1, 1, 0], [0, 9, 0]])
    release = SequentialRelease(Box([None] * 3, [None, 5, None]), direction, start=0.055, end=0.355)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[release])
    along = points.position[:5] @ torch.tensor(direction, dtype=torch.float64)
    part = (along - along.min()) / (along.max() - along.min())
    times = torch.cat([0.055 + 0.3 * part, torch.zeros(1).double()])
    dt = 0.01
    for k, state in enumerate(_march(solver, points, dt, 45)):
        begins = dt * torch.arange(k, dtype=torch.float64)[:, None]
        falling = (begins >= times - 1e-9).sum(0).double()
        torch.testing.assert_close(state.velocity[:, 2], -9.8 * dt * falling, rtol=0, atol=1e-10)
    assert bool((falling > 0).all())


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_release_lets_layers_of_a_block_fall_in_order(formulation, sign):
    points = _block(e=2e3)
    rest = points.position
    release = SequentialRelease(Sphere([0, 0, 0], 9.0), [sign, 0, 0], start=0.03, end=0.13)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[release])
    dt = 5e-3
    states = _march(solver, points, dt, 45)
    assert torch.equal(states[6].position, rest)
    layers = rest[:, 0].unique()
    layers = layers if sign > 0 else layers.flip(0)
    drop = torch.stack([(rest - states[24].position)[rest[:, 0] == x, 2].mean() for x in layers])
    assert bool((drop[:-1] > drop[1:] - 1e-15).all())
    assert float(drop[0]) > 0.01
    assert float(drop[-1]) < 1e-3
    # past the end nothing is held: the whole gains momentum at the rate of its weight
    gained = solver.momenta(states[45])["linear"] - solver.momenta(states[28])["linear"]
    weight = torch.tensor([0.0, 0.0, -9.8], dtype=torch.float64) * points.mass.sum()
    torch.testing.assert_close(gained, weight * dt * 17, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_release_turns_with_its_frame(formulation):
    """The scene's y points up: a front along scene y climbs in z; one along simulation y would meet all at once."""
    scene = torch.tensor([[0, 0, 0], [0, 2, 0], [0, 4, 0]], dtype=torch.float64)
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    points = _lone(frame.point_to_sim(scene).tolist())
    assert float(points.position[2, 2] - points.position[0, 2]) == pytest.approx(2.0)
    release = SequentialRelease(Box([-1, -1, -1], [1, 3, 1]), [0.0, 1.0, 0.0], start=0.015, end=0.035)
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[release])
    end = _march(solver, points, 0.01, 5, frame=frame)[-1]
    falling = torch.tensor([3.0, 1.0, 5.0], dtype=torch.float64)  # the third lies outside the region
    torch.testing.assert_close(end.velocity[:, 2], -0.098 * falling, rtol=0, atol=1e-12)


def test_release_of_a_single_layer_is_at_its_start():
    release = SequentialRelease(Sphere([0, 0, 0], 9.0), [0, 0, 1], start=0.25, end=2.0)
    assert release.release_time(torch.rand(5, 3) * torch.tensor([1.0, 1, 0])).tolist() == [0.25] * 5


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.0, -1.0, 0.0)])
def test_release_between_given_points(up):
    """The front meets them at its start and end, in whatever frame, and nothing depends on who is there."""
    scene = torch.tensor([[-1.0, 5, 0], [0.5, 0, 1], [1.0, 2, 9], [2.0, 0, 0], [3.5, 0, 0]], dtype=torch.float64)
    frame = SimFrame.fit(scene, up=up, metres_per_unit=0.5)
    release = SequentialRelease(
        Sphere([0, 0, 0], 99.0), [2.0, 0, 0], start=1.0, end=3.0, first=[0, 0, 0], last=[2, 7, 7]
    ).in_frame(frame)
    expected = [0.0, 1.5, 2.0, 3.0, 4.5]
    assert release.release_time(frame.point_to_sim(scene)).tolist() == pytest.approx(expected)
    assert release.release_time(frame.point_to_sim(scene[1:2])).tolist() == pytest.approx([1.5])


# ---- all of them

CONDITIONS = {
    "pin": lambda r: PinnedRegion(r, end=0.5),
    "handle": lambda r: Handle(r, [0.1, 0.0, 0.0], [0.0, 0.0, 1.0], [0.1, 0.2, 0.3], end=0.5),
    "release": lambda r: SequentialRelease(r, [0.0, 1.0, 0.0], end=0.5),
    "front": lambda r: SequentialRelease(r, [0.0, 1.0, 0.0], end=0.5, first=[0.0, -0.3, 0.1], last=[0.2, 0.9, 0.3]),
    "impulse": lambda r: Impulse(r, [0.1, 0.2, 0.3], end=0.5),
    "impulse-each": lambda r: Impulse(r, [0.01, 0.02, 0.03], end=0.5, per_particle=True),
    "plane": lambda r: Plane([0.11, 0.12, 0.23], [0.0, 1.0, 1.5], "slip", 0.3, end=0.5),
    "box": lambda r: EnclosingBox([-0.13, 0.07, 0.13], [0.33, 0.43, 0.51], "separate", 0.3, end=0.5),
    "velocity": lambda r: VelocityBox(r, [0.1, 0.2, 0.3], end=0.5),
    "velocity-travels": lambda r: VelocityBox(r, [0.1, 0.2, 0.3], end=0.5, travels=True),
}


REGIONS = {
    "everything": Everything(),
    "box": Box([None, 0.1, 0.23], [0.35, None, None]),
    "sphere": Sphere([0.1, 0.2, 0.2], 0.2),
    "cylinder": Cylinder([0.2, 0.2, 0.2], [1.0, 2.0, 0.5], 0.15, 0.3),
    "union": Union([Sphere([0.1, 0.1, 0.1], 0.15), Box([0.2, 0.2, 0.2], [0.4, 0.4, 0.4])]),
    "not": Not(Cylinder([0.2, 0.2, 0.2], [0.0, 0.0, 1.0], 0.15, 0.3)),
}
# every condition, and the one that asks for a region in each substep over each kind of region
ACTING = CONDITIONS | {
    f"velocity-{name}": lambda _, region=region: VelocityBox(region, [0.1, 0.2, 0.3], end=0.5)
    for name, region in REGIONS.items()
}


def _acting(name, device, dtype=torch.float64):
    """A condition in the metres of some frame, and the velocities and nodes that it acts on."""
    generator = torch.Generator().manual_seed(3)
    position = torch.rand(200, 3, generator=generator, dtype=torch.float64) * 0.6 - 0.1
    frame = SimFrame.fit(position, up=(0.2, 1.0, 0.3), metres_per_unit=2.0)
    place = frame.point_to_sim(position).to(device, dtype)
    nodes = Nodes(
        time=torch.tensor(0.1, dtype=torch.float64, device=device),
        dt=2e-3,
        position=place,
        lattice=place + 0.01,
        share=torch.rand(200, generator=generator, dtype=torch.float64).to(device, dtype),
        threshold=0.5,
        held_mass=torch.tensor(0.7, device=device, dtype=dtype),
    )
    velocity = torch.randn(200, 3, generator=generator, dtype=torch.float64).to(device, dtype)
    return ACTING[name](Box([None, None, 0.23], [None] * 3)).in_frame(frame).to(device), velocity, nodes


@pytest.mark.parametrize("name", ACTING)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_substep_may_be_a_tensor(name, dtype):
    boundary, velocity, nodes = _acting(name, "cpu", dtype)
    known = boundary(velocity, nodes)
    found = boundary(velocity, dataclasses.replace(nodes, dt=torch.tensor(nodes.dt, dtype=torch.float64)))
    assert found.dtype == dtype
    torch.testing.assert_close(found, known, rtol=1e-12 if dtype == torch.float64 else 1e-6, atol=0)
    assert not torch.equal(found, velocity)
    if name in ("handle", "impulse", "impulse-each"):  # what depends on the substep
        longer = boundary(velocity, dataclasses.replace(nodes, dt=torch.tensor(0.3, dtype=torch.float64)))
        assert float((longer - known).abs().max()) > 1e-3


@pytest.mark.parametrize("name", ACTING)
def test_a_condition_makes_its_constants_once(name, monkeypatch):
    boundary, velocity, nodes = _acting(name, "cpu")
    known = boundary(velocity, nodes)

    def refuse(*_, **__):
        raise AssertionError("made from numbers of the host")

    for place, function in ((torch, "tensor"), (torch, "as_tensor"), (torch.Tensor, "new_tensor")):
        monkeypatch.setattr(place, function, refuse)
    assert torch.equal(boundary(velocity, nodes), known)


@pytest.mark.gpu
@pytest.mark.parametrize("name", ACTING)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_recorded_condition_follows_time_and_substep(name, dtype):
    """One CUDA graph for any time and any substep; nothing in it waits for the host or copies from it."""
    boundary, velocity, nodes = _acting(name, "cuda", dtype)
    nodes = dataclasses.replace(nodes, dt=torch.full_like(nodes.time, 1e-3))
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        boundary(velocity, nodes)
        torch.cuda.set_sync_debug_mode("error")
        try:
            boundary(velocity, nodes)
        finally:
            torch.cuda.set_sync_debug_mode("default")
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        recorded = boundary(velocity, nodes)
    seen = []
    for time, dt in ((0.0, 1e-3), (0.2, 4e-3), (0.499, 2e-2), (0.7, 1e-3)):
        nodes.time.fill_(time)
        nodes.dt.fill_(dt)
        graph.replay()
        now = dataclasses.replace(nodes, time=torch.full_like(nodes.time, time), dt=dt)
        torch.testing.assert_close(recorded, boundary(velocity, now), rtol=1e-6, atol=1e-7)
        seen.append(recorded.clone())
    assert not torch.equal(seen[0], velocity)
    if name not in ("release", "front"):  # which the solver, not the condition, lets go
        assert torch.equal(seen[3], velocity)


@pytest.mark.parametrize("name", CONDITIONS)
def test_in_frame_leaves_the_original_alone(name):
    """Nor is the one in metres changed by a second frame, or by its original moving to another type."""
    scene = _block().position
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=3.0)
    region = Box([None, None, 0.23], [None] * 3)
    boundary = CONDITIONS[name](region)

    def values(condition):
        return {key: value.clone() for key, value in condition.state_dict().items()}

    before = values(boundary)
    moved = boundary.in_frame(frame)
    inside = values(moved)
    again = boundary.in_frame(frame)
    for known, now in ((before, boundary), (inside, moved), (inside, again)):
        found = values(now)
        assert found.keys() == known.keys()
        assert all(torch.equal(known[key], found[key]) for key in known)
    assert (moved.start, moved.end) == (0.0, 0.5)
    assert type(moved) is type(boundary)
    if hasattr(boundary, "region"):
        assert boundary.region is region
        assert torch.equal(moved.region.contains(frame.point_to_sim(scene)), region.contains(scene))
    else:
        assert any(not torch.equal(before[key], inside[key]) for key in before)
    assert all(torch.equal(value, values(boundary)[key]) for key, value in before.items())


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("name", CONDITIONS)
def test_conditions_can_be_copied_saved_and_narrowed(name, formulation):
    """A deep copy and one that loads the state dict do the same, bit for bit; float32 the same to round-off."""
    points = _block(per_side=5)
    region = Box([None, None, 0.23], [None] * 3)
    boundary = CONDITIONS[name](region)
    run = {"dx": 0.1, "formulation": formulation}
    known = _march(MPMSolver(**run, boundaries=[boundary]), points, 2e-3, 6)[-1]
    twin = copy.deepcopy(boundary)
    for tensor in boundary.buffers():
        tensor.zero_()
    assert torch.equal(_march(MPMSolver(**run, boundaries=[twin]), points, 2e-3, 6)[-1].position, known.position)
    loaded = MPMSolver(**run, boundaries=[boundary])
    loaded.load_state_dict(MPMSolver(**run, boundaries=[twin]).state_dict())
    assert torch.equal(_march(loaded, points, 2e-3, 6)[-1].position, known.position)
    assert float((known.position - _march(MPMSolver(**run), points, 2e-3, 6)[-1].position).abs().max()) > 1e-5

    loaded.init_state(points)
    narrow = loaded.to(torch.float32)
    end = _march(narrow, points.map(lambda t: t.float()), 2e-3, 6)[-1]
    assert end.position.dtype == torch.float32
    torch.testing.assert_close(end.position.double(), known.position, rtol=0, atol=2e-6)


@pytest.mark.parametrize("name", ["pin", "handle", "release", "front", "impulse", "impulse-each"])
@pytest.mark.parametrize("framed", [False, True])
def test_region_that_holds_nothing_names_its_condition(name, framed):
    boundary, points = CONDITIONS[name](Sphere([9, 9, 9], 0.1)), _block(low=(0.2, 0.2, 0.2), side=0.2)
    frame = SimFrame.fit(points.position, metres_per_unit=2.0) if framed else None
    if framed:
        points = dataclasses.replace(points, position=frame.point_to_sim(points.position))
    # where the particles are, in the units in which the region was given
    where = r"\[0.2167, 0.2167, 0.2167\] and \[0.3833, 0.3833, 0.3833\]"
    kind = type(boundary).__name__
    message = rf"region Sphere.* of the {kind} holds no particle: .* between {where}; move or enlarge `region`"
    with pytest.raises(ValueError, match=message):
        MPMSolver(dx=0.1, boundaries=[boundary]).init_state(points, frame=frame)


@pytest.mark.parametrize("kind", [PinnedRegion, Handle, SequentialRelease])
def test_share_that_no_node_reaches_names_its_condition(kind):
    """One particle among many at a node: it holds less than the share."""
    pin = kind(Sphere([0.2333, 0.2333, 0.2333], 0.03), held_share=0.9)
    with pytest.raises(ValueError, match=rf"no grid node.*`region` of the {kind.__name__} or lower its `held_share`"):
        MPMSolver(dx=0.4, boundaries=[pin]).init_state(_block())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane([0, 0, 0], [0, 0, 0]), "`normal` of the plane not to be zero"),
        (lambda: Plane([0, 0, 0], [0, 0, 1], "glue"), "`kind` to be one of sticky, slip, separate"),
        (lambda: Plane([0, 0], [0, 0, 1]), "`point` to have 3 numbers"),
        (lambda: Plane([0, 0, 0], [0, 0, 1], friction=-1), "`friction` to not be negative"),
        (lambda: Plane([0, 0, 0], [0, 0, 1], start=2.0, end=1.0), "`end` to be later than `start`"),
        (lambda: EnclosingBox([0, 0, 0], [1, 0, 1]), "`min` of the box below `max`"),
        (lambda: VelocityBox(Sphere([0, 0, 0], 1), [1, 2]), "`velocity` to have 3 numbers"),
        (lambda: PinnedRegion(Sphere([0, 0, 0], 1), held_share=1.0), "`held_share` to lie in"),
        (lambda: Handle(Sphere([0, 0, 0], 1), held_share=-0.1), "`held_share` to lie in"),
        (lambda: SequentialRelease(Sphere([0, 0, 0], 1), held_share=1.5), "`held_share` to lie in"),
        (lambda: Handle(Sphere([0, 0, 0], 1), [1, 2]), "`velocity` to have 3 numbers"),
        (lambda: Handle(Sphere([0, 0, 0], 1), angular_velocity=[1, 2]), "`angular_velocity` to have 3 numbers"),
        (lambda: Handle(Sphere([0, 0, 0], 1), pivot=[1, 2, 3, 4]), "`pivot` to have 3 numbers"),
        (lambda: Handle(Sphere([0, 0, 0], 1), [1, 2, math.nan]), "`velocity` to be finite"),
        (lambda: Handle(Sphere([0, 0, 0], 1), start=1.0, end=1.0), "`end` to be later than `start`"),
        (lambda: SequentialRelease(Sphere([0, 0, 0], 1), [0, 0, 0]), "`direction` of the SequentialRelease not to be"),
        (lambda: SequentialRelease(Sphere([0, 0, 0], 1), [1, 0]), "`direction` to have 3 numbers"),
        (lambda: SequentialRelease(Sphere([0, 0, 0], 1), end=None), "`end` of the SequentialRelease .* finite time"),
        (lambda: SequentialRelease(Sphere([0, 0, 0], 1), first=[0, 0, 0]), "both `first` and `last`"),
        (
            lambda: SequentialRelease(Sphere([0, 0, 0], 1), [0, 0, 1], first=[0, 0, 1], last=[5, 0, 1]),
            "`last` of the SequentialRelease farther along",
        ),
        (lambda: Impulse(Sphere([0, 0, 0], 1), [1, 0, 0], end=None), "`end` of the Impulse to be a finite time"),
        (lambda: Impulse(Sphere([0, 0, 0], 1), [1, 0, 0], end=math.inf), "`end` of the Impulse to be a finite time"),
        (lambda: Impulse(Sphere([0, 0, 0], 1), [1, 0]), "`impulse` to have 3 numbers"),
        (lambda: Impulse(Sphere([0, 0, 0], 1), [1, 0, 0], start=1.0), "`end` to be later than `start`"),
    ],
)
def test_bad_boundaries_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
