"""3x3 helpers against torch.linalg and the identities that define them."""

import pytest
import torch
from shared import EYE, double, near, peak, rand, randn, seeded
from torch.testing import assert_close

from gaussian_swaying.geometry.linalg import (
    cofactor,
    determinant,
    from_principal,
    largest_eigenvalue,
    polar_rotation,
    spectrum,
    svd3,
)


def _matrices(device, dtype, spread=0.3, count=200):
    generator = seeded(1)
    noise = randn(count, 3, 3, generator=generator)
    return (EYE + spread * noise).to(device, dtype)


def test_cofactor_and_determinant(device, dtype):
    F = _matrices(device, dtype)
    F = F[torch.linalg.det(F).abs() > 0.05]
    tol = 1e3 * torch.finfo(dtype).eps
    expected = torch.linalg.det(F)[:, None, None] * torch.linalg.inv(F).mT
    assert_close(cofactor(F), expected, rtol=tol, atol=tol)
    assert_close(determinant(F), torch.linalg.det(F), rtol=tol, atol=tol)


def test_polar_rotation_matches_svd(device, dtype):
    """Condition numbers up to 50; inverted matrices give the nearest rotation, not a reflection."""
    F = _matrices(device, dtype, spread=0.4)
    F = F[torch.linalg.cond(F.double()) < 50]
    u, s, vh = torch.linalg.svd(F.double())
    R = polar_rotation(F)
    # forward error of a polar factor: eps times the condition number
    tol = 100 * torch.finfo(dtype).eps
    proper = torch.linalg.det(F) > 0
    near(R[proper], (u @ vh).to(dtype)[proper], tol)
    eye = torch.eye(3, dtype=dtype, device=device).expand_as(R)
    near(R.mT @ R, eye, tol)
    near(torch.linalg.det(R), torch.ones(len(R), dtype=dtype, device=device), tol)
    # the nearest rotation has tr(R^T F) = s1 + s2 - s3
    inverted = ~proper
    assert int(inverted.sum()) > 5, "the test should meet inverted matrices"
    best = s[inverted] @ torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64, device=device)
    found = (R * F).double()[inverted].sum((-1, -2))
    near(found, best, 5e-3)
    clear = s[inverted][:, 1] > 1.5 * s[inverted][:, 2]
    near(found[clear], best[clear], 1e-4 if dtype == torch.float32 else 1e-5)


def test_polar_rotation_is_objective(device):
    """R(Q F) = Q R(F), and R(Q) = Q."""
    F = _matrices(device, torch.float64, spread=0.2)
    Q = torch.linalg.qr(_matrices(device, torch.float64, spread=1.0))[0]
    near(polar_rotation(Q @ F, 8), Q @ polar_rotation(F, 8), 1e-12)
    near(polar_rotation(Q, 8), Q, 1e-12)


def test_polar_gradient_at_identity():
    F = EYE.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(polar_rotation(F)[0, 1], F)
    expected = torch.zeros(3, 3).double()
    expected[0, 1], expected[1, 0] = 0.5, -0.5
    assert_close(gradient, expected)
    G = _matrices("cpu", torch.float64, spread=0.2, count=3)
    G = torch.cat([G, G @ torch.diag(double([1.0, 1.1, -0.5]))]).requires_grad_()
    assert torch.autograd.gradcheck(polar_rotation, G)


@pytest.mark.parametrize("matrix", [torch.zeros(3, 3), torch.diag(torch.tensor([1.0, 1.0, 0.0])), -torch.eye(3)])
def test_polar_rotation_of_degenerate_matrices_is_finite(matrix, dtype):
    F = matrix.to(dtype).requires_grad_()
    R = polar_rotation(F)
    assert torch.isfinite(R).all()
    (gradient,) = torch.autograd.grad(R.sum(), F)
    assert torch.isfinite(gradient).all()


def test_the_largest_eigenvalue_is_the_square_of_the_largest_singular_value():
    F = _matrices("cpu", torch.float64, spread=0.5)
    near(largest_eigenvalue(F.mT @ F), torch.linalg.matrix_norm(F, 2).square(), 1e-12)


def _graded(device, dtype, decades, count=2000):
    """Random matrices with stretches between 1 and 10^-decades, many of them repeated or nearly so, half inverted."""
    generator = seeded(2)
    u, v = (torch.linalg.qr(randn(count, 3, 3, generator=generator))[0] for _ in range(2))
    a = 10 ** (-decades * rand(count, 3, generator=generator))
    a[::3, 1] = a[::3, 0]
    a[::4, 2] = a[::4, 1] * (1 + 1e-5 * rand(len(a[::4]), generator=generator))
    F = u @ a.diag_embed() @ v.mT
    F[1::2] *= -1
    return F.to(device, dtype)


def _eye(dtype, device):
    return torch.eye(3, dtype=dtype, device=device)


# a Jacobi method is backward stable; some 40 rotations leave a few tens of eps
JACOBI = 30


@pytest.mark.parametrize("decades", [0, 1, 3, 6])
def test_svd3(device, dtype, decades):
    """Two rotations, sorted stretches, a sign for inverted matrices: against torch in float64."""
    F = _graded(device, dtype, decades)
    u, a, v = svd3(F)
    tol = JACOBI * torch.finfo(dtype).eps
    expected = torch.linalg.svdvals(F.double())
    largest = expected[:, :1, None]
    for rotation in (u, v):
        near(rotation.mT @ rotation, _eye(dtype, device).expand_as(u), tol)
        assert peak(torch.linalg.det(rotation) - 1) < tol
    assert peak((u @ a.diag_embed() @ v.mT - F).double() / largest) < tol
    error = (a.double().abs() - expected) / expected[:, :1]
    assert peak(error) < 3 * tol
    inverted = torch.linalg.det(F.double()) < 0
    assert 100 < int(inverted.sum()) < 1900
    sure = expected[:, 2] > 10 * tol * expected[:, 0]
    assert ((a[:, 2] < 0) == inverted)[sure].all()
    assert (a[:, :2] > -tol).all()
    near(spectrum(F).rotation, u @ v.mT, tol)


@pytest.mark.parametrize("name", ["zero", "rank one", "rank two", "identity", "reflection", "tiny"])
def test_spectrum_of_degenerate_matrices(device, dtype, name):
    eye = _eye(dtype, device)
    matrices = {"zero": 0 * eye, "rank one": eye[0].outer(eye[2] + eye[1]), "rank two": eye - eye[0].outer(eye[0])}
    F = (matrices | {"identity": eye, "reflection": -eye, "tiny": 1e-6 * (eye + 0.1)})[name]
    u, a, v = svd3(F)
    tol = JACOBI * torch.finfo(dtype).eps
    for rotation in (u, v, spectrum(F).rotation):
        near(rotation.mT @ rotation, eye, tol)
        assert abs(float(torch.linalg.det(rotation)) - 1) < tol
    assert_close(u @ a.diag() @ v.mT, F, rtol=tol, atol=tol * float(peak(F)))
    if name in ("identity", "tiny"):
        near(spectrum(F).rotation, eye, tol)


def test_shapes():
    for shape in [(), (0,), (4,), (2, 0), (2, 3)]:
        F = (torch.eye(3) + 0.1 * torch.rand(*shape, 3, 3)).requires_grad_()
        parts = spectrum(F)
        assert parts.stretch.shape == (*shape, 3)
        result = from_principal(parts, lambda a: a.square())
        assert result.shape == parts.rotation.shape == F.shape
        result.sum().backward()


def _log_sum(a):
    return a.log() + 0.3 * a.log().sum(-1, keepdim=True) + 0.1 * a.square()


REPEATED = {
    "identity": [1.0, 1, 1],
    "uniform": [0.7, 0.7, 0.7],
    "pair": [1.2, 1.2, 0.8],
    "low pair": [1.2, 0.8, 0.8],
    "near": [1.0, 1 + 1e-7, 0.9],
    "distinct": [1.3, 1.0, 0.6],
}


@pytest.mark.parametrize("name", list(REPEATED))
@pytest.mark.parametrize("rotated", [False, True])
def test_isotropic_functions_have_exact_gradients(name, rotated):
    """Where an eigenvector decomposition divides by the gap. Round-off of the differences is 1e-16 / 1e-6."""
    q = torch.linalg.qr(_matrices("cpu", torch.float64, spread=1.0, count=2))[0]
    q = q * torch.linalg.det(q)[:, None, None]
    F = (q[0] @ double(REPEATED[name]).diag() @ q[1].mT).requires_grad_()
    p = double(0.4).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, p: from_principal(spectrum(x), lambda a: p * _log_sum(a), rotated=rotated), (F, p), atol=1e-7
    )
    assert torch.autograd.gradcheck(lambda x: (spectrum(x).stretch.log().square().sum(), spectrum(x).rotation), F)


def test_isotropic_functions_of_inverted_matrices():
    """Exact there too, away from the state in which the least stretch is minus the middle one."""
    F = torch.diag(double([1.2, 0.9, -0.5]))
    F = (F + 0.02 * _matrices("cpu", torch.float64, count=3)).requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x: (from_principal(spectrum(x), lambda a: a.pow(3), rotated=True), spectrum(x).rotation), F
    )
    jump = torch.diag(torch.tensor([1.0, 0.5, -0.5])).requires_grad_()
    (gradient,) = torch.autograd.grad(from_principal(spectrum(jump), lambda a: a - 1, rotated=True).sum(), jump)
    assert torch.isfinite(gradient).all()


def test_isotropic_functions_that_are_known(device, dtype):
    F = _matrices(device, dtype)
    tol = JACOBI * torch.finfo(dtype).eps * float(peak(F)) ** 2
    parts = spectrum(F)
    near(from_principal(parts, lambda a: a, rotated=True), F, tol)
    near(from_principal(parts, lambda a: a.square()), F.mT @ F, tol)
    assert parts.spin is None
    with_gradient = spectrum(F.clone().requires_grad_())
    assert with_gradient.spin is not None
    for rotated in (False, True):
        values = [from_principal(p, lambda a: a.exp(), rotated=rotated) for p in (parts, with_gradient)]
        assert_close(*values, rtol=0, atol=tol)
    with torch.no_grad():
        assert spectrum(F.clone().requires_grad_()).spin is None
