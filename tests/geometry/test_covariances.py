import pytest
import torch
from shared import EYE, double, gradients, near, randn, unit
from torch.testing import assert_close

from gaussian_swaying.geometry.covariances import (
    covariance,
    covariance_to_quat_scale,
    deform_covariance,
)
from gaussian_swaying.geometry.patches import deform_all
from gaussian_swaying.geometry.rotations import quat_to_rotation


def test_covariance_has_the_axes_and_scales(device, dtype):
    quats, log_scales = torch.randn(9, 4, device=device, dtype=dtype), torch.randn(9, 3, device=device, dtype=dtype)
    a, rotation = covariance(quats, log_scales), quat_to_rotation(quats)
    assert_close(a, a.mT)
    assert_close(a @ rotation, rotation * (2 * log_scales).exp()[:, None])


def test_covariance_to_quat_scale_round_trip(device, dtype):
    quats, log_scales = (
        torch.randn(50, 4, device=device, dtype=dtype),
        torch.randn(50, 3, device=device, dtype=dtype) - 3,
    )
    a = deform_covariance(gradients(1000, device, dtype)[:50], covariance(quats, log_scales))
    q, s = covariance_to_quat_scale(a)
    assert (q.dtype, s.dtype) == (dtype, dtype)
    assert_close(torch.linalg.det(quat_to_rotation(q)), torch.ones(50, device=device, dtype=dtype))
    assert_close(covariance(q, s), a, rtol=1e-4, atol=1e-6)
    assert (s.diff(dim=-1) >= 0).all()


def test_covariance_to_quat_scale_of_singular_and_equal_axes():
    singular = torch.diag_embed(torch.tensor([[0.0, 1.0, 4.0], [0.0, 0.0, 1.0], [1.0, 1.0, 1.0], [0.0, 0.0, 0.0]]))
    q, s = covariance_to_quat_scale(singular)
    assert torch.isfinite(q).all()
    assert torch.isfinite(s).all()
    assert (s.exp() > 0).all()
    assert_close(covariance(q, s), singular)
    again, _ = covariance_to_quat_scale(singular * (1 + 1e-6))
    assert_close(again, q)


def test_covariance_to_quat_scale_signs_follow_the_matrix():
    """A small change of the matrix may not flip an axis: frames of an animation would flicker."""
    a = covariance(unit(100, 4), double([0.0, -1.0, -2.0]).expand(100, 3))
    q0, _ = covariance_to_quat_scale(a)
    q1, _ = covariance_to_quat_scale(a + 1e-9 * EYE)
    near(q1, q0, 1e-6)


def test_deformed_covariance_is_that_of_mapped_samples(device, dtype):
    f, scales = gradients(20, device, dtype)[:5], torch.randn(5, 3, device=device, dtype=dtype)
    quats = torch.randn(5, 4, device=device, dtype=dtype)
    axes = quat_to_rotation(quats) * scales.exp()[:, None]
    mapped = f @ axes
    assert_close(deform_covariance(f, covariance(quats, scales)), mapped @ mapped.mT)


def _drawn(f, rest, limit=2.0, solid=None):
    solid = torch.zeros(len(f), dtype=torch.bool, device=f.device) if solid is None else solid
    return deform_all(f, rest, torch.ones_like(f[:, 0]), False, limit, solid)[0]


def test_gaussians_are_drawn_out_to_a_limit(device, dtype):
    """Those below it keep their bits; those above have that size, and stay proper covariances."""
    rest = torch.diag(torch.tensor([4.0, 1.0, 0.01])).expand(6, 3, 3).to(device, dtype)
    f = torch.eye(3).repeat(6, 1, 1).to(device, dtype)
    f[1, 0, 0] = 1.5
    f[2, 1, 0] = 3.0
    f[3, 1, 0] = 1e4
    f[4] = 50 * torch.eye(3)
    f[5] = 0.0
    covariances, limited = (_drawn(f, rest, limit) for limit in (None, 2.0))
    assert torch.equal(limited[[0, 1, 5]], covariances[[0, 1, 5]])
    size = limited.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert_close(size[2:5], 4 * rest.diagonal(dim1=-2, dim2=-1).sum(-1)[2:5])
    assert_close(limited, limited.mT)
    values = torch.linalg.eigvalsh(limited[2:5])
    assert values.min() > 0.5  # of a rest size of 5.01, shared by three directions: no needle
    assert float(values[1, 2]) == pytest.approx(3 * 5.01 + 5.01 / 3, rel=1e-2)  # what is drawn out points as before
    axis = torch.linalg.eigh(limited[3])[1][:, 2]
    assert axis[1].abs() > 0.999


def test_the_limit_on_stretch_is_reached_without_a_jump():
    close = [_drawn(torch.diag(double([a**0.5, 1.0, 1.0]))[None], EYE[None]) for a in (10.0 - 1e-9, 10.0 + 1e-9)]
    near(close[0], close[1], 1e-7)


def test_a_solid_beyond_the_limit_goes_back_to_its_own_shape(device, dtype):
    rest = torch.diag(torch.tensor([4.0, 1.0, 0.01])).expand(4, 3, 3).to(device, dtype)
    turn = torch.tensor([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], device=device, dtype=dtype)
    stretch = torch.tensor([[1.9, 1.0, 1.0], [1.0, 1e3, 1.0], [1.0, 1e3, 1.0], [3.0, 3.0, 3.0]]).to(rest)
    f = turn * stretch[:, None, :]
    drawn = _drawn(f, rest, None)
    solid = torch.tensor([True, True, False, True], device=device)
    kept = _drawn(f, rest, solid=solid)
    assert torch.equal(kept[0], drawn[0])
    assert torch.equal(_drawn(f, rest, solid=~solid)[2], kept[1])
    size, size_at_rest = kept.diagonal(dim1=-2, dim2=-1).sum(-1), rest.diagonal(dim1=-2, dim2=-1).sum(-1)
    assert_close(size[1:], 4 * size_at_rest[1:])
    # turned, x and y change places; the thin axis stays thin, and what was torn out is 3 sizes long, not a thousand
    own, grain = (kept[k].diagonal().cpu().double() for k in (1, 2))
    assert_close(own, double([3 * 5.01 + 1.0, 4.0, 0.01]), rtol=1e-3, atol=1e-4)
    assert_close(grain, double([3 * 5.01 + 1.67, 1.67, 1.67]), rtol=1e-3, atol=1e-4)
    assert_close(kept[3], 4 * turn @ rest[3] @ turn.T, rtol=1e-5, atol=1e-6)
    assert _drawn(f[:0], rest[:0]).shape == (0, 3, 3)


def test_gradcheck(device):
    f = gradients(20, device)[:4].requires_grad_()
    a = covariance(unit(4, 4, device=device), randn(4, 3, device=device)).requires_grad_()
    assert torch.autograd.gradcheck(deform_covariance, (f, a))
