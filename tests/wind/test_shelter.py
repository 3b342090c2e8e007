"""The wind inside a body against the exponential law."""

import math

import pytest
import torch
from shared import double, solid
from torch.testing import assert_close

from gaussian_swaying import AeroForce, MPMSolver, WindField, WindForce
from gaussian_swaying._fixed import assign
from gaussian_swaying.wind.effects import Moment
from gaussian_swaying.wind.tables import Shelter, deposited, extinction, wind_axes

DOUBLE = torch.float64


def _slab(depth, drag, direction, cells=32):
    """A slab of leaves that all face the wind, 1 m deep and 0.8 m wide, of an optical depth; and its particles."""
    side = 40
    axis = (torch.arange(side, dtype=DOUBLE) + 0.5) / side
    place = torch.cartesian_prod(axis, axis, axis) * torch.tensor([1.0, 0.8, 0.8])
    axes = wind_axes(direction)
    place = place @ axes
    area = 2 * depth / drag * 0.64 / len(place)  # exp(-depth) behind: a half of C_D A per cross section
    points = solid(place, 1e-6)
    solver = MPMSolver(dx=0.2, transfer="torch")
    wind = WindField((5 * direction).tolist(), effects=[Shelter(cells)])
    normal = axes[0].expand(len(place), 3)
    aero = AeroForce(C_D=drag, C_F=0.0, C_L=0.0, law="projected")
    load = WindForce(aero, wind, normal, torch.full((len(place),), area, dtype=DOUBLE))
    state = solver.init_state(points, torch.ones_like(place))  # however it moves
    load.refresh(state)
    return load, state, axes


def _speed(load, state, *place):
    """Speed of the wind at a place, once it has been sheltered anew."""
    load.refresh(state)
    return float(load.wind.at(state.time, double([place]))[0].norm())


@pytest.mark.slow(gate=["direction0-0.2", "direction1-1.0", "direction2-3.0"])
@pytest.mark.parametrize("depth", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.6, -0.64, 0.48]])
def test_a_slab_of_leaves_follows_the_exponential_law(depth, direction):
    """Within 3 % of the undisturbed wind, two cells or more from its sides, and exactly behind it."""
    load, state, axes = _slab(depth, 1.3, double(direction))
    along = torch.linspace(-0.3, 1.3, 33, dtype=DOUBLE)
    line = torch.stack([along, torch.full_like(along, 0.37), torch.full_like(along, 0.43)], dim=-1) @ axes
    air = load.wind.at(state.time, line)
    assert_close(air - (air @ axes[0])[:, None] * axes[0], torch.zeros_like(air), rtol=0, atol=1e-12)
    share = (air @ axes[0]) / 5
    expected = torch.exp(-depth * along.clamp(0, 1))
    assert (share - expected).abs().max() < 0.03
    assert float(share[:6].min()) == pytest.approx(1.0, abs=1e-12)
    assert float(share[-1]) == pytest.approx(math.exp(-depth), rel=0.03)


def test_the_drag_area_is_that_of_the_force():
    """Leaves edge-on take nothing with the projected law, and the wake of twice the leaves is the square."""
    load, state, _ = _slab(0.7, 1.0, double([1.0, 0.0, 0.0]))
    behind = 1.2, 0.4, 0.4
    once = _speed(load, state, *behind) / 5
    assign(load.wind.effects[0], strength=2.0)
    assert _speed(load, state, *behind) / 5 == pytest.approx(once**2, rel=1e-6)
    assign(load, normal=double([0.0, 1.0, 0.0]).expand_as(load.normal))
    assert _speed(load, state, *behind) == pytest.approx(5.0, rel=1e-7)


def test_the_wake_follows_the_body_and_the_wind():
    load, state, _ = _slab(1.0, 1.0, double([1.0, 0.0, 0.0]))
    moved = state.replace(position=state.position + torch.tensor([0.0, 0.0, 5.0]))
    assert _speed(load, moved, 1.2, 0.4, 0.4) == pytest.approx(5.0)
    assign(load.wind, flows=double([[0.0, 5.0, 0.0]]))
    assign(load, normal=double([0.0, 1.0, 0.0]).expand_as(load.normal))
    assert _speed(load, state, 1.2, 0.4, 0.4) == pytest.approx(5.0)
    assert _speed(load, state, 0.5, 1.2, 0.4) < 3.2
    assign(load.wind, flows=torch.zeros(1, 3, dtype=DOUBLE))
    load.refresh(state)
    assert (load.wind.effects[0].table - 1).abs().max() == 0.0


def test_deposits_are_shared_and_do_not_depend_on_the_order():
    draw = torch.Generator().manual_seed(0)
    place = 5 * torch.rand(5000, 3, generator=draw)
    amount = torch.rand(5000, generator=draw)
    found = deposited(place, amount, 6)
    assert float(found.double().sum()) == pytest.approx(float(amount.double().sum()), rel=1e-5)
    order = torch.randperm(5000, generator=draw)
    assert torch.equal(found, deposited(place[order], amount[order], 6))
    single = deposited(torch.tensor([[1.25, 2.0, 4.0]]), torch.tensor([8.0]), 6)
    assert single[1, 2, 4] == 6.0
    assert single[2, 2, 4] == 2.0
    assert deposited(place, torch.zeros(5000), 6).abs().max() == 0.0


def test_extinction_is_the_trapezoidal_sum():
    density = double([1.0, 3.0, 0.0, 2.0]).reshape(4, 1, 1)
    depth = 0.5 * double([0.5, 2.5, 4.0, 5.0])  # spacing 1
    assert_close(extinction(density, torch.tensor(1.0)).flatten(), torch.exp(-depth))


def test_axes_of_a_wind():
    for flow in ([0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [1.0, -2.0, 0.3]):
        flow = double(flow)
        axes = wind_axes(flow)
        assert_close(axes @ axes.T, torch.eye(3, dtype=DOUBLE))
        if float(flow.norm()) > 0:
            assert_close(axes[0], flow / flow.norm())


@pytest.mark.parametrize("cells", [3, 300, 8.0])
def test_impossible_grids_are_refused(cells):
    with pytest.raises(ValueError, match="`cells` to be a whole number from 4 to 256"):
        Shelter(cells)


def test_a_shelter_that_was_not_refreshed_changes_nothing():
    velocity = torch.tensor([[1.0, 2.0, 3.0]])
    still = torch.zeros(3, dtype=DOUBLE)
    found = Shelter(4)(velocity, torch.rand(5, 3), Moment(still[0], still, still))
    assert_close(found, velocity.expand(5, 3))
