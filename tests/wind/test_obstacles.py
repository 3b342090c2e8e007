"""Flow round bodies: no divergence, no rotation, nothing through the surface, and closed forms at special places."""

import math

import pytest
import torch
from shared import double
from torch.testing import assert_close

from gaussian_swaying import SimFrame, WindField
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.wind import effects
from gaussian_swaying.wind.effects import CylinderObstacle, EllipsoidObstacle, Moment, wake_start

DOUBLE = torch.float64
FLOW = double([2.0, -0.7, 0.4])
AXIS = torch.nn.functional.normalize(double([0.3, 0.1, 1.0]), dim=0)
RADII = (0.7, 1.3, 0.4)
plane_wake = on_tensors(effects.plane_wake)


def round_wake(behind, aside, width, drag):
    """The wake of a body with a drag below one."""
    return on_tensors(effects.round_wake)(behind, aside, width, drag, wake_start(drag))


def carlson_rd(x, y, z):
    """Carlson's integral in double precision."""
    return on_tensors(effects.carlson_rd)(x, y, z, 9)


def around(obstacle, flow, place):
    """The flow of a wind round an obstacle without a wake."""
    return obstacle(flow, place, Moment(flow[0], flow, flow))


def cylinder(axis, radius):
    """A cylinder through the origin."""
    return CylinderObstacle([0.0] * 3, radius, axis=axis.tolist(), drag=0.0)


def ellipsoid(radii):
    """An ellipsoid at the origin."""
    return EllipsoidObstacle([0.0] * 3, list(radii), drag=0.0)


FLOWS = {
    "cylinder": lambda x: around(cylinder(AXIS, 0.8), FLOW, x),
    "ellipsoid": lambda x: around(ellipsoid(RADII), FLOW, x),
}


def _directions(count=40):
    draw = torch.randn(count, 3, dtype=DOUBLE, generator=torch.Generator().manual_seed(0))
    return torch.nn.functional.normalize(draw, dim=-1)


def _surface(name):
    """Points of a surface just outside of it, and its normals."""
    direction = _directions()
    if name == "ellipsoid":
        x = direction * double(RADII)
        return x * (1 + 1e-15), torch.nn.functional.normalize(direction / double(RADII), dim=-1)
    direction = torch.nn.functional.normalize(direction - (direction @ AXIS)[:, None] * AXIS, dim=-1)
    return 0.8 * direction * (1 + 1e-15) + 3 * AXIS, direction


@pytest.mark.parametrize("name", FLOWS)
def test_the_flow_is_a_potential_one_round_the_body(name):
    """Neither divergence nor rotation, nothing through the surface, the wind far away and still air inside."""
    flow = FLOWS[name]
    place = 1.5 * _directions() * torch.linspace(1, 3, 40, dtype=DOUBLE)[:, None]
    slope = torch.func.vmap(torch.func.jacrev(lambda x: flow(x[None])[0]))(place)
    assert slope.abs().max() > 0.1
    assert torch.einsum("nii->n", slope).abs().max() < 1e-12
    assert (slope - slope.mT).abs().max() < 1e-12
    place, normal = _surface(name)
    found = flow(place + 1e-13 * normal)
    assert found.norm(dim=-1).max() > 1.0  # it is outside
    assert (found * normal).sum(-1).abs().max() < 1e-11
    assert_close(flow(1e4 * (_directions() + double([2.0, 0.0, 0.0]))), FLOW.expand(40, 3), rtol=0, atol=1e-6)
    assert flow(0.1 * _directions()).abs().max() == 0.0


def test_closed_forms():
    """Lamb: twice the flow at the side of a cylinder."""
    x, y = torch.eye(3, dtype=DOUBLE)[:2]
    z = double([0.0, 0.0, 1.0])
    assert_close(around(cylinder(z, 1.0), x + z, 1.0 * y), 2 * x + z)
    assert_close(around(cylinder(z, 1.0), x + z, -2.0 * x), 0.75 * x + z)


def test_ellipsoids_become_spheres_and_cylinders():
    """The sphere's flow is v + (R / r)^3 / 2 (v - 3 (v n) n) (Lamb 92)."""
    place, normal = 1.2 * _directions(), _directions()
    sphere = FLOW + 0.5 * (0.8 / 1.2) ** 3 * (FLOW - 3 * (normal @ FLOW)[:, None] * normal)
    assert_close(around(ellipsoid((0.8,) * 3), FLOW, place), sphere, rtol=0, atol=1e-13)
    z = double([0.0, 0.0, 1.0])
    long = around(ellipsoid((0.8, 0.8, 8e5)), FLOW, place)
    assert_close(long, around(cylinder(z, 0.8), FLOW, place), rtol=0, atol=1e-9)


def test_the_side_of_a_spheroid():
    """Lamb 104: virtual mass of a prolate spheroid along its axis; the flow at its side is 1 + k times the wind."""
    e = math.sqrt(1 - 0.25)
    alpha = 2 * (1 - e * e) / e**3 * (0.5 * math.log((1 + e) / (1 - e)) - e)
    k = alpha / (2 - alpha)
    found = around(ellipsoid((1, 0.5, 0.5)), double([1.0, 0, 0]), double([[0.0, 0.5 + 1e-13, 0.0]]))
    assert found[0].tolist() == pytest.approx([1 + k, 0.0, 0.0], abs=1e-11)


def test_carlsons_integral():
    """Values of the paper."""
    x, y, z = (double(v) for v in (1e-300, 2.0, 1.0))
    assert float(carlson_rd(x, y, z)) == pytest.approx(1.7972103521033883, rel=1e-12)
    x, y, z = (double(v) for v in (2.0, 3.0, 4.0))
    assert float(carlson_rd(x, y, z)) == pytest.approx(0.16510527294261053, rel=1e-13)


def test_wakes_take_the_momentum_of_the_drag():
    """The integral of u (U - u) is half of C_D times the width, or the disc, wherever the wake is developed."""
    y = torch.linspace(-40, 40, 400001, dtype=DOUBLE)
    for behind in (10.0, 40.0, 100.0):
        share = plane_wake(torch.full_like(y, behind), y, 0.5, 1.2)
        assert float(torch.trapezoid(share * (1 - share), y)) == pytest.approx(0.5 * 1.2 * 0.5, rel=1e-6)
        r = y[200000:]
        share = round_wake(torch.full_like(r, behind), r, 0.5, 0.47)
        lost = float(torch.trapezoid(2 * math.pi * r * share * (1 - share), r))
        assert lost == pytest.approx(0.5 * 0.47 * math.pi * 0.25**2, rel=1e-6)
    for wake in (lambda x: plane_wake(x, 0 * x, 0.5, 1.2), lambda x: round_wake(x, 0 * x, 0.5, 0.47)):
        share = wake(torch.linspace(-3, 60, 500, dtype=DOUBLE))
        assert share[:20].abs().max() == 0.0
        assert 0.3 < share.max() < 1
        assert (share[100:].diff() < 0).all()


@pytest.mark.parametrize("turn", [0.0, 30.0])
def test_obstacles_in_a_frame_are_those_of_the_scene(turn):
    """Scaled by two, turned by a quarter about x and moved."""
    rotation = double([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    frame = SimFrame(double([1.0, 2.0, 3.0]), rotation, 2.0)
    scene = double([[1.9, 2.6, 3.2], [0.4, 1.2, 2.4]])
    flow = double([1.0, 0.3, -0.2])
    here, there = Moment(flow[0], flow, flow), Moment(flow[0], flow @ rotation.T, 2 * flow @ rotation.T)
    for obstacle in (
        CylinderObstacle([1.0, 2.5, 3.0], 0.4, axis=[0.0, 1.0, 1.0]),
        EllipsoidObstacle([1.0, 2.5, 3.0], [0.2, 0.5, 0.4], turn=turn, drag=0.0),
    ):
        expected = obstacle(flow, scene, here)
        moved = obstacle.in_frame(frame)
        found = moved(flow @ rotation.T, frame.point_to_sim(scene), there) @ rotation
        assert_close(found, expected)
        assert (expected - flow).abs().max() > 0.05
        assert list(obstacle.center) == [1.0, 2.5, 3.0]


def test_a_wall_shelters_what_is_behind_it():
    wall = EllipsoidObstacle([0.0, 0.0, 0.0], [0.1, 1.0, 0.8], drag=0.9)
    wind = WindField([4.0, 0.0, 0.0], effects=[wall])
    place = torch.tensor([[-5.0, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, 4.0, 0.0], [0.0, 1.1, 0.0]])
    front, behind, aside, edge = wind.at(torch.zeros((), dtype=DOUBLE), place)[:, 0].tolist()
    assert front == pytest.approx(4.0, rel=0.05)
    assert behind < 2.2
    assert aside == pytest.approx(4.0, rel=0.1)
    assert edge > 5.0


def test_still_air_stays_still():
    for obstacle in (
        CylinderObstacle([0.0] * 3, 0.5),
        EllipsoidObstacle([0.0] * 3, [1, 1, 2]),
    ):
        wind = WindField([0.0, 0.0, 0.0], effects=[obstacle])
        found = wind.at(double(1.0), 2 * _directions())
        assert torch.equal(found, torch.zeros_like(found))


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: CylinderObstacle([0.0] * 3, -1.0), "`radius` to be positive"),
        (lambda: EllipsoidObstacle([0.0] * 3, [1.0] * 3, drag=1.2), "`drag` of an ellipsoid to be below 1"),
        (lambda: CylinderObstacle([0.0] * 3, 1.0, axis=[0.0] * 3), "`axis` to have a direction"),
        (lambda: EllipsoidObstacle([0.0] * 3, [1.0, 2.0]), "`radii` to have 3 numbers"),
    ],
)
def test_impossible_obstacles_are_refused(make, words):
    with pytest.raises(ValueError, match=words):
        make()


def test_a_plane_wake_has_half_of_its_depth_where_it_was_measured():
    """Wygnanski and others: at 0.29 sqrt(theta x) from its middle."""
    width, drag = 0.3, 1.1
    theta = 0.5 * drag * width
    behind = double([4.0, 9.0, 30.0])
    middle = plane_wake(behind, torch.zeros_like(behind), width, drag)
    edge = plane_wake(behind, 0.29 * (theta * behind).sqrt(), width, drag)
    assert_close(edge / middle, torch.full_like(behind, 0.5), rtol=0, atol=1e-14)


@pytest.mark.parametrize("behind", [1e-3, 0.1, 0.5])
def test_a_plane_wake_takes_the_momentum_right_behind_the_body(behind):
    """The integral of u (U - u): half of C_D times the width. The least wide wake takes it with its largest depth."""
    y = torch.linspace(-3, 3, 20001, dtype=DOUBLE)
    share = plane_wake(torch.full_like(y, behind), y, 0.3, 1.1)
    assert float(torch.trapezoid(share * (1 - share), y)) == pytest.approx(0.5 * 1.1 * 0.3, rel=1e-9)
    assert float(share.max()) == pytest.approx(math.sqrt(0.5))


def test_a_round_wake_widens_by_a_twentieth():
    """Bastankhah & Porté-Agel in gusty wind; its standard deviation from its value at a place and in its middle."""
    behind, aside = double([2.0, 6.0, 12.0]), double(0.3)
    ratio = round_wake(behind, aside, 0.5, 0.47) / round_wake(behind, 0 * aside, 0.5, 0.47)
    sigma = aside / (-2 * ratio.log()).sqrt()
    assert_close(sigma.diff() / behind.diff(), double([0.05, 0.05]))


@pytest.mark.parametrize(("apart", "error"), [(0.5, 1e-14), (10, 1e-14), (1e12, 1e-14), (1e40, 1e-12)])
def test_carlsons_integral_of_two_equal_arguments(apart, error):
    """R_D(x, x, z) in closed form (DLMF 19.20.20, 19.2.18), with z = 1 + apart in units of x.

    To some roundings; at 1e40 the first two terms of the series are 2.5e-8 and 2.2e-11, those left out 3.2e-13.
    """
    x = double(0.7)
    found = float(carlson_rd(x, x, x * (1 + apart))) * 0.7**1.5
    root = math.sqrt(apart)
    expected = 3 * (math.asinh(root) / root - 1 / math.sqrt(1 + apart)) / apart
    assert found == pytest.approx(expected, rel=error, abs=0)
