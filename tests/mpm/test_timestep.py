"""The stable substep: the formulas, and that the solver is stable just below and unstable above them."""

import math

import pytest
import torch
from shared import solid

from gaussian_swaying import MPMSolver
from gaussian_swaying.mpm.timestep import stable_limit, substeps_per_frame, wave_speed
from gaussian_swaying.mpm.transfer import bspline_stencil


def _points(position, e=1e4, nu=0.3, density=100.0):
    return solid(position, 1e-6, density, e, nu)


@pytest.mark.parametrize(
    ("e", "nu", "density", "expected"),
    [(2e6, 0.4, 300, 119.5), (1e4, 0.4, 15, 37.8), (5e5, 0.4, 200, 73.2), (1e4, 0.3, 20, 25.9), (3e3, 0.3, 20, 14.2)],
)
def test_wave_speeds_of_the_papers_scenes(e, nu, density, expected):
    speed = wave_speed(_points(torch.zeros(1, 3, dtype=torch.float64), e, nu, density))
    assert float(speed[0]) == pytest.approx(expected, abs=0.05)


def test_frame_is_divided_without_losing_a_substep():
    """int(4e-2 / 2e-5) is 1999."""
    assert int(4e-2 / 2e-5) == 1999
    assert substeps_per_frame(4e-2, 2e-5, exact=True) == 2000
    assert substeps_per_frame(4e-2, 2e-5, exact=False) == 2000
    assert substeps_per_frame(0.04, 0.03, exact=False) == 2
    assert substeps_per_frame(0.04, 1.0, exact=False) == 1


def _growth(solver, points, dt, steps=150):
    """Largest velocity after a tiny random kick, relative to the kick."""
    kick = 1e-6 * torch.randn_like(points.position)
    state = solver.init_state(points, kick)
    state = solver.rollout(state, dt, steps)
    return float(state.velocity.abs().max() / kick.abs().max())


def test_limit_is_sharp_for_one_particle():
    """The bound is reached as a particle nears a plane where a weight vanishes, in the mode v_i = grad(w_i) / w_i."""
    position = torch.full((1, 3), 0.05001, dtype=torch.float64)
    points = _points(position, nu=0.3)
    solver = MPMSolver(dx=0.1, gravity=(0, 0, 0))
    limit = float(stable_limit(points, 0.1).amin())
    for factor, stable in ((0.99, True), (1.02, False)):
        state = solver.init_state(points)
        basis = bspline_stencil(position, state.grid).basis[0]
        mode = torch.zeros_like(state.node_velocity)
        mode[bspline_stencil(position, state.grid).node] = 1e-9 * (basis[1:4] / basis[0]).T
        end = solver.rollout(state.replace(node_velocity=mode), factor * limit, 400, check=False)
        strain = float((end.F_elastic - torch.eye(3, dtype=torch.float64)).abs().max())
        assert (strain < 1e-6) == stable, (factor, strain)


def test_updated_is_unstable_well_above_the_limit():
    points = _points(torch.full((1, 3), 0.05, dtype=torch.float64))
    solver = MPMSolver(dx=0.1, formulation="updated", gravity=(0, 0, 0))
    state = solver.init_state(points)
    state = state.replace(affine=1e-6 * torch.eye(3, dtype=torch.float64)[None])
    for factor, stable in ((0.98, True), (2.0, False)):
        end = solver.rollout(state, factor * solver.stable_substep(), 400, check=False)
        strain = float((end.F_elastic - torch.eye(3, dtype=torch.float64)).abs().max())
        assert (strain < 1e-5) == stable, (factor, strain)


@pytest.mark.parametrize("formulation", ["total", "updated"])
@pytest.mark.parametrize("nu", [0.0, 0.3, 0.45])
def test_random_bodies_are_stable_below_the_limit(formulation, nu):
    points = _points(0.15 * torch.rand(40, 3, dtype=torch.float64), nu=nu)
    solver = MPMSolver(dx=0.05, formulation=formulation, gravity=(0, 0, 0))
    assert _growth(solver, points, 0.98 * solver_limit(solver, points)) < 2


def solver_limit(solver, points):
    solver.init_state(points)
    return solver.stable_substep()


def test_cfl_of_0_47_never_exceeds_the_limit():
    for nu in (0.0, 0.2, 0.4, 0.49, 0.4999):
        points = _points(torch.zeros(1, 3, dtype=torch.float64), nu=nu)
        assert 0.47 / float(wave_speed(points)) <= float(stable_limit(points, 1.0))


def test_stretch_shortens_the_substep():
    points = _points(torch.zeros(1, 3, dtype=torch.float64))
    stretched = torch.diag(torch.tensor([2.0, 2.0, 0.5], dtype=torch.float64))[None]
    assert float(stable_limit(points, 1.0, stretched)) < 0.5 * float(stable_limit(points, 1.0))
    assert float(wave_speed(points, stretched)) > 1.5 * float(wave_speed(points))
    assert float(wave_speed(points, stretched, spatial=True)) == pytest.approx(2 * float(wave_speed(points, stretched)))


def test_adaptive_and_fixed_substeps():
    points = _points(torch.rand(20, 3, dtype=torch.float64))
    adaptive = MPMSolver(dx=0.1, cfl=0.4)
    state = adaptive.init_state(points)
    expected = math.ceil(0.04 * float(wave_speed(points).max()) / (0.4 * 0.1))
    assert adaptive.substeps(state, 0.04) == expected
    fixed = MPMSolver(dx=0.1, substep=2e-4)
    assert fixed.substeps(fixed.init_state(points), 0.04) == 200


def test_rounding_does_not_lengthen_a_fixed_substep_beyond_the_stable_one():
    points = _points(torch.rand(20, 3, dtype=torch.float64))
    solver = MPMSolver(dx=0.1)
    solver.init_state(points)
    limit = solver.stable_substep()
    fixed = MPMSolver(dx=0.1, substep=limit)
    assert fixed.substeps(fixed.init_state(points), 1.49 * limit) == 2


def test_fixed_substep_above_the_stable_one_is_refused():
    points = _points(torch.rand(20, 3, dtype=torch.float64))
    solver = MPMSolver(dx=0.1, substep=0.04)
    state = solver.init_state(points)
    stable = f"{solver.stable_substep():.4g}"
    with pytest.raises(ValueError, match=rf"fixed `substep` of 0\.04 s .* stable one of {stable} s"):
        solver.substeps(state, 0.04)
