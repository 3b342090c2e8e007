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
    """Against float64; without care, the closed form of the eigenvalues loses digits if two are equal."""
    points = make_points(kernel_device, ELASTIC[law], count=48)
    state = set_going(make_solver("torch", formulation), points)
    eye = torch.eye(3)
    stretches = torch.tensor([[2.0, 2.0, 1.0], [2.0, 1.0, 1.0], [0.5, 2.0, 2.0], [3.0, 3.0, 3.0], [1.0, 0.0, 0.0]])
    double = torch.linalg.qr(noise(30, 48, 3, 3))[0]
    double = double @ stretches[torch.arange(48) % 5].diag_embed() @ double.mT
    solver = make_solver("kernels", formulation)
    solver.init_state(points)
    exact = make_solver("torch", formulation)
    exact.init_state(points.map(torch.Tensor.double))
    largest = []
    for F in (eye + 1e-4 * noise(31, 48, 3, 3), 4.0 * noise(32, 48, 3, 3), double, 1e-12 * double, 0 * double):
        at = state.replace(F_elastic=F.to(kernel_device))
        wide = {n: getattr(at, n).double() for n in ("F_elastic", "F_total", "velocity", "position")}
        largest.append(float(measures.largest_speed(solver.bound, at)))
        assert largest[-1] == pytest.approx(float(exact.bound.cells_per_second(at.replace(**wide))), rel=1e-5)
        # in torch and float32, where the digits are there
        if F is not double:
            assert float(solver.cfl_number(at, DT)) == pytest.approx(
                float(_bound(make_solver("torch", formulation), points).cfl_number(at, DT)), rel=1e-5
            )
    assert len(set(largest)) >= (3 if law == "hencky" else 4)  # its logarithms are linear in all that is crushed
    for k in range(48):  # each particle counts
        F = torch.eye(3).repeat(48, 1, 1)
        F[k] *= 0.5 if law == "hencky" else 2  # stiffer than the others
        at = state.replace(F_elastic=F.to(kernel_device), velocity=torch.zeros_like(state.velocity))
        if k in (0, 17, 47):
            wide = {n: getattr(at, n).double() for n in ("F_elastic", "F_total", "velocity", "position")}
            one = float(exact.bound.cells_per_second(at.replace(**wide)))
            assert float(measures.largest_speed(solver.bound, at)) == pytest.approx(one, rel=1e-5)
            # a network never stiffens by more than particles differ in density
            assert one > 1.2 * largest[0] or law == "springs" or formulation == "updated"


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
