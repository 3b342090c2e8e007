import pytest
import torch
from shared import longest, rand, seeded

from gaussian_swaying.gaussians.grouping import grid_groups, loose_points
from gaussian_swaying.geometry.groups import sums

DX = 0.1


def cloud(count=4000, seed=0):
    return rand(count, 3, generator=seeded(seed))


@pytest.mark.parametrize("per_cell", [1, 2, 3])
def test_points_of_a_group_share_their_nodes(per_cell):
    points = cloud()
    group = grid_groups(points, DX, per_cell, torch.ones(len(points)))
    assert group.unique().equal(torch.arange(int(group.max()) + 1))
    base = torch.floor(points / DX - 0.5)
    centre = sums(points, group) / group.bincount()[:, None]
    for k in range(3):
        low, high = (torch.full((len(centre),), s * 99.0).double() for s in (1, -1))
        low = low.scatter_reduce(0, group, base[:, k], "amin")
        high = high.scatter_reduce(0, group, base[:, k], "amax")
        assert torch.equal(low, high)
    assert torch.equal(torch.floor(centre / DX - 0.5)[group], base)
    far = longest(points - centre[group])
    assert far < 3**0.5 * DX / per_cell
    expected = len(torch.unique(torch.floor((points / DX - 0.5) * per_cell), dim=0))
    assert int(group.max()) + 1 == expected


def test_labels_are_never_mixed():
    points = cloud()
    label = torch.stack([torch.arange(len(points)) % 3, torch.arange(len(points)) % 2], -1)
    group = grid_groups(points, DX, 2, torch.ones(len(points)), label=label)
    assert len(torch.cat([group[:, None], label], -1).unique(dim=0)) == int(group.max()) + 1
    assert int(group.max()) > int(grid_groups(points, DX, 2, torch.ones(len(points))).max())


@pytest.mark.parametrize(("gap", "apart"), [(0.1, False), (0.4, True)])
def test_close_sheets_stay_apart(gap, apart):
    """Two level sheets, 0.1 or 0.4 cells apart, within one layer of cubes."""
    axis = torch.arange(0.5, 40, dtype=torch.float64) * 0.25 * DX
    x, y = (g.reshape(-1) for g in torch.meshgrid(axis, axis, indexing="ij"))
    low = torch.stack([x, y, torch.full_like(x, 0.52 * DX)], -1)
    points = torch.cat([low, low + torch.tensor([0.0, 0.0, gap * DX])])
    normal = torch.tensor([[0.0, 0.0, 1.0]]).expand(len(points), 3) * (-1) ** torch.arange(len(points))[:, None]
    group = grid_groups(points, DX, 2, torch.ones(len(points)), normal)
    sheets = torch.stack([group, (points[:, 2] > 0.55 * DX + 1e-9).long()], -1).unique(dim=0)
    assert (len(sheets) == int(group.max()) + 1) is apart


def test_a_tilted_noisy_sheet_is_not_split():
    points = cloud()
    points[:, 2] = 0.3 * points[:, 0] + 0.002 * points[:, 2]
    normal = torch.nn.functional.normalize(torch.tensor([-0.3, 0.0, 1.0]), dim=0).expand(len(points), 3)
    weight = torch.ones(len(points))
    assert torch.equal(grid_groups(points, DX, 2, weight, normal), grid_groups(points, DX, 2, weight))


def sheet(count=20):
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
    assert not found[:400].any()
    assert found[400:].tolist() == [loose] * len(extra)
    moved = points.double() * 0.125 - 64  # exactly
    assert torch.equal(loose_points(moved, 0.125), found)  # in any unit, anywhere


def test_a_thread_holds():
    row = torch.tensor([[0.9, 0.0, 0.0]]) * torch.arange(1, 12)[:, None] + torch.tensor([19.0, 10.0, 0.0])
    other = sheet() + torch.tensor([30.0, 0.0, 0.0])
    assert not loose_points(torch.cat([sheet(), row, other]), 1.0).any()
    assert not loose_points(1.7 * row, 1.0)[1:-1].any()
