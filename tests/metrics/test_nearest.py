"""Distances to the nearest point against brute force and closed forms."""

import pytest
import torch
from torch.testing import assert_close

from gaussian_swaying.metrics import nearest
from gaussian_swaying.metrics.nearest import nearest_distances


def _chamfer(source, target):
    """The sum of the mean distances of both directions."""
    return sum(distances.mean() for distances in nearest_distances(source, target))


def _lattice(count, spacing, device, dtype):
    line = torch.arange(count, device=device, dtype=dtype) * spacing
    return torch.cartesian_prod(line, line, torch.zeros(1, device=device, dtype=dtype))


@pytest.mark.parametrize("pairs", [1, 57, 4 * 57, 2**20])
def test_nearest_distances_equal_brute_force_whatever_the_chunk(device, dtype, pairs, monkeypatch):
    monkeypatch.setitem(nearest.PAIRS, device.type, pairs)
    source, target = (torch.rand(count, 3, device=device, dtype=dtype) for count in (103, 57))
    forward, backward = nearest._by_chunks(source, target)
    every = (source.double()[:, None] - target.double()).norm(dim=-1).to(dtype)
    # differences of numbers up to 1 are exact to one unit in the last place, and three of them are added
    tolerance = {"rtol": 8 * torch.finfo(dtype).eps, "atol": 8 * torch.finfo(dtype).eps}
    assert_close(forward, every.amin(1), **tolerance)
    assert_close(backward, every.amin(0), **tolerance)


@pytest.mark.parametrize(
    "moved",
    [(0.0, 0.0, 0.0), (0.03, 0.0, 0.01), (5.0, 0.0, 0.0), (-5.0, 0.0, 0.0), (0.0, 9.0, 0.0)],
    ids=["mixed", "near", "above", "below", "aside"],
)
def test_a_tree_finds_the_nearest_of_all(moved):
    """Sheets, clusters and points that coincide: the same bits as from all pairs."""
    sheet = torch.rand(2500, 3) * torch.tensor([1.2, 0.05, 0.8])
    clusters = torch.cat([torch.rand(1200, 3) * 0.01 + c for c in (0.0, 0.7)] + [sheet[:300]]) + torch.tensor(moved)
    every = torch.cdist(sheet, clusters, compute_mode="donot_use_mm_for_euclid_dist")
    forward, backward = nearest_distances(sheet, clusters)
    assert torch.equal(forward, every.amin(1))
    assert torch.equal(backward, every.amin(0))


def test_a_tree_looks_at_few_pairs(monkeypatch):
    sizes = _watch(monkeypatch)
    flat = torch.tensor([1.0, 0.0, 1.0])
    nearest_distances(torch.rand(8000, 3) * flat, torch.rand(8000, 3) * flat)
    assert sum(sizes) < 8000**2 / 4


def _watch(monkeypatch):
    sizes = []
    cdist = torch.cdist

    def watched(*arguments, **options):
        result = cdist(*arguments, **options)
        sizes.append(result.numel())
        return result

    monkeypatch.setattr(torch, "cdist", watched)
    return sizes


def test_memory_is_bounded_by_the_chunk(monkeypatch):
    sizes = _watch(monkeypatch)
    monkeypatch.setitem(nearest.PAIRS, "cpu", 2000)
    broken = torch.cat([torch.rand(999, 3), torch.full((1, 3), torch.nan)])  # not for a tree
    nearest_distances(broken, torch.rand(200, 3))
    assert max(sizes) <= 2000
    assert sum(sizes) == 1000 * 200
    sizes.clear()
    nearest_distances(torch.rand(3000, 3), torch.rand(3000, 3) + 2)
    assert max(sizes) <= 2**20


@pytest.mark.parametrize("far", [0.0, 100.0])
def test_parallel_sheets(device, far):
    """Equal sheets at a height h: each term is h; far from the origin too, where expanded squares would lose it."""
    sheet = _lattice(20, 0.05, device, torch.float32) + far
    height = 0.03125  # exact in float32, also beside 100
    above = sheet + torch.tensor([0.0, 0.0, height], device=device)
    assert _chamfer(sheet, above) == 2 * height


def test_shifted_lattices(dtype):
    """Shifted by a third of the spacing a along one axis: every point finds one at a/3, the last row's at a/3 too."""
    n, a = 8, 0.3
    lattice = _lattice(n, a, "cpu", dtype)
    shifted = lattice + torch.tensor([a / 3, 0.0, 0.0], dtype=dtype)
    close = {"rtol": 0.0, "atol": 8 * n * a * torch.finfo(dtype).eps}
    assert_close(_chamfer(lattice, shifted), torch.tensor(2 * a / 3, dtype=dtype), **close)
    # by two thirds: the next one is at a/3, but for one row of n, which has none beyond
    shifted = lattice + torch.tensor([2 * a / 3, 0.0, 0.0], dtype=dtype)
    expected = torch.tensor(2 * (a / 3 * (n - 1) + 2 * a / 3) / n, dtype=dtype)
    assert_close(_chamfer(lattice, shifted), expected, **close)


def test_one_set_may_hold_the_other():
    part, whole = torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    assert _chamfer(part, whole) == _chamfer(whole, part) == 1.0


@pytest.mark.parametrize("count", [10, 3000])
def test_a_position_that_is_nan_is_not_hidden(count):
    source = torch.rand(count, 3)
    source[3, 1] = torch.nan
    assert _chamfer(source, torch.rand(count, 3)).isnan()
