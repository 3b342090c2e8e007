import dataclasses
import gc
import weakref
from contextlib import nullcontext

import pytest
import torch
from catalogue import ELASTIC
from shared import in_both, peak, value_error

from gaussian_swaying import Boundary, MPMSolver, PinnedRegion, WindField, WindForce
from gaussian_swaying.geometry.regions import Everything, HalfSpace
from gaussian_swaying.mpm import run
from gaussian_swaying.mpm.colliders import Wall
from gaussian_swaying.mpm.laws.elastic import FixedCorotated
from gaussian_swaying.mpm.pins import Impulse

from .bodies import (
    DT,
    DX,
    FORMULATIONS,
    LEFT,
    TOLERANCE,
    TOP,
    check_agreement,
    make_load,
    make_points,
    make_solver,
    noise,
    run_both,
    set_going,
)


@in_both
def test_one_solver_within_inference_mode_and_without(kernel_device, formulation):
    points = make_points(kernel_device, count=12)
    solvers = [make_solver(transfer, formulation) for transfer in ("torch", "kernels")]
    load = make_load(points)
    with torch.inference_mode():
        ends = [solver.rollout(set_going(solver, points), DT, 1, load) for solver in solvers]
    load.area.mul_(3.0)
    check_agreement([solver.rollout(end, DT, 2, load) for solver, end in zip(solvers, ends, strict=True)])


@in_both
def test_buffers_end_with_their_solver(kernel_device, formulation):
    """Immediately: a GPU may need their memory for the next one before Python collects cycles. Also if recorded."""
    points = make_points(kernel_device, count=12)
    solver = make_solver("kernels", formulation, boundaries=[Wall(HalfSpace([0, 0, 0.0], [0.0, 0, 1.0]))])
    solver.rollout(set_going(solver, points), DT, 2)
    buffer = weakref.ref(solver.kernels.load)
    gc.disable()
    try:
        del solver
        assert buffer() is None
    finally:
        gc.enable()


@in_both
def test_what_is_too_large_for_the_indices_is_refused(kernel_device, formulation, monkeypatch):
    points = make_points(kernel_device, count=12)
    monkeypatch.setattr(run, "MAX_INDEX", 700)
    solver = make_solver("kernels", formulation)
    state = solver.init_state(points)
    with value_error(r"set `solver\.transfer` to torch"):
        solver.rollout(state, DT, 1)


# ---- where the kernels are used


@in_both
def test_gradients_are_left_to_torch_or_to_their_kernels(kernel_device, formulation):
    points = make_points(kernel_device)
    auto = make_solver("auto", formulation)
    state = set_going(auto, points)
    velocity = state.velocity.clone().requires_grad_()
    load = make_load(points)
    name = "node_velocity" if formulation == "total" else "velocity"
    start = state.replace(**{name: getattr(state, name).clone().requires_grad_()})
    assert auto.rollout(start, DT, 2, load).position.requires_grad
    assert auto.step(state, DT, force=velocity).position.requires_grad
    area = load.area.clone().requires_grad_()
    assert auto.rollout(state, DT, 1, WindForce(load.aero, load.wind, load.normal, area)).position.requires_grad
    knock = Impulse(Everything(), [0.0, 0.0, 0.1], end=DT)
    knock.impulse.requires_grad_()
    pushed = make_solver("auto", formulation, boundaries=[knock])
    assert pushed.rollout(set_going(pushed, points), DT, 1).position.requires_grad
    only = make_solver("kernels", formulation)
    only.init_state(points)
    if formulation == "total":  # these have kernels, see test_adjoint.py
        assert only.rollout(start, DT, 2, load).position.requires_grad
        assert only.step(start, DT).position.requires_grad
    for attempt in (
        lambda: only.step(state, DT, force=velocity),
        lambda: only.rollout(start, DT, 2, load if formulation == "updated" else [load, load]),
    ):
        with value_error("`transfer: kernels` has no gradients here"):
            attempt()
    with torch.no_grad():
        assert not only.rollout(start, DT, 1, load).position.requires_grad


class OwnLaw(FixedCorotated):
    """A custom law, which may do anything."""

    def pk1(self, F, mu, lam, internal=None):
        return super().pk1(F, mu, lam, internal)


@pytest.mark.parametrize("what", ["float64 on a GPU", "custom law"])
def test_what_the_kernels_cannot_do(kernel_device, what):
    points, reason = make_points(kernel_device), "the law OwnLaw has no device functions"
    if what == "custom law":
        points = dataclasses.replace(points, laws=(OwnLaw(),))
    elif kernel_device.type == "cpu":
        pytest.skip("a CPU computes in float64, too: see test_agreement.py")
    else:
        points, reason = points.map(torch.Tensor.double), "computes in float32, but the material is float64"
    solver = MPMSolver(DX)
    state = solver.init_state(points)
    assert solver.kernels is None
    assert torch.isfinite(solver.step(state, DT).position).all()
    assert reason in solver._obstacle
    with value_error(reason):
        MPMSolver(DX, transfer="kernels").init_state(points)


def test_who_computes_a_substep(kernel_device):
    points, ordered = make_points(kernel_device), kernel_device.type == "cpu"
    for formulation, settings, has_kernels in (
        *((formulation, {}, True) for formulation in FORMULATIONS),
        *((formulation, {"transfer": "torch"}, False) for formulation in FORMULATIONS),
        ("total", {"deterministic": True}, True),
        ("updated", {"deterministic": True}, ordered),
    ):
        solver = MPMSolver(DX, formulation, **settings)
        solver.init_state(points)
        assert (solver.kernels is not None) == has_kernels
        assert solver.deterministic == ("deterministic" in settings)
    solver = MPMSolver(DX, "updated", deterministic=True, transfer="kernels")
    with nullcontext() if ordered else value_error("sums have no fixed order"):
        solver.init_state(points)


class _Waiting(Boundary):
    """A custom condition that makes the host wait: it cannot be recorded."""

    def forward(self, velocity, nodes):
        return velocity * (0.5 if float(nodes.time) > 2.5 * DT else 1.0)


@pytest.mark.gpu
@in_both
def test_a_condition_that_waits_is_asked_each_time(formulation):
    pytest.importorskip("triton")
    points = make_points(torch.device("cuda"))
    ends = []
    for transfer in ("torch", "kernels"):
        solver = MPMSolver(DX, formulation, transfer=transfer, boundaries=[_Waiting()])
        state = set_going(solver, points)
        for _ in range(3):
            state = solver.rollout(state, DT, 2)
        ends.append(state.velocity)
    assert peak(ends[1] - ends[0]) < 6 * TOLERANCE * peak(ends[0])


# ---- the Courant number from the kernels


@in_both
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
        assert float(solver.kernels.largest_speed(at)) == pytest.approx(found[-1], rel=1e-5)
        assert float(solver.cfl_number(at, DT)) == pytest.approx(float(exact.cfl_number(wide, DT)), rel=1e-5)
    assert len(set(found)) >= (4 if law == "corotated" else 2)  # a network never stiffens by more than densities differ


def _bound(solver, points):
    solver.init_state(points)
    return solver


# ---- held points and nodes


@pytest.mark.gpu
def test_held_points_stay_where_they_are_and_give_the_same_bits():
    """Thousands of substeps in float32, from graphs."""
    pytest.importorskip("triton")
    points = make_points("cuda", count=2000)
    ends = []
    for _ in range(2):
        solver = make_solver(
            "kernels", "total", deterministic=True, boundaries=[PinnedRegion(LEFT), PinnedRegion(TOP, "clamp")]
        )
        ends.append(solver.rollout(set_going(solver, points, strain=0.02), 2e-4, 4000, make_load(points)))
    for name in ("position", "velocity", "node_velocity", "impulse"):
        assert torch.equal(getattr(ends[0], name), getattr(ends[1], name))
    pinned = solver.bound.pinned_rows.rows
    rows = (pinned.weight[0, 0][..., None] * ends[0].node_displacement[pinned.node[0, 0]].double()).sum(-2)
    start = set_going(solver, points, strain=0.02).node_displacement
    before = (pinned.weight[0, 0][..., None] * start[pinned.node[0, 0]].double()).sum(-2)
    assert peak(rows - before) < 1e-5 * DX


def test_nodes_held_in_a_batch_of_winds(kernel_device):
    points = make_points(kernel_device, count=40, batch=(2,))
    winds = [WindField([0.0, -8.0, 0.0]), WindField([3.0, 9.0, 0.0])]
    listed = make_load(points, winds)
    load = WindForce(listed.aero, WindField.together(listed.wind), listed.normal[0], listed.area[0])
    boundaries = [PinnedRegion(LEFT, kind="nodes")]
    ends = run_both(points, lambda solver, state: solver.rollout(state, DT, 2, load), "total", boundaries=boundaries)
    check_agreement(ends)
    assert peak(ends[0].impulse) > 0
    torch.testing.assert_close(ends[1].impulse, ends[0].impulse, rtol=1e-3, atol=1e-12)
