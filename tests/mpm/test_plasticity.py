"""Return maps: where they end, what they conserve, and their gradients."""

import math

import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from torch.testing import assert_close

from gaussian_swaying.geometry.linalg import from_principal, spectrum
from gaussian_swaying.mpm.laws.fluid import fluid_flow
from gaussian_swaying.mpm.laws.foam import viscoplastic
from gaussian_swaying.mpm.laws.sand import cone_slope, drucker_prager
from gaussian_swaying.mpm.laws.shared import lame_parameters, von_mises
from gaussian_swaying.mpm.laws.snow import snow_plasticity

E, NU = torch.tensor(3000.0, dtype=torch.float64), torch.tensor(0.3, dtype=torch.float64)
MU, LAM = lame_parameters(E, NU)
YIELD, ETA, DT = 100.0, 20.0, 1e-3
ROOT = math.sqrt(2 / 3)
ZERO = torch.zeros((), dtype=torch.float64)
# round-off of a few logarithms and exponentials of numbers near one, in float64
TOL = 1e-13


def _stretches(count=200, spread=0.2):
    return (spread * torch.randn(count, 3, dtype=torch.float64)).exp()


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


@pytest.mark.parametrize("name", [n for n in PLASTIC if n != "foam"])
def test_return_maps_are_idempotent(name):
    trial = _stretches()
    once, internal = _map(name, trial)
    assert float((once - trial).abs().max()) > 0.01, "something should flow"
    twice, again = _map(name, once, internal)
    assert_close(twice, once, rtol=0, atol=TOL)
    if again is not None:
        assert_close(again, internal, rtol=0, atol=20 * TOL)


@pytest.mark.parametrize("name", ["sand", "metal", "plasticine", "foam", "snow"])
def test_states_inside_are_unchanged(name):
    """To the bit: a round trip through the logarithm in every substep would drift."""
    trial = 0.99 + 1e-3 * torch.rand(50, 3, dtype=torch.float64)
    new, internal = _map(name, trial)
    assert bool((new == trial).all())
    assert internal is None or bool((internal == PLASTIC[name].internal).all())


def test_flow_of_solids_keeps_the_volume():
    trial = _stretches()
    for name in ("metal", "plasticine", "foam"):
        assert_close(_map(name, trial)[0].prod(-1), trial.prod(-1), rtol=1e-13, atol=0)
    sheared = trial * (0.8 / trial.prod(-1, keepdim=True)) ** (1 / 3)
    assert_close(_map("sand", sheared)[0].prod(-1), sheared.prod(-1), rtol=1e-13, atol=0)


def test_sand_ends_on_the_cone_or_at_its_tip():
    trial = _stretches()
    new, _ = _map("sand", trial)
    deviator, trace = _deviatoric(new)
    pressure = -(LAM + 2 / 3 * MU) * trace
    # |dev tau| = alpha 3 p
    limit = 3 * cone_slope(30.0) * pressure
    assert float((deviator - limit).max()) < 1e-12 * float(E)
    flowed = (new != trial).any(-1) & (trial.log().sum(-1) < 0)
    assert 10 < int(flowed.sum()) < 190
    assert_close(deviator[flowed], limit[flowed], rtol=0, atol=1e-12 * float(E))
    assert bool((new[trial.log().sum(-1) > 0] == 1).all())


def test_sand_bears_pressure_but_no_tension():
    pulled, pressed = torch.full((3,), 1.1, dtype=torch.float64), torch.full((3,), 0.7, dtype=torch.float64)
    assert bool((drucker_prager(pulled, MU, LAM, None, 30.0)[0] == 1).all())
    assert bool((drucker_prager(pressed, MU, LAM, None, 30.0)[0] == pressed).all())


def test_cone_slope():
    """Triaxial compression mobilises the friction angle itself: sin phi = (s1 - s3) / (s1 + s3)."""
    assert cone_slope(30.0) == pytest.approx(0.32660, abs=1e-5)
    trial = torch.tensor([1.1, 1.1, 0.7], dtype=torch.float64)
    new, _ = drucker_prager(trial, MU, LAM, None, 30.0)
    log = new.log()
    tau = 2 * MU * log + LAM * log.sum()
    assert float((tau[2] - tau[0]) / (tau[2] + tau[0])) == pytest.approx(0.5, abs=1e-12)


def test_simple_shear_of_sand_mobilises_its_friction():
    """Steady shear at constant volume: tan 34.6 degrees, M / sqrt(3) less the elastic strain, for an angle of 30."""
    F = 0.999 * torch.eye(3, dtype=torch.float64)
    step = torch.eye(3, dtype=torch.float64)
    step[0, 1] = 5e-4
    for _ in range(150):
        parts = spectrum(step @ F)
        F = from_principal(parts, lambda a: drucker_prager(a, MU, LAM, None, 30.0)[0], rotated=True)
    tau = ELASTIC["hencky"].kirchhoff(F, MU, LAM)
    ratio = float(-tau[0, 1] / tau[1, 1])
    slope = 6 * 0.5 / (3 - 0.5) / math.sqrt(3)
    assert ratio == pytest.approx(0.6906, abs=5e-4)
    assert 0.98 * slope < ratio <= slope
    assert float(torch.linalg.det(F)) == pytest.approx(0.999**3, rel=1e-9)


def test_volume_correction_returns_what_tension_gained():
    """Pulled by 3 % in volume, then pressed by 5 %: only 2 % load the sand; without correction all 5 % do."""
    pulled = torch.full((3,), math.exp(0.01), dtype=torch.float64)
    new, gained = drucker_prager(pulled, MU, LAM, ZERO, 30.0)
    assert bool((new == 1).all())
    assert float(gained) == pytest.approx(0.03, abs=1e-14)
    slack, left = drucker_prager(torch.full((3,), math.exp(-0.005), dtype=torch.float64), MU, LAM, gained, 30.0)
    assert bool((slack == 1).all()), "still loose"
    assert float(left) == pytest.approx(0.015, abs=1e-14)
    loaded, rest = drucker_prager(slack * math.exp(-0.035 / 3), MU, LAM, left, 30.0)
    assert float(loaded.log().sum()) == pytest.approx(-0.02, abs=1e-14)
    assert float(rest) == pytest.approx(0.0, abs=1e-14)


def test_volume_correction_conserves_the_sum():
    """log det F + v_c changes only by the deformation."""
    trial, before = _stretches(), 0.1 * torch.rand(200, dtype=torch.float64)
    new, after = drucker_prager(trial, MU.expand(200), LAM.expand(200), before, 30.0)
    assert_close(new.log().sum(-1) + after, trial.log().sum(-1) + before, rtol=0, atol=TOL)
    assert float(after.min()) > -TOL


@pytest.mark.parametrize("hardening", [0.0, 500.0, -500.0, -4e3])
def test_metal_ends_on_its_new_yield_surface(hardening):
    """The last softens faster than it unloads (H < -3 mu), which leaves the residual stress at once."""
    residual = 20.0
    trial, before = _stretches(), 0.05 * torch.rand(200, dtype=torch.float64)
    new, after = von_mises(trial, MU, LAM, before, YIELD, hardening, residual)
    deviator, _ = _deviatoric(new)
    radius = ROOT * (YIELD + hardening * after).clamp(min=residual)
    assert float((deviator - radius).max()) < 1e-11 * float(E)
    flowed = after > before
    assert 10 < int(flowed.sum()) < 201
    assert_close(deviator[flowed], radius[flowed], rtol=0, atol=1e-11 * float(E))
    # alpha grows by sqrt(2/3) of the plastic strain
    plastic = (_deviatoric(trial)[0] - deviator) / (2 * MU)
    assert_close(after - before, ROOT * plastic, rtol=0, atol=1e-12)
    if hardening == -500:
        at_floor = flowed & (YIELD + hardening * after < residual)
        assert 0 < int(at_floor.sum()) < int(flowed.sum()), "both branches should be met"


def test_yield_in_uniaxial_tension():
    """A bar at just the yield stress: tau = (s, 0, 0) has |dev tau| = sqrt(2/3) s."""
    for factor, flows in ((0.999, False), (1.001, True)):
        s = factor * YIELD
        stretch = torch.stack([s / E, -NU * s / E, -NU * s / E]).exp()
        new, alpha = von_mises(stretch, MU, LAM, ZERO, YIELD)
        assert (float(alpha) > 0) == flows
        assert bool((new != stretch).any()) == flows


def test_foam_relaxes_exactly():
    """Two half substeps equal one, and the overstress falls by exp(-2 mu dt / eta)."""
    trial = _stretches()
    one, _ = viscoplastic(trial, MU, LAM, None, YIELD, ETA, DT)
    half, _ = viscoplastic(trial, MU, LAM, None, YIELD, ETA, DT / 2)
    assert_close(viscoplastic(half, MU, LAM, None, YIELD, ETA, DT / 2)[0], one, rtol=0, atol=TOL)
    over = (_deviatoric(trial)[0] - ROOT * YIELD).clamp(min=0)
    left = (_deviatoric(one)[0] - ROOT * YIELD).clamp(min=0)
    assert_close(left, over * torch.exp(-2 * MU * DT / ETA), rtol=0, atol=1e-11 * float(E))
    slow, _ = viscoplastic(trial, MU, LAM, None, YIELD, 1e12, DT)
    assert_close(slow, trial, rtol=0, atol=1e-10)
    fast, _ = viscoplastic(trial, MU, LAM, None, YIELD, 1e-6, DT)
    assert_close(fast, viscoplastic(trial, MU, LAM, None, YIELD, 0.0, DT)[0], rtol=0, atol=TOL)


def test_snow_moves_volume_to_its_plastic_part():
    trial = torch.tensor([[1.0, 1.0, 0.9], [1.1, 1.0, 1.0], [0.99, 1.0, 1.005]], dtype=torch.float64)
    new, volume = snow_plasticity(trial, MU, LAM, torch.ones(3, dtype=torch.float64), 0.025, 0.0075)
    expected = torch.tensor([[1.0, 1.0, 0.975], [1.0075, 1.0, 1.0], [0.99, 1.0, 1.005]], dtype=torch.float64)
    assert_close(new, expected)
    assert_close(volume, torch.tensor([0.9 / 0.975, 1.1 / 1.0075, 1.0], dtype=torch.float64))
    assert_close(volume * new.prod(-1), trial.prod(-1), rtol=1e-14, atol=0)


def test_fluid_keeps_only_the_volume():
    trial = _stretches()
    new, _ = fluid_flow(trial, MU, LAM, None)
    assert_close(new.prod(-1), trial.prod(-1), rtol=1e-13, atol=0)
    assert bool((new == new[:, :1]).all())
    crushed, _ = fluid_flow(torch.tensor([1.0, 0.5, -0.5], dtype=torch.float64), MU, LAM, None)
    assert_close(crushed.prod(), torch.tensor(0.05, dtype=torch.float64))


@pytest.mark.parametrize("name", PLASTIC)
def test_what_flows_comes_back_with_positive_stretches(name, dtype):
    """Also from inverted, crushed and flat states."""
    states = [[1, 1, 1], [0, 0, 0], [1.2, 1.1, -0.6], [1, 0.3, -0.3], [3, 2, -5], [3, 2, -60], [40, 1, 1e-4]]
    trial = torch.tensor([*states, [0.01] * 3], dtype=dtype, requires_grad=True)
    new, internal = _map(name, trial)
    (gradient,) = torch.autograd.grad(new.sum() + (0 if internal is None else internal.sum()), trial)
    assert new.dtype == dtype
    assert bool(torch.isfinite(new).all() & torch.isfinite(gradient).all())
    changed = (new != trial).any(-1)
    assert float(new[changed].detach().min()) > 0.049
