import math

import pytest
import torch
from shared import EYE, double, near, normalized, rand, randn, unit
from torch.testing import assert_close

from gaussian_swaying.geometry.directions import axes_across, hull_area, spread_lines
from gaussian_swaying.geometry.rotations import quat_to_rotation


def test_lines_are_spread_evenly():
    """The second moment of directions is a third of the identity; a spiral of n points has it up to about 1 / n."""
    lines = spread_lines(100)
    assert_close(lines.norm(dim=-1), torch.ones(100).double())
    near(lines.mT @ lines / 100, EYE / 3, 0.01)
    assert lines[:, 2].min() > 0


@pytest.mark.parametrize("count", [1, 7, 100])
def test_lines_are_in_the_middle_of_bands_of_equal_area(count):
    found = spread_lines(count)[:, 2].square().mean()
    assert float(found) == pytest.approx(1 / 3 - 1 / (12 * count**2), rel=1e-12)


def test_no_two_lines_of_a_spiral_are_close():
    """In a lattice of triangles with the area 2 pi / n for each line, neighbours are sqrt(4 pi / (sqrt(3) n)) apart.

    With the golden angle the square of the least distance is two thirds of that; with other angles it is less.
    """
    lines = spread_lines(100)
    apart = torch.cdist(lines, lines).fill_diagonal_(math.inf)
    assert apart.amin() ** 2 > 0.64 * 4 * math.pi / (math.sqrt(3) * 100)


def test_axes_across_make_a_right_handed_frame():
    lines = torch.cat([spread_lines(50), EYE])
    first, second = axes_across(lines)
    frame = torch.stack([first, second, lines], dim=-1)
    assert_close(frame.mT @ frame, EYE.expand(53, 3, 3))
    assert_close(torch.linalg.det(frame), torch.ones(53).double())


def test_hull_of_a_box_a_ball_and_a_sheet():
    """Exact up to the outline with 128 sides and 100 directions: a percent."""
    rotation, scale = quat_to_rotation(unit(4)), 30.0
    box = rand(5000, 3)
    corners = torch.cartesian_prod(*(double([0.0, 1.0]),) * 3)
    sides = double([1.0, 0.5, 0.2])
    found = hull_area(torch.cat([box, corners]) * sides @ rotation.mT * scale + 100)
    assert found == pytest.approx(2 * (0.5 + 0.2 + 0.1) * scale**2, rel=0.01)
    ball = unit(20_000, 3)
    assert hull_area(ball) == pytest.approx(4 * math.pi, rel=0.01)
    assert hull_area(corners * torch.tensor([1.0, 1.0, 0.0])) == pytest.approx(2.0, rel=0.01)


def test_hull_of_a_body_with_holes_is_that_of_its_corners():
    ring = normalized(randn(5000, 3)[:, :2])
    flat = torch.nn.functional.pad(ring, (0, 1))
    assert hull_area(flat) == pytest.approx(2 * math.pi, rel=0.01)


@pytest.mark.parametrize("count", [0, 1, 2])
def test_hull_of_few_points_has_no_area(count):
    assert hull_area(torch.rand(count, 3)) == 0.0
