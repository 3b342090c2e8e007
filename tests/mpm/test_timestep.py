"""The stable substep: the formulas, and that the solver is stable just below and unstable above them."""

import pytest
import torch
from shared import solid

from gaussian_swaying import MPMSolver
from gaussian_swaying.mpm.damping import damped_substep
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


@pytest.mark.slow(gate=["0.0", "1.0"])
@pytest.mark.parametrize("damping", [0.0, 0.05, 1.0, 30.0])
def test_limit_is_sharp_for_one_particle(damping):
    """The bound is reached as a particle nears a plane where a weight vanishes, in the mode v_i = grad(w_i) / w_i.

    Also where stiffness damping, here in undamped limits, shortens it.
    """
    position = torch.full((1, 3), 0.05001, dtype=torch.float64)
    points = _points(position, nu=0.3)
    undamped = float(stable_limit(points, 0.1).amin())
    solver = MPMSolver(dx=0.1, gravity=(0, 0, 0), stiffness_damping=damping * undamped)
    limit = damped_substep(undamped, solver.stiffness_damping)
    assert (limit < undamped) == (damping > 0)
    for factor, stable in ((0.98, True), (1.02 if damping == 0 else 1.05, False)):
        state = solver.init_state(points)
        stencil = bspline_stencil(position, state.grid)
        mode = torch.zeros_like(state.node_velocity)
        mode[stencil.node] = 1e-9 * (stencil.basis[0, 1:4] / stencil.basis[0, 0]).T
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
@pytest.mark.parametrize(("nu", "damping"), [(0.0, 0.0), (0.3, 0.0), (0.45, 0.0), (0.0, 2.0), (0.45, 2.0)])
def test_random_bodies_are_stable_below_the_limit(formulation, nu, damping):
    """With stiffness damping, in undamped limits, the damped one."""
    points = _points(0.15 * torch.rand(40, 3, dtype=torch.float64), nu=nu)
    time = damping * float(stable_limit(points, 0.05).amin())
    solver = MPMSolver(dx=0.05, formulation=formulation, gravity=(0, 0, 0), stiffness_damping=time)
    kick = 1e-6 * torch.randn_like(points.position)
    state = solver.init_state(points, kick)
    end = solver.rollout(state, 0.98 * solver.stable_substep(), 150)
    assert float(end.velocity.abs().max()) < 2 * float(kick.abs().max())


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


def test_rounding_does_not_lengthen_a_fixed_substep_beyond_the_stable_one():
    points = _points(torch.rand(20, 3, dtype=torch.float64))
    solver = MPMSolver(dx=0.1)
    solver.init_state(points)
    limit = solver.stable_substep()
    fixed = MPMSolver(dx=0.1, substep=limit)
    assert fixed.substeps(fixed.init_state(points), 1.49 * limit) == 2
