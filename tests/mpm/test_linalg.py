"""3x3 helpers against torch.linalg and the identities that define them."""

import pytest
import torch

from gaussian_swaying.mpm.linalg import cofactor, determinant, polar_rotation, singular_values, symmetric_eigenvalues


def _matrices(device, dtype, spread=0.3, count=200):
    generator = torch.Generator().manual_seed(1)
    noise = torch.randn(count, 3, 3, generator=generator, dtype=torch.float64)
    return (torch.eye(3, dtype=torch.float64) + spread * noise).to(device, dtype)


def test_cofactor_and_determinant(device, dtype):
    F = _matrices(device, dtype)
    F = F[torch.linalg.det(F).abs() > 0.05]
    tol = 1e3 * torch.finfo(dtype).eps
    expected = torch.linalg.det(F)[:, None, None] * torch.linalg.inv(F).mT
    torch.testing.assert_close(cofactor(F), expected, rtol=tol, atol=tol)
    torch.testing.assert_close(determinant(F), torch.linalg.det(F), rtol=tol, atol=tol)


def test_polar_rotation_matches_svd(device, dtype):
    """Condition numbers up to 50; inverted matrices give the nearest rotation, not a reflection."""
    F = _matrices(device, dtype, spread=0.4)
    F = F[torch.linalg.cond(F.double()) < 50]
    u, s, vh = torch.linalg.svd(F.double())
    R = polar_rotation(F, 5 if dtype == torch.float32 else 8)
    # forward error of a polar factor: eps times the condition number
    tol = 100 * torch.finfo(dtype).eps
    proper = torch.linalg.det(F) > 0
    torch.testing.assert_close(R[proper], (u @ vh).to(dtype)[proper], rtol=0, atol=tol)
    eye = torch.eye(3, dtype=dtype, device=device).expand_as(R)
    torch.testing.assert_close(R.mT @ R, eye, rtol=0, atol=tol)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R), dtype=dtype, device=device), rtol=0, atol=tol)
    # the nearest rotation has tr(R^T F) = s1 + s2 - s3
    inverted = ~proper
    assert int(inverted.sum()) > 5, "the test should meet inverted matrices"
    best = s[inverted] @ torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64, device=device)
    found = (R * F).double()[inverted].sum((-1, -2))
    torch.testing.assert_close(found, best, rtol=0, atol=5e-3)
    clear = s[inverted][:, 1] > 1.5 * s[inverted][:, 2]
    torch.testing.assert_close(found[clear], best[clear], rtol=0, atol=1e-4 if dtype == torch.float32 else 1e-5)


def test_polar_rotation_is_objective(device):
    """R(Q F) = Q R(F), and R(Q) = Q."""
    F = _matrices(device, torch.float64, spread=0.2)
    Q = torch.linalg.qr(_matrices(device, torch.float64, spread=1.0))[0]
    torch.testing.assert_close(polar_rotation(Q @ F, 8), Q @ polar_rotation(F, 8), rtol=0, atol=1e-12)
    torch.testing.assert_close(polar_rotation(Q, 8), Q, rtol=0, atol=1e-12)


def test_polar_gradient_at_identity():
    """An SVD gives NaN here; the derivative of R at I is the skew part of the perturbation."""
    F = torch.eye(3, dtype=torch.float64).requires_grad_()
    (gradient,) = torch.autograd.grad(polar_rotation(F)[0, 1], F)
    expected = torch.zeros(3, 3, dtype=torch.float64)
    expected[0, 1], expected[1, 0] = 0.5, -0.5
    torch.testing.assert_close(gradient, expected)
    G = _matrices("cpu", torch.float64, spread=0.2, count=3).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: polar_rotation(x, 8), G, fast_mode=True)


@pytest.mark.parametrize("matrix", [torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 1.0, 0.0])), -torch.eye(3)])
def test_polar_rotation_of_degenerate_matrices_is_finite(matrix):
    assert bool(torch.isfinite(polar_rotation(matrix)).all())


def test_eigenvalues_and_singular_values():
    F = _matrices("cpu", torch.float64, spread=0.5)
    expected = torch.linalg.svdvals(F)
    torch.testing.assert_close(singular_values(F), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(symmetric_eigenvalues(F.mT @ F), expected.square(), rtol=0, atol=1e-7)
    torch.testing.assert_close(singular_values(torch.eye(3)), torch.ones(3, dtype=torch.float64))
