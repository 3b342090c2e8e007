"""Buffers of the fused substep, what it refuses, and where the kernels are used."""

import dataclasses
import gc
import weakref
from contextlib import nullcontext

import pytest
import torch

from gaussian_swaying import Boundary, Box, MPMSolver, PinnedRegion, WindForce
from gaussian_swaying.geometry.regions import Everything
from gaussian_swaying.mpm.boundaries.impulse import Impulse
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
from gaussian_swaying.mpm.laws.fixed_corotated import FixedCorotated
from gaussian_swaying.mpm.laws.metal import Metal
from gaussian_swaying.mpm.triton import fused

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
    set_going,
)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_one_solver_within_inference_mode_and_without(kernel_device, formulation):
    """With patches that change in place in between."""
    points = make_points(kernel_device, count=12)
    solvers = [make_solver(transfer, formulation) for transfer in ("torch", "kernels")]
    load = make_load(points)
    with torch.inference_mode():
        ends = [solver.rollout(set_going(solver, points), DT, 1, load) for solver in solvers]
    load.area.mul_(3.0)
    check_agreement([solver.rollout(end, DT, 2, load) for solver, end in zip(solvers, ends, strict=True)])


def test_nothing_is_recorded_that_has_not_run(kernel_device):
    """A single substep of ``updated`` uses no kernel that ends one and starts another; recording would compile it."""
    points = make_points(kernel_device, count=12)
    solver = make_solver("kernels")
    state = solver.rollout(set_going(solver, points), DT, 1)
    assert not solver.fused().repeater._graphs
    solver.rollout(state, DT, 2)
    assert solver.fused().repeater._graphs


def test_nodes_far_from_all_particles_cost_nothing(kernel_device):
    """On a CPU ``updated`` leaves them alone, wherever the body goes, and reads none of them."""
    if kernel_device.type == "cuda":
        pytest.skip("a GPU visits all nodes")
    points = make_points(kernel_device, count=12)
    ends = []
    for poison in (0.0, float("nan")):
        solver = make_solver("kernels", "updated")
        state = set_going(solver, points)
        state = solver.rollout(state.replace(velocity=state.velocity + 3.0), DT, 1)
        fused = solver.fused()
        fused.velocity.fill_(poison)
        begin = state.position
        for _ in range(3):
            state = solver.rollout(state, DT, 40)
        ends.append(state)
    left = fused.velocity[: state.grid.node_count, :3].isnan().any(-1)
    assert 0.3 < left.float().mean() < 1
    assert float((state.position - begin).abs().max()) > 2 * DX
    for first, other in zip(*([end.position, end.velocity, end.affine] for end in ends), strict=True):
        assert torch.equal(first, other)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_boundaries_that_change(kernel_device, formulation):
    """A different window, a different buffer and a different object in it, and one in place, without ``init_state``."""
    points = make_points(kernel_device, count=12)
    ends = []
    for transfer in ("torch", "kernels"):
        pin, plane = PinnedRegion(LEFT), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0], "sticky")
        box = VelocityBox(Box([0.0, 0.0, 0.2], [1.0] * 3), [0.0, 1.0, 0.0])
        solver = make_solver(transfer, formulation, boundaries=[pin, plane, box])
        state = set_going(solver, points)
        found = [solver.rollout(state, DT, 1)]
        pin.end = 0.5 * DT
        found.append(solver.rollout(found[-1], DT, 1))
        plane.point = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64, device=kernel_device)
        found.append(solver.rollout(found[-1], DT, 1))
        box.region = TOP
        found.append(solver.rollout(found[-1], DT, 1))
        plane.point[2] = 0.14
        found.append(solver.rollout(found[-1], DT, 1))
        ends.append(found)
    check_agreement(ends)
    assert not torch.allclose(ends[0][1].velocity, ends[0][2].velocity, rtol=1e-2)
    assert bool((ends[0][4].impulse[1] != ends[0][3].impulse[1]).any())


def test_laws_that_change(kernel_device):
    ends = []
    for transfer in ("torch", "kernels"):
        law = Metal(5e2, 1e3)
        points, solver = make_points(kernel_device, law, count=12), make_solver(transfer)
        state = set_going(solver, points)
        solver.rollout(state, DT, 1)
        law.yield_stress = 2e3
        ends.append(solver.rollout(state, DT, 1))
    check_agreement(ends)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_buffers_end_with_their_solver(kernel_device, formulation):
    """Immediately: a GPU may need their memory for the next one before Python collects cycles. Also if recorded."""
    points = make_points(kernel_device, count=12)
    solver = make_solver("kernels", formulation, boundaries=[Plane([0, 0, 0.0], [0.0, 0, 1.0])])
    solver.rollout(set_going(solver, points), DT, 2)
    buffer = weakref.ref(solver.fused().load)
    gc.disable()
    try:
        del solver
        assert buffer() is None
    finally:
        gc.enable()


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_what_is_too_large_for_the_indices_is_refused(kernel_device, formulation, monkeypatch):
    points = make_points(kernel_device, count=12)
    monkeypatch.setattr(fused, "MAX_INDEX", 700)
    solver = make_solver("kernels", formulation)
    state = solver.init_state(points)
    with pytest.raises(ValueError, match=r"set `solver\.transfer` to torch"):
        solver.rollout(state, DT, 1)


# ---- where the kernels are used


@pytest.mark.parametrize("formulation", FORMULATIONS)
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
        with pytest.raises(ValueError, match="`transfer: kernels` has no gradients here"):
            attempt()
    with torch.no_grad():
        assert not only.rollout(start, DT, 1, load).position.requires_grad


class OwnLaw(FixedCorotated):
    """A custom law, which may do anything."""


@pytest.mark.parametrize("what", ["float64 on a GPU", "custom law"])
def test_what_the_kernels_cannot_do(kernel_device, what):
    """``auto`` uses torch, ``kernels`` raises an error with the reason."""
    points, reason = make_points(kernel_device), "the law OwnLaw has no Triton twin"
    if what == "custom law":
        points = dataclasses.replace(points, laws=(OwnLaw(),))
    elif kernel_device.type == "cpu":
        pytest.skip("a CPU computes in float64, too: see test_agreement.py")
    else:
        points, reason = points.map(torch.Tensor.double), "computes in float32, but the material is float64"
    solver = MPMSolver(dx=DX)
    state = solver.init_state(points)
    assert solver.fused() is None
    assert bool(torch.isfinite(solver.step(state, DT).position).all())
    assert reason in solver._fused_obstacle
    with pytest.raises(ValueError, match=reason):
        MPMSolver(dx=DX, transfer="kernels").init_state(points)


def test_who_computes_a_substep(kernel_device):
    """On a GPU sums of ``updated`` have no fixed order; on a CPU they always have one."""
    points, ordered = make_points(kernel_device), kernel_device.type == "cpu"
    for formulation, settings, has_kernels in (
        *((formulation, {}, True) for formulation in FORMULATIONS),
        *((formulation, {"transfer": "torch"}, False) for formulation in FORMULATIONS),
        ("total", {"deterministic": True}, True),
        ("updated", {"deterministic": True}, ordered),
    ):
        solver = MPMSolver(dx=DX, formulation=formulation, **settings)
        solver.init_state(points)
        assert (solver.fused() is not None) == has_kernels
        assert solver.deterministic == ("deterministic" in settings)
    solver = MPMSolver(dx=DX, formulation="updated", deterministic=True, transfer="kernels")
    with nullcontext() if ordered else pytest.raises(ValueError, match="sums have no fixed order"):
        solver.init_state(points)


def test_another_material_needs_other_buffers(kernel_device):
    solver = make_solver("kernels", "total")
    solver.init_state(make_points(kernel_device))
    first = solver.fused()
    assert solver.fused() is first
    solver.init_state(make_points(kernel_device, count=7))
    assert solver.fused().count == 7


def test_without_a_compiler_torch_computes(monkeypatch):
    """``triton`` says what is missing."""
    monkeypatch.setattr(fused, "compiles", lambda device: False)
    solver = MPMSolver(dx=DX)
    solver.init_state(make_points("cpu"))
    assert solver.fused() is None
    with pytest.raises(ValueError, match="llvmlite is not installed"):
        MPMSolver(dx=DX, transfer="kernels").init_state(make_points("cpu"))


class _Waiting(Boundary):
    """A custom condition that makes the host wait: it cannot be recorded."""

    def forward(self, velocity, nodes):
        return velocity * (0.5 if float(nodes.time) > 2.5 * DT else 1.0)


@pytest.mark.gpu
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_condition_that_waits_is_asked_each_time(formulation):
    pytest.importorskip("triton")
    points = make_points(torch.device("cuda"))
    ends = []
    for transfer in ("torch", "kernels"):
        solver = MPMSolver(dx=DX, formulation=formulation, transfer=transfer, boundaries=[_Waiting()])
        state = set_going(solver, points)
        for _ in range(3):
            state = solver.rollout(state, DT, 2)
        ends.append(state.velocity)
    assert float((ends[1] - ends[0]).abs().max()) < 6 * TOLERANCE * float(ends[0].abs().max())
