"""Constants of the closed forms, against the laws and the measurements that they come from."""

import math

import pytest
import torch
from shared import double
from torch.testing import assert_close

from gaussian_swaying.wind.obstacle_flow import carlson_rd, plane_wake, round_wake

DOUBLE = torch.float64


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
