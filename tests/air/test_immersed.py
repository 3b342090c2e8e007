import pytest
import torch
from shared import double, near, peak, rand, randn, seeded
from torch.testing import assert_close

from gaussian_swaying.air.flow import LatticeFlow, LatticeUnits
from gaussian_swaying.air.immersed import exchange, give, look, values_at

UNITS = LatticeUnits.at_speed(0.1, 1.0, viscosity=1e-3, density=1.2)


def _flow(cells=(12, 10, 9), faces=("open", "open", ("wall", "open"))):
    flow = LatticeFlow(cells, UNITS, faces=faces)
    state = flow.start([1.0, 0.0, 0.0], dtype=torch.float64)
    draw = seeded(0)
    state.moments[:4] += 0.02 * randn(4, *cells, generator=draw) * (flow.kind == 0)
    return flow, state.moments


def _points(cells, count=300, mass=1.0):
    draw = seeded(1)
    place = rand(count, 3, generator=draw) * (torch.tensor(cells) + 1.0) - 1
    area, mass = rand(2, count, generator=draw) * torch.tensor([[0.3], [mass]])
    return place, area, mass, 0.1 * randn(count, 3, generator=draw)


WIDE = (18, 18, 9)


def _sheet(height=4.3, layers=1):
    """Points on a level square of 12 cells in the middle of WIDE, half a cell apart, and which lie far from its edges.

    The exchange at a point depends on those at most six cells away, as it reads cells that others read. Away from the
    edges quadratic B-splines half a cell apart add up to the same everywhere, so that what is found there is exact.
    """
    side = 2.5 + 12 * (torch.arange(24).double() + 0.5) / 24
    x, y = torch.meshgrid(side, side, indexing="ij")
    place = torch.stack([x, y, torch.full_like(x, height)], -1).reshape(-1, 3).repeat(layers, 1)
    inner = ((place[:, :2] - 8.5).abs() < 1.5).all(-1)
    return place, double([0.25] * len(place)), inner


def _upwards():
    flow, moments = _flow(WIDE, ("open",) * 3)
    moments[0] = 0
    moments[1:4] = torch.tensor([0.0, 0.0, 0.1])[:, None, None, None]
    return flow, moments


@pytest.mark.parametrize("cells", [(12, 10, 9), (12, 1, 9)])
def test_the_air_loses_what_the_points_take_and_kernels_compute_it(cells, kernel_device):
    flow, moments = _flow(cells, ("open", "open" if cells[1] > 1 else "periodic", ("wall", "open")))
    place, area, mass, velocity = _points(cells)
    place[0] = -50.0  # far outside
    single = [tensor.float().to(kernel_device) for tensor in (moments, velocity, area, mass, place)]
    before = (1 + moments[0]) * moments[1:4]
    taken = exchange(moments, velocity, area, mass, place, flow.kind)
    lost = before - (1 + moments[0]) * moments[1:4]
    assert_close(lost.sum((1, 2, 3)), taken.sum(0))
    assert peak(taken) > 0
    assert peak(taken[0]) == 0
    assert peak(lost[:, flow.kind != 0]) == 0  # walls and held faces give and take nothing
    found = exchange(*single, flow.kind.to(kernel_device))
    near(found.cpu().double(), taken, 1e-6)
    near(single[0].cpu().double(), moments, 1e-6)


def test_a_linear_flow_is_read_exactly_and_a_constant_one_beside_a_wall():
    flow, _ = _flow()
    axes = [torch.arange(n).double() for n in flow.cells]
    field = 0.01 * torch.stack(torch.meshgrid(*axes, indexing="ij")) + 0.02
    place = 2.5 + rand(40, 3) * torch.tensor([6.0, 4.0, 3.0])
    assert_close(values_at(field, place, flow.kind), 0.01 * place + 0.02)
    place = double([[5.0, 5.0, 0.8], [5.0, 5.0, 4.0]])
    assert_close(values_at(torch.ones_like(field), place, flow.kind), torch.ones_like(place))


@pytest.mark.parametrize("layers", [1, 5])
def test_a_heavy_sheet_stops_the_air_and_no_more(layers):
    """In one step the air at a still sheet comes to rest, in any number of layers.

    At its edges it may not, but no motion of the air is turned round: the exchange takes from the cells the share M u,
    with M = sum of layer_p w_p w_p^T. It has no negative entry, and the area at the cells is an eigenvector of the
    eigenvalue one, which is then the largest (Perron and Frobenius). So air that moves as the area lies comes to rest.
    """
    flow, moments = _upwards()
    place, area, inner = _sheet(layers=layers)
    heavy, still = torch.full_like(area, 1e15), torch.zeros_like(place)
    exchange(moments, still, area, heavy, place, flow.kind)
    left = values_at(moments[1:4], place, flow.kind)[:, 2]
    assert peak(left[inner]) < 1e-13
    assert peak(left) > 1e-3
    moments.zero_()
    give(moments, -area[:, None].expand(-1, 3).contiguous(), place, flow.kind)
    assert moments[1:4].max() > 0.1
    exchange(moments, still, area, heavy, place, flow.kind)
    assert peak(moments[1:4]) < 1e-12


@pytest.mark.parametrize("ratio", [1e-3, 0.1, 1.0, 100.0])
def test_sheet_and_air_meet_at_their_common_velocity(ratio):
    """As in an inelastic collision: energy is only lost, whatever the ratio of the masses."""
    flow, moments = _upwards()
    place, area, inner = _sheet()
    _, layer = look(moments, area, place, flow.kind)
    mass, velocity = ratio * layer, torch.zeros_like(place)
    energy = 0.5 * moments[1:4].square().sum()
    taken = exchange(moments, velocity, area, mass, place, flow.kind)
    moved = taken / mass[:, None]
    air = values_at(moments[1:4], place, flow.kind)
    assert_close(moved[inner, 2], torch.full_like(moved[inner, 2], 0.1 / (1 + ratio)))
    assert_close(air[inner], moved[inner])
    assert 0.5 * moments[1:4].square().sum() + 0.5 * (mass * moved.square().sum(-1)).sum() <= energy
