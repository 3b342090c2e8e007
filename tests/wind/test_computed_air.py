import math

import pytest
import torch
from shared import alike, double, longest, near, peak, up_to
from torch.testing import assert_close

from gaussian_swaying import Box, Material, MPMSolver, Scene, Simulation, WindField
from gaussian_swaying.air.flow import SOUND
from gaussian_swaying.air.immersed import look
from gaussian_swaying.kernels.graphs import Replayed
from gaussian_swaying.scenes.procedural import FlagScene, GivenScene, both
from gaussian_swaying.simulation.step import why_not_batched
from gaussian_swaying.wind.computed_air import BYTES, ComputedAir, resolution
from gaussian_swaying.wind.effects import Obstacle, Profile
from gaussian_swaying.wind.field import FlowKey

LOW, HIGH = [-1.2, -0.9, -0.9], [1.5, 0.9, 0.9]


def _simulation(air=None, wind=(3.0, 0.5, 0.0), hold=True, density=100.0, dtype="float32", device="cpu", **changes):
    """A small flag across a box of 27 x 18 x 18 cells."""
    given = {"low": LOW, "high": HIGH, "cells": 27, "speed": 6.0} | changes
    return Simulation(
        FlagScene(spacing=0.05),
        Material(E=2e4, nu=0.3, density=density, thickness=0.01),
        solver=MPMSolver(0.1, gravity=[0.0, 0.0, 0.0]) if not hold else None,
        hold=up_to(x=0.06) if hold else None,
        wind=wind if isinstance(wind, WindField) else list(wind),
        air=air or ComputedAir(**given),
        dtype=dtype,
        device=device,
        frame_dt=0.02,
    )


def _started(**changes):
    stepper = _simulation(**changes).stepper
    state = stepper.start()
    return stepper, state, state.air.clone()


def _together(stepper, state, now, substeps=4):
    air, dt = stepper.air, stepper.air.flow.units.dt / substeps
    whole = [state] if air.settings.force == "law" else []
    (place,) = air._begin(now, substeps, dt, state.position, state.velocity, *whole)
    end, _ = stepper.solver.watched_rollout(state, dt, substeps, [air.push], 1, None, check=False)
    way, faster = end.position - state.position, end.velocity - state.velocity
    return end, air._lose(now, substeps, dt, place, way, faster)


def _run(simulation, frames):
    stepper = simulation.stepper
    state = stepper.start()
    for _ in range(frames):
        state, health = stepper.advance(state)
    return stepper, state, health


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_a_free_sheet_gets_the_momentum_that_the_air_loses(dtype):
    """In one step of the air, with its faces and all; rounding of float32 is that of the air."""
    stepper, state, now = _started(hold=False, dtype=dtype)
    before = stepper.air.momentum(now)
    end, taken = _together(stepper, state, now)
    gained = stepper.solver.momenta(end)["linear"].double()
    tolerance = 1e-4 if dtype == "float32" else 1e-9
    assert_close(gained, taken.double().sum(0), rtol=tolerance, atol=tolerance * float(peak(gained)))
    # the air is float32
    assert_close(before - stepper.air.momentum(now), gained, rtol=1e-4, atol=2e-7 * float(peak(before)))
    assert gained[0] > 0


def test_still_air_takes_energy_and_gives_none():
    stepper, state, _ = _started(wind=(0.0, 0.0, 0.0))
    velocity, nodes = torch.zeros_like(state.velocity), torch.zeros_like(state.node_velocity)
    velocity[:, 1] = 2.0 * (state.position[:, 0] + 0.6)
    nodes[..., 1] = 2.0 * (state.grid.node_positions(state.position)[:, 0] + 0.6).clamp(min=0)
    state = state.replace(velocity=velocity, node_velocity=nodes)
    units = stepper.air.flow.units

    def energy(state):
        own = stepper.solver.energies(state)
        moments = state.air.double()
        flow = 0.5 * ((1 + moments[0]) * moments[1:4].square().sum(0)).sum() * units.cell_mass * units.speed**2
        return float(own["kinetic"] + own["elastic"] + flow)

    before = energy(state)
    for _ in range(12):
        state, health = stepper.advance(state)
        now = energy(state)
        assert now <= before * 1.001
        before = now
    assert health.lost == 0


@pytest.mark.slow(gate=["0.1", "100.0"])
@pytest.mark.parametrize("ratio", [0.1, 1.0, 10.0, 100.0])
def test_any_ratio_of_masses_ends_finite(ratio):
    """Mass of the sheet per air of its length, from 0.1 to 100."""
    density = ratio * 1.225 * 1.2 / 0.01
    _, state, _ = _run(_simulation(density=density), 6)
    assert torch.isfinite(state.position).all()
    assert torch.isfinite(state.air).all()
    assert longest(state.velocity) < 12.0


@pytest.mark.gpu
@pytest.mark.parametrize("force", ["surface", "law"])
def test_recorded_steps_are_those_that_are_not(force, monkeypatch):
    _, replayed, _ = _run(_simulation(device="cuda", force=force), 4)
    monkeypatch.setattr(Replayed, "__call__", lambda self, key, function, *inputs: list(function(*inputs)))
    _, plain, _ = _run(_simulation(device="cuda", force=force), 4)
    scale = float(peak(plain.velocity))
    assert scale > 0.01
    near(replayed.velocity, plain.velocity, 1e-3 * scale)
    near(replayed.air, plain.air, 1e-4 * float(peak(plain.air[1:4])))


def test_the_law_acts_in_the_air_at_the_patches():
    lost = {}
    for force in ("law", "surface"):
        stepper, state, now = _started(force=force, wind=(0.5, 3.0, 0.0))
        before = stepper.air.momentum(now)
        taken = _together(stepper, state, now)[1].double().sum(0)
        assert_close(before - stepper.air.momentum(now), taken, rtol=1e-3, atol=1e-6)
        lost[force] = taken[1]
    assert 0 < lost["law"] < lost["surface"]


def test_a_heavy_surface_stops_its_layer_of_air_however_short_the_substeps():
    """It is so heavy that it does not move: it takes the momentum of the layer once, in one substep as in eight."""
    stepper, state, now = _started(density=1e5, dtype="float64")
    air = stepper.air
    layer = air.flow.units.cell_mass * look(state.air, air._area, air._place(state.position), air.flow.kind)[1].sum()
    # the layer of a point is some 1e-4 of its mass
    for substeps in (1, 8):
        taken = _together(stepper, state, now.clone(), substeps)[1].double().sum(0)
        assert_close(taken, float(layer) * double([3.0, 0.5, 0.0]), rtol=1e-3, atol=1e-6 * float(layer))


def test_the_law_is_no_stronger_than_what_stops_the_surface():
    stepper, state, _ = _started(force="law", wind=(0.5, 3.0, 0.0), dtype="float64")
    air = double([0.5, 3.0, 0.0]).expand_as(state.velocity)
    free, rate = stepper.air._law(state, air, torch.full(air.shape[:1], 1e9, dtype=torch.float64))
    assert rate.min() > 0
    most = torch.where(torch.arange(len(rate)) % 2 == 0, 0.25, 4.0) * rate
    force, held = stepper.air._law(state, air, most)
    share = torch.where(torch.arange(len(rate)) % 2 == 0, 0.25, 1.0)
    assert_close(force, share[:, None] * free)
    assert_close(held, share * rate)


def test_the_inflow_has_the_wind_of_the_end_of_the_frame():
    keys = [FlowKey(0.0, [2.0, 0.0, 0.0]), FlowKey(0.02, [4.0, 0.0, 0.0])]
    profile = Profile([0.0, 0.0, -1.2], height=2.0, roughness=0.05)
    wind = WindField(schedule=keys, interpolation="linear", effects=[profile])
    stepper, state, _ = _run(_simulation(wind=wind), 1)
    flow, moments = stepper.air.flow, state.air.reshape(10, -1)
    inlet = (flow.outward == torch.tensor([-1, 0, 0])).all(-1)
    found = moments[:, flow.held.long()[inlet]]
    assert int(inlet.sum()) > 100
    blown = (found[1] + SOUND * found[0]) * flow.units.speed
    height = 0.05 + 0.1 * (flow.held.long()[inlet] % 18) - 0.9 + 0.4 + 1.2  # the middle of the flag is at 0.4 m
    alike(blown.double(), 4.0 * (height.double() / 0.05).log() / math.log(2.0 / 0.05), 1e-4)


def test_ground_and_walls_are_still():
    walls = [Box([-0.4, -0.8, -0.4], [-0.2, -0.6, 1.0])]
    stepper, state, _ = _started(ground=True, walls=walls)
    assert stepper.air.walls[:, :, 0].all()
    assert stepper.air.walls[:, :, 3:].any()
    state, _ = stepper.advance(state)
    assert peak(state.air[1:4, stepper.air.walls]) == 0


@pytest.mark.parametrize("shift", [0.02, 0.06])
def test_gaussians_that_stand_still_are_walls(shift):
    """A flag beside a screen of Gaussians: cells within half a cell of it are walls, and the air stops there."""
    flag, screen = FlagScene(spacing=0.05).generate(), FlagScene(spacing=0.05, yaw=90.0).generate()
    screen.means[:] += torch.tensor([1.5 + shift, -0.6, 0.0])
    scene = Scene(generator=GivenScene(both(flag, screen)), region=up_to(x=1.3))
    air = ComputedAir(LOW, [2.0, 0.9, 0.9], 32, speed=6.0, still_walls=True)
    simulation = Simulation(
        scene, Material(E=2e4, nu=0.3, density=100.0, thickness=0.01), wind=[3.0, 0.5, 0.0], air=air, frame_dt=0.02,
        hold=up_to(x=0.06),
    )  # fmt: skip
    stepper, state, _ = _run(simulation, 2)
    wall = stepper.air.walls.nonzero() * stepper.air.settings.spacing + torch.tensor(LOW) + 0.05
    offset = wall - (torch.tensor([1.5 + shift, 0.0, 0.4]) - simulation.scene.center)
    assert len(wall) > 2 * 90  # two layers, wherever the screen lies between the cells
    assert peak(offset[:, 0]) < 0.11
    assert peak(offset[:, 1]) < 0.71
    assert peak(offset[:, 2]) < 0.51
    assert peak(state.air[1:4, stepper.air.walls]) == 0
    place = simulation.scene.frame.point_to_sim(torch.tensor([[1.6, 0.0, 0.4], [1.6, 1.0, 0.4]]))
    behind, beside = stepper.air_at(state, place)[:, 0]
    assert behind < 0.5 * float(beside)


def test_a_batch_gradients_and_another_frame_are_refused():
    stepper, state, _ = _run(_simulation(), 1)
    with pytest.raises(RuntimeError, match="no gradients"):
        stepper.advance(state.replace(velocity=state.velocity.clone().requires_grad_()))
    stepper.model = stepper.model.replace(frame_dt=0.03)
    with pytest.raises(RuntimeError, match="length of the frame"):
        stepper.advance(state)
    assert "set `air` to null" in why_not_batched(stepper.model)


def test_what_a_box_costs_and_resolves():
    found = _started()[0].air.resolution
    assert found.cells == (27, 18, 18)
    assert found.spacing == pytest.approx(0.1)
    assert found.steps == 12
    assert found.megabytes == pytest.approx(27 * 18 * 18 * BYTES * 1e-6)
    assert found.reynolds == pytest.approx(6.0 * 1.15 / 1.5e-5, rel=0.05)
    eddies = 0.1**2 * 0.1 * 6.0  # of Smagorinsky's constant, the spacing and the speed
    assert found.resolved == pytest.approx(6.0 * 1.15 / (1.5e-5 + eddies), rel=0.05)
    assert "Reynolds number" in str(found)
    unknown = resolution(ComputedAir(LOW, HIGH, 27), WindField([3.0, 4.0, 0.0]), 0.02, torch.eye(3))
    assert unknown.reynolds == pytest.approx(1.5 * 5.0 * 1.0 / 1.5e-5)  # of half as much again as the wind


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"walls": [Box([-9.0] * 3, [9.0] * 3)]}, r"no way for the wind.*`air\.walls` smaller"),
        ({"cells": 200}, "air would pass between them"),
        ({"cells": 18}, "no wake is resolved"),
        ({"density": 0.2}, "layer of air"),
        ({"wind": (0.0, 0.0, 0.0), "speed": None}, "air.speed"),
        ({"air": ComputedAir([-0.6, -0.9, -0.9], HIGH, 24, speed=6.0)}, "within two cells"),
        ({"wind": WindField([3.0, 0.0, 0.0], effects=[Obstacle([0.0] * 3, [0.1] * 3)])}, "air.walls"),
        ({"still_walls": True}, r"air\.still_walls"),
        ({"speed": 0.5}, r"raise `air\.speed`"),  # the wind outruns the steps
        ({"cells": 4}, "cells"),
        ({"low": HIGH}, "below `high`"),
        ({"viscosity": 0.0}, "viscosity"),
        ({"force": "drag"}, "force"),
    ],
)
def test_what_cannot_be_right_is_refused(changes, message):
    with pytest.raises((ValueError, RuntimeError), match=message):
        _run(_simulation(**changes), 1)


def test_a_wind_that_is_not_there_costs_nothing():
    assert not any(type(force).__name__ == "WindForce" for force in _simulation().stepper.forces)
