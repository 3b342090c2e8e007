import math
import sys
import threading
import time
import types

import pytest
import torch
from filelock import FileLock
from shared import peak, seeded

from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.gsplat_renderer import (
    GsplatRenderer,
    build_folder,
    load_kernels,
    loaded_before,
    make_renderer,
    rasterize_splat,
    render_gsplat,
)
from gaussian_swaying.rendering.torch_renderer import TorchRenderer, render_torch


def _camera():
    return look_at_camera((0.2, -3.0, 0.4), (0, 0, 0), (0, 0, 1), 40.0, 480, 270)


def _scene(count=10_000, device="cuda"):
    generator = seeded(1)
    means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([3.0, 8.0, 2.0])
    factors = torch.randn(count, 3, 3, generator=generator) * 0.02 * torch.tensor([1.0, 1.0, 0.05])
    opacities, colors = torch.rand(count, generator=generator), torch.rand(count, 3, generator=generator)
    return tuple(item.to(device) for item in (means, factors @ factors.mT, opacities, colors))


@pytest.mark.gpu
def test_matches_the_torch_renderer():
    """Same conventions; single pixels differ where alpha or transmittance is at a threshold."""
    background = torch.tensor([0.3, 0.6, 0.9], device="cuda")
    result = GsplatRenderer()(*_scene(), _camera(), background)
    expected = render_torch(*_scene(), _camera(), background)
    assert 0.3 < expected.alpha.mean() < 0.99
    for name in ("color", "alpha", "depth"):
        difference = (getattr(result, name) - getattr(expected, name)).abs().flatten()
        scale = 1.0 if name != "depth" else 7.0
        assert difference.mean() <= 1e-3 * scale, name
        assert float(difference.quantile(0.999)) <= 1e-2 * scale, name


@pytest.mark.gpu
def test_a_picture_is_that_of_gsplat_s_rasterization():
    gsplat = pytest.importorskip("gsplat")
    means, covariances, opacities, colors = _scene(3000)
    view = _camera().to("cuda", torch.float32)
    ours = render_gsplat(means, covariances, opacities, colors, view)
    pixels, alpha, _ = gsplat.rasterization(
        means=means,
        quats=None,
        scales=None,
        opacities=opacities,
        colors=colors,
        viewmats=view.world_to_camera[None],
        Ks=view.intrinsics[None],
        width=view.width,
        height=view.height,
        near_plane=view.near,
        packed=True,
        render_mode="RGB+D",
        covars=covariances,
    )
    assert alpha.mean() > 0.05
    for actual, expected in (
        (ours.color, pixels[0, ..., :3]),
        (ours.depth, pixels[0, ..., 3:]),
        (ours.alpha, alpha[0]),
    ):
        assert peak(actual - expected) <= 1e-3  # Gaussians of equal depth in another order


@pytest.mark.gpu
def test_gradients_match_the_torch_renderer():
    gradients = []
    for render in (render_gsplat, render_torch):
        scene = [item.clone().requires_grad_() for item in _scene(500)]
        render(*scene, _camera()).color.square().sum().backward()
        gradients.append([scene[0].grad, scene[2].grad, scene[3].grad])
    for actual, expected in zip(*gradients, strict=True):
        assert float((actual - expected).norm() / expected.norm()) < 0.02


@pytest.mark.gpu
def test_nothing_visible_and_bad_gaussians():
    background = torch.tensor([0.2, 0.5, 1.0], device="cuda")
    scene = _scene(100)
    empty = tuple(item[:0] for item in scene)
    behind = (scene[0] - torch.tensor([0.0, 50.0, 0.0], device="cuda"), *scene[1:])
    for gaussians in (empty, behind):
        result = render_gsplat(*gaussians, _camera(), background)
        assert result.color.eq(background).all()
        assert result.alpha.eq(0).all()
        assert result.depth.eq(0).all()
    expected = render_gsplat(*scene, _camera(), background)
    for field in range(4):
        extra = [item[:1].clone() for item in scene]
        extra[field].fill_(math.nan)
        result = render_gsplat(*(torch.cat(pair) for pair in zip(scene, extra, strict=True)), _camera(), background)
        torch.testing.assert_close(result.color, expected.color)


@pytest.mark.gpu
def test_make_renderer_with_cuda():
    assert isinstance(make_renderer("cuda:0"), GsplatRenderer)
    with pytest.raises(RuntimeError, match="CUDA device"):
        GsplatRenderer()(*_scene(5, "cpu"), _camera())


@pytest.mark.skipif(torch.cuda.is_available(), reason="is about machines without CUDA")
def test_missing_cuda_is_named():
    with pytest.raises(RuntimeError, match=r"needs CUDA.*TorchRenderer"):
        GsplatRenderer()
    with pytest.raises(RuntimeError, match="needs CUDA"):
        render_gsplat(*_scene(5, "cpu"), _camera())


@pytest.mark.gpu
def test_a_splat_as_it_is_stored_matches_the_torch_renderer():
    generator = seeded(1)
    count = 500
    means = (torch.rand(count, 3, generator=generator) - 0.5) * torch.tensor([3.0, 8.0, 2.0])
    parts = (
        means,
        torch.randn(count, 4, generator=generator),
        torch.rand(count, 3, generator=generator) - 4.0,
        torch.rand(count, generator=generator),
        torch.randn(count, 16, 3, generator=generator) * 0.2,
    )
    background = torch.tensor([0.3, 0.6, 0.9], device="cuda")
    results, gradients = [], []
    for renderer in (GsplatRenderer(), TorchRenderer()):
        splat = [part.cuda().requires_grad_() for part in parts]
        output = renderer.render_splat(*splat, _camera(), background)
        output.screen.means2d.retain_grad()
        output.color.square().sum().backward()
        screen = torch.zeros(count, 2, device="cuda")
        index = slice(None) if output.screen.index is None else output.screen.index
        screen[index] = output.screen.means2d.grad.reshape(-1, 2)
        results.append(output)
        gradients.append([*(part.grad for part in splat), screen])
    for name in ("color", "alpha"):
        difference = (getattr(results[0], name) - getattr(results[1], name)).abs().flatten()
        assert difference.mean() <= 1e-3
    for actual, expected in zip(*gradients, strict=True):
        assert float((actual - expected).norm() / expected.norm()) < 0.02


def test_one_process_compiles_the_kernels_of_gsplat_at_a_time(tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    backend = types.ModuleType("gsplat.cuda._backend")
    backend._C = object()
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)
    load_kernels.cache_clear()
    other, loaded = FileLock(tmp_path / "gsplat_cuda.lock", thread_local=False), []
    other.acquire()
    waiting = threading.Thread(target=lambda: loaded.append(load_kernels()))
    waiting.start()
    told, end = "", time.monotonic() + 60
    while "Another process is compiling" not in told:
        assert time.monotonic() < end
        told += capsys.readouterr().err
        waiting.join(0.01)
    assert waiting.is_alive()
    assert loaded == []
    other.release()
    waiting.join(60)
    load_kernels.cache_clear()
    assert loaded == [True]
    other.acquire(timeout=0)  # it was released
    other.release()


def test_the_folder_of_the_kernels_is_that_of_torch(tmp_path, monkeypatch):
    from torch.utils.cpp_extension import _get_build_directory

    monkeypatch.delenv("TORCH_EXTENSIONS_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert str(build_folder()) == _get_build_directory("gsplat_cuda", verbose=False)
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path / "mine"))
    assert str(build_folder()) == _get_build_directory("gsplat_cuda", verbose=False)


def test_kernels_that_were_loaded_before_are_loaded_by_their_file(tmp_path, monkeypatch):
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    library = tmp_path / "gsplat_cuda" / "gsplat_cuda.so"
    library.parent.mkdir()
    library.write_bytes(b"compiled")
    backend = types.ModuleType("gsplat.cuda._backend")
    backend._C = types.SimpleNamespace(__file__=str(library))
    by_file = []

    def load(name, asked_gsplat):
        monkeypatch.setitem(sys.modules, backend.__name__, backend)
        load_kernels.cache_clear()
        by_file.clear()
        assert load_kernels() is True
        assert by_file == ([] if asked_gsplat else [library]), name

    monkeypatch.setattr("gaussian_swaying.rendering.gsplat_renderer._load", by_file.append)
    assert not loaded_before()
    load("first", True)
    assert loaded_before()
    load("second", False)
    monkeypatch.setenv("NO_FAST_MATH", "1")
    assert not loaded_before()
    load("other option", True)
    load("the same option", False)
    monkeypatch.setattr(torch, "__version__", "3.0")
    load("other torch", True)
    library.write_bytes(b"compiled anew")
    load("other library", True)
    load_kernels.cache_clear()


@pytest.mark.gpu
@pytest.mark.parametrize("degree", [0, 2])
def test_put_together_it_is_the_picture_of_gsplat_s_rasterization(degree):
    from gsplat import rasterization

    generator = seeded(3)
    count, bands = 400, (degree + 1) ** 2
    leaves = {
        "means": torch.randn(count, 3, generator=generator) * 0.4,
        "quats": torch.randn(count, 4, generator=generator),
        "scales": 0.02 + 0.05 * torch.rand(count, 3, generator=generator),
        "opacities": torch.rand(count, generator=generator),
        "sh": 0.3 * torch.randn(count, bands, 3, generator=generator),
    }
    camera = look_at_camera((1.5, -2.0, 0.7), (0, 0, 0), (0, 0, 1), 40.0, 90, 70).to("cuda", torch.float32)
    background = torch.tensor([0.1, 0.5, 0.2], device="cuda")
    weight = torch.randn(70, 90, 3, generator=generator).cuda()
    found = []
    for own in (True, False):
        inputs = {name: value.cuda().requires_grad_() for name, value in leaves.items()}
        if own:
            pixels, alpha, screen = rasterize_splat(*inputs.values(), camera, background)
            centres, radii = screen.means2d, screen.radii
        else:
            pixels, alpha, meta = rasterization(
                *(inputs[name] for name in ("means", "quats", "scales", "opacities", "sh")),
                camera.world_to_camera[None],
                camera.intrinsics[None],
                90,
                70,
                near_plane=camera.near,
                sh_degree=degree,
                packed=False,
                backgrounds=background[None],
            )
            centres, radii = meta["means2d"], meta["radii"]
        centres.retain_grad()
        ((pixels[0] * weight).sum() + alpha.square().sum()).backward()
        drawn = (radii > 0).all(-1, keepdim=True)  # gsplat leaves the others as the memory was
        centres, kept = (torch.where(drawn, values, 0.0) for values in (centres, centres.grad))
        found.append([pixels, alpha, drawn.float(), centres, kept, *(leaf.grad for leaf in inputs.values())])
    for one, two in zip(*found, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-3, atol=1e-4 * float(peak(two)))
