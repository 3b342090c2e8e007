import math

import pytest
import torch
from shared import advanced, beyond, double, in_both, near, peak

from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.simulation.body import Material
from gaussian_swaying.simulation.model import Edit
from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.force import AeroForce, added_mass_per_area

BREADTH, SHEET = 1.0, 0.3  # m, kg/m²
SLOWER = math.sqrt(SHEET / (SHEET + added_mass_per_area(BREADTH, 1.225)))
STIFF = Material(E=2e4, density=30.0, thickness=0.01)


def air(breadth=BREADTH, drag=0.0, **settings):
    return AeroForce(drag, drag, C_L=0.0, added_mass=breadth, **settings)


@pytest.fixture
def hanging(make_simulation):
    """A sheet that hangs from its upper edge; gravity is slanted, so that it starts to swing."""

    def make(aero, **settings):
        top = PinnedRegion(beyond(z=0.69))
        given = {"gravity": (0.0, 0.5, -9.8), "dtype": torch.float64, "material": STIFF, "wind": WindField()}
        return make_simulation(aero=aero, pinned=False, boundaries=[top], **(given | settings))

    return make


@in_both
def test_still_air_slows_a_hanging_sheet(formulation, hanging):
    """All forces are the same, so the motion is that without air, in slower time: by sqrt(sigma / (sigma + m))."""
    without = hanging(air(0.0), formulation=formulation)
    carrying = hanging(air(), formulation=formulation, frame_dt=0.04 / SLOWER)
    slow, fast = (advanced(simulation, 15)[0].position for simulation in (carrying, without))
    assert peak(fast - without.model.points.position) > 0.02
    near(slow, fast, 1e-9)


@pytest.mark.parametrize("transfer", ["torch", "kernels"])
@in_both
def test_a_sheet_falls_slower_as_it_has_to_move_air(formulation, transfer, make_simulation):
    simulation = make_simulation(
        aero=air(), material=STIFF, wind=WindField(), pinned=False, formulation=formulation, transfer=transfer
    )
    state, _ = advanced(simulation, 5)
    speed = -float(state.velocity[:, 2].mean())
    assert speed == pytest.approx(9.8 * SLOWER**2 * 0.2, rel=1e-4)
    assert simulation.stepper.idle  # no wind, but air


def test_energy_is_kept_in_still_air_without_drag(hanging):
    without, carrying = hanging(air(0.0), cfl=0.1), hanging(air(), cfl=0.1, frame_dt=0.04 / SLOWER)
    logs = []
    for simulation in (without, carrying):
        first = simulation.stepper.at_first(simulation.start()).read()
        logs.append([first, *advanced(simulation, 25)[1]])
    mass, position = without.model.points.mass, without.model.points.position
    weight = mass[:, None] * double([0.0, 0.5, -9.8])
    assert logs[1][0].potential == pytest.approx(-float((weight * position).sum()))
    for name in ("kinetic", "elastic", "potential"):
        ours, theirs = ([getattr(health, name) for health in log] for log in logs)
        assert ours == pytest.approx(theirs, abs=1e-9)
    total = [health.kinetic + health.elastic + health.potential for health in logs[1]]
    assert max(abs(energy - total[0]) for energy in total) < 0.02 * max(health.kinetic for health in logs[1])


def test_the_air_that_is_lifted_is_no_work_of_the_wind(hanging):
    worst = []
    for cfl in (0.1, 0.05):
        _, log = advanced(hanging(air(), cfl=cfl), 25)
        worst.append(max(abs(sum(health.wind_work for health in log[:k])) for k in range(1, 26)))
        assert worst[-1] < 0.1 * max(health.kinetic for health in log)
    assert worst[1] < 0.6 * worst[0]


def test_a_batch_is_as_each_alone(hanging):
    first = hanging(air(drag=0.5), wind=WindField([1.0, 4.0, 0.0]), substep=0.004)
    other = first.variant({"material.density": 50.0, "wind.speed": 2.0})
    batch = first.batch([first.model, other.model])
    state = batch.start()
    for _ in range(3):
        state, health = batch.advance(state)
    assert health.potential == pytest.approx(sum(advanced(one, 3)[1][-1].potential for one in (first, other)))
    for k, one in enumerate((first, other)):
        near(state.scene(k).position, advanced(one, 3)[0].position, 1e-10)


def test_a_changed_breadth_binds_again_and_another_coefficient_does_not(hanging):
    simulation = hanging(air())
    state = simulation.start()
    stepper, points = simulation.stepper, simulation.model.points
    area = simulation.scene.patches.areas()

    def carried():
        assert simulation.model.points.mass is points.mass  # the material itself
        return (simulation.solver.points.mass - points.mass) / area

    torch.testing.assert_close(carried(), torch.full_like(area, added_mass_per_area(BREADTH, 1.225)))
    bound = simulation.solver.bound
    simulation.change("aero.C_D", 0.3)
    assert simulation.solver.bound is bound
    simulation.change("aero.added_mass", 0.5)
    torch.testing.assert_close(carried(), torch.full_like(area, added_mass_per_area(0.5, 1.225)))
    torch.testing.assert_close(
        stepper.lift.force[:, 2], 9.8 * area * added_mass_per_area(0.5, 1.225), rtol=1e-12, atol=0
    )
    simulation.aero = air(0.5, drag=0.3, air_density=2.0)
    torch.testing.assert_close(carried(), torch.full_like(area, added_mass_per_area(0.5, 2.0)))
    simulation.change("solver.gravity", [0.0, 0.0, 0.0])
    assert stepper.lift is None
    assert stepper.forces == [stepper.wind_force]  # C_D is not zero any more
    simulation.change("aero.added_mass", 0.0)
    assert simulation.solver.points is simulation.model.points
    assert torch.isfinite(simulation.advance(state)[0].position).all()


def test_an_edit_keeps_the_air(hanging):
    simulation = hanging(air())
    state = simulation.edit(simulation.start(), Edit(density=60.0))
    expected = simulation.model.points.mass + added_mass_per_area(BREADTH, 1.225) * simulation.scene.patches.areas()
    torch.testing.assert_close(simulation.solver.points.mass, expected)
    assert torch.isfinite(simulation.advance(state)[0].position).all()


def test_gradients_by_the_density_pass(hanging):
    def end(density):
        simulation = hanging(air(), material=STIFF, substep=0.004)
        state = simulation.start()
        simulation.change("material.density", density)
        return simulation.advance(state)[0].position[:, 1].mean()

    density = double(30.0).requires_grad_()
    (slope,) = torch.autograd.grad(end(density), density)
    assert float(slope) == pytest.approx(float(end(30.1) - end(29.9)) / 0.2, rel=1e-3)


@pytest.mark.gpu
@in_both
def test_a_gpu_does_the_same_with_recorded_frames(formulation, hanging):
    """In float32, with another breadth from the third frame on."""
    if not torch.cuda.is_available():
        pytest.skip("needs a CUDA device")
    found = []
    for device in ("cpu", "cuda"):
        settings = {"formulation": formulation, "dtype": torch.float32, "wind": WindField([1.0, 5.0, 0.0])}
        simulation = hanging(air(drag=0.5), **settings).to(device)
        state, log = advanced(simulation, 3)
        simulation.change("aero.added_mass", 0.3)
        state, more = advanced(simulation, 4, state)
        found.append((state.position.cpu(), [*log, *more]))
    near(found[0][0], found[1][0], 1e-4)
    largest = max(health.kinetic for health in found[0][1])
    for name in ("kinetic", "potential", "wind_work"):
        ours, theirs = ([getattr(health, name) for health in log] for _, log in found)
        assert ours == pytest.approx(theirs, abs=0.01 * largest)
