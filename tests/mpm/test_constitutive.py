"""Elastic laws against their energy, symmetry and small-strain limit, and the closed forms of single laws."""

import math

import pytest
import torch

from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated, fixed_corotated_energy, fixed_corotated_pk1
from gaussian_swaying.mpm.laws.fluid import Fluid, fluid_energy, fluid_pk1, fluid_pressure
from gaussian_swaying.mpm.laws.hencky import StVKHencky, stvk_hencky_energy
from gaussian_swaying.mpm.laws.neo_hookean import NeoHookean, neo_hookean_energy, neo_hookean_pk1
from gaussian_swaying.mpm.laws.shared import FLUID_LIMIT, LOG_LIMIT, continued_log, lame_parameters
from gaussian_swaying.mpm.laws.snow import Snow, snow_lame
from gaussian_swaying.mpm.laws.spring_network import SpringNetwork, spring_network_energy, spring_network_pk1

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
    tau = FixedCorotated().kirchhoff(F, MU, LAM)
    torch.testing.assert_close(tau, fixed_corotated_pk1(F, MU, LAM) @ F.mT)
    # round-off times the condition number
    torch.testing.assert_close(tau, tau.mT, rtol=0, atol=1e-12 * float(E))


def test_rotation_costs_nothing_and_turns_the_stress():
    F = _gradients(spread=0.2)
    Q = torch.linalg.qr(torch.randn(50, 3, 3, dtype=torch.float64))[0]
    Q = Q * torch.linalg.det(Q)[:, None, None]
    assert float(fixed_corotated_pk1(Q, MU, LAM).abs().max()) < 1e-8 * float(E)
    turned, plain = (FixedCorotated().kirchhoff(G, MU, LAM) for G in (Q @ F, F))
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
    """Also without the volume term: a reflection costs energy, and the stress drives its flipped axis towards J > 0."""
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


SNOW_VOLUME = torch.tensor(0.95, dtype=torch.float64)
LAWS = {
    name: (law.energy, law.pk1, law.kirchhoff)
    for name, law in {
        "fixed_corotated": FixedCorotated(),
        "neo_hookean": NeoHookean(),
        "spring_network": SpringNetwork(),
        "stvk_hencky": StVKHencky(),
        "fluid": Fluid(),
        "snow": Snow(hardening=10.0),
    }.items()
}


def _call(function, F, name, mu=MU, lam=LAM):
    return function(F, mu, lam, SNOW_VOLUME.to(F)) if name == "snow" else function(F, mu, lam)


def _wide(count=60):
    """Mild, strong and inverted deformation, away from the jump where two stretches are opposite."""
    F = torch.cat([_gradients(count, spread) for spread in (0.02, 0.25, 0.6)])
    a = torch.linalg.svdvals(F)
    F = F[(a[:, 1] > 1.1 * a[:, 2]) & (a[:, 2] > 0.01)]
    assert int((torch.linalg.det(F) < 0).sum()) > 5
    return F


def _rotations(count):
    Q = torch.linalg.qr(torch.randn(count, 3, 3, dtype=torch.float64))[0]
    return Q * torch.linalg.det(Q)[:, None, None]


@pytest.mark.parametrize("name", list(LAWS))
def test_every_stress_is_the_derivative_of_its_energy(name):
    """Inverted elements included. Both sides are analytic: only round-off times the condition number remains."""
    energy, pk1, _ = LAWS[name]
    F = _wide().requires_grad_()
    (expected,) = torch.autograd.grad(_call(energy, F, name).sum(), F)
    F = F.detach()
    stress = _call(pk1, F, name)
    assert float(((stress - expected).norm(dim=(1, 2)) / expected.norm(dim=(1, 2))).max()) < 1e-8
    assert float(_call(energy, torch.eye(3, dtype=torch.float64), name)) == pytest.approx(0, abs=1e-12 * float(E))
    assert float(_call(energy, F, name).min()) > 0


@pytest.mark.parametrize("name", list(LAWS))
def test_kirchhoff_stress_of_every_law(name):
    _, pk1, kirchhoff = LAWS[name]
    F = _wide()
    tau = _call(kirchhoff, F, name)
    scale = tau.norm(dim=(1, 2))[:, None, None]
    assert float(((tau - tau.mT) / scale).abs().max()) < 1e-10
    assert float(((tau - _call(pk1, F, name) @ F.mT) / scale).abs().max()) < 1e-12


@pytest.mark.parametrize("name", list(LAWS))
def test_objectivity_and_isotropy(name):
    energy, pk1, kirchhoff = LAWS[name]
    F = _wide()
    Q = _rotations(len(F))
    plain = _call(energy, F, name)
    torch.testing.assert_close(_call(energy, Q @ F, name), plain, rtol=1e-9, atol=0)
    torch.testing.assert_close(_call(energy, F @ Q, name), plain, rtol=1e-9, atol=0)
    tau = _call(kirchhoff, F, name)
    scale = tau.norm(dim=(1, 2))[:, None, None]
    # the rotation of a nearly singular element is only known to eps over its least stretches
    assert float(((_call(kirchhoff, Q @ F, name) - Q @ tau @ Q.mT) / scale).abs().max()) < 1e-9
    assert float(_call(pk1, Q, name).abs().max()) < 1e-11 * float(E)


@pytest.mark.parametrize("name", list(LAWS))
def test_every_law_is_hooke_for_small_strain(name):
    strain = 1e-6 * torch.tensor([[1.0, 0.5, 0.2], [0.5, -2.0, 0.3], [0.2, 0.3, 0.7]], dtype=torch.float64)
    eye = torch.eye(3, dtype=torch.float64)
    mu, lam = snow_lame(MU, LAM, SNOW_VOLUME, 10.0) if name == "snow" else (MU, LAM)
    if name == "fluid":
        mu, lam = 0 * MU, LAM + 2 / 3 * MU
    hooke = 2 * mu * strain + lam * strain.trace() * eye
    # the next order of the stress is about 10 E times the square of the strain
    torch.testing.assert_close(_call(LAWS[name][1], eye + strain, name), hooke, rtol=0, atol=1e-10 * float(E))


@pytest.mark.parametrize("name", list(LAWS))
def test_stress_gradients(name):
    """Against differences: at rest, at repeated stretches, rotated, and inverted."""
    stretches = [[1.0, 1, 1], [0.7, 0.7, 0.7], [1.2, 1.2, 0.8], [1.3, 1.0, 0.6], [1.3, 1.0, -0.6]]
    Q = _rotations(2 * len(stretches)).reshape(2, -1, 3, 3)
    F = Q[0] @ torch.tensor(stretches, dtype=torch.float64).diag_embed() @ Q[1]
    mu, lam = (x.expand(len(F)).clone().requires_grad_() for x in (MU / E, LAM / E))
    # rounding of stresses up to a few hundred, over the step of 1e-6
    assert torch.autograd.gradcheck(
        lambda x, mu, lam: _call(LAWS[name][1], x, name, mu, lam), (F.requires_grad_(), mu, lam), atol=1e-6, rtol=1e-6
    )


@pytest.mark.parametrize("name", list(LAWS))
def test_finite_everywhere(name, dtype, device):
    """Crushed, inverted and singular elements, with their gradients, in both precisions."""
    stretches = [
        [1, 1, 1],
        [0, 0, 0],
        [1, 1, 0],
        [1, 1, -1],
        [1, -1, -1],
        [3, 2, -5],
        [1e-3, 1e-3, -1e-3],
        [50, 1, 1e-4],
    ]
    F = torch.tensor(stretches, dtype=dtype, device=device).diag_embed().requires_grad_()
    mu, lam = MU.to(F), LAM.to(F)
    for function in LAWS[name]:
        value = _call(function, F, name, mu, lam)
        assert value.dtype == dtype
        assert bool(torch.isfinite(value).all())
        if function is not LAWS[name][0] or name != "snow":
            (gradient,) = torch.autograd.grad(value.sum(), F)
            assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("name", list(LAWS))
def test_every_law_pushes_inverted_elements_back(name):
    """A small step along -P lowers the energy and raises the determinant."""
    energy, pk1, _ = LAWS[name]
    F = torch.diag(torch.tensor([1.1, 0.9, -0.4], dtype=torch.float64))
    F = F @ _rotations(20)
    stress = _call(pk1, F, name)
    step = 1e-4 / stress.norm(dim=(1, 2))[:, None, None]
    moved = F - step * stress
    assert bool((_call(energy, moved, name) < _call(energy, F, name)).all())
    assert bool((torch.linalg.det(moved) > torch.linalg.det(F)).all())


@pytest.mark.parametrize("shape", [(), (4,), (2, 3), (0,)])
@pytest.mark.parametrize("name", list(LAWS))
def test_batch_shapes(name, shape):
    F = torch.eye(3) + 0.1 * torch.rand(*shape, 3, 3)
    mu, lam = (x.float().expand(shape) for x in (MU, LAM))
    energy, pk1, kirchhoff = (_call(f, F, name, mu, lam) for f in LAWS[name])
    assert energy.shape == shape
    assert pk1.shape == kirchhoff.shape == F.shape


def test_continued_log():
    x = torch.tensor([2.0, LOG_LIMIT, 0.0, -1.0], dtype=torch.float64)
    edge = math.log(LOG_LIMIT)
    expected = torch.tensor([math.log(2), edge, edge - 1, edge - 1 - 1 / LOG_LIMIT], dtype=torch.float64)
    torch.testing.assert_close(continued_log(x), expected)


def test_uniaxial_closed_forms():
    """Stretch along one axis, the others held: each law from its definition."""
    s = 1.3
    F = torch.diag(torch.tensor([s, 1.0, 1.0], dtype=torch.float64))
    mu, lam, log = float(MU), float(LAM), math.log(s)
    expected = 0.5 * mu * (s * s - 1) - mu * log + 0.5 * lam * log**2
    assert float(neo_hookean_energy(F, MU, LAM)) == pytest.approx(expected, rel=1e-12)
    stress = neo_hookean_pk1(F, MU, LAM)
    assert float(stress[0, 0]) == pytest.approx(mu * (s - 1 / s) + lam * log / s, rel=1e-12)
    assert float(stress[1, 1]) == pytest.approx(lam * log, rel=1e-12)
    assert float(stvk_hencky_energy(F, MU, LAM)) == pytest.approx((mu + 0.5 * lam) * log**2, rel=1e-12)


def test_a_network_is_a_mean_over_springs():
    """For Cauchy's solid, which has no other terms, against the mean over many directions; and a lattice's tension."""
    direction = torch.nn.functional.normalize(torch.randn(400_000, 3, dtype=torch.float64), dim=-1)
    F = torch.diag(torch.tensor([1.25, 0.9, 1.05], dtype=torch.float64))
    mean = ((direction @ F.mT).norm(dim=-1) - 1).square().mean()
    energy = spring_network_energy(F, MU, MU)
    # of the rule of degree 7: the next terms are of the sixth power of strains of 0.2; of the mean: 1 / sqrt(count)
    assert float(energy) == pytest.approx(float(7.5 * MU * mean), rel=5e-3)
    # a square lattice with diagonals at 18 % of stretch, free to contract: 1.059 times linear
    F = torch.diag(torch.tensor([1.18, 0.9455, 0.9455], dtype=torch.float64))
    stress = spring_network_pk1(F, MU, LAM)
    assert abs(float(stress[1, 1])) < 1e-3 * float(E)
    assert 1.05 < float(stress[0, 0]) / (0.18 * float(E)) < 1.12
    assert float(fixed_corotated_pk1(F, MU, LAM)[0, 0]) < 0.95 * 0.18 * float(E)


def test_fluid_pressure():
    """Tait: K / 7 (J^-7 - 1); one per cent of compression costs about K / 100, tension at most K / 7."""
    bulk = float(LAM + 2 / 3 * MU)
    det = torch.tensor([0.99, 1.0, 0.6, 100.0], dtype=torch.float64)
    expected = [bulk / 7 * (j**-7 - 1) for j in det.tolist()]
    assert fluid_pressure(det, MU, LAM).tolist() == pytest.approx(expected, rel=1e-12)
    assert float(fluid_pressure(det[0], MU, LAM)) == pytest.approx(0.0104 * bulk, rel=0.01)
    edge = torch.tensor([FLUID_LIMIT - 1e-9, FLUID_LIMIT + 1e-9], dtype=torch.float64)
    low, high = fluid_pressure(edge, MU, LAM).tolist()
    assert low == pytest.approx(high, rel=1e-6)
    F = 0.9 * torch.eye(3, dtype=torch.float64)
    sheared = F @ torch.tensor([[1.0, 0.7, 0], [0, 1, -0.2], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(fluid_energy(sheared, MU, LAM), fluid_energy(F, MU, LAM))
    torch.testing.assert_close(
        fluid_pk1(F, MU, LAM, 3.0)[0, 0], -0.81 * fluid_pressure(torch.linalg.det(F), MU, LAM, 3)
    )


def test_snow_hardens_when_packed():
    volume = torch.tensor([1.0, 0.9, 1.1, 0.1, -1.0], dtype=torch.float64)
    mu, lam = snow_lame(MU, LAM, volume, 10.0)
    factor = [1.0, math.e, 1 / math.e, math.exp(4), math.exp(4)]
    assert (mu / MU).tolist() == pytest.approx(factor, rel=1e-12)
    assert (lam / LAM).tolist() == pytest.approx(factor, rel=1e-12)
