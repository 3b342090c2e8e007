import torch
from torch.testing import assert_close

from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.training.initial import gaussians_from_points


def test_sizes_follow_the_distances():
    points = torch.cartesian_prod(*(torch.arange(4.0),) * 3) * 0.5
    colors = torch.rand(64, 3)
    cloud = gaussians_from_points(points, colors, 2, opacity=0.25, scale=0.8)
    assert_close(cloud.scales.exp(), torch.full((64, 3), 0.4))
    assert_close(cloud.opacities.sigmoid(), torch.full((64,), 0.25))
    assert_close(sh_to_color(cloud.sh, torch.randn(64, 3)), colors)
    assert cloud.sh_degree == 2


def test_points_on_one_another_keep_a_size():
    cloud = gaussians_from_points(torch.zeros(5, 3), torch.zeros(5, 3))
    assert torch.isfinite(cloud.scales).all()
    assert len(gaussians_from_points(torch.zeros(1, 3), torch.zeros(1, 3))) == 1
