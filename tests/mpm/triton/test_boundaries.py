"""Boundaries in the fused substep, and how often `updated` sorts its particles.

Covers: mpm.triton.fused_updated.
"""

import pytest
import torch

from gaussian_swaying.aero.wind import WindField
from gaussian_swaying.aero.wind_batch import WindBatch
from gaussian_swaying.aero.wind_force import WindForce
from gaussian_swaying.geometry.regions import Box, Everything
from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox
from gaussian_swaying.mpm.boundaries.handle import Handle
from gaussian_swaying.mpm.boundaries.impulse import Impulse
from gaussian_swaying.mpm.boundaries.pinned_points import PinnedPoints
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion
from gaussian_swaying.mpm.boundaries.plane import Plane
from gaussian_swaying.mpm.boundaries.sequential_release import SequentialRelease
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox
from gaussian_swaying.mpm.triton import fused_updated

from .bodies import (
    DT,
    DX,
    FORMULATIONS,
    LEFT,
    TOP,
    check_agreement,
    make_load,
    make_points,
    make_solver,
    on_each,
    run_both,
    run_in_wind,
    set_going,
)

WINDOW = {"start": 0.5 * DT, "end": 1.5 * DT}
BOUNDARIES = {
    "pin": lambda: [PinnedRegion(LEFT, "nodes")],
    "hinge": lambda: [PinnedRegion(LEFT)],
    "two pins": lambda: [PinnedRegion(LEFT, "nodes"), PinnedRegion(TOP, "nodes", held_share=0.4)],
    "pin for some time": lambda: [PinnedRegion(LEFT, "nodes", **WINDOW)],
    "hinge for some time": lambda: [PinnedRegion(LEFT, **WINDOW)],
    "handle": lambda: [Handle(LEFT, [0.5, 0.0, 0.2], [0.0, 30.0, 9.0], [0.1, 0.1, 0.1], "nodes", **WINDOW)],
    "hinged handle": lambda: [Handle(LEFT, [0.5, 0.0, 0.2], [0.0, 30.0, 9.0], [0.1, 0.1, 0.1], **WINDOW)],
    "release": lambda: [SequentialRelease(LEFT, [0.0, 1.0, 0.0], start=0.5 * DT, end=1.5 * DT, kind="nodes")],
    "release of points": lambda: [SequentialRelease(LEFT, [0.0, 1.0, 0.0], start=0.5 * DT, end=1.5 * DT)],
    "impulse": lambda: [Impulse(TOP, [0.01, 0.0, 0.02], **WINDOW)],
    "plane": lambda: [Plane([0.0, 0.0, 0.13], [0.1, 0.0, 1.0], "separate", 0.4, **WINDOW)],
    "box": lambda: [EnclosingBox([0.1, 0.1, 0.1], [0.2, 0.2, 0.2], "slip", 0.2)],
    "walls": lambda: [
        Plane([0.0, 0.0, 0.13], [0.1, 0.0, 1.0], "sticky", **WINDOW),
        EnclosingBox([0.11, 0.1, 0.1], [0.2, 0.2, 0.2], "separate", 0.1, end=1.5 * DT),
    ],
    "velocity box": lambda: [VelocityBox(TOP, [0.0, 1.0, 0.0], **WINDOW)],
    "walls and pins": lambda: [
        Plane([0.0, 0.0, 0.13], [0.1, 0.0, 1.0], "separate", 0.4),
        PinnedRegion(LEFT, "nodes", **WINDOW),
        EnclosingBox([0.1, 0.1, 0.1], [0.2, 0.2, 0.2], "slip", 0.2),
        PinnedRegion(TOP, "nodes", start=0.5 * DT),
    ],
    "pin and plane": lambda: [PinnedRegion(LEFT, "nodes"), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0], "sticky")],
    "knock and release": lambda: [SequentialRelease(LEFT, end=1.5 * DT), Impulse(Everything(), [0, 0, 0.02], end=DT)],
}


@pytest.mark.slow(
    gate=[f"updated-cpu-{name}" for name in ("handle", "knock and release", "walls", "box", "two pins")]
    + [f"total-cpu-{name}" for name in ("hinge", "hinged handle", "plane", "box", "two pins")]
)
@pytest.mark.parametrize(
    ("kernel_device", "name"),
    [
        *(pytest.param("cuda", name, marks=pytest.mark.gpu) for name in BOUNDARIES),
        *(
            ("cpu", name)
            for name in (
                *("two pins", "hinge", "handle", "hinged handle", "knock and release", "plane", "box", "walls"),
                "walls and pins",
            )
        ),
    ],
    indirect=["kernel_device"],
)
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_boundaries(kernel_device, formulation, name):
    """Over three substeps, of which the first and the last lie outside the window."""
    _boundaries_case(kernel_device, formulation, BOUNDARIES[name])


POINT_HOLDS = {
    "clamp": lambda: [PinnedRegion(LEFT, "clamp")],
    "points": lambda: [PinnedPoints([[0.1, 0.12, 0.11], [0.2, 0.17, 0.13]])],
    "nodes, hinge and clamp": lambda: [
        PinnedRegion(LEFT),
        PinnedRegion(TOP, "nodes", held_share=0.4),
        PinnedPoints([[0.2, 0.1, 0.1]], "clamp"),
        PinnedRegion(LEFT, "nodes", held_share=0.5),
    ],
    "points and plane": lambda: [PinnedPoints([[0.2, 0.1, 0.1]]), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0], "sticky")],
    "points one after the other": lambda: [
        PinnedRegion(LEFT, end=1.5 * DT),
        PinnedPoints([[0.2, 0.1, 0.1]], "clamp", start=0.5 * DT),
        Handle(TOP, [0.5, 0.0, 0.2], [0.0, 30.0, 9.0], [0.1, 0.1, 0.1], "clamp", start=1.5 * DT),
    ],
}
"""These are for `total` alone."""


@pytest.mark.parametrize(("kernel_device", "name"), on_each(*POINT_HOLDS), indirect=["kernel_device"])
def test_points_that_are_held(kernel_device, name):
    _boundaries_case(kernel_device, "total", POINT_HOLDS[name])


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


def test_a_plane_that_is_moved_in_place(kernel_device):
    """Between two rollouts, and without another buffer."""
    points, ends = make_points(kernel_device, count=12), []
    for transfer in ("torch", "kernels"):
        plane = Plane([0.0, 0.0, -1.0], [0.0, 0.0, 1.0], "sticky")
        solver = make_solver(transfer, "updated", boundaries=[plane])
        state = solver.rollout(set_going(solver, points), DT, 1)
        plane.point[2] = 0.13
        ends.append(solver.rollout(state, DT, 1))
    check_agreement(ends)
    assert float(ends[1].impulse.abs().max()) > 1e-4


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


def test_points_held_in_a_batch(kernel_device):
    """The scenes have different rows."""
    points = make_points(kernel_device, count=40, batch=(2,))
    boundaries = [PinnedRegion(LEFT), PinnedRegion(TOP, "nodes", held_share=0.4)]
    ends = run_in_wind(points, "total", steps=2, boundaries=boundaries)
    check_agreement(ends)
    assert ends[1].impulse.shape == (2, 2, 3)


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


def _boundaries_case(kernel_device, formulation, make):
    points = make_points(kernel_device, count=12)
    load = make_load(points)

    def run(solver, state):
        state = solver.rollout(state, DT, 1, load)
        return [state, solver.rollout(state, DT, 2, load)]

    ends = run_both(points, run, formulation, boundaries=make())
    check_agreement(ends)
    assert float(ends[1][1].impulse.abs().max()) > 1e-4
    free = make_solver("torch", formulation)
    with torch.no_grad():
        velocity = run(free, set_going(free, points))[1].velocity
    assert not torch.allclose(velocity, ends[0][1].velocity, rtol=1e-3)


def test_nodes_without_mass_are_let_go(kernel_device):
    """Boundaries see them at the origin, and so inside a region around it."""
    points = make_points(kernel_device, count=12)
    boundaries = [VelocityBox(Box([-0.1] * 3, [0.1] * 3), [0.0, 1.0, 0.0], end=0.5 * DT)]
    check_agreement(
        run_both(points, lambda solver, state: solver.rollout(state, DT, 3), "total", boundaries=boundaries)
    )


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_boundaries_of_a_batch(kernel_device, formulation):
    points = make_points(kernel_device, count=40, batch=(2,))
    boundaries = [SequentialRelease(LEFT, [0.0, 1.0, 0.0], end=1.5 * DT), Plane([0.0, 0.0, 0.13], [0.0, 0.0, 1.0])]
    check_agreement(run_in_wind(points, formulation, steps=2, boundaries=boundaries))


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
