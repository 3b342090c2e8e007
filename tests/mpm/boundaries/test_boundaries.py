"""Each boundary acts only where and when it should.

Covers: mpm.boundaries.ball, mpm.boundaries.block, mpm.boundaries.boundary, mpm.boundaries.capsule,
mpm.boundaries.half_space, mpm.boundaries.mesh, mpm.boundaries.boundary, mpm.boundaries.pinned_points,
mpm.boundaries.still_gaussians.
"""

import copy
import dataclasses
import math
import re
from pathlib import Path
from pkgutil import iter_modules

import pytest
import torch

from gaussian_swaying.geometry.distance import DistanceGrid
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.geometry.regions import Box, Cylinder, Everything, Not, Sphere, Union
from gaussian_swaying.mpm import boundaries
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.block import BoxObstacle
from gaussian_swaying.mpm.boundaries.boundary import Nodes
from gaussian_swaying.mpm.boundaries.capsule import CapsuleObstacle
from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
from gaussian_swaying.mpm.boundaries.half_space import HalfSpaceObstacle
from gaussian_swaying.mpm.boundaries.handle import Handle
from gaussian_swaying.mpm.boundaries.impulse import Impulse
from gaussian_swaying.mpm.boundaries.mesh import MeshObstacle
from gaussian_swaying.mpm.boundaries.pinned_points import PinnedPoints
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.boundaries.rigid_region import RigidRegion
from gaussian_swaying.mpm.boundaries.sequential_release import SequentialRelease
from gaussian_swaying.mpm.boundaries.still_gaussians import StillGaussians
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
from gaussian_swaying.mpm.solver import MPMSolver

FORMULATIONS = ["total", "updated"]
MOVING = KeyedPath([0.0, 0.2], [[0, 0, 0], [0.1, 0.05, 0]], [[0, 0, 0], [10, 20, 30]])
MESH = str(Path(__file__).with_name("octahedron.obj"))
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
    "ball": lambda r: BallObstacle([0.1, 0.2, 0.2], 0.15, 0.3, end=0.5),
    "ball-moving": lambda r: BallObstacle([0.1, 0.2, 0.2], 0.15, 0.3, 0.01, MOVING, end=0.5),
    "capsule": lambda r: CapsuleObstacle([0.01, 0.13, 0.2], [0.31, 0.3, 0.13], 0.11, 0.3, path=MOVING, end=0.5),
    "block": lambda r: BoxObstacle([0.0, 0.1, 0.2], [0.3, 0.3, 0.4], [20, 0, 40], 0.3, path=MOVING, end=0.5),
    "ground": lambda r: HalfSpaceObstacle([0.1, 0.2, 0.2], [0.0, 0.3, 1.0], 0.3, path=MOVING, end=0.5),
    "mesh": lambda r: MeshObstacle(MESH, 12, [0.113, 0.207, 0.181], 0.3, path=MOVING, end=0.5),
    "rigid": lambda r: RigidRegion(r),
    "velocity-travels": lambda r: VelocityBox(r, [0.1, 0.2, 0.3], end=0.5, travels=True),
}


def _still():
    """A ball made of distances, as a simulation makes them of Gaussians."""
    axis = torch.arange(8, dtype=torch.float64) * 0.1 - 0.33
    nodes = torch.cartesian_prod(axis, axis, axis).reshape(8, 8, 8, 3)
    obstacle = StillGaussians(friction=0.3, end=0.5)
    obstacle.take(DistanceGrid((nodes - 0.03).norm(dim=-1) - 0.26, nodes[0, 0, 0], 0.1))
    return obstacle


METRES = {"still": lambda r: _still()}  # it is in metres, whatever the frame
POINTS = {"points": lambda r: PinnedPoints([[0.1, 0.2, 0.3], [0.3, 0.1, 0.2]], end=0.5)}  # they hold no nodes
REGIONS = {
    "everything": Everything(),
    "box": Box([None, 0.1, 0.23], [0.35, None, None]),
    "sphere": Sphere([0.1, 0.2, 0.2], 0.2),
    "cylinder": Cylinder([0.2, 0.2, 0.2], [1.0, 2.0, 0.5], 0.15, 0.3),
    "union": Union([Sphere([0.1, 0.1, 0.1], 0.15), Box([0.2, 0.2, 0.2], [0.4, 0.4, 0.4])]),
    "not": Not(Cylinder([0.2, 0.2, 0.2], [0.0, 0.0, 1.0], 0.15, 0.3)),
}
# every condition, and the one that evaluates its region in each substep with each kind of region
ACTING = (
    CONDITIONS
    | METRES
    | {
        f"velocity-{name}": lambda _, region=region: VelocityBox(region, [0.1, 0.2, 0.3], end=0.5)
        for name, region in REGIONS.items()
    }
)


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
        mass=torch.rand(200, generator=generator, dtype=torch.float64).to(device, dtype),
    )
    velocity = torch.randn(200, 3, generator=generator, dtype=torch.float64).to(device, dtype)
    return ACTING[name](Box([None, None, 0.23], [None] * 3)).in_frame(frame).to(device), velocity, nodes


def test_a_boundary_is_one_file():
    """Each file of the folder has one, except the shared files, and each is tested here."""
    files = {found.name for found in iter_modules(boundaries.__path__)} - {"boundary", "particle_boundary", "obstacle"}
    found = boundaries.BOUNDARIES
    assert {kind.__module__.rsplit(".", 1)[1] for kind in found.values()} == files
    assert len(found) == len(files)
    assert {type(make(Everything())) for make in (CONDITIONS | METRES | POINTS).values()} == set(found.values())


def test_the_documented_boundaries_are_those_that_there_are():
    page = (Path(__file__).parents[3] / "docs" / "configuration.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith("| `solver.boundaries`"))
    assert set(re.findall("`([A-Z][A-Za-z]+)`", row)) == set(boundaries.BOUNDARIES)


@pytest.mark.slow(
    gate=[
        "handle-updated",
        "slip-total",
        "friction-updated",
        "velocity-total",
        "box-sticky-total",
        "box-separate-total",
        "sticky-total",
        "pin-updated",
        "box-slip-total",
    ]
)
@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    "make",
    [
        lambda start, end: PinnedRegion(Sphere([0.2, 0.2, 0.2], 2.0), "nodes", start=start, end=end),
        lambda start, end: Handle(Sphere([0.2, 0.2, 0.2], 2.0), kind="nodes", start=start, end=end),
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
def test_time_windows(formulation, make, block, run_for):
    """Each of these stops everything, so the block falls only outside the time window."""
    points = block()
    assert float(run_for(formulation, [make(0.0, 0.1)], points, 0.1).velocity.abs().max()) == 0.0
    falling = torch.full((216,), -0.98, dtype=torch.float64)
    released = run_for(formulation, [make(0.0, 0.1)], points, 0.2)
    torch.testing.assert_close(released.velocity[:, 2], falling, rtol=1e-6, atol=0)
    later = run_for(formulation, [make(0.1, None)], points, 0.1)
    torch.testing.assert_close(later.velocity[:, 2], falling, rtol=1e-6, atol=0)
    assert float(run_for(formulation, [make(0.1, None)], points, 0.12).velocity.abs().max()) < 1e-14


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
@pytest.mark.parametrize("friction", [0.0, 0.7])
def test_plane_and_box_leave_alone_what_is_near_but_free(formulation, kind, friction, block, run_for):
    """Less than 1.5 cells away and coming closer, yet no node at or behind the plane: a rigid flight."""
    points = block(low=(0.16, 0.16, 0.16), per_side=4)
    low, high = 0.05, 0.65
    plane = Plane([0, 0, low], [0, 0, 2], kind, friction)
    ceiling = Plane([0, 0, high], [0, 0, -1], kind, friction)
    for boundary in (plane, ceiling, EnclosingBox([low] * 3, [high] * 3, kind, friction)):
        for sign in (1.0, -1.0):
            velocity = sign * torch.tensor([0.3, -0.2, 0.25], dtype=torch.float64).expand_as(points.position)
            state = run_for(formulation, [boundary], points, 0.04, velocity, gravity=(0, 0, 0))
            torch.testing.assert_close(state.velocity, velocity, rtol=0, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    "make", [Plane, lambda _, n, *a: EnclosingBox([-9, -9, 0.11 if n[2] > 0 else -9], [9] * 3, *a)]
)
def test_separate_lets_go_of_what_moves_away_and_slip_does_not(formulation, make, block, run_for):
    points = block(low=(0, 0, 0.05))
    low = 0.11  # behind it lie the lowest nodes of either formulation
    velocity = torch.tensor([0.3, 0.0, 1.0], dtype=torch.float64).expand_as(points.position)

    def run(kind, friction=0.0):
        boundary = make([0, 0, low], [0, 0, 1], kind, friction)
        return run_for(formulation, [boundary], points, 0.02, velocity, gravity=(0, 0, 0)).velocity

    torch.testing.assert_close(run("separate"), velocity, rtol=0, atol=1e-12)
    torch.testing.assert_close(run("separate", 0.8), velocity, rtol=0, atol=1e-12)
    slip = run("slip")
    assert float(slip[:, 2].mean()) < 0.8
    assert float(slip[:, 0].mean()) == pytest.approx(0.3, rel=1e-9)
    assert float(run("slip", 0.8)[:, 0].mean()) < 0.29  # friction follows the removed normal velocity
    assert float(run("sticky").mean(0)[0]) < 0.29


@pytest.mark.parametrize("name", ACTING)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_substep_may_be_a_tensor(name, dtype):
    boundary, velocity, nodes = _acting(name, "cpu", dtype)
    known = boundary(velocity, nodes)
    found = boundary(velocity, dataclasses.replace(nodes, dt=torch.tensor(nodes.dt, dtype=torch.float64)))
    assert found.dtype == dtype
    torch.testing.assert_close(found, known, rtol=1e-12 if dtype == torch.float64 else 1e-6, atol=0)
    assert not torch.equal(found, velocity)
    if name in ("handle", "impulse", "impulse-each"):  # values that depend on the substep
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
        # the substep is a tensor here and a number there, so velocities of 1 m/s are rounded in another order
        torch.testing.assert_close(recorded, boundary(velocity, now), rtol=1e-6, atol=4 * torch.finfo(dtype).eps)
        seen.append(recorded.clone())
    assert not torch.equal(seen[0], velocity)
    if name not in ("release", "front", "rigid"):  # the solver ends the first two; a rigid body never ends
        assert torch.equal(seen[3], velocity)


@pytest.mark.parametrize("name", CONDITIONS | POINTS)
def test_in_frame_leaves_the_original_alone(name, block):
    """A second frame, or a dtype change of the original, does not change the copy in metres either."""
    scene = block().position
    frame = SimFrame.fit(scene, up=(0.0, 1.0, 0.0), metres_per_unit=3.0)
    region = Box([None, None, 0.23], [None] * 3)
    boundary = (CONDITIONS | POINTS)[name](region)

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


@pytest.mark.parametrize(
    ("formulation", "name"), [(f, n) for f in FORMULATIONS for n in CONDITIONS] + [("total", n) for n in POINTS]
)
def test_conditions_can_be_copied_saved_and_narrowed(name, formulation, block, march):
    """A deep copy and a copy from the state dict give the same bits; float32 gives the same to round-off."""
    points = block(per_side=5)
    region = Box([None, None, 0.23], [None] * 3)
    boundary = (CONDITIONS | POINTS)[name](region)
    run = {"dx": 0.1, "formulation": formulation}
    push = 0.3 * points.position.flip(-1) if name == "rigid" else None  # which free fall does not strain
    known = march(MPMSolver(**run, boundaries=[boundary]), points, 2e-3, 6, push)[-1]
    twin = copy.deepcopy(boundary)
    for tensor in boundary.buffers():
        tensor.zero_()
    assert torch.equal(march(MPMSolver(**run, boundaries=[twin]), points, 2e-3, 6, push)[-1].position, known.position)
    loaded = MPMSolver(**run, boundaries=[boundary])
    loaded.load_state_dict(MPMSolver(**run, boundaries=[twin]).state_dict())
    assert torch.equal(march(loaded, points, 2e-3, 6, push)[-1].position, known.position)
    assert float((known.position - march(MPMSolver(**run), points, 2e-3, 6, push)[-1].position).abs().max()) > 1e-5

    loaded.init_state(points)
    narrow = loaded.to(torch.float32)
    end = march(narrow, points.map(lambda t: t.float()), 2e-3, 6, None if push is None else push.float())[-1]
    assert end.position.dtype == torch.float32
    torch.testing.assert_close(end.position.double(), known.position, rtol=0, atol=2e-6)


@pytest.mark.parametrize("name", ["pin", "handle", "release", "front", "impulse", "impulse-each"])
@pytest.mark.parametrize("framed", [False, True])
def test_region_that_holds_nothing_names_its_condition(name, framed, block):
    boundary, points = CONDITIONS[name](Sphere([9, 9, 9], 0.1)), block(low=(0.2, 0.2, 0.2), side=0.2)
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
def test_share_that_no_node_reaches_names_its_condition(kind, block):
    """One particle among many at a node: it holds less than the share."""
    pin = kind(Sphere([0.2333, 0.2333, 0.2333], 0.03), kind="nodes", held_share=0.9)
    with pytest.raises(ValueError, match=rf"no grid node.*`region` of the {kind.__name__} or lower its `held_share`"):
        MPMSolver(dx=0.4, boundaries=[pin]).init_state(block())


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Plane([0, 0, 0], [0, 0, 0]), "`normal` of the plane not to be zero"),
        (lambda: Plane([0, 0, 0], [0, 0, 1], "glue"), "`kind` to be one of sticky, slip, separate"),
        (lambda: Plane([0, 0], [0, 0, 1]), "`point` to have 3 numbers"),
        (lambda: Plane([0, 0, 0], [0, 0, 1], friction=-1), "`friction` to not be negative"),
        (lambda: Plane([0, 0, 0], [0, 0, 1], start=2.0, end=1.0), "`end` to be later than `start`"),
        (lambda: EnclosingBox([0, 0, 0], [1, 0, 1]), "`min` of the box to be below `max`"),
        (lambda: VelocityBox(Sphere([0, 0, 0], 1), [1, 2]), "`velocity` to have 3 numbers"),
        (lambda: PinnedRegion(Sphere([0, 0, 0], 1), held_share=1.0), "`held_share` to lie in"),
        (lambda: PinnedRegion(Sphere([0, 0, 0], 1), "glue"), "`kind` to be one of hinge, clamp, nodes"),
        (lambda: PinnedPoints([]), "`at` of the PinnedPoints to name at least one place"),
        (lambda: PinnedPoints([[0, 0]]), "`at` to have 3 numbers"),
        (lambda: PinnedPoints([[0, 0, 0]], "nodes"), "`kind` to be one of hinge, clamp"),
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
            "`last` of the SequentialRelease to be farther along",
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
