import math

import pytest
import torch
from shared import near, randn, unit, value_error
from torch.testing import assert_close

from gaussian_swaying.gaussians import harmonics
from gaussian_swaying.gaussians.harmonics import evaluate_sh, rotate_sh, sh_basis, sh_to_color
from gaussian_swaying.geometry.rotations import quat_to_rotation

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}


def _legendre(degree, order, z):
    """Associated Legendre polynomial with the Condon-Shortley phase, by its recurrence in the degree."""
    value = torch.ones_like(z)
    for k in range(1, order + 1):
        value = -value * (2 * k - 1) * (1 - z * z).sqrt()
    before = torch.zeros_like(z)
    for k in range(order + 1, degree + 1):
        before, value = value, ((2 * k - 1) * z * value - (k + order - 1) * before) / (k - order)
    return value


def _reference_basis(directions, degree):
    """Textbook real harmonics from spherical angles; the phase is kept, as 3DGS does."""
    x, y, z = directions.unbind(-1)
    azimuth = torch.atan2(y, x)
    columns = []
    for band in range(degree + 1):
        for order in range(-band, band + 1):
            m = abs(order)
            norm = math.sqrt((2 * band + 1) / (4 * math.pi) * math.factorial(band - m) / math.factorial(band + m))
            trig = torch.sin(m * azimuth) if order < 0 else torch.cos(m * azimuth)
            columns.append(norm * (math.sqrt(2) if m else 1) * _legendre(band, m, z) * trig)
    return torch.stack(columns, dim=-1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_evaluation(device, dtype, degree):
    directions = unit(50, 3, device=device, dtype=dtype)
    sh = torch.randn(50, (degree + 1) ** 2, 3, device=device, dtype=dtype)
    basis = _reference_basis(directions, degree)
    near(sh_basis(directions, degree), basis, TOLERANCE[dtype])
    expected = torch.einsum("nk,nkc->nc", basis, sh)
    tolerance = 10 * TOLERANCE[dtype]
    near(evaluate_sh(sh, directions), expected, tolerance)
    near(evaluate_sh(sh, 7 * directions), expected, tolerance)
    near(sh_to_color(sh, directions), (expected + 0.5).clamp(min=0), tolerance)
    assert (sh_to_color(sh, directions) == 0).any()


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_the_basis_as_one_product(device, dtype, degree):
    directions = unit(50, 3, device=device, dtype=dtype).requires_grad_()
    found, known = harmonics._basis_by_product(directions, degree), sh_basis(directions, degree)
    near(found, known, TOLERANCE[dtype])
    weights = torch.randn_like(known)
    gradients = [torch.autograd.grad((basis * weights).sum(), directions)[0] for basis in (found, known)]
    # along a direction they may differ: the basis is asked about unit vectors only
    across = [g - (g * directions).sum(-1, keepdim=True) * directions for g in gradients]
    near(across[0], across[1], 20 * TOLERANCE[dtype])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_what_an_inference_kept_serves_gradients(degree, device, monkeypatch):
    monkeypatch.setattr(harmonics, "_kept", {})
    harmonics._sampling.cache_clear()
    harmonics._coefficients.cache_clear()
    sh = torch.randn(5, (degree + 1) ** 2, 3, device=device)
    directions, turn = unit(5, 3, device=device, dtype=torch.float32), torch.eye(3, device=device).repeat(5, 1, 1)
    with torch.inference_mode():
        harmonics._basis_by_product(directions, degree)
        known = evaluate_sh(sh, directions), rotate_sh(sh, turn)
    for given in (sh, directions, turn):
        given.requires_grad_()
    basis = harmonics._basis_by_product(directions, degree)
    found = evaluate_sh(sh, directions), rotate_sh(sh, turn)
    for a, b in zip(found, known, strict=True):
        assert_close(a, b)
    (found[0].sum() + found[1].sum() + basis.sum()).backward()
    for given in (sh, directions, turn):
        assert torch.isfinite(given.grad).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_rotated_coefficients_equal_turned_directions(device, dtype, degree):
    directions, rotation = (
        unit(50, 3, device=device, dtype=dtype),
        quat_to_rotation(unit(6, 1, 4, device=device, dtype=dtype)),
    )
    sh = torch.randn(50, (degree + 1) ** 2, 3, device=device, dtype=dtype)
    turned = (rotation.mT @ directions[..., None]).squeeze(-1)
    actual = evaluate_sh(rotate_sh(sh, rotation), directions.expand(6, 50, 3))
    near(actual, evaluate_sh(sh.expand(6, *sh.shape), turned), TOLERANCE[dtype])


def test_gradients(device):
    sh = randn(2, 16, 3, device=device, requires_grad=True)
    rotation = quat_to_rotation(unit(2, 4, device=device)).requires_grad_()
    assert torch.autograd.gradcheck(rotate_sh, (sh, rotation), fast_mode=True)
    assert torch.autograd.gradcheck(evaluate_sh, (sh, unit(2, 3, device=device)), fast_mode=True)


def test_wrong_arguments():
    with value_error("Expected `sh` to have 1, 4, 9 or 16 coefficients, but got 5"):
        evaluate_sh(torch.zeros(2, 5, 3), torch.ones(2, 3))
