"""Numbers of known states, and who is to blame for bad ones."""

import math
import warnings

import pytest
import torch

from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.sand import Sand
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.diagnostics import (
    FrameDiagnostics,
    SimulationDiverged,
    TearingGauge,
    check_state,
    diagnose,
    measure,
)


def _solver(**settings):
    position = torch.rand(30, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = MaterialPoints.create(position, volume=0.02, density=100.0, youngs_modulus=1e4, poisson_ratio=0.0)
    solver = MPMSolver(dx=0.2, formulation="updated", **settings)
    return solver, solver.init_state(points)


def test_numbers_of_a_known_state():
    """Stretched by 2, 1, 0.25, moved by (3, 0, 4), all with velocity (0, 0, 2)."""
    solver, state = _solver()
    F = torch.diag(torch.tensor([2.0, 1.0, 0.25], dtype=torch.float64)).expand(30, 3, 3)
    shift = torch.tensor([3.0, 0.0, 4.0], dtype=torch.float64)
    shift = shift * torch.linspace(0, 1, 30, dtype=torch.float64)[:, None]
    velocity = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64).expand(30, 3)
    lost = torch.zeros(30, dtype=torch.bool)
    lost[[3, 7]] = True
    start = state
    state = state.replace(
        position=state.position + shift,
        velocity=velocity,
        F_total=F,
        F_elastic=F,
        lost=lost,
        time=torch.tensor(0.6, dtype=torch.float64),
        work=torch.tensor(3.5, dtype=torch.float64),
    )
    health = diagnose(solver, state, 12, solver.cfl_number(state, 1e-3), before=start)
    assert health.time == pytest.approx(0.6)
    assert health.wind_work == 3.5
    assert (health.momentum_x, health.momentum_y, health.momentum_z) == (0.0, 0.0, pytest.approx(30 * 2.0 * 2.0))
    # r x p with p along z: (y, -x, 0) times 4 kg m/s each
    x, y, _ = state.position.sum(0).tolist()
    assert health.angular_momentum_x == pytest.approx(4.0 * y)
    assert health.angular_momentum_y == pytest.approx(-4.0 * x)
    assert health.angular_momentum_z == pytest.approx(0.0, abs=1e-12)
    assert (health.substeps, health.lost) == (12, 2)
    assert health.kinetic == pytest.approx(0.5 * 30 * 2.0 * 4.0)
    assert health.potential == pytest.approx(9.8 * 2.0 * float(state.position[:, 2].sum()))
    # nu = 0: lambda = 0, mu = E / 2, energy density = mu |Sigma - I|²
    assert health.elastic == pytest.approx(30 * 0.02 * 5e3 * (1.0 + 0.75**2), rel=1e-9)
    assert (health.J_min, health.J_max) == (pytest.approx(0.5), pytest.approx(0.5))
    assert (health.stretch_min, health.stretch_max) == (pytest.approx(0.25), pytest.approx(2.0))
    assert (health.displacement_mean, health.displacement_max) == (pytest.approx(2.5), pytest.approx(5.0))
    # c = sqrt(2 mu / rho) = 10 m/s, twice that in a cell stretched by 2, and 2 m/s of motion
    assert health.cfl == pytest.approx(1e-3 * (2 * 10.0 + 2.0) / 0.2)
    assert health.as_dict()["kinetic"] == health.kinetic


def test_forces_on_supports(make_simulation):
    """The momentum that each boundary took in the frame over its time; a plane far away takes none."""
    pin, plane = PinnedRegion(Box([None, None, None], [0.11, None, None])), Plane([0, 0, -9], [0, 0, 1])
    simulation = make_simulation(pinned=False, boundaries=[pin, plane])
    before = simulation.start()
    after, health = simulation.advance(before)
    force = (after.impulse - before.impulse) / 0.04
    torch.testing.assert_close(torch.tensor(health.support, dtype=torch.float64), force)
    assert health.support[1] == (0.0, 0.0, 0.0)
    assert health.support[0][2] < 0 < health.support[0][0]
    row = health.as_dict()
    assert [row[f"support_0_{axis}"] for axis in "xyz"] == list(health.support[0])
    assert diagnose(simulation.solver, before, 0, 0.0).support == ((0.0, 0.0, 0.0),) * 2


def test_extremes_are_those_of_single_particles():
    solver, state = _solver()
    F = state.F_total.clone()
    F[4, 0, 0], F[9, 1, 1] = 3.0, -0.5
    position = state.position.clone()
    position[7] += 0.1
    health = diagnose(solver, state.replace(F_total=F, position=position), 1, 1e-3)
    assert (health.J_min, health.J_max) == (pytest.approx(-0.5), pytest.approx(3.0))
    assert (health.moved_particle, health.compressed_particle, health.stretched_particle) == (7, 9, 4)


def test_extremes_of_a_batch_name_the_particles_of_their_scenes():
    """The third scene moved most, the second is compressed most, the first is stretched most."""
    alone, _ = _solver()
    solver = MPMSolver(dx=alone.dx)
    state = solver.init_state(MaterialPoints.stack([alone.points] * 3))
    F, position = state.F_total.clone(), state.position.clone()
    F[0, 4, 0, 0], F[2, 5, 0, 0] = 3.0, 2.0
    F[1, 9, 1, 1], F[0, 3, 1, 1] = 0.5, 0.7
    position[2, 7] += 0.1
    position[0, 8] += 0.05
    health = diagnose(solver, state.replace(F_total=F, position=position), 1, 1e-3)
    assert (health.moved_particle, health.compressed_particle, health.stretched_particle) == (7, 9, 4)
    assert health.stretch_max == pytest.approx(3.0)


def _row(spacing=0.1, count=6, law=None):
    """Particles along x, one or two to a cell of 0.1 m."""
    position = torch.zeros(count, 3, dtype=torch.float64)
    position[:, 0] = torch.arange(count) * spacing
    points = MaterialPoints.create(position, volume=1e-3, density=1.0, youngs_modulus=1e3, poisson_ratio=0.3, law=law)
    solver = MPMSolver(dx=0.1, formulation="updated")
    return solver, solver.init_state(points)


def test_torn_particles_are_counted():
    """A gap of more than two cells opens between the third and the fourth particle of a row."""
    solver, state = _row()
    gauge = TearingGauge(solver, count=2)
    shift = torch.zeros_like(state.position)
    for gap, torn in ((0.0, 0), (0.09, 0), (0.11, 2), (0.21, 2), (5.0, 2)):
        shift[3:, 0] = gap
        # the two inner neighbours of the gap are 0.1 m apart at rest, so 0.2 m once the gap is 0.1 m
        assert int(gauge(state.position + shift).sum()) == torn, gap
        assert diagnose(solver, state.replace(position=state.position + shift), 1, 1e-3, tearing=gauge).torn == torn
    turn = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    assert not bool(gauge(state.position @ turn.T + 7.0).any())


def test_what_was_apart_at_rest_or_flows_is_not_torn():
    solver, state = _row(spacing=0.25)
    assert not bool(TearingGauge(solver)(state.position).any())
    solver, state = _row(law=Sand())
    assert not bool(TearingGauge(solver)(10 * state.position).any())
    solver, state = _row(law=FixedCorotated())
    assert bool(TearingGauge(solver)(10 * state.position).all())


def test_a_lost_particle_is_named():
    solver, state = _solver()
    lost = torch.zeros(30, dtype=torch.bool)
    lost[[5, 6]] = True
    with pytest.raises(SimulationDiverged, match=r"particle 5: it left the grid \(2 particles did\).*EnclosingBox"):
        check_state(solver, state.replace(lost=lost))


def test_a_particle_far_away_is_named():
    solver, state = _solver()
    position = state.position.clone()
    position[11, 2] += 2000.0
    with pytest.raises(SimulationDiverged, match=r"particle 11: it is more than 1000 object sizes"):
        check_state(solver, state.replace(position=position))


def test_what_is_worst_is_named_first():
    """Of one particle that is several things at once; of several particles the first."""
    solver, state = _solver()
    lost = torch.zeros(30, dtype=torch.bool)
    lost[[5, 9]] = True
    position = state.position.clone()
    position[5] = math.inf
    with pytest.raises(SimulationDiverged, match=r"particle 5: .*NaN"):
        check_state(solver, state.replace(lost=lost, position=position))
    position[5], position[3] = 0.0, 3000.0
    with pytest.raises(SimulationDiverged, match=r"particle 3: it is more than 1000 object sizes"):
        check_state(solver, state.replace(lost=lost, position=position))


@pytest.mark.parametrize("name", ["position", "velocity", "F_elastic"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_bad_component_is_enough_and_the_first_particle_is_named(name, dtype):
    solver, state = _solver()
    for column in range(9 if name == "F_elastic" else 3):
        for value in (math.nan, math.inf, -math.inf):
            field = getattr(state, name).to(dtype).clone()
            field.flatten(1)[[17, 21], column] = value
            bad = state.replace(**{name: field}, time=torch.tensor(0.25, dtype=torch.float64))
            words = r"t = 0\.25 s, particle 17: .*NaN.*Remedy: lower `solver\.cfl`"
            with pytest.raises(SimulationDiverged, match=words) as info:
                check_state(solver, bad)
            assert (info.value.particle, info.value.time) == (17, 0.25)


def test_a_measurement_can_check_as_well():
    solver, state = _solver()
    gauge = TearingGauge(solver)
    known = diagnose(solver, state, 3, 0.25, gauge)
    assert diagnose(solver, state, 3, 0.25, gauge, check=True) == known
    assert diagnose(solver, state, 3, torch.tensor(0.25), gauge) == known
    assert known.cfl == 0.25
    bad = state.replace(velocity=state.velocity * math.nan, time=torch.tensor(0.25, dtype=torch.float64))
    diagnose(solver, bad, 3, 0.25)
    messages = []
    for look in (lambda: check_state(solver, bad), lambda: diagnose(solver, bad, 3, 0.25, check=True)):
        with pytest.raises(SimulationDiverged, match=r"t = 0\.25 s, particle 0: .*NaN") as info:
            look()
        messages.append(str(info.value))
    assert messages[0] == messages[1]


def test_scenes_of_a_batch_are_summed():
    """Two scenes, one of them twice as heavy, against each by itself; the second particle of the second is lost."""
    position = torch.rand(12, 3, dtype=torch.float64)
    settings = {"volume": 0.02, "youngs_modulus": 1e4, "poisson_ratio": 0.3}
    density = torch.tensor([[100.0], [200.0]], dtype=torch.float64)

    def health(position, density, lost):
        points = MaterialPoints.create(position, density=density, **settings)
        solver = MPMSolver(dx=0.2, formulation="updated")
        state = solver.init_state(points, torch.ones_like(position))
        return diagnose(solver, state.replace(position=2 * position, lost=lost), 1, 0.1, tearing=TearingGauge(solver))

    lost = torch.zeros(2, 12, dtype=torch.bool)
    lost[1, 1] = True
    both = health(torch.stack([position, position + 0.5]), density, lost)
    each = [health(position + 0.5 * k, density[k], lost[k]) for k in range(2)]
    for name in ("kinetic", "potential", "elastic", "momentum_x", "angular_momentum_y", "lost", "torn"):
        assert getattr(both, name) == pytest.approx(sum(getattr(one, name) for one in each)), name
    assert (both.lost, both.displacement_max) == (1, max(one.displacement_max for one in each))
    assert both.torn > 0


@pytest.mark.gpu
@pytest.mark.parametrize("formulation", ["total", "updated"])
def test_a_frame_is_measured_in_one_transfer(formulation):
    position = torch.rand(200, 3, device="cuda")
    points = MaterialPoints.create(position, volume=0.02, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3)
    solver = MPMSolver(dx=0.2, formulation=formulation)
    state = solver.init_state(points)
    gauge, work = TearingGauge(solver), torch.zeros((), dtype=torch.float64, device="cuda")
    diagnose(solver, state, 1, work, gauge, check=True)
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as waits:
            warnings.simplefilter("always")
            diagnose(solver, state, 1, work, gauge, check=True)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len([wait for wait in waits if "synchroniz" in str(wait.message)]) == 1


def test_numbers_of_a_batch_are_those_of_its_scenes():
    """Two scenes with states of their own; the work of the wind is what it did since the state before."""
    draw = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.randn(*shape, generator=draw, dtype=torch.float64)

    rest = torch.rand(30, 3, generator=draw, dtype=torch.float64)
    moved, velocity, F = 0.1 * random(2, 30, 3), random(2, 30, 3), torch.eye(3) + 0.1 * random(2, 30, 3, 3)
    lost = torch.rand(2, 30, generator=draw) < 0.2
    done, work = random(2), torch.tensor([3.5, -1.25], dtype=torch.float64)

    def numbers(index, measured):
        position = rest.expand(2, 30, 3)[index].clone()
        points = MaterialPoints.create(position, volume=0.02, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3)
        solver = MPMSolver(dx=0.2, formulation="updated")
        before = solver.init_state(points).replace(work=done[index])
        state = before.replace(
            position=position + moved[index],
            velocity=velocity[index],
            F_total=F[index],
            F_elastic=F[index],
            lost=lost[index],
            work=(done + work)[index],
        )
        return measured(solver, state, before)

    found = numbers(slice(None), lambda *of: measure(of[0], of[1], 7, 0.1, before=of[2]).each())
    assert len(found) == 2
    for k in range(2):
        expected = numbers(k, lambda *of, k=k: diagnose(of[0], of[1], 7, 0.1, before=of[2]))
        for name in FrameDiagnostics.__dataclass_fields__:
            one, other = getattr(found[k], name), getattr(expected, name)
            if name == "support":
                one, other = ([value for force in part for value in force] for part in (one, other))
            assert one == pytest.approx(other, rel=1e-9, abs=1e-12), name
