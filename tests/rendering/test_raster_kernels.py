"""The renderer in kernels against the torch renderer in float64, which is its definition."""

import math

import pytest
import torch
from shared import near, seeded

from gaussian_swaying.kernels.launch import compiles
from gaussian_swaying.rendering import raster, torch_renderer
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.torch_renderer import TorchRenderer, render_torch

from .conftest import oblique

pytestmark = pytest.mark.skipif(not compiles("cpu") or raster.INTERPRETED, reason="needs kernels compiled for the CPU")
BACKGROUND = torch.tensor([0.9, 0.1, 0.4])


def _camera(width=61, height=43):
    return oblique(width, height, 2.5, torch.float32)


def _scene(count=300, seed=3, size=0.08):
    generator = seeded(seed)
    means = (torch.rand(count, 3, generator=generator) - 0.5) * 2.0
    factors = torch.randn(count, 3, 3, generator=generator) * size
    opacities = torch.rand(count, generator=generator)
    opacities[: count // 10] = 1.0
    return means, factors @ factors.mT, opacities, torch.rand(count, 3, generator=generator)


def _agree(scene, camera, background=BACKGROUND):
    made = raster.render(*scene, camera, background)
    double = [part.double() for part in scene]
    pictures = []
    for change in (0.0, 1e-5, -1e-5):
        with pytest.MonkeyPatch.context() as patch:
            for name, times in (("MIN_ALPHA", 1), ("MIN_TRANSMITTANCE", 10)):
                patch.setattr(torch_renderer, name, getattr(torch_renderer, name) * (1 + times * change))
            pictures.append(render_torch(*double, camera, background.double()))
    far = float(pictures[0].depth.max().clamp_min(1.0))
    for name, limit in (("color", 1e-5), ("alpha", 1e-5), ("depth", 1e-5 * far)):
        found = getattr(made, name)
        assert found.dtype == torch.float32
        assert found.shape == getattr(pictures[0], name).shape
        errors = torch.stack([(found - getattr(picture, name)).abs() for picture in pictures])
        assert errors.amin(0).max() < limit, name
        assert (errors[0] < limit).double().mean() > 0.999, name
    return made


@pytest.mark.parametrize("size", [(61, 43), (64, 48), (8, 16), (1, 1), (7, 90), (130, 5)])
def test_random_gaussians(size):
    made = _agree(_scene(), _camera(*size))
    assert size == (1, 1) or float(made.alpha.max()) > 0.5


@pytest.mark.parametrize("seed", range(4))
def test_small_gaussians(seed):
    _agree(_scene(4000, seed, 0.01), _camera())


def test_pixels_end():
    means, covariances, opacities, colors = _scene(600, size=0.3)
    opacities = opacities * 0.1 + 0.9
    made = _agree((means, covariances, opacities, colors), _camera())
    assert (made.alpha > 0.999).float().mean() > 0.5
    assert made.alpha.min() < 0.99


def test_thin_and_huge_gaussians():
    means, covariances, opacities, colors = _scene()
    needle = torch.tensor([[3.0, 0, 0], [0, 3.0, 0], [3.0, 0, 0]]) * torch.tensor([1.0, 0.01, 1.0])
    covariances[:40] = needle @ needle.T * torch.linspace(0.01, 4, 40)[:, None, None]
    covariances[40:50] = 1e-12 * torch.eye(3)
    covariances[50:60] = torch.eye(3) * 100.0
    covariances[60:62] = torch.eye(3) * 1e12
    opacities[50:62] *= 0.1
    _agree((means, covariances, opacities, colors), _camera())


def test_gaussians_that_are_not_drawn():
    scene = _scene()
    expected = _agree(scene, _camera())
    extra = [part[:9].clone() for part in _scene(seed=4)]
    extra[0][0] = torch.tensor([0.1, -4.0, 0.2])
    extra[0][1] = torch.tensor([0.1, -2.4, 0.2])
    extra[2][2] = 0.0039
    extra[0][3] = torch.tensor([90.0, 0.0, 0.0])
    extra[0][4, 1], extra[1][5, 0, 2], extra[2][6], extra[3][7, 2] = math.nan, math.inf, math.nan, -math.inf
    extra[2][8] = 0.0
    made = raster.render(*map(torch.cat, zip(extra, scene, strict=True)), _camera(), BACKGROUND, 0.3)
    for name in ("color", "alpha", "depth"):
        assert torch.equal(getattr(made, name), getattr(expected, name))


@pytest.mark.parametrize("case", ["none", "behind", "aside"])
def test_empty_pictures(case):
    scene = _scene(count=0 if case == "none" else 50)
    scene[0].add_(torch.tensor([0.0, -90.0, 0.0] if case == "behind" else [900.0, 0.0, 0.0]))
    made = raster.render(*scene, _camera(), BACKGROUND, 0.3)
    assert made.color.eq(BACKGROUND).all()
    assert made.alpha.eq(0).all()
    assert made.depth.eq(0).all()


def test_near_and_far_gaussians_in_order():
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]), 16, 16)
    means = torch.tensor([[0.0, 0, 3.0], [0, 0, 2.0], [0, 0, 2.0], [0, 0, 2.0000002]])
    colors = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
    made = raster.render(means, 4 * torch.eye(3).expand(4, 3, 3), torch.ones(4), colors, camera, None, 0.3)
    assert float(made.color[8, 8, 1]) > 0.99
    assert float(made.color[8, 8, 0]) < 1e-3


def test_any_three_values():
    """Normals and scalars are blended as colours are, also negative ones and one column repeated."""
    means, covariances, opacities, colors = _scene()
    _agree((means, covariances, opacities, 2 * colors - 1), _camera())
    _agree((means, covariances, opacities, colors[:, :1].expand(-1, 3)), _camera())


def test_background():
    scene, camera = _scene(), _camera()
    made = _agree(scene, camera)
    black = raster.render(*scene, camera, None)
    near(made.color, black.color + (1 - black.alpha) * BACKGROUND, 1e-6)


def test_the_same_bits_for_any_number_of_threads():
    scene, camera, before = _scene(5000, size=0.02), _camera(300, 200), torch.get_num_threads()
    made = []
    try:
        for threads in (1, 2, 3):
            torch.set_num_threads(threads)
            made.append(raster.render(*scene, camera, BACKGROUND, 0.3))
    finally:
        torch.set_num_threads(before)
    for name in ("color", "alpha", "depth"):
        assert torch.equal(getattr(made[0], name), getattr(made[1], name))
        assert torch.equal(getattr(made[0], name), getattr(made[2], name))


@pytest.fixture
def drawn(monkeypatch):
    calls, render = [], raster.render

    def counted(*given):
        calls.append(render(*given))
        return calls[-1]

    monkeypatch.setattr(raster, "render", counted)
    return calls


def test_the_renderer_takes_the_kernels_without_gradients(drawn):
    renderer, scene, camera = TorchRenderer(), _scene(), _camera()
    made = renderer(*scene, camera, BACKGROUND)
    assert len(drawn) == 1
    assert made is drawn[0]
    with torch.inference_mode():
        renderer(*scene, camera)
        renderer(*[part.clone() for part in scene], camera, BACKGROUND.double())
    wanted = [part.clone().requires_grad_() for part in scene]
    with torch.no_grad():
        assert torch.equal(renderer(*wanted, camera, BACKGROUND).color, made.color)
    assert len(drawn) == 4


def test_gradients_and_float64_are_those_of_torch(drawn):
    scene, camera, renderer = _scene(), _camera(), TorchRenderer()
    for k in range(4):
        wanted = [part.clone().requires_grad_(n == k) for n, part in enumerate(scene)]
        renderer(*wanted, camera).color.sum().backward()
        assert wanted[k].grad.isfinite().all()
    background = BACKGROUND.clone().requires_grad_()
    renderer(*scene, camera, background).color.sum().backward()
    assert background.grad.abs().sum() > 0
    assert renderer(*[part.double() for part in scene], camera).color.dtype == torch.float64
    assert drawn == []


def test_too_many_pairs_are_left_to_torch(drawn, monkeypatch):
    monkeypatch.setattr(raster, "MOST_PAIRS", 100)
    scene, camera = _scene(), _camera()
    made = TorchRenderer()(*scene, camera)
    assert drawn == [None]
    assert torch.equal(made.color, render_torch(*scene, camera).color)
