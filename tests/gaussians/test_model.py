import pytest
import torch
from shared import gradients, value_error
from small_scenes import varied_cloud
from torch.testing import assert_close

from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.geometry.patches import deform_normal, smallest_axis_normal


def test_model_holds_storage_form_parameters(device, dtype):
    model = GaussianSurfaceModel.from_cloud(varied_cloud(6, 2).to(device, dtype))
    shapes = {name: tuple(parameter.shape) for name, parameter in model.named_parameters()}
    assert shapes == {"means": (6, 3), "quats": (6, 4), "scales": (6, 3), "opacities": (6,), "sh0": (6, 1, 3)} | {
        "shN": (6, 8, 3)
    }
    assert all(parameter.requires_grad for parameter in model.parameters())
    fixed = GaussianSurfaceModel.from_cloud(varied_cloud(6, 2).to(device, dtype), requires_grad=False)
    assert not any(parameter.requires_grad for parameter in fixed.parameters())
    assert len(model) == 6


@pytest.mark.parametrize("copy", [True, False])
def test_tensors_are_copied_or_shared(copy):
    cloud = varied_cloud(6, 2)
    model = GaussianSurfaceModel.from_cloud(cloud, requires_grad=False, copy=copy)
    assert all(torch.equal(getattr(model, name), getattr(cloud, name)) for name in ("means", "quats", "opacities"))
    shared = {name: getattr(model, name).data_ptr() == getattr(cloud, name).data_ptr() for name in ("means", "scales")}
    assert shared == {"means": not copy, "scales": not copy}


def test_model_state_dict_round_trip():
    cloud = varied_cloud(6, 2, normals=True)
    state = GaussianSurfaceModel.from_cloud(cloud).state_dict()
    other = GaussianSurfaceModel.from_cloud(varied_cloud(6, 2, seed=1, normals=True))
    other.load_state_dict(state)
    assert torch.equal(other.sh, cloud.sh)
    assert torch.equal(other.to_cloud().normals, cloud.normals)


def test_model_normals_take_the_side_of_the_file():
    cloud = varied_cloud(200, 2, normals=True)
    normals = GaussianSurfaceModel.from_cloud(cloud).normals()
    axis = smallest_axis_normal(cloud.quats, cloud.scales)
    assert ((normals * cloud.normals).sum(-1) >= 0).all()
    assert_close((normals * axis).sum(-1).abs(), torch.ones(200))
    assert not torch.equal(normals, axis)
    plain = GaussianSurfaceModel.from_cloud(varied_cloud(6, 2))
    assert torch.equal(plain.normals(), smallest_axis_normal(plain.quats, plain.scales))


def test_model_deforms_a_batch(device, dtype):
    model = GaussianSurfaceModel.from_cloud(varied_cloud(6, 2).to(device, dtype))
    f = gradients(100, device, dtype)[:12].unflatten(0, (2, 6))
    position = torch.randn(2, 6, 3, device=device, dtype=dtype)
    deformed = model.deformed(position, f)
    assert deformed.means is position
    assert_close(deformed.covariances, f @ model.covariance() @ f.mT)
    assert_close(deformed.normals, deform_normal(f, model.normals().expand(2, 6, 3)))
    deformed.covariances.sum().backward()
    assert model.quats.grad.abs().sum() > 0
    with value_error(r"Expected `deformation_gradient` of shape \(6, 3, 3\)"):
        model.deformed(position, f[:, :5])
