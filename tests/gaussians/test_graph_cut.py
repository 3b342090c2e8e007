"""Labels spread from a few Gaussians to those that look alike and are near."""

import dataclasses
import itertools

import pytest
import torch
from small_scenes import plain_cloud, together

from gaussian_swaying.gaussians import graph_cut
from gaussian_swaying.gaussians.graph_cut import spread_labels
from gaussian_swaying.gaussians.harmonics import SH_DC

RED, GREEN, BLUE = (0.7, 0.3, 0.2), (0.3, 0.6, 0.2), (0.2, 0.3, 0.7)


def ball(middle, colour, count=800, seed=0, radius=0.5, noise=0.05):
    """Gaussians on a sphere, with noisy colours."""
    draw = torch.Generator().manual_seed(seed)
    place = torch.randn(count, 3, generator=draw)
    cloud = plain_cloud(torch.tensor(middle) + radius * place / place.norm(dim=-1, keepdim=True))
    shade = torch.tensor(colour) + noise * torch.randn(count, 3, generator=draw)
    return dataclasses.replace(cloud, sh=((shade - 0.5) / SH_DC)[:, None])


def seeds_at(cloud, *places):
    """A seed for each label: the Gaussians next to a place, three of them."""
    seeds = torch.full((len(cloud),), -1)
    for label, place in enumerate(places):
        seeds[(cloud.means - torch.tensor(place)).norm(dim=-1).argsort()[:3]] = label
    return seeds


def right(label, *sizes):
    expected = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    return float((label == expected).double().mean())


def test_two_balls_that_touch_are_told_apart():
    cloud = together(ball((0.0, 0.0, 0.0), RED), ball((0.95, 0.0, 0.0), GREEN, seed=1))
    seeds = seeds_at(cloud, (-0.5, 0.0, 0.0), (1.45, 0.0, 0.0))
    label = spread_labels(cloud, seeds, 2)
    assert right(label, 800, 800) > 0.99
    assert torch.equal(label, spread_labels(cloud, seeds, 2))
    assert torch.equal(label[seeds >= 0], seeds[seeds >= 0])


def test_like_colours_are_told_apart_by_where_they_touch():
    """Both are red with specks of another colour: a border costs least where the balls meet."""
    cloud = together(ball((0.0, 0.0, 0.0), RED, noise=0.0), ball((1.04, 0.0, 0.0), RED, seed=1, noise=0.0))
    seeds = torch.full((1600,), -1)
    seeds[:800:4], seeds[800::4] = 0, 1
    assert right(spread_labels(cloud, seeds, 2), 800, 800) > 0.97


def test_three_labels_and_a_part_of_the_colour_of_another():
    balls = [ball((0.95 * k, 0.0, 0.0), colour, seed=k) for k, colour in enumerate((RED, GREEN, BLUE))]
    cloud = together(*balls)
    label = spread_labels(cloud, seeds_at(cloud, (0.0, 0.0, 0.5), (0.95, 0.0, 0.5), (1.9, 0.0, 0.5)), 3)
    assert right(label, 800, 800, 800) > 0.99


def test_one_label_is_for_all():
    cloud = ball((0.0, 0.0, 0.0), RED, count=30)
    assert spread_labels(cloud, seeds_at(cloud, (0.0, 0.0, 0.5)), 1).tolist() == [0] * 30


@pytest.mark.parametrize("seed", range(6))
def test_a_cut_of_two_labels_has_the_least_cost_of_all(seed):
    draw = torch.Generator().manual_seed(seed)
    nodes, pairs = 9, torch.tensor(list(itertools.combinations(range(9), 2))).T
    edge = torch.randint(0, 60, (pairs.shape[1],), generator=draw)
    own = torch.randint(0, 200, (nodes, 2), generator=draw)

    def cost(label):
        return int(own.gather(1, label[:, None]).sum() + edge[label[pairs[0]] != label[pairs[1]]].sum())

    found = graph_cut._expanded(torch.zeros(nodes, dtype=torch.long), 1, own, pairs, edge)
    assert cost(found) == min(cost(torch.tensor(label)) for label in itertools.product((0, 1), repeat=nodes))


@pytest.mark.parametrize("seed", range(6))
def test_an_expansion_finds_the_best_change_to_its_label(seed):
    draw = torch.Generator().manual_seed(seed)
    nodes, pairs = 8, torch.tensor(list(itertools.combinations(range(8), 2))).T
    edge = torch.randint(0, 60, (pairs.shape[1],), generator=draw)
    own = torch.randint(0, 200, (nodes, 3), generator=draw)
    start = torch.randint(0, 3, (nodes,), generator=draw)

    def cost(label):
        return int(own.gather(1, label[:, None]).sum() + edge[label[pairs[0]] != label[pairs[1]]].sum())

    changes = (torch.tensor(change) for change in itertools.product((False, True), repeat=nodes))
    assert cost(graph_cut._expanded(start, 2, own, pairs, edge)) == min(
        cost(torch.where(change, 2, start)) for change in changes
    )


def test_many_gaussians_are_cut_as_cells_of_like_colour(monkeypatch):
    monkeypatch.setattr(graph_cut, "MOST", 400)
    cloud = together(ball((0.0, 0.0, 0.0), RED, 3000), ball((0.95, 0.0, 0.0), GREEN, 3000, seed=1))
    node = graph_cut._nodes(cloud.means.double(), torch.zeros(6000, 3).double(), torch.zeros(6000))
    assert int(node.max()) < 400
    seeds = seeds_at(cloud, (-0.5, 0.0, 0.0), (1.45, 0.0, 0.0))
    assert right(spread_labels(cloud, seeds, 2), 3000, 3000) > 0.99


@pytest.mark.parametrize(
    ("seeds", "count", "message"),
    [
        ([0, -1, -1], 2, "label 1 has no seed"),
        ([0, 2, -1], 2, "`seeds` from -1 to 1"),
        ([0, 1], 2, "`seeds` of shape"),
        ([0, 1, -1], 0, "`count`"),
    ],
)
def test_seeds_that_do_not_fit_are_refused(seeds, count, message):
    with pytest.raises(ValueError, match=message):
        spread_labels(plain_cloud(torch.rand(3, 3)), torch.tensor(seeds), count)


def test_the_smoothness_must_be_positive():
    with pytest.raises(ValueError, match="smooth"):
        spread_labels(plain_cloud(torch.rand(3, 3)), torch.tensor([0, 1, -1]), 2, smooth=0.0)
