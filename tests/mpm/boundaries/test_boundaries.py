import copy
import dataclasses
import math
import re
from pathlib import Path

import pytest
import torch
from catalogue import BOUNDARIES, OBSTACLES, conditions
from shared import alike, beyond, double, in_both, near, peak, rand, randn, seeded, value_error, without_waits
from torch.testing import assert_close

from gaussian_swaying import Box, Cylinder, MPMSolver, Sphere
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.regions import Everything, HalfSpace, Not, Union
from gaussian_swaying.mpm.boundary import Nodes
from gaussian_swaying.mpm.colliders import VelocityBox, Wall, plane_velocity

from .bodies import block, march, run_for

MOVING = KeyedPath([0.0, 0.2], [[0, 0, 0], [0.1, 0.05, 0]], [[0, 0, 0], [10, 20, 30]])
UPPER = beyond(z=0.23)
REGIONS = {
    "everything": Everything(),
    "box": Box([None, 0.1, 0.23], [0.35, None, None]),
    "sphere": Sphere([0.1, 0.2, 0.2], 0.2),
    "cylinder": Cylinder([0.2, 0.2, 0.2], [1.0, 2.0, 0.5], 0.15, 0.3),
    "union": Union([Sphere([0.1, 0.1, 0.1], 0.15), Box([0.2, 0.2, 0.2], [0.4, 0.4, 0.4])]),
    "not": Not(Cylinder([0.2, 0.2, 0.2], [0.0, 0.0, 1.0], 0.15, 0.3)),
}
NAMES = ["rigid", *conditions(UPPER), *OBSTACLES]
# every condition that holds nodes, and the one that evaluates its region in each substep with each kind of region
ACTING = [name for name in NAMES if name != "points"] + [f"in {name}" for name in REGIONS]


def _made(name, region=UPPER):
    """Until 0.5 s, but for a rigid part, which never ends; obstacles move, but for two."""
    if name == "rigid":
        return BOUNDARIES["RigidRegion"](region)
    if name in OBSTACLES:
        more = {} if name in ("ball", "still") else {"path": MOVING}
        return OBSTACLES[name](friction=0.3, end=0.5, **more)
    return conditions(REGIONS.get(name.removeprefix("in "), region))[name if name in NAMES else "velocity"](end=0.5)


def _acting(name, device, dtype=torch.float64):
    generator = seeded(3)
    position = rand(200, 3, generator=generator) * 0.6 - 0.1
    frame = SimFrame.fit(position, up=(0.2, 1.0, 0.3), metres_per_unit=2.0)
    place = frame.point_to_sim(position).to(device, dtype)
    nodes = Nodes(
        time=torch.tensor(0.1, dtype=torch.float64, device=device),
        dt=2e-3,
        position=place,
        lattice=place + 0.01,
        share=rand(200, generator=generator).to(device, dtype),
        threshold=0.5,
        pinned_mass=torch.tensor(0.7, device=device, dtype=dtype),
        mass=rand(200, generator=generator).to(device, dtype),
    )
    velocity = randn(200, 3, generator=generator).to(device, dtype)
    return _made(name).in_frame(frame).to(device), velocity, nodes


def test_every_boundary_is_tested_here():
    assert {type(_made(name)) for name in NAMES} == set(BOUNDARIES.values())


def test_the_documented_boundaries_are_those_that_there_are():
    page = (Path(__file__).parents[3] / "docs" / "configuration.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith("| `solver.boundaries`"))
    assert set(re.findall("`([A-Z][A-Za-z]+)`", row)) == set(BOUNDARIES)


@in_both
@pytest.mark.parametrize(("kind", "friction"), [("sticky", 0.0), ("slip", 0.7), ("separate", 0.7)])
def test_plane_and_box_leave_alone_what_is_near_but_free(formulation, kind, friction):
    """Less than 1.5 cells away and coming closer, yet no node at or behind the plane: a rigid flight."""
    points = block(low=(0.16, 0.16, 0.16), per_side=4)
    low, high = 0.05, 0.65
    plane = BOUNDARIES["Wall"](HalfSpace([0, 0, low], [0, 0, 2]), kind, friction)
    ceiling = BOUNDARIES["Wall"](HalfSpace([0, 0, high], [0, 0, -1]), kind, friction)
    for boundary in (plane, ceiling, BOUNDARIES["Wall"](Box([low] * 3, [high] * 3), kind, friction)):
        for sign in (1.0, -1.0):
            velocity = sign * double([0.3, -0.2, 0.25]).expand_as(points.position)
            state = run_for(formulation, [boundary], points, 0.04, velocity, gravity=(0, 0, 0))
            near(state.velocity, velocity, 1e-12)


@pytest.mark.parametrize("name", ACTING)
def test_a_substep_may_be_a_tensor_and_constants_are_made_once(name, monkeypatch):
    for dtype, tolerance in ((torch.float32, 1e-6), (torch.float64, 1e-12)):
        boundary, velocity, nodes = _acting(name, "cpu", dtype)
        known = boundary(velocity, nodes)
        found = boundary(velocity, dataclasses.replace(nodes, dt=double(nodes.dt)))
        assert found.dtype == dtype
        alike(found, known, tolerance)
        assert not torch.equal(found, velocity)
    if name in ("handle", "impulse", "impulse for each"):  # values that depend on the substep
        longer = boundary(velocity, dataclasses.replace(nodes, dt=double(0.3)))
        assert peak(longer - known) > 1e-3

    for time, acts in ((0.499, True), (0.5, False)):
        now = dataclasses.replace(nodes, time=torch.full_like(nodes.time, time))
        assert torch.equal(boundary(velocity, now), velocity) == (not acts) or name in ("release", "front", "rigid")

    def refuse(given, *_, **__):
        assert isinstance(given, torch.Tensor), "made from numbers of the host"
        return given

    for place, function in ((torch, "tensor"), (torch, "as_tensor"), (torch.Tensor, "new_tensor")):
        monkeypatch.setattr(place, function, refuse)
    assert torch.equal(boundary(velocity, nodes), known)


@pytest.mark.gpu
@pytest.mark.parametrize("name", ACTING)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_recorded_condition_follows_time_and_substep(name, dtype):
    boundary, velocity, nodes = _acting(name, "cuda", dtype)
    nodes = dataclasses.replace(nodes, dt=torch.full_like(nodes.time, 1e-3))
    stream = torch.cuda.Stream()
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        boundary(velocity, nodes)
        with without_waits():
            boundary(velocity, nodes)
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
        # the substep is a tensor here and a number there, so velocities of 1 m/s are rounded in another order
        assert_close(recorded, boundary(velocity, now), rtol=1e-6, atol=4 * torch.finfo(dtype).eps)
        seen.append(recorded.clone())
    assert not torch.equal(seen[0], velocity)
    if name not in ("release", "front", "rigid"):  # the solver ends the first two; a rigid body never ends
        assert torch.equal(seen[3], velocity)


@pytest.mark.parametrize("name", [name for name in NAMES if name != "still"])  # which is in metres
def test_in_frame_leaves_the_original_alone(name):
    scene = block().position
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=3.0)
    boundary, region = _made(name), UPPER

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
    assert (moved.start, moved.end) == (0.0, math.inf if name == "rigid" else 0.5)
    assert type(moved) is type(boundary)
    if hasattr(boundary, "region"):
        assert boundary.region is region
        assert torch.equal(moved.region.contains(frame.point_to_sim(scene)), region.contains(scene))
    else:
        assert any(not torch.equal(before[key], inside[key]) for key in before)
    assert all(torch.equal(value, values(boundary)[key]) for key, value in before.items())


@in_both
@pytest.mark.parametrize("name", [name for name in NAMES if name not in ("points", "still")])
def test_conditions_can_be_copied_saved_and_narrowed(name, formulation):
    """A deep copy and a copy from the state dict give the same bits; float32 gives the same to round-off."""
    points = block(per_side=5)
    boundary = _made(name)
    run = {"dx": 0.1, "formulation": formulation}
    push = 0.3 * points.position.flip(-1) if name == "rigid" else None  # which free fall does not strain
    known = march(MPMSolver(**run, boundaries=[boundary]), points, 2e-3, 6, push)[-1]
    device_function = copy.deepcopy(boundary)
    for tensor in boundary.buffers():
        tensor.zero_()
    assert torch.equal(
        march(MPMSolver(**run, boundaries=[device_function]), points, 2e-3, 6, push)[-1].position, known.position
    )
    loaded = MPMSolver(**run, boundaries=[boundary])
    loaded.load_state_dict(MPMSolver(**run, boundaries=[device_function]).state_dict())
    assert torch.equal(march(loaded, points, 2e-3, 6, push)[-1].position, known.position)
    assert peak(known.position - march(MPMSolver(**run), points, 2e-3, 6, push)[-1].position) > 1e-5

    loaded.init_state(points)
    narrow = loaded.to(torch.float32)
    end = march(narrow, points.map(lambda t: t.float()), 2e-3, 6, None if push is None else push.float())[-1]
    assert end.position.dtype == torch.float32
    near(end.position.double(), known.position, 2e-6)


@pytest.mark.parametrize("name", ["pin", "handle", "release", "front", "impulse", "impulse for each"])
@pytest.mark.parametrize("framed", [False, True])
def test_region_that_holds_nothing_names_its_condition(name, framed):
    boundary, points = _made(name, Sphere([9, 9, 9], 0.1)), block(low=(0.2, 0.2, 0.2), side=0.2)
    frame = SimFrame.fit(points.position, metres_per_unit=2.0) if framed else None
    if framed:
        points = dataclasses.replace(points, position=frame.point_to_sim(points.position))
    # where the particles are, in the units in which the region was given
    where = r"\[0.2167, 0.2167, 0.2167\] and \[0.3833, 0.3833, 0.3833\]"
    kind = type(boundary).__name__
    message = rf"region Sphere.* of the {kind} holds no particle: .* between {where}; move or enlarge `region`"
    with value_error(message):
        MPMSolver(0.1, boundaries=[boundary]).init_state(points, frame=frame)


def test_share_that_no_node_reaches_names_its_condition():
    pin = changed(BOUNDARIES["PinnedRegion"](Sphere([0.2333, 0.2333, 0.2333], 0.03), kind="nodes"), pinned_share=0.9)
    with value_error(r"no grid node.*enlarge `region` of the PinnedRegion"):
        MPMSolver(0.4, boundaries=[pin]).init_state(block())


ZERO, UNIT, BALL = [0, 0, 0], [0, 0, 1], Sphere([0, 0, 0], 1)
BELOW = HalfSpace(ZERO, UNIT)
REFUSED = [
    ("Wall", (BELOW, "glue"), {}, "kind"),
    ("Wall", (BALL,), {}, "shape"),
    ("Wall", (BELOW,), {"friction": -1}, "friction"),
    ("Wall", (BELOW,), {"start": 1.0, "end": 1.0}, "end"),
    ("VelocityBox", (BALL, [1, 2]), {}, "velocity"),
    ("PinnedRegion", (BALL, "glue"), {}, "kind"),
    ("PinnedPoints", ([],), {}, "at"),
    ("PinnedPoints", ([[0, 0]],), {}, "at"),
    ("PinnedPoints", ([ZERO], "nodes"), {}, "kind"),
    ("PinnedRegion", (BALL,), {"velocity": [1, 2]}, "velocity"),
    ("PinnedRegion", (BALL,), {"angular_velocity": [1, 2]}, "angular_velocity"),
    ("PinnedRegion", (BALL,), {"pivot": [1, 2, 3, 4]}, "pivot"),
    ("PinnedRegion", (BALL,), {"front": [ZERO], "end": 1.0}, "front"),
    ("PinnedRegion", (BALL,), {"front": [[1, 0]], "end": 1.0}, "front"),
    ("PinnedRegion", (BALL,), {"front": [UNIT, UNIT], "end": 1.0}, "front"),
    ("PinnedRegion", (BALL,), {"front": [UNIT]}, "end"),
    ("Impulse", (BALL, [1, 0, 0]), {"end": math.inf}, "end"),
    ("Impulse", (BALL, [1, 0]), {}, "impulse"),
    ("Impulse", (BALL, [1, 0, 0]), {"start": 1.0}, "end"),
    ("Obstacle", (BALL,), {"friction": -1.0}, "friction"),
    ("Obstacle", (BALL,), {"gap": -1.0}, "gap"),
    ("Obstacle", (Box([0, 0, None], [1, 1, 1]),), {}, "max"),
]


def test_bad_boundaries_are_refused():
    for kind, given, settings, field in REFUSED:
        with value_error(f"`{field}`"):
            BOUNDARIES[kind](*given, **settings)


@pytest.mark.parametrize(("time", "acts"), [(0.4, False), (0.5, True), (0.9, True), (1.0, False)])
def test_an_obstacle_stops_the_nodes_on_and_in_it_in_its_time(time, acts):
    """A ball of radius 2 without friction: what moves into it slides, from its surface inwards."""
    ball = BOUNDARIES["Obstacle"](Sphere([1.0, 0.0, 0.0], 2.0), friction=0.0, start=0.5, end=1.0)
    place = double([[3.0, 0, 0], [2.0, 0, 0], [3.001, 0, 0], [-4.0, 0, 0]])
    velocity = double([[-1.0, 0.5, 0.0]]).expand(4, 3)
    found = ball(velocity, Nodes(double(time), 1e-3, place))
    stopped = double([0.0, 0.5, 0.0])
    expected = torch.where(torch.tensor([[True], [True], [False], [False]]) & acts, stopped, velocity)
    assert_close(found, expected)


@pytest.mark.parametrize("path", [None, KeyedPath([0.0, 1.0], moves=[[0, 0, 0], [1, 2, 3]])])
def test_a_mesh_in_a_frame_is_as_far_as_in_the_scene(path):
    turn = double([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    frame = SimFrame(double([0.3, -0.1, 0.2]), turn, 3.0)
    mesh = OBSTACLES["mesh"](path=path)
    grid = mesh.shape.grid
    low, high = grid.origin, grid.origin + grid.spacing * (torch.tensor(grid.values.shape) - 1)
    draw = rand(200, 3, generator=seeded(0))
    place = low + draw * (high - low) + torch.tensor([0.113, 0.207, 0.181])
    now = double(0.0)
    distance, normal, speed = mesh.touch(place, now, 0.1)
    found = mesh.in_frame(frame).touch(frame.point_to_sim(place), now, 0.1)
    assert distance.amin() < -2 * grid.spacing
    assert distance.amax() > 2 * grid.spacing
    assert_close(found[0], 3 * distance)
    assert_close(found[1], normal @ turn.T)
    assert_close(found[2], 3 * speed @ turn.T)


# ---- planes: contact, friction, and nothing on the free side


UP = double([0.0, 0.0, 1.0])


def test_plane_velocity_kinds():
    into = double([[3.0, 0.0, -2.0]])
    away = double([[3.0, 0.0, 2.0]])
    assert plane_velocity(into, UP, "sticky", 0.0).tolist() == [[0, 0, 0]]
    assert plane_velocity(away, UP, "sticky", 0.0).tolist() == [[0, 0, 0]]
    assert plane_velocity(into, UP, "slip", 0.0).tolist() == [[3, 0, 0]]
    assert plane_velocity(away, UP, "slip", 0.0).tolist() == [[3, 0, 0]]
    assert plane_velocity(into, UP, "separate", 0.0).tolist() == [[3, 0, 0]]
    assert plane_velocity(away, UP, "separate", 0.5).tolist() == [[3, 0, 2]]
    # Coulomb: the tangential speed loses mu times the normal speed taken away, and never turns round
    assert_close(plane_velocity(into, UP, "separate", 0.5), torch.tensor([[2.0, 0, 0]]).double())
    assert plane_velocity(into, UP, "separate", 5.0).tolist() == [[0, 0, 0]]
    assert plane_velocity(torch.zeros(1, 3), UP.float(), "separate", 0.5).tolist() == [[0, 0, 0]]


@in_both
def test_block_slides_down_an_incline_with_coulombs_acceleration(formulation):
    """Static below the friction angle; a = g (sin - mu cos) above. Gravity is tilted instead of the plane."""
    angle, points = math.radians(30), block()
    gravity = (9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle))
    seconds = 0.4
    # the lowest nodes are in contact from the start, so nothing bounces
    plane = Wall(HalfSpace([0, 0, 0.06], [0, 0, 2]), "separate", 0.2)
    x, _, z = run_for(formulation, [plane], points, seconds, gravity=gravity).velocity.mean(0).tolist()
    # mu times the momentum that the plane gave upwards, less what bulging turns aside, more at the slow start
    lost = 9.8 * seconds * math.sin(angle) - x
    assert lost == pytest.approx(0.2 * (9.8 * seconds * math.cos(angle) + z), rel=0.03)
    assert abs(z) < 0.05 * 9.8 * seconds
    # damped, so that it does not hop: with mu = 1 it leans by less than twice the static g sin m c, c as above
    plane = Wall(HalfSpace([0, 0, 0.06], [0, 0, 0.3]), "separate", 1.0)
    held = run_for(formulation, [plane], points, seconds, gravity=gravity, damping=30.0)
    leans = 9.8 * math.sin(angle) * (0.4 * 2.6 + 0.6) * 0.4**2 * 100 / 2e4
    assert (held.position - points.position)[:, 0].mean() < 2 * leans


# ---- velocity boxes, at rest and travelling


def test_a_travelling_box_takes_its_nodes_from_where_it_is():
    frame = SimFrame.fit(block().position, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    box = Box([0.0, 0.0, 0.0], [0.2, 0.4, 0.4])
    drift = frame.direction_to_sim(double([1.0, 0.0, 0.0]))
    move = (0.3 * drift).tolist()
    drive = VelocityBox(box, move, start=0.1, end=9.0).in_frame(frame)
    place = rand(500, 3) * torch.tensor([1.0, 0.6, 0.6])
    for time in (0.1, 0.4):
        nodes = Nodes(double(time), 1e-3, frame.point_to_sim(place))
        driven = (drive(torch.zeros_like(place), nodes) != 0).any(-1)
        # 0.3 m/s are 0.6 scene units a second
        gone = place - double([0.6 * (time - 0.1), 0, 0])
        assert torch.equal(driven, box.contains(gone))
        assert torch.equal(driven, box.contains(place)) == (time == 0.1)
