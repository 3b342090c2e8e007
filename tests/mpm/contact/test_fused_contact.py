"""The kernels of contact: float32 against float64, lists and their buffers, recordings."""

import pytest
import torch
from contacts import pairs, samples
from shared import ZERO, double, peak, value_error
from torch.testing import assert_close

from gaussian_swaying import Contact, MaterialPoints, PinnedPoints
from gaussian_swaying.geometry.regions import Sphere
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.mpm import contact, contact_kernels
from gaussian_swaying.mpm.colliders import Obstacle

from .bodies import scene, sheet

DT = 1.2e-3


@pytest.mark.parametrize(
    ("arm", "normal"),
    [
        ((0.05, 0.28, 2.0), (0.0, 0.0, 1.0)),  # 0.284 from the axis of the first, high above it
        ((0.05, 0.31, -2.0), None),
        ((-2.0, 0.38, 0.05), (-1.0, 0.0, 0.0)),  # 0.383 from that of the second
        ((2.0, 0.41, 0.05), None),
        ((0.1, 0.05, 0.1), (0.5**0.5, 0.0, 0.5**0.5)),  # near both
        ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)),  # in one place: the normal of one of them
    ],
)
def test_a_disc_counts_if_the_centre_of_the_other_is_above_it(arm, normal):
    """A disc of radius 0.3 that faces z, and one of 0.4 that faces x."""
    d, first, second = double([arm, [0, 0, 1], [1, 0, 0]])
    found, above = on_tensors(contact_kernels.discs)(tuple(d), tuple(first), 0.3, tuple(second), 0.4)
    assert bool(above) == (normal is not None)
    if normal is not None:
        assert [float(number) for number in found] == pytest.approx(normal)


def _collision(device, dtype=torch.float32):
    below, above = sheet(5, 5, dtype=dtype), sheet(3, 3, (0.023, 0.017, 0.1), dtype=dtype)
    points = MaterialPoints.join([below, above]).map(lambda t: t.to(device))
    velocity = torch.zeros_like(points.position)
    velocity[below.count :] = torch.tensor([6.0, 0.0, -20.0]).to(velocity)
    pins = PinnedPoints([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0]])
    balls = [
        Obstacle(Sphere([0.04, 0.04, -0.06], 0.05), 0.4),
        Obstacle(Sphere([0.04, 0.04, -0.5], 0.05)),  # out of reach
        Obstacle(Sphere([0.0, 0.08, -0.045], 0.05), start=3.5 * DT, end=4.5 * DT),
    ]
    return points, velocity, [pins, *balls]


def _ends(device, contact, *parts, speed=1.0):
    """Positions, velocities and impulses after parts of a rollout, on a device and in float64; the first solver."""
    ends, solvers = [], []
    for place, dtype in ((device, torch.float32), ("cpu", torch.float64)):
        points, velocity, boundaries = _collision(place, dtype)
        solver, state = scene(points, contact, boundaries, velocity=speed * velocity)
        states = []
        for steps in parts:
            state = solver.rollout(state, DT, steps)
            fields = (state.position, state.velocity, state.impulse)
            states.append([field.cpu().double() for field in fields])
        ends.append(states)
        solvers.append(solver)
    return *ends, solvers[0]


@pytest.mark.parametrize("iterations", [1, 4])
def test_a_collision_is_the_same_in_float32_and_float64(device, iterations, monkeypatch):
    """Four substeps of free flight and two of collision; round-off grows in it, but not to a thousandth of it."""
    monkeypatch.setattr(contact, "MOST_ITERATIONS", iterations)
    single, wide, solver = _ends(device, Contact(friction=0.1), 4, 2)  # they slide
    assert solver.kernels.touching.rounds > 0
    (position, speed, taken), (expected, speeds, impulse) = single[1], wide[1]
    changed = float(peak(speed - single[0][1]))
    assert changed > 5.0
    assert_close(position, expected, rtol=0, atol=2e-5)
    assert_close(speed, speeds, rtol=0, atol=1e-3 * changed)
    assert_close(taken, impulse, rtol=0, atol=1e-4 * float(peak(impulse)) + 1e-6)
    for each in (taken, impulse):
        assert (each.abs().amax(-1) > 1e-7).tolist() == [True, True, False, True]
    points, velocity, _boundaries = _collision("cpu", torch.float64)
    momentum = (points.mass[:, None] * (speeds - velocity)).sum(0) + impulse.sum(0)
    gravity = points.mass.sum() * 6 * DT * double([0.0, 0.0, -9.8])
    assert_close(momentum, gravity, rtol=0, atol=1e-12)  # what the boundaries took is what the sheets lost


def test_the_lists_are_those_of_a_tree(device):
    low = sheet(9, 9, dtype=torch.float32)
    points = MaterialPoints.join([low, sheet(9, 9, (0.0, 0.0, 0.4), dtype=torch.float32)]).map(lambda t: t.to(device))
    solver, state = scene(points, Contact(), transfer="kernels", gravity=ZERO)
    moved = torch.zeros_like(state.node_displacement)
    upper = state.grid.node_positions(moved)[:, 2] > 0.2
    moved[upper] = torch.tensor([0.013, -0.007, 0.01 - 0.4], device=device)
    state = solver.bound.read_particles(state, moved, 0 * moved)
    solver.rollout(state, 1e-5, 1)
    touching, stage = solver.kernels.touching, solver.bound.contact
    limit = stage.reach + contact.SLACK * stage.dx + touching.margin
    both = pairs(stage, samples(stage, state)[0], limit)
    assert both.shape[1] > 200
    assert touching.pairs == both.shape[1]
    near = touching.near.long()
    known = torch.arange(touching.room, device=device) < near[:, None]
    found = torch.stack([known.nonzero()[:, 0], touching.candidates.long()[known]])
    expected = torch.cat([both, both.flip(0)], dim=1)
    width = len(near)
    assert torch.equal((found[0] * width + found[1]).sort()[0], (expected[0] * width + expected[1]).sort()[0])


def test_nodes_without_weight_do_not_widen_the_lists(device):
    """A node that reaches a sheet by a thousandth of a cell may fly at 1000 m/s, as stress makes it: no place moves."""
    low = sheet(5, 5, dtype=torch.float32)
    dx = 0.044
    points = MaterialPoints.join([low, sheet(3, 3, (0.023, 0.017, 2.501 * dx), dtype=torch.float32)])
    points = points.map(lambda t: t.to(device))
    solver, state = scene(points, Contact(), gravity=ZERO)
    mass = solver.bound.node_mass
    light = (mass > 0) & (mass < 1e-5 * mass.amax())
    assert int(light.sum()) > 4
    velocity = torch.where(light[:, None], 1000.0, 0.0).expand(-1, 3)
    state = solver.bound.read_particles(state, torch.zeros_like(velocity), velocity)
    solver.rollout(state, 1e-5, 3)
    touching = solver.kernels.touching
    assert touching.margin == contact.REACHES * solver.bound.contact.reach
    assert touching.interval > 1


def test_lists_that_do_not_fit_get_more_room(device, monkeypatch):
    """The rollout is done again from its start, and ends where it would have with enough room."""
    points, velocity, _ = _collision(device)
    ends, rooms = [], []
    for room, slots in ((64, 32), (2, 1)):
        monkeypatch.setattr(contact, "ROOM", room)
        monkeypatch.setattr(contact, "SLOTS", slots)
        # torch makes the masses of the nodes, on a GPU in no fixed order unless told to
        settings = {"transfer": "kernels", "deterministic": True}
        solver, state = scene(points, Contact(), velocity=velocity, **settings)
        ends.append(solver.rollout(state, 4 * DT, 2))
        rooms.append((solver.kernels.touching.room, solver.kernels.touching.slots))
    assert rooms[0] == (64, 32)
    assert rooms[1][0] > 2
    assert rooms[1][1] > 1
    assert peak(ends[0].velocity - velocity) > 1.0  # they touched
    assert torch.equal(ends[0].velocity, ends[1].velocity)
    assert float(ends[0].time) == float(ends[1].time)


def test_material_that_has_collapsed_is_refused(device, monkeypatch):
    monkeypatch.setattr(contact, "ROOM", 2)
    points, velocity, _ = _collision(device)
    solver, state = scene(points, Contact(), velocity=velocity, transfer="kernels")
    monkeypatch.setattr(contact, "MOST_ENTRIES", 1000 * points.count)
    solver.prepare()
    monkeypatch.setattr(contact, "MOST_ENTRIES", 100)
    touching = solver.kernels.touching
    with value_error("the material has collapsed"):
        solver.rollout(state, 4 * DT, 1)
    assert touching.candidates.shape == (touching.places, touching.room)  # kernels would write beside them
    assert touching.other.shape == (touching.slots, touching.places)
    monkeypatch.setattr(contact, "MOST_ENTRIES", 1000 * points.count)
    again = solver.rollout(state, 4 * DT, 1)
    assert torch.isfinite(again.velocity).all()


@pytest.mark.gpu
def test_graphs_do_what_single_substeps_do():
    """On a GPU: substeps of a collision from graphs, and new lists in the middle, against a CPU in float64."""
    single, wide, _ = _ends("cuda", Contact(), 20, 20, 20, speed=0.1)
    scale = float(peak(wide[-1][0] - wide[0][0]))
    assert_close(single[-1][0], wide[-1][0], rtol=0, atol=0.02 * scale)


@pytest.mark.gpu
def test_deterministic_contact_gives_the_same_bits():
    device = torch.device("cuda")
    points, velocity, boundaries = _collision(device)
    ends = []
    for _ in range(2):
        solver, state = scene(points, Contact(), boundaries, velocity=velocity, transfer="auto", deterministic=True)
        assert solver.kernels.recordable  # nothing waits for the host
        for _ in range(3):  # without and with graphs
            state = solver.rollout(state, DT, 12)
        ends.append(state.position)
    assert torch.equal(*ends)
