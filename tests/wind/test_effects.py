import math
import re
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import pytest
import torch
from shared import EYE, double, longest, near, normalized, peak, rand, randn, seeded, solid, value_error
from torch.testing import assert_close

from gaussian_swaying import AeroForce, MPMSolver, WindField, WindForce, wind
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.wind import effects
from gaussian_swaying.wind.effects import (
    Moment,
    Obstacle,
    Plume,
    Profile,
    WindEffect,
    wake_start,
)
from gaussian_swaying.wind.tables import Shelter, deposited, wind_axes

NOW = Moment(double(0.0), torch.zeros(3).double(), torch.zeros(3).double(), double(1.0))


def speeds(profile, heights):
    """Speed at some heights above the origin, in a wind of 8 m/s."""
    place = torch.zeros(len(heights), 3).double()
    place[:, 2] = torch.tensor(heights)
    wind = profile(double([8.0, 0.0, 0.0]), place, NOW)
    assert peak(wind[:, 1:]) == 0
    return wind[:, 0].tolist()


def test_the_logarithmic_profile():
    profile = Profile(ground=(0.0, 0.0, -2.0), height=10.0, roughness=0.1)
    found = speeds(profile, [8.0, -1.0, -1.95, -5.0])  # 10 m, 1 m, below the roughness, and below the ground
    assert found == pytest.approx([8.0, 8.0 * math.log(10) / math.log(100), 0.0, 0.0])


def test_the_power_law():
    found = speeds(Profile(ground=(0.0, 0.0, 1.0), height=10.0, exponent=0.2), [11.0, 1.3125, 0.5])
    assert found == pytest.approx([8.0, 8.0 * 0.03125**0.2, 0.0])  # 0.03125 is half to the fifth


class Flat(WindEffect):
    """Forgets that places have three coordinates, or returns no tensor."""

    def __init__(self, kind):
        super().__init__()
        self.kind = kind

    def forward(self, velocity, position, moment):
        return {"speed": velocity[0] * position[:, 2], "swapped": position.T[:, :3], "number": 1.0}[self.kind]


@pytest.mark.parametrize(
    ("kind", "error", "message"),
    [
        ("speed", ValueError, r"`velocity of Flat` of shape \(3,\), but got \(5,\)"),
        ("swapped", ValueError, r"`velocity of Flat` of shape \(5, 3\), but got \(3, 3\)"),
        ("number", TypeError, "`velocity of Flat` to be a torch.Tensor, but got float"),
    ],
)
def test_an_effect_that_returns_another_shape_is_named(kind, error, message):
    wind = WindField([1.0, 0.0, 0.0], effects=[Flat(kind)])
    with pytest.raises(error, match=message):
        wind.at(double(0.0), torch.zeros(5, 3))


def test_the_documented_effects_are_those_that_there_are():
    """All that a YAML can name; a ``CarriedField`` takes a tensor."""
    names = set()
    for found in iter_modules(wind.__path__):
        for kind in vars(import_module(f"{wind.__name__}.{found.name}")).values():
            known = (
                isinstance(kind, type)
                and issubclass(kind, WindEffect)
                and kind.device_function is not WindEffect.device_function
            )
            names |= {kind.__name__} - {"CarriedField", "Tabulated"} if known else set()
    docs = Path(__file__).parents[2] / "docs"
    (row,) = (line for line in (docs / "configuration.md").read_text().splitlines() if "`wind.effects`" in line)
    assert set(re.findall("`([A-Z][A-Za-z]+)`", row)) == names, "docs/configuration.md lists others at `wind.effects`"
    page = (docs / "wind.md").read_text()
    missing = sorted(name for name in names if not re.search(rf"\b{name}\b", page))
    assert missing == [], "docs/wind.md says nothing of these"


def plume_at(plume, place):
    return plume(torch.zeros(3).double(), double(place), NOW)


def test_a_plume_rises_as_fast_as_over_a_fire():
    """Heskestad's 1.03 Q^(1/3) z^(-1/3) with Q in kW, and NFPA 92's mass flow 0.071 Q^(1/3) z^(5/3) kg/s."""
    plume = Plume(source=(0.3, 0.2, -1.0), radius=1e-6, heat=2e4)
    radius = torch.linspace(0, 1.5, 3001, dtype=torch.float64)
    place = torch.stack([0.3 + radius, 0.2 + 0 * radius, 0 * radius + 1.0], dim=-1)
    up = plume(torch.zeros(3).double(), place, NOW)[:, 2]
    assert float(up[0]) == pytest.approx(1.03 * (20 / 2) ** (1 / 3), rel=0.01)
    flow = 1.2 * torch.trapezoid(2 * math.pi * radius * up, radius)
    assert float(flow) == pytest.approx(0.071 * 20 ** (1 / 3) * 2 ** (5 / 3), rel=0.1)


def test_a_plume_has_no_divergence_and_draws_air_in():
    plume = Plume(source=(0.0, 0.0, -1.0), radius=0.05)
    place = rand(50, 3, generator=seeded(0)) - 0.5
    place[0] = torch.tensor([0.0, 0.0, 0.3])  # on the axis
    change = torch.vmap(torch.func.jacrev(lambda x: plume(torch.zeros(3).double(), x, NOW)))(place)
    assert peak(change.diagonal(dim1=1, dim2=2).sum(-1)) < 1e-10 * peak(change)
    assert plume_at(plume, [0.6, 0.0, 0.0])[0] < -0.01
    assert peak(plume_at(plume, [0.0, 0.0, -1.001])) == 0


def test_a_plume_is_as_wide_as_its_source_there():
    plume = Plume(radius=0.2)
    middle, edge = plume_at(plume, [[0.0, 0.0, 0.0], [0.0, 0.2, 0.0]])[:, 2]
    assert float(edge / middle) == pytest.approx(math.exp(-1))


def test_a_plume_in_scene_units():
    frame = SimFrame(double([1.0, 0.0, 0.0]), EYE, 2.0)
    moved = Plume(source=(1.5, 0.0, 0.0), radius=0.1, heat=500.0).in_frame(frame)
    place = [[1.1, 0.2, 0.7]]
    assert_close(plume_at(moved, place), plume_at(Plume((1.0, 0.0, 0.0), 0.2, 500.0), place))


FLOW = double([2.0, -0.7, 0.4])
AXIS = torch.nn.functional.normalize(double([0.3, 0.1, 1.0]), dim=0)
RADII = (0.7, 1.3, 0.4)
plane_wake = on_tensors(effects.plane_wake)


def round_wake(behind, aside, width, drag):
    return on_tensors(effects.round_wake)(behind, aside, width, drag, wake_start(drag))


def carlson_rd(x, y, z):
    return on_tensors(effects.carlson_rd)(x, y, z, 9)


def around(obstacle, flow, place):
    """The flow of a wind round an obstacle without a wake."""
    return obstacle(flow, place, Moment(flow[0], flow, flow, flow[0]))


def cylinder(axis, radius):
    return changed(Obstacle([0.0] * 3, [None, radius, radius], drag=0.0), axes=[axis.tolist()] * 3)


def ellipsoid(radii):
    return Obstacle([0.0] * 3, list(radii), drag=0.0)


FLOWS = {
    "cylinder": lambda x: around(cylinder(AXIS, 0.8), FLOW, x),
    "ellipsoid": lambda x: around(ellipsoid(RADII), FLOW, x),
}


def _directions(count=40):
    draw = randn(count, 3, generator=seeded(0))
    return normalized(draw)


def _surface(name):
    direction = _directions()
    if name == "ellipsoid":
        x = direction * double(RADII)
        return x * (1 + 1e-15), normalized(direction / double(RADII))
    direction = normalized(direction - (direction @ AXIS)[:, None] * AXIS)
    return 0.8 * direction * (1 + 1e-15) + 3 * AXIS, direction


@pytest.mark.parametrize("name", FLOWS)
def test_the_flow_is_a_potential_one_round_the_body(name):
    flow = FLOWS[name]
    place = 1.5 * _directions() * torch.linspace(1, 3, 40, dtype=torch.float64)[:, None]
    slope = torch.func.vmap(torch.func.jacrev(lambda x: flow(x[None])[0]))(place)
    assert peak(slope) > 0.1
    assert peak(torch.einsum("nii->n", slope)) < 1e-12
    assert peak(slope - slope.mT) < 1e-12
    place, normal = _surface(name)
    found = flow(place + 1e-13 * normal)
    assert longest(found) > 1.0  # it is outside
    assert peak((found * normal).sum(-1)) < 1e-11
    near(flow(1e4 * (_directions() + double([2.0, 0.0, 0.0]))), FLOW.expand(40, 3), 1e-6)
    assert peak(flow(0.1 * _directions())) == 0.0


def test_closed_forms():
    """Lamb: twice the flow at the side of a cylinder."""
    x, y = EYE[:2]
    z = double([0.0, 0.0, 1.0])
    assert_close(around(cylinder(z, 1.0), x + z, 1.0 * y), 2 * x + z)
    assert_close(around(cylinder(z, 1.0), x + z, -2.0 * x), 0.75 * x + z)


def test_ellipsoids_become_spheres_and_cylinders():
    """The sphere's flow is v + (R / r)^3 / 2 (v - 3 (v n) n) (Lamb 92)."""
    place, normal = 1.2 * _directions(), _directions()
    sphere = FLOW + 0.5 * (0.8 / 1.2) ** 3 * (FLOW - 3 * (normal @ FLOW)[:, None] * normal)
    near(around(ellipsoid((0.8,) * 3), FLOW, place), sphere, 1e-13)
    z = double([0.0, 0.0, 1.0])
    long = around(ellipsoid((0.8, 0.8, 8e5)), FLOW, place)
    near(long, around(cylinder(z, 0.8), FLOW, place), 1e-9)


def test_carlsons_integral():
    """Values of the paper."""
    x, y, z = (double(v) for v in (1e-300, 2.0, 1.0))
    assert float(carlson_rd(x, y, z)) == pytest.approx(1.7972103521033883, rel=1e-12)
    x, y, z = (double(v) for v in (2.0, 3.0, 4.0))
    assert float(carlson_rd(x, y, z)) == pytest.approx(0.16510527294261053, rel=1e-13)


def test_wakes_take_the_momentum_of_the_drag():
    """The integral of u (U - u) is half of C_D times the width, or the disc, wherever the wake is developed.

    The least wide plane wake, right behind the body, takes it with its largest depth.
    """
    y = torch.linspace(-40, 40, 400001, dtype=torch.float64)
    for behind in (1e-3, 0.1, 0.5, 10.0, 40.0, 100.0):
        share = plane_wake(torch.full_like(y, behind), y, 0.5, 1.2)
        assert float(torch.trapezoid(share * (1 - share), y)) == pytest.approx(0.5 * 1.2 * 0.5, rel=1e-6)
        assert behind > 0.5 or float(share.max()) == pytest.approx(math.sqrt(0.5))
        if behind < 10:
            continue
        r = y[200000:]
        share = round_wake(torch.full_like(r, behind), r, 0.5, 0.47)
        lost = float(torch.trapezoid(2 * math.pi * r * share * (1 - share), r))
        assert lost == pytest.approx(0.5 * 0.47 * math.pi * 0.25**2, rel=1e-6)
    for wake in (lambda x: plane_wake(x, 0 * x, 0.5, 1.2), lambda x: round_wake(x, 0 * x, 0.5, 0.47)):
        share = wake(torch.linspace(-3, 60, 500, dtype=torch.float64))
        assert peak(share[:20]) == 0.0
        assert 0.3 < share.max() < 1
        assert (share[100:].diff() < 0).all()


@pytest.mark.parametrize("turn", [0.0, 30.0])
def test_obstacles_in_a_frame_are_those_of_the_scene(turn):
    """Scaled by two, turned by a quarter about x and moved."""
    rotation = double([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    frame = SimFrame(double([1.0, 2.0, 3.0]), rotation, 2.0)
    scene = double([[1.9, 2.6, 3.2], [0.4, 1.2, 2.4]])
    flow = double([1.0, 0.3, -0.2])
    here = Moment(flow[0], flow, flow, flow[0])
    there = Moment(flow[0], flow @ rotation.T, 2 * flow @ rotation.T, flow[0])
    for obstacle in (
        Obstacle([1.0, 2.5, 3.0], [0.4, 0.4, None], [-45.0, 0.0, 0.0]),
        Obstacle([1.0, 2.5, 3.0], [0.2, 0.5, 0.4], rotation=[0.0, 0.0, turn], drag=0.0),
    ):
        expected = obstacle(flow, scene, here)
        moved = obstacle.in_frame(frame)
        found = moved(flow @ rotation.T, frame.point_to_sim(scene), there) @ rotation
        assert_close(found, expected)
        assert peak(expected - flow) > 0.05
        assert list(obstacle.center) == [1.0, 2.5, 3.0]


def test_a_wall_shelters_what_is_behind_it():
    wall = Obstacle([0.0, 0.0, 0.0], [0.1, 1.0, 0.8], drag=0.9)
    wind = WindField([4.0, 0.0, 0.0], effects=[wall])
    place = torch.tensor([[-5.0, 0.0, 0.0], [1.5, 0.0, 0.0], [1.5, 4.0, 0.0], [0.0, 1.1, 0.0]])
    front, behind, aside, edge = wind.at(double(0.0), place)[:, 0].tolist()
    assert front == pytest.approx(4.0, rel=0.05)
    assert behind < 2.2
    assert aside == pytest.approx(4.0, rel=0.1)
    assert edge > 5.0


def test_still_air_stays_still():
    for obstacle in (
        Obstacle([0.0] * 3, [0.5, 0.5, None]),
        Obstacle([0.0] * 3, [1, 1, 2]),
    ):
        wind = WindField([0.0, 0.0, 0.0], effects=[obstacle])
        found = wind.at(double(1.0), 2 * _directions())
        assert torch.equal(found, torch.zeros_like(found))


@pytest.mark.parametrize(
    ("kind", "given", "words"),
    [
        (Obstacle, ([0.0] * 3, [-1.0, -1.0, None]), "`radii` to be positive"),
        (Obstacle, ([0.0] * 3, [1.0] * 3, [0.0] * 3, 1.2), "`drag` of an ellipsoid to be below 1"),
        (Obstacle, ([0.0] * 3, [1.0, 2.0, None]), "`radii` of a pole"),
        (Obstacle, ([0.0] * 3, [1.0, 2.0]), "`radii` to have 3 numbers"),
        (Profile, ((0.0, 0.0, 0.0), 1.0, 2.0), "`roughness` .* to be below `height`"),
        (Plume, ((0.0, 0.0, 0.0), 0.0), "`radius` to be positive"),
        (Plume, ((0.0, 0.0, 0.0), 1.0, 0.0), "`heat` to be positive"),
        *((Shelter, (cells,), "`cells` to be a whole number from 4 to 256") for cells in (3, 300, 8.0)),
    ],
)
def test_impossible_effects_are_refused(kind, given, words):
    with value_error(words):
        kind(*given)


def test_a_plane_wake_has_half_of_its_depth_where_it_was_measured():
    """Wygnanski and others: at 0.29 sqrt(theta x) from its middle."""
    width, drag = 0.3, 1.1
    theta = 0.5 * drag * width
    behind = double([4.0, 9.0, 30.0])
    middle = plane_wake(behind, torch.zeros_like(behind), width, drag)
    edge = plane_wake(behind, 0.29 * (theta * behind).sqrt(), width, drag)
    near(edge / middle, torch.full_like(behind, 0.5), 1e-14)


def test_a_round_wake_widens_by_a_twentieth():
    """Bastankhah & Porté-Agel in gusty wind; its standard deviation from its value at a place and in its middle."""
    behind, aside = double([2.0, 6.0, 12.0]), double(0.3)
    ratio = round_wake(behind, aside, 0.5, 0.47) / round_wake(behind, 0 * aside, 0.5, 0.47)
    sigma = aside / (-2 * ratio.log()).sqrt()
    assert_close(sigma.diff() / behind.diff(), double([0.05, 0.05]))


def _slab(depth, drag, direction, cells=32):
    """A slab of leaves that all face the wind, 1 m deep and 0.8 m wide, of an optical depth; and its particles."""
    side = 40
    axis = (torch.arange(side).double() + 0.5) / side
    place = torch.cartesian_prod(axis, axis, axis) * torch.tensor([1.0, 0.8, 0.8])
    axes = wind_axes(direction)
    place = place @ axes
    area = 2 * depth / drag * 0.64 / len(place)  # exp(-depth) behind: a half of C_D A per cross section
    points = solid(place, 1e-6)
    solver = MPMSolver(0.2, transfer="torch")
    wind = WindField((5 * direction).tolist(), effects=[Shelter(cells)])
    normal = axes[0].expand(len(place), 3)
    aero = AeroForce(C_D=drag, C_F=0.0, C_L=0.0, law="projected")
    load = WindForce(aero, wind, normal, torch.full((len(place),), area, dtype=torch.float64))
    state = solver.init_state(points, torch.ones_like(place))  # however it moves
    load.refresh(state)
    return load, state, axes


def _speed(load, state, *place):
    load.refresh(state)
    return float(load.wind.at(state.time, double([place]))[0].norm())


@pytest.mark.slow(gate=["direction0-0.2", "direction1-1.0", "direction2-3.0"])
@pytest.mark.parametrize("depth", [0.2, 1.0, 3.0])
@pytest.mark.parametrize("direction", [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.6, -0.64, 0.48]])
def test_a_slab_of_leaves_follows_the_exponential_law(depth, direction):
    """Within 3 % of the undisturbed wind, two cells or more from its sides, and exactly behind it."""
    load, state, axes = _slab(depth, 1.3, double(direction))
    along = torch.linspace(-0.3, 1.3, 33, dtype=torch.float64)
    line = torch.stack([along, torch.full_like(along, 0.37), torch.full_like(along, 0.43)], dim=-1) @ axes
    air = load.wind.at(state.time, line)
    near(air - (air @ axes[0])[:, None] * axes[0], torch.zeros_like(air), 1e-12)
    share = (air @ axes[0]) / 5
    expected = torch.exp(-depth * along.clamp(0, 1))
    assert peak(share - expected) < 0.03
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
    assign(load.wind, flows=torch.zeros(1, 3).double())
    load.refresh(state)
    assert peak(load.wind.effects[0].table - 1) == 0.0


def test_deposits_are_shared_and_do_not_depend_on_the_order():
    draw = seeded(0)
    place = 5 * torch.rand(5000, 3, generator=draw)
    amount = torch.rand(5000, generator=draw)
    found = deposited(place, amount, 6)
    assert float(found.double().sum()) == pytest.approx(float(amount.double().sum()), rel=1e-5)
    order = torch.randperm(5000, generator=draw)
    assert torch.equal(found, deposited(place[order], amount[order], 6))
    single = deposited(torch.tensor([[1.25, 2.0, 4.0]]), torch.tensor([8.0]), 6)
    assert single[1, 2, 4] == 6.0
    assert single[2, 2, 4] == 2.0
    assert peak(deposited(place, torch.zeros(5000), 6)) == 0.0


def test_a_shelter_that_was_not_refreshed_changes_nothing():
    velocity = torch.tensor([[1.0, 2.0, 3.0]])
    found = Shelter(4)(velocity, torch.rand(5, 3), NOW)
    assert_close(found, velocity.expand(5, 3))
