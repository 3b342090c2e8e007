"""Winds by their look: mean, intensity and coherence of long records, and another stretch of the same turbulence."""

import math
from itertools import pairwise

import pytest
import torch
from shared import double

from gaussian_swaying.wind.field import WindField
from gaussian_swaying.wind.turbulence import CELLS, LOOKS, Turbulence, look, turbulence_length

SECONDS, SEEDS = 400.0, 6


def record(wind, places, step=0.2, seconds=SECONDS):
    """Wind at places (K, 3), shape (T, K, 3); the field is carried, so a later time is a place upstream."""
    times = torch.arange(round(seconds / step), dtype=torch.float64) * step
    where = torch.as_tensor(places, dtype=torch.float64) - times[:, None, None] * wind.flows[0].double()
    return wind.at(times[0], where.reshape(-1, 3)).double().reshape(len(times), -1, 3)


@pytest.mark.parametrize("name", LOOKS)
def test_a_long_record_has_the_mean_and_the_intensity(name):
    """Within the sampling error, but for the waves that the box leaves out.

    A record of T seconds has T U / 2 L independent values of u, of the integral length L along the wind, and a box no
    more than its 8 x 4 x 4 cubic lengths. The error of the mean is sigma over the root of their number.

    The cells of L / 16 resolve 92 % of the variance and their interpolation takes 3 %; waves longer than the sides of
    8, 4 and 4 L are missing, some 15 % of it. So sigma is 0.87 of the closed form, and varies by 5 % with the seed.
    """
    given, height = LOOKS[name], 0.5
    records = [
        record(look(name, (0.0, 2.0, 0.0), height=height, seed=seed), [[0.0, 0.0, 0.0]]) for seed in range(SEEDS)
    ]
    air = torch.cat(records)[:, 0]
    count = SEEDS * min(SECONDS * given.speed / (2 * turbulence_length(height)), math.prod(CELLS) / 16**3)
    sigma = given.intensity * given.speed
    flow = double([0.0, given.speed, 0.0])
    assert ((air.mean(0) - flow).abs() < 3 * sigma / math.sqrt(count)).all()
    for spread in air.std(0).tolist():  # isotropic
        assert spread == pytest.approx(0.87 * sigma, rel=3 * 0.05 / math.sqrt(SEEDS) + 0.05)


def test_it_is_coherent_in_space():
    """The correlation falls with the distance, and parts of a plant get nearly the same wind."""
    apart = [0.0, 0.1, 0.4, 1.0, 3.0]
    wind = look("gusts", height=0.5, seed=3)
    air = record(wind, [[0.0, d, 0.0] for d in apart])[..., 0]
    found = torch.corrcoef(air.T)[0].tolist()
    assert found[0] == pytest.approx(1.0)
    assert all(a > b for a, b in pairwise(found))
    assert found[1] > 0.8
    assert found[-1] < 0.3


def test_two_heights_have_two_lengths():
    """Of 3.2 heights, so that the slow part of the spectrum is stronger; 1.5 m at least."""
    assert turbulence_length(0.1) == 1.5
    assert turbulence_length(4.0) == pytest.approx(12.8)
    air = [record(look("gusts", height=h), [[0.0, 0.0, 0.0]], step=0.02, seconds=200)[:, 0, 0] for h in (0.5, 4.0)]
    slopes = [float((line[1:] - line[:-1]).square().mean() / line.var()) for line in air]
    assert slopes[1] < 0.5 * slopes[0]


def test_direction_and_speed_may_be_given():
    wind = look("storm", (3.0, 4.0, 0.0), speed=5.0)
    assert wind.flows[0].tolist() == pytest.approx([3.0, 4.0, 0.0])
    assert not wind.uniform
    places = torch.zeros(1, 3, dtype=torch.float64)
    first, other = (look("storm", seed=seed).at(torch.zeros((), dtype=torch.float64), places) for seed in (0, 1))
    assert not torch.equal(first, other)
    assert look("breeze", speed=0.0).flows[0].tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"name": "hurricane"}, "`look` to be one of breeze, gusts, storm"),
        ({"height": 0.0}, "`height`"),
        ({"height": math.nan}, "`height`"),
        ({"direction": (0.0, 0.0, 0.0)}, "say where it blows to"),
        ({"direction": (1.0, 0.0)}, "`direction`"),
        ({"speed": -1.0}, "`speed`"),
        ({"speed": math.inf}, "`speed`"),
    ],
)
def test_bad_input_is_refused(given, words):
    with pytest.raises(ValueError, match=words):
        look(**{"name": "breeze"} | given)


def test_a_simulation_takes_a_look_by_its_name(make_simulation):
    wind = make_simulation(wind="gusts").wind
    assert isinstance(wind, WindField)
    assert wind.flows[0].tolist() == pytest.approx([LOOKS["gusts"].speed, 0.0, 0.0])
    assert [type(effect) for effect in wind.effects] == [Turbulence]
    assert wind.effects[0].intensity == LOOKS["gusts"].intensity
    with pytest.raises(ValueError, match="one of breeze, gusts, storm"):
        make_simulation(wind="gales")


def test_a_start_is_a_later_time():
    """The air has come the start's way: U t."""
    flow, places = [6.0, 2.0, 0.0], torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    plain = WindField(flow, effects=[Turbulence(0.3, 1.5)])
    later = WindField(flow, effects=[Turbulence(0.3, 1.5, start=[7.0 * c for c in flow])])
    for time in (0.0, 1.3):
        found, expected = (wind.at(double(t), places) for wind, t in ((later, time), (plain, time + 7.0)))
        torch.testing.assert_close(found, expected, rtol=0, atol=1e-4)  # places of float32 in a box of some 100 cells
    assert not torch.allclose(found, plain.at(double(1.3), places), atol=0.1)
