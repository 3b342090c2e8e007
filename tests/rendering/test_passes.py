import math

import pytest
import torch

from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.passes import (
    colormap,
    depth_colors,
    depth_steps,
    facing,
    mean_depth,
    normal_colors,
    scalar_colors,
)
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.rendering.torch_renderer import render_torch


def test_the_depth_of_a_wall():
    """A wall of Gaussians 2 units before the camera, opaque enough to have a depth wherever it covers a pixel."""
    x, z = torch.meshgrid(torch.linspace(-0.5, 0.5, 11), torch.linspace(-0.5, 0.5, 11), indexing="ij")
    means = torch.stack([x.reshape(-1), torch.zeros(121), z.reshape(-1)], -1)
    camera = look_at_camera([0, -2, 0], [0, 0, 0], [0, 0, 1], 60.0, 32, 32)
    shape = (0.06**2 * torch.eye(3)).expand(121, 3, 3)
    picture = render_torch(means, shape, torch.full((121,), 0.9), torch.ones(121, 3), camera)
    depth = mean_depth(picture)
    assert float(depth[16, 16]) == pytest.approx(2.0, rel=1e-5)  # along the axis, not the ray
    assert float(depth[12, 12]) == pytest.approx(2.0, rel=1e-5)
    assert float(depth[0, 0]) == 0.0
    assert 0.05 < (depth > 0).float().mean() < 0.5
    near, far = depth_colors(depth, 1.0, 2.0), depth_colors(depth, 2.0, 3.0)
    torch.testing.assert_close(near[16, 16], colormap(torch.tensor(0.0)))
    torch.testing.assert_close(far[16, 16], colormap(torch.tensor(1.0)))
    assert not near[0, 0].any()


def test_depth_in_16_bits():
    """0 is kept for nothing; no depth falls to it, and what is beyond the range is at its end."""
    found = depth_steps(torch.tensor([0.0, 1e-5, 0.0014, 2.0, 100.0]))
    assert found.dtype == torch.int32
    assert found.tolist() == [0, 1, 1, 2000, 65535]


def test_colours_of_the_scale():
    values = torch.tensor([-1.0, 0.0, 0.5, 1.0, 2.0])
    torch.testing.assert_close(colormap(torch.tensor([math.nan])), colormap(torch.zeros(1)))
    colours = colormap(values)
    assert torch.equal(colours[0], colours[1])
    assert torch.equal(colours[3], colours[4])
    luminance = colormap(torch.linspace(0, 1, 101)) @ torch.tensor([0.2126, 0.7152, 0.0722])
    assert (luminance.diff() > 0).all()  # readable in grey too
    blended = torch.tensor([[1.0, 4.0, 0.1]])
    alpha = torch.tensor([[[1.0], [0.8], [0.4]]])
    found = scalar_colors(blended, alpha, 2.0)
    torch.testing.assert_close(found[0, 0], colormap(torch.tensor(0.5)))
    torch.testing.assert_close(found[0, 1], colormap(torch.tensor(1.0)))
    assert not found[0, 2].any()


def test_normals_are_unit_and_in_the_axes_asked_for():
    turn = torch.tensor([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    blended = 0.7 * torch.tensor([[[1.0, 0.0, 0.0], [0.0, 0.6, 0.8]]])
    alpha = torch.tensor([[[0.7], [0.7]]])
    found = 2 * normal_colors(blended, alpha, turn) - 1
    torch.testing.assert_close(found[0], torch.tensor([[0.0, -1.0, 0.0], [0.6, 0.0, 0.8]]), rtol=0, atol=1e-6)
    assert not normal_colors(blended, 0.5 * alpha, turn).any()
    normals = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    view = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0]])
    assert torch.equal(facing(normals, view), -torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0]]))


def test_a_pixel_half_covered_has_a_depth():
    for alpha, depth in ((0.5, 3.0), (0.49, 0.0)):
        picture = RenderOutput(torch.zeros(1, 1, 3), torch.full((1, 1, 1), alpha), torch.full((1, 1, 1), 3.0 * alpha))
        assert math.isclose(float(mean_depth(picture)), depth, rel_tol=1e-6)
