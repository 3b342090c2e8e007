import math

import pytest
import torch
from shared import double, near, peak, rand, seeded

from gaussian_swaying.geometry.rotations import rotation_from_z, rotation_to_quat
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.planes import pixel_rays, plane_channels, surface_maps
from gaussian_swaying.rendering.torch_renderer import TorchRenderer

NORMAL = torch.nn.functional.normalize(double([0.3, -1.0, 0.2]), dim=0)
OFFSET = 0.1  # [m] of the plane from the origin


def _camera(width=40, height=30):
    return look_at_camera((0.4, -2.0, 0.3), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 35.0, width, height, dtype=torch.float64)


def _plane(count=2500, half=0.9):
    generator = seeded(0)
    flat = rand(count, 2, generator=generator) * 2 * half - half
    frame = rotation_from_z(NORMAL)
    means = torch.nn.functional.pad(flat, (0, 1)) @ frame.T + OFFSET * NORMAL
    angle = rand(count, generator=generator) * 2 * math.pi
    turn = torch.zeros(count, 3, 3).double()
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = angle.cos(), -angle.sin(), angle.sin(), angle.cos()
    turn[:, 2, 2] = 1.0
    quats = rotation_to_quat(frame @ turn)
    scales = double([0.05, 0.04, 0.001]).log().repeat(count, 1)
    return means, quats, scales


def _maps(camera, means, quats, scales, renderer=None):
    opacities = torch.full((len(means),), 0.9, dtype=means.dtype, device=means.device)
    sh = torch.zeros(len(means), 1, 3, dtype=means.dtype, device=means.device)
    view = camera.to(means.device, means.dtype)
    channels = plane_channels(means, quats, scales, view)
    drawn = (renderer or TorchRenderer()).render_splat(means, quats, scales, opacities, sh, view, channels=channels)
    return surface_maps(drawn.channels, drawn.alpha, view), drawn


def _true_depth(camera):
    rotation, eye = camera.world_to_camera[:3, :3], camera.position
    rays = pixel_rays(camera) @ rotation
    return (OFFSET - eye @ NORMAL) / (rays @ NORMAL)


def test_discs_of_a_plane_show_that_plane():
    camera = _camera()
    maps, _ = _maps(camera, *_plane())
    known = maps.known[..., 0]
    assert known.float().mean() > 0.5
    torch.testing.assert_close(maps.depth[known][:, 0], _true_depth(camera)[known], rtol=1e-6, atol=0)
    facing = camera.world_to_camera[:3, :3] @ NORMAL
    near(maps.unit[known], facing.expand(int(known.sum()), 3), 1e-6)
    assert (maps.distance[known] < 0).all()
    assert maps.depth[~known].eq(0).all()


def test_a_picture_without_gaussians_shows_no_surface():
    camera = _camera()
    maps, _ = _maps(camera, *(part[:0] for part in _plane()))
    assert not maps.known.any()
    assert maps.depth.eq(0).all()


def test_seen_from_behind_the_normal_turns():
    means, quats, scales = _plane(50)
    front = _camera()
    behind = look_at_camera((0.0, 2.0, 0.3), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), 35.0, 40, 30, dtype=torch.float64)
    for camera in (front, behind):
        channels = plane_channels(means, quats, scales, camera)
        seen = means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        assert (channels[:, 3] < 0).all()
        torch.testing.assert_close((channels[:, :3] * seen).sum(-1), channels[:, 3])


def test_derivatives_of_the_maps():
    camera = _camera(8, 6)
    means, quats, scales = _plane(6, half=0.2)
    scales = scales + math.log(5.0)

    def values(means, quats):
        maps, _ = _maps(camera, means, quats, scales)
        return torch.cat([maps.unit, maps.distance, maps.depth], dim=-1)

    assert values(means, quats).abs().sum() > 0
    inputs = (means.clone().requires_grad_(), quats.clone().requires_grad_())
    assert torch.autograd.gradcheck(values, inputs, eps=1e-7, atol=1e-4)


@pytest.mark.gpu
def test_gsplat_blends_the_same_channels():
    """Colours are as without channels, the background is not blended into them, and gradients agree with torch."""
    from gaussian_swaying.rendering.gsplat_renderer import GsplatRenderer

    camera, background = _camera(), torch.tensor([0.2, 0.5, 0.7], device="cuda")
    found, gradients = [], []
    for renderer in (GsplatRenderer(), TorchRenderer()):
        means, quats, scales = (part.float().cuda().requires_grad_() for part in _plane())
        maps, drawn = _maps(camera, means, quats, scales, renderer)
        (maps.depth.square().sum() + maps.unit[..., 0].sum()).backward()
        found.append((maps, drawn))
        gradients.append((means.grad, quats.grad))
        opacities, sh = torch.full((len(means),), 0.9).cuda(), torch.zeros(len(means), 1, 3).cuda()
        plain = renderer.render_splat(means, quats, scales, opacities, sh, camera, background)
        view = camera.to("cuda", torch.float32)
        channels = plane_channels(means, quats, scales, view)
        both = renderer.render_splat(means, quats, scales, opacities, sh, camera, background, channels=channels)
        torch.testing.assert_close(both.color, plain.color)
        torch.testing.assert_close(both.channels, drawn.channels)
    (ours, _), (expected, _) = found
    same = (ours.known == expected.known).float().mean()
    assert float(same) > 0.999
    known = ours.known & expected.known
    assert peak((ours.depth - expected.depth)[known]) < 1e-4
    for one, two in zip(*gradients, strict=True):
        assert float((one - two).norm() / two.norm()) < 0.02
