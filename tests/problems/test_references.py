import math

import pytest
import torch
from bench.problems.beams import elastica, timoshenko_mode
from bench.problems.crowns import branch_drag
from bench.problems.drapes import DISC, FABRIC, shadow
from bench.problems.falling import GRAVITY, sliding, terminal
from bench.problems.granular.deposit import lajeunesse, lube
from bench.problems.plates import hinged_plate_angle
from bench.problems.reconfiguration import elastica as bent
from bench.problems.settings import fit_sinusoid
from bench.problems.trees import WOOD_DENSITY, WOOD_E, Piece, frame_modes
from bench.problems.vortex import body_force, placement
from bench.problems.wrinkles import wavelength
from shared import double, near
from torch.func import jacrev, vmap

from gaussian_swaying.mpm.laws.elastic import fixed_corotated_pk1

pytestmark = pytest.mark.slow


def test_elasticas():
    for b, *known in [(0.5, 0.0623, 0.0022, 4.76), (4, 0.4252, 0.1099, 33.72), (32, 0.8785, 0.6715, 83.73)]:
        drop, shortening, slope = elastica(b)
        assert [drop, shortening, math.degrees(slope)] == pytest.approx(known, abs=5e-3)
    assert elastica(1e-3)[0] == pytest.approx(1e-3 / 8, rel=1e-6)
    drags = {"projected": (0.9827, 0.5320, 0.1869, 0.0872), "cross_flow": (0.9748, 0.5236, 0.1918, 0.0890)}
    for law, known in drags.items():
        assert [bent(c, law)[0] for c in (1.0, 10.0, 100.0, 1000.0)] == pytest.approx(known, abs=6e-5)
    assert branch_drag([1.0, 10.0], 0.0) == pytest.approx([bent(c, "projected")[0] for c in (1.0, 10.0)], rel=1e-5)


def test_frequencies_of_beams():
    euler = 3.516015 * math.sqrt(0.5**2 / 12) / 100.0**2
    assert timoshenko_mode(100.0, 0.5, 0.5**3 / 12)[0] == pytest.approx(euler, rel=3e-4)
    exact = 3.516015 / 10**2 * math.sqrt(WOOD_E * 0.2**2 / 16 / WOOD_DENSITY)
    whole = frame_modes([Piece((0, 0, 0), (0, 0, 10), (0.2, 0.2))], parts=6)[0]
    assert whole[:2] == pytest.approx([exact, exact], rel=2e-3)


def test_plates_in_a_wind():
    each = ((0.25, "paper"), (0.5, "paper"), (0.5, "projected"), (2.0, "projected"))
    assert [hinged_plate_angle(*one) for one in each] == pytest.approx([14.48, 30.0, 26.57, 63.43], abs=0.005)
    times = torch.linspace(0, 0.5, 6).double().numpy()
    speeds = [terminal() * math.tanh(GRAVITY * t / terminal()) for t in times]
    assert sliding(0.0, "projected", times)[:, 0] == pytest.approx(speeds, rel=1e-6)


def test_columns_of_sand_in_experiments():
    assert [round(lube(a), 2) for a in (0.5, 1, 2, 3)] == [0.6, 1.2, 2.4, 3.95]
    assert [round(lajeunesse(a), 2) for a in (0.5, 1, 2, 3)] == [0.5, 2.0, 2.83, 3.46]


def test_what_is_read_from_series_and_lines():
    time = torch.linspace(0, 5, 81, dtype=torch.float64)
    found = fit_sinusoid(time, 3 * torch.exp(-0.1 * time) * torch.sin(4.2 * time - 0.3))
    assert found == pytest.approx((4.2, 0.1), rel=1e-9)
    y = torch.linspace(-0.1, 0.1, 96).double().numpy()
    wave = 1e-4 * torch.cos(torch.tensor(2 * math.pi * y / 0.025)).numpy()
    assert wavelength(wave, 0.2 * 96 / 95) == pytest.approx(0.025, rel=0.01)
    turn = torch.arange(2000).double() * 2 * math.pi / 2000
    ring = torch.stack([turn.cos(), turn.sin(), 0 * turn], -1).numpy()
    assert [shadow(DISC * ring), shadow(FABRIC * ring)] == pytest.approx([0.0, 1.0], abs=1e-5)


def test_the_body_force_of_the_vortex_is_the_residual_of_its_momentum_balance():
    """Acceleration and divergence of the stress by automatic differentiation of the placement."""
    rest = double([[0.9, 0.2, 0.1], [-0.3, 1.0, 0.0], [0.1, -1.1, 0.2]])
    mu, lam, time = (double(value) for value in (380.0, 570.0, 0.5))
    density = 900.0

    def stress(x):
        return fixed_corotated_pk1(jacrev(lambda y: placement(y, time, 1.0))(x), mu, lam)

    divergence = torch.stack([torch.einsum("iJJ->i", jacrev(stress)(x)) for x in rest])
    acceleration = vmap(lambda x: jacrev(jacrev(lambda s: placement(x, s, 1.0)))(time))(rest)
    expected = acceleration - divergence / density
    near(body_force(rest, time, 1.0, 380.0, density), expected, 1e-11)
