import dataclasses

import pytest
import torch
from shared import ZERO, alike, beyond, double, in_both, longest, near, peak, rand, seeded, solid, value_error
from torch.testing import assert_close

from gaussian_swaying import MaterialPoints, MPMSolver, MPMState, PinnedRegion
from gaussian_swaying.mpm.state import GridSpec


def _block(*batch, dtype=torch.float64, device="cpu", count=200, e=1e4, density=100.0):
    generator = seeded(3)
    position = 0.4 * rand(*batch, count, 3, generator=generator)
    return solid(position.to(device, dtype), 0.4**3 / count, density, e)


@in_both
def test_free_fall_follows_the_symplectic_sum(formulation, device, dtype):
    points = _block(dtype=dtype, device=device)
    solver = MPMSolver(0.1, formulation)
    state, steps, before, speed, fall = solver.init_state(points), 50, 1e-3, 0.0, 0.0
    for dt in (1e-3, 8e-4):
        state = solver.rollout(state, dt, steps // 2)
        for _ in range(steps // 2):
            speed += 9.8 * 0.5 * (before + dt)
            fall -= speed * dt
            before = dt
    # round-off: each of the steps may err by a few ulp of the largest coordinate
    tol = 4 * steps * torch.finfo(dtype).eps
    expected = points.position + torch.tensor([0.0, 0.0, fall], dtype=dtype, device=device)
    near(state.position, expected, tol)
    assert peak(state.F_elastic - torch.eye(3, dtype=dtype, device=device)) < 10 * tol / 0.1
    assert float(state.time) == pytest.approx(0.045)


@in_both
def test_damping_is_a_rate_and_not_per_substep(formulation):
    points = _block()
    solver = MPMSolver(0.1, formulation, gravity=ZERO, damping=3.0)
    velocity = torch.ones(200, 3).double()
    for steps in (10, 40):
        end = solver.rollout(solver.init_state(points, velocity), 0.1 / steps, steps)
        assert_close(end.velocity, velocity * torch.exp(double(-0.3)))


def test_total_moves_with_particles_on_half_cell_planes():
    """A layer exactly on a half-cell plane creates nodes of zero mass; an unguarded division gives NaN."""
    x = torch.arange(8).double() * 0.05 + 0.05
    position = torch.stack(torch.meshgrid(x, double([0.05]), x, indexing="ij"), -1)
    points = solid(position.reshape(-1, 3), 1e-5, 30.0, 3e3)
    for dtype in (torch.float32, torch.float64):
        for shift in (0.0, 1e-9, -1e-8, 1e-5):
            moved = points.map(lambda t, dtype=dtype: t.to(dtype))
            moved = dataclasses.replace(moved, position=moved.position + shift)
            solver = MPMSolver(0.1, boundaries=[PinnedRegion(beyond(z=0.35))])
            state = solver.rollout(solver.init_state(moved), 1e-3, 200)
            assert torch.isfinite(state.position).all()
            # let go unstretched, a bar is strained by 2 rho g L / E at most, and longer by rho g L² / E after 2, 6, ...
            # times L / c, here 0.005 s before the end; to second order in a cell over its length
            load, length = 30.0 * 9.8 / 3e3, 0.325
            assert peak(state.F_elastic - torch.eye(3, dtype=dtype)) < 2 * load * length
            lowest = float(longest(state.position - moved.position))
            assert lowest == pytest.approx(load * length**2, rel=2 * (0.1 / length) ** 2)


def test_grid_follows_the_object_without_changing_the_motion():
    points = _block(count=50)
    velocity = double([5.0, -3.0, 0.0]).expand(50, 3)
    solver = MPMSolver(0.1, "updated")
    following = fixed = solver.init_state(points, velocity, margin=40)
    for _ in range(5):
        following = solver.rollout(solver.fit_grid(following, 0.04), 2e-3, 20)
        fixed = solver.rollout(fixed, 2e-3, 20)
    assert following.grid != fixed.grid
    assert following.grid.node_count < 0.1 * fixed.grid.node_count
    near(following.position, fixed.position, 1e-13)
    assert not following.lost.any()


def test_a_grid_holds_what_lies_within_it():
    grid = GridSpec(0.1, (-2, 0, 3), (5, 4, 6))
    assert grid.holds(grid)
    assert grid.holds(GridSpec(0.1, (-1, 1, 3), (4, 3, 6)))
    for other in (
        GridSpec(0.1, (-3, 0, 3), (5, 4, 6)),
        GridSpec(0.1, (-2, 0, 3), (5, 5, 6)),
        GridSpec(0.2, (-2, 0, 3), (5, 4, 6)),
    ):
        assert not grid.holds(other)


def test_room_lies_where_a_grid_was_outgrown():
    before = GridSpec(0.1, (0, 0, 0), (40, 40, 40))
    needed = GridSpec(0.1, (2, -1, 0), (80, 30, 40))
    roomy = needed.with_room(before)
    assert roomy == GridSpec(0.1, (2 - 4, -1 - 4, -4), (4 + 80 + 10, 4 + 30 + 4, 4 + 40 + 4))
    assert roomy.holds(needed)


@pytest.mark.parametrize(
    ("name", "value", "kind", "match"),
    [
        ("position", float("nan"), FloatingPointError, "The position of particle 7 is NaN or infinite"),
        ("position", float("-inf"), FloatingPointError, "The position of particle 7 is NaN or infinite"),
        ("position", 1e25, ValueError, "more than 64,000,000"),
        ("velocity", float("nan"), FloatingPointError, "The speed of particle 7 is NaN or infinite"),
        ("velocity", 1e30, FloatingPointError, "The speed of particle 7 is NaN or infinite"),  # its square is
        ("velocity", 1e15, ValueError, "may fly .* more than 64,000,000"),
    ],
)
def test_no_grid_for_what_is_not_finite_or_too_far(device, name, value, kind, match):
    points = _block(dtype=torch.float32, device=device)
    solver = MPMSolver(0.1, "updated")
    state = solver.init_state(points)
    broken = getattr(state, name).clone()
    broken[7, 1] = value
    with pytest.raises(kind, match=match):
        solver.fit_grid(state.replace(**{name: broken}), 0.04)
    far = state.replace(position=state.position + 1e12)
    with value_error(r"more than 2\^31 cells"):
        solver.fit_grid(far, 0.04)


@in_both
def test_watched_rollout_is_a_rollout_that_saw_the_largest_courant_number(formulation):
    """A block that expands and contracts: its stiffness is largest on the way, not at the end. In torch to the bit.

    The kernels of `updated` sort particles at the start of a rollout, so parts of one have other sums.
    """
    for transfer, tolerance in (("torch", 0.0), ("kernels", 1e-12)):
        _watch(MPMSolver(0.1, formulation, gravity=ZERO, transfer=transfer), tolerance)


def _watch(solver, tolerance):
    points = _block()
    centre = points.position.mean(0)
    start = solver.init_state(points, 40 * (points.position - centre))
    seen, state = [], start
    for _ in range(10):
        state = solver.rollout(state, 2e-4, 16)
        seen.append(float(solver.cfl_number(state, 2e-4)))
    end, largest = solver.watched_rollout(start, 2e-4, 160, looks=10)
    near(end.position, state.position, tolerance)
    assert float(largest) == pytest.approx(max(seen), rel=tolerance, abs=0)
    assert max(seen) > 1.02 * max(seen[0], seen[-1])


@in_both
def test_work_is_what_the_force_adds_to_the_energy(formulation):
    """A constant force on a body that does not deform: work is force times distance, and equals its kinetic energy.

    (B, P, 3) is B independent scenes, of any shape B.
    """
    points = _block(2, 2)
    solver = MPMSolver(0.1, formulation, gravity=ZERO)
    pull = double([[[3.0, 0, 0], [0, 6, 0]], [[1, 2, 0], [0, 0, 0.5]]])[..., None, :]
    force = points.mass[..., None] * pull
    state = solver.rollout(solver.init_state(points), 1e-3, 20, lambda state: force)
    assert state.work.shape == (2, 2)
    assert state.work.dtype == torch.float64
    alike(state.work, solver.energies(state)["kinetic"], 1e-9)
    assert_close(state.velocity, (0.02 * pull).expand_as(state.velocity), rtol=1e-9, atol=1e-12)


@in_both
def test_state_dict_round_trip(formulation, tmp_path):
    solver = MPMSolver(0.1, formulation, boundaries=[PinnedRegion(beyond(z=0.35))])
    state = solver.rollout(solver.init_state(_block()), 1e-3, 5)
    assert peak(state.impulse) > 0
    torch.save(state.state_dict(), tmp_path / "state.pt")
    back = MPMState.from_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert back.grid == state.grid
    for field in dataclasses.fields(MPMState):
        a, b = getattr(state, field.name), getattr(back, field.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, field.name
    one, two = solver.step(state, 1e-3), solver.step(back, 1e-3)
    assert torch.equal(one.position, two.position)


def test_bad_settings_are_refused():
    for arguments in (
        {"dx": 0.0},
        {"formulation": "lagrange"},
        {"gravity": (0, 0)},
        {"damping": -1.0},
        {"stiffness_damping": -1e-3},
        {"cfl": 0.0},
        {"substep": -1e-3},
        {"transfer": "tritn"},
    ):
        (name,) = arguments
        with value_error(f"{name}` to "):
            MPMSolver(**arguments)


def test_bad_material_is_refused():
    good = {"volume": 1e-3, "density": 1.0, "youngs_modulus": 1e3, "poisson_ratio": 0.3}
    for name, value, field in (
        ("poisson_ratio", 0.5, "nu"),
        ("youngs_modulus", 0.0, "E"),
        ("density", -3.0, "density"),
        ("volume", -1e-3, "volume"),
        ("density", float("nan"), "density"),
    ):
        with value_error(f"`{field}`"):
            MaterialPoints.create(torch.rand(5, 3), **(good | {name: value}))


def test_shapes_are_checked():
    solver = MPMSolver(0.1)
    with value_error(r"Expected `velocity` of shape \(64, 3\), but got \(63, 3\)"):
        solver.init_state(_block(count=64), torch.zeros(63, 3))
    with pytest.raises(TypeError, match="Expected `points` to be a MaterialPoints"):
        solver.init_state(torch.zeros(3, 3))
    with value_error(r"Expected `mass` of shape \(5,\)"):
        MaterialPoints(torch.rand(5, 3), torch.rand(4), *(torch.rand(5) for _ in range(3)))
    with pytest.raises(RuntimeError, match="call `init_state"):
        MPMSolver().points  # noqa: B018
