"""Gradients from the kernels of the backward pass against torch's autograd in float64."""

import dataclasses
from itertools import cycle

import pytest
import torch
from catalogue import ELASTIC
from shared import double, normalized, peak, rand, randn, seeded, solid, up_to, value_error

from gaussian_swaying import (
    AeroForce,
    MPMSolver,
    PinnedPoints,
    PinnedRegion,
    SineSway,
    WindField,
    WindForce,
)
from gaussian_swaying.geometry.regions import HalfSpace, Sphere
from gaussian_swaying.mpm import total
from gaussian_swaying.mpm.colliders import Obstacle, Wall
from gaussian_swaying.wind.force import LAWS as WIND_LAWS
from gaussian_swaying.wind.patches import Patches

WIDE = torch.float64


def _random(seed, *shape):
    return randn(*shape, generator=seeded(seed))


def _error(found, expected):
    return float(peak(found.to(expected) - expected)) / max(float(peak(expected)), 1e-30)


def _patches(count, dtype):
    point = torch.arange(5 * count) % count
    point = point[point % 4 > 0]
    normal = normalized(_random(3, len(point), 3))
    area = 0.005 * (1.5 + _random(6, len(point)).tanh())
    return Patches(normal.to(dtype), area.to(dtype), point, count)


DX, DT = 0.1, 1e-3


def _place(batch=()):
    """A sheet whose outermost nodes have mass enough: the inverse of a vanishing mass would make all errors large."""
    axes = [DX * torch.arange(*axis).double() for axis in ((1.0, 3.1, 0.5), (1.0, 2.1, 0.5), (1.0, 1.1, 1.0))]
    place = torch.cartesian_prod(*axes)
    return place + 2e-3 * rand(*batch, *place.shape, generator=seeded(0))


def _gradients(
    device,
    dtype,
    transfer,
    law,
    *,
    steps=4,
    batch=(),
    wind=(),
    groups=False,
    damped=False,
    bends=False,
    attached=False,
    **settings,
):
    place = _place(batch)
    values = {
        "velocity": _random(1, *place.shape),
        "youngs_modulus": 1e4 * (1.2 + 0.2 * _random(5, *place.shape[:-1]).tanh()),
        "poisson_ratio": double(0.3),
        "density": 80 * (1.2 + 0.2 * _random(7, *place.shape[:-1]).tanh()),
        "volume": double(1e-4),
    }
    if bends:
        values["bending"] = 1e-3 * (1.2 + 0.2 * _random(10, *place.shape[:-1]).tanh())
    values = {name: value.to(device, dtype).requires_grad_() for name, value in values.items()}
    upright = torch.zeros(place.shape, device=device, dtype=dtype)
    upright[..., 2] = 1.0
    points = solid(
        place.to(device, dtype),
        values["volume"],
        values["density"],
        values["youngs_modulus"],
        values["poisson_ratio"],
        law=law,
        law_index=torch.arange(place.shape[-2]) % len(law) if isinstance(law, list) else None,
        damping=30 * _random(9, *place.shape[:-1]).abs().to(device, dtype) if damped else None,
        **({"normal": upright, "bending": values["bending"]} if bends else {}),
        attached=torch.arange(place.shape[-2], device=device) % 2 if attached else None,
    )
    solver = MPMSolver(**{"dx": DX, "transfer": transfer, **settings})
    state = solver.init_state(points, values["velocity"])
    strained = 0.2 * DX * _random(8, *state.node_displacement.shape).to(state.position)
    state = solver.bound.in_shape(solver.bound.read_particles(state, strained, state.node_velocity))
    forces = []
    if wind is not None:
        field = WindField([2.0, 5.0, 1.0], modulations=[SineSway()]).to(device)
        aero = AeroForce(0.6, 0.4, C_L=0.2, **dict(wind)).to(device)
        leaves = {"flow": field.flows, "C_D": aero.C_D, "C_F": aero.C_F, "C_L": aero.C_L}
        values |= {name: leaf.requires_grad_() for name, leaf in leaves.items()}
        normal = normalized(_random(3, *place.shape)).to(device, dtype)
        area = 0.02 * rand(place.shape[:-1], generator=seeded(4))
        patches = [_patches(place.shape[-2], dtype).to(device)] if groups else [normal, area.to(device, dtype)]
        forces = [WindForce(aero, field, *patches)]
    state = solver.rollout(state, DT, steps, forces, 2)
    fields = ("position", "velocity", "F_total", "affine", "node_displacement", "node_velocity")
    weights = [1.0, 1e-2, 0.3, 1e-3, 1.0, 1e-2]
    loss = 0.0
    for k, (name, weight) in enumerate(zip(fields, weights, strict=True)):
        value = getattr(state, name)
        loss = loss + weight * (value * _random(20 + k, *value.shape).to(value)).sum()
    found = torch.autograd.grad(loss, list(values.values()))
    return dict(zip(values, (g.cpu().double() for g in found), strict=True)) | {"loss": loss.detach().cpu().double()}


def _compare(device, law, left_out=(), **settings):
    """The kernels, on a GPU in float32, against torch's autograd in float64; what is left out does not change anything.

    A failure names the errors of all gradients, with those of torch's autograd in the same precision beside them.
    """
    dtype, tolerance = (WIDE, 1e-9) if device.type == "cpu" else (torch.float32, 3e-4)
    expected = _gradients(torch.device("cpu"), WIDE, "torch", law, **settings)
    found = _gradients(device, dtype, "kernels", law, **settings)
    assert found.keys() == expected.keys()
    names = [name for name in expected if name not in left_out]
    for name in names:
        assert peak(expected[name]) > 0, name
    errors = {name: _error(found[name], expected[name]) for name in names}
    if not all(error <= tolerance for error in errors.values()):
        torchs = _gradients(device, dtype, "torch", law, **settings)
        rows = [f"{name}: {errors[name]:.1e} (torch: {_error(torchs[name], expected[name]):.1e})" for name in names]
        pytest.fail(f"above {tolerance:.0e} of the largest value: " + ", ".join(rows))


def _pin(kind):
    return PinnedRegion(up_to(x=0.12), kind=kind)


SEVERAL = [ELASTIC["corotated"], ELASTIC["neo-hookean"]]
ROLLOUTS = {  # by everything that a fit may seek; with 5 substeps, segments of two and a shorter last one
    **{
        name: lambda name=name, wind=wind: (
            ELASTIC[name],
            {"steps": 5, "damping": 0.5, "wind": {"law": wind, "max_area_ratio": 1.2}},
        )
        for name, wind in zip(ELASTIC, cycle(WIND_LAWS))
    },
    "viscosity, rates and two laws": lambda: (SEVERAL, {"stiffness_damping": 2e-3, "damped": True}),
    # held nodes, points and slopes; the gradient by the density goes through what held points weigh, too
    **{kind: lambda kind=kind: (SEVERAL[0], {"boundaries": [_pin(kind)]}) for kind in ("nodes", "hinge", "clamp")},
    # nodes that are held, and moved by a held point as well
    "pins of both kinds": lambda: (
        SEVERAL[0],
        {
            "boundaries": [
                PinnedRegion(up_to(x=0.12, y=0.12)),
                PinnedPoints([[0.15, 0.15, 0.07]]),
            ]
        },
    ),
    "sheets that bend": lambda: (SEVERAL, {"bends": True, "boundaries": [_pin("clamp")], "stiffness_damping": 2e-3}),
    "virtual nodes": lambda: (SEVERAL[0], {"attached": True, "boundaries": [_pin("hinge")]}),
    "two scenes in one wind": lambda: (SEVERAL[0], {"batch": (2,), "boundaries": [_pin("hinge")]}),
    **{
        f"groups of patches, {wind}": lambda wind=wind: (
            SEVERAL[0],
            {"groups": True, "wind": {"law": wind, "max_area_ratio": 1.2}},
        )
        for wind in WIND_LAWS
    },
}


@pytest.mark.slow(gate=[f"cpu-{name}" for name in ROLLOUTS if "paper" not in name and name != "hinge"])
@pytest.mark.parametrize("name", ROLLOUTS)
def test_gradients_of_a_rollout(name, kernel_device):
    law, settings = ROLLOUTS[name]()
    _compare(kernel_device, law, **settings)


def test_gradients_without_wind(kernel_device):
    _compare(kernel_device, ELASTIC["corotated"], wind=None, left_out=("volume",))


def test_gradients_where_cells_are_cut(kernel_device, monkeypatch):
    monkeypatch.setattr(total, "_lanes", lambda sizes: 2)
    _compare(kernel_device, ELASTIC["corotated"], steps=3)


# ---- what is left to torch


def _refused(solver, state, forces=(), match=""):
    with value_error(f"`transfer: kernels` has no gradients here, because .*{match}"):
        solver.rollout(state, DT, 1, list(forces))


def _free(device, **settings):
    place = _place().to(device, torch.float32)
    points = solid(place, 1e-4, 80.0)
    solver = MPMSolver(DX, transfer="kernels", **settings)
    state = solver.init_state(points)
    return solver, state.replace(node_velocity=state.node_velocity.clone().requires_grad_())


def test_kernels_refuse_what_they_do_not_cover(kernel_device):
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
    late = PinnedRegion(up_to(x=0.12), start=DT)
    _refused(*_free(kernel_device, boundaries=[late]), match="pins that hold all the time")
    floor = Wall(HalfSpace([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]))
    ball = Obstacle(Sphere([0.2, 0.15, -0.1], 0.05))
    for boundary in (floor, ball):
        _refused(*_free(kernel_device, boundaries=[boundary]), match="pins that hold all the time, and contact")
    place = solver.points.position.clone().requires_grad_()
    solver.init_state(dataclasses.replace(solver.points, position=place))
    _refused(solver, state, match="rest positions")
