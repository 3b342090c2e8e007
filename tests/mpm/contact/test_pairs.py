"""Pairs of places far apart in numbers of cells."""

import torch

from gaussian_swaying.mpm.contact.pairs import close_pairs


def test_a_place_very_far_away_hides_no_pair():
    """2^26 reaches from the others, so that their distance from the corner of the grid rounds to 8 reaches."""
    reach = 0.1
    draw = torch.Generator().manual_seed(0)
    place = 2 * torch.rand(400, 3, generator=draw)
    place[-1] = -reach * 2.0**26
    first, second = close_pairs(place, reach, 9 * place, 0.0)
    expected = (torch.cdist(place.double(), place.double()) < reach).triu(1).nonzero()
    assert len(expected) > 30
    assert torch.equal(torch.stack([first, second], -1), expected)
