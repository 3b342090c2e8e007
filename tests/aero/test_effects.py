"""Mean winds that grow with the height, against their formulas."""

import math

import pytest
import torch

from gaussian_swaying.aero.effects import LogProfile, Moment, PowerProfile

NOW = Moment(torch.zeros((), dtype=torch.float64), torch.zeros(3).double(), torch.zeros(3).double())


def speeds(profile, heights):
    """Speed at some heights above the origin, in a wind of 8 m/s."""
    place = torch.zeros(len(heights), 3, dtype=torch.float64)
    place[:, 2] = torch.tensor(heights)
    wind = profile(torch.tensor([8.0, 0.0, 0.0], dtype=torch.float64), place, NOW)
    assert wind[:, 1:].abs().max() == 0
    return wind[:, 0].tolist()


def test_the_logarithmic_profile():
    profile = LogProfile(ground=(0.0, 0.0, -2.0), height=10.0, roughness=0.1)
    found = speeds(profile, [8.0, -1.0, -1.95, -5.0])  # 10 m, 1 m, below the roughness, and below the ground
    assert found == pytest.approx([8.0, 8.0 * math.log(10) / math.log(100), 0.0, 0.0])


def test_the_power_law():
    found = speeds(PowerProfile(ground=(0.0, 0.0, 1.0), height=10.0, exponent=0.2), [11.0, 1.3125, 0.5])
    assert found == pytest.approx([8.0, 8.0 * 0.03125**0.2, 0.0])  # 0.03125 is half to the fifth


def test_a_roughness_above_the_height_is_refused():
    with pytest.raises(ValueError, match=r"Expected `roughness` .* to be below `height`"):
        LogProfile(height=1.0, roughness=2.0)
