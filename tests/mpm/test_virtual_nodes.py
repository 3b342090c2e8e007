import dataclasses

import pytest
import torch
from shared import EYE, ZERO, beyond, double, longest, peak, rand, randn, seeded, solid, up_to, value_error

from gaussian_swaying import (
    AeroForce,
    Box,
    Contact,
    MaterialPoints,
    MPMSolver,
    MPMState,
    PinnedPoints,
    PinnedRegion,
    WindField,
    WindForce,
)
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.geometry.regions import HalfSpace, Sphere
from gaussian_swaying.mpm.colliders import Obstacle, VelocityBox, Wall
from gaussian_swaying.mpm.contact import Surface
from gaussian_swaying.mpm.embedded import EmbeddedInGrid, on_material
from gaussian_swaying.mpm.pins import RigidRegion
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.virtual_nodes import virtual_nodes
from gaussian_swaying.wind.effects import Profile

EDGE = up_to(x=1.0)


def sheet(height, width=4, length=8):
    x, y = (torch.arange(2 * n).double() / 2 + 0.27 for n in (length, width))
    return torch.cartesian_prod(x, y, height + double([-0.05, 0.0, 0.05]))


def material(position, attached=None):
    return solid(position, 0.01, 1.0, 100.0, attached=attached)


def together(*parts):
    return torch.cat(parts), torch.cat([torch.full((len(part),), k) for k, part in enumerate(parts)])


def rolled(points, velocity=None, steps=60, transfer="torch", boundaries=(), push=None, **options):
    options = {"gravity": (0, 0, -0.1)} | options
    solver = MPMSolver(1.0, transfer=transfer, boundaries=boundaries, **options)
    start = solver.init_state(points, velocity)
    forces = None if push is None else lambda _: push
    return solver, start, solver.rollout(start, 0.8 * solver.stable_substep(start), steps, forces)


def fields(state):
    return [getattr(state, f.name) for f in dataclasses.fields(MPMState) if f.name != "grid"]


@pytest.mark.parametrize("transfer", ["torch", "kernels"])
@pytest.mark.parametrize("how", ["number", "pairs"])
def test_one_piece_is_the_same_bit_for_bit(transfer, how):
    position = sheet(3.2)
    attached = torch.zeros(len(position), dtype=torch.long)
    if how == "pairs":
        near = (position[:, None] - position).norm(dim=-1) < 0.8
        attached = near.nonzero()
    pins = [PinnedRegion(EDGE), Wall(HalfSpace([0, 0, 2.9], [0, 0, 1]))]
    plain, known = (rolled(material(position, a), transfer=transfer, boundaries=pins)[2] for a in (None, attached))
    assert known.grid == plain.grid
    for one, other in zip(fields(plain), fields(known), strict=True):
        assert one is other or (one == other if isinstance(one, float) else torch.equal(one, other))


@pytest.mark.parametrize("transfer", ["torch", "kernels"])
@pytest.mark.parametrize("kind", [None, "nodes", "hinge", "clamp"])
def test_two_sheets_each_move_as_alone(transfer, kind):
    parts = sheet(3.1), sheet(3.3)
    pushes = [double([0.0, 0.0, push]).expand_as(parts[0]) for push in (2e-3, -1e-3)]
    position, number = together(*parts)
    how = {"boundaries": [PinnedRegion(EDGE, kind)], "transfer": transfer}
    solver, start, both = rolled(material(position, number), push=torch.cat(pushes), **how)
    glued = rolled(material(position), push=torch.cat(pushes), **how)[2]
    assert start.grid.virtual > 0
    assert solver.has_kernels == (transfer == "kernels")
    energy = float(solver.bound.kinetic(both) + solver.elastic_energy(both))
    for k, (part, push) in enumerate(zip(parts, pushes, strict=True)):
        lone, _, end = rolled(material(part), push=push, **how)
        energy -= float(lone.bound.kinetic(end) + lone.elastic_energy(end))
        alone = end.position
        far = longest(alone - part)
        assert far > 0.1
        assert longest(both.position[number == k] - alone) < 1e-9 * far
        assert longest(glued.position[number == k] - alone) > 0.1 * far
    assert abs(energy) < 1e-9


def strip(x, y, z):
    return torch.cartesian_prod(*(torch.as_tensor(t, dtype=torch.float64) for t in (x, y, z)))


def fork(gap):
    """Two arms along x, and a base that joins them from x = 0 to 2; points that are neighbours are attached."""
    along, across = torch.arange(0.25, 12.0, 0.5), torch.tensor([0.2, 0.6])
    arms = strip(along, across, [0.2, 0.6]), strip(along, across + 0.4 + gap, [0.2, 0.6])
    position, number = together(*arms)
    near = (position[:, None] - position).abs().amax(-1) <= 0.51
    apart = (number[:, None] != number) & (position[:, None, 0] > 2)
    return position + 3.0, (near & ~apart).nonzero(), number


def test_arms_share_nodes_only_where_the_base_is_near():
    position, pairs, number = fork(0.1)
    solver, start, _ = rolled(material(position, pairs), steps=1)
    node, grid = solver.bound.stencil.nodes, start.grid
    shared = set(node[:, number == 0].flatten().tolist()) & set(node[:, number == 1].flatten().tolist())
    every = torch.arange(grid.node_count)[solver.bound.node_inverse_mass > 0]
    at = solver.bound.node_positions(position)
    assert grid.virtual > 0
    # a node reaches 1.5 cells, and the base ends at x = 5
    assert max(at[list(shared), 0]) < 5 + 1.5
    copied = [n for n in every.tolist() if at[n, 0] > 6.5]
    assert not shared & set(copied)
    both = [n for n in every.tolist() if at[n, 0] < 5]
    assert set(both) <= set(range(grid.lattice_count))  # no node near the base has a copy


@pytest.mark.parametrize("how", ["a point", "points in a cell", "a line", "a sheet", "a block"])
@pytest.mark.parametrize("turn", [0, 2])
def test_small_pieces_in_any_orientation_move_as_alone(how, turn):
    """Among each other in the same cells: nothing is singular, whatever few points a piece has."""
    reach = torch.arange(-2.0, 2.1, 0.4)
    none = torch.zeros(1)
    axes = {
        "a point": (none, none, none),
        "points in a cell": (torch.tensor([0.0, 0.2]), none, torch.tensor([0.0, 0.1])),
        "a line": (reach, none, none),
        "a sheet": (reach, reach, none),
        "a block": (reach, torch.tensor([0.0, 0.3]), torch.tensor([0.0, 0.3])),
    }[how]
    piece = strip(*axes)
    random = seeded(turn)
    parts, speeds = [], []
    for _ in range(3):
        rotation = polar_rotation(randn(3, 3, generator=random))
        if turn == 0:
            rotation = EYE
        parts.append(piece @ rotation.T + 5 + 0.3 * rand(3, generator=random))
        rate = 0.05 * randn(3, 3, generator=random)
        speeds.append((parts[-1] - parts[-1].mean(0)) @ rate + randn(3, generator=random))
    position, number = together(*parts)
    solver, _, both = rolled(material(position, number), torch.cat(speeds), transfer="kernels")
    assert torch.isfinite(solver.bound.node_inverse_mass).all()
    for k, (part, speed) in enumerate(zip(parts, speeds, strict=True)):
        alone = rolled(material(part), speed, transfer="torch")[2]
        for name in ("position", "velocity", "F_elastic"):
            mine, expected = getattr(both, name)[number == k], getattr(alone, name)
            assert peak(mine - expected) < 1e-9 * max(1.0, float(peak(expected)))


BOUNDARIES = {
    "handle": lambda: PinnedRegion(EDGE, velocity=[0.0, 0.3, 0.0]),
    "points": lambda: PinnedPoints([[0.5, 1.0, 3.1], [0.5, 1.0, 3.3], [0.5, 3.0, 3.3]]),
    "clamped points": lambda: PinnedPoints([[0.5, 1.0, 3.1], [0.5, 2.0, 3.3]], "clamp"),
    "a pin with an end": lambda: PinnedRegion(EDGE, "hinge", end=0.1),
    "a box of velocities": lambda: VelocityBox(Box([3.0, None, None], [5.0, None, None]), [0.1, 0.0, 0.2]),
    "a rigid part": lambda: RigidRegion(beyond(x=5.0)),
    "ground": lambda: Wall(HalfSpace([0, 0, 3.05], [0, 0, 1])),
}


@pytest.mark.parametrize("name", list(BOUNDARIES))
def test_boundaries_act_on_each_piece(name):
    parts = sheet(3.1), sheet(3.3)
    position, number = together(*parts)
    both = rolled(material(position, number), boundaries=[BOUNDARIES[name]()])[2]
    assert torch.isfinite(both.position).all()
    fused = rolled(material(position, number), boundaries=[BOUNDARIES[name]()], transfer="auto")[2]
    for field in ("position", "velocity", "node_displacement", "impulse"):
        one, other = getattr(both, field), getattr(fused, field)
        assert peak(one - other) < 1e-9 * max(1.0, float(peak(one)))
    if name in ("points", "clamped points", "a rigid part"):
        return
    apart, _ = together(parts[0], parts[1] + double([0.0, 50.0, 0.0]))
    distant = rolled(material(apart), boundaries=[BOUNDARIES[name]()])[2]
    away = peak(both.position[number == 0] - distant.position[number == 0])
    assert away < 1e-9


def test_held_points_hold_the_piece_that_they_lie_on():
    parts = sheet(3.1), sheet(3.3)
    position, number = together(*parts)
    pins = [PinnedPoints([[0.5, 1.0, 3.3], [0.5, 3.0, 3.3]])]
    both = rolled(material(position, number), boundaries=pins, transfer="kernels")[2]
    fallen = position[number == 0][:, 2] - both.position[number == 0][:, 2]
    assert peak(fallen - fallen.mean()) < 1e-9  # the lower sheet falls freely
    alone = rolled(material(parts[1]), boundaries=pins, transfer="torch")[2]
    assert peak(both.position[number == 1] - alone.position) < 1e-9


def test_scenes_of_a_batch_have_their_own_copies(kernel_device):
    """Pins, wind that depends on the place and viscosity, in the kernels, beside each scene alone in torch.

    On a GPU in single precision. A virtual node lies where the node lies that it is a copy of.
    """
    position, number = together(sheet(3.1), sheet(3.3))
    scenes = [material(position, number), material(position + 0.31, number)]
    own = torch.float64 if kernel_device.type == "cpu" else torch.float32

    def end(points, transfer):
        up, area = torch.zeros_like(points.position), torch.full_like(points.mass, 0.01)
        up[..., 2] = 1.0
        wind = WindField([5.0, 2.0, -1.0], effects=[Profile(height=3.0)])
        pins = [PinnedRegion(EDGE, "hinge")]
        solver = MPMSolver(1.0, boundaries=pins, transfer=transfer, stiffness_damping=1e-3).to(up.device)
        state = solver.init_state(points)
        assert state.grid.virtual > 0
        load = WindForce(AeroForce(), wind, up, area).to(up.device)
        return solver.rollout(state, 1e-2, 20, [load]).position.cpu().double()

    both = end(MaterialPoints.stack(scenes).map(lambda t: t.to(kernel_device, own)), "kernels")
    for k, points in enumerate(scenes):
        alone = end(points, "torch")
        away = peak(alone - points.position)
        assert away > 1e-3
        # of the logarithm of the wind, and of rounding
        assert peak(both[k] - alone) < (1e-6 if own == torch.float64 else 1e-3) * away


def test_places_follow_their_own_piece():
    parts = sheet(3.1), sheet(3.3)
    position, number = together(*parts)
    push = torch.where(number == 0, 2e-3, -1e-3)[:, None] * double([0.0, 0.0, 1.0])
    points = material(position, number)
    start, state = rolled(points, boundaries=[PinnedRegion(EDGE)], push=push)[1:]
    place = position + 0.05
    read, nodes = on_material(place, torch.arange(len(place)), points, 1.0)
    follow = EmbeddedInGrid(read, place - read, nodes)
    move, _ = follow.motion(state)
    slack = (0.2 * (state.F_total - EYE).norm(dim=(-1, -2)).amax()).clamp(min=0.01)
    assert longest(move - (state.position - position)) < slack
    assert follow.nodes(state).max() >= start.grid.lattice_count
    some = follow.some(torch.arange(5))
    assert torch.equal(some.motion(state)[0], move[:5])
    glued = EmbeddedInGrid(read, place - read).motion(state)[0]
    assert longest(glued - move) > 0.1  # from the nodes of the other piece


def test_a_place_far_from_the_few_points_of_a_piece_is_read_at_one_of_them():
    """A node that the points hardly reach may swing far; at the other end of their cell it would count."""
    few = double([3.55, 3.55, 3.55]) + 0.02 * rand(6, 3)
    position, number = together(sheet(3.1), few)
    place = double([[3.56, 3.56, 3.56], [4.4, 4.4, 4.4]])
    nearest = torch.full((2,), len(position) - 1)
    read, nodes = on_material(place, nearest, material(position, number), 1.0)
    assert torch.equal(read, torch.stack([place[0], position[-1]]))
    assert torch.equal(nodes[:, 0], nodes[:, 1])


def test_a_state_is_saved_and_read():
    position, number = together(sheet(3.1), sheet(3.3))
    solver, start, state = rolled(material(position, number), steps=2)
    again = MPMState.from_state_dict(state.state_dict())
    assert again.grid == state.grid
    end, other = (solver.rollout(s, 1e-3, 2).position for s in (state, again))
    assert torch.equal(end, other)
    assert solver.continued(solver, state, start) is not None


def test_close_parts_touch_and_do_not_pass_each_other():
    """Sheets with a gap of 0.4 cells that are pushed together; on shared nodes they would be one body."""
    position, number = together(sheet(3.1), sheet(3.5))
    points, up = material(position, number), torch.zeros_like(position)
    up[:, 2] = 1.0
    velocity = (0.5 - number)[:, None] * up
    ends = []
    for contact in (Contact(), None):
        surface = Surface.of_points(points, up, 0.5, 0.1, contact)
        solver = MPMSolver(1.0, gravity=ZERO)
        start = solver.init_state(points, velocity, surface=surface)
        ends.append(solver.rollout(start, 0.5 * solver.stable_substep(start), 40))
    gap, passed = ((end.position[number == 1] - end.position[number == 0])[:, 2] for end in ends)
    assert passed.max() < 0.0
    assert gap.min() > 0.099  # the thickness
    twice = solver.momenta(ends[0])["linear"] - solver.momenta(start)["linear"]
    assert twice.norm() < 1e-9


def test_contact_and_obstacles_in_kernels():
    """Of two sheets in one cell, the upper one meets a third one from above, and the lower one a ball from below."""
    position, number = together(sheet(3.1), sheet(3.5), sheet(6.0))
    points, up = material(position, number), torch.zeros_like(position)
    up[:, 2] = 1.0
    velocity = -2.0 * (number == 2)[:, None] * up
    surface = Surface.of_points(points, up, 0.5, 0.2, Contact())
    solver = MPMSolver(1.0, gravity=(0, 0, -1), boundaries=[Obstacle(Sphere([2.0, 2.0, 2.3], 0.7))])
    start = solver.init_state(points, velocity, surface=surface)
    assert start.grid.virtual > 0
    end = solver.rollout(start, 0.5 * solver.stable_substep(start), 60)
    free = rolled(points, velocity, gravity=(0, 0, -1))[2]
    for k in (0, 1, 2):
        assert peak((end.velocity - free.velocity)[number == k]) > 0.1  # all have met something
    low, high = (end.position[number == k, 2] for k in (0, 1))
    assert (high - low).min() > 0.1  # across tilted sheets; one that has passed the other has less than 0
    assert ((end.position - torch.tensor([2.0, 2.0, 2.3]).double()).norm(dim=-1) > 0.7).all()


def test_copies_are_numbered_after_the_lattice():
    grid = GridSpec(1.0, (0, 0, 0), (4, 3, 3))
    first = torch.tensor([0, 0, 9])
    found = virtual_nodes(first, grid, torch.tensor([[0, 2]]))
    assert found.original.shape == (1, 27)
    assert torch.equal(found.node[:, 1], 36 + torch.arange(27))  # the second point is alone
    assert torch.equal(found.original[0], torch.arange(27))
    assert torch.equal(found.node[:18, 2], found.node[9:, 0])  # the others share what both reach
    assert found.node[:, [0, 2]].max() < 36


def test_wrong_numbers_are_refused():
    for attached in (torch.zeros(7, dtype=torch.long), torch.zeros(8), torch.tensor([[0, 8]])):
        with value_error("`attached`"):
            material(torch.rand(8, 3), attached)


def test_joined_bodies_keep_their_pieces():
    one, two = material(torch.rand(4, 3)), material(torch.rand(3, 3), torch.tensor([5, 5, 9]))
    assert MaterialPoints.join([one, two]).attached.tolist() == [0, 0, 0, 0, 1, 1, 2]
    assert MaterialPoints.join([one, one]).attached is None
    with value_error("cannot be joined"):
        MaterialPoints.join([one, material(torch.rand(3, 3), torch.tensor([[0, 1]]))])
    with value_error("same `attached`"):
        MaterialPoints.stack([one, material(torch.rand(4, 3), torch.zeros(4, dtype=torch.long))])


# ---- where Gaussians read the motion of the nodes


def test_places_without_all_their_nodes_are_read_at_a_material_point():
    """Cells end at halves: (1.6, 2.4) shares a cell with the point at (2, 2), (2.6, 2) reads nodes beyond it."""
    points = solid(torch.tensor([[2.0, 2.0, 2.0], [9.25, 2.0, 2.0]]), 1.0, 1.0, 1.0)
    place = double(
        [
            [1.6, 2.4, 2.1],  # its nodes are those of the first point
            [8.9, 1.7, 2.2],  # and here of the second
            [2.6, 2.0, 2.0],  # some of its nodes have no mass
            [5.5, 2.0, 2.0],  # none of its nodes has mass
            [2.0, 0.2, 2.0],  # some of its nodes are not in the grid
            [2.0, 90.0, 2.0],  # none of its nodes is
        ]
    )
    nearest = torch.tensor([1, 0, 0, 1, 0, 1])
    expected = torch.cat([place[:2], points.position.double()[nearest[2:]]])
    read, nodes = on_material(place, nearest, points, 1.0)
    assert nodes is None
    assert torch.equal(read, expected)
