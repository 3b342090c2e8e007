import math

import pytest
import torch
from shared import EYE, double, longest, rand, randn, seeded

from gaussian_swaying.gaussians import connectivity
from gaussian_swaying.gaussians.connectivity import pieces
from gaussian_swaying.geometry.groups import joined

STEP = 0.1  # spacing of the points


def random(seed):
    return seeded(seed)


def sheet(seed, size=2.0, noise=0.15):
    axis = torch.arange(0, size, STEP, dtype=torch.float64)
    flat = torch.cartesian_prod(axis, axis, torch.zeros(1).double())
    return flat + noise * STEP * randn(flat.shape, generator=random(seed))


def attached_pairs(points, *parts, normals=None):
    own = double([0.0, 0.0, 1.0]).expand(len(points), 3) if normals is None else normals
    own = own + 0.3 * randn(own.shape, generator=random(9))
    return connectivity.attached_pairs(points, own, *parts)


def number_of_pieces(points, pairs, least=1):
    return int((joined(len(points), pairs.T).bincount() >= least).sum())


def across(number, pairs):
    return pairs[number[pairs[:, 0]] != number[pairs[:, 1]]]


@pytest.mark.parametrize("seed", range(3))
def test_a_sheet_with_holes_is_one_piece(seed):
    points = sheet(seed)
    points = points[torch.rand(len(points), generator=random(seed)) > 0.25]
    pairs = attached_pairs(points)
    assert number_of_pieces(points, pairs) == 1
    assert longest(points[pairs[:, 0]] - points[pairs[:, 1]]) < 5 * STEP


@pytest.mark.parametrize(("gap", "pieces"), [(0.4, 1), (4.0, 2)])
def test_two_layers_are_one_skin_and_two_sheets_are_two(gap, pieces):
    points = torch.cat([sheet(0), sheet(1) + torch.tensor([0.03, 0.02, gap * STEP])])
    assert number_of_pieces(points, attached_pairs(points)) == pieces


def book(angle):
    leaf = sheet(0, noise=0.05)
    turned = [leaf @ rotation(side * angle).T for side in (-1, 1)]
    # the stem joins them below their edges
    z = torch.arange(0, 2.0, STEP / 2, dtype=torch.float64)
    stem = torch.stack([0 * z - STEP, z, 0 * z], -1)
    around = torch.cat([stem + STEP * double([0, 0, k]) for k in range(-6, 7)])
    shift = double([0.0, 0.0, 6 * STEP])
    points = torch.cat([turned[0] + shift, turned[1] - shift, around])
    up = double([0.0, 0.0, 1.0])
    facing = [(rotation(side * angle) @ up).expand(len(leaf), 3) for side in (-1, 1)]
    normals = torch.cat([*facing, double([[1.0, 0.0, 0.0]]).expand(len(around), 3)])
    return points, normals, torch.tensor([0] * len(leaf) + [1] * len(leaf) + [2] * len(around))


def rotation(angle):
    c, s = math.cos(angle), math.sin(angle)
    return double([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def test_leaves_that_cross_are_cut_where_they_do(monkeypatch):
    points, normals, number = book(-0.6)  # they cross at about half of their length
    pairs = attached_pairs(points, normals=normals)
    assert number_of_pieces(points, pairs) == 1  # by their stem
    leaves = across(number, pairs[(number[pairs] < 2).all(1)])
    monkeypatch.setattr(connectivity, "SMOOTH", 2.0)  # nothing is smooth, so nothing is cut
    whole = attached_pairs(points, normals=normals)
    before = across(number, whole[(number[whole] < 2).all(1)])
    assert len(before) > 500
    assert len(leaves) < 0.1 * len(before)


def test_what_stays_attached_lies_near_the_planes_of_both():
    """Leaves that cross at 45 degrees: of what is left, little is farther than 1.3 spacings above either of them."""
    points, normals, number = book(-0.4)
    pairs = attached_pairs(points, normals=normals)
    a, b = across(number, pairs[(number[pairs] < 2).all(1)]).T
    arm = (points[b] - points[a]) / STEP
    above = torch.maximum(*((arm * normals[own]).sum(-1).abs() for own in (a, b)))
    assert len(above) > 500
    assert (above > 1.3).double().mean() < 0.1


def test_pieces_are_joined_again_where_most_pairs_were_cut():
    k = torch.arange(5)
    chains = torch.cat([torch.stack([5 * piece + k[:-1], 5 * piece + k[1:]], 1) for piece in range(3)])
    most = torch.cat([torch.stack([k, k + 5], 1), torch.stack([k[:4] + 5, k[:4] + 10], 1)])
    cut = torch.cat([torch.tensor([[0, 14]]), most])
    assert sorted(connectivity._put_back(15, chains, cut).tolist()) == sorted(most.tolist())


def test_what_hangs_together_is_never_taken_off():
    upright = sheet(1) @ rotation(math.pi / 2).T
    points = torch.cat([sheet(0), upright + double([1.0, 0.0, 2.1])])
    normals = EYE[[2, 0]].repeat_interleave(len(upright), 0)
    assert number_of_pieces(points, attached_pairs(points, normals=normals)) == 1


def test_haze_is_attached_to_what_is_next_to_it():
    haze = 2 * rand(8, 3, generator=random(3)) + torch.tensor([0, 0, 0.3])
    points = torch.cat([sheet(0), haze])
    pairs = attached_pairs(points)
    assert number_of_pieces(points, pairs) == 1


def test_a_twig_with_branches_is_one_piece():
    z = torch.arange(0, 3, STEP / 2, dtype=torch.float64)
    line = torch.stack([0 * z, 0 * z, z], -1)
    branch = torch.tensor([0, 0, 1.5]) + torch.stack([z, 0 * z, 0.5 * z], -1)
    points = torch.cat([line, branch]) + 0.01 * randn(2 * len(z), 3, generator=random(0))
    assert number_of_pieces(points, attached_pairs(points)) == 1


def test_parts_say_what_they_are_attached_to():
    low, high = sheet(0), sheet(1) + torch.tensor([0.0, 0.0, 0.3 * STEP])
    stem = sheet(2, size=0.3) + torch.tensor([-1.0, 0.0, 0.0])
    points = torch.cat([low, high, stem])
    labels = torch.tensor([0] * len(low) + [1] * len(high) + [2] * len(stem))
    assert len(across(labels, attached_pairs(points, labels, [None, None, None]))) > 100
    pairs = attached_pairs(points, labels, [2, 2, None])
    ends = labels[across(labels, pairs)].sort(1).values
    assert set(map(tuple, ends.tolist())) == {(0, 2), (1, 2)}
    assert len(ends) == 16


def test_few_gaussians():
    assert attached_pairs(torch.rand(1, 3)).shape == (0, 2)
    assert attached_pairs(torch.rand(2, 3)).tolist() == [[0, 1]]
    assert len(attached_pairs(torch.zeros(5, 3))) == 10


def test_pieces_of_a_cell_are_those_of_one_sheet():
    points = torch.cat([sheet(0), sheet(1) + torch.tensor([0.0, 0.0, 4 * STEP])])
    pairs = attached_pairs(points)
    number = torch.arange(2).repeat_interleave(len(points) // 2)
    cell = ((points[:, 0] + 1) / 0.7).floor().long() * 5 + ((points[:, 1] + 1) / 0.7).floor().long()
    cell = torch.unique(cell, return_inverse=True)[1]
    piece, several = pieces(cell, pairs)
    assert several[(points[:, :2] - 0.9).abs().amax(1) < 0.6].all()
    assert not set(piece[number == 0].tolist()) & set(piece[number == 1].tolist())
    alone = points[number == 0]
    assert not pieces(torch.zeros(len(alone), dtype=torch.long), attached_pairs(alone))[1].any()
