"""One point for each cube, and who follows whom."""

import pytest
import torch

from gaussian_swaying.gaussians.grouping import blend_weights, group_points, joined, loose_points


def test_each_cube_keeps_the_point_nearest_to_its_weighted_centre():
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    weight = torch.rand(500, generator=torch.Generator().manual_seed(1))
    kept, group = group_points(points, weight, 0.25)
    cell = torch.floor((points.double() - points.double().amin(0)) / 0.25).long()
    assert len(kept) == len(cell.unique(dim=0)) < 500
    assert torch.equal(kept, kept.sort().values)
    assert torch.equal(cell[kept[group]], cell)  # each is stood for by one of its own cube
    for number, index in enumerate(kept.tolist()):
        own = group == number
        share = weight[own].double()
        centre = (share[:, None] * points[own].double()).sum(0) / share.sum()
        distance = (points.double() - centre).norm(dim=-1)
        assert float(distance[index]) == float(distance[own].min())


def test_preferred_points_stand_for_their_cube():
    points = torch.tensor([[0.0, 0, 0], [0.09, 0, 0], [0.05, 0, 0], [0.95, 0, 0]])
    weight = torch.ones(4)
    assert group_points(points, weight, 0.1)[0].tolist() == [2, 3]
    kept, group = group_points(points, weight, 0.1, preferred=2)
    assert len(kept) == 2
    assert int(kept[0]) in (0, 1)  # not the point in the middle
    assert group.tolist() == [0, 0, 0, 1]
    with pytest.raises(ValueError, match="side"):
        group_points(points, weight, 0.0)


def test_blend_is_a_smooth_partition_that_interpolates():
    points = torch.rand(200, 3, generator=torch.Generator().manual_seed(2))
    line = torch.stack([torch.linspace(0.2, 0.8, 4001), torch.full((4001,), 0.4), torch.full((4001,), 0.6)], -1)
    index, weight = blend_weights(points, torch.cat([points[:5], line]), 6)
    assert index.shape == (4006, 6)
    torch.testing.assert_close(weight.sum(-1), torch.ones(4006, dtype=torch.float64))
    assert index[:5, 0].tolist() == [0, 1, 2, 3, 4]
    assert float(weight[:5, 0].min()) > 1 - 1e-6
    # of any values, the blend moves by less than a step's worth along the line, also where neighbours are exchanged
    value = torch.rand(200, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    blend = (weight * value[index]).sum(-1)[5:]
    assert float(blend.diff().abs().max()) < 0.01
    assert float(blend.max() - blend.min()) > 0.2


def test_few_points_are_followed_as_they_are():
    one = torch.zeros(1, 3)
    index, weight = blend_weights(one, torch.rand(3, 3), 6)
    assert index.tolist() == [[0]] * 3
    assert weight.tolist() == [[1.0]] * 3
    index, weight = blend_weights(torch.rand(9, 3), torch.rand(3, 3), 1)
    assert index.shape == (3, 1)
    assert weight.tolist() == [[1.0]] * 3


def sheet(count=20):
    """A square lattice of points, one apart."""
    side = torch.arange(float(count))
    return torch.cartesian_prod(side, side, torch.zeros(1))


@pytest.mark.parametrize(
    ("extra", "loose"),
    [
        ([[30, 0, 0], [31, 0, 0], [30, 1, 0]], True),  # a part of three: less than a hundredth of 400
        ([[30, 0, 0], [31, 0, 0], [30, 1, 0], [31, 1, 0]], False),  # four are a hundredth
        ([[10, 10, 1.9]], True),  # hangs on the one point below it
        ([[10, 10, 1.2]], False),  # and on four beside that one
        ([[10, 10, 2.5]], True),  # on none
    ],
)
def test_small_parts_and_what_hangs_by_a_thread_are_loose(extra, loose):
    points = torch.cat([sheet(), torch.tensor(extra).float()])
    found = loose_points(points, 1.0)
    assert not bool(found[:400].any())
    assert found[400:].tolist() == [loose] * len(extra)
    moved = points.double() * 0.125 - 64  # exactly
    assert torch.equal(loose_points(moved, 0.125), found)  # in any unit, anywhere


def test_a_dense_speck_counts_as_one():
    clump = 0.1 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0)) + torch.tensor([30.0, 0, 0])
    assert bool(loose_points(torch.cat([sheet(), clump]), 1.0)[400:].all())


def test_a_thread_holds():
    """Two sheets joined by single points in a row stay whole, and a row alone loses at most its ends."""
    row = torch.tensor([[0.9, 0.0, 0.0]]) * torch.arange(1, 12)[:, None] + torch.tensor([19.0, 10.0, 0.0])
    other = sheet() + torch.tensor([30.0, 0.0, 0.0])
    assert not bool(loose_points(torch.cat([sheet(), row, other]), 1.0).any())
    assert not bool(loose_points(1.7 * row, 1.0)[1:-1].any())


def test_an_object_of_few_points_is_not_loose():
    for points in (torch.zeros(1, 3), torch.tensor([[0.0, 0, 0], [5, 0, 0]]), 10 * torch.eye(3)):
        assert not bool(loose_points(points, 1.0).any())
    with pytest.raises(ValueError, match="side"):
        loose_points(sheet(), 0.0)


def test_joined_numbers_the_parts():
    pairs = torch.tensor([[0, 4, 2], [4, 5, 6]])
    assert joined(7, pairs).tolist() == [0, 1, 2, 3, 0, 0, 2]
    assert joined(2, torch.zeros(2, 0, dtype=torch.long)).tolist() == [0, 1]
