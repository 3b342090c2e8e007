import math

import torch
from shared import double, normalized, rand, randn, seeded
from torch.testing import assert_close

from gaussian_swaying.geometry.surface_normals import neighbour_normals


def _sheet(count=6000, height=None):
    generator = seeded(0)
    flat = rand(count, 2, generator=generator)
    points = torch.nn.functional.pad(flat, (0, 1))
    if height is not None:
        points[:, 2] = height(flat)
    noise = 0.1 * randn(count, 3, generator=generator)
    up = double([0.0, 0.0, 1.0])
    return points, normalized(up + noise)


def _degrees(one, two):
    return torch.rad2deg((one * two).sum(-1).abs().clamp(max=1).acos())


def test_a_plane_gets_its_normal_however_its_points_are_turned():
    points, normals = _sheet(2000)
    signs = torch.where(torch.arange(len(normals)) % 2 == 0, 1.0, -1.0)[:, None]
    found = neighbour_normals(points, signs * normals)
    assert found[:, 2].abs().min() > 1 - 1e-12
    assert ((found * signs * normals).sum(-1) > 0).all()  # each on its own side


def test_a_wave_keeps_its_normals():
    """Surfaces over 128 neighbours, 4.6 cm, follow a wave of 0.5 m; a plane over them would be off by 3 degrees."""
    points, _ = _sheet(height=lambda p: 0.05 * torch.sin(4 * math.pi * p[:, 0]))
    slope = 0.05 * 4 * math.pi * torch.cos(4 * math.pi * points[:, 0])
    true = normalized(torch.stack([-slope, torch.zeros_like(slope), torch.ones_like(slope)], -1))
    angle = _degrees(neighbour_normals(points, true), true)
    assert angle.median() < 1.0
    assert angle.max() < 4.0


def test_noise_of_the_points_counts_less_the_wider_a_shape_is():
    """On a plane the neighbourhood grows from 5 to 37 cm, and noise of 1 mm tilts an edge by less than 0.3 degrees."""
    points, normals = _sheet()
    points[:, 2] += 1e-3 * randn(len(points), generator=seeded(1))
    up = double([0.0, 0.0, 1.0])
    angle = _degrees(neighbour_normals(points, normals), up)
    edge = (points[:, :2] - 0.5).abs().amax(-1) > 0.47
    assert angle.square().mean().sqrt() < 0.15
    assert angle[edge].square().mean().sqrt() < 0.3


def test_a_rolled_leaf_is_not_a_plane():
    """A half cylinder of a radius of 10 points, with noise of 8 % of their spacing."""
    generator = seeded(2)
    angle, along = math.pi * rand(1600, generator=generator), 50 * rand(1600, generator=generator)
    true = torch.stack([angle.cos(), torch.zeros_like(angle), angle.sin()], -1)
    points = 10 * true + 0.08 * true * randn(1600, 1, generator=generator)
    points[:, 1] = along
    own = normalized(true + 0.05 * randn(1600, 3, generator=generator))
    assert _degrees(neighbour_normals(points, own), true).square().mean().sqrt() < 1.5


def test_a_leaf_close_above_another_one_counts_little():
    """Two sheets with the same normals, two spacings of points apart: planes through both would stand across them."""
    points, normals = _sheet(4000)
    points[:2000, 2] += 0.045
    points[:, 2] += 0.001 * randn(4000, generator=seeded(3))
    found = _degrees(neighbour_normals(points, normals), double([0.0, 0.0, 1.0]))
    assert found.square().mean().sqrt() < 5


def test_another_sheet_counts_little():
    """At an edge of two sheets the normals of both stay their own; equal neighbours would round it."""
    points, _ = _sheet(2000)
    other = points[:, [2, 1, 0]]
    both = torch.cat([points, other])
    up = double([0.0, 0.0, 1.0]).repeat(2000, 1)
    across = up[:, [2, 1, 0]]
    true = torch.cat([up, across])
    assert _degrees(neighbour_normals(both, true), true).max() < 1e-4


def test_weights_count():
    points, normals = _sheet(3000)
    lifted = points.clone()
    stray = torch.arange(len(points)) % 5 < 3
    lifted[stray, 2] += 0.02 * rand(int(stray.sum()), generator=seeded(4))
    weights = torch.where(stray, 0.0, 1.0)
    assert neighbour_normals(lifted, normals, weights)[~stray][:, 2].abs().min() > 1 - 1e-9
    assert neighbour_normals(lifted, normals)[~stray][:, 2].abs().min() < 1 - 1e-9


def test_what_has_no_plane_keeps_its_normal():
    normals = torch.tensor([[0.0, 0.0, 1.0]]).repeat(5, 1)
    line = torch.linspace(0, 1, 5)[:, None] * torch.tensor([1.0, 2.0, 0.5])
    assert_close(neighbour_normals(line, normals), normals)
    assert_close(neighbour_normals(line[:2], normals[:2]), normals[:2])
    assert neighbour_normals(line[:0], normals[:0]).shape == (0, 3)
