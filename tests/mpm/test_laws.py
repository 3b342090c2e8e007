import math
import re
from pathlib import Path

import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from shared import EYE, alike, double, near, peak, rand, randn, unit, value_error
from torch.testing import assert_close

from gaussian_swaying.geometry.linalg import spectrum
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.mpm.laws import LAWS as KINDS
from gaussian_swaying.mpm.laws.law import LOG_LIMIT, lame_parameters, log
from gaussian_swaying.mpm.laws.plastic import cone_slope

LAWS = ELASTIC | PLASTIC
EACH = pytest.mark.parametrize("name", LAWS)
STRESSES = pytest.mark.parametrize("name", [*ELASTIC, "snow", "fluid"])  # the others have that of Hencky's law
FLOWING = pytest.mark.parametrize("name", PLASTIC)
E, DT = 3000.0, 1e-3


def _lame(count, nu=0.3, dtype=torch.float64, device="cpu"):
    e, poisson = (torch.full((count,), x, dtype=dtype, device=device) for x in (E, nu))
    return lame_parameters(e, poisson)


MU, LAM = (x[0] for x in _lame(1))


def _gradients(count=50, spread=0.2):
    return EYE + spread * randn(count, 3, 3)


def _wide(count=60):
    F = torch.cat([_gradients(count, spread) for spread in (0.02, 0.25, 0.6)])
    a = torch.linalg.svdvals(F)
    F = F[(a[:, 1] > 1.1 * a[:, 2]) & (a[:, 2] > 0.01)]
    assert (torch.linalg.det(F) < 0).sum() > 5
    return F


def _rotations(*shape):
    return quat_to_rotation(randn(*shape, 4))


def _turned(stretches):
    Q = _rotations(2, len(stretches))
    return Q[0] @ double(stretches).diag_embed() @ Q[1]


def _internal(law, F, packed=False):
    return None if law.internal is None else torch.full_like(F[..., 0, 0], 0.95 if packed else law.internal)


def _parts(name, F):
    """Functions of F alone: energy, stress and Kirchhoff stress; snow is packed."""
    law, internal = LAWS[name], _internal(LAWS[name], F, name == "snow")
    mu, lam = (x.to(F).expand(F.shape[:-2]) for x in (MU, LAM))
    return [lambda F, f=f: f(F, mu, lam, internal) for f in (law.energy, law.pk1, law.kirchhoff)]


def _close(found, exact, tolerance):
    assert ((found - exact).norm(dim=(1, 2)) / exact.norm(dim=(1, 2))).max() < tolerance


# ---- the list


def test_every_law_is_tested_here():
    assert {type(law) for law in LAWS.values()} == set(KINDS.values())


def test_the_documented_laws_are_those_that_there_are():
    page = (Path(__file__).parents[2] / "docs" / "configuration.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith("| `material.law`"))
    elastic, flowing = (set(re.findall("`([A-Z][A-Za-z]+)`", part)) for part in row.split("plastic"))
    assert elastic == {name for name, law in KINDS.items() if not law.plastic}
    assert flowing == {name for name, law in KINDS.items() if law.plastic}


# ---- energy and stress


@EACH
def test_stress_is_the_derivative_of_the_energy(name):
    """Inverted elements included. Both sides are analytic: only round-off times the condition number remains."""
    F = _wide().requires_grad_()
    energy, pk1, kirchhoff = _parts(name, F)
    (expected,) = torch.autograd.grad(energy(F).sum(), F)
    F = F.detach()
    stress, tau = pk1(F), kirchhoff(F)
    _close(stress, expected, 1e-8)
    _close(tau, stress @ F.mT, 1e-12)
    _close(tau, tau.mT, 1e-10)
    assert energy(F).min() > 0
    assert peak(energy(EYE.expand_as(F))) < 1e-12 * E
    if name != "snow":
        mu, lam = _lame(len(F))
        near(LAWS[name].pk1(F, mu, lam), stress, 0)


@EACH
def test_objectivity_and_isotropy(name):
    F = _wide()
    Q, (energy, pk1, kirchhoff) = _rotations(len(F)), _parts(name, F)
    plain = energy(F)
    alike(energy(Q @ F), plain, 1e-9)
    alike(energy(F @ Q), plain, 1e-9)
    # the rotation of a nearly singular element is only known to eps over its least stretches
    _close(kirchhoff(Q @ F), Q @ kirchhoff(F) @ Q.mT, 1e-9)
    assert peak(pk1(Q)) < 1e-11 * E


@EACH
def test_small_strain_is_hookes_law(name):
    strain = 1e-6 * double([[[1.0, 0.5, 0.2], [0.5, -2.0, 0.3], [0.2, 0.3, 0.7]]])
    packed = math.exp(10 * 0.05) if name == "snow" else 1.0
    mu, lam = packed * MU, packed * LAM
    if name == "fluid":
        mu, lam = 0 * MU, LAM + 2 / 3 * MU
    hooke = 2 * mu * strain + lam * strain[0].trace() * EYE
    # the next order of the stress is about 10 E times the square of the strain
    near(_parts(name, strain)[1](EYE + strain), hooke, 1e-10 * E)


@STRESSES
def test_gradients_of_stress(name):
    F = _turned([[1.0, 1, 1], [0.7, 0.7, 0.7], [1.2, 1.2, 0.8], [1.3, 1.0, 0.6], [1.3, 1.0, -0.6]]).requires_grad_()
    mu, lam = ((x / E).requires_grad_() for x in _lame(len(F)))
    internal = _internal(LAWS[name], F, True)
    # rounding of stresses up to a few hundred, over the step of 1e-6
    assert torch.autograd.gradcheck(
        lambda F, mu, lam: LAWS[name].pk1(F, mu, lam, internal), (F, mu, lam), atol=1e-6, rtol=1e-6
    )


@EACH
def test_all_is_finite_everywhere(name, dtype, device):
    stretches = [[1, 1, 1], [0, 0, 0], [1, 1, 0], [1, 1, -1], [1, -1, -1], [3, 2, -5], [1e-3, 1e-3, -1e-3]]
    stretches += [[50, 1, 1e-4], [1.2, 1.1, -0.6], [1, 0.5, -0.5], [0.01, 0.01, 0.01], [3, 2, -60], [1, 0.3, -0.3]]
    F = torch.tensor(stretches, dtype=dtype, device=device).diag_embed().requires_grad_()
    mu, lam = _lame(len(F), dtype=dtype, device=device)
    new, internal = LAWS[name].return_map(F, mu, lam, _internal(LAWS[name], F), DT)
    flown = LAWS[name].kirchhoff(new, mu, lam, internal)
    near(flown[0], 0 * flown[0], 90 * torch.finfo(dtype).eps * E)
    changed = new.detach()[(new - F).detach().abs().amax((1, 2)) > 0.01]
    assert (len(changed) > 0) == LAWS[name].plastic  # what flows comes back with positive stretches
    assert (torch.linalg.svdvals(changed) > 0.049).all() & (torch.linalg.det(changed) > 0).all()
    energy, *stresses = (part(F) for part in _parts(name, F))
    for value in (energy, *stresses, new, flown, flown.square()):
        assert value.dtype == dtype
        assert torch.isfinite(value).all()
        if value is not energy or name != "snow":
            (gradient,) = torch.autograd.grad(value.mean(), F, retain_graph=True)
            assert torch.isfinite(gradient).all()


@STRESSES
def test_inverted_elements_are_pushed_back(name):
    F = torch.diag(double([1.1, 0.9, -0.4])) @ _rotations(20)
    energy, pk1, _ = _parts(name, F)
    stress = pk1(F)
    moved = F - 1e-4 / stress.norm(dim=(1, 2))[:, None, None] * stress
    assert (energy(moved) < energy(F)).all()
    assert (torch.linalg.det(moved) > torch.linalg.det(F)).all()


# ---- return maps


@FLOWING
def test_return_map_keeps_axes_and_rotation(name):
    """F = U diag(a) V^T becomes U diag(z) V^T, with the same result from either side."""
    law, F = LAWS[name], _gradients()
    mu, lam = _lame(50)
    new, internal = law.return_map(F, mu, lam, _internal(law, F), DT)
    trial, after = spectrum(F), spectrum(new)
    expected, _ = law.flow(trial.stretch, mu, lam, _internal(law, F), DT)
    near(trial.left.mT @ new @ trial.axes, expected.diag_embed(), 1e-13)
    assert peak(new - F) > 0.01
    near(after.rotation, trial.rotation, 1e-12)
    assert (internal is None) == (law.internal is None)
    Q = _rotations(50)
    turned, _ = law.return_map(Q @ F @ Q.mT, mu, lam, None, DT)
    near(turned, Q @ new @ Q.mT, 1e-11)


@FLOWING
def test_gradients_of_return_maps(name):
    """Plastic and elastic states, repeated stretches, at rest; away from kinks, which differences would cross."""
    law = LAWS[name]
    stretches = [[1.0, 0.8, 0.7], [1.3, 1.1, 1.05], [0.9, 0.9, 0.6], [0.97, 0.95, 0.93], [0.96, 0.6, 0.6], [1.0] * 3]
    F = _turned(stretches[:-1] if "sand" in name else stretches)  # rest is the tip of the cone
    internal = _internal(law, F)
    if internal is not None:
        internal = (internal + 0.01).requires_grad_()
    mu, lam = (x.requires_grad_() for x in _lame(len(F)))

    def run(F, internal, mu, lam):
        new, after = law.return_map(F, mu, lam, internal, DT)
        return new if after is None else (new, after)

    assert torch.autograd.gradcheck(run, (F.requires_grad_(), internal, mu, lam), eps=1e-6, atol=1e-7)


# ---- where return maps end, and what they conserve

YIELD, ETA = 100.0, 20.0
ROOT = math.sqrt(2 / 3)
# round-off of a few logarithms and exponentials of numbers near one, in float64
TOL = 1e-13


def _stretches(count=200, spread=0.2):
    return (spread * randn(count, 3)).exp()


def _map(name, stretch, internal=None):
    one = torch.ones_like(stretch[..., 0])
    law = PLASTIC[name]
    if internal is None and law.internal is not None:
        internal = law.internal * one
    return law.flow(stretch, MU.to(stretch) * one, LAM.to(stretch) * one, internal, DT)


def _deviatoric(stretch):
    """Norm of the deviatoric Kirchhoff stress, and the trace of the logarithmic strain."""
    log = stretch.log()
    return 2 * MU * (log - log.mean(-1, keepdim=True)).norm(dim=-1), log.sum(-1)


@pytest.mark.parametrize("name", ["sand", "metal", "plasticine", "foam", "snow"])
def test_states_inside_are_unchanged(name):
    """To the bit: a round trip through the logarithm in every substep would drift."""
    trial = 0.99 + 1e-3 * rand(50, 3)
    trial[0] = 0.99
    new, internal = _map(name, trial)
    assert (new == trial).all()
    assert internal is None or bool((internal == PLASTIC[name].internal).all())


def test_flow_of_solids_keeps_the_volume():
    trial = _stretches()
    for name in ("metal", "plasticine", "foam"):
        alike(_map(name, trial)[0].prod(-1), trial.prod(-1), 1e-13)
    sheared = trial * (0.8 / trial.prod(-1, keepdim=True)) ** (1 / 3)
    alike(_map("sand", sheared)[0].prod(-1), sheared.prod(-1), 1e-13)


def test_sand_ends_on_the_cone_or_at_its_tip():
    trial = _stretches()
    new, _ = _map("sand", trial)
    deviator, trace = _deviatoric(new)
    pressure = -(LAM + 2 / 3 * MU) * trace
    # |dev tau| = alpha 3 p
    limit = 3 * cone_slope(30.0) * pressure
    assert (deviator - limit).max() < 1e-12 * E
    flowed = (new != trial).any(-1) & (trial.log().sum(-1) < 0)
    assert 10 < int(flowed.sum()) < 190
    near(deviator[flowed], limit[flowed], 1e-12 * E)
    assert (new[trial.log().sum(-1) > 0] == 1).all()


def test_volume_correction_conserves_the_sum():
    trial, before = _stretches(), 0.1 * rand(200)
    new, after = _map("sand that swells", trial, before)
    near(new.log().sum(-1) + after, trial.log().sum(-1) + before, TOL)
    assert after.min() > -TOL
    assert after[(new != 1).any(-1)].max() < TOL


@pytest.mark.parametrize("hardening", [0.0, 500.0, -500.0, -4e3])
def test_metal_ends_on_its_new_yield_surface(hardening):
    """The last softens faster than it unloads (H < -3 mu), which leaves the residual stress at once."""
    residual = 20.0
    trial, before = _stretches(), 0.05 * rand(200)
    law = KINDS["Plasticine"](YIELD, -hardening, residual) if hardening < 0 else KINDS["Metal"](YIELD, hardening)
    residual = residual if hardening < 0 else 0.0
    new, after = law.flow(trial, MU.expand(200), LAM.expand(200), before, DT)
    deviator, _ = _deviatoric(new)
    radius = ROOT * (YIELD + hardening * after).clamp(min=residual)
    assert (deviator - radius).max() < 1e-11 * E
    flowed = after > before
    assert 10 < int(flowed.sum()) < 201
    near(deviator[flowed], radius[flowed], 1e-11 * E)
    # alpha grows by sqrt(2/3) of the plastic strain
    plastic = (_deviatoric(trial)[0] - deviator) / (2 * MU)
    near(after - before, ROOT * plastic, 1e-12)
    if hardening == -500:
        at_floor = flowed & (YIELD + hardening * after < residual)
        assert 0 < int(at_floor.sum()) < int(flowed.sum()), "both branches should be met"


def test_foam_relaxes_exactly():
    """Two half substeps equal one, and the overstress falls by exp(-2 mu dt / eta)."""
    trial = _stretches()

    def flow(stretch, viscosity=ETA, dt=DT):
        return KINDS["Foam"](YIELD, viscosity).flow(stretch, MU.expand(200), LAM.expand(200), None, dt)[0]

    one = flow(trial)
    near(flow(flow(trial, dt=DT / 2), dt=DT / 2), one, TOL)
    over = (_deviatoric(trial)[0] - ROOT * YIELD).clamp(min=0)
    left = (_deviatoric(one)[0] - ROOT * YIELD).clamp(min=0)
    near(left, over * torch.exp(-2 * MU * DT / ETA), 1e-11 * E)
    near(flow(trial, 1e12), trial, 1e-10)
    near(flow(trial, 1e-6), flow(trial, 0.0), TOL)


def test_snow_moves_volume_to_its_plastic_part():
    trial = double([[1.0, 1.0, 0.9], [1.1, 1.0, 1.0], [0.99, 1.0, 1.005]])
    new, volume = _map("snow", trial)
    expected = double([[1.0, 1.0, 0.975], [1.0075, 1.0, 1.0], [0.99, 1.0, 1.005]])
    assert_close(new, expected)
    assert_close(volume, double([0.9 / 0.975, 1.1 / 1.0075, 1.0]))
    alike(volume * new.prod(-1), trial.prod(-1), 1e-14)


def test_fluid_keeps_only_the_volume():
    trial = _stretches()
    new, _ = _map("fluid", trial)
    alike(new.prod(-1), trial.prod(-1), 1e-13)
    assert (new == new[:, :1]).all()
    crushed, _ = _map("fluid", double([1.0, 0.5, -0.5]))
    assert_close(crushed.prod(), double(0.05))


# ---- bounds on the stiffness


def _hessian(law, F, mu, lam):
    """d P / d F, (N, 9, 9), from first derivatives of the stress."""
    F = F.clone().requires_grad_()
    stress = law.pk1(F, mu, lam, None)
    rows = [torch.autograd.grad(stress[:, i, j].sum(), F, retain_graph=True)[0] for i in range(3) for j in range(3)]
    return torch.stack(rows, 1).reshape(-1, 9, 9)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("name", ["corotated", "neo-hookean", "hencky", "fluid"])
def test_moduli_bound_the_hessian(name, nu):
    law, mild = LAWS[name], 150
    F = torch.cat([_gradients(mild, 0.05), _gradients(150, 0.3), _gradients(100, 0.8)])
    F = torch.cat([F, torch.linspace(0.2, 3, 20, dtype=torch.float64)[:, None, None] * EYE])
    a = torch.linalg.svdvals(F)
    F = F[a[:, 2] > 0.02 * a[:, 0]]
    assert (torch.linalg.det(F) < 0).sum() > 5
    mu, lam = _lame(len(F), nu)
    hessian = _hessian(law, F, mu, lam)
    size = hessian.abs().amax((1, 2))
    # round-off of the stress gradients, over the differences of nearly repeated stretches
    assert ((hessian - hessian.mT).abs().amax((1, 2)) / size).max() < 1e-8
    wave, bound = law.moduli(F, mu, lam)
    exact = torch.linalg.eigvalsh(hessian)[:, -1]
    assert (exact / bound).max() < 1 + 1e-6
    direction = unit(300, 3)
    acoustic = torch.einsum("pijkl,nj,nl->pnik", hessian.reshape(-1, 3, 3, 3, 3), direction, direction)
    speed = torch.linalg.eigvalsh(acoustic)[..., -1].amax(-1)
    assert (speed / wave).max() < 1 + 1e-6
    assert (wave / bound).max() < 1 + 1e-9
    # fluids and tension fall below their stiffness at rest, at which the bounds stop
    assert (exact / bound)[:mild].median() > 0.7
    assert (speed / wave)[:mild].median() > 0.7


@pytest.mark.parametrize("nu", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("name", ["springs", "hencky"])
def test_moduli_of_stretches_are_those_of_the_hessian(name, nu):
    """Both bounds are exact, down to their values at rest.

    In principal axes H has the entries ii,jj and, for each pair, a block of ij,ij and ij,ji, whose sum and difference
    are its eigenvalues. On m (x) N the entries ii,jj may be moved to the blocks: see ``laws/law.py``.
    """
    law, (i, j) = LAWS[name], ((0, 0, 1), (1, 2, 2))
    F = (4.8 * rand(300, 3) - 2.8).exp().diag_embed()  # logarithms are continued below 0.05
    mu, lam = _lame(len(F), nu)
    hessian = _hessian(law, F, mu, lam)
    entry = hessian.reshape(-1, 3, 3, 3, 3)
    same, swapped, mixed = entry[:, i, j, i, j], entry[:, i, j, j, i], entry[:, i, i, j, j]
    own = entry[:, range(3), range(3), range(3), range(3)]
    fastest = torch.cat([own, same - swapped - mixed, same + swapped + mixed], -1).amax(-1).maximum(2 * mu + lam)
    wave, bound = law.moduli(F, mu, lam)
    largest = torch.linalg.eigvalsh(hessian)[:, -1].maximum(2 * mu + 3 * lam)
    assert (fastest > 1.1 * (2 * mu + lam)).sum() > 30
    # stretches that are alike by chance: rounding over their difference, or a divided difference
    alike(wave, fastest, 1e-7)
    alike(bound, largest, 1e-7)


@EACH
def test_moduli_at_rest(name, dtype):
    mu, lam = _lame(2, dtype=dtype)
    wave, bound = LAWS[name].moduli(torch.eye(3, dtype=dtype).expand(2, 3, 3), mu, lam)
    expected = lam + 2 * mu if name != "fluid" else lam + 2 / 3 * mu
    # eigenvalues in closed form, and a divided difference: rounding over the cube root of eps
    tol = 1e-4 if dtype == torch.float32 else 1e-8
    alike(wave, expected, tol)
    alike(bound, 3 * lam + 2 * mu, tol)


def test_moduli_of_uniform_expansion_are_exact_for_fixed_corotated():
    """F = s I along I and e (x) e: mu |F - R|^2 gives 2 mu, lambda / 2 (J - 1)^2 gives 5 s^4 - 2 s and s^4."""
    for s in (1.05, 1.5, 3.0):
        wave, bound = ELASTIC["corotated"].moduli(s * EYE, MU, LAM)
        assert_close(wave, 2 * MU + LAM * s**4)
        assert_close(bound, 2 * MU + LAM * (5 * s**4 - 2 * s))


# ---- closed forms


def test_a_reflection_costs_energy_without_the_volume_term():
    """The stress drives its flipped axis towards J > 0."""
    F = torch.diag(double([1.2, 1.1, -0.6]))
    mu, lam = double(1.0), double(0.0)
    law = ELASTIC["corotated"]
    near(law.pk1(F, mu, lam), 2 * (F - EYE), 1e-9)
    assert float(law.energy(F, mu, lam)) == pytest.approx(0.2**2 + 0.1**2 + 1.6**2)


def test_continued_log():
    x = double([2.0, LOG_LIMIT, 0.0, -1.0])
    edge = math.log(LOG_LIMIT)
    expected = double([math.log(2), edge, edge - 1, edge - 1 - 1 / LOG_LIMIT])
    assert_close(on_tensors(log)(x), expected)


def test_uniaxial_closed_forms():
    s = 1.3
    F = torch.diag(double([s, 1.0, 1.0]))
    mu, lam, log = float(MU), float(LAM), math.log(s)
    law = ELASTIC["neo-hookean"]
    expected = 0.5 * mu * (s * s - 1) - mu * log + 0.5 * lam * log**2
    assert float(law.energy(F, MU, LAM)) == pytest.approx(expected, rel=1e-12)
    stress = law.pk1(F, MU, LAM)
    assert float(stress[0, 0]) == pytest.approx(mu * (s - 1 / s) + lam * log / s, rel=1e-12)
    assert float(stress[1, 1]) == pytest.approx(lam * log, rel=1e-12)
    assert float(ELASTIC["hencky"].energy(F, MU, LAM)) == pytest.approx((mu + 0.5 * lam) * log**2, rel=1e-12)


def test_a_network_is_a_mean_over_springs():
    """For Cauchy's solid, which has no other terms, against the mean over many directions; and a lattice's tension."""
    direction = unit(400_000, 3)
    F = torch.diag(double([1.25, 0.9, 1.05]))
    mean = ((direction @ F.mT).norm(dim=-1) - 1).square().mean()
    energy = ELASTIC["springs"].energy(F, MU, MU)
    # of the rule of degree 7: the next terms are of the sixth power of strains of 0.2; of the mean: 1 / sqrt(count)
    assert float(energy) == pytest.approx(float(7.5 * MU * mean), rel=5e-3)
    # a square lattice with diagonals at 18 % of stretch, free to contract: 1.059 times linear
    F = torch.diag(double([1.18, 0.9455, 0.9455]))
    stress = ELASTIC["springs"].pk1(F, MU, LAM)
    assert abs(float(stress[1, 1])) < 1e-3 * E
    assert 1.05 < float(stress[0, 0]) / (0.18 * E) < 1.12
    assert float(ELASTIC["corotated"].pk1(F, MU, LAM)[0, 0]) < 0.95 * 0.18 * E


def test_fluid_pressure():
    """Tait: K / 7 (J^-7 - 1); one per cent of compression costs about K / 100, tension at most K / 7."""
    bulk = float(LAM + 2 / 3 * MU)
    det = double([0.99, 1.0, 0.6, 100.0, 0.5 - 1e-9, 0.5 + 1e-9])

    def pressure(det, gamma=7.0):
        F = det.pow(1 / 3)[:, None, None] * EYE
        stress = KINDS["Fluid"](gamma).pk1(F, MU.expand(len(det)), LAM.expand(len(det)))
        return -stress[:, 0, 0] / F[:, 0, 0].square()

    expected = [bulk / 7 * (j**-7 - 1) for j in det.tolist()]
    found = pressure(det).tolist()
    assert found[:4] == pytest.approx(expected[:4], rel=1e-12, abs=1e-12 * bulk)
    assert found[0] == pytest.approx(0.0104 * bulk, rel=0.01)
    assert found[4] == pytest.approx(found[5], rel=1e-6)  # where it is continued
    F, law = 0.9 * EYE, PLASTIC["fluid"]
    sheared = F @ double([[1.0, 0.7, 0], [0, 1, -0.2], [0, 0, 1]])
    assert_close(law.energy(sheared, MU, LAM), law.energy(F, MU, LAM))
    assert float(pressure(det[2:3], 3.0)) == pytest.approx(bulk / 3 * (0.6**-3 - 1), rel=1e-12)


def test_snow_hardens_when_packed():
    volume, F = double([1.0, 0.9, 1.1, 0.1, -1.0]), 1.02 * EYE.expand(5, 3, 3)
    stress = PLASTIC["snow"].pk1(F, MU.expand(5), LAM.expand(5), volume)[:, 0, 0]
    factor = [1.0, math.e, 1 / math.e, math.exp(4), math.exp(4)]
    assert (stress / stress[0]).tolist() == pytest.approx(factor, rel=1e-12)
    bounds = PLASTIC["snow"].moduli(EYE.expand(2, 3, 3), *_lame(2), volume[:2])
    assert [float(bound[1] / bound[0]) for bound in bounds] == pytest.approx([math.e] * 2)


def test_arguments_are_checked():
    for name, given, field in [
        ("Sand", (90.0,), "friction_angle"),
        ("Sand", (math.nan,), "friction_angle"),
        ("Metal", (0.0,), "yield_stress"),
        ("Metal", (1.0, -1.0), "Plasticine"),
        ("Metal", (1.0, math.nan), "hardening"),
        ("Foam", (-1.0, 1.0), "yield_stress"),
        ("Foam", (1.0, math.inf), "viscosity"),
        ("Plasticine", (1.0, -1.0), "softening"),
        ("Plasticine", (1.0, 1.0, 2.0), "residual"),
        ("Snow", (1.0,), "critical_compression"),
        ("Snow", (0.1, -0.1), "critical_stretch"),
        ("Snow", (0.1, 0.1, -1.0), "hardening"),
        ("Fluid", (1.0,), "gamma"),
    ]:
        with value_error(field):
            KINDS[name](*given)
