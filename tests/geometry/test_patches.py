import pytest
import torch
from shared import EYE, alike, double, gradients, near, rand, randn, unit
from torch.testing import assert_close

from gaussian_swaying.geometry import patches
from gaussian_swaying.geometry.covariances import deform_covariance
from gaussian_swaying.geometry.linalg import polar_rotation
from gaussian_swaying.geometry.patches import deform_all, deform_normal, deform_patch, smallest_axis_normal
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.kernels.language import INTERPRETED

UP = double([0.0, 0.0, 1.0])


def test_deformed_normal_and_area_match_a_mapped_plane():
    def curved(x):
        a, b, c = x.unbind(-1)
        return torch.stack([a + 0.3 * torch.sin(2 * b) + 0.2 * c, b + 0.4 * a * a, c + 0.5 * torch.cos(a + b)], dim=-1)

    points, step = rand(30, 3), 1e-5
    tangents = torch.linalg.qr(randn(30, 3, 3))[0]
    first, second = tangents[..., 0], tangents[..., 1]
    normal = torch.linalg.cross(first, second)
    shift = step * EYE
    f = torch.stack([(curved(points + e) - curved(points - e)) / (2 * step) for e in shift], dim=-1)
    assert (torch.linalg.det(f) > 0).all()
    mapped = [(curved(points + step * t) - curved(points - step * t)) / (2 * step) for t in (first, second)]
    cross = torch.linalg.cross(*mapped)
    near(deform_normal(f, normal), cross / cross.norm(dim=-1, keepdim=True), 1e-8)
    area = rand(30)
    both = deform_patch(f, normal, area)
    near(both[0], deform_normal(f, normal), 1e-15)
    alike(both[1], cross.norm(dim=-1) * area, 1e-7)


def test_deformed_normal_matches_the_inverse(device, dtype):
    """Reflections included: the sign is that of F^-T N."""
    f = gradients(40, device, dtype)
    normal = unit(len(f), 3, device=device, dtype=dtype)
    expected = (torch.linalg.inv(f).mT @ normal[..., None]).squeeze(-1)
    assert (torch.linalg.det(f) < 0).any()
    assert_close(deform_normal(f, normal), expected / expected.norm(dim=-1, keepdim=True), rtol=1e-4, atol=1e-5)


def test_deformed_normal_of_singulargradients(device, dtype):
    up = UP.to(device, dtype)
    flat = torch.diag(torch.tensor([2.0, 3.0, 0.0], device=device, dtype=dtype))  # the plane keeps its normal
    line = torch.diag(torch.tensor([2.0, 0.0, 1.0], device=device, dtype=dtype))  # the plane becomes a line
    tiny = 1e-12 * torch.eye(3, device=device, dtype=dtype)  # squares of cofactors underflow in float32
    f = torch.stack([flat, line, torch.zeros_like(flat), tiny]).requires_grad_()
    normal = deform_normal(f, up.expand(4, 3))
    assert_close(normal.detach(), up.expand(4, 3))
    normal.sum().backward()
    assert torch.isfinite(f.grad).all()
    area = torch.ones(4, device=device, dtype=dtype)
    assert deform_patch(f.detach(), up.expand(4, 3), area)[1][:3].tolist() == [6, 0, 0]


def test_everything_at_once_is_each_by_itself(device, dtype):
    f = gradients(60, device, dtype)
    f[1] = torch.diag(torch.tensor([2.0, 3.0, 0.0]))
    f[2] = 1e-12 * torch.eye(3)
    f[3] = torch.eye(3)
    f = f.mT.contiguous().mT  # any strides
    factor = torch.randn(len(f), 3, 3, device=device, dtype=dtype)
    rest, normal = factor @ factor.mT, unit(len(f), 3, device=device, dtype=dtype)
    normal[1] = UP.to(normal)
    covariances, normals, rotations = deform_all(f, rest, normal)
    assert_close(covariances, deform_covariance(f, rest))
    assert_close(normals, deform_normal(f, normal), rtol=1e-4, atol=1e-5)
    stretched = [k for k in range(len(f)) if k not in (1, 2)]
    near(rotations[stretched], polar_rotation(f)[stretched], 1e-5)
    assert torch.isfinite(rotations).all()
    assert torch.equal(covariances[3], rest[3])
    *same, none = deform_all(f, rest, normal, rotations=False)
    assert none is None
    assert torch.equal(same[0], covariances)
    assert torch.equal(same[1], normals)


def test_the_kernel_keeps_to_the_limit_as_torch_does(device):
    """Far beyond the limit, a little, below, flat, empty, solids and grains."""
    count = 40
    f = torch.eye(3).repeat(count, 1, 1) + 0.2 * torch.randn(count, 3, 3)
    f[:20, 0, 1] += torch.logspace(-1, 2, 20)
    f[20] = torch.diag(torch.tensor([9.0, 3.0, 0.0]))
    f[21] = 0.0
    factor = torch.randn(count, 3, 3)
    rest = factor @ factor.mT
    rest[22] = 0.0
    normal, solid = unit(count, 3, dtype=torch.float32), torch.arange(count) % 2 == 0
    given = [part.to(device) for part in (f, rest, normal)]
    for rotations in (True, False):
        made = patches._deform_all(*given, rotations, 1.5, solid.to(device))
        drawn, _, turns = deform_all(*(part.double() for part in given), rotations, 1.5, solid.to(device))
        assert_close(made[0].double(), drawn, rtol=1e-4, atol=1e-4)
        assert (made[2] is None) == (turns is None)
    free = patches._deform_all(*given, False)[0]
    assert_close(free, deform_covariance(*given[:2]))
    changed = (free != made[0]).any(-1).any(-1)
    assert 5 < int(changed.sum()) < 35


@pytest.mark.skipif(INTERPRETED, reason="the interpreter replaces nothing")
def test_the_kernel_is_the_one_that_is_asked(device, monkeypatch):
    """Not with a gradient, nor in float64."""
    calls, deform = [], patches._deform_all
    monkeypatch.setattr(patches, "_deform_all", lambda *a: calls.append(1) or deform(*a))
    f = torch.eye(3, device=device).expand(4, 3, 3)
    normal = torch.eye(3, device=device)[:1].expand(4, 3)
    deform_all(f.double(), f.double(), normal.double())
    deform_all(f.clone().requires_grad_(), f, normal)
    assert calls == []
    deform_all(f, f, normal)
    with torch.no_grad():
        deform_all(f.clone().requires_grad_(), f, normal)
    assert calls == [1, 1]
    assert deform_all(f[:0], f[:0], normal[:0])[2].shape == (0, 3, 3)


def test_smallest_axis(device, dtype):
    quats = unit(3, 4, device=device, dtype=dtype)
    log_scales = torch.tensor([[-9.0, 0, 1], [0, -9, 1], [1, 0, -9]], device=device, dtype=dtype)
    rotation = quat_to_rotation(quats)
    expected = torch.stack([rotation[0, :, 0], rotation[1, :, 1], rotation[2, :, 2]])
    assert_close(smallest_axis_normal(quats, log_scales), expected)


def test_gradcheck(device):
    f = gradients(20, device)[:4].requires_grad_()
    normal = unit(4, 3, device=device).requires_grad_()
    area = rand(4, device=device, requires_grad=True)
    assert torch.autograd.gradcheck(deform_normal, (f, normal))
    assert torch.autograd.gradcheck(deform_patch, (f, normal, area))
