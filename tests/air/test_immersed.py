"""Surfaces in the air: momentum to rounding, no overshoot for any mass, and kernels against torch.

Covers: air.immersed_kernels.
"""

import pytest
import torch

from gaussian_swaying.air.flow import LatticeFlow
from gaussian_swaying.air.immersed import Reach, exchange, look, velocity_at
from gaussian_swaying.air.lattice import LatticeUnits

UNITS = LatticeUnits.at_speed(0.1, 1.0, viscosity=1e-3, density=1.2)


def _flow(cells=(12, 10, 9), faces=("open", "open", ("wall", "open"))):
    flow = LatticeFlow(cells, UNITS, faces=faces)
    state = flow.start([1.0, 0.0, 0.0], dtype=torch.float64)
    draw = torch.Generator().manual_seed(0)
    state.moments[:4] += 0.02 * torch.randn(4, *cells, dtype=torch.float64, generator=draw) * (flow.kind == 0)
    return flow, state.moments


def _points(cells, count=300, mass=1.0):
    draw = torch.Generator().manual_seed(1)
    place = torch.rand(count, 3, dtype=torch.float64, generator=draw) * (torch.tensor(cells) + 1.0) - 1
    area, mass = torch.rand(2, count, dtype=torch.float64, generator=draw) * torch.tensor([[0.3], [mass]])
    return place, area, mass, 0.1 * torch.randn(count, 3, dtype=torch.float64, generator=draw)


def _sheet(count=12, height=4.3, layers=1):
    """Points on a level square of 6 cells, half a cell apart."""
    side = 3.0 + 6 * (torch.arange(count, dtype=torch.float64) + 0.5) / count
    x, y = torch.meshgrid(side, side, indexing="ij")
    place = torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3).repeat(layers, 1)
    return place, torch.full((len(place),), (6 / count) ** 2, dtype=torch.float64)


@pytest.mark.parametrize("cells", [(12, 10, 9), (12, 1, 9)])
def test_the_air_loses_what_the_points_take(cells):
    faces = ("open", "open" if cells[1] > 1 else "periodic", ("wall", "open"))
    flow, moments = _flow(cells, faces)
    place, area, mass, velocity = _points(cells)
    before = (1 + moments[0]) * moments[1:4]
    taken = exchange(moments, velocity, area, mass, place, flow.kind)
    lost = before - (1 + moments[0]) * moments[1:4]
    torch.testing.assert_close(lost.sum((1, 2, 3)), taken.sum(0))
    assert float(taken.abs().max()) > 0
    assert float(lost[:, flow.kind != 0].abs().max()) == 0  # walls and held faces give and take nothing


@pytest.mark.parametrize("cells", [(12, 10, 9), (12, 1, 9)])
def test_kernels_compute_the_exchange(cells, kernel_device):
    faces = ("open", "open" if cells[1] > 1 else "periodic", ("wall", "open"))
    flow, moments = _flow(cells, faces)
    place, area, mass, velocity = _points(cells)
    place[0] = -50.0  # far outside
    single = [tensor.float().to(kernel_device) for tensor in (moments, velocity, area, mass, place)]
    expected = exchange(moments, velocity, area, mass, place, flow.kind)
    found = exchange(*single, flow.kind.to(kernel_device))
    torch.testing.assert_close(found.cpu().double(), expected, rtol=0, atol=1e-6)
    torch.testing.assert_close(single[0].cpu().double(), moments, rtol=0, atol=1e-6)
    assert float(expected[0].abs().max()) == 0


def test_weights_of_a_point_add_up_to_one_beside_a_wall():
    flow, _ = _flow()
    place = torch.tensor([[5.0, 5.0, 0.8], [5.0, 5.0, 4.0]], dtype=torch.float64)
    torch.testing.assert_close(Reach.around(place, flow.kind).weight.sum(0), torch.ones(2, dtype=torch.float64))


def test_a_linear_flow_is_read_exactly():
    flow, moments = _flow()
    axes = [torch.arange(n, dtype=torch.float64) for n in flow.cells]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), 0)
    moments[1:4] = 0.01 * grid + 0.02
    place = 2.5 + torch.rand(40, 3, dtype=torch.float64) * torch.tensor([6.0, 4.0, 3.0])
    torch.testing.assert_close(velocity_at(moments, Reach.around(place, flow.kind)), 0.01 * place + 0.02)


@pytest.mark.parametrize("layers", [1, 5])
def test_a_heavy_sheet_stops_the_air_and_no_more(layers):
    """In one step the air at a still sheet nearly comes to rest, in any number of layers."""
    flow, moments = _flow(faces=("open",) * 3)
    moments[0] = 0
    moments[1:4] = torch.tensor([0.0, 0.0, 0.1])[:, None, None, None]
    place, area = _sheet(layers=layers)
    mass = torch.full_like(area, 1e9)
    exchange(moments, torch.zeros_like(place), area, mass, place, flow.kind)
    left = velocity_at(moments, Reach.around(place, flow.kind))[:, 2]
    middle = ((place[:, :2] - 6).abs() < 1.5).all(-1)
    assert float(left[middle].abs().max()) < 0.013
    assert float(left.min()) > -0.025  # at the corners


@pytest.mark.parametrize("ratio", [1e-3, 0.1, 1.0, 100.0])
def test_sheet_and_air_meet_at_their_common_velocity(ratio):
    """As in an inelastic collision: energy is only lost, whatever the ratio of the masses."""
    flow, moments = _flow(faces=("open",) * 3)
    moments[0] = 0
    moments[1:4] = torch.tensor([0.0, 0.0, 0.1])[:, None, None, None]
    place, area = _sheet()
    _, layer = look(moments, area, place, flow.kind)
    mass, velocity = ratio * layer, torch.zeros_like(place)
    energy = 0.5 * moments[1:4].square().sum()
    taken = exchange(moments, velocity, area, mass, place, flow.kind)
    moved = taken / mass[:, None]
    middle = ((place[:, :2] - 6).abs() < 1.5).all(-1)
    air = velocity_at(moments, Reach.around(place, flow.kind))
    torch.testing.assert_close(moved[middle, 2], torch.full_like(moved[middle, 2], 0.1 / (1 + ratio)))
    assert float((air - moved)[middle, 2].abs().max()) < 0.013
    assert float(0.5 * moments[1:4].square().sum() + 0.5 * (mass * moved.square().sum(-1)).sum()) <= float(energy)
