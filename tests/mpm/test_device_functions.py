"""The materials of the kernels, one function at a time, against float64."""

import math

import pytest
import torch
from catalogue import ELASTIC, PLASTIC

from gaussian_swaying.geometry import linalg
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.dispatch import BodyLaws, in_common
from gaussian_swaying.mpm.laws import LAWS as KINDS
from gaussian_swaying.mpm.laws.elastic import NeoHookean
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw, DeviceLaw

MU, LAM, DT = 4e3, 6e3, 1e-3


@triton.jit
def _matrix(pointer, index, mask):
    return (
        tl.load(pointer + index, mask, 0.0), tl.load(pointer + index + 1, mask, 0.0),
        tl.load(pointer + index + 2, mask, 0.0), tl.load(pointer + index + 3, mask, 0.0),
        tl.load(pointer + index + 4, mask, 0.0), tl.load(pointer + index + 5, mask, 0.0),
        tl.load(pointer + index + 6, mask, 0.0), tl.load(pointer + index + 7, mask, 0.0),
        tl.load(pointer + index + 8, mask, 0.0),
    )  # fmt: skip


@triton.jit
def _scalars(F_in, wave, energy, mu, lam, count, WAVE: tl.constexpr, ENERGY: tl.constexpr, BLOCK: tl.constexpr):
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = place < count
    F = _matrix(F_in, place * 9, mask)
    mu = F[0] * 0 + mu
    lam = F[0] * 0 + lam
    tl.store(wave + place, WAVE(F, mu, lam), mask)
    tl.store(energy + place, ENERGY(F, mu, lam), mask)


def _turned(stretch, generator, device):
    """Stretches (N, 3) between random rotations, in float32."""
    turns = torch.linalg.qr(torch.randn(2, len(stretch), 3, 3, dtype=torch.float64, generator=generator))[0]
    turns = turns * torch.linalg.det(turns)[..., None, None]
    return (turns[0] @ stretch.diag_embed() @ turns[1].mT).float().to(device)


def _launch(kernel, count, *arguments, **options):
    block = lanes(arguments[0].device, 128)
    launch(kernel, (-(-count // block),))(*arguments, count, **options, BLOCK=block)


ENERGIES = list(ELASTIC.values())
HENCKY = KINDS["StVKHencky"]
LAME = {"equal": (4e3, 4e3), "mu": (6e3, 2e3), "lambda": (2e3, 8e3), "auxetic": (5e3, -1e3), "steel": (8e10, 1.2e11)}


def _strained(device):
    """Turned round at random: stretches from crushed to fourfold, equal and nearly equal ones, and inverted ones."""
    generator = torch.Generator().manual_seed(2)
    free = 0.02 + 4 * torch.rand(500, 3, dtype=torch.float64, generator=generator)
    thin = free * torch.tensor([1.0, 0.1, 0.01], dtype=torch.float64)
    two, three = free.clone(), free[:, :1].repeat(1, 3)
    two[:, 1] = two[:, 0]
    near = three * (1 + 1e-4 * torch.randn(500, 3, dtype=torch.float64, generator=generator))
    small = 1 + 1e-3 * torch.randn(500, 3, dtype=torch.float64, generator=generator)
    stretch = torch.cat([free, thin, two, three, near, small])
    inverted = stretch.sort(-1, descending=True)[0] * torch.tensor([1.0, 1.0, -0.9], dtype=torch.float64)
    stretch = torch.cat([stretch, inverted])
    return _turned(stretch, generator, device)


CASES = [(law, ratio) for law in ENERGIES for ratio in LAME if law.least_nu < 0 or ratio != "auxetic"]


def _wave_and_energy(law, F, mu, lam):
    found = F.new_empty(2, len(F))
    _launch(_scalars, len(F), F, *found, mu, lam, WAVE=in_common([law], "wave"), ENERGY=in_common([law], "energy"))
    return found


@pytest.mark.parametrize(("law", "ratio"), CASES, ids=lambda x: x if isinstance(x, str) else type(x).__name__)
def test_wave_modulus_and_energy(kernel_device, law, ratio):
    """Against float64, to what a hundred roundings (of 1.2e-7) change: roots and divisions of a GPU are of 2 ulp.

    A modulus divides by the sum of two stretches, which is exact to the rounding of the largest. The modulus of a
    corotated body and of a network is only exact to the root of the rounding if two eigenvalues in closed form are
    equal.
    """
    mu, lam = LAME[ratio]
    F = _strained(kernel_device)
    wave, energy = _wave_and_energy(law, F, mu, lam)
    wide = F.double()
    parameters = [torch.full_like(wide[:, 0, 0], value) for value in (mu, lam)]
    values = linalg.svd3(wide)[1]
    expected = law.moduli(wide, *parameters)[0]
    rounding = 1.2e-5 + 5e-7 * values[:, 0] / (values[:, 1] + values[:, 2]).abs()
    if not isinstance(law, HENCKY):
        rounding = rounding.clamp(min=5e-4)
    error = (wave - expected).abs() / expected
    assert bool((error <= rounding).all()), f"{float((error / rounding).max()):.1e}"
    if lam > 0 or isinstance(law, HENCKY):  # otherwise there is no network, and nothing stiffens
        assert int((expected > 1.01 * (2 * mu + lam)).sum()) > 500
    exact = law.energy(wide, *parameters)
    slope = (exact * expected).sqrt()
    least = 0.3 if isinstance(law, NeoHookean) else 1e-6  # at small strain it is the difference of numbers near one
    error = (energy - exact).abs() / (exact + slope + least * expected)
    assert bool((error <= 3e-6).all()), f"{float(error.max()):.1e}"


@pytest.mark.parametrize("law", ENERGIES, ids=lambda law: type(law).__name__)
def test_what_is_not_finite_has_no_modulus(kernel_device, law):
    """In any entry of F; maxima would drop it by default."""
    F = torch.eye(3, device=kernel_device).repeat(18, 1, 1)
    F.view(18, 9)[range(9), range(9)] = math.nan
    F.view(18, 9)[range(9, 18), range(9)] = math.inf
    assert not bool(torch.isfinite(_wave_and_energy(law, F, MU, LAM)[0]).any())


def test_which_energy_holds_for_a_body():
    """One kernel per energy: all laws based on Hencky's share it, with any plastic flow."""
    snow = PLASTIC["snow"]
    on_hencky = [KINDS["StVKHencky"](), *(law for name, law in PLASTIC.items() if name not in ("snow", "fluid"))]
    for name in ("energy", "wave"):
        found = [in_common([law], name) for law in ENERGIES]
        assert None not in found
        assert len(set(found)) == len(ENERGIES)
        assert in_common(on_hencky, name) is in_common(on_hencky[:1], name)
        for body in [ENERGIES[:2], [snow], [PLASTIC["fluid"]], [OwnLaw()], [OwnLaw(), ENERGIES[0]]]:
            assert in_common(body, name) is None


class OwnLaw(NeoHookean):
    """It has another stress than the law that it is derived from."""

    def pk1(self, F, mu, lam, internal=None):
        return 2 * super().pk1(F, mu, lam, internal)


def test_what_a_body_asks_of_a_kernel():
    def body(*names):
        return BodyLaws([(ELASTIC | PLASTIC)[name] for name in names])

    direct, flowing = body("corotated", "neo-hookean"), body("sand", "fluid")
    mixed = body("neo-hookean", "sand", "corotated", "hencky", "metal", "plasticine")
    assert [one.spectral for one in (direct, mixed)] == [False, True]
    assert [one.all_flow for one in (mixed, flowing)] == [False, True]
    keys = {repr(one) for one in (direct, mixed, flowing, body("sand"), body("corotated"))}
    assert len(keys) == 5
    assert repr(BodyLaws([KINDS["Fluid"](3.0)])) == repr(body("fluid"))


def test_a_law_is_whole():
    function = object()
    for given in ({}, {"flow": function}, {"strain_energy": function}, {"moduli": function}):
        with pytest.raises(ValueError, match="have `energy`, or `strain_energy` and `moduli`"):
            DeviceLaw(**given)

    class Many(KINDS["Sand"]):
        numbers = (1.0, 2.0, 3.0, 4.0, 5.0)

    with pytest.raises(ValueError, match="at most four `numbers` of Many, but got 5"):
        BodyLaws([Many()])
    with pytest.raises(NotImplementedError, match="Bare needs `device`, or energy, pk1 and moduli"):
        type("Bare", (ConstitutiveLaw,), {})().energy(*torch.ones(3, 1, 3, 3))
