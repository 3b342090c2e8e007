"""Gradients from the kernels of the backward pass against torch's autograd in float64."""

import dataclasses

import pytest
import torch
from catalogue import ELASTIC
from shared import solid

from gaussian_swaying import (
    AeroForce,
    Box,
    MPMSolver,
    PinnedPoints,
    PinnedRegion,
    SineSway,
    WindField,
    WindForce,
)
from gaussian_swaying.aero.force import LAWS as WIND_LAWS
from gaussian_swaying.aero.force_adjoint_triton import wind_force_adjoint, wind_on_groups_adjoint
from gaussian_swaying.aero.patches import Patches, PatchSums
from gaussian_swaying.geometry.linalg_triton import load3, load9, read, store3, store9
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.damping import kelvin_voigt_pk1
from gaussian_swaying.mpm.laws.triton.body import BodyLaws, pk1_adjoint
from gaussian_swaying.mpm.triton import fused_total
from gaussian_swaying.mpm.triton.damping import kelvin_voigt_adjoint

WIDE = torch.float64


@pytest.fixture(autouse=True)
def _one_width(monkeypatch):
    """The number of lanes is a constant of the compiled kernel: the same for all bodies."""
    monkeypatch.setattr(fused_total, "_lanes", lambda sizes: 4)


def _random(seed, *shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=WIDE)


def _error(found, expected):
    """Largest difference, relative to the largest value."""
    return float((found.to(expected) - expected).abs().max()) / max(float(expected.abs().max()), 1e-30)


def _close(found, expected, tolerance, name=""):
    error = _error(found, expected)
    assert error <= tolerance, f"{name}: {error:.1e} of the largest value"


# ---- one function at a time, in float64 on a CPU


@triton.jit
def _law(F_in, Q_in, mu_in, lam_in, row, change_out, scalars, count, LAWS: tl.constexpr, BLOCK: tl.constexpr):
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < count
    mu, lam = tl.load(mu_in + k, mask, 1.0), tl.load(lam_in + k, mask, 1.0)
    change, by_mu, by_lam = pk1_adjoint(load9(F_in, 1, 9 * k, mask), load9(Q_in, 1, 9 * k, mask), mu, lam, row, LAWS)
    store9(change_out, 1, 9 * k, change, mask)
    tl.store(scalars + 2 * k, by_mu, mask)
    tl.store(scalars + 2 * k + 1, by_lam, mask)


@triton.jit
def _viscous(F_in, L_in, Q_in, by_F, by_rate, scalars, mu, lam, time, count, BLOCK: tl.constexpr):
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < count
    F, L, Q = load9(F_in, 1, 9 * k, mask), load9(L_in, 1, 9 * k, mask), load9(Q_in, 1, 9 * k, mask)
    one, two, by_mu, by_lam = kelvin_voigt_adjoint(F, L, Q, mu, lam, time)
    store9(by_F, 1, 9 * k, one, mask)
    store9(by_rate, 1, 9 * k, two, mask)
    tl.store(scalars + 2 * k, by_mu, mask)
    tl.store(scalars + 2 * k + 1, by_lam, mask)


@triton.jit
def _wind(
    F_in, v_in, patch_in, wind, numbers, a_in, table, by_F, by_v, parts, count,
    OPTIONS: tl.constexpr, FUNCTION: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    k = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = k < count
    F, v, n = load9(F_in, 1, 9 * k, mask), load3(v_in, 1, 3 * k, mask), load3(patch_in, 1, 4 * k, mask)
    patch = (n[0], n[1], n[2], tl.load(patch_in + 4 * k + 3, mask, 0.0))
    a = load3(a_in, 1, 3 * k, mask)
    one, two, by_wind, by_numbers = FUNCTION(F, v, patch, read(numbers, 0, 5), read(wind, 0, 3), table, a, OPTIONS)
    store9(by_F, 1, 9 * k, one, mask)
    store3(by_v, 1, 3 * k, two, mask)
    store3(parts, 1, 6 * k, by_wind, mask)
    store3(parts + 3, 1, 6 * k, by_numbers, mask)


def _deformed(count=200):
    """Deformation gradients, also inverted and crushed ones, without stretches that are nearly opposite."""
    F = torch.eye(3, dtype=WIDE) + 0.3 * _random(0, count, 3, 3)
    F[0] = torch.eye(3, dtype=WIDE)
    F[1] = torch.diag(torch.tensor([1.4, 1.4, 0.8], dtype=WIDE))
    F[2] = torch.diag(torch.tensor([1.2, 1.0, 0.02], dtype=WIDE))
    a = torch.linalg.svdvals(F)
    sign = torch.linalg.det(F).sign()[:, None]
    a = torch.cat([a[:, :2], a[:, 2:] * sign], 1)
    return F[(a[:, 1] + a[:, 2]) > 0.3]


def _tolerance(device, double, single):
    return (WIDE, double) if device.type == "cpu" else (torch.float32, single)


@pytest.mark.parametrize("name", ELASTIC)
def test_derivative_of_a_stress(name, kernel_device):
    """By F in a random direction, and by mu and lambda; mu and lambda in either order."""
    # the kernels have the limit of the logarithm in float32
    dtype, tolerance = _tolerance(kernel_device, 1e-7, 2e-4)
    F = _deformed().requires_grad_()
    mu = (4e3 * (1.5 + _random(2, len(F)).tanh())).requires_grad_()
    lam = (4e3 * (1.5 + _random(3, len(F)).tanh())).requires_grad_()
    Q = _random(1, len(F), 3, 3)
    expected = torch.autograd.grad((ELASTIC[name].pk1(F, mu, lam) * Q).sum(), [F, mu, lam])
    laws = BodyLaws([ELASTIC[name]])
    row = torch.tensor(laws.table, device=kernel_device, dtype=torch.float32)
    given = [t.detach().to(kernel_device, dtype).contiguous() for t in (F, Q, mu, lam)]
    change, scalars = torch.empty_like(given[0]), torch.empty(len(F), 2, device=kernel_device, dtype=dtype)
    block = lanes(kernel_device, 64)
    launch(_law, (triton.cdiv(len(F), block),))(*given, row, change, scalars, len(F), LAWS=laws, BLOCK=block)
    _close(change.cpu(), expected[0], tolerance, "F")
    _close(scalars[:, 0].cpu(), expected[1], tolerance, "mu")
    _close(scalars[:, 1].cpu(), expected[2], tolerance, "lambda")


def test_derivative_of_the_viscous_stress(kernel_device):
    """By F, its rate, mu and lambda."""
    dtype, tolerance = _tolerance(kernel_device, 1e-13, 1e-5)
    time = 2.0**-9  # numbers are passed in float32
    F, rate, Q = (_random(seed, 50, 3, 3).requires_grad_() for seed in range(3))
    mu, lam = (torch.full((50,), value, dtype=WIDE, requires_grad=True) for value in (4e3, 6e3))
    stress = kelvin_voigt_pk1(F, rate, mu, lam, time)
    expected = torch.autograd.grad((stress * Q).sum(), [F, rate, mu, lam])
    given = [t.detach().to(kernel_device, dtype) for t in (F, rate, Q)]
    found = [torch.empty_like(given[0]) for _ in range(2)]
    scalars = torch.empty(50, 2, device=kernel_device, dtype=dtype)
    launch(_viscous, (1,))(*given, *found, scalars, 4e3, 6e3, time, 50, BLOCK=64)
    for value, wanted in zip((*found, scalars[:, 0], scalars[:, 1]), expected, strict=True):
        _close(value.cpu(), wanted, tolerance)


@pytest.mark.parametrize("law", WIND_LAWS)
def test_derivative_of_the_wind(law, kernel_device):
    """By F, velocity, wind and coefficients, with a cap on the area."""
    dtype, tolerance = _tolerance(kernel_device, 1e-11, 1e-4)
    aero = AeroForce(0.6, 0.4, C_L=0.2, law=law, max_area_ratio=1.5)
    for coefficient in (aero.C_D, aero.C_F, aero.C_L):
        coefficient.requires_grad_()
    F = _deformed(80).requires_grad_()
    count = len(F)
    v, wind = _random(2, count, 3).requires_grad_(), torch.tensor([2.0, 5.0, 1.0], dtype=WIDE, requires_grad=True)
    normal = torch.nn.functional.normalize(_random(3, count, 3), dim=-1)
    area = 0.5 + torch.rand(count, dtype=WIDE)
    area[::7] = 0.0
    turned, grown = deform_patch(F, normal, area)
    force = aero(wind, v, turned, torch.minimum(grown, 1.5 * area))
    a = _random(4, count, 3)
    leaves = [F, v, wind, aero.C_D, aero.C_F, aero.C_L]
    expected = torch.autograd.grad((force * a).sum(), leaves)
    numbers = torch.tensor([0.6, 0.4, 0.2, 0.5 * 1.225, 1.5], dtype=WIDE)
    patch = torch.cat([normal, area[:, None]], 1)
    given = [t.detach().to(kernel_device, dtype).contiguous() for t in (F, v, patch, wind, numbers, a, numbers)]
    options = (WIND_LAWS.index(law), False)
    _check_wind(given, options, wind_force_adjoint, expected, tolerance)


def _check_wind(given, options, function, expected, tolerance):
    """The gradients of a . f by F, velocity, wind and coefficients."""
    count = len(given[0])
    by_F, by_v, parts = (torch.empty_like(given[0]), torch.empty_like(given[1]), given[1].new_empty(count, 6))
    block = lanes(by_F.device, 64)
    launch(_wind, (triton.cdiv(count, block),))(
        *given, by_F, by_v, parts, count, OPTIONS=options, FUNCTION=function, BLOCK=block
    )
    _close(by_F.cpu(), expected[0], tolerance, "F")
    _close(by_v.cpu(), expected[1], tolerance, "velocity")
    sums = parts.cpu().double().sum(0)
    _close(sums[:3], expected[2], tolerance, "wind")
    _close(sums[3:], torch.stack(expected[3:]), tolerance, "coefficients")


@pytest.mark.parametrize("law", WIND_LAWS)
def test_derivative_of_the_wind_on_groups(law, kernel_device):
    """Points with no, one and several patches."""
    dtype, tolerance = _tolerance(kernel_device, 1e-11, 1e-4)
    aero = AeroForce(0.6, 0.4, C_L=0.2, law=law, max_area_ratio=1.2)
    for coefficient in (aero.C_D, aero.C_F, aero.C_L):
        coefficient.requires_grad_()
    F = _deformed(60).requires_grad_()
    count = len(F)
    v, wind = _random(2, count, 3).requires_grad_(), torch.tensor([2.0, 5.0, 1.0], dtype=WIDE, requires_grad=True)
    sums = PatchSums(_patches(count, WIDE))
    force, _ = aero.on_groups(wind, v, F, sums)
    a = _random(4, count, 3)
    expected = torch.autograd.grad((force * a).sum(), [F, v, wind, aero.C_D, aero.C_F, aero.C_L])
    numbers = torch.tensor([0.6, 0.4, 0.2, 0.5 * 1.225, 1.2], dtype=WIDE)
    place = torch.nn.functional.pad(sums.lists(), (0, 2))
    given = [t.detach().to(kernel_device, dtype).contiguous() for t in (F, v, place, wind, numbers, a, sums.table())]
    _check_wind(given, (WIND_LAWS.index(law), False), wind_on_groups_adjoint, expected, tolerance)


def _patches(count, dtype):
    """Up to five patches for each point, of all directions, and none for every fourth."""
    point = torch.arange(5 * count) % count
    point = point[point % 4 > 0]
    normal = torch.nn.functional.normalize(_random(3, len(point), 3), dim=-1)
    area = 0.005 * (1.5 + _random(6, len(point)).tanh())
    return Patches(normal.to(dtype), area.to(dtype), point, count)


# ---- whole rollouts

DX, DT = 0.1, 1e-3
INPUTS = ("velocity", "youngs_modulus", "poisson_ratio", "density", "volume", "flow", "C_D", "C_F", "C_L")


def _place(batch=()):
    """A sheet whose outermost nodes have mass enough: the inverse of a vanishing mass would make all errors large."""
    axes = [DX * torch.arange(*axis, dtype=WIDE) for axis in ((1.0, 3.1, 0.5), (1.0, 2.1, 0.5), (1.0, 1.1, 1.0))]
    place = torch.cartesian_prod(*axes)
    return place + 2e-3 * torch.rand(*batch, *place.shape, generator=torch.Generator().manual_seed(0), dtype=WIDE)


def _gradients(
    device, dtype, transfer, law, *, steps=4, checkpoint=2, batch=(), wind=True, groups=False, damped=False, **settings
):
    """Gradients of a mixture of all fields at the end by every input, by name, and that mixture."""
    place = _place(batch)
    values = {
        "velocity": _random(1, *place.shape),
        "youngs_modulus": 1e4 * (1.2 + 0.2 * _random(5, *place.shape[:-1]).tanh()),
        "poisson_ratio": torch.tensor(0.3, dtype=WIDE),
        "density": 80 * (1.2 + 0.2 * _random(7, *place.shape[:-1]).tanh()),
        "volume": torch.tensor(1e-4, dtype=WIDE),
    }
    values = {name: value.to(device, dtype).requires_grad_() for name, value in values.items()}
    points = solid(
        place.to(device, dtype),
        values["volume"],
        values["density"],
        values["youngs_modulus"],
        values["poisson_ratio"],
        law=law,
        law_index=torch.arange(place.shape[-2]) % len(law) if isinstance(law, list) else None,
        damping=30 * _random(9, *place.shape[:-1]).abs().to(device, dtype) if damped else None,
    )
    solver = MPMSolver(**{"dx": DX, "transfer": transfer, **settings})
    state = solver.init_state(points, values["velocity"])
    forces = []
    if wind:
        field = WindField([2.0, 5.0, 1.0], modulations=[SineSway()]).to(device)
        aero = AeroForce(0.6, 0.4, C_L=0.2).to(device)
        leaves = {"flow": field.flows, "C_D": aero.C_D, "C_F": aero.C_F, "C_L": aero.C_L}
        values |= {name: leaf.requires_grad_() for name, leaf in leaves.items()}
        normal = torch.nn.functional.normalize(_random(3, *place.shape), dim=-1).to(device, dtype)
        area = 0.02 * torch.rand(place.shape[:-1], generator=torch.Generator().manual_seed(4), dtype=WIDE)
        patches = [_patches(place.shape[-2], dtype).to(device)] if groups else [normal, area.to(device, dtype)]
        forces = [WindForce(aero, field, *patches)]
    state = solver.rollout(state, DT, steps, forces, checkpoint)
    fields = ("position", "velocity", "F_total", "affine", "node_displacement", "node_velocity")
    weights = [1.0, 1e-2, 0.3, 1e-3, 1.0, 1e-2]
    loss = 0.0
    for k, (name, weight) in enumerate(zip(fields, weights, strict=True)):
        value = getattr(state, name)
        loss = loss + weight * (value * _random(20 + k, *value.shape).to(value)).sum()
    found = torch.autograd.grad(loss, list(values.values()))
    return dict(zip(values, (g.cpu().double() for g in found), strict=True)) | {"loss": loss.detach().cpu().double()}


def _compare(device, law, tolerance=3e-4, left_out=(), **settings):
    """The kernels in float32 against torch's autograd in float64; what is left out does not change anything.

    A failure names the errors of all gradients, with those of torch's autograd in float32 beside them.
    """
    expected = _gradients(torch.device("cpu"), WIDE, "torch", law, **settings)
    found = _gradients(device, torch.float32, "kernels", law, **settings)
    assert found.keys() == expected.keys()
    names = [name for name in expected if name not in left_out]
    for name in names:
        assert float(expected[name].abs().max()) > 0, name
    errors = {name: _error(found[name], expected[name]) for name in names}
    if not all(error <= tolerance for error in errors.values()):
        torchs = _gradients(device, torch.float32, "torch", law, **settings)
        rows = [f"{name}: {errors[name]:.1e} (torch: {_error(torchs[name], expected[name]):.1e})" for name in names]
        pytest.fail(f"above {tolerance:.0e} of the largest value: " + ", ".join(rows))


def _pin(kind):
    return PinnedRegion(Box([None, None, None], [0.12, None, None]), kind=kind)


SEVERAL = [ELASTIC["corotated"], ELASTIC["neo-hookean"]]
ROLLOUTS = {  # by everything that a fit may seek; with 5 substeps, segments of two and a shorter last one
    **{name: lambda name=name: (ELASTIC[name], {"steps": 5, "damping": 0.5}) for name in ELASTIC},
    "viscosity, rates and two laws": lambda: (SEVERAL, {"stiffness_damping": 2e-3, "damped": True}),
    # held nodes, points and slopes; the gradient by the density goes through what held points weigh, too
    **{kind: lambda kind=kind: (SEVERAL[0], {"boundaries": [_pin(kind)]}) for kind in ("nodes", "hinge", "clamp")},
    # nodes that are held, and moved by a held point as well
    "pins of both kinds": lambda: (
        SEVERAL[0],
        {
            "boundaries": [
                PinnedRegion(Box([None, None, None], [0.12, 0.12, None])),
                PinnedPoints([[0.15, 0.15, 0.07]]),
            ]
        },
    ),
    "two scenes in one wind": lambda: (SEVERAL[0], {"batch": (2,), "boundaries": [_pin("hinge")]}),
    "groups of patches": lambda: (SEVERAL[0], {"groups": True}),
}


@pytest.mark.slow(gate=[f"cpu-{name}" for name in ROLLOUTS if name not in ("neo-hookean", "springs", "hinge")])
@pytest.mark.parametrize("name", ROLLOUTS)
def test_gradients_of_a_rollout(name, kernel_device):
    law, settings = ROLLOUTS[name]()
    _compare(kernel_device, law, **settings)


def test_gradients_without_wind(kernel_device):
    """No force at all: nothing is gathered but F."""
    _compare(kernel_device, ELASTIC["corotated"], wind=False, left_out=("volume",))


def test_gradients_where_cells_are_cut(kernel_device, monkeypatch):
    """Crowded cells are cut into pieces, whose sums are joined."""
    monkeypatch.setattr(fused_total, "_lanes", lambda sizes: 2)
    _compare(kernel_device, ELASTIC["corotated"], steps=3)


# ---- what is left to torch


def _refused(solver, state, forces=(), match=""):
    """The kernels say why they do not compute a gradient."""
    with pytest.raises(ValueError, match=f"`transfer: kernels` has no gradients here, because .*{match}"):
        solver.rollout(state, DT, 1, list(forces))


def _free(device, **settings):
    """A solver of a sheet and its first state, whose nodal velocity requires a gradient."""
    place = _place().to(device, torch.float32)
    points = solid(place, 1e-4, 80.0)
    solver = MPMSolver(dx=DX, transfer="kernels", **settings)
    state = solver.init_state(points)
    return solver, state.replace(node_velocity=state.node_velocity.clone().requires_grad_())


def test_kernels_refuse_what_they_do_not_cover(kernel_device):
    """Nothing is silently left out of a gradient: with `transfer: auto` torch computes these."""
    solver, state = _free(kernel_device)
    count = state.position.shape[0]
    normal, area = torch.zeros(count, 3, device=kernel_device), torch.ones(count, device=kernel_device)
    normal[:, 1] = 1.0
    wind = WindField([1.0, 0.0, 0.0]).to(kernel_device)

    def force(*patches, **settings):
        return WindForce(AeroForce(**settings).to(kernel_device), wind, *patches)

    load = force(normal, area)
    assert solver.rollout(state, DT, 1, load).position.requires_grad
    _refused(solver, state, [load, load], "one force")
    _refused(solver, state, [force(normal, area, drag_step="semi_implicit")], "no backward kernel")
    _refused(solver, state, [force(normal, area.clone().requires_grad_())], "patches")
    leaf = state.replace(F_elastic=state.F_elastic.clone().requires_grad_())
    _refused(solver, leaf, match="inputs of their own")
    alone = leaf.replace(node_velocity=state.node_velocity.detach())
    _refused(solver, alone, match="the nodal ones do not")
    late = PinnedRegion(Box([None, None, None], [0.12, None, None]), start=DT)
    _refused(*_free(kernel_device, boundaries=[late]), match="pins that hold all the time")
    floor = Plane([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    ball = BallObstacle([0.2, 0.15, -0.1], 0.05)
    for boundary in (floor, ball):
        _refused(*_free(kernel_device, boundaries=[boundary]), match="pins that hold all the time, and contact")
    place = solver.points.position.clone().requires_grad_()
    solver.init_state(dataclasses.replace(solver.points, position=place))
    _refused(solver, state, match="rest positions")
