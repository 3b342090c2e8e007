"""Cells of any size and places of particles in the kernels, and what one batch shares."""

import dataclasses

import pytest
import torch

from gaussian_swaying import WindField, WindForce
from gaussian_swaying.kernels.launch import lanes
from gaussian_swaying.mpm.state import GridSpec
from gaussian_swaying.mpm.triton import fused_total
from gaussian_swaying.wind.field import FlowKey

from .bodies import (
    DT,
    DX,
    FORMULATIONS,
    TOLERANCE,
    check_agreement,
    make_body,
    make_load,
    make_points,
    make_solver,
    noise,
    on_each,
    run_both,
    run_in_wind,
    set_going,
)


@pytest.mark.parametrize(
    ("kernel_device", "case"),
    [
        *on_each(("total", [1]), ("updated", [1]), ("total", [1, 3, 0, 64, 65, 130]), cpu=[("updated", [3, 0, 64])]),
        pytest.param("cuda", ("updated", [1, 3, 0, 64, 65, 130]), marks=pytest.mark.gpu),
    ],
    indirect=["kernel_device"],
    ids=str,
)
@pytest.mark.parametrize("programs", [1, 2048])
def test_cells_of_any_size(kernel_device, case, programs, monkeypatch):
    """Several chunks of lanes, pieces or warps for one cell; cells without a particle between others."""
    formulation, sizes = case
    if programs > 1 and (formulation == "updated" or lanes(kernel_device, 64) < 64):
        pytest.skip("only `total` cuts cells, and only on a GPU")
    monkeypatch.setattr(fused_total, "_PROGRAMS", programs)
    if len(sizes) > 2:
        monkeypatch.setattr(fused_total, "_lanes", lambda sizes: 64)
    generator = torch.Generator().manual_seed(7)
    cells = torch.repeat_interleave(torch.arange(len(sizes)), torch.tensor(sizes))
    place = 0.52 + 0.96 * torch.rand(len(cells), 3, generator=generator)  # of a cell, from the first node
    place[:, 2] += cells
    place = place[torch.randperm(len(place), generator=generator)]
    check_agreement(run_in_wind(make_body((place * DX).to(kernel_device)), formulation))


@pytest.mark.gpu
@pytest.mark.parametrize("number", [32, 128])
def test_every_number_of_lanes(number, monkeypatch):
    """The others are used in other tests."""
    pytest.importorskip("triton")
    monkeypatch.setattr(fused_total, "_lanes", lambda sizes: number)
    check_agreement(run_in_wind(make_points("cuda", count=300), "total"))


def test_a_node_adds_only_the_cells_around_it(monkeypatch):
    """A sheet one cell thick has at most nine cells around a node, and each of a node's rows is that of its place."""
    cell = torch.full((27, 2), 5)
    cell[[3, 20], 0] = torch.tensor([4, 2])
    cell[26, 1] = 0
    assert fused_total._sources(cell, 5).tolist() == [[3 * 6 + 4, 26 * 6], [20 * 6 + 2, 5]]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_particles_on_the_borders_of_cells(kernel_device, formulation):
    steps = torch.tensor([0.05, 0.15, 0.1, 0.25])
    position = torch.cartesian_prod(steps, steps, steps)[:32]
    position = torch.cat([position, torch.nextafter(position, torch.zeros(()))[5:13]])
    check_agreement(run_in_wind(make_body(position.to(kernel_device)), formulation))


def test_what_leaves_the_grid_is_lost(kernel_device):
    """It has no weight, does not affect the far side, and keeps its place; particles too near the edge are lost too."""
    points = make_points(kernel_device)
    outside = torch.tensor([[0.13, 0.14, 0.5], [0.5, 0.1, 0.1], [0.13, -0.4, 0.1], [0.15, 0.12, 0.349], [90.0, 0, 0]])
    count = len(outside)
    position = torch.cat([points.position[:-count], outside.to(kernel_device)])
    points = dataclasses.replace(points, position=position)
    grid = GridSpec(DX, (0, -1, 0), (5, 6, 5))

    def start(solver, points):
        state = set_going(solver, points).replace(grid=grid)
        state.velocity[-2, 2] = 60.0  # from within the grid
        return state

    def run(solver, state):
        states = [solver.rollout(state, DT, steps, check=False) for steps in (1, 4)]
        assert states[0].lost.tolist() == [False] * 19 + [True] * 3 + [False, True]
        assert states[1].lost.tolist() == [False] * 19 + [True] * 5
        assert float(states[1].velocity[-1].abs().max()) == 0.0
        assert torch.equal(states[1].position[-5:-2], state.position[-5:-2])
        roomy = states[1].replace(grid=GridSpec(DX, (-1, -6, -1), (9, 12, 9)))
        states.append(solver.rollout(roomy, DT, 1, check=False))
        assert torch.equal(states[2].lost, states[1].lost)  # though most are back
        return states

    check_agreement(run_both(points, run, start=start, gravity=(0, 0, 0)))


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_batch_is_each_scene_by_itself(kernel_device, formulation):
    points = make_points(kernel_device, count=10, batch=(2,))
    winds = [WindField([0.0, -8.0, 0.0]), WindField(schedule=[FlowKey(0.0, [1.0, 0, 0]), FlowKey(DT, [9.0, 0, 0])])]
    load, velocity = make_load(points, winds), 10 * noise(1, 2, 10, 3).to(kernel_device)

    def end(points, velocity, load):
        solver = make_solver("kernels", formulation)
        return solver.rollout(solver.init_state(points, velocity), DT, 4, load)

    both = end(points, velocity, load)
    assert both.work.shape == (2,)
    for k, wind in enumerate(winds):
        own = WindForce(load.aero, wind, load.normal[k], load.area[k])
        alone = end(points.map(lambda value, k=k: value[k]), velocity[k], own)
        for name in ("position", "velocity", "affine", "F_elastic"):
            error = (getattr(alone, name) - getattr(both, name)[k]).abs().max()
            assert float(error) <= TOLERANCE * float(getattr(alone, name).abs().max()), name
        torch.testing.assert_close(alone.work, both.work[k], rtol=1e-4, atol=0)
