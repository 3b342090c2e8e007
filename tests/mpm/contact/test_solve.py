"""Normals and gaps of pairs of discs."""

import math

import pytest
import torch

from gaussian_swaying.mpm.contact.solve import pair_gaps


@pytest.mark.parametrize(
    ("arm", "normal", "distance"),
    [
        ((0.05, 0.28, 2.0), (0.0, 0.0, 1.0), 2.0),  # 0.284 from the axis of the first, high above it
        ((0.05, 0.31, -2.0), None, None),
        ((-2.0, 0.38, 0.05), (-1.0, 0.0, 0.0), 2.0),  # 0.383 from that of the second
        ((2.0, 0.41, 0.05), None, None),
        ((0.1, 0.05, 0.1), (math.sqrt(0.5), 0.0, math.sqrt(0.5)), math.sqrt(0.02)),  # near both
    ],
)
def test_a_disc_counts_if_the_centre_of_the_other_is_above_it(arm, normal, distance):
    """A disc of radius 0.3 that faces z, and one of 0.4 that faces x."""
    facing = torch.eye(3, dtype=torch.float64)[2:], torch.eye(3, dtype=torch.float64)[:1]
    radii = tuple(torch.tensor([radius], dtype=torch.float64) for radius in (0.3, 0.4))
    thickness = torch.tensor([0.01], dtype=torch.float64)
    found, gap, above = pair_gaps(torch.tensor([arm], dtype=torch.float64), facing, radii, thickness)
    assert bool(above) == (normal is not None)
    if normal is not None:
        assert found[0].tolist() == pytest.approx(normal)
        assert float(gap) == pytest.approx(distance - 0.01)
