"""What is given to a rollout and makes no sense is refused in one sentence, and so is an end that means nothing."""

import math

import pytest
import torch
from shared import ZERO, double, in_both, near, randn, seeded, solid, value_error, without_waits

from gaussian_swaying import Force, MPMSolver, _checks

DX, DT = 0.1, 1e-3
FORMULATIONS = ("total", "updated")


@pytest.fixture(autouse=True)
def _as_users_run_it(monkeypatch):
    monkeypatch.setattr(_checks, "VALUE_CHECKS", False)


def _block(side=3, dtype=torch.float64, device="cpu"):
    axis = (torch.arange(side, dtype=dtype, device=device) + 0.5) * 0.05
    return solid(torch.cartesian_prod(axis, axis, axis), 0.05**3)


def _solver(formulation, points=None, dx=DX):
    solver = MPMSolver(dx, formulation, gravity=ZERO)
    return solver, solver.init_state(_block() if points is None else points)


def _broken(*shape, row=7):
    value = torch.zeros(*shape).double()
    value[row] = math.nan
    return value


def _calls(solver, state):
    return (solver.step, lambda s, dt: solver.rollout(s, dt, 3), lambda s, dt: solver.watched_rollout(s, dt, 3)), state


@in_both
@pytest.mark.parametrize(
    ("dt", "kind", "message"),
    [
        (math.nan, ValueError, "Expected `dt` to be positive and finite, but got nan"),
        (math.inf, ValueError, "Expected `dt` to be positive and finite, but got inf"),
        (-DT, ValueError, "Expected `dt` to be positive and finite, but got -0.001"),
        (0.0, ValueError, "Expected `dt` to be positive and finite, but got 0"),
        (1.0, ValueError, "Expected `dt` of at most 0.017.* got 1 s: `solver.substeps"),
        ("1", TypeError, "Expected `dt` to be a number of seconds, but got str"),
        (torch.tensor(DT), TypeError, "Expected `dt` to be a number of seconds, but got Tensor"),
    ],
)
def test_a_substep_that_is_none(formulation, dt, kind, message):
    calls, state = _calls(*_solver(formulation))
    for call in calls:
        with pytest.raises(kind, match=message):
            call(state, dt)


@in_both
def test_no_stable_substep_is_refused(formulation):
    """The limit lies above the substep that is stable for any arrangement, and below it a usual body explodes."""
    for damping in (0.0, 0.01):
        solver = MPMSolver(DX, formulation, gravity=ZERO, stiffness_damping=damping)
        state = solver.init_state(_block(6), 1e-9 * randn(216, 3, generator=_random()))
        limit = solver.bound.longest_substep
        assert solver.stable_substep() < limit
        solver.rollout(state, solver.stable_substep(), 2)
        end = solver.rollout(state, 0.99 * limit, 12)  # a wave grows 3.3 times in a substep at 2 dx / c
        assert float(solver.energies(end)["kinetic"] / solver.energies(state)["kinetic"]) > 1e4


def _random():
    return seeded(0)


@in_both
def test_numbers_of_substeps(formulation):
    solver, state = _solver(formulation)
    for steps, kind, message in (
        (-1, ValueError, "not to be negative"),
        (2.5, TypeError, "a whole number, but got 2.5"),
    ):
        for call in (solver.rollout, solver.watched_rollout):
            with pytest.raises(kind, match=f"Expected `steps` .*{message}"):
                call(state, DT, steps)
    assert torch.equal(solver.rollout(state, DT, 0).position, state.position)


class _Broken(Force):
    """A force that is NaN from a time on."""

    def __init__(self, since):
        super().__init__()
        self.since = since

    def forward(self, state):
        bad = _broken(27, 3)
        return torch.where(state.time >= self.since, bad, 0 * bad.nan_to_num())


@in_both
def test_what_is_given_as_nan_is_named(formulation):
    solver, state = _solver(formulation)
    bad = _broken(27, 3)
    with value_error("the force of step on particle 7 is NaN"):
        solver.step(state, DT, force=bad)
    with value_error("the resistance of step of particle 7 is NaN"):
        solver.step(state, DT, force=torch.zeros_like(bad), drag=bad[:, 0])
    for call in (solver.rollout, solver.watched_rollout):
        with value_error("the force of _Broken on particle 7 is NaN"):
            call(state, DT, 3, _Broken(0.0))

    def lots(state):
        return torch.zeros_like(state.position), bad[:, 0]

    with value_error("the resistance of lots of particle 7 is NaN"):
        solver.rollout(state, DT, 3, lots)
    with pytest.raises(FloatingPointError, match=r"became NaN or infinite within the rollout: lower `dt` \(stable at"):
        solver.rollout(state, DT, 3, _Broken(1.5 * DT))
    name = "velocity" if formulation == "updated" else "node_velocity"
    given = getattr(state, name).clone()
    given[5] = math.nan
    with value_error(f"the velocity of {'particle' if formulation == 'updated' else 'node'} 5 is"):
        solver.rollout(state.replace(**{name: given}), DT, 3)
    with value_error("Expected `velocity` to be finite, but that of particle 7 is not"):
        solver.init_state(_block(), bad)


@in_both
def test_tensors_of_another_kind(formulation):
    solver, state = _solver(formulation)
    for name, shape in (("force", (27, 3)), ("drag", (27,))):
        given = torch.zeros(shape).double()
        for wrong, kind, message in (
            (given.float(), TypeError, f"Expected `{name}` in float64, as the material is, but got float32"),
            (given.to("meta"), ValueError, f"Expected `{name}` on cpu, .* but it is on meta"),
            (given[1:], ValueError, f"Expected `{name}` of shape"),
            (0.0, TypeError, f"Expected `{name}` to be a torch.Tensor, but got float"),
        ):
            with pytest.raises(kind, match=message):
                solver.step(state, DT, **{name: wrong})
    given = torch.zeros(27, 3).double()
    assert solver.rollout(state, DT, 1, lambda _: given.float()).position.dtype == torch.float64
    for wrong, kind, message in (
        (given.to(torch.complex128), TypeError, "Expected `force of FunctionForce` in float64, .* got complex128"),
        (given.to("meta"), ValueError, "Expected `force of FunctionForce` on cpu, .* but it is on meta"),
        (given[1:], ValueError, "Expected `force of FunctionForce` of shape"),
    ):
        with pytest.raises(kind, match=message):
            solver.rollout(state, DT, 1, lambda _, wrong=wrong: wrong)
    with pytest.raises(TypeError, match="Expected `velocity` in float64, as the material is, but got float32"):
        solver.init_state(_block(), given.float())
    with value_error("Expected `velocity` on cpu"):
        solver.init_state(_block(), given.to("meta"))


@in_both
def test_no_points(formulation):
    empty = solid(torch.zeros(0, 3), 1.0, 1.0, 1.0)
    with value_error("Expected `points` with at least one point, but got none"):
        MPMSolver(DX, formulation).init_state(empty)


@in_both
def test_the_state_of_another_solver(formulation):
    solver, state = _solver(formulation)
    other = FORMULATIONS[formulation == "total"]
    cases = [
        (_solver(formulation, _block(4))[1], ValueError, r"it has positions \(64, 3\) instead of \(27, 3\)"),
        (_solver(formulation, dx=0.05)[1], ValueError, "it has another grid"),
        (_solver(other)[1], ValueError, f"it is not one of the {formulation} formulation"),
        (_solver(formulation, _block(dtype=torch.float32))[1], TypeError, "`position of the state` in float64"),
        (state.replace(impulse=torch.zeros(2, 3)), ValueError, "it has 2 boundaries instead of 0"),
        (None, TypeError, "Expected `state` to be an MPMState, but got NoneType"),
    ]
    for given, kind, message in cases:
        for call in (
            solver.step,
            lambda s, dt: solver.rollout(s, dt, 1),
            lambda s, dt: solver.watched_rollout(s, dt, 1),
        ):
            with pytest.raises(kind, match=message):
                call(given, DT)
    solver.rollout(_solver(formulation)[1], DT, 1)  # one of an equal solver


def test_a_plate_that_leaves_its_grid():
    plate = _block()
    speed = double([12.0, 0.0, 0.0]).expand(27, 3)
    solver = MPMSolver(DX, "updated", gravity=ZERO)
    state = solver.init_state(plate, speed)
    for call in (solver.rollout, solver.watched_rollout):
        with value_error(r"left the grid .* call `solver.fit_grid\(state, 0.048\)` before"):
            call(state, 4 * DT, 12)

    def one_by_one():
        now = state
        for _ in range(12):
            now = solver.step(now, 4 * DT)

    with value_error(r"left the grid .* call `solver.fit_grid"):
        one_by_one()
    end = solver.rollout(solver.fit_grid(state, 0.048), 4 * DT, 12)
    near(end.velocity, speed, 12 * 12 * 27 * 2**-52)  # a sum of 27 in each substep
    marked = solver.rollout(state, 4 * DT, 12, check=False)
    assert marked.lost.any()
    with value_error("left the grid"):  # of the rollout before
        solver.rollout(solver.fit_grid(marked, DT), DT, 1)


def test_a_plate_that_a_force_drives_out_of_a_fitted_grid():
    solver, state = _solver("updated")
    push = torch.zeros(27, 3).double()
    push[:, 0] = 2e3 * solver.points.mass
    with value_error("with a `margin` of some cells"):
        solver.rollout(solver.fit_grid(state, 0.02), DT, 20, lambda _: push)
    end = solver.rollout(solver.fit_grid(state, 0.02, margin=8), DT, 20, lambda _: push)
    assert float(end.velocity[:, 0].min()) == pytest.approx(2e3 * 0.02)


def test_a_simulation_reads_what_is_wrong_with_its_measurements(monkeypatch):
    """One wait in a frame: the check at the end of a rollout would be another."""
    from gaussian_swaying.mpm import solver as module
    from gaussian_swaying.scenes.procedural import FlagScene
    from gaussian_swaying.simulation.simulation import Simulation

    seen = []
    monkeypatch.setattr(module, "_check_end", lambda *given: seen.append(given))
    simulation = Simulation(FlagScene(spacing=0.3), wind=[4, 0, 0], device="cpu")
    state, _ = simulation.advance(simulation.start())
    assert seen == []
    simulation.solver.rollout(state, 1e-4, 1)
    assert len(seen) == 1


@pytest.mark.gpu
@in_both
def test_on_a_gpu_a_rollout_is_checked_and_a_step_does_not_wait(formulation):
    points = _block(dtype=torch.float32, device="cuda")
    solver = MPMSolver(DX, formulation)
    state = solver.step(solver.init_state(points), DT)
    bad = _broken(27, 3).float().cuda()
    torch.cuda.synchronize()
    with without_waits():
        state = solver.step(state, DT, force=bad)
    with value_error("is NaN or infinite"):
        solver.rollout(state, DT, 2)
