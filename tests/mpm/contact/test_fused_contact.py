"""Contact in the Triton substep against torch."""

import pytest
import torch
from torch.testing import assert_close

from gaussian_swaying import Contact, MaterialPoints, PinnedPoints
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.half_space import HalfSpaceObstacle
from gaussian_swaying.mpm.contact.pairs import close_pairs
from gaussian_swaying.mpm.triton import fused_contact

from .bodies import scene, sheet

DT = 1.2e-3


def _collision(device):
    """A small sheet that flies onto one that is held at two corners, beside a moving ball."""
    below, above = sheet(5, 5, dtype=torch.float32), sheet(3, 3, (0.023, 0.017, 0.1), dtype=torch.float32)
    points = MaterialPoints.join([below, above]).map(lambda t: t.to(device))
    velocity = torch.zeros_like(points.position)
    velocity[below.count :] = torch.tensor([6.0, 0.0, -20.0], device=device)
    pins = PinnedPoints([[0.0, 0.0, 0.0], [0.08, 0.0, 0.0]])
    balls = [
        BallObstacle([0.04, 0.04, -0.06], 0.05, 0.4),
        BallObstacle([0.04, 0.04, -0.5], 0.05),  # out of reach
        BallObstacle([0.0, 0.08, -0.045], 0.05, start=3.5 * DT, end=4.5 * DT),
    ]
    return points, velocity, [pins, *balls]


@pytest.mark.parametrize(
    ("device", "iterations"),
    [("cpu", 4), *(pytest.param("cuda", number, marks=pytest.mark.gpu) for number in (1, 4))],
    indirect=["device"],
)
def test_the_kernels_do_what_torch_does(device, iterations):
    """Four substeps of free flight and two of collision; round-off grows in it, but not to a thousandth of it."""
    points, velocity, boundaries = _collision(device)
    ends, taken = [], []
    for transfer in ("torch", "kernels"):
        contact = Contact(friction=0.1, iterations=iterations)  # they slide
        solver, state = scene(points, contact, boundaries, velocity=velocity, transfer=transfer)
        assert solver.has_kernels == (transfer == "kernels")
        state = solver.rollout(state, DT, 4)
        middle = state.velocity.clone()
        state = solver.rollout(state, DT, 2)
        ends.append(state)
        taken.append(state.impulse)
    assert solver.fused().touching.rounds > 0
    changed = float((ends[0].velocity - middle).abs().max())
    assert changed > 5.0
    assert_close(ends[1].position, ends[0].position, rtol=0, atol=2e-5)
    assert_close(ends[1].velocity, ends[0].velocity, rtol=0, atol=1e-3 * changed)
    assert_close(taken[1], taken[0], rtol=0, atol=1e-4 * float(taken[0].abs().max()) + 1e-6)
    for each in taken:
        assert (each.abs().amax(-1) > 1e-7).tolist() == [True, True, False, True]


def test_iterations_are_counted_where_there_are_obstacles(device):
    """One in every substep of a sheet that presses on the ground."""
    points = sheet(5, 5, dtype=torch.float32).map(lambda t: t.to(device))
    ground = HalfSpaceObstacle([0.0, 0.0, -0.004], [0.0, 0.0, 1.0])
    solver, state = scene(points, Contact(iterations=1), [ground], transfer="kernels", gravity=(0.0, 0.0, -9.8))
    solver.rollout(state, DT, 6)
    assert solver.fused().touching.rounds == 6


def test_the_lists_are_those_of_close_pairs(device):
    """Sheets that lie across each other in many cells of the grid: both sides of all pairs, in a fixed order."""
    low = sheet(9, 9, dtype=torch.float32)
    points = MaterialPoints.join([low, sheet(9, 9, (0.0, 0.0, 0.4), dtype=torch.float32)]).map(lambda t: t.to(device))
    solver, state = scene(points, Contact(iterations=1), transfer="kernels", gravity=(0.0, 0.0, 0.0))
    moved = torch.zeros_like(state.node_displacement)
    upper = state.grid.node_positions(moved)[:, 2] > 0.2
    moved[upper] = torch.tensor([0.013, -0.007, 0.01 - 0.4], device=device)
    state = solver.bound.read_particles(state, moved, 0 * moved)
    solver.rollout(state, 1e-5, 1)
    touching, stage = solver.fused().touching, solver.bound.contact
    limit = stage.reach + float(touching.margin)
    first, second = close_pairs(stage.positions(moved), limit, stage.surface.place, stage.apart)
    assert len(first) > 200
    assert touching.pairs == len(first)
    near = touching.near.long()
    known = torch.arange(touching.room, device=device) < near[:, None]
    found = torch.stack([known.nonzero()[:, 0], touching.candidates.long()[known]])
    expected = torch.cat([torch.stack([first, second]), torch.stack([second, first])], dim=1)
    width = len(near)
    assert torch.equal((found[0] * width + found[1]).sort()[0], (expected[0] * width + expected[1]).sort()[0])


def test_nodes_without_weight_do_not_widen_the_lists(device):
    """A node that reaches a sheet by a thousandth of a cell may fly at 1000 m/s, as stress makes it: no place moves."""
    low = sheet(5, 5, dtype=torch.float32)
    dx = 0.044
    points = MaterialPoints.join([low, sheet(3, 3, (0.023, 0.017, 2.501 * dx), dtype=torch.float32)])
    points = points.map(lambda t: t.to(device))
    ends = []
    for transfer in ("torch", "kernels"):
        solver, state = scene(points, Contact(iterations=4), transfer=transfer, gravity=(0.0, 0.0, 0.0))
        mass = solver.bound.node_mass
        light = (mass > 0) & (mass < 1e-5 * mass.amax())
        assert int(light.sum()) > 4
        velocity = torch.where(light[:, None], 1000.0, 0.0).expand(-1, 3)
        state = solver.bound.read_particles(state, torch.zeros_like(velocity), velocity)
        ends.append(solver.rollout(state, 1e-5, 3))
    touching = solver.fused().touching
    assert touching.made == 1
    assert float(touching.margin) < 0.5 * dx
    assert_close(ends[1].position, ends[0].position, rtol=0, atol=1e-6)


def test_lists_that_do_not_fit_get_more_room(device, monkeypatch):
    """The rollout is done again from its start, and ends where it would have with enough room."""
    points, velocity, _ = _collision(device)
    ends, rooms = [], []
    for room, slots in ((64, 32), (2, 1)):
        monkeypatch.setattr(fused_contact, "ROOM", room)
        monkeypatch.setattr(fused_contact, "SLOTS", slots)
        # torch makes the masses of the nodes, on a GPU in no fixed order unless told to
        settings = {"transfer": "kernels", "deterministic": True}
        solver, state = scene(points, Contact(iterations=2), velocity=velocity, **settings)
        ends.append(solver.rollout(state, 4 * DT, 2))
        rooms.append((solver.fused().touching.room, solver.fused().touching.slots))
    assert rooms[0] == (64, 32)
    assert rooms[1][0] > 2
    assert rooms[1][1] > 1
    assert float((ends[0].velocity - velocity).abs().max()) > 1.0  # they touched
    assert torch.equal(ends[0].velocity, ends[1].velocity)
    assert float(ends[0].time) == float(ends[1].time)


def test_material_that_has_collapsed_is_refused(device, monkeypatch):
    """More candidates than any buffer holds: a sentence, not wrong lists, and another rollout is possible."""
    monkeypatch.setattr(fused_contact, "ROOM", 2)
    points, velocity, _ = _collision(device)
    solver, state = scene(points, Contact(iterations=1), velocity=velocity, transfer="kernels")
    monkeypatch.setattr(fused_contact, "MOST_ENTRIES", 1000 * points.count)
    solver.fused()
    monkeypatch.setattr(fused_contact, "MOST_ENTRIES", 100)
    touching = solver.fused().touching
    with pytest.raises(ValueError, match="the material has collapsed"):
        solver.rollout(state, 4 * DT, 1)
    assert touching.candidates.shape == (touching.places, touching.room)  # kernels would write beside them
    assert touching.other.shape == (touching.slots, touching.places)
    monkeypatch.setattr(fused_contact, "MOST_ENTRIES", 1000 * points.count)
    again = solver.rollout(state, 4 * DT, 1)
    assert torch.isfinite(again.velocity).all()


@pytest.mark.gpu
def test_graphs_do_what_single_substeps_do():
    """On a GPU: substeps of a collision from graphs, and a new list in the middle, against torch."""
    device = torch.device("cuda")
    points, velocity, boundaries = _collision(device)
    ends = []
    for transfer in ("torch", "kernels"):
        solver, state = scene(points, Contact(), boundaries, velocity=0.1 * velocity, transfer=transfer)
        for _ in range(4):
            state = solver.rollout(state, DT / 4, 80)
        ends.append(state)
    scale = float((ends[0].position - points.position).abs().max())
    assert scale > 0.05
    assert_close(ends[1].position, ends[0].position, rtol=0, atol=0.02 * scale)


@pytest.mark.gpu
def test_deterministic_contact_gives_the_same_bits():
    device = torch.device("cuda")
    points, velocity, boundaries = _collision(device)
    ends = []
    for _ in range(2):
        solver, state = scene(points, Contact(), boundaries, velocity=velocity, transfer="auto", deterministic=True)
        assert solver.fused().recordable  # nothing waits for the host
        for _ in range(3):  # without and with graphs
            state = solver.rollout(state, DT, 12)
        ends.append(state.position)
    assert torch.equal(*ends)
