"""Least squares on problems whose answers are known."""

import math

import pytest
import torch
from shared import double, randn, seeded, value_error

from gaussian_swaying.inverse.least_squares import (
    CLOSELY,
    NO_STEP,
    REACH,
    Block,
    DivergedError,
    beside,
    cost_of,
    covariance,
    normal,
    scale_of,
    solve,
)
from gaussian_swaying.inverse.plan import Unknown, check_apart

TIME = torch.linspace(0, 1, 60, dtype=torch.float64)


def scaled(sigma):
    """Standard deviations that stay."""
    return lambda block: sigma


def estimated(block):
    """Those of the residuals."""
    return scale_of(block, 1e-6)


def _decay(truth, noise):
    """Residuals of amplitude x exp(-rate t) against noisy data, of two columns."""

    def curve(place):
        amplitude, rate = 1 + 4 * place[..., 0, None], 10 * place[..., 1, None]
        found = amplitude * torch.exp(-rate * TIME)
        return torch.stack([found, 0.5 * found + 1], -1)

    data = curve(double(truth)) + noise
    cluster = torch.arange(len(TIME)) // 4
    return lambda places: Block(curve(places.double()) - data, cluster)


def _solved(residuals, start, rescale=estimated, most=60):
    return solve(residuals, double(start), most, closely=True, scale=rescale)


def test_outliers_count_little():
    generator = seeded(1)
    noise = 0.01 * randn(60, 2, generator=generator)
    noise[::10] += 3.0  # tracks that jumped to something else
    found = _solved(_decay([0.4, 0.3], noise), [0.9, 0.9])
    assert found.ended
    assert found.place.tolist() == pytest.approx([0.4, 0.3], abs=0.006)


def test_a_value_outside_its_range_ends_at_the_end():
    found = _solved(_decay([0.4, -0.1], torch.zeros(60, 2)), [0.9, 0.9])
    assert float(found.place[1]) == 0.0
    assert 0.8 < float(found.place[0]) < 0.9  # the best constant


def test_standard_errors_are_the_scatter_of_repeated_fits():
    """Noise that is the same for four neighbours in time: s^2 A^-1 would be half of it."""
    places, errors = [], []
    for seed in range(60):
        generator = seeded(seed)
        noise = 0.05 * randn(15, 2, generator=generator).repeat_interleave(4, 0)
        residuals = _decay([0.4, 0.3], noise)
        place = _solved(residuals, [0.5, 0.4]).place
        places.append(place)
        errors.append(covariance(*normal(residuals, place, estimated)).diagonal().sqrt())
    scatter, told = torch.stack(places).std(0), torch.stack(errors).square().mean(0).sqrt()
    assert (told / scatter).tolist() == pytest.approx([1.0, 1.0], abs=0.3)


def test_an_exact_combination_is_named_and_refused():
    unknowns = [Unknown("material.E", 1e3, 1e5, "log"), Unknown("material.thickness", 1e-3, 1e-1, "log")]
    row = double([[1.0, 1.0]])  # only the product is seen
    place = double([0.5, 0.5])
    with value_error("cannot tell") as error:
        check_apart(100 * row.mT @ row, unknowns, place, 1e6)
    for words in ("`material.E` and `material.thickness`", "raising", "lowering", "10%", "`known`"):
        assert words in str(error.value)
    check_apart(torch.eye(2).double(), unknowns, place, 1e3)


def test_sensitivities_are_exact_to_second_order_and_stay_in_the_range():
    """Of x^2 + 3 y^2, whose sum of sensitivities times residuals is its square's half derivative."""

    def squares(places):
        assert ((places >= 0) & (places <= 1)).all()
        weighed = places.square() * torch.tensor([1.0, 3.0])
        return Block(weighed[:, None], torch.zeros(1, dtype=torch.long))

    matrix, scores = normal(squares, double([0.5, 0.25]), scaled(1.0))
    assert matrix.diagonal().tolist() == pytest.approx([1.0, 1.5**2])
    assert scores[0].sum(0).tolist() == pytest.approx([0.25 * 1.0, 0.1875 * 1.5])
    assert beside(double([0.0, 1.0]))[1].min() > 0
    normal(squares, double([0.0, 1.0]), scaled(1.0))


def valley(places):
    """Along the valley y = 0.9 x**2 the residuals change by a thirtieth of what they change across it."""
    x, y = places.T
    values = torch.stack([x - 0.7, 30 * (y - 0.9 * x.square())], -1)[:, :, None]
    return Block(values, torch.arange(2))


def test_the_lowest_place_of_a_narrow_valley_is_found():
    found = _solved(valley, [0.3, 0.081], scaled(0.1))
    assert found.place.tolist() == pytest.approx([0.7, 0.441], abs=1e-3)


def test_a_rough_valley_ends():
    """Shorter and shorter steps that lower the cost by nearly nothing are an end."""

    def rough(places):
        x, y = places.T
        wave = 0.1 / (2 * torch.pi) * torch.sin(2 * torch.pi * x / 0.05)
        values = torch.stack([x - 0.9 + wave, 30 * (y - 0.9 * x.square())], -1)[:, :, None]
        return Block(values, torch.arange(2))

    found = solve(rough, double([0.3, 0.081]), 40, scale=scaled(0.1))
    assert found.ended
    assert found.steps < 25


def test_a_wind_across_a_sheet_is_found_in_few_steps():
    """The wind across is seen forty times as well as that along the sheet, in speed and azimuth a curved valley."""
    speed, azimuth = Unknown("wind.speed", 0.5, 16.0, "log"), Unknown("wind.azimuth", -80.0, 160.0)

    def components(place):
        angle = math.radians(azimuth.value(float(place[1])))
        return [speed.value(float(place[0])) * part for part in (math.cos(angle), math.sin(angle))]

    wanted, across = components([0.5, 0.7]), double([math.cos(0.3), math.sin(0.3)])
    along = torch.stack([-across[1], across[0]])

    def curved(places):
        off = double([components(place) for place in places]) - torch.tensor(wanted)
        values = torch.stack([20 * off @ across, 0.5 * off @ along], -1)
        return Block(values[:, :, None], torch.arange(2))

    found = _solved(curved, [0.55, 0.45], scaled(1.0))
    assert found.steps < 30
    assert found.place.tolist() == pytest.approx([0.5, 0.7], abs=1e-3)


def test_no_first_step_is_longer_than_its_reach():
    tried = []

    def line(places):
        tried.append(places.clone())
        return Block(10 * (places - 0.95)[:, :, None], torch.arange(2))

    _solved(line, [0.1, 0.2], scaled(1.0))
    first = next(places for places in tried[1:] if len(places) == 1)
    assert float((first - double([0.1, 0.2])).abs().max()) == pytest.approx(REACH)


def test_steps_are_counted_and_run_out():
    found = solve(valley, double([0.3, 0.081]), 2, scale=scaled(0.1))
    assert (found.steps, found.ended) == (2, "")
    again = solve(valley, double([0.7, 0.441]), 9, True, scaled(0.1))
    assert again.ended
    assert float((again.place - double([0.7, 0.441])).abs().max()) < CLOSELY[0]


def test_where_nothing_is_better_the_place_stays():
    """Differences that lie: every step goes up, and shorter ones are tried until they are none."""

    def lying(places):
        values = places if len(places) > 1 else (places - 0.5).abs() + 0.5
        return Block(values[:, :, None], torch.zeros(1, dtype=torch.long))

    found = _solved(lying, [0.5], scaled(1.0))
    assert found.ended == NO_STEP
    assert float(found.place) == 0.5


def test_a_variant_that_diverges_is_no_end():
    """Beyond 0.6 everything is lost; a place that is lost itself is an error."""

    def lost(places):
        values = torch.where(places < 0.6, places - 0.55, torch.nan)
        return Block(values[:, :, None], torch.zeros(1, dtype=torch.long))

    assert float(_solved(lost, [0.1], scaled(1.0)).place) == pytest.approx(0.55, abs=1e-3)
    for work in (lambda: _solved(lost, [0.7], scaled(1.0)), lambda: normal(lost, double([0.7]), scaled(1.0))):
        with pytest.raises(DivergedError, match="Every simulation of a step diverged"):
            work()


def _mean(values, cluster, sigma, moment=None):
    """The covariance of an unknown that is added to each value."""

    def at(places):
        return Block((values.flatten() + places - 0.5)[..., None], cluster, moment)

    return covariance(*normal(at, double([0.5]), scaled(sigma)))


@pytest.mark.parametrize("clusters", [1, 2, 5])
def test_the_error_of_a_mean_is_that_of_its_clusters_and_of_its_residuals(clusters):
    """A mean of C clusters of equal size, in textbooks: variance of their means over C, and sigma^2 / n beside it."""
    size, sigma = 6, 0.2
    draw = randn(clusters, size, generator=seeded(3))
    values = (0.1 * (draw - draw.mean())).double()  # all below HUBER, and their mean is the best place
    cluster = 2 * torch.arange(clusters).repeat_interleave(size)  # every other one is empty
    found = _mean(values, cluster, sigma)
    between = values.mean(1).var() / clusters if clusters > 1 else 0.0
    expected = float(between + sigma**2 / (clusters * size))
    assert found.shape == (1, 1)
    assert float(found) == pytest.approx(expected, rel=1e-10)  # rounding of a difference of 0.004


def test_errors_that_are_alike_all_over_the_object_count_by_their_time():
    """As clusters: the mean of values that are off by one number in each half of the time."""
    values = double([0.1, -0.1]).repeat_interleave(8)
    cluster, moment = torch.arange(16) % 4, torch.arange(2).repeat_interleave(8)
    sigma = 0.2
    found = [float(_mean(values, cluster, sigma, part)) for part in (moment, None)]
    assert found[0] - found[1] == pytest.approx(0.1**2, rel=1e-9)  # 2 / (2 - 1) * 2 * 0.1^2 / 4
    assert found[1] == pytest.approx(sigma**2 / 16, rel=1e-9)


def test_the_cost_is_hubers_function():
    """Against torch's, on both sides of 1.345 standard deviations."""
    sigma = 0.5
    values = double([[0.1, -0.6, 0.67, -0.68, 2.0], [0.0, 1.0, -3.0, 0.5, 0.2]])
    block = Block(values[..., None], torch.zeros(5))
    expected = torch.nn.functional.huber_loss(
        values / sigma, torch.zeros_like(values), reduction="none", delta=1.345
    ).mean(1)
    torch.testing.assert_close(cost_of(block, sigma), expected)
    values[1, 3] = float("nan")
    assert cost_of(block, sigma).tolist() == [pytest.approx(float(expected[0])), float("inf")]


def test_the_scale_is_that_of_normal_noise():
    for count in (1, 2, 3):
        values = 0.3 * randn(1, 4000, count, generator=seeded(0))
        values[:, :200] = 50.0
        assert scale_of(Block(values, torch.zeros(4000)), 0.0) == pytest.approx(0.3, rel=0.1)
