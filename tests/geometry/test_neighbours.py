import pytest
import torch
from shared import peak, randn
from torch.testing import assert_close

from gaussian_swaying.geometry.neighbours import nearest_neighbours


def _uneven(count):
    points = randn(count, 3) * torch.logspace(-4, 1, count, dtype=torch.float64)[:, None]
    points[0] = 1e5
    return points


def _distances(a, b):
    return torch.linalg.vector_norm(a[:, None] - b[None], dim=-1)


def test_among_themselves():
    points = _uneven(2000)
    distance, index = nearest_neighbours(points, 12)
    everything = _distances(points, points).fill_diagonal_(torch.inf)
    assert_close(distance, everything.sort(dim=-1).values[:, :12])
    assert_close(everything.gather(-1, index), distance)


@pytest.mark.parametrize("count", [1, 5])
def test_from_other_places(count):
    points = _uneven(1500)
    queries = torch.cat([randn(300, 3), points[10:20], torch.tensor([[-3e6, 0, 1.0]]).double()])
    distance, index = nearest_neighbours(points, count, queries)
    everything = _distances(queries, points)
    assert_close(distance, everything.sort(dim=-1).values[:, :count])
    assert_close(everything.gather(-1, index), distance)


def test_far_from_the_origin_and_degenerate():
    """Distances by matrix products would be off by metres at float32 coordinates of 1e4."""
    points = (torch.rand(200, 3) + 1e4).float()
    queries = points[::3] + torch.tensor([0.001, 0.0, 0.0])
    _, index = nearest_neighbours(points.double(), 1, queries)
    assert torch.equal(index[:, 0], _distances(queries.double(), points.double()).argmin(1))
    assert nearest_neighbours(points, 1, queries[:0])[1].shape == (0, 1)
    same = torch.zeros(4, 3)
    assert peak(nearest_neighbours(same, 1, same)[0]) == 0
    assert nearest_neighbours(same[:1], 1, torch.ones(2, 3))[1].tolist() == [[0], [0]]
