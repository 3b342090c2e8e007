import pytest
import torch
from shared import EYE, ZERO, beyond, double, peak, rand, randn, seeded, solid
from torch.testing import assert_close

from gaussian_swaying import MPMSolver, PinnedRegion, aero_force
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.mpm.laws.elastic import FixedCorotated, NeoHookean
from gaussian_swaying.mpm.transfer import bspline_stencil, scatter

STEPS, DT, DX, COUNT = 5, 8e-3, 0.15, 15
FORMULATIONS = "total", "updated"
LAWS = {"fixed_corotated": FixedCorotated, "neo_hookean": NeoHookean}


def _rest():
    """A slanting patch of particles, none of them near a plane of half cells, to be held at its upper edge."""
    generator = seeded(4)
    x, z = torch.meshgrid(torch.arange(3) * 0.09 + 0.03, torch.arange(5) * 0.09 + 0.02, indexing="ij")
    position = torch.stack([x, 0.11 + 0.3 * x, z], dim=-1).reshape(-1, 3).double()
    position = position + 0.02 * rand(COUNT, 3, generator=generator)
    return position, 0.5 * randn(COUNT, 3, generator=generator)


REST, VELOCITY = _rest()
HELD = REST[:, 2] > 0.35
INPUTS = {  # the scale of each input, so that a derivative gives the effect of a relative change
    "position": (REST, DX),
    "velocity": (VELOCITY, 1.0),
    "youngs_modulus": (4e3, 4e3),
    "poisson_ratio": (0.3, 0.3),
    "density": (40.0, 40.0),
    "wind": (double([2.0, 5.0, 1.0]), 5.0),
    "C_D": (0.6, 0.6),
    "C_F": (0.4, 0.4),
    "C_L": (0.2, 0.2),
}


def _leaf(name):
    value, scale = INPUTS[name]
    return (torch.as_tensor(value, dtype=torch.float64) / scale).clone().requires_grad_()


def _patches():
    normal = double([-0.3, 1.0, 0.1]).expand(COUNT, 3)
    return normal / normal.norm(dim=-1, keepdim=True), torch.full((COUNT,), 0.09**2, dtype=torch.float64)


def _start(values, law, **settings):
    points = solid(
        values["position"],
        0.09**2 * 0.01,
        values["density"],
        values["youngs_modulus"],
        values["poisson_ratio"],
        law=law,
        law_index=None if isinstance(law, FixedCorotated | NeoHookean) else torch.arange(COUNT) % 2,
    )
    solver = MPMSolver(DX, boundaries=[PinnedRegion(beyond(z=0.35))], **settings)
    state = solver.init_state(points, values["velocity"])
    rest_normal, rest_area = (value.to(values["position"].dtype) for value in _patches())

    def force(state):
        normal, area = deform_patch(state.F_total, rest_normal, rest_area)
        coefficients = {"drag": values["C_D"], "friction": values["C_F"], "lift": values["C_L"]}
        return aero_force(values["wind"], state.velocity, normal, area, **coefficients)

    return solver, state, force


def _values(name=None, leaf=None):
    """All inputs in SI units, one of them from a scaled leaf."""
    values = {key: torch.as_tensor(value, dtype=torch.float64) for key, (value, _) in INPUTS.items()}
    if name is not None:
        values[name] = leaf * INPUTS[name][1]
    return values


def _check(name, law, **settings):
    """Five substeps against central differences, and the gradient must not vanish."""
    generator = seeded(5)
    weights = randn(4, 12 * COUNT, generator=generator)

    def run(leaf):
        solver, state, force = _start(_values(name, leaf), law, **settings)
        state = solver.rollout(state, DT, STEPS, force)
        return torch.cat([state.position, state.F_total.flatten(-2)], dim=-1).flatten()

    leaf = _leaf(name)
    # in full for a few numbers and four mixtures of the outputs, otherwise along one random direction
    few = leaf.numel() <= 3
    checked = (lambda leaf: weights @ run(leaf)) if few else run
    assert torch.autograd.gradcheck(checked, leaf, eps=1e-6, atol=1e-8, rtol=1e-5, fast_mode=not few)
    gradient = torch.autograd.grad(weights @ run(leaf), leaf, torch.ones(4).double())[0]
    # the tolerance above would accept a detached path if its gradient is this small
    assert peak(gradient) > 1e-4, f"The gradient by {name} vanishes: {gradient}"
    if name in ("position", "velocity"):
        assert (gradient.abs().amax(-1) > 1e-6)[~HELD].all()


@pytest.mark.slow(gate=[f"{name}-{few}" for few in ("total-neo_hookean", "updated-fixed_corotated") for name in INPUTS])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("setting", FORMULATIONS)
@pytest.mark.parametrize("name", INPUTS)
def test_gradient_of_five_substeps(name, setting, law):
    _check(name, LAWS[law](), formulation=setting)


@pytest.mark.parametrize("setting", FORMULATIONS)
@pytest.mark.parametrize("name", ["position", "youngs_modulus", "poisson_ratio"])
def test_gradient_with_damping_and_two_laws(name, setting):
    _check(name, [FixedCorotated(), NeoHookean()], damping=2.0, stiffness_damping=2e-3, formulation=setting)


@pytest.mark.parametrize("case", ["at rest", "light node"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("setting", FORMULATIONS)
def test_gradients_are_finite(setting, law, case):
    """F = I exactly, no motion, no wind, no weight; and a node whose mass is so small that the square of its inverse
    overflows in float32.
    """
    still = case == "at rest"
    values = {name: 0 * value if still and name in ("velocity", "wind") else value for name, value in _values().items()}
    if not still:
        values = {name: value.float() for name, value in values.items()}
        values["position"] = values["position"].clone()
        values["position"][0] = torch.tensor([0.075] * 3) - 1e-3 * DX  # its farthest node has half the cube of 1e-6
    values = {name: value.clone().requires_grad_() for name, value in values.items()}
    gravity = (0.0, 0.0, 0.0) if still else (0.0, 0.0, -9.8)
    solver, state, force = _start(values, LAWS[law](), gravity=gravity, formulation=setting)
    if not still:
        stencil = bspline_stencil(values["position"].detach(), state.grid)
        mass = scatter(stencil, solver.points.mass.detach()[:, None, None])[:, 0]
        assert 1e-32 < mass[mass > 0].min() < 5e-20
    state = solver.rollout(state, 1e-3, STEPS, force)
    loss = state.position.square().sum() + state.F_total.square().sum()
    for name, gradient in zip(values, torch.autograd.grad(loss, list(values.values())), strict=True):
        assert torch.isfinite(gradient).all(), name
        # the state at rest depends on place and velocity alone, as drag is quadratic
        alike = still and name not in ("position", "velocity")
        assert float(peak(gradient)) < 1e-12 if alike else float(peak(gradient)) > 0, name
    if still:
        assert peak(state.F_total.detach() - EYE) < 1e-14


# ---- long rollouts


@pytest.mark.parametrize("checkpoint", [0, 7, 30])
def test_checkpoints_find_what_is_used_late(checkpoint):
    points = solid(rand(8, 3), 0.1, 10.0, 1e3)
    first, second = (torch.zeros(3, dtype=torch.float64, requires_grad=True) for _ in range(2))
    solver = MPMSolver(0.5, gravity=ZERO)
    state = solver.rollout(
        solver.init_state(points),
        1e-3,
        20,
        lambda s: (first if float(s.time) < 5.5e-3 else 2 * second).expand(8, 3),
        checkpoint,
    )
    state.position.sum().backward()
    assert not state.time.requires_grad
    # a uniform force on particles of 1 kg that are at rest: each moves by dt² for every substep that is left
    ways = [1e-6 * sum(20 - n for n in steps) for steps in (range(6), range(6, 20))]
    assert_close(first.grad, torch.full((3,), 8 * ways[0], dtype=torch.float64))
    assert_close(second.grad, torch.full((3,), 16 * ways[1], dtype=torch.float64))
