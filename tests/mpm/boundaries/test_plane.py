"""Planes: contact, friction, and nothing on the free side."""

import math

import pytest
import torch

from gaussian_swaying.mpm.boundaries.plane import Plane, plane_velocity

FORMULATIONS = ["total", "updated"]
UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


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


@pytest.mark.parametrize("length", [1e-3, 1.0, 50.0])
def test_the_length_of_the_normal_does_not_matter(length):
    plane = Plane([0.0, 0.0, 0.0], [0.6 * length, 0.0, -0.8 * length])
    torch.testing.assert_close(plane.normal, torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64))


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("kind", ["sticky", "slip", "separate"])
def test_plane_holds_a_falling_block_on_its_free_side(formulation, kind, block, run_for):
    points = block(low=(0, 0, 0.05))
    state = run_for(formulation, [Plane([0, 0, 0], [0, 0, 1], kind)], points, 0.6)
    assert -0.1 < float(state.position[:, 2].min()) < 0.12
    assert float(state.position[:, 2].max()) > 0.25


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_plane_does_not_act_on_the_free_side(formulation, block, run_for):
    """A plane far below does not change free fall."""
    points = block(low=(0, 0, 1.0))
    state = run_for(formulation, [Plane([0, 0, -5], [0, 0, 1], "sticky")], points, 0.2)
    free = run_for(formulation, [], points, 0.2)
    torch.testing.assert_close(state.position, free.position, rtol=0, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_slip_slides_and_sticky_sticks(formulation, block, run_for):
    """PhysGaussian's slip planes stick; ours keep the tangential speed."""
    points = block(low=(0, 0, 0.05))
    velocity = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64).expand_as(points.position)
    speed = {}
    for kind, friction in (("slip", 0.0), ("separate", 0.0), ("separate", 0.6), ("sticky", 0.0)):
        state = run_for(formulation, [Plane([0, 0, 0], [0, 0, 1], kind, friction)], points, 0.4, velocity)
        speed[kind, friction] = float(state.velocity[:, 0].mean())
    assert speed["slip", 0.0] == pytest.approx(1.0, abs=1e-6)
    assert speed["separate", 0.0] == pytest.approx(1.0, abs=1e-6)
    assert speed["separate", 0.6] < 0.5
    assert abs(speed["sticky", 0.0]) < 0.5


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_block_slides_down_an_incline_with_coulombs_acceleration(formulation, block, run_for):
    """Static below the friction angle; a = g (sin - mu cos) above. Gravity is tilted instead of the plane."""
    angle, points = math.radians(30), block()
    gravity = (9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle))
    seconds = 0.4
    for friction in (0.2, 1.0):
        # the lowest nodes are in contact from the start, so nothing bounces
        plane = Plane([0, 0, 0.06], [0, 0, 1], "separate", friction)
        state = run_for(formulation, [plane], points, seconds, gravity=gravity)
        expected = 9.8 * seconds * max(math.sin(angle) - friction * math.cos(angle), 0.0)
        assert float(state.velocity[:, 0].mean()) == pytest.approx(expected, abs=0.12 * 9.8 * seconds * math.sin(angle))
