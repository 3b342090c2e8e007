import itertools
import math

import pytest
import torch
from shared import double, in_both, rand, randn, seeded, up_to, waits

from gaussian_swaying.geometry.regions import HalfSpace
from gaussian_swaying.mpm.colliders import Wall
from gaussian_swaying.mpm.laws.elastic import FixedCorotated
from gaussian_swaying.mpm.laws.plastic import Sand
from gaussian_swaying.mpm.pins import PinnedRegion
from gaussian_swaying.mpm.solver import MPMSolver
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.simulation.measure import (
    FrameDiagnostics,
    SimulationDiverged,
    TearingGauge,
    measure,
)


def _measured(*given, check=False, **more):
    return measure(*given, **more).read(check)


def _solver(dtype=torch.float64):
    position = torch.rand(30, 3, generator=seeded(0), dtype=dtype)
    points = MaterialPoints.create(position, volume=0.02, density=100.0, youngs_modulus=1e4, poisson_ratio=0.0)
    solver = MPMSolver(0.2, "updated")
    return solver, solver.init_state(points)


def test_numbers_of_a_known_state():
    """Stretched by 2, 1, 0.25, moved by (3, 0, 4), all with velocity (0, 0, 2)."""
    solver, state = _solver()
    F = torch.diag(double([2.0, 1.0, 0.25])).expand(30, 3, 3)
    shift = double([3.0, 0.0, 4.0])
    shift = shift * torch.linspace(0, 1, 30, dtype=torch.float64)[:, None]
    velocity = double([0.0, 0.0, 2.0]).expand(30, 3)
    lost = torch.zeros(30, dtype=torch.bool)
    lost[[3, 7]] = True
    start = state
    state = state.replace(
        position=state.position + shift,
        velocity=velocity,
        F_total=F,
        F_elastic=F,
        lost=lost,
        time=double(0.6),
        work=double(3.5),
    )
    health = _measured(solver, state, 12, solver.cfl_number(state, 1e-3), before=start)
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
    pin, plane = PinnedRegion(up_to(x=0.11)), Wall(HalfSpace([0, 0, -9], [0, 0, 1]))
    simulation = make_simulation(pinned=False, boundaries=[pin, plane])
    before = simulation.start()
    after, health = simulation.advance(before)
    force = (after.impulse - before.impulse) / 0.04
    torch.testing.assert_close(double(health.support), force)
    assert health.support[1] == (0.0, 0.0, 0.0)
    assert health.support[0][2] < 0 < health.support[0][0]
    row = health.as_dict()
    assert [row[f"support_0_{axis}"] for axis in "xyz"] == list(health.support[0])
    assert _measured(simulation.solver, before, 0, 0.0).support == ((0.0, 0.0, 0.0),) * 2


def test_extremes_are_those_of_single_particles():
    solver, state = _solver()
    F = state.F_total.clone()
    F[4, 0, 0], F[9, 1, 1] = 3.0, -0.5
    position = state.position.clone()
    position[7] += 0.1
    health = _measured(solver, state.replace(F_total=F, position=position), 1, 1e-3)
    assert (health.J_min, health.J_max) == (pytest.approx(-0.5), pytest.approx(3.0))
    assert (health.moved_particle, health.compressed_particle, health.stretched_particle) == (7, 9, 4)


def _row(spacing=0.1, count=6, law=None):
    """Particles along x, one or two to a cell of 0.1 m."""
    position = torch.zeros(count, 3).double()
    position[:, 0] = torch.arange(count) * spacing
    points = MaterialPoints.create(position, volume=1e-3, density=1.0, youngs_modulus=1e3, poisson_ratio=0.3, law=law)
    solver = MPMSolver(0.1, "updated")
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
        assert _measured(solver, state.replace(position=state.position + shift), 1, 1e-3, tearing=gauge).torn == torn
    turn = double([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    assert not gauge(state.position @ turn.T + 7.0).any()


def test_what_was_apart_at_rest_or_flows_is_not_torn():
    solver, state = _row(spacing=0.25)
    assert not TearingGauge(solver)(state.position).any()
    solver, state = _row(law=Sand())
    assert not TearingGauge(solver)(10 * state.position).any()
    solver, state = _row(law=FixedCorotated())
    assert TearingGauge(solver)(10 * state.position).all()


def _refused(solver, state, told):
    with pytest.raises(SimulationDiverged, match=told) as caught:
        _measured(solver, state, 3, 0.25, check=True)
    return caught.value.particle, caught.value.time


def test_what_is_worst_is_named_first():
    solver, state = _solver()
    lost = torch.zeros(30, dtype=torch.bool)
    lost[[5, 6]] = True
    _refused(solver, state.replace(lost=lost), r"particle 5: it left the grid \(2 particles did\).*Wall")
    position = state.position.clone()
    position[5] = math.inf
    bad = state.replace(lost=lost, position=position)
    _refused(solver, bad, r"particle 5: .*NaN")
    assert _measured(solver, bad, 3, 0.25).lost == 2
    position[5], position[3] = 0.0, 3000.0
    _refused(solver, bad, r"particle 3: it is more than 1000 object sizes")


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_one_bad_component_is_enough_and_the_first_particle_is_named(dtype):
    solver, state = _solver(dtype)
    state = state.replace(time=double(0.25))
    told = r"t = 0\.25 s, particle 17: .*NaN.*Remedy: lower `solver\.cfl`"
    for name, value in itertools.product(("position", "velocity", "F_elastic"), (math.nan, math.inf, -math.inf)):
        for column in range(getattr(state, name).flatten(1).shape[1]):
            field = getattr(state, name).clone()
            field.flatten(1)[[17, 21], column] = value
            assert _refused(solver, state.replace(**{name: field}), told) == (17, 0.25)


@pytest.mark.gpu
@in_both
def test_a_frame_is_measured_in_one_transfer(formulation):
    position = torch.rand(200, 3, device="cuda")
    points = MaterialPoints.create(position, volume=0.02, density=100.0, youngs_modulus=1e4, poisson_ratio=0.3)
    solver = MPMSolver(0.2, formulation)
    state = solver.init_state(points)
    gauge, work = TearingGauge(solver), torch.zeros((), dtype=torch.float64, device="cuda")
    _measured(solver, state, 1, work, gauge, check=True)
    assert waits(lambda: _measured(solver, state, 1, work, gauge, check=True)) == 1


def test_numbers_of_a_batch_are_those_of_its_scenes():
    """Two scenes with states of their own; the work of the wind is what it did since the state before."""
    draw = seeded(0)

    def random(*shape):
        return randn(*shape, generator=draw)

    rest = rand(30, 3, generator=draw)
    moved, velocity, F = 0.1 * random(2, 30, 3), random(2, 30, 3), torch.eye(3) + 0.1 * random(2, 30, 3, 3)
    lost = torch.rand(2, 30, generator=draw) < 0.2
    done, work = random(2), double([3.5, -1.25])

    def measurement(index):
        position = rest.expand(2, 30, 3)[index].clone()
        points = MaterialPoints.create(
            position,
            volume=0.02,
            density=torch.tensor([[100.0], [200.0]])[index],
            youngs_modulus=1e4,
            poisson_ratio=0.3,
        )
        solver = MPMSolver(0.2, "updated")
        before = solver.init_state(points).replace(work=done[index])
        state = before.replace(
            position=position + moved[index],
            velocity=velocity[index],
            F_total=F[index],
            F_elastic=F[index],
            lost=lost[index],
            work=(done + work)[index],
        )
        return measure(solver, state, 7, torch.tensor(0.1).double(), TearingGauge(solver), before)

    both = measurement(slice(None))
    found, whole = both.each(), both.read()
    for name in ("kinetic", "potential", "elastic", "wind_work", "momentum_x", "angular_momentum_y", "lost", "torn"):
        assert getattr(whole, name) == pytest.approx(sum(getattr(one, name) for one in found)), name
    assert whole.lost > 0
    assert whole.torn > 0
    for name, particle in (("displacement_max", "moved_particle"), ("stretch_max", "stretched_particle")):
        first = max(found, key=lambda one: getattr(one, name))
        assert (getattr(whole, name), getattr(whole, particle)) == (getattr(first, name), getattr(first, particle))
    for k, one in enumerate(found):
        expected = measurement(k).read()
        for name in FrameDiagnostics.__dataclass_fields__:
            own, other = getattr(one, name), getattr(expected, name)
            if name == "support":
                own, other = ([value for force in part for value in force] for part in (own, other))
            assert own == pytest.approx(other, rel=1e-9, abs=1e-12), name
