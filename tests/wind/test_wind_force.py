"""The wind as a load: what it gives at each substep, and that a rollout in it is the one with its forces."""

import math

import pytest
import torch
from shared import double, solid, unit
from torch.testing import assert_close

from gaussian_swaying import (
    AeroForce,
    MPMSolver,
    SpatialWind,
    UniformGust,
    WindField,
    WindForce,
)
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.wind.effects import PowerProfile
from gaussian_swaying.wind.field import FlowKey
from gaussian_swaying.wind.force import Places
from gaussian_swaying.wind.turbulence import Turbulence

DT = 1e-3
GUSTS = WindField([3.0, 1.0, 0.0], modulations=[UniformGust(0.5, interval=1.5 * DT)])
RISING = WindField(schedule=[FlowKey(0.0, [0.0] * 3), FlowKey(4 * DT, [0.0, 20.0, 0.0])], interpolation="linear")


def _setting(batch=(), wind=GUSTS, formulation="total", **settings):
    generator = torch.Generator().manual_seed(0)
    position = 0.3 * torch.rand(*batch, 20, 3, dtype=torch.float64, generator=generator)
    normal = unit(*batch, 20, 3, generator=generator)
    area = 0.02 * torch.rand(*batch, 20, dtype=torch.float64, generator=generator)
    points = solid(position, 1e-4, 50.0)
    solver = MPMSolver(dx=0.1, formulation=formulation, transfer="torch")
    velocity = torch.randn(*batch, 20, 3, dtype=torch.float64, generator=generator)
    state = solver.init_state(points, velocity)
    return solver, solver.rollout(state, DT, 2), WindForce(AeroForce(**settings), wind, normal, area)


def test_winds_are_those_of_the_start_of_each_substep():
    *_, load = _setting()
    time = double(0.01)
    winds = load.winds(time, DT, 5)
    assert winds.shape == (5, 3)
    assert winds.dtype == torch.float64
    for k in range(5):
        assert torch.equal(winds[k], GUSTS(time + k * DT))
    assert len(set(winds[:, 0].tolist())) > 1


def test_each_scene_has_its_own_wind():
    *_, load = _setting(batch=(2,), wind=[GUSTS, RISING])
    time = double(DT)
    winds = load.winds(time, DT, 3)
    assert winds.shape == (3, 2, 1, 3)
    assert torch.equal(winds[:, 1, 0], torch.stack([RISING(time + k * DT) for k in range(3)]))


@pytest.mark.parametrize("drag_step", ["explicit", "semi_implicit"])
def test_force_is_that_on_the_deformed_patches(drag_step):
    _, state, load = _setting(drag_step=drag_step, C_L=0.4)
    wind = double([5.0, 0.0, 1.0])
    force, resistance = load.force(state, wind)
    normal, area = deform_patch(state.F_total, load.normal, load.area)
    assert (area / load.area - 1).abs().max() > 1e-4
    assert_close(force, load.aero(wind, state.velocity, normal, area))
    if drag_step == "explicit":
        assert resistance is None
    else:
        assert torch.equal(resistance, load.aero.resistance(wind, state.velocity, area))
    now, _ = load(state)
    assert torch.equal(now, load.force(state, GUSTS(state.time))[0])


@pytest.mark.parametrize("drag_step", ["explicit", "semi_implicit"])
def test_the_area_of_what_has_flowed_is_capped(drag_step):
    """Shear without end: the normal turns, the force stays that on so many times the area at rest."""
    _, state, free = _setting(drag_step=drag_step)
    load = WindForce(AeroForce(drag_step=drag_step, max_area_ratio=1.5), GUSTS, free.normal, free.area)
    wind = double([5.0, 0.0, 1.0])
    F = torch.eye(3, dtype=torch.float64).repeat(20, 1, 1)
    F[:10, 0, 1] = 3e4
    F[10:15, 0, 0] = 1.2
    state = state.replace(F_total=F)
    normal, area = deform_patch(F, free.normal, free.area)
    growth = area / free.area
    assert growth[:10].min() > 1.5 > growth[10:].max()
    force, resistance = load.force(state, wind)
    capped = torch.cat([1.5 * free.area[:10], area[10:]])
    assert_close(force, load.aero(wind, state.velocity, normal, capped))
    if drag_step == "semi_implicit":
        assert_close(resistance, load.aero.resistance(wind, state.velocity, capped))
    assert_close(force[10:], free.force(state, wind)[0][10:])
    assert (force[:10] - free.force(state, wind)[0][:10]).abs().max() > 1.0


def test_gradients_through_a_capped_area_are_finite():
    """Also where the patch stands exactly at the cap; in F only the direction of the normal is left above it."""
    _, state, free = _setting()
    load = WindForce(AeroForce(max_area_ratio=1.0), GUSTS, free.normal, free.area)
    F = torch.eye(3, dtype=torch.float64).repeat(20, 1, 1)
    F[:10, 0, 1] = 3e4
    F.requires_grad_()
    force, _ = load.force(state.replace(F_total=F), double([5.0, 0.0, 1.0]))
    (found,) = torch.autograd.grad(force.square().sum(), F)
    assert torch.isfinite(found).all()
    assert found.abs().amax() > 0
    scaled = F.detach()[:10].requires_grad_()
    size = load.force(state.replace(F_total=torch.cat([scaled, F.detach()[10:]])), load.winds(state.time, 0.0, 1)[0])
    (slope,) = torch.autograd.grad(size[0][:10].square().sum(), scaled)
    # growth of F as a whole turns no normal, so the force does not see it
    assert (slope * scaled.detach()).sum((-1, -2)).abs().max() < 1e-9 * 3e4 * float(slope.abs().max())


@pytest.mark.parametrize("formulation", ["total", "updated"])
def test_a_batch_is_each_scene_by_itself(formulation):
    solver, state, load = _setting(batch=(2,), wind=[GUSTS, RISING], formulation=formulation)
    force, _ = load(state)
    for k, wind in enumerate(load.wind):
        normal, area = deform_patch(state.F_total[k], load.normal[k], load.area[k])
        expected = load.aero(wind(state.time), state.velocity[k], normal, area)
        assert_close(force[k], expected)
    assert solver.rollout(state, DT, 2, load).work.shape == (2,)


def test_gradients_reach_the_patches_and_the_coefficients():
    solver, state, load = _setting()
    load.area.requires_grad_()
    load.aero.C_D.requires_grad_()
    end = solver.rollout(state, DT, 3, load).position.square().sum()
    for found in torch.autograd.grad(end, [load.area, load.aero.C_D]):
        assert found.abs().max() > 0


@pytest.mark.parametrize("name", ["area", "normal", "C_D", "flows"])
def test_what_asks_for_a_gradient_is_not_left_to_the_kernels(name, monkeypatch):
    """The rollout as a whole is asked about it, before any substep."""
    solver, state, load = _setting(wind=WindField([3.0, 0.0, 0.0]))
    owner = {"C_D": load.aero, "flows": load.wind}.get(name, load)
    getattr(owner, name).requires_grad_()
    asked = []
    monkeypatch.setattr(MPMSolver, "fused", lambda solver, *tensors: asked.append(tensors))
    solver.rollout(state, DT, 1, load)
    assert any(tensor.requires_grad for tensor in asked[0])
    asked.clear()
    solver.watched_rollout(state, DT, 1, load)
    assert any(tensor.requires_grad for tensor in asked[0])


def test_shapes_are_checked():
    up = torch.tensor([[0.0, 0.0, 1.0]]).expand(4, 3)
    with pytest.raises(ValueError, match="normal"):
        WindForce(AeroForce(), GUSTS, torch.zeros(4), torch.ones(4))
    with pytest.raises(ValueError, match="area"):
        WindForce(AeroForce(), GUSTS, up, torch.ones(3))
    with pytest.raises(ValueError, match=r"one `wind` for each of the \(2,\) scenes, but got 3"):
        WindForce(AeroForce(), [GUSTS] * 3, up.expand(2, 4, 3), torch.ones(2, 4))
    with pytest.raises(ValueError, match=r"one `wind` for each of the \(3,\) scenes, but got 1"):
        WindForce(AeroForce(), WindField.together([GUSTS]), torch.ones(3, 5, 3), torch.ones(3, 5))


def _turn(degrees):
    s, c = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
    return double([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class Whirl(SpatialWind):
    """Air that turns about the origin."""

    def forward(self, time, position):
        return torch.stack([-position[..., 1], position[..., 0], torch.zeros_like(position[..., 0])], dim=-1)


def _blown(winds, turn, shift, delay):
    """The wind at five points of two copies, and its force."""
    places = Places(torch.stack([_turn(0.0), turn]), double([[0.0] * 3, shift]), double([0.0, delay]))
    load = WindForce(AeroForce(), winds, torch.eye(3, dtype=torch.float64)[2:].expand(5, 3), torch.ones(5), places)
    return load, torch.rand(2, 5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))


def test_copies_feel_one_wind_turned_and_later():
    """Turned by 90 degrees counterclockwise, their own x axis is y of the scene: wind along y is wind along x."""
    wind = WindField([0.0, 2.0, 0.0], modulations=[UniformGust(0.5)], seed=5)
    load, _ = _blown(wind.with_seeds([5, 6]), _turn(90.0), [0.0] * 3, 0.7)
    found, times = load.winds(double(1.0), 0.3, 4), double(1.0) + 0.3 * torch.arange(4)
    assert found.shape == (4, 2, 1, 3)
    assert torch.equal(found[:, 0, 0], wind(times))
    later = changed(wind, seed=6)(times - 0.7)
    assert_close(found[:, 1, 0], later @ _turn(90.0), rtol=0, atol=1e-15)
    assert float(later[:, 0].abs().max()) < 1e-12 < 0.9 < float(found[:, 1, 0, 0].min())


@pytest.mark.parametrize("wind", [Whirl(), WindField([4.0, 1.0, 0.0], effects=[PowerProfile(height=2.0)])])
def test_copies_feel_the_wind_at_their_places(wind):
    turn, shift = _turn(30.0), double([2.0, -1.0, 0.5])
    load, position = _blown([wind] * 2, turn, shift.tolist(), 0.0)
    now, there = double(2.0), position[1] @ turn.T + shift
    wanted = [wind.at(now, p) if isinstance(wind, WindField) else wind(now, p) for p in (position[0], there)]
    found = load.air(now, position)
    assert_close(found[0], wanted[0])
    assert_close(found[1] @ turn.T, wanted[1])


def test_a_force_in_many_winds():
    winds = [WindField([3.0 + k, 0.0, 0.0], modulations=[UniformGust(0.5)], seed=k) for k in range(3)]
    normal, area = unit(5, 3, generator=torch.Generator().manual_seed(0)), torch.full((5,), 0.1)
    batch = WindForce(AeroForce(), WindField.together(winds), normal, area)
    listed = WindForce(AeroForce(), winds, normal.expand(3, 5, 3), area.expand(3, 5))
    assert torch.equal(batch.winds(double(0.7), 1e-3, 6), listed.winds(double(0.7), 1e-3, 6))
    assert batch.uniform
    assert batch.recordable
    assert batch.twin() is not None


def _shaped():
    effects = [PowerProfile([0.0, 0.0, -1.0], height=2.0), Turbulence(0.3, 0.2, cells=[16, 8, 8])]
    return WindField([3.0, 1.0, 0.0], modulations=[UniformGust(0.5, interval=4 * DT)], effects=effects)


@pytest.mark.parametrize("batch", [(), (2,)])
def test_a_wind_with_effects_is_asked_where_the_particles_are(batch):
    """For all substeps at once or one by one; a batch takes winds with and without."""
    shaped = _shaped()
    wind = [shaped, GUSTS] if batch else shaped
    _, state, load = _setting(batch=batch, wind=wind)
    assert not load.uniform
    assert load.twin() is None or not batch
    assert load.recordable
    found = load.air(state.time, state.position)
    own = shaped.at(state.time, state.position[0] if batch else state.position)
    assert_close(found[0] if batch else found, own)
    if batch:
        assert torch.equal(found[1], GUSTS(state.time).expand(20, 3))
    assert own.std(0).min() > 0.01
    each = load.during(state.time, DT, 3)
    for k in range(3):
        later = state.replace(time=state.time + k * DT)
        assert_close(each(later, k)[0], load(later)[0])


def test_turbulence_does_not_depend_on_the_substep():
    """The impulse of 0.2 s on patches that stand still, from substeps of 4, 2 and 1 ms.

    The wind at a common time is the same, so that the sums differ only by their rule: of first order in the substep.
    """
    wind = WindField([2.0, 0.0, 0.0], effects=[Turbulence(0.5, 1.0, cells=[16] * 3)])
    _, state, load = _setting(wind=wind)
    state = state.replace(velocity=torch.zeros_like(state.velocity), time=torch.zeros_like(state.time))
    found, kept = [], []
    for dt in (4e-3, 2e-3, 1e-3):
        steps = round(0.2 / dt)
        each = load.during(state.time, dt, steps)
        forces = torch.stack([each(state, k)[0] for k in range(steps)])
        found.append(forces.sum(0) * dt)
        kept.append(forces[:: round(4e-3 / dt)])
    for forces in kept[1:]:
        assert_close(forces, kept[0], rtol=0, atol=1e-12)
    assert kept[0].std(0).max() > 0.05 * float(kept[0].abs().max())  # it gusts
    size = float(found[2].abs().max())
    coarse, fine = (float((one - found[2]).abs().max()) / size for one in found[:2])
    assert coarse < 0.02
    assert fine < 0.6 * coarse  # a third, where no patch turns its other side to the wind meanwhile
