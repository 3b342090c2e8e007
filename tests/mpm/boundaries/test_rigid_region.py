"""A rigid part keeps its shape and its momenta, moves what is attached to it, and is moved by it."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import curve_fit
from shared import ZERO, beyond, double, in_both, longest, near, peak, solid, turned_by, up_to, value_error
from torch.testing import assert_close

from gaussian_swaying import Box, MPMSolver, PinnedPoints, PinnedRegion
from gaussian_swaying.geometry.regions import Everything, HalfSpace, Union
from gaussian_swaying.mpm.colliders import Obstacle
from gaussian_swaying.mpm.pins import RigidRegion

RIGHT = beyond(x=0.2)


def bar(*boundaries, formulation="total", transfer="auto", dx=0.05, dtype=torch.float64, gravity=(0, 0, -9.8), **other):
    """A bar of 0.4 m along x, and its solver."""
    h = dx / 2
    count = [round(length / h) for length in (0.4, 0.1, 0.1)]
    place = torch.cartesian_prod(*[(torch.arange(n).double() + 0.5) * h for n in count])
    points = solid(place.to(dtype), h**3, 300.0, 2e4, **other)
    return points, MPMSolver(dx, formulation, gravity=gravity, transfer=transfer, boundaries=boundaries)


def advance(solver, state, seconds, frames=10):
    for _ in range(frames):
        state = solver.fit_grid(state, seconds / frames, 1)
        count = solver.substeps(state, seconds / frames)
        state = solver.rollout(state, seconds / frames / count, count)
    return state


def right(points):
    return points.position[..., 0] > 0.2


def strain(F):
    return float(peak(F.mT @ F - torch.eye(3, dtype=F.dtype)))


@pytest.mark.parametrize(
    ("transfer", "dtype"), [("torch", torch.float64), ("kernels", torch.float64), ("kernels", torch.float32)], ids=str
)
@in_both
def test_a_free_part_keeps_momenta_energy_and_shape(formulation, transfer, dtype):
    """It turns about no axis of its own, so that the axis of its rotation moves: 1,000 substeps, 1.4 turns.

    Torch, which is slow, takes 300 of them. In single precision it drifts by rounding only.
    """
    options = {"formulation": formulation, "transfer": transfer, "gravity": (0, 0, 0), "dtype": dtype}
    points, solver = bar(RigidRegion(Everything()), **options)
    arm = points.position - points.position.mean(0)
    spin = torch.tensor([3.0, 8.0, 1.0], dtype=dtype).expand_as(arm)
    velocity = torch.tensor([1.0, 0.5, 0.0], dtype=dtype) + torch.linalg.cross(spin, arm, dim=-1)
    state = solver.rollout(solver.init_state(points, velocity, margin=2), 1e-3, 1)
    momenta, energy = solver.momenta(state), solver.energies(state)["kinetic"]
    distance, errors = torch.pdist(points.position.double()), []
    rounding = 1.0 if dtype == torch.float64 else 1e7
    for _ in range(3 if transfer == "torch" else 10):
        state = solver.rollout(solver.fit_grid(state, 0.1), 1e-3, 100)
        errors.append(float(peak(torch.pdist(state.position.double()) - distance)))
        assert strain(state.F_total) < 1e-13 * rounding
        assert torch.linalg.det(state.F_total).min() > 0
    assert max(errors) < (1e-13 if rounding == 1 else 1e-5)  # nor do they grow
    for name, value in solver.momenta(state).items():
        assert_close(value, momenta[name], rtol=1e-10 if rounding == 1 else 1e-4, atol=1e-10 if rounding == 1 else 1e-6)
    assert float(solver.energies(state)["kinetic"] / energy) == pytest.approx(1.0, abs=1e-6 if rounding == 1 else 1e-4)
    assert float(solver.energies(state)["elastic"]) < 1e-12 * rounding


@in_both
def test_half_of_a_bar_pulls_at_the_other(formulation):
    """The rigid half keeps its shape, the soft half bends, both fly on with the momenta of both together."""
    points, solver = bar(RigidRegion(RIGHT), formulation=formulation, gravity=ZERO)
    own = right(points)
    velocity = torch.where(own[:, None], double([0.0, 0.0, 1.0]), 0.0)
    state = solver.rollout(solver.init_state(points, velocity, margin=4), 1e-4, 1)
    before = solver.momenta(state)
    state = advance(solver, state, 0.2)
    for name, value in solver.momenta(state).items():
        assert_close(value, before[name], rtol=1e-9, atol=1e-10)
    assert strain(state.F_total[own]) < 1e-12
    assert strain(state.F_total[~own]) > 1e-3
    assert state.velocity[~own, 2].mean() > 0.2  # it is taken along
    gap = (state.position[own, 0].min() - state.position[~own, 0].max()).abs()
    assert float(gap) < 0.05  # and does not tear off


@in_both
def test_a_part_next_to_a_held_one_stays(formulation):
    pin = PinnedRegion(up_to(x=0.1), "nodes")
    points, solver = bar(RigidRegion(Box([0.1, None, None], [0.3, None, None])), pin, formulation=formulation)
    state = advance(solver, solver.init_state(points), 0.3)
    moved = (state.position - points.position).norm(dim=-1)
    assert moved[points.position[:, 0] < 0.3].max() < 1e-7
    assert moved[points.position[:, 0] > 0.3].max() > 1e-3


def test_a_pin_of_no_kind_holds_the_nodes_of_a_rigid_part():
    points, solver = bar(PinnedRegion(beyond(x=0.3)), RigidRegion(RIGHT))
    state = advance(solver, solver.init_state(points), 0.2)
    assert solver.bound.kinds == ("nodes", "nodes")
    assert peak((state.position - points.position)[right(points)]) < 1e-7
    assert longest((state.position - points.position)[~right(points)]) > 1e-2


@in_both
def test_a_handle_leads_the_whole_part(formulation):
    handle = PinnedRegion(beyond(x=0.3), "nodes", angular_velocity=[0, 0, 2.0], pivot=[0.4, 0, 0])
    points, solver = bar(RigidRegion(RIGHT), handle, formulation=formulation, gravity=ZERO)
    state = advance(solver, solver.init_state(points), 0.25)
    turn = turned_by(math.degrees(0.5))
    pivot = double([0.4, 0, 0])
    wanted = pivot + (points.position - pivot) @ turn.mT
    near(state.position[right(points)], wanted[right(points)], 1e-5)
    near(state.F_total[right(points)], turn.expand(int(right(points).sum()), 3, 3), 1e-4)


@in_both
def test_it_has_gradients(formulation):
    pin = PinnedRegion(up_to(x=0.1), "nodes")

    def height(E):
        points, solver = bar(RigidRegion(RIGHT), pin, formulation=formulation, dx=0.1)
        points = points.map(lambda x: x)
        object.__setattr__(points, "youngs_modulus", E.expand(points.mass.shape))
        state = solver.init_state(points, margin=3)
        return solver.rollout(state, 1e-3, 40).position[right(points), 2].mean()

    E = double(2e4).requires_grad_()
    (slope,) = torch.autograd.grad(height(E), E)
    with torch.no_grad():
        difference = (height(E + 20) - height(E - 20)) / 40
    assert float(slope) == pytest.approx(float(difference), rel=1e-3)
    assert float(slope) != 0


def pendulum(dx):
    """A box of 2 kg on a cord of 1 m, which is clamped in a wall: the period, and that of theory [s]."""
    half, width, E, mass = 0.1, 0.03, 2e5, 2.0
    count = round(3 / dx)
    above, side = round(0.3 * count), round(6 * half / dx)
    down = -(torch.arange(-above, count, dtype=torch.float64) + 0.5) / count
    across = double([-1.0, 1.0]) * width / 2 / 3**0.5
    inside = ((torch.arange(side).double() + 0.5) / side * 2 - 1) * half
    cord, box = torch.cartesian_prod(across, across, down), torch.cartesian_prod(inside, inside, inside)
    place = torch.cat([cord, box + torch.tensor([0, 0, -1 - half])])
    sizes = [len(cord), len(box)]
    volume = torch.repeat_interleave(torch.tensor([width**2 / count / 4, (2 * half / side) ** 3]), torch.tensor(sizes))
    density = torch.repeat_interleave(torch.tensor([100.0, mass / (2 * half) ** 3]), torch.tensor(sizes))
    points = solid(place, volume.double(), density.double(), E, 0.0)
    wall, body = beyond(z=0.0), up_to(z=-1.0)
    boundaries = [PinnedRegion(wall, "clamp"), RigidRegion(body)]
    hanging = MPMSolver(dx, damping=8.0, boundaries=boundaries, gravity=(0, 0, -9.81))
    state = advance(hanging, hanging.init_state(points), 1.0)
    solver = MPMSolver(dx, boundaries=boundaries, gravity=(0, 0, -9.81))
    solver.init_state(points)
    node = state.grid.node_positions(place) + state.node_displacement
    push = torch.zeros_like(node)
    push[:, 0] = -0.3 * node[:, 2].clamp(max=0)
    state = state.replace(node_velocity=push)
    times, across, lengths = [], [], []
    for _ in range(60):
        state = advance(solver, state, 0.05, 1)
        middle = state.position[len(cord) :].mean(0)
        times.append(float(state.time))
        across.append(float(middle[0]))
        lengths.append(float(middle.norm()))
    (_, rate, _), _ = curve_fit(
        lambda t, a, w, p: a * np.cos(w * t + p), np.array(times), np.array(across), p0=[0.1, 3, 1.5]
    )
    # a double pendulum; the cord is clamped at both ends, as if it began the length sqrt(EI / T) farther in
    bent = math.sqrt(E * width**4 / 12 / (mass * 9.81))
    cord_length, arm = sum(lengths) / len(lengths) - half - 2 * bent, half + bent
    inertia = mass * double([[cord_length**2, cord_length * arm], [cord_length * arm, arm**2 + (2 * half) ** 2 / 6]])
    pull = mass * 9.81 * torch.diag(double([cord_length, arm]))
    lowest = torch.linalg.eigvals(torch.linalg.solve(inertia, pull)).real.min()
    return 2 * math.pi / abs(rate), 2 * math.pi / float(lowest) ** 0.5


@pytest.mark.slow(gate=["0.1"])
@pytest.mark.parametrize("dx", [0.1, 0.05])
def test_a_box_on_a_cord_is_a_pendulum(dx):
    found, theory = pendulum(dx)
    assert found == pytest.approx(theory, rel=0.02)


def test_what_cannot_be_is_refused():
    points, solver = bar(RigidRegion(RIGHT), RigidRegion(Box([0.1, None, None], [0.2, None, None])))
    with value_error("Two rigid parts touch"):
        solver.init_state(points)
    parts = Union([RIGHT, Box([0.1, None, None], [0.2, None, None])])
    bar(RigidRegion(parts))[1].init_state(points)
    for pin in (PinnedRegion(beyond(x=0.3), "clamp"), PinnedPoints([[0.35, 0.05, 0.05]])):
        points, solver = bar(RigidRegion(RIGHT), pin)
        with value_error("points of a rigid part"):
            solver.init_state(points)
    with pytest.raises(TypeError, match="start"):
        RigidRegion(RIGHT, start=0.1)  # it is rigid all the time
    with value_error("holds no particle"):
        bar(RigidRegion(Box([9.0] * 3, [10.0] * 3)))[1].init_state(points)


def test_in_total_a_part_falls_on_the_ground_and_rests_there():
    ground = Obstacle(HalfSpace([0.0, 0.0, -0.03], [0.0, 0.0, 1.0]), 0.5)
    points, solver = bar(ground, RigidRegion(Everything()))
    state = advance(solver, solver.init_state(points), 0.4)
    before = state.position
    state = advance(solver, state, 0.3)
    assert peak(state.position - before) < 2e-4
    assert -0.045 < state.position[:, 2].min() < -0.02
    assert strain(state.F_total) < 1e-12


def test_in_updated_parts_may_meet():
    left = up_to(x=0.2)
    points, solver = bar(RigidRegion(left), RigidRegion(RIGHT), formulation="updated", gravity=ZERO)
    velocity = torch.where(right(points)[:, None], double([-1.0, 0.0, 0.0]), 0.0)
    state = solver.init_state(points, velocity, margin=4)
    before = solver.momenta(state)["linear"]
    state = advance(solver, state, 0.1)
    assert_close(solver.momenta(state)["linear"], before, rtol=1e-9, atol=1e-10)
    assert state.velocity[~right(points), 0].max() < -0.3  # it is pushed
    for own in (right(points), ~right(points)):
        near(torch.pdist(state.position[own]), torch.pdist(points.position[own]), 1e-12)


def test_a_part_that_becomes_rigid_on_the_way_takes_its_shape_again():
    points, soft = bar(PinnedRegion(up_to(x=0.1), "nodes"))
    state = advance(soft, soft.init_state(points), 0.2)
    assert strain(state.F_total[right(points)]) > 1e-3
    _, rigid = bar(PinnedRegion(up_to(x=0.1), "nodes"), RigidRegion(RIGHT))
    after = rigid.continued(soft, state, rigid.init_state(points))
    after = advance(rigid, after, 0.1)
    assert strain(after.F_total[right(points)]) < 1e-12
    distance = torch.pdist(points.position[right(points)])
    found = torch.pdist(after.position[right(points)])
    near(found, distance, 1e-12)
