"""Planes: contact, friction, and nothing on the free side."""

import math

import pytest
import torch
from torch.testing import assert_close

from gaussian_swaying.mpm.boundaries.plane import Plane, plane_velocity

from .bodies import block, run_for

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
    assert_close(plane_velocity(into, UP, "separate", 0.5), torch.tensor([[2.0, 0, 0]]).double())
    assert plane_velocity(into, UP, "separate", 5.0).tolist() == [[0, 0, 0]]
    assert plane_velocity(torch.zeros(1, 3), UP.float(), "separate", 0.5).tolist() == [[0, 0, 0]]


@pytest.mark.parametrize("length", [1e-3, 1.0, 50.0])
def test_the_length_of_the_normal_does_not_matter(length):
    plane = Plane([0.0, 0.0, 0.0], [0.6 * length, 0.0, -0.8 * length])
    assert_close(plane.normal, torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_block_slides_down_an_incline_with_coulombs_acceleration(formulation):
    """Static below the friction angle; a = g (sin - mu cos) above. Gravity is tilted instead of the plane."""
    angle, points = math.radians(30), block()
    gravity = (9.8 * math.sin(angle), 0.0, -9.8 * math.cos(angle))
    seconds = 0.4
    # the lowest nodes are in contact from the start, so nothing bounces
    plane = Plane([0, 0, 0.06], [0, 0, 1], "separate", 0.2)
    x, _, z = run_for(formulation, [plane], points, seconds, gravity=gravity).velocity.mean(0).tolist()
    # mu times the momentum that the plane gave upwards, less what bulging turns aside, more at the slow start
    lost = 9.8 * seconds * math.sin(angle) - x
    assert lost == pytest.approx(0.2 * (9.8 * seconds * math.cos(angle) + z), rel=0.03)
    assert abs(z) < 0.05 * 9.8 * seconds
    # damped, so that it does not hop: with mu = 1 it leans by less than twice the static g sin m c, c as above
    plane = Plane([0, 0, 0.06], [0, 0, 1], "separate", 1.0)
    held = run_for(formulation, [plane], points, seconds, gravity=gravity, damping=30.0)
    leans = 9.8 * math.sin(angle) * (0.4 * 2.6 + 0.6) * 0.4**2 * 100 / 2e4
    assert float((held.position - points.position)[:, 0].mean()) < 2 * leans
