"""The shares of the visible area that make a floor."""

import pytest
import torch

from gaussian_swaying.preview.up import floor_mask


@pytest.mark.parametrize(
    ("floor", "below", "is_floor"),
    [
        (0.155, 0.0, True),  # at least 15 % of the area
        (0.145, 0.0, False),
        (0.948, 0.0, True),  # something above it: at least 5 %
        (0.952, 0.0, False),
        (0.5, 0.029, True),  # almost nothing below it: at most 3 %
        (0.5, 0.031, False),
    ],
)
def test_a_floor_has_its_share_of_the_area(floor, below, is_floor):
    """A level plate of 2 x 2, an upright thing on it, and bits below it; the rest of the area is the thing's."""
    side = torch.linspace(-1, 1, 21)
    plate = torch.cartesian_prod(side, side, torch.zeros(1))
    thing = torch.cartesian_prod(torch.linspace(-0.2, 0.2, 5), torch.linspace(-0.2, 0.2, 5), torch.linspace(0.2, 1, 9))
    bits = torch.cartesian_prod(side[::4], side[::4], torch.tensor([-0.3]))
    points = torch.cat([plate, thing, bits])
    upright = torch.tensor([0.0, 0.0, 1.0]).expand_as(plate)
    sideways = torch.tensor([1.0, 0.0, 0.0])
    normals = torch.cat([upright, sideways.expand_as(thing), sideways.expand_as(bits)])
    shares = (floor, 1 - floor - below, below)
    weight = torch.cat([torch.full((len(p),), s / len(p)) for p, s in zip((plate, thing, bits), shares, strict=True)])
    found = floor_mask(points, normals, 3.7 * weight, (0.0, 0.0, 1.0))
    expected = torch.arange(len(points)) < len(plate)
    expected[len(plate) + len(thing) :] = True  # what lies below the floor is not a part of the object
    assert torch.equal(found, expected & is_floor)
