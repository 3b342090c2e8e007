"""Whole steps of both formulations against exact solutions."""

import dataclasses

import pytest
import torch
from shared import solid
from torch.testing import assert_close

from gaussian_swaying import Box, MaterialPoints, MPMSolver, MPMState, PinnedRegion
from gaussian_swaying.mpm.state import GridSpec

FORMULATIONS = ["total", "updated"]


def _block(*batch, dtype=torch.float64, device="cpu", count=200, e=1e4, density=100.0):
    generator = torch.Generator().manual_seed(3)
    position = 0.4 * torch.rand(*batch, count, 3, generator=generator, dtype=torch.float64)
    return solid(position.to(device, dtype), 0.4**3 / count, density, e)


def _sheet(width=0.6, height=0.4, spacing=0.025, dtype=torch.float32, e=3e3, density=30.0):
    x = (torch.arange(round(width / spacing), dtype=dtype) + 0.5) * spacing
    z = (torch.arange(round(height / spacing), dtype=dtype) + 0.5) * spacing
    gx, gz = (g.reshape(-1) for g in torch.meshgrid(x, z, indexing="ij"))
    position = torch.stack([gx, 0.003 * torch.sin(9 * gx), gz], dim=-1)
    return solid(position, spacing**2 * 0.01, density, e)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_free_fall_follows_the_symplectic_sum(formulation, device, dtype):
    """x_n = x0 + g dt² n (n + 1) / 2 for every particle, and no strain."""
    points = _block(dtype=dtype, device=device)
    solver = MPMSolver(dx=0.1, formulation=formulation)
    dt, steps = 1e-3, 50
    state = solver.rollout(solver.init_state(points), dt, steps)
    fall = -9.8 * dt * dt * steps * (steps + 1) / 2
    # round-off: each of the steps may err by a few ulp of the largest coordinate
    tol = 4 * steps * torch.finfo(dtype).eps
    expected = points.position + torch.tensor([0.0, 0.0, fall], dtype=dtype, device=device)
    assert_close(state.position, expected, rtol=0, atol=tol)
    assert float((state.F_elastic - torch.eye(3, dtype=dtype, device=device)).abs().max()) < 10 * tol / 0.1
    assert float(state.time) == pytest.approx(steps * dt)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_external_force_moves_the_centre_of_mass(formulation):
    points = _block()
    solver = MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0))
    force = torch.rand(200, 3, dtype=torch.float64) * 1e-2
    state = solver.rollout(solver.init_state(points), 1e-3, 20, lambda _: force)
    momentum = (points.mass[:, None] * state.velocity).sum(0)
    assert_close(momentum, force.sum(0) * 0.02, rtol=1e-10, atol=0)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_damping_is_a_rate_and_not_per_substep(formulation):
    points = _block()
    solver = MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0), damping=3.0)
    velocity = torch.ones(200, 3, dtype=torch.float64)
    for steps in (10, 40):
        end = solver.rollout(solver.init_state(points, velocity), 0.1 / steps, steps)
        assert_close(end.velocity, velocity * torch.exp(torch.tensor(-0.3, dtype=torch.float64)))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_batch_equals_scenes_alone(formulation, device):
    """(B, P, 3) is B independent scenes, each with its own material and wind."""
    points = _block(2, 2, device=device)
    points = dataclasses.replace(
        points, youngs_modulus=points.youngs_modulus * torch.tensor([[1.0, 2.0], [3.0, 4.0]], device=device)[..., None]
    )
    force = 1e-3 * torch.randn(2, 2, 200, 3, dtype=torch.float64, device=device)
    pin = [PinnedRegion(Box([None, None, 0.35], [None, None, None]))]
    together = MPMSolver(dx=0.1, formulation=formulation, boundaries=pin)
    state = together.rollout(together.init_state(points), 1e-3, 10, lambda _: force)
    assert state.position.shape == (2, 2, 200, 3)
    for i in range(2):
        for j in range(2):
            alone = MPMSolver(dx=0.1, formulation=formulation, boundaries=pin)
            single = alone.init_state(points.map(lambda t, i=i, j=j: t[i, j]))
            end = alone.rollout(single, 1e-3, 10, lambda _, i=i, j=j: force[i, j])
            assert_close(state.position[i, j], end.position, rtol=0, atol=1e-12)
            assert_close(state.F_total[i, j], end.F_total, rtol=0, atol=1e-12)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_each_particle_has_its_own_material(formulation):
    """Two blocks far apart in one run, with different E, nu and density, move as each does alone."""
    parts, ends = [], []
    for shift, e, nu, density in ((0.0, 1e4, 0.2, 50.0), (2.0, 4e4, 0.45, 200.0)):
        position = _block(count=60).position + torch.tensor([shift, 0.0, 0.0], dtype=torch.float64)
        part = solid(position, 1e-3, density, e, nu)
        parts.append(part)
        alone = MPMSolver(dx=0.1, formulation=formulation)
        velocity = 0.5 * (position - position.mean(0))
        ends.append(alone.rollout(alone.init_state(part, velocity), 5e-4, 40).F_elastic)
    together = MPMSolver(dx=0.1, formulation=formulation)
    velocity = torch.cat([0.5 * (part.position - part.position.mean(0)) for part in parts])
    end = together.rollout(together.init_state(MaterialPoints.join(parts), velocity), 5e-4, 40)
    assert_close(end.F_elastic, torch.cat(ends), rtol=0, atol=1e-11)
    assert float((ends[0] - ends[1]).abs().max()) > 1e-4


def test_formulations_agree_on_a_vibrating_block():
    """A free block in its first stretching mode, over most of a period, within the discretisation error of either."""
    axis = (torch.arange(12, dtype=torch.float64) + 0.5) / 30
    position = torch.cartesian_prod(axis, axis, axis)
    points = solid(position, 1 / 27000, 100.0, 2e4)
    velocity = torch.zeros_like(position)
    velocity[:, 0] = -torch.cos(torch.pi * position[:, 0] / 0.4)
    ends = []
    for formulation in FORMULATIONS:
        solver = MPMSolver(dx=1 / 15, formulation=formulation, gravity=(0, 0, 0))
        ends.append(solver.rollout(solver.init_state(points, velocity), 5e-4, 50).position)
    moved = (ends[0] - position).norm(dim=-1).max()
    assert float(moved) > 0.005
    assert float((ends[0] - ends[1]).norm(dim=-1).max()) < 0.25 * float(moved)
    # the mode itself: 50 transfers take 4.5 % of its amplitude, 0.024 (pi / 6)^4 of the kinetic half each (test_bars)
    speed, mode = (2e4 * 0.7 / (1.3 * 0.4) / 100) ** 0.5, velocity / velocity.norm()
    here, there = (float(((end - position) * mode).sum()) for end in ends)
    assert here == pytest.approx(there, abs=0.06 * float(velocity.norm()) * 0.4 / (torch.pi * speed))


@pytest.mark.slow(gate=["total"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_flag_hung_by_one_row_does_not_slide_off(formulation):
    """Four seconds: a pin that only resets its particles lets the sheet fall at 70 % of free fall."""
    points = _sheet(spacing=0.05, e=1e4)
    pin = PinnedRegion(Box([None, None, 0.37], [None, None, None]))
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[pin], damping=0.5)
    state = solver.init_state(points)
    row = points.position[:, 2] > 0.37
    assert int(row.sum()) == 12
    with torch.inference_mode():
        for _ in range(100):
            steps = solver.substeps(state, 0.04)
            state = solver.rollout(solver.fit_grid(state, 0.04), 0.04 / steps, steps)
    # static stretch: rho g L² / (2 E) = 2.4 mm; free fall would be 78 m, sliding off 54 m
    assert float((state.position - points.position)[row].norm(dim=-1).max()) < 0.01
    assert float((state.position - points.position).norm(dim=-1).max()) < 0.05
    assert not bool(state.lost.any())


def test_total_moves_with_particles_on_half_cell_planes():
    """A layer exactly on a half-cell plane creates nodes of zero mass; an unguarded division gives NaN."""
    x = torch.arange(8, dtype=torch.float64) * 0.05 + 0.05
    position = torch.stack(torch.meshgrid(x, torch.tensor([0.05], dtype=torch.float64), x, indexing="ij"), -1)
    points = solid(position.reshape(-1, 3), 1e-5, 30.0, 3e3)
    for dtype in (torch.float32, torch.float64):
        for shift in (0.0, 1e-9, -1e-8, 1e-5):
            moved = points.map(lambda t, dtype=dtype: t.to(dtype))
            moved = dataclasses.replace(moved, position=moved.position + shift)
            solver = MPMSolver(dx=0.1, boundaries=[PinnedRegion(Box([None, None, 0.35], [None, None, None]))])
            state = solver.rollout(solver.init_state(moved), 1e-3, 200)
            assert bool(torch.isfinite(state.position).all())
            # let go unstretched, a bar is strained by 2 rho g L / E at most, and longer by rho g L² / E after 2, 6, ...
            # times L / c, here 0.005 s before the end; to second order in a cell over its length
            load, length = 30.0 * 9.8 / 3e3, 0.325
            assert float((state.F_elastic - torch.eye(3, dtype=dtype)).abs().max()) < 2 * load * length
            lowest = float((state.position - moved.position).norm(dim=-1).max())
            assert lowest == pytest.approx(load * length**2, rel=2 * (0.1 / length) ** 2)


def test_grid_follows_the_object_without_changing_the_motion():
    points = _block(count=50)
    velocity = torch.tensor([5.0, -3.0, 0.0], dtype=torch.float64).expand(50, 3)
    solver = MPMSolver(dx=0.1, formulation="updated")
    following = fixed = solver.init_state(points, velocity, margin=40)
    for _ in range(5):
        following = solver.rollout(solver.fit_grid(following, 0.04), 2e-3, 20)
        fixed = solver.rollout(fixed, 2e-3, 20)
    assert following.grid != fixed.grid
    assert following.grid.node_count < 0.1 * fixed.grid.node_count
    assert_close(following.position, fixed.position, rtol=0, atol=1e-13)
    assert not bool(following.lost.any())


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


def test_what_flies_on_needs_a_new_grid_the_more_rarely_the_farther_it_is():
    """One side moves by 5 cells a frame, from 50 to 2050 cells: a factor of 41, or 1.125 to the power 32."""
    grid, grids = GridSpec(0.1, (0, 0, 0), (50, 20, 20)), set()
    for frame in range(401):
        needed = GridSpec(0.1, (0, 0, 0), (50 + 5 * frame, 20, 20))
        if not grid.holds(needed):
            grid = needed.with_room(grid)
        grids.add(grid)
    assert 20 < len(grids) < 2 * 32
    assert grid.node_count < 1.2 * GridSpec(0.1, (0, 0, 0), (2050 + 8, 20 + 8, 20 + 8)).node_count


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
    solver = MPMSolver(dx=0.1, formulation="updated")
    state = solver.init_state(points)
    broken = getattr(state, name).clone()
    broken[7, 1] = value
    with pytest.raises(kind, match=match):
        solver.fit_grid(state.replace(**{name: broken}), 0.04)
    far = state.replace(position=state.position + 1e12)
    with pytest.raises(ValueError, match=r"more than 2\^31 cells"):
        solver.fit_grid(far, 0.04)


@pytest.mark.gpu
def test_a_grid_on_a_gpu_stays_while_it_serves():
    """CUDA graphs are recorded for one grid: a body that drifts slowly needs a new one only from time to time."""
    points = _block(dtype=torch.float32, device="cuda")
    solver = MPMSolver(dx=0.05, formulation="updated", gravity=(0, 0, 0))
    state = solver.init_state(points, torch.full_like(points.position, 0.2))
    grids = []
    for _ in range(40):
        state = solver.fit_grid(state, 0.04)
        grids.append(state.grid)
        state = solver.rollout(state, 1e-3, 40)
    assert not state.lost.any()
    assert 1 < len(set(grids)) < 10
    assert max(grid.node_count for grid in grids) < 40**3


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_watched_rollout_is_a_rollout_that_saw_the_largest_courant_number(formulation):
    """A block that expands and contracts: its stiffness is largest on the way, not at the end. In torch to the bit.

    The kernels of `updated` sort particles at the start of a rollout, so parts of one have other sums.
    """
    for transfer, tolerance in (("torch", 0.0), ("kernels", 1e-12)):
        _watch(MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0), transfer=transfer), tolerance)


def _watch(solver, tolerance):
    points = _block()
    centre = points.position.mean(0)
    start = solver.init_state(points, 40 * (points.position - centre))
    seen, state = [], start
    for _ in range(10):
        state = solver.rollout(state, 2e-4, 16)
        seen.append(float(solver.cfl_number(state, 2e-4)))
    end, largest = solver.watched_rollout(start, 2e-4, 160, looks=10)
    assert_close(end.position, state.position, rtol=0, atol=tolerance)
    assert float(largest) == pytest.approx(max(seen), rel=tolerance, abs=0)
    assert max(seen) > 1.02 * max(seen[0], seen[-1])


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_work_is_what_the_force_adds_to_the_energy(formulation):
    """A constant force on a body that does not deform: work is force times distance, and equals its kinetic energy."""
    points = _block(2)
    solver = MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0))
    pull = torch.tensor([[[3.0, 0.0, 0.0]], [[0.0, 6.0, 0.0]]], dtype=torch.float64)
    force = points.mass[..., None] * pull
    state = solver.rollout(solver.init_state(points), 1e-3, 20, lambda state: force)
    assert state.work.shape == (2,)
    assert state.work.dtype == torch.float64
    assert_close(state.work, solver.energies(state)["kinetic"], rtol=1e-9, atol=0)


def test_particle_that_outruns_its_grid_is_marked_lost():
    points = _block(count=20)
    solver = MPMSolver(dx=0.1, formulation="updated", gravity=(0, 0, 0))
    state = solver.init_state(points, torch.full((20, 3), 50.0, dtype=torch.float64), margin=1)
    state = solver.rollout(state, 2e-3, 20, check=False)
    assert bool(state.lost.any())


def test_grid_that_grows_too_large_is_refused(monkeypatch):
    monkeypatch.setattr("gaussian_swaying.mpm.formulations.formulation.MAX_NODES", 100)
    points = _block(count=20)
    with pytest.raises(ValueError, match=r"more than 100:"):
        MPMSolver(dx=0.05).init_state(points)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_state_dict_round_trip(formulation, tmp_path):
    solver = MPMSolver(dx=0.1, formulation=formulation, boundaries=[PinnedRegion(Box([None, None, 0.35], [None] * 3))])
    state = solver.rollout(solver.init_state(_block()), 1e-3, 5)
    assert float(state.impulse.abs().max()) > 0
    torch.save(state.state_dict(), tmp_path / "state.pt")
    back = MPMState.from_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    assert back.grid == state.grid
    for field in dataclasses.fields(MPMState):
        a, b = getattr(state, field.name), getattr(back, field.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, field.name
    one, two = solver.step(state, 1e-3), solver.step(back, 1e-3)
    assert torch.equal(one.position, two.position)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_step_is_differentiable(formulation):
    """Gradient of a few steps with respect to the initial velocity and a force, against finite differences."""
    points = _block(count=4)
    solver = MPMSolver(dx=0.2, formulation=formulation)

    def run(velocity, force):
        state = solver.rollout(solver.init_state(points, velocity), 1e-3, 3, lambda _: force)
        return state.position, state.F_elastic

    velocity = torch.randn(4, 3, dtype=torch.float64).requires_grad_()
    force = (1e-2 * torch.randn(4, 3, dtype=torch.float64)).requires_grad_()
    assert torch.autograd.gradcheck(run, (velocity, force), fast_mode=True)


def test_energies_of_known_states():
    points = _block()
    solver = MPMSolver(dx=0.1)
    state = solver.init_state(points, torch.tensor([1.0, 2.0, 2.0], dtype=torch.float64).expand(200, 3))
    energies = solver.energies(state)
    mass = float(points.mass.sum())
    assert float(energies["kinetic"]) == pytest.approx(0.5 * mass * 9)
    assert float(energies["elastic"]) == pytest.approx(0.0, abs=1e-20)
    assert float(energies["potential"]) == pytest.approx(9.8 * float((points.mass * points.position[:, 2]).sum()))


def test_module_moves_its_material(dtype):
    solver = MPMSolver(dx=0.1)
    solver.init_state(_block())
    solver.to(dtype)
    assert solver.points.position.dtype == dtype
    assert solver.bound.node_mass.dtype == dtype


def test_bad_settings_are_refused():
    for arguments in (
        {"dx": 0.0},
        {"formulation": "lagrange"},
        {"gravity": (0, 0)},
        {"damping": -1.0},
        {"stiffness_damping": -1e-3},
        {"cfl": 0.0},
        {"substep": -1e-3},
    ):
        (name,) = arguments
        with pytest.raises(ValueError, match=f"`{name}` to "):
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
        with pytest.raises(ValueError, match=f"`{field}`"):
            MaterialPoints.create(torch.rand(5, 3), **(good | {name: value}))


def test_shapes_are_checked():
    solver = MPMSolver(dx=0.1)
    state = solver.init_state(_block(count=64))
    with pytest.raises(ValueError, match=r"Expected `force` of shape \(64, 3\), but got \(64, 2\)"):
        solver.step(state, 1e-3, force=torch.zeros(64, 2))
    with pytest.raises(ValueError, match=r"Expected `velocity` of shape \(64, 3\), but got \(63, 3\)"):
        solver.init_state(_block(count=64), torch.zeros(63, 3))
    with pytest.raises(TypeError, match="Expected `points` to be a MaterialPoints"):
        solver.init_state(torch.zeros(3, 3))
    with pytest.raises(ValueError, match=r"Expected `mass` of shape \(5,\)"):
        MaterialPoints(torch.rand(5, 3), torch.rand(4), *(torch.rand(5) for _ in range(3)))
    with pytest.raises(RuntimeError, match="call `init_state"):
        MPMSolver().points  # noqa: B018
