"""Patches against mapped planes, inverses and the true areas of planes, shells and spheres."""

import math
import os

import pytest
import torch

from gaussian_swaying.gaussians.area import coverage_area, patch_area
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import sh_to_color
from gaussian_swaying.gaussians.model import GaussianSurfaceModel
from gaussian_swaying.gaussians.ply import read_ply
from gaussian_swaying.geometry import patches
from gaussian_swaying.geometry.covariances import (
    covariance,
    covariance_to_quat_scale,
    deform_covariance,
    limit_deformed,
    limit_stretch,
)
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.geometry.patches import deform_all, deform_normal, deform_patch, smallest_axis_normal
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def _unit(*shape, device="cpu", dtype=torch.float64):
    return torch.nn.functional.normalize(torch.randn(*shape, device=device, dtype=dtype), dim=-1)


def _gradients(count, device="cpu", dtype=torch.float64):
    """Deformation gradients of both orientations, none of them near singular."""
    f = torch.eye(3, dtype=torch.float64) + 0.3 * torch.randn(count, 3, 3, dtype=torch.float64)
    f = f[torch.linalg.det(f).abs() > 0.2]
    assert len(f) > 4
    f[0] = torch.diag(torch.tensor([1.0, -1.0, 1.0]))
    return f.to(device, dtype)


# --- rotations and covariances -----------------------------------------------------------------------------------


def test_quaternion_rotates_as_hamilton_product(device, dtype):
    quats, v = torch.randn(20, 4, device=device, dtype=dtype), torch.randn(20, 3, device=device, dtype=dtype)
    unit = quats / quats.norm(dim=-1, keepdim=True)
    w, u = unit[:, :1], unit[:, 1:]
    expected = v + 2 * torch.linalg.cross(u, torch.linalg.cross(u, v) + w * v)
    torch.testing.assert_close((quat_to_rotation(quats) @ v[..., None]).squeeze(-1), expected)


def test_rotation_to_quat_inverts(device, dtype):
    """Half turns about each axis included, where the formula from the trace divides by zero."""
    quats = torch.cat([torch.eye(4, dtype=torch.float64), _unit(200, 4)]).to(device, dtype)
    quats = torch.where(quats[:, :1] < 0, -quats, quats)
    back = rotation_to_quat(quat_to_rotation(quats))
    assert (back[:, 0] >= 0).all()
    torch.testing.assert_close(quat_to_rotation(back), quat_to_rotation(quats))
    torch.testing.assert_close(back[4:], quats[4:], rtol=0, atol=1e-5 if dtype == torch.float32 else 1e-13)


def test_covariance_has_the_axes_and_scales(device, dtype):
    quats, log_scales = torch.randn(9, 4, device=device, dtype=dtype), torch.randn(9, 3, device=device, dtype=dtype)
    a, rotation = covariance(quats, log_scales), quat_to_rotation(quats)
    torch.testing.assert_close(a, a.mT)
    torch.testing.assert_close(a @ rotation, rotation * (2 * log_scales).exp()[:, None])


def test_covariance_to_quat_scale_round_trip(device, dtype):
    quats, log_scales = (
        torch.randn(50, 4, device=device, dtype=dtype),
        torch.randn(50, 3, device=device, dtype=dtype) - 3,
    )
    a = deform_covariance(_gradients(1000, device, dtype)[:50], covariance(quats, log_scales))
    q, s = covariance_to_quat_scale(a)
    assert (q.dtype, s.dtype) == (dtype, dtype)
    torch.testing.assert_close(torch.linalg.det(quat_to_rotation(q)), torch.ones(50, device=device, dtype=dtype))
    torch.testing.assert_close(covariance(q, s), a, rtol=1e-4, atol=1e-6)
    assert (s.diff(dim=-1) >= 0).all()


def test_covariance_to_quat_scale_of_singular_and_equal_axes():
    singular = torch.diag_embed(torch.tensor([[0.0, 1.0, 4.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]))
    q, s = covariance_to_quat_scale(singular)
    assert torch.isfinite(q).all()
    assert torch.isfinite(s).all()
    assert (s.exp() > 0).all()
    torch.testing.assert_close(covariance(q, s), singular)
    again, _ = covariance_to_quat_scale(singular * (1 + 1e-6))
    torch.testing.assert_close(again, q)


def test_covariance_to_quat_scale_signs_follow_the_matrix():
    """A small change of the matrix may not flip an axis: frames of an animation would flicker."""
    a = covariance(_unit(100, 4), torch.tensor([0.0, -1.0, -2.0], dtype=torch.float64).expand(100, 3))
    q0, _ = covariance_to_quat_scale(a)
    q1, _ = covariance_to_quat_scale(a + 1e-9 * torch.eye(3, dtype=torch.float64))
    torch.testing.assert_close(q1, q0, rtol=0, atol=1e-6)


# --- deformation -------------------------------------------------------------------------------------------------


def test_deformed_covariance_is_that_of_mapped_samples(device, dtype):
    f, scales = _gradients(20, device, dtype)[:5], torch.randn(5, 3, device=device, dtype=dtype)
    quats = torch.randn(5, 4, device=device, dtype=dtype)
    axes = quat_to_rotation(quats) * scales.exp()[:, None]
    mapped = f @ axes
    torch.testing.assert_close(deform_covariance(f, covariance(quats, scales)), mapped @ mapped.mT)


def test_deformed_normal_and_area_match_a_mapped_plane():
    """Finite differences of x(u, v) on a curved map: the normal and the area of the image of the plane."""

    def curved(x):
        a, b, c = x.unbind(-1)
        return torch.stack([a + 0.3 * torch.sin(2 * b) + 0.2 * c, b + 0.4 * a * a, c + 0.5 * torch.cos(a + b)], dim=-1)

    points, step = torch.rand(30, 3, dtype=torch.float64), 1e-5
    tangents = torch.linalg.qr(torch.randn(30, 3, 3, dtype=torch.float64))[0]
    first, second = tangents[..., 0], tangents[..., 1]
    normal = torch.linalg.cross(first, second)
    shift = step * torch.eye(3, dtype=torch.float64)
    f = torch.stack([(curved(points + e) - curved(points - e)) / (2 * step) for e in shift], dim=-1)
    assert (torch.linalg.det(f) > 0).all()
    mapped = [(curved(points + step * t) - curved(points - step * t)) / (2 * step) for t in (first, second)]
    cross = torch.linalg.cross(*mapped)
    torch.testing.assert_close(deform_normal(f, normal), cross / cross.norm(dim=-1, keepdim=True), rtol=0, atol=1e-8)
    area = torch.rand(30, dtype=torch.float64)
    both = deform_patch(f, normal, area)
    assert torch.equal(both[0], deform_normal(f, normal))
    torch.testing.assert_close(both[1], cross.norm(dim=-1) * area, rtol=1e-7, atol=0)


def test_deformed_normal_matches_the_inverse(device, dtype):
    """Reflections included: the sign is that of F^-T N."""
    f = _gradients(40, device, dtype)
    normal = _unit(len(f), 3, device=device, dtype=dtype)
    expected = (torch.linalg.inv(f).mT @ normal[..., None]).squeeze(-1)
    assert (torch.linalg.det(f) < 0).any()
    torch.testing.assert_close(
        deform_normal(f, normal), expected / expected.norm(dim=-1, keepdim=True), rtol=1e-4, atol=1e-5
    )


def test_deformed_normal_of_singular_gradients(device, dtype):
    up = UP.to(device, dtype)
    flat = torch.diag(torch.tensor([2.0, 3.0, 0.0], device=device, dtype=dtype))  # the plane keeps its normal
    line = torch.diag(torch.tensor([2.0, 0.0, 1.0], device=device, dtype=dtype))  # the plane becomes a line
    tiny = 1e-12 * torch.eye(3, device=device, dtype=dtype)  # squares of cofactors underflow in float32
    f = torch.stack([flat, line, torch.zeros_like(flat), tiny]).requires_grad_()
    normal = deform_normal(f, up.expand(4, 3))
    torch.testing.assert_close(normal.detach(), up.expand(4, 3))
    normal.sum().backward()
    assert torch.isfinite(f.grad).all()
    area = torch.ones(4, device=device, dtype=dtype)
    assert deform_patch(f.detach(), up.expand(4, 3), area)[1][:3].tolist() == [6, 0, 0]


def test_everything_at_once_is_each_by_itself(device, dtype):
    """On a GPU in one kernel, if triton is there: turned over, flattened and undeformed patches included."""
    f = _gradients(60, device, dtype)
    f[1] = torch.diag(torch.tensor([2.0, 3.0, 0.0]))
    f[2] = 1e-12 * torch.eye(3)
    f[3] = torch.eye(3)
    f = f.mT.contiguous().mT  # any strides
    factor = torch.randn(len(f), 3, 3, device=device, dtype=dtype)
    rest, normal = factor @ factor.mT, _unit(len(f), 3, device=device, dtype=dtype)
    normal[1] = UP.to(normal)
    covariances, normals, rotations = deform_all(f, rest, normal)
    torch.testing.assert_close(covariances, deform_covariance(f, rest))
    torch.testing.assert_close(normals, deform_normal(f, normal), rtol=1e-4, atol=1e-5)
    stretched = [k for k in range(len(f)) if k not in (1, 2)]
    torch.testing.assert_close(rotations[stretched], polar_rotation(f)[stretched], rtol=0, atol=1e-5)
    assert torch.isfinite(rotations).all()
    assert torch.equal(covariances[3], rest[3])
    *same, none = deform_all(f, rest, normal, rotations=False)
    assert none is None
    assert torch.equal(same[0], covariances)
    assert torch.equal(same[1], normals)


def test_the_kernel_keeps_to_the_limit_as_torch_does(device):
    """In the interpreter too: far beyond the limit, a little, below, flat, empty, solids and grains."""
    kernels = pytest.importorskip("gaussian_swaying.geometry.patches_triton")
    if device.type == "cpu" and os.environ.get("TRITON_INTERPRET") != "1":
        pytest.skip("on this machine the kernels are compiled")
    count = 40
    f = torch.eye(3).repeat(count, 1, 1) + 0.2 * torch.randn(count, 3, 3)
    f[:20, 0, 1] += torch.logspace(-1, 2, 20)
    f[20] = torch.diag(torch.tensor([9.0, 3.0, 0.0]))
    f[21] = 0.0
    factor = torch.randn(count, 3, 3)
    rest = factor @ factor.mT
    rest[22] = 0.0
    normal, solid = _unit(count, 3, dtype=torch.float32), torch.arange(count) % 2 == 0
    given = [part.to(device) for part in (f, rest, normal)]
    for rotations in (True, False):
        made = kernels.deform_all(*given, rotations, 1.5, solid.to(device))
        drawn, _, turns = deform_all(*(part.double() for part in given), rotations, 1.5, solid.to(device))
        torch.testing.assert_close(made[0].double(), drawn, rtol=1e-4, atol=1e-4)
        assert (made[2] is None) == (turns is None)
    free = kernels.deform_all(*given, False)[0]
    torch.testing.assert_close(free, deform_covariance(*given[:2]))
    changed = (free != made[0]).any(-1).any(-1)
    assert 5 < int(changed.sum()) < 35


@pytest.mark.gpu
def test_the_kernel_is_the_one_that_is_asked(monkeypatch):
    """Not with a gradient, nor in float64."""
    pytest.importorskip("triton")
    kernels, calls = patches._kernels(), []
    assert kernels is not None
    deform = kernels.deform_all
    monkeypatch.setattr(kernels, "deform_all", lambda *a: calls.append(1) or deform(*a))
    f = torch.eye(3, device="cuda").expand(4, 3, 3)
    normal = torch.eye(3, device="cuda")[:1].expand(4, 3)
    deform_all(f.double(), f.double(), normal.double())
    deform_all(f.clone().requires_grad_(), f, normal)
    assert calls == []
    deform_all(f, f, normal)
    with torch.no_grad():
        deform_all(f.clone().requires_grad_(), f, normal)
    assert calls == [1, 1]
    assert deform_all(f[:0], f[:0], normal[:0])[2].shape == (0, 3, 3)


def test_gaussians_are_drawn_out_to_a_limit(device, dtype):
    """Those below it keep their bits; those above have that size, and stay proper covariances."""
    rest = torch.diag(torch.tensor([4.0, 1.0, 0.01])).expand(6, 3, 3).to(device, dtype)
    f = torch.eye(3).repeat(6, 1, 1).to(device, dtype)
    f[1, 0, 0] = 1.5
    f[2, 1, 0] = 3.0
    f[3, 1, 0] = 1e4
    f[4] = 50 * torch.eye(3)
    f[5] = 0.0
    covariances = deform_covariance(f, rest)
    limited = limit_stretch(covariances, rest, 2.0)
    assert torch.equal(limited[[0, 1, 5]], covariances[[0, 1, 5]])
    size = limited.diagonal(dim1=-2, dim2=-1).sum(-1)
    torch.testing.assert_close(size[2:5], 4 * rest.diagonal(dim1=-2, dim2=-1).sum(-1)[2:5])
    torch.testing.assert_close(limited, limited.mT)
    values = torch.linalg.eigvalsh(limited[2:5])
    assert float(values.min()) > 0.5  # of a rest size of 5.01, shared by three directions: no needle
    assert float(values[1, 2]) == pytest.approx(3 * 5.01 + 5.01 / 3, rel=1e-2)  # what is drawn out points as before
    axis = torch.linalg.eigh(limited[3])[1][:, 2]
    assert float(axis[1].abs()) > 0.999


def test_the_limit_on_stretch_is_reached_without_a_jump():
    rest = torch.eye(3, dtype=torch.float64)
    close = [
        limit_stretch(torch.diag(torch.tensor([a, 1.0, 1.0], dtype=torch.float64)), rest, 2.0)
        for a in (10.0 - 1e-9, 10.0 + 1e-9)
    ]
    torch.testing.assert_close(close[0], close[1], rtol=0, atol=1e-7)


def test_a_solid_beyond_the_limit_goes_back_to_its_own_shape(device, dtype):
    """A needle torn out a thousandfold stays a needle, turned with the material, where a grain becomes a ball."""
    rest = torch.diag(torch.tensor([4.0, 1.0, 0.01])).expand(4, 3, 3).to(device, dtype)
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], device=device, dtype=dtype)
    stretch = torch.tensor([[1.9, 1.0, 1.0], [1.0, 1e3, 1.0], [1.0, 1e3, 1.0], [3.0, 3.0, 3.0]]).to(rest)
    f = turn * stretch[:, None, :]
    drawn = deform_covariance(f, rest)
    solid = torch.tensor([True, True, False, True], device=device)
    kept = limit_deformed(f, drawn, rest, 2.0, solid)
    assert torch.equal(kept[0], drawn[0])
    assert torch.equal(limit_deformed(f, drawn, rest, 2.0, ~solid)[2], kept[1])
    torch.testing.assert_close(limit_deformed(f, drawn, rest, 2.0, solid, polar_rotation(f)), kept)
    size, size_at_rest = kept.diagonal(dim1=-2, dim2=-1).sum(-1), rest.diagonal(dim1=-2, dim2=-1).sum(-1)
    torch.testing.assert_close(size[1:], 4 * size_at_rest[1:])
    # turned, x and y change places; the thin axis stays thin, and what was torn out is 3 sizes long, not a thousand
    own, grain = (kept[k].diagonal().cpu().double() for k in (1, 2))
    torch.testing.assert_close(own, torch.tensor([3 * 5.01 + 1.0, 4.0, 0.01]).double(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(grain, torch.tensor([3 * 5.01 + 1.67, 1.67, 1.67]).double(), rtol=1e-3, atol=1e-4)
    torch.testing.assert_close(kept[3], 4 * turn @ rest[3] @ turn.T, rtol=1e-5, atol=1e-6)
    assert torch.equal(limit_deformed(f[:0], drawn[:0], rest[:0], 2.0, solid[:0]), drawn[:0])


def test_gradcheck(device):
    f = _gradients(20, device)[:4].requires_grad_()
    normal = _unit(4, 3, device=device).requires_grad_()
    a = covariance(_unit(4, 4, device=device), torch.randn(4, 3, device=device, dtype=torch.float64)).requires_grad_()
    log_scales = torch.randn(4, 3, device=device, dtype=torch.float64, requires_grad=True)
    area = torch.rand(4, device=device, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(deform_covariance, (f, a))
    assert torch.autograd.gradcheck(deform_normal, (f, normal))
    assert torch.autograd.gradcheck(deform_patch, (f, normal, area))
    assert torch.autograd.gradcheck(patch_area, (log_scales,))


def test_smallest_axis(device, dtype):
    quats = _unit(3, 4, device=device, dtype=dtype)
    log_scales = torch.tensor([[-9.0, 0, 1], [0, -9, 1], [1, 0, -9]], device=device, dtype=dtype)
    rotation = quat_to_rotation(quats)
    expected = torch.stack([rotation[0, :, 0], rotation[1, :, 1], rotation[2, :, 2]])
    torch.testing.assert_close(smallest_axis_normal(quats, log_scales), expected)


def test_patch_area_takes_the_two_larger_scales(device, dtype):
    scales = torch.tensor(
        [[2.0, 3.0, 0.1], [0.1, 2.0, 3.0], [3.0, 0.1, 2.0], [1.0, 1.0, 1.0]], device=device, dtype=dtype
    )
    expected = math.pi * torch.tensor([6.0, 6.0, 6.0, 1.0], device=device, dtype=dtype)
    torch.testing.assert_close(patch_area(scales.log()), expected)


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda z: quat_to_rotation(z(2, 3)), "quats"),
        (lambda z: rotation_to_quat(z(2, 3)), "rotation"),
        (lambda z: covariance(z(2, 4), z(2, 4)), "log_scales"),
        (lambda z: covariance_to_quat_scale(z(2, 3)), "covariances"),
        (lambda z: deform_covariance(z(2, 9), z(2, 3, 3)), "deformation_gradient"),
        (lambda z: deform_covariance(z(2, 3, 3), z(2, 6)), "covariances"),
        (lambda z: limit_stretch(z(2, 6), z(2, 3, 3), 2.0), "covariances"),
        (lambda z: limit_stretch(z(2, 3, 3), z(2, 6), 2.0), "rest"),
        (lambda z: limit_stretch(z(2, 3, 3), z(2, 3, 3), 2.0, z(2, 6)), "shape"),
        (lambda z: limit_deformed(z(2, 3, 3), z(3, 3, 3), z(2, 3, 3), 2.0, z(2)), "covariances"),
        (lambda z: limit_deformed(z(2, 3, 3), z(2, 3, 3), z(2, 3, 3), 2.0, z(3)), "solid"),
        (lambda z: deform_normal(z(2, 3, 3), z(2, 2)), "normals"),
        (lambda z: deform_patch(z(2, 3), z(2, 3), z(2)), "deformation_gradient"),
        (lambda z: patch_area(z(2, 2)), "log_scales"),
        (lambda z: coverage_area(z(2, 2), z(2, 3), z(2, 3)), "means"),
        (lambda z: coverage_area(z(2, 3), z(3, 3), z(2, 3)), "normals"),
        (lambda z: coverage_area(z(2, 3), z(2, 3), z(2, 3), z(3)), "opacity"),
    ],
)
def test_wrong_shapes_are_named(call, name):
    with pytest.raises(ValueError, match=rf"Expected `{name}` of shape .* but got"):
        call(torch.zeros)


# --- areas that add up -------------------------------------------------------------------------------------------


def _cloud(count=6, degree=2, normals=False, device="cpu", dtype=torch.float32):
    cloud = GaussianCloud(
        means=torch.randn(count, 3),
        quats=torch.randn(count, 4),
        scales=torch.randn(count, 3) - 3,
        opacities=torch.randn(count),
        sh=torch.randn(count, (degree + 1) ** 2, 3),
        normals=_unit(count, 3, dtype=torch.float32) if normals else None,
    )
    return cloud.to(device, dtype)


def test_model_holds_storage_form_parameters(device, dtype):
    model = GaussianSurfaceModel.from_cloud(_cloud(device=device, dtype=dtype))
    shapes = {name: tuple(parameter.shape) for name, parameter in model.named_parameters()}
    assert shapes == {"means": (6, 3), "quats": (6, 4), "scales": (6, 3), "opacities": (6,), "sh0": (6, 1, 3)} | {
        "shN": (6, 8, 3)
    }
    assert all(parameter.requires_grad for parameter in model.parameters())
    fixed = GaussianSurfaceModel.from_cloud(_cloud(device=device, dtype=dtype), requires_grad=False)
    assert not any(parameter.requires_grad for parameter in fixed.parameters())
    assert len(model) == 6


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("normals", [False, True])
def test_model_round_trip_through_a_file(tmp_path, degree, normals):
    cloud = _cloud(degree=degree, normals=normals)
    GaussianSurfaceModel.from_cloud(cloud).save_ply(tmp_path / "a.ply")
    model = GaussianSurfaceModel.from_ply(tmp_path / "a.ply", requires_grad=False)
    back = model.to_cloud()
    for field in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(back, field), getattr(cloud, field))
        assert not getattr(back, field).requires_grad
    assert torch.equal(back.normals, read_ply(tmp_path / "a.ply").normals)
    assert not any(parameter.requires_grad for parameter in model.parameters())


def test_model_leaves_its_cloud_alone():
    cloud = _cloud(normals=True)
    before = cloud.means.clone()
    model = GaussianSurfaceModel.from_cloud(cloud)
    with torch.no_grad():
        model.means.add_(1)
    assert torch.equal(cloud.means, before)


def test_model_normals_take_the_side_of_the_file():
    cloud = _cloud(200, normals=True)
    normals = GaussianSurfaceModel.from_cloud(cloud).normals()
    axis = smallest_axis_normal(cloud.quats, cloud.scales)
    assert ((normals * cloud.normals).sum(-1) >= 0).all()
    torch.testing.assert_close((normals * axis).sum(-1).abs(), torch.ones(200))
    assert not torch.equal(normals, axis)
    plain = GaussianSurfaceModel.from_cloud(_cloud())
    assert torch.equal(plain.normals(), smallest_axis_normal(plain.quats, plain.scales))


def test_model_methods_agree_with_the_functions(device, dtype):
    cloud = _cloud(40, device=device, dtype=dtype)
    model = GaussianSurfaceModel.from_cloud(cloud)
    directions = torch.randn(40, 3, device=device, dtype=dtype)
    torch.testing.assert_close(model.covariance(), covariance(cloud.quats, cloud.scales))
    torch.testing.assert_close(model.opacity(), 1 / (1 + (-cloud.opacities).exp()))
    torch.testing.assert_close(model.colors(directions), sh_to_color(cloud.sh, directions))
    torch.testing.assert_close(model.areas("paper"), patch_area(cloud.scales))
    expected = coverage_area(cloud.means, model.normals(), cloud.scales, model.opacity())
    torch.testing.assert_close(model.areas("coverage"), expected)
    assert not torch.allclose(expected, patch_area(cloud.scales))
    with pytest.raises(ValueError, match="Expected `mode` to be one of paper, coverage, but got 'disc'"):
        model.areas("disc")


def test_model_deforms_a_batch(device, dtype):
    model = GaussianSurfaceModel.from_cloud(_cloud(device=device, dtype=dtype))
    f = _gradients(100, device, dtype)[:12].unflatten(0, (2, 6))
    position = torch.randn(2, 6, 3, device=device, dtype=dtype)
    deformed = model.deformed(position, f)
    assert deformed.means is position
    torch.testing.assert_close(deformed.covariances, f @ model.covariance() @ f.mT)
    torch.testing.assert_close(deformed.normals, deform_normal(f, model.normals().expand(2, 6, 3)))
    deformed.covariances.sum().backward()
    assert model.quats.grad.abs().sum() > 0
    with pytest.raises(ValueError, match=r"Expected `deformation_gradient` of shape \(6, 3, 3\)"):
        model.deformed(position, f[:, :5])


def test_model_state_dict_round_trip():
    cloud = _cloud(normals=True)
    state = GaussianSurfaceModel.from_cloud(cloud).state_dict()
    other = GaussianSurfaceModel.from_cloud(_cloud(normals=True))
    other.load_state_dict(state)
    assert torch.equal(other.sh, cloud.sh)
    assert torch.equal(other.to_cloud().normals, cloud.normals)
