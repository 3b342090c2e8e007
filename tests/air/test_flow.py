"""The flow: its lattice and collision by what they conserve, exact and published flows.

The problems are those of tools/bench/problems/air.py; the bench records finer ones.
"""

import pytest
import torch
from shared import EYE, alike, double, near, peak, randn, seeded, value_error
from torch.testing import assert_close

from gaussian_swaying.air import flow as kernels
from gaussian_swaying.air.flow import DIRECTIONS, HELD, WALL, FlowState, LatticeFlow, LatticeUnits
from gaussian_swaying.kernels.derive import on_tensors

UNITS = LatticeUnits.at_speed(0.1, 1.0, viscosity=1e-3, density=1.2)
C = double(DIRECTIONS)
W = double([on_tensors(kernels.weight)(*c) for c in DIRECTIONS]) / 6  # population has the other factor
BOXES = {
    "wind over ground": ((12, 10, 9), ("open", "periodic", ("wall", "open"))),
    "slab": ((12, 1, 9), ("open", "periodic", "open")),
    "periodic": ((7, 6, 8), ("periodic",) * 3),
    "flat": ((6, 8, 1), ("open", "wall", "periodic")),
}


@pytest.fixture
def moments():
    return 0.05 * randn(10, 50, generator=seeded(0))


def _populations(moments):
    return torch.stack([on_tensors(kernels.population)(moments.unbind(), *c) for c in DIRECTIONS])


def _collided(moments, relaxation=0.8, smagorinsky=0.0, push=(0.0, 0.0, 0.0)):
    sums = (torch.zeros(50).double(),) * 10
    for c, f in zip(DIRECTIONS, _populations(moments), strict=True):
        sums = on_tensors(kernels.gather)(sums, f, *c)
    return torch.stack(sums), torch.stack(on_tensors(kernels.collide)(sums, relaxation, smagorinsky, *push))


def test_moments_of_the_weights_are_those_of_a_gas_at_rest():
    """Up to the fourth: sums of w c c = I / 3, and of w c c c c = (I I) / 9, without which viscosity has directions."""
    assert_close(W.sum(), double(1.0))
    assert_close(torch.einsum("i,ia,ib->ab", W, C, C), EYE / 3)
    fourth = sum(torch.einsum(f"{a},{b}->abcd", EYE, EYE) for a, b in (("ab", "cd"), ("ac", "bd"), ("ad", "bc")))
    assert_close(torch.einsum("i,ia,ib,ic,id->abcd", W, C, C, C, C), fourth / 9)
    assert_close(torch.einsum("i,ia,ib,ic->abc", W, C, C, C), torch.zeros(3, 3, 3).double())


def test_populations_have_the_moments_that_made_them_and_third_ones_by_recursion(moments):
    found, _ = _collided(moments)
    rho, u = 1 + moments[0], moments[1:4]
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    second = [rho * u[a] * u[b] + moments[4 + k] + (a == b) * moments[0] / 3 for k, (a, b) in enumerate(pairs)]
    assert_close(found, torch.stack([moments[0], *rho * u, *second]))
    third = torch.einsum("ia,ib,ic,in->abcn", C, C, C, _populations(moments))
    xxy = rho * u[0] ** 2 * u[1] + u[1] * moments[4] + 2 * u[0] * moments[7]
    assert_close(third[0, 0, 1] - rho * u[1] / 3, xxy)
    assert_close(third[0, 1, 2], rho * u.prod(0) + u[0] * moments[9] + u[1] * moments[8] + u[2] * moments[7])


def test_a_collision_keeps_mass_and_momentum_adds_a_push_and_relaxes_the_stress(moments):
    push = [0.01, 0.02, -0.03]
    _, after = _collided(moments, push=push)
    expected = moments.clone()
    expected[1:4] += double(push)[:, None]
    expected[4:] *= 1 - 1 / 0.8
    assert_close(after, expected)


def test_eddies_have_the_viscosity_of_smagorinsky(moments):
    """nu_t = C² |S|, with the strain rate that the stress and the whole relaxation time give."""
    constant, tau0 = 0.15, 0.505
    _, after = _collided(moments, tau0, 18 * 2**0.5 * constant**2)
    stress = moments[4:]
    tau = 1 / (1 - after[4] / stress[0])
    strain = -1.5 / (tau * (1 + moments[0])) * stress
    size = (2 * (strain[:3].square().sum(0) + 2 * strain[3:].square().sum(0))).sqrt()
    assert_close((tau - tau0) / 3, constant**2 * size)


def test_units_of_a_speed():
    units = LatticeUnits.at_speed(0.1, 5.0, lattice_speed=0.05, viscosity=1e-3, density=1.2)
    found = units.dt, units.speed, units.relaxation, units.cell_mass
    assert found == pytest.approx((0.001, 100.0, 0.5 + 3 * 1e-3 * 0.001 / 0.01, 1.2e-3))


@pytest.mark.parametrize("cell", [(3, 2, 4), (0, 5, 7)])
def test_air_that_is_too_dense_goes_to_all_neighbours(cell):
    flow = LatticeFlow((7, 6, 8), UNITS, faces=("periodic",) * 3)
    state = flow.start(dtype=torch.float64)
    state.moments[0][cell] = 1e-3
    after = flow.step(state).moments
    for c, weight in zip(DIRECTIONS, W, strict=True):
        there = (slice(None), *((x + s) % n for x, s, n in zip(cell, c, flow.cells, strict=True)))
        sent = 1e-3 * weight
        assert_close(after[there][:4], torch.stack([sent, *(sent * double(c) / (1 + sent))]))
    assert_close(after[0].sum(), double(1e-3))


def _random(flow, seed=0):
    draw = seeded(seed)
    velocity = randn(3, *flow.cells, generator=draw)
    walls = 0.1 * randn(3, *flow.cells, generator=draw)
    moments = flow.start(velocity, walls, dtype=torch.float64).moments
    other = randn(7, *flow.cells, generator=draw) * (flow.kind != WALL)
    moments[0] += 0.01 * other[0]
    moments[4:] += 0.001 * other[1:]
    return FlowState(moments), randn(len(flow.held), 3, generator=draw)


def _ball(place):
    return (place - double([6.3, 5.2, 4.6])).square().sum(-1) < 2.6**2


@pytest.mark.parametrize(
    ("name", "walls"), [*((name, walls) for name in BOXES for walls in ("none", "some")), ("wind over ground", "ball")]
)
def test_a_step_of_float32_is_that_of_float64(name, walls, kernel_device):
    cells, faces = BOXES[name]
    solid = {"some": torch.rand(cells, generator=seeded(1)) < 0.05, "ball": _ball}.get(walls)
    flow = LatticeFlow(cells, UNITS, faces=faces, walls=solid)
    if walls == "ball":
        assert flow.gaps.min() < 0.2
        assert flow.gaps.max() > 0.8
    state, wind = _random(flow)
    push = (0.1, 0.2, 0.3)
    expected = flow.step(state, wind, push).moments
    single = flow.to(kernel_device).step(FlowState(state.moments.float().to(kernel_device)), wind, push).moments
    near(single.cpu().double(), expected, 5e-7 if walls == "ball" else 3e-7)


def test_nothing_flows_back_in_where_the_wind_blows_out():
    flow = LatticeFlow((6, 5, 4), UNITS)
    state, _ = _random(flow)
    moments = state.moments.clone()
    flow.hold(moments, 0.01 * UNITS.speed * flow.outward)
    before, after = (given[1:4].reshape(3, -1).T for given in (state.moments, moments))
    across = flow.outward / flow.outward.norm(dim=-1, keepdim=True)
    came, left = ((part[index.long()] * across).sum(-1) for part, index in ((before, flow.behind), (after, flow.held)))
    assert (came < 0).sum() > 20
    near(left, came.clamp(min=0).to(left), 1e-12)


@pytest.mark.parametrize("shift", [0.3, 0.8])
def test_a_wall_between_cells_is_where_it_is(shift):
    """A flow between walls that are not halfway: the exact parabola, within the error of its third-order remainder."""
    cells, units = 12, LatticeUnits.at_speed(1 / 12, 1.0, lattice_speed=0.05, viscosity=0.1, density=1.0)
    low, high = 1 + shift, 13 - shift

    def inside(place):
        return (place[..., 2] < low) | (place[..., 2] > high)

    flow = LatticeFlow((4, 1, cells + 2), units, faces=("periodic",) * 3, walls=inside, smagorinsky=0)
    height = torch.arange(cells + 2).double() + 0.5
    exact = ((height - low) * (high - height)).clamp(min=0) / 36
    start = torch.zeros(3, *flow.cells)
    start[0] = exact
    state, push = flow.start(start), 2 * 0.1 * 144 / 36
    for _ in range(600):
        state = flow.step(state, acceleration=(push, 0.0, 0.0))
    found = (flow.velocity(state)[0, 0, 0] - 0.5 * push * units.dt).double() * (flow.kind[0, 0] == 0)
    near(found, exact * (flow.kind[0, 0] == 0), 0.01)


def test_mass_and_momentum_of_a_periodic_box_stay():
    flow = LatticeFlow((6, 5, 7), UNITS, faces=("periodic",) * 3)
    state, _ = _random(flow)
    mass, momentum = state.moments[0].sum(), flow.momentum(state)
    for _ in range(20):
        state = flow.step(state)
    assert_close(state.moments[0].sum(), mass)
    assert_close(flow.momentum(state), momentum)


def test_walls_get_the_momentum_that_the_air_loses():
    walls = torch.zeros(8, 8, 8, dtype=torch.bool)
    walls[3:5, 3:5, 3:6] = True
    flow = LatticeFlow((8, 8, 8), UNITS, faces=("periodic",) * 3, walls=walls)
    state, _ = _random(flow)
    before, force = flow.momentum(state), flow.force_on_walls(state, walls)
    after = flow.momentum(flow.step(state))
    assert_close(before - after, force * UNITS.dt)


def test_wind_blows_through_an_open_box_undisturbed():
    flow = LatticeFlow((12, 8, 8), UNITS)
    state = flow.start([0.8, 0.3, -0.2])
    for _ in range(60):
        state = flow.step(state, torch.tensor([0.8, 0.3, -0.2]))
    expected = torch.tensor([0.8, 0.3, -0.2])[:, None, None, None].expand(3, 12, 8, 8)
    near(flow.velocity(state), expected, 1e-5)
    pressure = state.moments[0] * (UNITS.density * UNITS.speed**2 / 3)
    assert peak(pressure) < 1e-4


def test_a_new_wind_fills_the_box():
    flow = LatticeFlow((12, 8, 8), UNITS)
    state = flow.start([0.5, 0.0, 0.0])
    for _ in range(400):
        state = flow.step(state, torch.tensor([1.0, 0.0, 0.0]))
    alike(flow.velocity(state)[0].mean(), torch.tensor(1.0), 0.02)


def test_vorticity_of_a_turning_flow():
    flow = LatticeFlow((8, 7, 6), UNITS)
    axes = [0.1 * torch.arange(n).double() for n in flow.cells]
    place = torch.stack(torch.meshgrid(*axes, indexing="ij"))
    spin = double([0.2, -0.3, 0.5])
    turning = torch.linalg.cross(spin[:, None, None, None].expand_as(place), place, dim=0)
    found = flow.vorticity(flow.start(turning, dtype=torch.float64))
    assert_close(found, 2 * spin[:, None, None, None].expand_as(found))


def test_kinds_of_cells():
    walls = torch.zeros(6, 5, 5, dtype=torch.bool)
    walls[2, 2, 2] = True
    flow = LatticeFlow((6, 5, 5), UNITS, faces=("open", "open", ("wall", "open")), walls=walls)
    assert (flow.kind[:, :, 0] == WALL).all()
    assert int(flow.kind[2, 2, 2]) == WALL
    assert (flow.kind[0, :, 1:] == HELD).all()
    assert set(flow.kind.reshape(-1)[flow.held.long()].tolist()) == {HELD}


@pytest.mark.parametrize(("cells", "message"), [((3, 8, 8), "at least 4"), ((2000, 2000, 2000), "at most")])
def test_bad_numbers_of_cells(cells, message):
    with value_error(message):
        LatticeFlow(cells, UNITS)
