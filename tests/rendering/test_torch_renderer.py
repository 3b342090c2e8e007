import math

import pytest
import torch
from shared import EYE, double, near, rand, randn, seeded, value_error
from small_scenes import varied_cloud

from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.geometry import covariances
from gaussian_swaying.rendering import torch_renderer
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera, project
from gaussian_swaying.rendering.protocol import finite_gaussians
from gaussian_swaying.rendering.torch_renderer import TorchRenderer, project_gaussians, render_torch

from .conftest import oblique

WIDTH, HEIGHT = 20, 14


def _camera():
    return oblique(WIDTH, HEIGHT, 2.0)


def _scene(count=40, dtype=torch.float64, device="cpu"):
    generator = seeded(3)
    means = (rand(count, 3, generator=generator) - 0.5) * 2.6
    factors = randn(count, 3, 3, generator=generator) * 0.15
    opacities = rand(count, generator=generator)
    colors = rand(count, 3, generator=generator)
    opacities[:6] = 1.0
    opacities[6] = 0.003  # below 1/255
    factors[7:10] = torch.tensor([[0.6, 0, 0], [0, 0.6, 0], [0.6, 0, 0]]) * torch.tensor([1.0, 0.01, 1.0])  # needles
    means[10] = torch.tensor([0.1, -1.9, 0.2])  # in front of the near plane
    means[11] = torch.tensor([0.3, -4.0, 0.2])  # behind the camera
    means[12] = torch.tensor([0.25, -1.7, 0.3])  # just behind the near plane, beyond the field of view
    means[13] = torch.tensor([1.5, 0.0, 0.0])  # centre off-screen
    factors[13] = EYE * 0.4
    means[14:18] *= 0.3  # large and opaque: they end the pixels behind them
    factors[14:18] = EYE * 0.3
    opacities[14:18] = 1.0
    covariances = factors @ factors.mT + 1e-6 * EYE
    return tuple(item.to(device, dtype) for item in (means, covariances, opacities, colors))


def _oracle(means, covariances, opacities, colors, camera, background):
    (fx, _, cx), (_, fy, cy), _ = camera.intrinsics.tolist()
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    tan_x, tan_y = camera.width / (2 * fx), camera.height / (2 * fy)
    splats = []
    for mean, covariance, opacity, color in zip(means, covariances, opacities.tolist(), colors, strict=True):
        x, y, z = (rotation @ mean + shift).tolist()
        if z < camera.near:
            continue
        u = min((camera.width - cx) / fx + 0.3 * tan_x, max(-cx / fx - 0.3 * tan_x, x / z))
        v = min((camera.height - cy) / fy + 0.3 * tan_y, max(-cy / fy - 0.3 * tan_y, y / z))
        jacobian = double([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
        image = jacobian @ rotation @ covariance @ rotation.T @ jacobian.T + 0.3 * torch.eye(2).double()
        splats.append((z, fx * x / z + cx, fy * y / z + cy, torch.linalg.inv(image).tolist(), opacity, color))
    splats.sort(key=lambda splat: splat[0])
    color_image = torch.zeros(camera.height, camera.width, 3).double()
    alpha_image, depth_image = color_image[..., :1].clone(), color_image[..., :1].clone()
    stopped = 0
    for row in range(camera.height):
        for column in range(camera.width):
            transmittance = 1.0
            for z, center_x, center_y, inverse, opacity, color in splats:
                dx, dy = column + 0.5 - center_x, row + 0.5 - center_y
                power = inverse[0][0] * dx * dx + 2 * inverse[0][1] * dx * dy + inverse[1][1] * dy * dy
                alpha = min(0.999, opacity * math.exp(-0.5 * power))
                if alpha < 1 / 255:
                    continue
                if transmittance * (1 - alpha) <= 1e-4:
                    stopped += 1
                    break
                color_image[row, column] += transmittance * alpha * color
                depth_image[row, column] += transmittance * alpha * z
                transmittance *= 1 - alpha
            alpha_image[row, column] = 1 - transmittance
            color_image[row, column] += transmittance * background
    return color_image, alpha_image, depth_image, stopped


def test_matches_the_loop_over_pixels(device, dtype):
    background = double([0.9, 0.1, 0.4])
    color, alpha, depth, stopped = _oracle(*_scene(), _camera(), background)
    assert stopped > 10
    assert alpha.min() < 0.3
    assert alpha.max() > 0.99
    result = TorchRenderer()(*_scene(dtype=dtype, device=device), _camera(), background)
    assert result.color.dtype == dtype
    assert result.color.device.type == device.type
    tolerance = 1e-10 if dtype == torch.float64 else 2e-4
    near(result.color.cpu().double(), color, tolerance)
    near(result.alpha.cpu().double(), alpha, tolerance)
    near(result.depth.cpu().double(), depth, tolerance * 4)


def test_an_opaque_gaussian_lets_a_thousandth_through():
    camera = Camera(torch.eye(4), torch.tensor([[10.0, 0, 4.5], [0, 10, 4.5], [0, 0, 1]]), 9, 9)
    given = torch.tensor([[0.0, 0.0, 2.0]]), 0.02 * torch.eye(3)[None], torch.ones(1), torch.ones(1, 3)
    assert float(render_torch(*given, camera).alpha.max()) == pytest.approx(0.999, abs=1e-6)


def test_projection_is_sorted_and_keeps_what_is_seen():
    projected = project_gaussians(*_scene()[:3], _camera())
    assert (projected.depths.diff() >= 0).all()
    kept = set(projected.index.tolist())
    assert kept.isdisjoint({6, 10, 11})
    assert {0, 7, 13} <= kept


@pytest.mark.parametrize("pairs", [1, 7, 100, 1 << 20])
def test_memory_limit_does_not_change_the_picture(pairs, monkeypatch):
    expected = render_torch(*_scene(), _camera())
    monkeypatch.setattr(torch_renderer, "PAIRS", pairs)
    result = TorchRenderer()(*_scene(), _camera())
    for name in ("color", "alpha", "depth"):
        near(getattr(result, name), getattr(expected, name), 1e-12)


def test_deterministic_bit_for_bit():
    scene = _scene(400, torch.float32)
    first, second = render_torch(*scene, _camera()), render_torch(*scene, _camera())
    assert torch.equal(first.color, second.color)
    assert torch.equal(first.alpha, second.alpha)
    with torch.inference_mode():
        assert torch.equal(first.color, render_torch(*scene, _camera()).color)


@pytest.mark.parametrize("case", ["none", "behind", "aside"])
def test_nothing_visible(device, dtype, case):
    scene = _scene(dtype=dtype, device=device)
    if case == "none":
        scene = tuple(item[:0] for item in scene)
    else:
        offset = torch.tensor([0.0, -9.0, 0.0] if case == "behind" else [900.0, 0.0, 0.0], dtype=dtype, device=device)
        scene = (scene[0] + offset, *scene[1:])
    background = torch.tensor([0.2, 0.5, 1.0], dtype=dtype, device=device)
    result = render_torch(*scene, _camera(), background)
    assert result.color.shape == (HEIGHT, WIDTH, 3)
    assert result.color.eq(background).all()
    assert result.alpha.shape == result.depth.shape == (HEIGHT, WIDTH, 1)
    assert result.alpha.eq(0).all()
    assert result.depth.eq(0).all()


def test_bad_gaussians_do_not_poison_the_picture():
    scene = _scene()
    expected = render_torch(*scene, _camera())
    for field in range(4):
        for value in (math.nan, math.inf):
            extra = [item[:1].clone() for item in scene]
            extra[field].fill_(value)
            result = render_torch(*(torch.cat(pair) for pair in zip(scene, extra, strict=True)), _camera())
            near(result.color, expected.color, 1e-12)
    huge = (scene[0][:1], EYE[None] * 1e305, scene[2][:1], scene[3][:1])
    assert render_torch(*huge, _camera()).color.isfinite().all()


def test_gradcheck(monkeypatch):
    monkeypatch.setattr(torch_renderer, "PAIRS", 300)
    means, covariances, opacities, colors = (item[[20, 21, 22, 23]].clone() for item in _scene())
    means *= 0.4  # inside the image
    factors = torch.linalg.cholesky(covariances + 0.02 * EYE)
    background = rand(3)
    inputs = (means, factors, 0.2 + 0.6 * opacities, colors, background)
    for item in inputs:
        item.requires_grad_()

    def render(means, factors, opacities, colors, background):
        result = render_torch(means, factors @ factors.mT, opacities, colors, _camera(), background)
        return result.color[::4, ::4], result.alpha[::4, ::4], result.depth[::4, ::4]

    assert all(float(output.detach().std()) > 0.01 for output in render(*inputs))
    assert torch.autograd.gradcheck(render, inputs, eps=1e-7, atol=1e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_bad_number_makes_a_gaussian_not_finite(dtype, device):
    means, covariances, opacities, colors = fields = _scene(80, dtype, device)
    assert finite_gaussians(*fields).all()
    covariances[0, 0, 0] = torch.finfo(dtype).max  # huge, yet a number
    expected = torch.ones(80, dtype=torch.bool)
    row = 1
    for field in (means, covariances, opacities[:, None], colors):
        for column in range(field[0].numel()):
            for value in (math.nan, math.inf, -math.inf):
                field[row].view(-1)[column] = value
                expected[row] = False
                row += 1
    assert row > 40
    assert finite_gaussians(*fields).tolist() == expected.tolist()
    assert finite_gaussians(*(field[:0] for field in fields)).shape == (0,)


def test_gradients_are_finite_where_gaussians_are_dropped():
    scene = [item.clone().requires_grad_() for item in _scene(dtype=torch.float32)]
    with torch.no_grad():
        scene[0][0] = math.nan
        scene[2][1] = 0.0
    render_torch(*scene, _camera()).color.square().sum().backward()
    for item in scene:
        assert item.grad.isfinite().all()
        assert item.grad.abs().sum() > 0
    assert scene[0].grad[0].eq(0).all()


@pytest.mark.parametrize(
    ("field", "name"), [(0, "means"), (1, "covariances"), (2, "opacities"), (3, "colors"), (4, "background")]
)
def test_bad_shapes_are_named(field, name):
    scene = [*_scene(), torch.zeros(3)]
    scene[field] = torch.zeros(7, 7)
    with value_error(f"`{name}`"):
        render_torch(*scene[:4], _camera(), scene[4])
    scene[field] = [1.0]
    with pytest.raises(TypeError, match=f"`{name}`"):
        render_torch(*scene[:4], _camera(), scene[4])


def test_a_splat_as_it_is_stored():
    cloud = varied_cloud(40, 2)
    means, opacities = 0.5 * (cloud.means - 1), cloud.opacities.sigmoid()
    quats, log_scales, sh = cloud.quats, cloud.scales, cloud.sh
    camera = look_at_camera((0.2, -3.0, 0.4), (0, 0, 0), (0, 0, 1), 40.0, 48, 32)
    background = torch.tensor([0.2, 0.4, 0.6])
    renderer = TorchRenderer()
    colors = sh_to_color(sh, means - camera.position)
    expected = renderer(means, covariances.covariance(quats, log_scales), opacities, colors, camera, background)
    tensors = [t.requires_grad_() for t in (means, quats, log_scales, opacities, sh)]
    result = renderer.render_splat(*tensors, camera, background)
    torch.testing.assert_close(result.color, expected.color)
    torch.testing.assert_close(result.alpha, expected.alpha)
    screen = result.screen
    assert (screen.width, screen.height) == (48, 32)
    assert screen.means2d.shape == screen.radii.shape == (len(screen.index), 2)
    assert (screen.radii > 0).all()
    screen.means2d.retain_grad()
    result.color.square().sum().backward()
    assert screen.means2d.grad.abs().sum() > 0
    assert all(t.grad is not None and torch.isfinite(t.grad).all() for t in tensors)
    # the centres on the screen are those of a pinhole
    pinhole = project(means, camera)[0][screen.index].float()
    torch.testing.assert_close(screen.means2d.detach(), pinhole, rtol=1e-4, atol=1e-3)
