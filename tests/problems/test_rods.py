"""Rods thinner than a cell."""

import math

import pytest
import torch
from bench.problems.rods import rod, section
from bench.problems.settings import Settings


@pytest.mark.parametrize("count", [3, 4, 8])
def test_a_section_has_the_second_moment_of_a_disc(count):
    across = section(0.3, count)
    moments = across.T @ across / count * math.pi * 0.3**2 / 4
    torch.testing.assert_close(moments, torch.eye(2, dtype=torch.float64) * math.pi * 0.3**4 / 64)


@pytest.mark.parametrize("axis", [(1.0, 0.0, 0.0), (1.0, 0.5, 0.3)])
def test_a_rod_of_a_third_of_a_cell_bends_with_its_own_stiffness(axis):
    found = rod(Settings(), 0.3, (0.25, 0.13, 0.4), axis, length=8.0)
    assert found["error"] < 0.06
    assert 0 < found["lowest"] <= found["highest"]
