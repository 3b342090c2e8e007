"""Lists of forces: valid types, sums, work and gradients; ``kernels/test_forces.py`` is for the fused substep."""

import pytest
import torch
from shared import ZERO, double, in_both, longest, near, peak, rand, randn, seeded, solid, unit, value_error
from torch.testing import assert_close

from gaussian_swaying import AeroForce, Force, MPMSolver, WindField, WindForce
from gaussian_swaying.mpm.forces import FunctionForce, as_forces

DT = 1e-3


class Spring(Force):
    """Pulls every particle to a place, with a drag if requested."""

    recordable = True

    def __init__(self, stiffness=3.0, resistance=None):
        super().__init__()
        self.stiffness = torch.nn.Parameter(double(float(stiffness)))
        self.resistance = resistance

    def forward(self, state):
        pull = -self.stiffness * state.position
        if self.resistance is None:
            return pull
        drag = torch.full_like(state.position[..., 0], self.resistance)
        return pull - drag[..., None] * state.velocity, drag


def _setting(formulation="total", batch=(), **options):
    generator = seeded(0)
    position = 0.3 * rand(*batch, 20, 3, generator=generator)
    points = solid(position, 1e-4, 50.0)
    solver = MPMSolver(0.1, formulation, transfer="torch", **options)
    velocity = randn(*batch, 20, 3, generator=generator)
    normal = unit(*batch, 20, 3, generator=generator)
    wind = WindForce(AeroForce(), WindField([4.0, 0.0, 1.0]), normal, torch.full(position.shape[:-1], 0.01))
    return solver, solver.init_state(points, velocity), wind


def _push(state):
    return 0.2 * torch.ones_like(state.position)


@in_both
@pytest.mark.parametrize("batch", [(), (2,)])
@torch.no_grad()
def test_forces_add_up(formulation, batch):
    """A rollout with several forces equals a rollout with their sum; so does a single step."""
    solver, start, wind = _setting(formulation, batch)
    forces = [wind, Spring(2.0, 0.4), _push, Spring()]
    state = start
    for _ in range(4):
        force = drag = 0.0
        for given in (part(state) for part in forces):
            value, resistance = given if isinstance(given, tuple) else (given, None)
            force, drag = force + value, drag if resistance is None else drag + resistance
        state = solver.step(state, DT, force=force, drag=drag)
    several = solver.rollout(start, DT, 4, forces)
    watched, _ = solver.watched_rollout(start, DT, 4, forces, looks=2)
    stepped = start
    for _ in range(4):
        stepped = solver.step(stepped, DT, forces)
    for other in (several, watched, stepped):
        near(other.position, state.position, 1e-12)
        assert_close(other.work, state.work)
    for k in range(len(forces)):  # each of them has an effect
        fewer = solver.rollout(start, DT, 4, forces[:k] + forces[k + 1 :])
        assert peak(fewer.velocity - state.velocity) > 1e-5


@torch.no_grad()
def test_a_force_that_is_given_to_a_step_is_added_to_the_others():
    solver, start, wind = _setting()
    given = torch.randn_like(start.position)
    wind_now, _ = wind(start)
    expected = solver.step(start, DT, force=wind_now + given)
    assert torch.equal(solver.step(start, DT, wind, force=given).velocity, expected.velocity)


@pytest.mark.parametrize("checkpoint", [0, 2])
def test_gradients_reach_a_force(checkpoint):
    solver, start, wind = _setting()
    spring = Spring(3.0, 0.2)

    def final():
        return solver.rollout(start, DT, 6, [wind, spring], checkpoint).position.square().sum()

    (found,) = torch.autograd.grad(final(), spring.stiffness)
    with torch.no_grad():
        ends = []
        for change in (1e-4, -1e-4):
            spring.stiffness += change
            ends.append(final())
            spring.stiffness -= change
    assert float(found) == pytest.approx(float(ends[0] - ends[1]) / 2e-4, rel=1e-6)


def test_what_is_no_force_is_named():
    solver, start, wind = _setting()
    with pytest.raises(TypeError, match=r"`forces` to be Force objects or functions.*got Tensor.*`force`"):
        solver.step(start, DT, torch.zeros(20, 3))
    with pytest.raises(TypeError, match="got float"):
        solver.rollout(start, DT, 1, [wind, 3.0])
    with value_error(r"`force of FunctionForce` of shape \(20, 3\), but got \(3,\)"):
        solver.rollout(start, DT, 1, lambda state: state.position[0])
    spring = Spring()
    spring.forward = lambda state: (state.position, torch.ones(3))
    with value_error(r"`resistance of Spring` of shape \(20,\)"):
        solver.rollout(start, DT, 1, spring)
    with pytest.raises(TypeError, match=r"`force of FunctionForce` to be a torch\.Tensor, but got NoneType"):
        solver.rollout(start, DT, 1, lambda state: None)


def test_a_force_says_for_itself_whether_it_can_be_recorded():
    class Own(Spring):
        def forward(self, state):
            return float(state.time) * state.position

    assert Spring().recordable
    assert not Own().recordable
    assert not FunctionForce(_push).recordable
    assert isinstance(as_forces(_push)[0], FunctionForce)


# ---- wind that depends on the place


# ---- drag at the end of the substep: unconditionally stable, and without effect if nothing moves


AERO = AeroForce(C_D=1.2, C_F=0.0, C_L=0.0, drag_step="semi_implicit")


def _sheet(areal, e=1e4):
    """A sheet in the x-z plane, areal density in kg/m²."""
    x = (torch.arange(8).double() + 0.5) * 0.05
    gx, gz = (g.reshape(-1) for g in torch.meshgrid(x, x, indexing="ij"))
    position = torch.stack([gx, torch.full_like(gx, 0.02), gz], dim=-1)
    return solid(position, 0.05**2 * 0.01, areal / 0.01, e, 0.0)


def _run(solver, state, wind, dt, steps, aero=AERO):
    wind = double(wind)
    normal = double([0.0, 1.0, 0.0]).expand_as(state.position)
    area = torch.full_like(solver.points.mass, 0.05**2)
    fastest = 0.0
    for k in range(steps):
        force = aero(wind, state.velocity, normal, area)
        drag = aero.resistance(wind, state.velocity, area)
        state = solver.fit_grid(state, min(20, steps) * dt) if k % 20 == 0 else state
        state = solver.step(state, dt, force=force, drag=drag)
        fastest = max(fastest, float(longest(state.velocity)))
    return state, fastest


@in_both
@pytest.mark.parametrize("dt", [1e-4, 1e-2, 0.1])
def test_one_step_is_the_implicit_one(formulation, dt):
    """v+ = (v + k u) / (1 + k), k = dt rho A C v_r / 2m, for a free sheet in a wind too strong for explicit steps."""
    points = _sheet(0.02, e=1.0)  # soft, or the long substeps would be refused; a free sheet does not deform
    solver = MPMSolver(0.1, formulation, gravity=ZERO)
    velocity = double([0.0, -10.0, 0.0]).expand_as(points.position)
    state, _ = _run(solver, solver.init_state(points, velocity), [0.0, 30.0, 0.0], dt, 1)
    k = dt * 1.225 * 1.2 * 40.0 / (2 * 0.02)
    expected = (-10.0 + k * 30.0) / (1 + k)
    torch.testing.assert_close(state.velocity[:, 1], torch.full_like(points.mass, expected))
