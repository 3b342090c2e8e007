import math

import pytest
import torch
from shared import peak, seeded, value_error

from gaussian_swaying.kernels.launch import compiles
from gaussian_swaying.rendering import raster
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
from gaussian_swaying.rendering.thinning import FEWEST, thinned
from gaussian_swaying.rendering.torch_renderer import TorchRenderer, render_torch

WIDTH = 64
BACKGROUND = torch.tensor([0.1, 0.2, 0.9])


def _camera(dtype=torch.float32):
    return look_at_camera((0, -4, 0), (0, 0, 0), (0, 0, 1), 30.0, WIDTH, WIDTH, 0.1, dtype=dtype)


def _cloud(count, pixels, opacity=0.6, seed=0, dtype=torch.float32):
    draw = seeded(seed)
    means = torch.randn(count, 3, generator=draw, dtype=dtype) * 0.3
    focal = float(_camera().intrinsics[0, 0])
    # the root of the Frobenius norm of a ball's covariance is its deviation times the fourth root of three
    sigma = pixels * 4 / focal / 3**0.25
    shapes = sigma**2 * torch.eye(3, dtype=dtype).expand(count, 3, 3).contiguous()
    colours = (0.5 + means).clamp(0, 1)
    return means, shapes, torch.full((count,), opacity, dtype=dtype), colours


def _psnr(one, other):
    return -10 * math.log10(float((one - other).square().mean()))


@pytest.mark.parametrize(("pixels", "least"), [(0.05, 19), (0.1, 24), (0.2, 31)])
def test_thinned_gaussians_look_like_all_of_them(pixels, least):
    given, camera = _cloud(40_000, pixels, opacity=0.05), _camera()
    some = thinned(*given, camera, 1 / 3)
    assert len(some[0]) / len(given[0]) == pytest.approx(max((3 * pixels) ** 2, FEWEST), rel=0.1)
    chosen = torch.isin(given[0][:, 0], some[0][:, 0])
    assert int(chosen.sum()) - len(some[0]) <= 5  # two may have the same x
    full, made, left = (
        render_torch(*each, camera, BACKGROUND).color for each in (given, some, [part[chosen] for part in given])
    )
    assert _psnr(made, full) > max(least, 4 + _psnr(left, full))
    off, without = (float(peak(one.mean((0, 1)) - full.mean((0, 1)))) for one in (made, left))
    assert off < min(0.05, 0.6 * without)  # brightness


def test_one_covers_for_those_that_are_left_out():
    """Area, optical depth and the blur of the renderer, by the formulas of the docstring, in float64."""
    given = _cloud(2_000, 0.1, dtype=torch.float64)
    given[0][:, 1] = 0  # all at one depth
    _, shapes, opacities, colours = thinned(*given, _camera(torch.float64), 1 / 3)
    share, size2 = 0.09, 0.01
    torch.testing.assert_close(shapes[0], given[1][0] / share, rtol=1e-4, atol=0.0)
    grown = (0.3 + size2 / share) / (0.3 + size2)
    depth = -math.log(1 - float(opacities[0])) * grown * share
    assert depth == pytest.approx(-math.log(1 - 0.6), rel=1e-4)
    assert len(colours) == pytest.approx(share * 2_000, abs=2)


def test_large_gaussians_are_drawn_as_they_are():
    given = _cloud(500, 2.0)
    assert all(one is other for one, other in zip(thinned(*given, _camera()), given, strict=True))
    small = _cloud(500, 0.05)
    both = [torch.cat([one, other]) for one, other in zip(given, small, strict=True)]
    some = thinned(*both, _camera())
    assert all(torch.equal(one[:500], other) for one, other in zip(some, given, strict=True))
    small[0][3] = math.nan
    small[1][4] = math.inf
    assert len(thinned(*small, _camera())[0]) < 30
    assert torch.isfinite(TorchRenderer(detail=1.0)(*small, _camera()).color).all()


def test_the_same_gaussians_are_drawn_while_they_move():
    given = _cloud(5_000, 0.1)
    first = thinned(*given, _camera())[0]
    moved = thinned(given[0] + torch.tensor([0.01, 0.0, 0.0]), *given[1:], _camera())[0]
    torch.testing.assert_close(moved, first + torch.tensor([0.01, 0.0, 0.0]))


def test_a_renderer_thins_only_if_it_is_told_to():
    given, camera = _cloud(3_000, 0.1, dtype=torch.float64), _camera(torch.float64)
    background = BACKGROUND.double()
    rough = TorchRenderer(detail=0.5)(*given, camera, background)
    some = thinned(*given, camera, 0.5)
    assert torch.equal(rough.color, render_torch(*some, camera, background).color)
    assert not torch.equal(rough.color, TorchRenderer()(*given, camera, background).color)
    assert (TorchRenderer().detail, make_renderer("cpu").detail, make_renderer("cpu", detail=0.5).detail) == (0, 0, 0.5)
    with value_error(r"`detail` to not be negative"):
        TorchRenderer(detail=-1.0)


@pytest.mark.skipif(not compiles("cpu") or raster.INTERPRETED, reason="needs kernels compiled for the CPU")
@pytest.mark.parametrize("opacity", [0.05, 0.6, 1.0])
def test_kernels_thin_as_the_definition(opacity):
    """In float64, Gaussians of many sizes, some of them large; without a detail not a bit changes."""
    given = list(_cloud(3_000, 0.1, opacity))
    given[1] = given[1] * torch.logspace(-2, 3, 3_000)[:, None, None]
    camera = _camera()
    made = raster.render(*given, camera, BACKGROUND, 0.5)
    double = [part.double() for part in given]
    some = thinned(*double, _camera(torch.float64), 0.5)
    assert 0.3 < len(some[0]) / 3_000 < 0.9
    expected = render_torch(*some, _camera(torch.float64), BACKGROUND.double())
    errors = (made.color - expected.color).abs()
    assert (errors < 2e-5).double().mean() > 0.999
    assert errors.max() < 0.01
    assert torch.equal(
        raster.render(*given, camera, BACKGROUND).color, TorchRenderer()(*given, camera, BACKGROUND).color
    )
