"""Steps in the plane of the wind's components."""

import math

import pytest
import torch
from shared import double, peak

from gaussian_swaying.inverse.evidence import Block
from gaussian_swaying.inverse.fit import REACH, Progress, iterate, straight
from gaussian_swaying.inverse.unknowns import Unknown

SOUGHT = [
    Unknown("wind.speed", 0.5, 16.0, "log"),
    Unknown("material.E", 1e3, 1e5, "log"),
    Unknown("wind.azimuth", -80.0, 160.0),
]


def _components(place):
    speed, angle = SOUGHT[0].value(float(place[0])), math.radians(SOUGHT[2].value(float(place[2])))
    return speed * math.cos(angle), speed * math.sin(angle)


@pytest.mark.parametrize("size", [1e-4, 0.1])
def test_a_step_is_straight_in_the_plane(size):
    """Halves of it lie on the way of the whole; its begin is that of speed and azimuth; E is added."""
    place, step = double([0.4, 0.3, 0.5]), size * torch.tensor([0.7, 0.2, -1.0]).double()
    take = straight(SOUGHT)
    begin, middle, end = (_components(take(place, share * step)) for share in (0.0, 0.5, 1.0))
    assert middle == pytest.approx([0.5 * (a + b) for a, b in zip(begin, end, strict=True)], rel=1e-9)
    moved = take(place, step) - place
    assert float(moved[1]) == pytest.approx(0.2 * size)
    if size < 1e-3:
        assert moved.tolist() == pytest.approx(step.tolist(), rel=1e-3)
    else:
        assert not torch.allclose(moved, step, rtol=0.05)


def test_a_step_is_added_without_an_azimuth_and_from_no_wind_on():
    place, step = double([0.0, 0.5]), double([0.1, -0.2])
    for sought in (SOUGHT[:2], [Unknown("wind.speed", 0.0, 10.0), SOUGHT[2]]):
        assert torch.equal(straight(sought)(place, step), place + step)


def test_a_wind_across_a_sheet_is_found_in_few_steps():
    """The wind across is seen forty times as well as that along the sheet, so the valley is straight in the plane."""
    wanted, across = _components([0.5, 0.5, 0.7]), double([math.cos(0.3), math.sin(0.3)])
    along = torch.stack([-across[1], across[0]])

    def valley(places):
        off = double([_components(place) for place in places]) - torch.tensor(wanted)
        values = torch.stack([20 * off @ across, 0.5 * off @ along, places[:, 1] - 0.5], -1)
        return [Block("tracks", values[:, :, None], torch.arange(3))]

    taken = []
    for retract in (straight(SOUGHT), torch.add):
        progress = Progress(double([0.55, 0.3, 0.45]))
        while not progress.done and progress.iteration < 60:
            iterate(valley, lambda blocks: {"tracks": 1.0}, progress, 1e-6, retract=retract)
        taken.append(progress.iteration)
        assert progress.place.tolist() == pytest.approx([0.5, 0.5, 0.7], abs=1e-3)
    assert taken[0] < 8
    assert taken[1] > 2 * taken[0]


@pytest.mark.parametrize("step", [[-0.25, 0.0, 0.0], [0.0, 0.0, 0.25], [-0.25, 0.0, -0.25], [0.1, 0.25, 0.25]])
def test_no_step_is_too_long(step):
    """Against the wind, the end on the line would have a far lower speed."""
    place, step = double([0.9, 0.3, 0.5]), double(step)
    moved = straight(SOUGHT)(place, step) - place
    assert peak(moved) <= 1.001 * REACH
    assert peak(moved) > 0.05


def test_a_wind_does_not_blow_back():
    place = double([0.5, 0.5, 0.5])
    end = straight([Unknown("wind.speed", 0.5, 16.0), *SOUGHT[1:]])(place, torch.tensor([-1.0, 0.0, 0.1]).double())
    assert abs(float(end[2] - place[2])) <= REACH
    assert float(end[0]) < 0.5


def test_an_azimuth_with_a_logarithmic_scale_stays_in_its_range():
    sought = [SOUGHT[0], Unknown("wind.azimuth", 1.0, 90.0, "log")]
    end = straight(sought)(torch.tensor([0.4, 0.3]).double(), torch.tensor([-0.1, -0.25]).double())
    assert end.isfinite().all()
    assert float(end[1]) >= 0
