import dataclasses

import pytest
import torch
from shared import value_error
from small_scenes import plain_cloud, together

from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.labelling import alike, connected


def sheet(turned=False, color=(0.5, 0.5, 0.5), shift=(0.0, 0.0, 0.0)):
    """A square of 10 x 10 flat Gaussians 0.1 apart, level or upright."""
    u, v = torch.meshgrid(torch.arange(10) * 0.1, torch.arange(10) * 0.1, indexing="ij")
    flat = torch.zeros(10, 10)
    places = torch.stack([flat, u, v] if turned else [u, v, flat], -1).reshape(-1, 3) + torch.tensor(shift)
    scales = [-6.0, -3.0, -3.0] if turned else [-3.0, -3.0, -6.0]
    cloud = plain_cloud(places, log_scales=scales)
    sh = ((torch.tensor(color) - 0.5) / SH_DC).expand(100, 1, 3)
    return dataclasses.replace(cloud, sh=sh)


def of(cloud, number):
    return torch.arange(len(cloud)) // 100 == number


def test_what_is_apart_is_not_connected():
    cloud = together(sheet(), sheet(shift=(1.4, 0.0, 0.0)), sheet(shift=(2.4, 0.0, 0.0)))
    assert torch.equal(connected(cloud, [0.0, 0.0, 0.0]), of(cloud, 0))
    assert torch.equal(connected(cloud, [2.0, 0.3, 0.4]), of(cloud, 1) | of(cloud, 2))
    assert connected(cloud, [0.0, 0.0, 0.0], reach=0.6).all()
    with value_error("`reach`"):
        connected(cloud, [0.0, 0.0, 0.0], reach=0.0)


def test_another_colour_or_a_fold_ends_a_part():
    floor, wall = sheet(), sheet(turned=True, shift=(0.95, 0.0, 0.0))
    cloud = together(floor, wall, sheet(color=(0.8, 0.4, 0.2), shift=(0.0, 1.0, 0.0)))
    assert connected(cloud, [0.0, 0.0, 0.0]).all()
    assert torch.equal(alike(cloud, [0.0, 0.0, 0.0]), of(cloud, 0))
    assert torch.equal(alike(cloud, [0.0, 0.0, 0.0], angle=90.0), of(cloud, 0) | of(cloud, 1))
    assert torch.equal(alike(cloud, [0.5, 1.5, 0.0]), of(cloud, 2))
    assert torch.equal(alike(cloud, [0.0, 0.0, 0.0], color=1.0), of(cloud, 0) | of(cloud, 2))


@pytest.mark.parametrize(("settings", "message"), [({"color": 0.0}, "`color`"), ({"angle": 91.0}, "`angle`")])
def test_bad_limits_are_refused(settings, message):
    with value_error(message):
        alike(sheet(), [0.0, 0.0, 0.0], **settings)
