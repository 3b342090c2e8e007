"""The decompositions, wave moduli and energies of the kernels, one function at a time, against float64.

A test of many matrices at once (also singular, inverted, tiny, with repeated stretches) costs almost nothing here.
"""

import math

import pytest
import torch
from catalogue import ELASTIC, PLASTIC
from shared import EYE, double, rand, randn, seeded, value_error
from torch.testing import assert_close

from gaussian_swaying.geometry import linalg
from gaussian_swaying.geometry.linalg_triton import load9, polar_rotation, store3, store9, svd3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.dispatch import BodyLaws, in_common
from gaussian_swaying.mpm.laws import LAWS as KINDS
from gaussian_swaying.mpm.laws.elastic import NeoHookean
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw, DeviceLaw

MU, LAM = 4e3, 6e3


@triton.jit
def _decompose(F_in, rotation, left, stretch, axes, count, BLOCK: tl.constexpr):
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = place < count
    F = load9(F_in, 1, place * 9, mask)
    u, a, v = svd3(F)
    store9(rotation, 1, place * 9, polar_rotation(F), mask)
    store9(left, 1, place * 9, u, mask)
    store9(axes, 1, place * 9, v, mask)
    store3(stretch, 1, place * 3, a, mask)


@triton.jit
def _scalars(F_in, wave, energy, mu, lam, count, WAVE: tl.constexpr, ENERGY: tl.constexpr, BLOCK: tl.constexpr):
    place = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = place < count
    F = load9(F_in, 1, place * 9, mask)
    mu = F[0] * 0 + mu
    lam = F[0] * 0 + lam
    tl.store(wave + place, WAVE(F, mu, lam), mask)
    tl.store(energy + place, ENERGY(F, mu, lam), mask)


def _turned(stretch, generator, device):
    """Stretches (N, 3) between random rotations, in float32."""
    turns = torch.linalg.qr(randn(2, len(stretch), 3, 3, generator=generator))[0]
    turns = turns * torch.linalg.det(turns)[..., None, None]
    return (turns[0] @ stretch.diag_embed() @ turns[1].mT).float().to(device)


def _matrices(device, unique=False):
    """Deformation gradients; with ``unique`` only those with a unique nearest rotation, far from others."""
    generator = seeded(0)
    special = [
        [1.0, 1.0, 1.0], [2.0, 2.0, 1.0], [2.0, 1.0, 1.0], [1.0, 1.0 - 1e-6, 1.0 - 2e-6], [1.5, 0.7, 1e-3],
        [1.5, 0.7, 1e-6], [3.0, 1e-2, 5e-3], [1.2, 1.0, -0.3], [1.2, 1.1, -0.02], [20.0, 1.0, 0.4],
        [1.0001, 1.0, 0.9999], [0.051, 0.05, 0.049], [3.0, 0.9, -0.5], [1.5, 0.7, 0.0],
    ]  # fmt: skip
    if not unique:
        special += [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1e-8, 1e-9, 1e-9], [1e4, 1e3, 1.0], [1.0, 1.0, -1.0]]
    F = _turned(double(special)[torch.arange(900) % len(special)], generator, device)
    random = EYE + 0.4 * randn(900, 3, 3, generator=generator)
    if unique:
        values = torch.linalg.svdvals(random)
        values[:, 2] *= torch.linalg.det(random).sign()
        random = random[values[:, 1] + values[:, 2] > 0.05]
    return torch.cat([F, random.to(F)])


def _launch(kernel, count, *arguments, **options):
    block = lanes(arguments[0].device, 128)
    launch(kernel, (-(-count // block),))(*arguments, count, **options, BLOCK=block)


def _decomposed(F):
    rotation, left, axes = (torch.empty_like(F) for _ in range(3))
    stretch = F.new_empty(len(F), 3)
    _launch(_decompose, len(F), F, rotation, left, stretch, axes)
    return rotation, left, stretch, axes


def test_decomposition(kernel_device):
    """U and V are rotations for any F, and the product is F, to some units in the last place of its size."""
    F = _matrices(kernel_device)
    _, left, stretch, axes = _decomposed(F)
    eye = torch.eye(3, device=kernel_device).expand_as(F)
    for turn in (left, axes):
        assert_close(turn @ turn.mT, eye, rtol=0, atol=3e-6)
        assert_close(torch.linalg.det(turn), torch.ones_like(stretch[:, 0]), rtol=0, atol=3e-6)
    size = torch.linalg.matrix_norm(F)
    product = left @ stretch.diag_embed() @ axes.mT
    assert (torch.linalg.matrix_norm(product - F) <= 3e-6 * size + 1e-14).all()
    exact = linalg.svd3(F.double())[1]
    assert ((stretch - exact).abs().amax(-1) <= 2e-6 * size + 1e-14).all()
    assert (stretch[:, 0] >= stretch[:, 1] - 1e-6 * size).all() & (
        stretch[:, 1] >= stretch[:, 2].abs() - 1e-6 * size
    ).all()


def test_nearest_rotation(kernel_device):
    """Five iterations are enough for stretches that differ by a factor of fifty; beyond that, as in torch."""
    F = _matrices(kernel_device, unique=True)
    rotation = _decomposed(F)[0]
    exact = linalg.polar_rotation(F.double()).float()
    values = linalg.svd3(F.double())[1]
    easy = values[:, 2].abs() * 50 > values[:, 0]
    assert int(easy.sum()) > 900
    assert_close(rotation[easy], exact[easy], rtol=0, atol=1e-5)
    assert torch.isfinite(_decomposed(_matrices(kernel_device))[0]).all()


LAWS = (
    ELASTIC
    | PLASTIC
    | {
        "metal that hardens": KINDS["Metal"](2e2, 5e3),
        "plasticine that softens at once": KINDS["Plasticine"](1e3, 5e4, 1e2),
        "stiff foam": KINDS["Foam"](1e2, 1e4),
        "foam of no strength": KINDS["Foam"](0.0, 0.0),
    }
)


@pytest.mark.parametrize("name", LAWS)
def test_flow_and_stress_in_single_precision(name, device):
    """To 2e-5 of the size of each matrix, or of the stress at a strain of one, for each of two decompositions."""
    law, F, ends = LAWS[name], _matrices(device, unique=True), []
    values = linalg.svd3(F.double())[1]
    easy = values[:, 2].abs() * 50 > values[:, 0]
    for own in (F, F.double()):
        mu, lam = (torch.full_like(own[:, 0, 0], value) for value in (MU, LAM))
        internal = None if law.internal is None else torch.full_like(mu, law.internal + 0.01)
        flown, internal = law.return_map(own, mu, lam, internal, 1e-3)
        ends.append((flown, law.kirchhoff(flown, mu, lam, internal)))
    for found, exact, size in zip(*ends, (1.0, MU + LAM), strict=True):
        error, most = (part.flatten(1).abs().amax(-1) for part in (found - exact, exact))
        assert (error <= 4e-5 * (most + size))[easy | law.plastic].all()
        assert torch.isfinite(found).all()


ENERGIES = list(ELASTIC.values())
HENCKY = KINDS["StVKHencky"]
LAME = {"equal": (4e3, 4e3), "mu": (6e3, 2e3), "lambda": (2e3, 8e3), "auxetic": (5e3, -1e3), "steel": (8e10, 1.2e11)}


def _strained(device):
    """Turned round at random: stretches from crushed to fourfold, equal and nearly equal ones, and inverted ones."""
    generator = seeded(2)
    free = 0.02 + 4 * rand(500, 3, generator=generator)
    thin = free * double([1.0, 0.1, 0.01])
    two, three = free.clone(), free[:, :1].repeat(1, 3)
    two[:, 1] = two[:, 0]
    near = three * (1 + 1e-4 * randn(500, 3, generator=generator))
    small = 1 + 1e-3 * randn(500, 3, generator=generator)
    stretch = torch.cat([free, thin, two, three, near, small])
    inverted = stretch.sort(-1, descending=True)[0] * double([1.0, 1.0, -0.9])
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
    assert (error <= rounding).all(), f"{float((error / rounding).max()):.1e}"
    if lam > 0 or isinstance(law, HENCKY):  # otherwise there is no network, and nothing stiffens
        assert (expected > 1.01 * (2 * mu + lam)).sum() > 500
    exact = law.energy(wide, *parameters)
    slope = (exact * expected).sqrt()
    least = 0.3 if isinstance(law, NeoHookean) else 1e-6  # at small strain it is the difference of numbers near one
    error = (energy - exact).abs() / (exact + slope + least * expected)
    assert (error <= 3e-6).all(), f"{float(error.max()):.1e}"


@pytest.mark.parametrize("law", ENERGIES, ids=lambda law: type(law).__name__)
def test_what_is_not_finite_has_no_modulus(kernel_device, law):
    """In any entry of F; maxima would drop it by default."""
    F = torch.eye(3, device=kernel_device).repeat(18, 1, 1)
    F.view(18, 9)[range(9), range(9)] = math.nan
    F.view(18, 9)[range(9, 18), range(9)] = math.inf
    assert not torch.isfinite(_wave_and_energy(law, F, MU, LAM)[0]).any()


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
    """No decomposition if none is needed, and shared parts of laws only once."""

    def body(*names):
        return BodyLaws([(ELASTIC | PLASTIC)[name] for name in names])

    direct = body("corotated", "neo-hookean")
    assert (direct.spectral, len(direct.principals), len(direct.matrices), len(direct.flows)) == (False, 0, 2, 0)
    mixed = body("neo-hookean", "sand", "corotated", "hencky", "metal", "plasticine")
    assert (mixed.spectral, len(mixed.principals), len(mixed.matrices), len(mixed.flows)) == (True, 1, 2, 2)
    flowing = body("sand", "fluid")
    assert (mixed.all_flow, flowing.all_flow) == (False, True)
    keys = {repr(one) for one in (direct, mixed, flowing, body("sand"), body("corotated"))}
    assert len(keys) == 5
    assert repr(BodyLaws([KINDS["Fluid"](3.0)])) == repr(body("fluid"))


def test_a_law_is_whole():
    function = object()
    for given in ({}, {"flow": function}, {"strain_energy": function}, {"moduli": function}):
        with value_error("have `energy`, or `strain_energy` and `moduli`"):
            DeviceLaw(**given)

    class Many(KINDS["Sand"]):
        numbers = (1.0, 2.0, 3.0, 4.0, 5.0)

    with value_error("at most four `numbers` of Many, but got 5"):
        BodyLaws([Many()])
    with pytest.raises(NotImplementedError, match="Bare needs `device`, or energy, pk1 and moduli"):
        type("Bare", (ConstitutiveLaw,), {})().energy(*torch.ones(3, 1, 3, 3))
