"""A wind with effects in the kernels against the same wind in torch."""

import tempfile
from pathlib import Path

import numpy as np
import pytest
import torch
from shared import solid, unit
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from gaussian_swaying import AeroForce, MPMSolver, UniformGust, WindField, WindForce
from gaussian_swaying._fixed import assign
from gaussian_swaying.mpm.twins import Composed, Tables
from gaussian_swaying.wind.effects import CylinderObstacle, EllipsoidObstacle, LogProfile, Plume, PowerProfile
from gaussian_swaying.wind.field import FlowKey
from gaussian_swaying.wind.patches import Patches
from gaussian_swaying.wind.tables import CarriedField, RecordedWind, Shelter
from gaussian_swaying.wind.turbulence import Turbulence

DX, DT = 0.1, 1e-3
TOLERANCE = 2e-5
"""Relative to the largest value of a field, as in tests/mpm/triton/bodies.py."""


def _field(wraps):
    table = 2 * torch.randn(6, 5, 4, 3, generator=torch.Generator().manual_seed(3))
    return CarriedField(
        table, [0.05, 0.07, 0.06], origin=[0.1, 0.0, 0.1], anchor=[0.1, 0.2, 0.05], wraps=wraps, scale=2
    )


MIDDLE = [0.1, 0.15, 0.1]
GUSTS = [UniformGust(0.5, interval=2 * DT)]
TURNING = [FlowKey(0.0, [4.0, 1.0, 0.5]), FlowKey(3 * DT, [-2.0, 3.0, 0.0])]


def _recorded():
    axis = np.linspace(-0.2, 0.5, 5)
    velocity = np.random.default_rng(0).normal(size=(4, 5, 5, 5, 3))
    with tempfile.TemporaryDirectory() as folder:
        np.savez(Path(folder) / "w.npz", time=DT * np.arange(4.0), x=axis, y=axis, z=axis, velocity=velocity)
        return RecordedWind(Path(folder) / "w.npz", repeat=True)


def _wind(name):
    """A wind of its own for every test, as it is moved to a device."""
    low = {"ground": [0.0, 0.0, 0.05], "height": 0.2}
    turbulence = Turbulence(0.5, 0.1, cells=[8, 6, 4], spacing=0.03)
    effects = {
        "all": [turbulence, LogProfile(**low, roughness=0.02)],
        "sheltered": [turbulence, Shelter(cells=8, strength=20.0)],
        "half": [PowerProfile(**low, exponent=0.3), _field((True, False, False))],
        "several": [
            LogProfile(**low, roughness=0.02),
            CylinderObstacle(MIDDLE, 0.05, axis=[0.0, 1.0, 1.0]),
            turbulence,
            EllipsoidObstacle(MIDDLE, [0.03, 0.08, 0.05], turn=20.0, drag=0.0),
            Plume([0.13, 0.17, 0.12], 0.05, heat=1e6),
            EllipsoidObstacle(MIDDLE, [0.01, 0.1, 0.05]),
            _recorded(),
        ],
    }
    return WindField(schedule=TURNING, interpolation="linear", modulations=GUSTS, effects=effects[name])


def _bodies(device, formulation, wind, batch=(), groups=False, transfer="kernels", **aero):
    draw = torch.Generator().manual_seed(0)
    position = 0.06 + 0.18 * torch.rand(*batch, 24, 3, generator=draw)
    normal = unit(*batch, 24, 3, generator=draw, dtype=torch.float32).to(device)
    area = (0.02 * torch.rand(*batch, 24, generator=draw)).to(device)
    velocity = torch.randn(*batch, 24, 3, generator=draw).to(device)
    points = solid(position.to(device), 1e-4, 50.0)
    patches = (normal, area)
    if groups:  # two patches on each particle
        owner = torch.arange(24, device=device).repeat(2)
        patches = (Patches(torch.cat([normal, normal.roll(1, 0)]), area.repeat(2), owner, 24),)
    solver = MPMSolver(dx=DX, formulation=formulation, transfer=transfer)
    load = WindForce(AeroForce(C_D=1.0, **aero).to(device), wind.to(device), *patches)
    return solver, solver.init_state(points, velocity), load


def _pair(device, formulation, wind, **options):
    """The solver with kernels and that in torch, a state, and the load of a wind that a function makes."""
    solver, state, load = _bodies(device, formulation, wind(), **options)
    return solver, _bodies(device, formulation, wind(), transfer="torch", **options)[0], state, load


def _same(found, expected):
    for name in ("position", "velocity", "F_total"):
        a, b = getattr(found, name), getattr(expected, name)
        assert_close(a, b, rtol=0, atol=TOLERANCE * float(b.abs().max()))
    assert_close(found.work, expected.work, rtol=1e-4, atol=1e-7)


WINDS = ("all", "sheltered", "half", "several")


@pytest.mark.parametrize(("formulation", "name"), [("total", "half"), ("total", "several"), ("updated", "sheltered")])
def test_the_kernels_blow_as_torch_does(kernel_device, formulation, name):
    """Also at later times: on a GPU the third rollout is replayed."""
    solver, reference, state, load = _pair(kernel_device, formulation, lambda: _wind(name))
    assert load.twin() is not None
    load.refresh(state)
    for _ in range(3):
        found, expected = solver.rollout(state, DT, 3, load), reference.rollout(state, DT, 3, load)
        _same(found, expected)
        before, state = state, expected
    assign(load.wind, effects=torch.nn.ModuleList())
    bare = reference.rollout(before, DT, 3, load)
    change = float((bare.velocity - expected.velocity).abs().max())
    least = 1e-2 * float(expected.velocity.abs().max())
    assert change > least, f"without the effects the velocity differs by {change:.2g} m/s: make them stronger in _wind"


@pytest.mark.slow(gate=["cpu-updated"])
@pytest.mark.parametrize("formulation", ["total", "updated"])
def test_the_kernels_blow_on_groups_of_patches_and_batches(kernel_device, formulation):
    for options in ({"groups": True}, {"batch": (2,)}):
        options |= {"drag_step": "semi_implicit"}
        solver, reference, state, load = _pair(kernel_device, formulation, lambda: _wind("all"), **options)
        assert load.twin() is not None
        assert (load.sums is not None) == ("groups" in options)
        _same(solver.rollout(state, DT, 4, load), reference.rollout(state, DT, 4, load))


def test_a_changed_effect_is_read_again_at_the_same_address(kernel_device):
    """A table changed in place, another flow, and rollouts that are replayed from graphs on a GPU."""
    solver, reference, state, load = _pair(kernel_device, "total", lambda: _wind("half"))
    ends, where = [], None
    for change in range(4):
        if change == 2:
            load.wind.effects[1].table.mul_(-3.0)
        if change == 3:
            assign(load.wind, flows=load.wind.flows.flip(0))
        ends.append(solver.rollout(state, DT, 5, load))
        _same(ends[-1], reference.rollout(state, DT, 5, load))
        where = where or solver.fused().loads.tables.buffer.data_ptr()
        assert solver.fused().loads.tables.buffer.data_ptr() == where
    assert_close(ends[0].position, ends[1].position, rtol=0, atol=1e-6)
    for one, other in ((1, 2), (2, 3)):
        assert (ends[one].velocity - ends[other].velocity).abs().max() > 1e-3


def test_only_what_has_changed_is_written_again(kernel_device, monkeypatch):
    """A shelter is refreshed in every frame; the turbulence before it has fifty megabytes in its full size."""
    _, state, load = _bodies(kernel_device, "total", _wind("sheltered"))
    written, tables = [], Tables(torch.device(kernel_device))
    plain = torch.Tensor.copy_
    monkeypatch.setattr(torch.Tensor, "copy_", lambda to, what: written.append(to.numel()) or plain(to, what))

    def take():
        written.clear()
        tables.take([load.twin()], Composed([load.twin()]))
        return list(written)

    turbulence, shelter = [21, 8 * 6 * 4 * 3], [21, 8**3]
    assert take() == [*turbulence, *shelter]
    assert take() == []
    load.refresh(state)
    assert take() == shelter
    load.wind.effects[0].table.mul_(2.0)
    assert take() == turbulence
    buffer = tables.buffer.clone()
    tables = Tables(torch.device(kernel_device))
    assert take() == [*turbulence, *shelter]
    assert torch.equal(tables.buffer, buffer)


def test_the_last_place_of_a_table_that_repeats(kernel_device):
    """Places just below zero round up to the length of the table in float32."""
    table = torch.arange(4.0).repeat_interleave(12).reshape(4, 2, 2, 3)
    wind = WindField([0.0, 0.0, 0.0], effects=[CarriedField(table, [1.0] * 3, anchor=[-1e-9, 0.0, 0.0])])
    solver, reference, state, load = _pair(kernel_device, "total", lambda: wind)
    _same(solver.rollout(state, DT, 2, load), reference.rollout(state, DT, 2, load))


class _NoReading(TorchDispatchMode):
    """Refuses what a CUDA graph cannot record: to read a number of a tensor, and to make a tensor of numbers."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        assert function is not torch.ops.aten._local_scalar_dense.default, "the host reads a number of a tensor"
        assert function is not torch.ops.aten.lift_fresh.default, "`forward` makes a tensor: register a buffer instead"
        return function(*args, **(kwargs or {}))


def test_the_host_reads_nothing_of_a_wind():
    """So all of it can be recorded, and the needs of the next frame of a shelter can be measured in a CUDA graph."""
    time, place = torch.tensor(0.003, dtype=torch.float64), torch.rand(20, 3)
    for wind in (_wind(name) for name in WINDS if name != "sheltered"):
        for interpolation in ("step", "linear"):
            wind = WindField(schedule=TURNING, interpolation=interpolation, effects=wind.effects)
            expected = wind.at(time, place)
            with _NoReading():
                found = wind.at(time, place)
            assert torch.equal(found, expected)
    _, state, load = _bodies("cpu", "total", _wind("sheltered"), transfer="torch")
    with _NoReading():
        load.foreseen(state).samples(state, DT, 5)


def test_what_the_kernels_do_not_know_runs_in_torch():
    """A subclass does not inherit the twin, nor does a wind have one without those of all effects."""

    class Doubled(LogProfile):
        def forward(self, velocity, position, moment):
            return 2 * super().forward(velocity, position, moment)

    class Same(LogProfile):
        twin = LogProfile.twin

    assert Doubled().twin() is None
    assert Same().twin().function is LogProfile().twin().function
    for effects in ([Doubled()], [Same(), Doubled(), EllipsoidObstacle(MIDDLE, [0.05] * 3)]):
        wind = WindField([1.0, 0.0, 0.0], effects=effects)
        assert _bodies("cpu", "total", wind, transfer="torch")[2].twin() is None
