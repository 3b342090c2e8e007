"""The wind as a load: what it gives at each substep, and rollouts in it, in torch and in kernels."""

import math
import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from shared import EYE, double, in_both, near, peak, rand, seeded, solid, turned_by, unit, value_error
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from gaussian_swaying import AeroForce, MPMSolver, SpatialWind, UniformGust, WindField, WindForce
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying.geometry.patches import deform_patch
from gaussian_swaying.mpm.device_functions import Packed
from gaussian_swaying.wind.effects import Obstacle, Plume, Profile
from gaussian_swaying.wind.field import FlowKey
from gaussian_swaying.wind.patches import Patches
from gaussian_swaying.wind.tables import CarriedField, RecordedWind, Shelter
from gaussian_swaying.wind.turbulence import Turbulence

DT = 1e-3
TOLERANCE = 2e-5
"""Of kernels, relative to the largest value of a field, as in tests/mpm/kernels/bodies.py."""
GUSTS = WindField([3.0, 1.0, 0.0], modulations=[UniformGust(0.5, interval=1.5 * DT)])
RISING = WindField(schedule=[FlowKey(0.0, [0.0] * 3), FlowKey(4 * DT, [0.0, 20.0, 0.0])], interpolation="linear")
TURNING = [FlowKey(0.0, [4.0, 1.0, 0.5], gusts=0.2), FlowKey(3 * DT, [-2.0, 3.0, 0.0]), FlowKey(5 * DT, gusts=2.0)]
MIDDLE = [0.1, 0.15, 0.1]
ZERO = double(0.0)


def _setting(wind=GUSTS, batch=(), formulation="total", transfer="torch", like=ZERO, groups=False, **aero):
    draw = seeded(0)
    position, velocity, area = (
        make(*batch, 20, n, dtype=torch.float64, generator=draw).to(like)
        for make, n in ((torch.rand, 3), (torch.randn, 3), (torch.rand, 1))
    )
    normal, area = unit(*batch, 20, 3, generator=draw).to(like), 0.02 * area[..., 0]
    patches = (normal, area)
    if groups:
        owner = torch.arange(20, device=like.device).repeat(2)
        patches = (Patches(torch.cat([normal, normal.roll(1, 0)]), area.repeat(2), owner, 20),)
    wind = wind.to(like.device) if isinstance(wind, torch.nn.Module) else wind
    load = WindForce(AeroForce(**aero).to(like.device), wind, *patches)
    solver, plain = (MPMSolver(0.1, formulation, transfer=kind) for kind in (transfer, "torch"))
    points = solid(0.06 + 0.2 * position, 1e-4, 50.0)
    solver.init_state(points, velocity)
    return solver, plain.rollout(plain.init_state(points, velocity), DT, 2), load


def test_winds_are_those_of_the_start_of_each_substep():
    time = double(0.01)
    times = time + DT * torch.arange(5)
    winds = _setting()[2].winds(time, DT, 5)
    assert torch.equal(winds, GUSTS(times))
    assert len(set(winds[:, 0].tolist())) > 1
    winds = _setting([GUSTS, RISING], (2,))[2].winds(time, DT, 5)
    assert torch.equal(winds[:, :, 0], torch.stack([GUSTS(times), RISING(times)], 1))


@pytest.mark.parametrize("cap", [None, 1.5])
@pytest.mark.parametrize("drag_step", ["explicit", "semi_implicit"])
def test_force_is_that_on_the_deformed_patches(drag_step, cap):
    """Sheared without end, the normal turns, and the area is at most so many times that at rest."""
    _, state, load = _setting(drag_step=drag_step, C_L=0.4, max_area_ratio=cap)
    wind, F = double([5.0, 0.0, 1.0]), state.F_total.clone()
    F[:10, 0, 1] = 3e4
    state = state.replace(F_total=F)
    normal, area = deform_patch(F, load.normal, load.area)
    assert (area[:10] / load.area[:10]).min() > 1.5 > (area[10:] / load.area[10:]).max() > 1 + 1e-4
    area = torch.minimum(area, (cap or math.inf) * load.area)
    force, resistance = load.force(state, wind)
    assert_close(force, load.aero(wind, state.velocity, normal, area))
    if drag_step == "explicit":
        assert resistance is None
    else:
        assert_close(resistance, load.aero.resistance(wind, state.velocity, area))
    assert torch.equal(load(state)[0], load.force(state, GUSTS(state.time))[0])


def test_gradients_through_a_capped_area_are_finite():
    """Also where the patch stands exactly at the cap; above it only the direction of the normal is left in F."""
    _, state, load = _setting(max_area_ratio=1.0)
    F = EYE.repeat(20, 1, 1)
    F[:10, 0, 1] = 3e4
    force, _ = load.force(state.replace(F_total=F.requires_grad_()), double([5.0, 0.0, 1.0]))
    (slope,) = torch.autograd.grad(force.square().sum(), F)
    assert torch.isfinite(slope).all()
    assert peak(slope) > 0
    # growth of F as a whole turns no normal, so the force does not see it
    assert peak((slope * F.detach())[:10].sum((-1, -2))) < 1e-9 * 3e4 * peak(slope[:10])


@in_both
def test_a_batch_is_each_scene_by_itself(formulation):
    solver, state, load = _setting([GUSTS, RISING], (2,), formulation)
    force, _ = load(state)
    for k, wind in enumerate(load.wind):
        normal, area = deform_patch(state.F_total[k], load.normal[k], load.area[k])
        assert_close(force[k], load.aero(wind(state.time), state.velocity[k], normal, area))
    assert solver.rollout(state, DT, 2, load).work.shape == (2,)


@pytest.mark.parametrize("name", ["area", "normal", "C_D", "flows"])
def test_what_asks_for_a_gradient_is_not_left_to_the_kernels(name, monkeypatch):
    solver, state, load = _setting(WindField([3.0, 0.0, 0.0]))
    owner = {"C_D": load.aero, "flows": load.wind}.get(name, load)
    getattr(owner, name).requires_grad_()
    asked = []
    monkeypatch.setattr(MPMSolver, "_wanted", lambda solver, *tensors: asked.append(tensors))
    for roll in (solver.rollout, solver.watched_rollout):
        asked.clear()
        roll(state, DT, 1, load)
        assert any(tensor.requires_grad for tensor in asked[0])


def test_shapes_are_checked():
    up, one = double([0.0, 0.0, 1.0]), torch.ones
    for words, wind, *patches in (
        ("normal", GUSTS, torch.zeros(4), one(4)),
        ("`area`", GUSTS, up.expand(4, 3), one(3)),
        ("`area` of the patches", GUSTS, up.expand(4, 3)),
        (r"one `wind` for each of the \(2,\) scenes, but got 3", [GUSTS] * 3, up.expand(2, 4, 3), one(2, 4)),
        (r"one `wind` for each of the \(3,\) scenes, but got 1", WindField.together([GUSTS]), one(3, 5, 3), one(3, 5)),
    ):
        with value_error(words):
            WindForce(AeroForce(), wind, *patches)


class Whirl(SpatialWind):
    """Air that turns about the origin, faster and faster."""

    def forward(self, time, position):
        return time * torch.stack([-position[..., 1], position[..., 0], torch.zeros_like(position[..., 0])], dim=-1)


def _blown(winds, turn, shift, delay):
    turns = torch.stack([turned_by(0.0), turn])
    places = torch.nn.Module()
    vars(places).update(turn=turns, shift=double([[0.0] * 3, shift]), delay=double([0.0, delay]))
    load = WindForce(AeroForce(), winds, EYE[2:].expand(5, 3), torch.ones(5), places)
    return load, rand(2, 5, 3, generator=seeded(1))


def test_copies_feel_one_wind_turned_and_later():
    """Turned by 90 degrees counterclockwise, their own x axis is y of the scene: wind along y is wind along x."""
    wind = WindField([0.0, 2.0, 0.0], modulations=[UniformGust(0.5)], seed=5)
    load, _ = _blown(wind.with_seeds([5, 6]), turned_by(90.0), [0.0] * 3, 0.7)
    found, times = load.winds(double(1.0), 0.3, 4), double(1.0) + 0.3 * torch.arange(4)
    assert found.shape == (4, 2, 1, 3)
    assert torch.equal(found[:, 0, 0], wind(times))
    later = changed(wind, seed=6)(times - 0.7)
    near(found[:, 1, 0], later @ turned_by(90.0), 1e-15)
    assert peak(later[:, 0]) < 1e-12 < 0.9 < found[:, 1, 0, 0].min()


@pytest.mark.parametrize("wind", [Whirl(), WindField([4.0, 1.0, 0.0], effects=[Profile(height=2.0, exponent=0.14)])])
def test_copies_feel_the_wind_at_their_places(wind):
    turn, shift = turned_by(30.0), double([2.0, -1.0, 0.5])
    load, position = _blown([wind] * 2, turn, shift.tolist(), 0.7)
    now, there, air = double(2.0), position[1] @ turn.T + shift, wind.at if isinstance(wind, WindField) else wind
    wanted = [air(now, position[0]), air(now - 0.7, there)]
    found = load.air(now, position)
    assert_close(found[0], wanted[0])
    assert_close(found[1] @ turn.T, wanted[1])


def test_a_force_in_many_winds():
    winds = [WindField([3.0 + k, 0.0, 0.0], modulations=[UniformGust(0.5)], seed=k) for k in range(3)]
    normal, area = unit(5, 3, generator=seeded(0)), torch.full((5,), 0.1)
    batch = WindForce(AeroForce(), WindField.together(winds), normal, area)
    listed = WindForce(AeroForce(), winds, normal.expand(3, 5, 3), area.expand(3, 5))
    assert torch.equal(batch.winds(double(0.7), 1e-3, 6), listed.winds(double(0.7), 1e-3, 6))
    assert batch.uniform
    assert batch.recordable
    assert batch.device_function() is not None


@pytest.mark.parametrize("batch", [(), (2,)])
def test_a_wind_with_effects_is_asked_where_the_particles_are(batch):
    effects = [Profile([0.0, 0.0, -1.0], height=2.0, exponent=0.14), Turbulence(0.3, 0.2, cells=[16, 8, 8])]
    shaped = WindField([3.0, 1.0, 0.0], modulations=[UniformGust(0.5, interval=4 * DT)], effects=effects)
    _, state, load = _setting([shaped, GUSTS] if batch else shaped, batch)
    assert not load.uniform
    assert load.device_function() is None or not batch
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


def _field():
    table = 2 * torch.randn(6, 5, 4, 3, generator=seeded(3))
    return CarriedField(
        table, [0.05, 0.07, 0.06], origin=[0.1, 0.0, 0.1], anchor=[0.1, 0.2, 0.05], wraps=(True, False, False), scale=2
    )


def _recorded():
    axis = np.linspace(-0.2, 0.5, 5)
    velocity = np.random.default_rng(0).normal(size=(4, 5, 5, 5, 3))
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "w.npz", time=DT * np.arange(4.0), x=axis, y=axis, z=axis, velocity=velocity)
        return RecordedWind(Path(folder) / "w.npz", repeat=True)


def _wind(name):
    low = {"ground": [0.0, 0.0, 0.05], "height": 0.2}
    gusts = [UniformGust(0.5, interval=2 * DT)]
    turbulence = Turbulence(0.5, 0.1, cells=[8, 6, 4], spacing=0.03)
    effects = {
        "all": [turbulence, Profile(**low, roughness=0.02)],
        "sheltered": [turbulence, Shelter(cells=8, strength=20.0)],
        "half": [Profile(**low, exponent=0.3), _field()],
        "several": [
            Profile(**low, roughness=0.02),
            Obstacle(MIDDLE, [0.05, 0.05, None], [-45.0, 0.0, 0.0]),
            turbulence,
            Obstacle(MIDDLE, [0.03, 0.08, 0.05], rotation=[0.0, 0.0, 20.0], drag=0.0),
            Plume([0.13, 0.17, 0.12], 0.05, heat=1e6),
            Obstacle(MIDDLE, [0.01, 0.1, 0.05]),
            _recorded(),
        ],
    }
    return WindField(schedule=TURNING, interpolation="linear", modulations=gusts, effects=effects[name])


def _pair(device, make, formulation="total", **options):
    options |= {"formulation": formulation, "like": torch.zeros((), device=device)}
    solver, state, load = _setting(make(), transfer="kernels", **options)
    return solver, _setting(make(), **options)[0], state, load


def _same(found, expected):
    for name in ("position", "velocity", "F_total"):
        a, b = getattr(found, name), getattr(expected, name)
        near(a, b, TOLERANCE * float(peak(b)))
    assert_close(found.work, expected.work, rtol=1e-4, atol=1e-7)


SOFT = {"drag_step": "semi_implicit"}


@pytest.mark.parametrize(
    ("formulation", "name", "options"),
    [
        ("total", "several", {}),
        ("updated", "sheltered", {}),
        ("updated", "all", SOFT | {"groups": True}),
        ("total", "all", SOFT | {"batch": (2,)}),
    ],
)
def test_the_kernels_blow_as_torch_does(kernel_device, formulation, name, options):
    """Also at later times: on a GPU the third rollout is replayed."""
    solver, reference, state, load = _pair(kernel_device, lambda: _wind(name), formulation, **options)
    assert load.device_function() is not None
    assert (load.sums is not None) == ("groups" in options)
    load.refresh(state)
    for _ in range(3):
        found, expected = solver.rollout(state, DT, 3, load), reference.rollout(state, DT, 3, load)
        _same(found, expected)
        before, state = state, expected
    assign(load.wind, effects=torch.nn.ModuleList())
    bare = reference.rollout(before, DT, 3, load)
    change = float(peak(bare.velocity - expected.velocity))
    least = 1e-2 * float(peak(expected.velocity))
    assert change > least, f"without the effects the velocity differs by {change:.2g} m/s: make them stronger in _wind"


def test_a_changed_effect_is_read_again_at_the_same_address(kernel_device):
    solver, reference, state, load = _pair(kernel_device, lambda: _wind("half"))
    ends, where = [], None
    for change in range(4):
        if change == 2:
            load.wind.effects[1].table.mul_(-3.0)
        if change == 3:
            assign(load.wind, flows=load.wind.flows.flip(0))
        ends.append(solver.rollout(state, DT, 5, load))
        _same(ends[-1], reference.rollout(state, DT, 5, load))
        where = where or solver.kernels.loads.buffer.data_ptr()
        assert solver.kernels.loads.buffer.data_ptr() == where
    near(ends[0].position, ends[1].position, 1e-6)
    for one, other in ((1, 2), (2, 3)):
        assert peak(ends[one].velocity - ends[other].velocity) > 1e-3


def _packed(load, device):
    return Packed(load.area.shape, {"dtype": torch.float32, "device": torch.device(device)})


def test_only_what_has_changed_is_written_again(kernel_device, monkeypatch):
    _, state, load = _setting(_wind("sheltered"), like=torch.zeros((), device=kernel_device))
    written, tables = [], _packed(load, kernel_device)
    plain = torch.Tensor.copy_
    monkeypatch.setattr(torch.Tensor, "copy_", lambda to, what: written.append(to.numel()) or plain(to, what))

    def take():
        written.clear()
        tables.take([load.device_function()], 1)
        return list(written)

    turbulence, shelter = [21, 8 * 6 * 4 * 3], [21, 8**3]
    assert take() == [*turbulence, *shelter]
    assert take() == []
    load.refresh(state)
    assert take() == shelter
    load.wind.effects[0].table.mul_(2.0)
    assert take() == turbulence
    buffer = tables.buffer.clone()
    tables = _packed(load, kernel_device)
    assert take() == [*turbulence, *shelter]
    assert torch.equal(tables.buffer, buffer)


class _NoReading(TorchDispatchMode):
    """Refuses what a CUDA graph cannot record: to read a number of a tensor, and to make a tensor of numbers."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        assert function is not torch.ops.aten._local_scalar_dense.default, "the host reads a number of a tensor"
        assert function is not torch.ops.aten.lift_fresh.default, "`forward` makes a tensor: register a buffer instead"
        return function(*args, **(kwargs or {}))


def test_the_host_reads_nothing_of_a_wind():
    """So all of it can be recorded, and the needs of the next frame of a shelter can be measured in a CUDA graph."""
    time, place = double(0.003), torch.rand(20, 3)
    for wind in map(_wind, ("all", "half", "several")):
        for interpolation in ("step", "linear"):
            wind = WindField(schedule=TURNING, interpolation=interpolation, effects=wind.effects)
            expected = wind.at(time, place)
            with _NoReading():
                found = wind.at(time, place)
            assert torch.equal(found, expected)
    _, state, load = _setting(_wind("sheltered"))
    load._fields[0](time)  # the first call makes the numbers of the modulations
    with _NoReading():
        load.foreseen(state).samples(state, DT, 5)


def test_what_the_kernels_do_not_know_runs_in_torch():
    class Doubled(Profile):
        def forward(self, velocity, position, moment):
            return 2 * super().forward(velocity, position, moment)

    class Same(Profile):
        device_function = Profile.device_function

    assert Doubled().device_function() is None
    assert Same().device_function().function is Profile().device_function().function
    for effects in ([Doubled()], [Same(), Doubled(), Obstacle(MIDDLE, [0.05] * 3)]):
        wind = WindField([1.0, 0.0, 0.0], effects=effects)
        assert _setting(wind)[2].device_function() is None
