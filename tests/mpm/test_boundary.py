"""Each boundary acts where and when it says, and nowhere else."""

import math

import pytest
import torch

from gaussian_swaying.gaussians.selection import Box, Sphere
from gaussian_swaying.mpm.boundary import EnclosingBox, PinnedRegion, Plane, VelocityBox, plane_velocity
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
    points = MaterialPoints(*(torch.cat(pair) for pair in zip(_fields(inside), _fields(outside), strict=True)))
    drive = VelocityBox(Box([-0.5, -0.5, -0.5], [1.5, 1, 1]), [0.5, 0.0, 0.0])
    state = _run(formulation, [drive], points, 0.2, gravity=(0, 0, 0))
    half = inside.count
    torch.testing.assert_close(state.velocity[:half, 0], torch.full((half,), 0.5, dtype=torch.float64))
    assert float(state.velocity[half:].abs().max()) == 0.0


def _fields(points):
    return [points.position, points.mass, points.volume, points.youngs_modulus, points.poisson_ratio]


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize(
    "make",
    [
        lambda start, end: PinnedRegion(Sphere([0.2, 0.2, 0.2], 2.0), start=start, end=end),
        lambda start, end: Plane([0, 0, 5], [0, 0, 1], "sticky", start=start, end=end),
        lambda start, end: VelocityBox(Box([-9, -9, -9], [9, 9, 9]), [0, 0, 0], start=start, end=end),
        lambda start, end: EnclosingBox([-9, -9, 5], [9, 9, 9], "sticky", start=start, end=end),
    ],
    ids=["pin", "plane", "velocity", "box"],
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
    assert float(_run(formulation, [make(0.1, None)], points, 0.12).velocity.abs().max()) == 0.0


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_pin_holds_only_its_end(formulation):
    points = _block()
    pin = PinnedRegion(Box([None, None, 0.34], [None, None, None]))
    state = _run(formulation, [pin], points, 0.3)
    held = points.position[:, 2] > 0.34
    moved = (state.position - points.position).norm(dim=-1)
    assert float(moved[held].max()) < 0.01
    # the static sag of a rod this long is 2 mm; `updated` holds all nodes that the pinned layer touches
    assert float(moved[~held].max()) > 0.002


def test_pin_that_holds_nothing_is_an_error():
    points = _block()
    with pytest.raises(ValueError, match=r"pin Sphere.* holds no particle: .* move or enlarge `region`"):
        MPMSolver(dx=0.1, boundaries=[PinnedRegion(Sphere([9, 9, 9], 0.1))]).init_state(points)
    # one particle among many at a node: it holds less than the share
    pin = PinnedRegion(Sphere([0.2333, 0.2333, 0.2333], 0.03), held_share=0.9)
    with pytest.raises(ValueError, match=r"no grid node.*lower its `held_share`"):
        MPMSolver(dx=0.4, boundaries=[pin]).init_state(points)


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
    ],
)
def test_bad_boundaries_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
