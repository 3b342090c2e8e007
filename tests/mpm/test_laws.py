"""Laws as modules: the functions they call, return maps on deformation gradients, bounds on the stiffness.

Covers: _folders, mpm.laws.fixed_corotated, mpm.laws.fluid, mpm.laws.foam, mpm.laws.hencky, mpm.laws.law,
mpm.laws.metal, mpm.laws.neo_hookean, mpm.laws.plasticine, mpm.laws.sand, mpm.laws.shared, mpm.laws.snow,
mpm.laws.spring_network.
"""

import math
import re
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pytest
import torch

from gaussian_swaying.geometry import linalg
from gaussian_swaying.geometry.linalg import spectrum
from gaussian_swaying.mpm import laws
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.fluid import Fluid
from gaussian_swaying.mpm.laws.foam import Foam
from gaussian_swaying.mpm.laws.hencky import StVKHencky
from gaussian_swaying.mpm.laws.law import ConstitutiveLaw
from gaussian_swaying.mpm.laws.metal import Metal
from gaussian_swaying.mpm.laws.neo_hookean import NeoHookean
from gaussian_swaying.mpm.laws.plasticine import Plasticine
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.laws.shared import lame_parameters
from gaussian_swaying.mpm.laws.snow import Snow
from gaussian_swaying.mpm.laws.spring_network import SpringNetwork

LAWS = {
    "fixed corotated": FixedCorotated(),
    "neo-Hookean": NeoHookean(),
    "springs": SpringNetwork(),
    "Hencky": StVKHencky(),
    "sand": Sand(),
    "corrected sand": Sand(35.0, volume_correction=True),
    "metal": Metal(100.0, 50.0),
    "foam": Foam(100.0, 20.0),
    "plasticine": Plasticine(100.0, 500.0, 20.0),
    "snow": Snow(),
    "fluid": Fluid(),
}
PLASTIC = [name for name, law in LAWS.items() if law.plastic]
DT = 1e-3


def _lame(count, nu=0.3, dtype=torch.float64, device="cpu"):
    e, poisson = (torch.full((count,), x, dtype=dtype, device=device) for x in (3000.0, nu))
    return lame_parameters(e, poisson)


def _gradients(count=50, spread=0.2):
    return torch.eye(3, dtype=torch.float64) + spread * torch.randn(count, 3, 3, dtype=torch.float64)


def _internal(law, count, dtype=torch.float64, device="cpu"):
    return None if law.internal is None else torch.full((count,), law.internal, dtype=dtype, device=device)


def test_attributes():
    assert PLASTIC == ["sand", "corrected sand", "metal", "foam", "plasticine", "snow", "fluid"]
    values = [law.internal for law in LAWS.values()]
    assert values == [None, None, None, None, None, 0.0, 0.0, None, 0.0, 1.0, None]
    assert all(isinstance(law, ConstitutiveLaw) for law in LAWS.values())


def test_a_law_is_one_file():
    """Each file of the folder has one law, except the shared files."""
    files = {found.name for found in iter_modules(laws.__path__) if not found.ispkg} - {"law", "shared"}
    assert {law.__module__.rsplit(".", 1)[1] for law in laws.LAWS.values()} == files
    assert len(laws.LAWS) == len(files)
    assert {type(law) for law in LAWS.values()} == set(laws.LAWS.values())  # a new one must be tested here


def test_no_file_of_device_functions_is_unused():
    names = {found.name for found in iter_modules([f"{path}/triton" for path in laws.__path__])}
    found = [
        import_module(f"gaussian_swaying.mpm.laws.triton.{name}").FUNCTIONS
        for name in names - {"body", "functions", "shared"}
    ]
    used = [law.twin().function for law in LAWS.values()]
    assert all(any(functions is other for other in used) for functions in found)
    assert all(any(functions is other for other in found) for functions in used)


def test_the_documented_laws_are_those_that_there_are():
    page = (Path(__file__).parents[2] / "docs" / "configuration.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith("| `material.law`"))
    elastic, flowing = (set(re.findall("`([A-Z][A-Za-z]+)`", part)) for part in row.split("plastic"))
    assert elastic == {name for name, law in laws.LAWS.items() if not law.plastic}
    assert flowing == {name for name, law in laws.LAWS.items() if law.plastic}


@pytest.mark.parametrize("name", list(LAWS))
def test_stress_is_the_derivative_of_the_energy(name):
    law = LAWS[name]
    F = _gradients().requires_grad_()
    mu, lam = _lame(50)
    internal = _internal(law, 50)
    (expected,) = torch.autograd.grad(law.energy(F, mu, lam, internal).sum(), F)
    F = F.detach()
    stress = law.pk1(F, mu, lam, internal)
    assert float(((stress - expected).norm(dim=(1, 2)) / expected.norm(dim=(1, 2))).max()) < 1e-8
    torch.testing.assert_close(law.kirchhoff(F, mu, lam, internal), stress @ F.mT, rtol=0, atol=1e-8)
    torch.testing.assert_close(law.pk1(F, mu, lam), stress, rtol=0, atol=0)


def test_elastic_laws_need_no_eigenvectors(monkeypatch):
    """FixedCorotated and NeoHookean must stay cheap."""

    def fail(*args, **kwargs):
        raise AssertionError("called")

    files = [import_module(f"{laws.__name__}.{found.name}") for found in iter_modules(laws.__path__)]
    for module in (linalg, *files):
        for name in ("spectrum", "from_principal", "_singular_vectors", "_jacobi"):
            monkeypatch.setattr(module, name, fail, raising=False)
    F = _gradients().requires_grad_()
    mu, lam = _lame(50)
    for law in (FixedCorotated(), NeoHookean()):
        total = law.energy(F, mu, lam).sum() + law.pk1(F, mu, lam).sum() + law.kirchhoff(F, mu, lam).sum()
        total.backward()
        law.moduli(F.detach(), mu, lam)
        assert law.return_map(F, mu, lam, None, DT)[0] is F
    with pytest.raises(AssertionError, match="called"):
        StVKHencky().energy(F, mu, lam)


@pytest.mark.parametrize("name", PLASTIC)
def test_return_map_keeps_axes_and_rotation(name):
    """F = U diag(a) V^T becomes U diag(z) V^T, with the same result from either side."""
    law = LAWS[name]
    F = _gradients()
    mu, lam = _lame(50)
    new, internal = law.return_map(F, mu, lam, _internal(law, 50), DT)
    trial, after = spectrum(F), spectrum(new)
    expected, _ = law.flow(trial.stretch, mu, lam, _internal(law, 50), DT)
    torch.testing.assert_close(trial.left.mT @ new @ trial.axes, expected.diag_embed(), rtol=0, atol=1e-13)
    assert float((new - F).abs().max()) > 0.01
    torch.testing.assert_close(after.rotation, trial.rotation, rtol=0, atol=1e-12)
    assert (internal is None) == (law.internal is None)
    Q = torch.linalg.qr(torch.randn(50, 3, 3, dtype=torch.float64))[0]
    Q = Q * torch.linalg.det(Q)[:, None, None]
    turned, _ = law.return_map(Q @ F @ Q.mT, mu, lam, None, DT)
    torch.testing.assert_close(turned, Q @ new @ Q.mT, rtol=0, atol=1e-11)


@pytest.mark.parametrize("name", PLASTIC)
def test_gradients_of_return_maps(name):
    """Plastic and elastic states, repeated stretches, at rest; away from kinks, which differences would cross."""
    law = LAWS[name]
    stretches = [[1.0, 0.8, 0.7], [1.3, 1.1, 1.05], [0.9, 0.9, 0.6], [0.96, 0.6, 0.6], [1.0, 1.0, 1.0]]
    if name in ("sand", "corrected sand"):
        stretches.pop()  # rest is the tip of the cone
    Q = torch.linalg.qr(torch.randn(2, 3, 3, dtype=torch.float64))[0]
    Q = Q * torch.linalg.det(Q)[:, None, None]
    F = Q[0] @ torch.tensor(stretches, dtype=torch.float64).diag_embed() @ Q[1]
    internal = _internal(law, len(F))
    if internal is not None:
        internal = (internal + 0.01).requires_grad_()
    mu, lam = (x.requires_grad_() for x in _lame(len(F)))

    def run(F, internal, mu, lam):
        new, after = law.return_map(F, mu, lam, internal, DT)
        return new if after is None else (new, after)

    assert torch.autograd.gradcheck(run, (F.requires_grad_(), internal, mu, lam), eps=1e-6, atol=1e-7)


@pytest.mark.parametrize("name", list(LAWS))
def test_gradients_through_a_substep_are_finite(name, dtype, device):
    """Return map, then stress: at rest, crushed, inverted, singular."""
    law = LAWS[name]
    stretches = [[1, 1, 1], [1, 1, 0], [1.2, 1.1, -0.6], [1, 0.5, -0.5], [0.01, 0.01, 0.01], [0, 0, 0], [3, 2, -5]]
    F = torch.tensor(stretches, dtype=dtype, device=device).diag_embed().requires_grad_()
    mu, lam = _lame(len(F), dtype=dtype, device=device)
    elastic, internal = law.return_map(F, mu, lam, _internal(law, len(F), dtype, device), DT)
    tau = law.kirchhoff(elastic, mu, lam, internal)
    assert tau.dtype == dtype
    assert bool(torch.isfinite(tau).all())
    (gradient,) = torch.autograd.grad(tau.square().mean(), F)
    assert bool(torch.isfinite(gradient).all())
    torch.testing.assert_close(tau[0], torch.zeros_like(tau[0]), rtol=0, atol=30 * torch.finfo(dtype).eps * 3000)


@pytest.mark.parametrize("name", ["sand", "metal", "foam", "plasticine", "snow", "fluid"])
def test_inverted_elements_recover(name):
    """Steps along -P with a return map after each, as in a solver, end with a positive determinant."""
    law = LAWS[name]
    F = torch.diag(torch.tensor([1.1, 0.9, -0.3], dtype=torch.float64))[None]
    mu, lam = _lame(1)
    internal = _internal(law, 1)
    for _ in range(500):
        stress = law.pk1(F, mu, lam, internal)
        F = F - 1e-2 * stress / stress.norm().clamp(min=1)
        F, internal = law.return_map(F, mu, lam, internal, DT)
        if float(torch.linalg.det(F)) > 0.3:
            break
    assert float(torch.linalg.det(F)) > 0.3


def _hessian(law, F, mu, lam, internal):
    """d P / d F, (N, 9, 9), from first derivatives of the stress."""
    F = F.clone().requires_grad_()
    stress = law.pk1(F, mu, lam, internal)
    rows = [torch.autograd.grad(stress[:, i, j].sum(), F, retain_graph=True)[0] for i in range(3) for j in range(3)]
    return torch.stack(rows, 1).reshape(-1, 9, 9)


@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("name", ["fixed corotated", "neo-Hookean", "Hencky", "fluid"])
def test_moduli_bound_the_hessian(name, nu):
    """The largest eigenvalue, and the acoustic tensor over many directions; both bounds are tight in mild states."""
    law = LAWS[name]
    mild = 150
    F = torch.cat([_gradients(mild, 0.05), _gradients(150, 0.3), _gradients(100, 0.8)])
    uniform = torch.linspace(0.2, 3, 20, dtype=torch.float64)[:, None, None] * torch.eye(3, dtype=torch.float64)
    F = torch.cat([F, uniform])
    a = torch.linalg.svdvals(F)
    F = F[a[:, 2] > 0.02 * a[:, 0]]
    assert int((torch.linalg.det(F) < 0).sum()) > 5
    mu, lam = _lame(len(F), nu)
    hessian = _hessian(law, F, mu, lam, None)
    size = hessian.abs().amax((1, 2))
    # round-off of the stress gradients, over the differences of nearly repeated stretches
    assert float(((hessian - hessian.mT).abs().amax((1, 2)) / size).max()) < 1e-8
    wave, bound = law.moduli(F, mu, lam)
    exact = torch.linalg.eigvalsh(hessian)[:, -1]
    assert float((exact / bound).max()) < 1 + 1e-6
    direction = torch.nn.functional.normalize(torch.randn(300, 3, dtype=torch.float64), dim=-1)
    acoustic = torch.einsum("pijkl,nj,nl->pnik", hessian.reshape(-1, 3, 3, 3, 3), direction, direction)
    speed = torch.linalg.eigvalsh(acoustic)[..., -1].amax(-1)
    assert float((speed / wave).max()) < 1 + 1e-6
    assert float((wave / bound).max()) < 1 + 1e-9
    # fluids and tension fall below their stiffness at rest, at which the bounds stop
    assert float((exact / bound)[:mild].median()) > 0.7
    assert float((speed / wave)[:mild].median()) > 0.7


@pytest.mark.parametrize("nu", [0.1, 0.25, 0.4])
@pytest.mark.parametrize("name", ["springs", "Hencky"])
def test_moduli_of_stretches_are_those_of_the_hessian(name, nu):
    """Both bounds are exact, down to their values at rest.

    In principal axes H has the entries ii,jj and, for each pair, a block of ij,ij and ij,ji, whose sum and difference
    are its eigenvalues. On m (x) N the entries ii,jj may be moved to the blocks: see ``stvk_hencky_moduli``.
    """
    law, (i, j) = LAWS[name], ((0, 0, 1), (1, 2, 2))
    F = (4.8 * torch.rand(300, 3, dtype=torch.float64) - 2.8).exp().diag_embed()  # logarithms are continued below 0.05
    mu, lam = _lame(len(F), nu)
    hessian = _hessian(law, F, mu, lam, None)
    entry = hessian.reshape(-1, 3, 3, 3, 3)
    same, swapped, mixed = entry[:, i, j, i, j], entry[:, i, j, j, i], entry[:, i, i, j, j]
    own = entry[:, range(3), range(3), range(3), range(3)]
    fastest = torch.cat([own, same - swapped - mixed, same + swapped + mixed], -1).amax(-1).maximum(2 * mu + lam)
    wave, bound = law.moduli(F, mu, lam)
    largest = torch.linalg.eigvalsh(hessian)[:, -1].maximum(2 * mu + 3 * lam)
    assert int((fastest > 1.1 * (2 * mu + lam)).sum()) > 30
    # stretches that are alike by chance: rounding over their difference, or a divided difference
    torch.testing.assert_close(wave, fastest, rtol=1e-7, atol=0)
    torch.testing.assert_close(bound, largest, rtol=1e-7, atol=0)


@pytest.mark.parametrize("name", list(LAWS))
def test_moduli_at_rest(name, dtype):
    law = LAWS[name]
    mu, lam = _lame(2, dtype=dtype)
    F = torch.eye(3, dtype=dtype).expand(2, 3, 3)
    wave, bound = law.moduli(F, mu, lam)
    expected = lam + 2 * mu if name != "fluid" else lam + 2 / 3 * mu
    # eigenvalues in closed form, and a divided difference: rounding over the cube root of eps
    tol = 1e-4 if dtype == torch.float32 else 1e-8
    torch.testing.assert_close(wave, expected, rtol=tol, atol=0)
    torch.testing.assert_close(bound, 3 * lam + 2 * mu, rtol=tol, atol=0)


@pytest.mark.parametrize("s", [1.05, 1.5, 3.0])
def test_moduli_of_uniform_expansion_are_exact_for_fixed_corotated(s):
    """F = s I along I and e (x) e: mu |F - R|^2 gives 2 mu, lambda / 2 (J - 1)^2 gives 5 s^4 - 2 s and s^4."""
    mu, lam = _lame(1)
    F = s * torch.eye(3, dtype=torch.float64)[None]
    wave, bound = FixedCorotated().moduli(F, mu, lam)
    torch.testing.assert_close(wave, 2 * mu + lam * s**4)
    torch.testing.assert_close(bound, 2 * mu + lam * (5 * s**4 - 2 * s))


def test_packed_snow_is_stiffer():
    mu, lam = _lame(2)
    F = torch.eye(3, dtype=torch.float64).expand(2, 3, 3)
    wave, bound = Snow().moduli(F, mu, lam, torch.tensor([1.0, 0.9], dtype=torch.float64))
    assert float(wave[1] / wave[0]) == pytest.approx(math.e)
    assert float(bound[1] / bound[0]) == pytest.approx(math.e)


def test_snow_packs_under_compression():
    mu, lam = _lame(1)
    law = Snow()
    F = 0.95 * torch.eye(3, dtype=torch.float64)[None]
    F, volume = law.return_map(F, mu, lam, None, DT)
    torch.testing.assert_close(F[0], 0.975 * torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-14)
    assert float(volume) == pytest.approx((0.95 / 0.975) ** 3)
    assert float(law.pk1(F, mu, lam, volume)[0, 0, 0]) < float(law.pk1(F, mu, lam)[0, 0, 0]) < 0


def test_worked_plasticine_weakens_and_worked_metal_hardens():
    """Yield stress in a uniaxial test at constant volume: sigma_y + H alpha, with alpha the axial plastic strain."""
    mu, lam = _lame(1)
    trial = torch.diag(torch.tensor([1.2, 1.2**-0.5, 1.2**-0.5], dtype=torch.float64))[None]
    for law, slope in ((Metal(100.0, 300.0), 300.0), (Plasticine(100.0, 300.0), -300.0)):
        F, alpha = law.return_map(trial, mu, lam, None, DT)
        assert alpha is not None
        tau = law.kirchhoff(F, mu, lam)
        assert float(alpha) > 0.1
        assert float(tau[0, 0, 0] - tau[0, 1, 1]) == pytest.approx(100 + slope * float(alpha), rel=1e-10)


def test_fluid_forgets_shear():
    mu, lam = _lame(1)
    F = 0.98 * torch.tensor([[[1.0, 0.4, 0.0], [0, 1, 0], [0, 0, 1]]], dtype=torch.float64)
    new, _ = Fluid().return_map(F, mu, lam, None, DT)
    torch.testing.assert_close(new.mT @ new, 0.98**2 * torch.eye(3, dtype=torch.float64)[None], rtol=0, atol=1e-13)
    torch.testing.assert_close(Fluid().kirchhoff(new, mu, lam), Fluid().kirchhoff(F, mu, lam), rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: Sand(friction_angle=90.0), "friction_angle"),
        (lambda: Sand(friction_angle=math.nan), "friction_angle"),
        (lambda: Metal(0.0), "yield_stress"),
        (lambda: Metal(1.0, -1.0), "Plasticine"),
        (lambda: Metal(1.0, math.nan), "hardening"),
        (lambda: Foam(-1.0, 1.0), "yield_stress"),
        (lambda: Foam(1.0, math.inf), "viscosity"),
        (lambda: Plasticine(1.0, -1.0), "softening"),
        (lambda: Plasticine(1.0, 1.0, 2.0), "residual"),
        (lambda: Snow(critical_compression=1.0), "critical_compression"),
        (lambda: Snow(critical_stretch=-0.1), "critical_stretch"),
        (lambda: Snow(hardening=-1.0), "hardening"),
        (lambda: Fluid(1.0), "gamma"),
    ],
)
def test_arguments_are_checked(build, field):
    with pytest.raises(ValueError, match=field):
        build()
