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


def test_a_pair_at_the_far_sides_of_two_cells_is_found():
    """Cells as wide as the reach: with cells of 0.9 reaches these places would lie in cells 0 and 2."""
    place = torch.tensor([[0.0, 0.0, 0.0], [0.089, 5.0, 0.0], [0.181, 5.0, 0.0]], dtype=torch.float64)
    for axes in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        first, second = close_pairs(place[:, axes], 0.1, 9 * place, 0.0)
        assert (first.tolist(), second.tolist()) == ([1], [2])


def test_only_places_in_the_cells_beside_are_looked_at(monkeypatch):
    """On a lattice a little wider than the reach: at most two further on in the column, and three in each of four."""
    looked, repeat = [], torch.repeat_interleave

    def counted(*args):
        looked.append(len(found := repeat(*args)))
        return found

    monkeypatch.setattr(torch, "repeat_interleave", counted)
    lattice = 0.101 * torch.cartesian_prod(*(torch.arange(count, dtype=torch.float64) for count in (61, 4, 4)))
    assert len(close_pairs(lattice, 0.1, 9 * lattice, 0.0)[0]) == 0
    assert 0 < sum(looked) <= 14 * len(lattice)
