"""The fixed-corotated law against its energy, symmetry and small-strain limit."""

import pytest
import torch

from gaussian_swaying.mpm.constitutive import (
    fixed_corotated_energy,
    fixed_corotated_kirchhoff,
    fixed_corotated_pk1,
    lame_parameters,
)

E, NU = torch.tensor(3000.0, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
MU, LAM = lame_parameters(E, NU)


def _gradients(count=50, spread=0.25):
    return torch.eye(3, dtype=torch.float64) + spread * torch.randn(count, 3, 3, dtype=torch.float64)


def test_lame_parameters_give_back_e_and_nu():
    torch.testing.assert_close(MU * (3 * LAM + 2 * MU) / (LAM + MU), E)
    torch.testing.assert_close(LAM / (2 * (LAM + MU)), NU)


def test_stress_is_the_derivative_of_the_energy():
    F = _gradients().requires_grad_()
    (expected,) = torch.autograd.grad(fixed_corotated_energy(F, MU, LAM).sum(), F)
    stress = fixed_corotated_pk1(F, MU, LAM)
    torch.testing.assert_close(stress, expected, rtol=1e-8, atol=1e-8 * float(E))


def test_kirchhoff_is_symmetric_and_consistent():
    F = _gradients(spread=0.2)
    tau = fixed_corotated_kirchhoff(F, MU, LAM)
    torch.testing.assert_close(tau, fixed_corotated_pk1(F, MU, LAM) @ F.mT)
    # five Newton iterations leave the rotation wrong by less than 1e-9 here
    torch.testing.assert_close(tau, tau.mT, rtol=0, atol=1e-8 * float(E))


def test_rotation_costs_nothing_and_turns_the_stress():
    F = _gradients(spread=0.2)
    Q = torch.linalg.qr(torch.randn(50, 3, 3, dtype=torch.float64))[0]
    Q = Q * torch.linalg.det(Q)[:, None, None]
    assert float(fixed_corotated_pk1(Q, MU, LAM).abs().max()) < 1e-8 * float(E)
    turned, plain = fixed_corotated_kirchhoff(Q @ F, MU, LAM), fixed_corotated_kirchhoff(F, MU, LAM)
    torch.testing.assert_close(turned, Q @ plain @ Q.mT, rtol=0, atol=1e-8 * float(E))


def test_small_strain_limit_is_hooke():
    strain = 1e-6 * torch.tensor([[1.0, 0.5, 0.0], [0.5, -2.0, 0.3], [0.0, 0.3, 0.7]], dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    hooke = 2 * MU * strain + LAM * strain.trace() * eye
    torch.testing.assert_close(fixed_corotated_pk1(eye + strain, MU, LAM), hooke, rtol=0, atol=1e-5 * float(E) * 1e-6)


def test_crushed_and_inverted_elements_stay_finite():
    F = torch.tensor([[0.0, 0, 0], [1, 1, 0], [1, 1, -1]]).diag_embed()
    mu, lam = MU.float(), LAM.float()
    assert bool(torch.isfinite(fixed_corotated_pk1(F, mu, lam)).all())


def test_inverted_element_is_pushed_back():
    """Without the volume term too: a reflection costs energy, and the stress drives its flipped axis towards J > 0."""
    F = torch.diag(torch.tensor([1.2, 1.1, -0.6], dtype=torch.float64))
    mu, lam = torch.tensor(1.0, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)
    stress = fixed_corotated_pk1(F, mu, lam)
    torch.testing.assert_close(stress, 2 * (F - torch.eye(3, dtype=torch.float64)), rtol=0, atol=1e-9)
    assert float(stress[2, 2]) < -3
    assert float(fixed_corotated_energy(F, mu, lam)) == pytest.approx(0.2**2 + 0.1**2 + 1.6**2)
    G = (torch.eye(3, dtype=torch.float64) + 0.05 * torch.randn(20, 3, 3, dtype=torch.float64)) @ F
    G.requires_grad_()
    (expected,) = torch.autograd.grad(fixed_corotated_energy(G, mu, lam).sum(), G)
    torch.testing.assert_close(fixed_corotated_pk1(G, mu, lam), expected, rtol=0, atol=1e-7)
