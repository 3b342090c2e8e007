import math

import pytest
import torch
from shared import alike, value_error
from torch.testing import assert_close

from gaussian_swaying.gaussians.area import coverage_area
from gaussian_swaying.gaussians.subdivision import split_large, subdivide
from gaussian_swaying.geometry.neighbours import nearest_neighbours


def _sheet(side, spacing, size, opacity=0.99):
    """A square of round flat Gaussians in the plane z = 0."""
    line = torch.arange(0.5 * spacing, side, spacing)
    means = torch.cartesian_prod(line, line, torch.zeros(1))
    count = len(means)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(count, 1)
    scales = torch.tensor([size, size, 1e-3]).log().repeat(count, 1)
    return means, quats, scales, torch.full((count,), opacity)


def test_small_gaussians_stay_whole():
    sheet = means, _, scales, opacity = _sheet(1.0, 0.1, 0.02)
    found, split = subdivide(*sheet, 0.1), split_large(*sheet, 0.02)
    assert len(found.parent) == len(found.means) == 0
    assert torch.equal(split.means, means)
    for same in (found, split):
        assert torch.equal(same.log_scales, scales)
        assert torch.equal(same.opacity, opacity)


def test_points_of_one_gaussian():
    """On a lattice no wider than the spacing, within the ellipse of a quarter of full opacity, turned with it."""
    quats = torch.tensor([[math.cos(0.5), 0.0, 0.0, math.sin(0.5)]])  # by 1 rad about z
    scales = torch.tensor([[0.2, 0.05, 1e-3]]).log()
    found = subdivide(torch.tensor([[1.0, 2.0, 3.0]]), quats, scales, torch.tensor([0.8]), 0.06)
    offset = found.means - torch.tensor([1.0, 2.0, 3.0])
    along = offset @ torch.tensor([math.cos(1.0), math.sin(1.0), 0.0])
    across = offset @ torch.tensor([-math.sin(1.0), math.cos(1.0), 0.0])
    assert_close(offset[:, 2], torch.zeros(len(offset)))
    squared = (along / 0.2).square() + (across / 0.05).square()
    assert squared.max() <= 2 * math.log(0.8 / 0.25) * (1 + 1e-5)
    assert along.max() > 0.2 * math.sqrt(2 * math.log(0.8 / 0.25)) - 0.06  # to the rim
    assert_close(found.opacity[1:], 0.8 * (-0.5 * squared).exp())
    everything = torch.cat([torch.zeros(1, 3), offset])
    assert nearest_neighbours(everything, 1)[0].max() <= 0.06
    pieces = (scales - found.log_scales[:1]).exp()[0]
    alike(pieces, pieces.round(), 1e-5)
    assert pieces[0] > pieces[1] >= 1
    assert pieces[2] == 1


def test_a_faint_one_stays_whole():
    means, quats, scales, _ = _sheet(0.1, 0.1, 0.2)
    assert len(subdivide(means, quats, scales, torch.tensor([0.25]), 0.02).parent) == 0
    assert len(subdivide(means, quats, scales, torch.tensor([0.9]), 0.02).parent) > 0


def test_holes_close_and_areas_add_up():
    """A sheet with one large Gaussian in the place of 144 small ones: no hole, and the area of the sheet."""
    means, quats, scales, opacity = _sheet(1.0, 0.05, 0.02)
    hole = (means - 0.5).abs()[:, :2].amax(-1) > 0.3
    means, quats, scales, opacity = (t[hole] for t in (means, quats, scales, opacity))
    large = _sheet(1.0, 1.0, 0.2)
    means, quats, scales, opacity = (
        torch.cat(pair) for pair in zip((means, quats, scales, opacity), large, strict=True)
    )
    found = subdivide(means, quats, scales, opacity, 0.05)
    assert set(found.parent.tolist()) == {len(means) - 1}
    asked = 0.05 + 0.9 * torch.rand(2000, 3)
    asked[:, 2] = 0
    before = nearest_neighbours(means, 1, asked)[0].max()
    after = nearest_neighbours(torch.cat([means, found.means]), 1, asked)[0].max()
    assert before > 0.15
    assert after < 2 * 0.05  # what is left out is within a spacing of another
    normals = torch.tensor([0.0, 0.0, 1.0]).repeat(len(means) + len(found.means), 1)
    area = coverage_area(torch.cat([means, found.means]), normals, found.log_scales, found.opacity).sum()
    assert float(area) == pytest.approx(1.0, rel=0.03)
    assert coverage_area(means, normals[: len(means)], scales, opacity).sum() < 0.9


def test_overlapping_ones_do_not_pile_up():
    means, quats, scales, opacity = _sheet(0.1, 0.1, 0.2)
    one = subdivide(means, quats, scales, opacity, 0.05)
    copies = [t.repeat(10, *[1] * (t.ndim - 1)) for t in (means, quats, scales, opacity)]
    copies[0] = copies[0] + 0.02 * torch.randn(10, 3) * torch.tensor([1.0, 1.0, 0.0])
    ten = subdivide(*copies, 0.05)
    assert len(ten.parent) < 3 * len(one.parent)
    to_centres = nearest_neighbours(copies[0], 1, ten.means)[0]
    assert to_centres.min() >= math.sqrt(0.5) * 0.05 * (1 - 1e-5)


def test_haze_is_refused():
    """A Gaussian of a hundred metres among small ones, before memory runs out."""
    means, quats, scales, opacity = _sheet(1.0, 0.1, 0.02)
    scales[3, :2] = math.log(100.0)
    with value_error("particle_spacing"):
        subdivide(means, quats, scales, opacity, 0.01)


def test_split_gaussians_look_like_the_large_one():
    """Opacities composed over a line through its centre, within what a lattice of 0.6 steps leaves uneven."""
    means, quats, scales, opacity = _sheet(0.1, 0.1, 0.3, opacity=0.95)
    found = split_large(means, quats, scales, opacity, 0.03)
    assert found.log_scales.exp().amax() <= 0.03 * (1 + 1e-6)
    assert len(found.means) > 100
    assert int(found.source.max()) == 0
    line = means[0] + torch.linspace(-0.3, 0.3, 101)[:, None] * torch.tensor([1.0, 0.0, 0.0])

    def seen(means, scales, opacity):
        squared = ((line[:, None] - means) / scales)[..., :2].square().sum(-1)
        return 1 - (1 - opacity * (-0.5 * squared).exp()).prod(-1)

    before = seen(means, scales.exp(), opacity)
    after = seen(found.means, found.log_scales.exp(), found.opacity)
    assert before.min() > 0.5
    assert (after - before).abs().mean() < 0.2
    assert after.min() > 0.5
