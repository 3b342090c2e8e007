"""The wind as a copy feels it: in its own axes, at its own place, later, with gusts of its own."""

import math

import pytest
import torch
from shared import double
from torch.testing import assert_close

from gaussian_swaying import GaussianGust, SineSway, SpatialWind, WindField
from gaussian_swaying.wind.copied_wind import CopiedWind
from gaussian_swaying.wind.effects import PowerProfile

TIMES = torch.linspace(0.0, 3.0, 13, dtype=torch.float64)
NONE = torch.zeros(3, dtype=torch.float64)


def _turn(degrees):
    s, c = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return double([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class Whirl(SpatialWind):
    """Air that turns about the origin."""

    def forward(self, time, position):
        return torch.stack([-position[..., 1], position[..., 0], torch.zeros_like(position[..., 0])], dim=-1)


def _gusty(seed=3):
    return WindField([4.0, 1.0, 0.5], modulations=[SineSway(phase=0.3), GaussianGust(0.5)], seed=seed)


def test_without_values_it_is_the_wind():
    wind = _gusty()
    assert torch.equal(CopiedWind(wind, _turn(0.0), NONE)(TIMES), wind(TIMES))


def test_a_turned_copy_feels_the_wind_from_its_other_side():
    """Turned by 90 degrees counterclockwise, its own x axis is y of the scene: wind along y is wind along its x."""
    found = CopiedWind(WindField([0.0, 2.0, 0.0]), _turn(90.0), NONE)(TIMES)
    assert_close(found, double([[2.0, 0.0, 0.0]]).expand_as(found))


def test_gusts_come_later_or_are_others():
    wind = _gusty()
    assert torch.equal(CopiedWind(wind, _turn(0.0), NONE, delay=0.7)(TIMES), wind(TIMES - 0.7))
    assert torch.equal(CopiedWind(wind, _turn(0.0), NONE, seed=8)(TIMES), _gusty(8)(TIMES))
    assert wind.seed == 3


@pytest.mark.parametrize("wind", [Whirl(), WindField([4.0, 1.0, 0.0], effects=[PowerProfile(height=2.0)])])
def test_a_wind_that_varies_in_space_is_that_at_the_place_of_the_copy(wind):
    turn, shift = _turn(30.0), double([2.0, -1.0, 0.5])
    copied, place, now = CopiedWind(wind, turn, shift), torch.rand(5, 3, dtype=torch.float64), TIMES[2]
    there = (turn @ place.T).T + shift
    wanted = wind.at(now, there) if isinstance(wind, WindField) else wind(now, there)
    assert_close((turn @ copied(now, place).T).T, wanted)
    assert not copied.uniform


def test_what_can_be_recorded_in_a_graph():
    """Winds of the package, but none with a `forward` of its own that is not known to be recordable."""

    class Own(WindField):
        pass

    for wind, known in ((_gusty(), True), (Own([1.0, 0.0, 0.0]), False), (Whirl(), False)):
        assert CopiedWind(wind, _turn(0.0), NONE).recordable is known


def test_a_wind_of_ones_own_has_no_seed():
    with pytest.raises(ValueError, match=r"`copies\.seed` null with a wind of your own.*use `delay`"):
        CopiedWind(Whirl(), _turn(0.0), NONE, seed=1)
