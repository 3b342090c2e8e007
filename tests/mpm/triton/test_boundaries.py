"""Boundaries in the fused substep, and how often `updated` sorts its particles."""

import pytest
import torch

from gaussian_swaying import Box, PinnedRegion, WindField, WindForce
from gaussian_swaying.aero.wind_batch import WindBatch
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
from gaussian_swaying.mpm.triton import fused_updated

from .bodies import (
    DT,
    DX,
    LEFT,
    TOP,
    check_agreement,
    make_load,
    make_points,
    make_solver,
    on_each,
    run_both,
    set_going,
)
from .test_agreement import BOUNDARIES


@pytest.mark.parametrize(
    ("kernel_device", "name"), on_each("pin and plane", "walls and pins", cpu=["walls"]), indirect=["kernel_device"]
)
def test_boundaries_of_many_scenes(kernel_device, name):
    """Each scene has its own reaction impulses; a program may have nodes of two."""
    points = make_points(kernel_device, count=12, batch=(3,))

    def start(solver, points):
        state = set_going(solver, points)
        return state.replace(velocity=state.velocity * torch.tensor([1.0, -2.0, 3.0]).to(kernel_device)[:, None, None])

    ends = run_both(
        points,
        lambda solver, state: solver.rollout(state, DT, 3),
        "updated",
        start=start,
        boundaries=BOUNDARIES[name](),
    )
    check_agreement(ends)
    assert len(torch.unique(ends[1].impulse.abs().sum((1, 2)))) == 3


def test_which_boundaries_are_a_part_of_the_kernel_of_the_nodes(kernel_device):
    """Planes, boxes and pins, in order; in torch an enclosing box takes as long as the substep."""
    points, turns = make_points(kernel_device, count=12), {}
    for name in ("walls", "pin and plane", "walls and pins", "handle"):
        solver = make_solver("kernels", "updated", boundaries=BOUNDARIES[name]())
        solver.init_state(points)
        turns[name] = solver.fused().turns
    assert turns["walls"] == ((0, 0), *((1, 1 + n) for n in range(6)))
    assert turns["pin and plane"] == ((0, -1), (1, 0))
    assert turns["walls and pins"] == ((0, 0), (1, -1), *((2, 1 + n) for n in range(6)), (3, -2))
    assert turns["handle"] == ()


def test_fast_particles_are_sorted_more_often_and_sheets_less():
    """At least every 64 substeps, and not so often that a small body waits for the host."""
    often = [fused_updated.sorted_for(8.0, rate, 1_000_000) for rate in (1e-6, 1e-2, 1e-1, 1.0)]
    assert often[0] == 64
    assert often == sorted(often, reverse=True)
    assert often[-1] == 4
    assert fused_updated.sorted_for(4.0, 1e-1, 1_000_000) > fused_updated.sorted_for(8.0, 1e-1, 1_000_000)
    assert fused_updated.sorted_for(100.0, 1e-1, 1_000_000) > fused_updated.sorted_for(8.0, 1e-1, 1_000_000)
    assert fused_updated.sorted_for(8.0, 1.0, 20_000) == 32
    axis = (torch.arange(32) + 0.5) * DX / 2
    assert 7 < fused_updated.crowd_of(torch.cartesian_prod(axis, axis, axis), DX) <= 8


def test_a_fast_body_is_sorted_more_often_from_the_second_rollout_on(kernel_device, monkeypatch):
    """The host does not wait for the speed: it reads that of an earlier rollout."""
    monkeypatch.setattr(fused_updated, "LEAST", 1)
    points = make_points(kernel_device, count=48)
    found = []
    for speed in (0.01, 10.0):
        solver = make_solver("kernels", "updated", gravity=(0.0, 0.0, 0.0))
        state = solver.init_state(points, torch.full_like(points.position, speed))
        for _ in range(2):
            state = solver.rollout(state, 1e-3, 2)
            if kernel_device.type == "cuda":
                torch.cuda.synchronize()
        solver.rollout(state, 1e-3, 1)
        fused = solver.fused()
        found.append(fused.crossing)
        assert fused.crossing == pytest.approx(3 * speed * 1e-3 / solver.dx, rel=0.1)
    assert found[1] > 100 * found[0]


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
    holds = solver.bound.point_holds
    rows = (holds.weight[0, 0][..., None] * ends[0].node_displacement[holds.node[0, 0]].double()).sum(-2)
    start = set_going(solver, points, strain=0.02).node_displacement
    before = (holds.weight[0, 0][..., None] * start[holds.node[0, 0]].double()).sum(-2)
    assert float((rows - before).abs().max()) < 1e-5 * DX


def test_nodes_without_mass_are_let_go(kernel_device):
    """Boundaries see them at the origin, and so inside a region around it."""
    points = make_points(kernel_device, count=12)
    boundaries = [VelocityBox(Box([-0.1] * 3, [0.1] * 3), [0.0, 1.0, 0.0], end=0.5 * DT)]
    check_agreement(
        run_both(points, lambda solver, state: solver.rollout(state, DT, 3), "total", boundaries=boundaries)
    )


def test_nodes_held_in_a_batch_of_winds(kernel_device):
    """The momentum that pins take is summed for each scene, and all scenes share their patches."""
    points = make_points(kernel_device, count=40, batch=(2,))
    winds = WindBatch([WindField([0.0, -8.0, 0.0]), WindField([3.0, 9.0, 0.0])]).to(kernel_device)
    listed = make_load(points, [WindField([0.0, -8.0, 0.0]), WindField([3.0, 9.0, 0.0])])
    load = WindForce(listed.aero, winds, listed.normal[0], listed.area[0])
    boundaries = [PinnedRegion(LEFT, kind="nodes")]
    ends = run_both(points, lambda solver, state: solver.rollout(state, DT, 2, load), "total", boundaries=boundaries)
    check_agreement(ends)
    assert float(ends[0].impulse.abs().amax()) > 0
    torch.testing.assert_close(ends[1].impulse, ends[0].impulse, rtol=1e-3, atol=1e-12)
