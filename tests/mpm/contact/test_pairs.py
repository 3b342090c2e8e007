"""Pairs of places that are close, their normals and gaps, and the impulses that part them."""

import math

import pytest
import torch
from torch.testing import assert_close

from gaussian_swaying.mpm.contact.pairs import close_pairs
from gaussian_swaying.mpm.contact.solve import Constraints, Rows, pair_gaps, resolve


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


def test_close_pairs_are_those_of_brute_force():
    place = torch.rand(700, 3, dtype=torch.float64) * torch.tensor([1.0, 0.5, 0.2])
    rest = torch.rand(700, 3, dtype=torch.float64)
    first, second = close_pairs(place, 0.07, rest, 0.2)
    near = (torch.cdist(place, place) < 0.07) & (torch.cdist(rest, rest) >= 0.2)
    expected = near.triu(1).nonzero()
    assert len(first) > 100
    assert torch.equal(torch.stack([first, second], -1), expected)


def test_close_pairs_in_chunks(monkeypatch):
    place = torch.rand(500, 3)
    whole = close_pairs(place, 0.2, 9 * place, 0.0)
    monkeypatch.setattr("gaussian_swaying.mpm.contact.pairs._CHUNK", 300)
    parts = close_pairs(place, 0.2, 9 * place, 0.0)
    assert torch.equal(whole[0], parts[0])
    assert torch.equal(whole[1], parts[1])


def test_close_pairs_of_points_in_one_place_are_refused(monkeypatch):
    monkeypatch.setattr("gaussian_swaying.mpm.contact.pairs.MOST_PAIRS", 1000)
    with pytest.raises(ValueError, match="the material has collapsed"):
        close_pairs(torch.zeros(100, 3), 0.1, torch.rand(100, 3), 0.0)
    with pytest.raises(FloatingPointError, match="NaN or infinite"):
        close_pairs(torch.full((3, 3), torch.nan), 0.1, torch.rand(3, 3), 0.0)


@pytest.mark.parametrize(
    ("arm", "normal", "distance"),
    [
        ((0.05, 0.28, 2.0), (0.0, 0.0, 1.0), 2.0),  # 0.284 from the axis of the first, high above it
        ((0.05, 0.31, -2.0), None, None),
        ((-2.0, 0.38, 0.05), (-1.0, 0.0, 0.0), 2.0),  # 0.383 from that of the second
        ((2.0, 0.41, 0.05), None, None),
        ((0.1, 0.05, 0.1), (math.sqrt(0.5), 0.0, math.sqrt(0.5)), math.sqrt(0.02)),  # near both
        ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), 0.0),  # in one place: the normal of one of them
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


def _contacts(first, second, mass, friction):
    """Blocks on one node each, and contacts along z between some of them; the last number is the ground's."""
    weight = torch.nn.functional.pad(torch.ones(len(mass), 1, dtype=torch.float64), (0, 26))
    rows = Rows.of(torch.arange(len(mass))[:, None].repeat(1, 27), weight, 1 / mass)
    count = len(first)
    held = Constraints(
        first,
        second,
        torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).repeat(count, 1),
        torch.zeros(count, dtype=torch.float64),
        torch.zeros(count, 3, dtype=torch.float64),
        torch.full((count,), friction, dtype=torch.float64),
        torch.ones(count, dtype=torch.bool),
    )
    return torch.tensor([[0.3, 0.0, -1.0]], dtype=torch.float64).repeat(len(mass), 1), rows, held


@pytest.mark.parametrize("count", [1, 4])
def test_lone_and_joint_impulses_are_exact(count):
    """A lone place is stopped in one iteration with its own mass, and so is a whole row of them."""
    mass = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
    velocity, rows, held = _contacts(torch.arange(count), torch.full((count,), 4), mass, 0.1)
    after, impulse = resolve(velocity, rows, held, 1e-3, 0.1, 1)
    assert_close(impulse[:, 2], mass[:count])
    assert_close(impulse[:, 0], -0.1 * mass[:count])  # sliding: Coulomb's bound
    assert_close(after[:count, 2], torch.zeros(count, dtype=torch.float64))


@pytest.mark.parametrize("count", [2, 4, 8])
def test_unfinished_friction_does_not_push(count):
    """A column of blocks that stick to each other, on a slope: however few iterations are made, none moves uphill."""
    below = torch.cat([torch.tensor([count]), torch.arange(count - 1)])
    velocity, rows, held = _contacts(torch.arange(count), below, torch.ones(count, dtype=torch.float64), 10.0)
    for iterations in (1, 2, 5, 10, 15, 20, 25, 30, 35, 40):
        after, impulse = resolve(velocity, rows, held, 1e-3, 0.1, iterations)
        moving = rows.read(after)
        relative = moving[held.first] - moving[held.second]
        assert float((impulse * relative)[:, 0].sum()) < 0.0  # the work of friction
        assert float(after[:, 0].min()) > 0.0
        assert float(after[:, 0].max()) < 0.3 + 1e-12
