"""Turbulence against von Karman's closed forms: variance, length, spectrum, coherence, divergence, interpolation.

A box holds the waves between its sides and its cells, and leaves the others out. So each number has two targets: the
closed form of endless turbulence, where what is left out does not matter, and the sum over the waves of the box.
"""

import math

import pytest
import torch
from shared import EYE, double, near, peak, rand, randn, seeded, value_error
from torch.testing import assert_close

from gaussian_swaying.kernels.derive import Memory, on_tensors
from gaussian_swaying.wind.effects import Moment
from gaussian_swaying.wind.field import FlowKey, WindField
from gaussian_swaying.wind.tables import CarriedField, box_axes, look_up
from gaussian_swaying.wind.turbulence import (
    CELLS as LOOK_CELLS,
)
from gaussian_swaying.wind.turbulence import (
    LOOKS,
    Turbulence,
    along_spectrum,
    energy_spectrum,
    look,
    resolved_share,
    sheared_variances,
    turbulence_box,
    turbulence_length,
)

CELLS, H, L, SEEDS = (128, 64, 64), 0.25, 1.0, 20
K = math.pi / H


def looked_up(table, place, wraps=False):
    """Values of a table at places in cells (n, 3)."""
    sizes = tuple(map(float, table.shape[:3]))
    return torch.stack(on_tensors(look_up)(Memory(table), sizes, place.unbind(-1), (wraps,) * 3 + (3,)), dim=-1)


def _waves(cells=CELLS, spacing=H):
    """Wave numbers of a box, and the share of the variance along x in each of its waves, by Batchelor's tensor."""
    axes = [2 * math.pi * torch.fft.fftfreq(n, spacing, dtype=torch.float64) for n in cells]
    k1, k2, k3 = torch.meshgrid(*axes, indexing="ij")
    square = k1**2 + k2**2 + k3**2
    square[0, 0, 0] = 1.0
    found = energy_spectrum(square.sqrt(), L) / (4 * math.pi * square) * (1 - k1**2 / square)
    found *= math.prod(2 * math.pi / (n * spacing) for n in cells)
    found[0, 0, 0] = 0
    for axis in range(3):
        found.select(axis, cells[axis] // 2).zero_()
    return axes, found


@pytest.fixture(scope="module")
def measured():
    variance, spectrum, cross = 0, 0, {j: 0 for j in (1, 2, 4)}
    for seed in range(SEEDS):
        box = turbulence_box(CELLS, [H] * 3, L, seed=seed).double()
        variance = variance + box.square().mean((0, 1, 2)) / SEEDS
        wave = torch.fft.fft(box, dim=0) / CELLS[0]
        unit = CELLS[0] * H / (2 * math.pi) / SEEDS
        spectrum = spectrum + unit * wave[..., 0].abs().square().mean((1, 2))
        for j in cross:
            both = wave[..., 0] * wave[..., 0].roll(-j, 1).conj()
            cross[j] = cross[j] + unit * both.real.mean((1, 2))
    return variance, spectrum, cross


@pytest.mark.parametrize("spectrum", ["von_karman", "kaimal"])
def test_spectra_agree_with_each_other(spectrum):
    k = torch.logspace(-7, 7, 100001, dtype=torch.float64)
    energy = energy_spectrum(k, 2.0, spectrum)
    assert float(torch.trapezoid(energy, k)) == pytest.approx(1.5, rel=1e-4)  # k^(-5/3) beyond 1e7: 2e-5
    assert 2 * float(torch.trapezoid(along_spectrum(k, 2.0, spectrum), k)) == pytest.approx(1.0, rel=1e-4)
    assert math.pi * float(along_spectrum(torch.zeros(()), 2.0, spectrum)) == pytest.approx(2.0)
    for k1 in (0.05, 0.7, 9.0):  # Batchelor 3.4.15
        q = k1 * torch.logspace(0, 7, 20001, dtype=torch.float64)
        rest = torch.trapezoid(energy_spectrum(q, 2.0, spectrum) / q * (1 - (k1 / q) ** 2), q) / 2
        assert float(rest) == pytest.approx(float(along_spectrum(torch.tensor(k1), 2.0, spectrum)), rel=1e-5)


def test_the_resolved_share_is_that_of_the_waves_of_a_box():
    _, share = _waves((64, 64, 64), 0.25)
    # waves of exactly two cells are left out of the box: a 64th of each axis at its far end
    assert resolved_share(L, (0.25,) * 3) == pytest.approx(float(share.sum()), abs=0.01)
    assert resolved_share(L, (L / 16,) * 3) == pytest.approx(0.92, abs=0.01)
    assert resolved_share(L, (0.25, 0.25, 1.0)) < resolved_share(L, (0.25,) * 3)


def test_variance_is_that_of_the_waves_of_the_box(measured):
    _, share = _waves()
    target = float(share.sum())
    # of a sum of independent squares, half of which come twice
    error = float((2 * share.square().sum() / SEEDS).sqrt())
    assert 4 * error < 0.05 * target
    for found in measured[0].tolist():
        assert found == pytest.approx(target, rel=0.05)


def test_spectra_are_von_karmans(measured):
    (k1, *_), share = _waves()
    exact = share.sum((1, 2)) / (k1[1] - k1[0])
    for first, last in ((1, 4), (4, 8), (8, 16), (16, 32), (32, 60)):
        band = slice(first, last)
        assert float(measured[1][band].mean() / exact[band].mean()) == pytest.approx(1.0, abs=0.05)
    band = slice(1, 9)
    assert float(k1[8]) == pytest.approx(K / 8)
    assert float((measured[1][band] / along_spectrum(k1[band], L)).mean()) == pytest.approx(1.0, abs=0.05)


def test_coherence_is_that_of_the_waves_of_the_box(measured):
    (_, k2, _), share = _waves()
    for j, cross in measured[2].items():
        found = cross / measured[1]
        turned = (share * torch.cos(k2 * j * H)[:, None]).sum((1, 2)) / share.sum((1, 2)).clamp(min=1e-30)
        for first, last in ((1, 3), (3, 6), (6, 12)):
            assert float((found - turned)[first:last].mean()) == pytest.approx(0.0, abs=0.025)


@pytest.mark.parametrize("gamma", [0.0, 3.9])
def test_there_is_no_divergence(gamma):
    box = turbulence_box((32, 16, 24), [0.25, 0.5, 0.3], L, gamma=gamma, seed=3).double()
    shape, steps = box.shape[:3], (0.25, 0.5, 0.3)
    k = torch.meshgrid(
        *[2 * math.pi * torch.fft.fftfreq(n, h, dtype=torch.float64) for n, h in zip(shape, steps, strict=True)],
        indexing="ij",
    )
    waves = torch.fft.fftn(box, dim=(0, 1, 2))
    gradient = torch.stack([k[i] * waves[..., j] for i in range(3) for j in range(3)])
    divergence = gradient[0] + gradient[4] + gradient[8]
    assert divergence.norm() / gradient.norm() < 1e-5
    assert gradient[0].norm() / gradient.norm() > 0.05  # not because nothing varies along x


def test_interpolation_takes_the_smallest_waves():
    """Between two corners a wave keeps (2 + cos k h) / 3 of its square on average, along each axis."""
    (k1, k2, k3), share = _waves()
    kept = [(2 + torch.cos(k * H)) / 3 for k in (k1, k2, k3)]
    target = float((share * kept[0][:, None, None] * kept[1][:, None] * kept[2]).sum())
    assert target < 0.9 * share.sum()
    draw = seeded(1)
    place = rand(100_000, 3, generator=draw) * torch.tensor(CELLS)
    found = 0.0
    for seed in range(SEEDS):
        box = turbulence_box(CELLS, [H] * 3, L, seed=seed)
        found += float(looked_up(box, place, True)[:, 0].square().mean()) / SEEDS
    assert found == pytest.approx(target, rel=0.05)


def test_look_ups_are_exact_for_a_linear_field():
    table = torch.cartesian_prod(*[torch.arange(n).double() for n in (4, 5, 6)]).reshape(4, 5, 6, 3)
    place = double([[0.3, 3.2, 4.9], [2.99, 0.0, 5.0], [-1.0, 7.0, 2.5]])
    expected = place.clone()
    expected[2] = torch.tensor([0.0, 4.0, 2.5])
    assert_close(looked_up(table, place), expected)
    around = looked_up(table, double([[3.5, 0.0, -0.25]]), True)
    assert_close(around, double([[1.5, 0.0, 1.25]]))


@pytest.mark.parametrize("wraps", [True, False])
def test_places_that_are_no_numbers_stay_in_the_table(wraps):
    table = torch.ones(4, 5, 6, 3)
    place = torch.tensor([[float("nan"), 1.0, 1.0], [float("inf"), 1.0, 1.0], [1e30, -1e30, 1.0]])
    found = looked_up(table, place, wraps)
    assert found.shape == (3, 3)
    assert found[0].isnan().all()
    table = torch.arange(4.0).repeat_interleave(12).reshape(4, 2, 2, 3)  # just below zero rounds up to its length
    assert looked_up(table, torch.tensor([[-1e-9, 0.0, 0.0]]), wraps).tolist() == [[0.0] * 3]


def test_shear_has_the_variances_of_the_standard():
    """IEC 61400-1 (ed. 3, annex B): with 3.9 the deviations are 1, 0.7 and 0.5, isotropic ones 0.55; it rounds."""
    along, across, up = (math.sqrt(v) for v in sheared_variances(3.9))
    assert 1 / along == pytest.approx(0.55, abs=0.01)
    assert across / along == pytest.approx(0.7, abs=0.02)
    assert up / along == pytest.approx(0.5, abs=0.03)
    assert sheared_variances(0.0) == (1.0, 1.0, 1.0)
    for found in sheared_variances(1e-4):  # waves beyond 1e3 / L, and the steps of the sum: 1 %
        assert found == pytest.approx(1.0, abs=0.015)


def test_shear_makes_gusts_down_the_wind_and_stress():
    length, found = 1.0, 0
    for seed in range(4):
        box = turbulence_box((512, 32, 32), [0.5] * 3, length, gamma=3.9, seed=seed).double().flatten(0, 2)
        found = found + box.T @ box / len(box) / 4
    whole = sheared_variances(3.9)
    for i in range(3):
        assert 0.6 * whole[i] < found[i, i] < whole[i]
    assert found[0, 2] < -0.3 * float(found[2, 2])
    assert abs(float(found[0, 1])) < 0.15 * float(found[0, 0])


def test_a_seed_is_a_turbulence(device):
    """On every device: transforms of 2^13 float32 numbers differ by some 1e-6 of their size."""
    one, same, other = (
        turbulence_box((32, 16, 16), [0.25] * 3, L, gamma=2.0, seed=seed, device=where)
        for seed, where in ((5, "cpu"), (5, device), (6, "cpu"))
    )
    near(same.cpu(), one, 0 if one.device == same.device else 2e-5)
    assert peak(one - other) > 0.5


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cells": [15, 8, 8]}, "Expected `cells`"),
        ({"cells": [8, 8]}, "Expected `cells`"),
        ({"cells": [2048, 512, 512]}, "too large"),
        ({"length": 0.0}, "Expected `length`"),
        ({"spectrum": "x"}, "Expected `spectrum`"),
        ({"spectrum": "kaimal", "gamma": 1.0}, "gamma"),
    ],
)
def test_impossible_boxes_are_refused(changes, message):
    with value_error(message):
        _gusts(**changes)


def _gusts(**changes):
    return Turbulence(**{"intensity": 0.2, "length": L, "cells": [32, 16, 16], "spacing": 0.25, "seed": 2} | changes)


def test_turbulence_is_carried_by_the_mean_wind():
    """Taylor: what is at x now is at x + U t later, whatever the modulations; the size follows from the speed."""
    flow = double([3.0, -4.0, 0.5])
    wind = WindField(flow.tolist(), effects=[_gusts()])
    place = rand(50, 3, generator=seeded(0))
    now, later = (double(t) for t in (0.3, 7.9))
    first = wind.at(now, place)
    near(wind.at(later, place + (later - now) * flow), first, 1e-10)
    assert peak(wind.at(later, place) - first) > 0.5
    still = wind.effects[0](torch.zeros(3), place, wind.moment(now))
    thrice = wind.effects[0](torch.zeros(3), place, Moment(now, 2 * flow, wind.carried(now), double(1.5)))
    assert_close(first, flow + still)
    assert_close(thrice, 3 * still)


def test_the_box_comes_back_at_another_place():
    sides = (16.0, 8.0, 8.0)
    flow = torch.tensor([1.0, 2.0, 0.0])
    tilted, straight = (box_axes(flow, sides, tilted) for tilted in (True, False))
    for axes in (tilted, straight):
        assert_close(axes @ axes.T, EYE)
        assert float(torch.linalg.det(axes)) == pytest.approx(1.0)
    direction = flow.double() / flow.norm()
    assert_close(straight @ direction, double([1.0, 0.0, 0.0]))
    passed = tilted @ direction
    passed = passed * (sides[0] / passed[0])
    assert_close(passed, double([16.0, 0.382 * 8, 0.236 * 8]))
    box_axes(torch.tensor([0.0, 0.0, -3.0]), sides, True)  # straight down
    assert torch.equal(box_axes(torch.zeros(3), sides, False)[0], double([1.0, 0.0, 0.0]))


@pytest.mark.parametrize("interpolation", ["step", "linear"])
def test_air_is_carried_by_a_changing_flow(interpolation):
    keys = [FlowKey(1.0, [2.0, 0.0, 0.0]), FlowKey(2.0, [0.0, 4.0, 0.0]), FlowKey(4.0, [1.0, 1.0, 1.0], gusts=2.0)]
    wind = WindField(schedule=keys, interpolation=interpolation)
    fine = torch.arange(0, 6, 1e-3, dtype=torch.float64)
    flows = wind.mean_flow(fine + 5e-4)
    sums = torch.cat([torch.zeros(1, 3), flows.cumsum(0) * 1e-3])
    near(wind.carried(fine), sums[:-1], 1e-9)
    one = double(2.5)
    near(wind.carried(one), sums[2500], 1e-9)
    assert_close(WindField([1.0, 2.0, 3.0]).carried(one), 2.5 * double([1.0, 2.0, 3.0]))


def test_a_field_that_does_not_repeat_goes_on_outside():
    table = torch.zeros(4, 2, 2, 3)
    table[:, 0, :, 0], table[:, 1, :, 0] = 1.0, 5.0
    field = CarriedField(table, [1.0, 0.5, 0.5], wraps=(True, False, False))
    field = field.along(torch.tensor([2.0, 0.0, 0.0]))
    still = torch.zeros(3).double()
    place = double([[0.0, -3.0, 0.0], [100.3, 0.25, 9.0], [0.0, 3.0, 0.0]])
    found = field(torch.zeros(3), place, Moment(still[0], still, still, double(1.0)))
    assert_close(found[:, 0], double([1.0, 3.0, 5.0]))
    with value_error("Expected `table` of shape"):
        CarriedField(torch.zeros(4, 2, 2), [1.0] * 3)


SECONDS, RECORDS = 400.0, 6


def record(wind, places, step=0.2, seconds=SECONDS):
    """Wind at places (K, 3), shape (T, K, 3); the field is carried, so a later time is a place upstream."""
    times = torch.arange(round(seconds / step)).double() * step
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
        record(look(name, (0.0, 2.0, 0.0), height=height, seed=seed), [[0.0, 0.0, 0.0]]) for seed in range(RECORDS)
    ]
    air = torch.cat(records)[:, 0]
    count = RECORDS * min(SECONDS * given.speed / (2 * turbulence_length(height)), math.prod(LOOK_CELLS) / 16**3)
    sigma = given.intensity * given.speed
    flow = double([0.0, given.speed, 0.0])
    assert ((air.mean(0) - flow).abs() < 3 * sigma / math.sqrt(count)).all()
    for spread in air.std(0).tolist():  # isotropic
        assert spread == pytest.approx(0.87 * sigma, rel=3 * 0.05 / math.sqrt(RECORDS) + 0.05)


def test_the_length_is_that_of_kaimals_peak():
    """3.2 heights, and 1.5 m at least."""
    assert turbulence_length(0.1) == 1.5
    assert turbulence_length(4.0) == pytest.approx(12.8)
    assert look("gusts", height=4.0).effects[0].length == turbulence_length(4.0)


def test_direction_and_speed_may_be_given():
    wind = look("storm", (3.0, 4.0, 0.0), speed=5.0)
    assert wind.flows[0].tolist() == pytest.approx([3.0, 4.0, 0.0])
    assert not wind.uniform
    places = torch.zeros(1, 3).double()
    first, other = (look("storm", seed=seed).at(double(0.0), places) for seed in (0, 1))
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
    with value_error(words):
        look(**{"name": "breeze"} | given)


def test_a_simulation_takes_a_look_by_its_name(make_simulation):
    wind = make_simulation(wind="gusts").wind
    assert isinstance(wind, WindField)
    assert wind.flows[0].tolist() == pytest.approx([LOOKS["gusts"].speed, 0.0, 0.0])
    assert [type(effect) for effect in wind.effects] == [Turbulence]
    assert wind.effects[0].intensity == LOOKS["gusts"].intensity
    with value_error("one of breeze, gusts, storm"):
        make_simulation(wind="gales")


def test_a_start_is_a_later_time():
    flow, places = [6.0, 2.0, 0.0], randn(20, 3, generator=seeded(0))
    plain = WindField(flow, effects=[Turbulence(0.3, 1.5)])
    later = WindField(flow, effects=[Turbulence(0.3, 1.5, start=[7.0 * c for c in flow])])
    for time in (0.0, 1.3):
        found, expected = (wind.at(double(t), places) for wind, t in ((later, time), (plain, time + 7.0)))
        near(found, expected, 1e-4)  # places of float32 in a box of some 100 cells
    assert not torch.allclose(found, plain.at(double(1.3), places), atol=0.1)
