import math

import pytest
import torch
from shared import alike, double, normalized, rand, randn, unit, value_error
from torch.testing import assert_close

from gaussian_swaying.gaussians import area
from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.kernels.launch import replaces

UP = double([0.0, 0.0, 1.0])


def _plane(kind, side):
    """side^2 points of the unit square."""
    line = (torch.arange(side).double() + 0.5) / side
    points = torch.cartesian_prod(line, line)
    if kind == "jittered":
        points = points + (rand(side**2, 2) - 0.5) * 0.8 / side
    if kind == "random":
        points = rand(side**2, 2)
    return torch.nn.functional.pad(points, (0, 1))


def _discs(count, area, overlap):
    scale = math.log(overlap * math.sqrt(area / count))
    return double([scale, scale, scale - 3]).expand(count, 3)


def _areas(points, normals=UP, overlap=0.5, opacity=None, area=1):
    count = len(points)
    return coverage_area(points, normals.expand(count, 3), _discs(count, area, overlap), opacity)


@pytest.mark.parametrize("overlap", [0.3, 0.5, 1.0])
@pytest.mark.parametrize("kind", ["regular", "jittered", "random"])
@pytest.mark.parametrize("side", [32, 100])
def test_sum_is_the_area_of_a_plane_with_borders(kind, side, overlap):
    """The paper's pi s1 s2 gives 0.28 to 3.1 here."""
    assert float(_areas(_plane(kind, side), overlap=overlap).sum()) == pytest.approx(1, abs=0.03)


def test_each_patch_of_a_regular_plane_has_its_cell():
    areas = _areas(_plane("regular", 20), overlap=0.3) * 400
    inner = areas.unflatten(0, (20, 20))[3:-3, 3:-3]
    assert_close(inner, torch.ones_like(inner), rtol=0, atol=0.03)
    assert areas.min() > 0.7
    assert areas.max() < 1.4


@pytest.mark.parametrize("overlap", [0.3, 1.0])
@pytest.mark.parametrize("count", [1000, 10000])
@pytest.mark.parametrize("kind", ["spiral", "random"])
def test_sum_is_the_area_of_a_sphere(kind, count, overlap):
    if kind == "spiral":
        index = torch.arange(count).double()
        z, angle = 1 - 2 * (index + 0.5) / count, index * math.pi * (3 - math.sqrt(5))
        radius = (1 - z * z).sqrt()
        points = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)
    else:
        points = unit(count, 3)
    assert float(_areas(points, points, overlap, area=4 * math.pi).sum()) == pytest.approx(4 * math.pi, rel=0.03)


def test_sum_scales_and_moves_with_the_scene():
    points, scale = _plane("random", 40), 250.0
    rotation = quat_to_rotation(unit(4))
    moved = scale * points @ rotation.T + 1e3
    total = float(_areas(moved, rotation @ UP, area=scale**2).sum())
    assert total / scale**2 == pytest.approx(float(_areas(points).sum()), rel=2e-3)


@pytest.mark.slow(gate=["1-regular", "-1-random"])
@pytest.mark.parametrize("kind", ["regular", "random"])
@pytest.mark.parametrize("sign", [1, -1])
def test_shell_counts_each_sheet_from_one_spacing_apart(kind, sign):
    first, second, spacing = _plane(kind, 60), _plane(kind, 60), 1 / 60
    normals = torch.cat([UP.expand(3600, 3), sign * UP.expand(3600, 3)])

    def total(gap):
        points = torch.cat([first, second + gap * spacing * UP])
        return float(coverage_area(points, normals, _discs(3600, 1, 0.5).repeat(2, 1)).sum())

    assert total(1.0) == pytest.approx(2, rel=0.03)
    assert total(3.0) == pytest.approx(2, rel=0.03)
    assert total(0.2) == pytest.approx(1, rel=0.03)


def test_clones_thickness_and_sizes_do_not_change_the_sum():
    points, count = _plane("random", 60), 3600
    normals, discs, spacing = UP.expand(count, 3), _discs(count, 1, 0.5), 1 / 60
    copies = coverage_area(points.repeat(3, 1), normals.repeat(3, 1), discs.repeat(3, 1))
    assert float(copies.sum()) == pytest.approx(float(_areas(points).sum()), rel=1e-9)
    assert_close(copies[:count], copies[count : 2 * count])
    near = torch.cat([points, points + 1e-3 * spacing * torch.randn_like(points)])
    assert float(coverage_area(near, normals.repeat(2, 1), discs.repeat(2, 1)).sum()) == pytest.approx(1, abs=0.03)
    lifted = points + 0.1 * spacing * torch.randn(count, 1) * UP
    assert float(_areas(lifted).sum()) == pytest.approx(1, abs=0.03)
    sizes, opacity = discs + 0.7 * torch.randn(count, 1), torch.rand(count)
    assert float(coverage_area(points, normals, sizes, opacity).sum()) == pytest.approx(1, abs=0.03)
    tilted = normalized(normals + 0.1 * torch.randn(count, 3))
    assert float(_areas(points, tilted).sum()) == pytest.approx(1, abs=0.03)


def test_faint_patch_among_opaque_ones_carries_little():
    points = _plane("regular", 20)
    opacity = torch.ones(400).double()
    opacity[210] = 0.01
    areas = _areas(points, opacity=opacity)
    assert areas[210] < 0.05 / 400
    assert float(areas.sum()) == pytest.approx(float(_areas(points).sum()), rel=1e-9)


def test_twins_share_by_weight():
    points = _plane("regular", 20)
    points = torch.cat([points, points[210:211]])
    opacity = torch.ones(401).double()
    opacity[210], opacity[400] = 0.75, 0.25
    areas = coverage_area(points, UP.expand(401, 3), _discs(400, 1, 0.5)[:1].expand(401, 3), opacity)
    alone = _areas(points[:400])
    assert_close(areas[210] + areas[400], alone[210])
    assert_close(areas[210], 3 * areas[400])


@pytest.mark.parametrize("count", [1, 2, 3, 5, 8])
def test_few_or_lonely_gaussians_keep_their_own_area(count, device, dtype):
    means = 1e3 * torch.rand(count, 3, device=device, dtype=dtype)
    scales = torch.tensor([0.0, 0.5, -3.0], device=device, dtype=dtype).expand(count, 3)
    areas = coverage_area(means, normalized(torch.ones_like(means)), scales)
    assert (areas.dtype, areas.device.type) == (dtype, device.type)
    assert_close(areas, patch_area(scales))


def test_wild_input_stays_finite_and_positive():
    cluster = 1e-7 * torch.randn(500, 3)
    line = torch.stack([torch.linspace(0, 1, 300), torch.zeros(300), torch.zeros(300)], dim=-1)
    means = torch.cat([torch.rand(2000, 3), cluster, line, torch.full((60, 3), 0.5), torch.tensor([[1e6, 0, 0]])])
    scales = -4 + 2 * torch.randn(len(means), 3)
    areas = coverage_area(means, unit(len(means), 3, dtype=torch.float32), scales, torch.rand(len(means)))
    assert torch.isfinite(areas).all()
    assert (areas > 0).all()
    assert coverage_area(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 3)).shape == (0,)


@pytest.mark.skipif(not replaces((torch.ones(0).double(),), torch.float64), reason="nothing is compiled")
@pytest.mark.parametrize("neighbours", [6, 24])
def test_the_kernel_of_the_cells_is_their_definition(neighbours, monkeypatch):
    flat = rand(300, 3) * double([1.0, 0.6, 0.0])
    cluster = flat[:40] + 1e-3 * randn(40, 3)
    above = flat[100:200] + double([0.0, 0.0, 0.03])
    stack = flat[200:210] + double([0.0, 0.0, 1e-9])
    means = torch.cat([flat, cluster, above, stack, 5 + 10 * rand(7, 3)])
    normals = torch.tensor([0.0, 0.0, 1.0]) + 0.2 * randn(len(means), 3)
    normals[-7:] = torch.eye(3)[torch.arange(7) % 3]
    log_scales = torch.log(0.005 + 0.05 * rand(len(means), 3))
    opacity = rand(len(means))
    monkeypatch.setattr(area, "_CHUNK", 100)
    found = coverage_area(means, normals, log_scales, opacity, neighbours)
    asked = []
    monkeypatch.setattr(area, "replaces", lambda *_: asked.append(1))
    expected = coverage_area(means, normals, log_scales, opacity, neighbours)
    alike(found, expected, 3e-7)  # torch divides by counts in float32
    assert len(asked) == 5


def test_order_and_sign_do_not_matter():
    points = _plane("random", 50)
    areas = _areas(points)
    order = torch.randperm(2500)
    assert_close(_areas(points[order]), areas[order])
    alike(_areas(points, -UP).sum(), areas.sum(), 2e-3)


def test_coverage_rejects_bad_values():
    points = _plane("regular", 4)
    points[3, 1] = torch.nan
    with value_error("Expected `means` to be finite"):
        _areas(points)


def test_patch_area_takes_the_two_larger_scales(device, dtype):
    scales = torch.tensor(
        [[2.0, 3.0, 0.1], [0.1, 2.0, 3.0], [3.0, 0.1, 2.0], [1.0, 1.0, 1.0]], device=device, dtype=dtype
    )
    expected = math.pi * torch.tensor([6.0, 6.0, 6.0, 1.0], device=device, dtype=dtype)
    assert_close(patch_area(scales.log()), expected)
