"""The Courant number and the elastic energy from the kernels."""

import math

import pytest
import torch
from catalogue import ELASTIC, PLASTIC

from gaussian_swaying.mpm.triton import measures

from .bodies import DT, FORMULATIONS, make_points, make_solver, noise, set_going


@pytest.mark.parametrize("formulation", FORMULATIONS)
@pytest.mark.parametrize("law", ["corotated", "springs", "hencky"])
def test_courant_number(kernel_device, formulation, law):
    """Against torch in float64; each particle counts."""
    points = make_points(kernel_device, ELASTIC[law], count=48)
    state = set_going(make_solver("torch", formulation), points)
    solver = _bound(make_solver("kernels", formulation), points)
    exact = _bound(make_solver("torch", formulation), points.map(torch.Tensor.double))
    strained = torch.eye(3).repeat(4, 48, 1, 1)
    strained[0] = 4.0 * noise(32, 48, 3, 3)
    for row, k in enumerate((0, 17, 47), 1):
        strained[row, k] *= 0.5 if law == "hencky" else 2  # stiffer than the others
    found = []
    for row, F in enumerate(strained):
        at = state.replace(F_elastic=F.to(kernel_device))
        at = at if row == 0 else at.replace(velocity=torch.zeros_like(state.velocity))
        wide = at.replace(**{n: getattr(at, n).double() for n in ("F_elastic", "F_total", "velocity", "position")})
        found.append(float(exact.bound.cells_per_second(wide)))
        assert float(measures.largest_speed(solver.bound, at)) == pytest.approx(found[-1], rel=1e-5)
        assert float(solver.cfl_number(at, DT)) == pytest.approx(float(exact.cfl_number(wide, DT)), rel=1e-5)
    assert len(set(found)) >= (4 if law == "corotated" else 2)  # a network never stiffens by more than densities differ


def _bound(solver, points):
    solver.init_state(points)
    return solver


@pytest.mark.parametrize("law", ["corotated", "springs", "sand"])
def test_elastic_energy(kernel_device, law):
    """For a batch, against float64, and from the kernel."""
    points = make_points(kernel_device, (ELASTIC | PLASTIC)[law], batch=(2,))
    solver = make_solver("kernels")
    state = set_going(solver, points)
    exact = make_solver("torch")
    wide = set_going(exact, points.map(torch.Tensor.double))
    wide = wide.replace(F_elastic=state.F_elastic.double(), F_total=state.F_total.double())
    expected = exact.energies(wide)["elastic"]
    solver.laws.energy = None
    found = solver.energies(state)["elastic"]
    assert found.shape == (2,)
    torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)


@pytest.mark.parametrize("law", ["corotated", "springs", "hencky"])
def test_courant_number_of_what_is_broken_is_not_finite(kernel_device, law):
    points = make_points(kernel_device, ELASTIC[law])
    solver = _bound(make_solver("kernels"), points)
    state = set_going(solver, points)
    state.F_elastic[3, 1, 1] = math.nan
    assert not math.isfinite(float(solver.cfl_number(state, DT)))
