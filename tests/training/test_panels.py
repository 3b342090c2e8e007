import torch
from shared import near
from torch.testing import assert_close

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.torch_renderer import TorchRenderer
from gaussian_swaying.scenes.procedural import FlagScene
from gaussian_swaying.training.panels import panel


def test_a_panel_shows_four_pictures():
    model = GaussianSurfaceModel.from_cloud(FlagScene(spacing=0.05, ripple=0.0).generate())
    camera = look_at_camera((0.6, -1.0, 0.4), (0.6, 0.0, 0.4), (0.0, 0.0, 1.0), 30.0, 40, 30)
    photo = torch.rand(30, 40, 3)
    result = panel(model, TorchRenderer(), camera, photo)
    assert result.shape == (30, 160, 3)
    assert not result.requires_grad
    assert_close(result[:, :40], photo)
    normals, areas = result[15, 100], result[15, 140]
    near(normals, torch.tensor([0.5, 0.5, 1.0]), 0.03)
    assert areas.std() > 0.05  # equal areas have one colour of the ramp, which is none of its greys
