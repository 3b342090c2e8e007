"""Least squares on problems whose answers are known."""

import pytest
import torch
from shared import double, randn, seeded, value_error

from gaussian_swaying.inverse.evidence import Block, scales_of
from gaussian_swaying.inverse.fit import (
    NO_STEP,
    Progress,
    huber,
    iterate,
    linearised,
    normal_equations,
    sensitivities,
)
from gaussian_swaying.inverse.unknowns import Unknown, check_apart, condition, directions

TIME = torch.linspace(0, 1, 60, dtype=torch.float64)
FLOORS = {"tracks": 1e-6}


def _decay(truth, noise):
    """Residuals of amplitude x exp(-rate t) against noisy data, of two columns."""

    def curve(place):
        amplitude, rate = 1 + 4 * place[..., 0, None], 10 * place[..., 1, None]
        found = amplitude * torch.exp(-rate * TIME)
        return torch.stack([found, 0.5 * found + 1], -1)

    data = curve(double(truth)) + noise
    cluster = torch.arange(len(TIME)) // 4
    return lambda places: [Block("tracks", curve(places.double()) - data, cluster)]


def _solve(residuals, start, iterations=30):
    progress = Progress(double(start))
    while not progress.done and progress.iteration < iterations:
        iterate(residuals, lambda blocks: scales_of(blocks, FLOORS), progress, 1e-7)
    return progress


def test_outliers_count_little():
    generator = seeded(1)
    noise = 0.01 * randn(60, 2, generator=generator)
    noise[::10] += 3.0  # tracks that jumped to something else
    found = _solve(_decay([0.4, 0.3], noise), [0.9, 0.9])
    assert found.done
    assert found.place.tolist() == pytest.approx([0.4, 0.3], abs=0.006)


def test_a_value_outside_its_range_ends_at_the_end():
    found = _solve(_decay([0.4, -0.1], torch.zeros(60, 2)), [0.9, 0.9])
    assert float(found.place[1]) == 0.0
    assert 0.8 < float(found.place[0]) < 0.9  # the best constant


def test_standard_errors_are_the_scatter_of_repeated_fits():
    """Noise that is the same for four neighbours in time: s^2 A^-1 would be half of it."""
    places, errors = [], []
    for seed in range(60):
        generator = seeded(seed)
        noise = 0.05 * randn(15, 2, generator=generator).repeat_interleave(4, 0)
        residuals = _decay([0.4, 0.3], noise)
        place = _solve(residuals, [0.5, 0.4]).place
        normal, _, _ = linearised(residuals, lambda blocks: scales_of(blocks, FLOORS), place)
        places.append(place)
        errors.append(normal.covariance().diagonal().sqrt())
    scatter, told = torch.stack(places).std(0), torch.stack(errors).square().mean(0).sqrt()
    assert (told / scatter).tolist() == pytest.approx([1.0, 1.0], abs=0.3)


def test_an_exact_combination_is_named_and_refused():
    unknowns = [Unknown("material.E", 1e3, 1e5, "log"), Unknown("material.thickness", 1e-3, 1e-1, "log")]
    row = double([[1.0, 1.0]])  # only the product is seen
    place = double([0.5, 0.5])
    found = directions(100 * row.mT @ row, unknowns, place)
    assert condition(found) > 1e6
    with value_error("cannot tell") as error:
        check_apart(found, unknowns, 1e3)
    for words in ("`material.E` and `material.thickness`", "raising", "lowering", "10%", "`known`"):
        assert words in str(error.value)
    check_apart(directions(torch.eye(2).double(), unknowns, place), unknowns, 1e3)


def test_sensitivities_are_exact_to_second_order_and_stay_in_the_range():
    def squares(places):
        assert ((places >= 0) & (places <= 1)).all()
        return [
            Block("tracks", (places.square() * torch.tensor([1.0, 3.0]))[:, None], torch.zeros(1, dtype=torch.long))
        ]

    place = double([0.5, 0.25])
    blocks, steps = sensitivities(squares, place)
    slopes = (blocks[0].values[1:] - blocks[0].values[:1])[:, 0] / steps[:, None]
    assert slopes.diagonal().tolist() == pytest.approx([1.0, 1.5])
    assert sensitivities(squares, double([0.0, 1.0]))[1].min() > 0


def valley(places):
    """Along the valley y = 0.9 x**2 the residuals change by a thirtieth of what they change across it."""
    x, y = places.T
    values = torch.stack([x - 0.7, 30 * (y - 0.9 * x.square())], -1)[:, :, None]
    return [Block("tracks", values, torch.arange(2))]


def test_the_lowest_place_of_a_narrow_valley_is_found():
    progress = Progress(double([0.3, 0.081]))
    while not progress.done and progress.iteration < 60:
        iterate(valley, lambda blocks: {"tracks": 0.1}, progress, 1e-5)
    assert progress.place.tolist() == pytest.approx([0.7, 0.441], abs=1e-3)


def _steep(places):
    return [Block("tracks", (10 * (places[:, :1] - 0.2).atan())[:, :, None], torch.zeros(1, dtype=torch.long))]


def test_after_a_shorter_step_the_sensitivities_are_those_of_its_end():
    """Its damping is kept, and lowered after a step at once that is as expected."""
    seen = []

    def residuals(places):
        seen.append(len(places))
        assert ((places >= 0) & (places <= 1)).all()
        return _steep(places)

    progress = Progress(double([0.3]))
    far = lambda place, step: place + 8 * step  # noqa: E731
    iterate(residuals, lambda blocks: {"tracks": 1.0}, progress, 1e-6, retract=far)
    assert seen == [3, 3, 5, 3]
    kept = progress.damping
    assert kept >= 1e-3
    there, _, _ = linearised(_steep, lambda blocks: {"tracks": 1.0}, progress.place)
    assert progress.normal.cost == there.cost
    assert torch.equal(progress.normal.gradient, there.gradient)
    iterate(residuals, lambda blocks: {"tracks": 1.0}, progress, 1e-6)
    assert seen[4:] == [3]
    assert progress.damping < 0.1 * kept


def test_a_step_below_the_tolerance_that_is_not_better_is_the_end():
    """Shorter ones are not tried."""
    seen = []

    def residuals(places):
        seen.append(len(places))
        return _steep(places)

    progress = Progress(double([0.2001]))
    iterate(residuals, lambda blocks: {"tracks": 1.0}, progress, 1e-3, retract=torch.sub)
    assert seen == [3, 3]
    assert progress.done == NO_STEP
    assert float(progress.place) == 0.2001


def test_a_rough_valley_ends():
    """Shorter and shorter steps that lower the cost by nearly nothing are an end."""

    def rough(places):
        x, y = places.T
        wave = 0.1 / (2 * torch.pi) * torch.sin(2 * torch.pi * x / 0.05)
        values = torch.stack([x - 0.9 + wave, 30 * (y - 0.9 * x.square())], -1)[:, :, None]
        return [Block("tracks", values, torch.arange(2))]

    progress = Progress(double([0.3, 0.081]))
    while not progress.done and progress.iteration < 40:
        iterate(rough, lambda blocks: {"tracks": 0.1}, progress, 9e-3, 3e-3)
    assert progress.done
    assert progress.iteration < 25


@pytest.mark.parametrize("clusters", [1, 2, 5])
def test_the_error_of_a_mean_is_that_of_its_clusters_and_of_its_residuals(clusters):
    """A mean of C clusters of equal size, in textbooks: variance of their means over C, and sigma^2 / n beside it."""
    size, sigma = 6, 0.2
    draw = randn(clusters, size, generator=seeded(3))
    values = 0.1 * (draw - draw.mean())  # all below HUBER, and their mean is the best place
    cluster = 2 * torch.arange(clusters).repeat_interleave(size)  # every other one is empty
    variants = torch.stack([values, values + 0.004])  # the unknown is added to each
    block = Block("tracks", variants.reshape(2, -1, 1), cluster)
    found = normal_equations([block], {"tracks": sigma}, double([0.004])).covariance()
    between = values.mean(1).var() / clusters if clusters > 1 else 0.0
    expected = float(between + sigma**2 / (clusters * size))
    assert found.shape == (1, 1)
    assert float(found) == pytest.approx(expected, rel=1e-10)  # rounding of a difference of 0.004


def test_errors_that_are_alike_all_over_the_object_count_by_their_time():
    """As clusters: the mean of values that are off by one number in each half of the time."""
    values = double([0.1, -0.1]).repeat_interleave(8)
    cluster, moment = torch.arange(16) % 4, torch.arange(2).repeat_interleave(8)
    variants = torch.stack([values, values + 0.004])
    steps = double([0.004])
    sigma = 0.2
    found = [
        float(
            normal_equations(
                [Block("tracks", variants[..., None], cluster, part)], {"tracks": sigma}, steps
            ).covariance()
        )
        for part in (moment, None)
    ]
    assert found[0] - found[1] == pytest.approx(0.1**2, rel=1e-9)  # 2 / (2 - 1) * 2 * 0.1^2 / 4
    assert found[1] == pytest.approx(sigma**2 / 16, rel=1e-9)


def test_the_cost_is_hubers_function():
    """Against torch's, on both sides of 1.345 standard deviations."""
    sigma = 0.5
    values = double([[0.1, -0.6, 0.67, -0.68, 2.0], [0.0, 1.0, -3.0, 0.5, 0.2]])
    blocks = [
        Block("tracks", values[:, :2, None], torch.zeros(2)),
        Block("tracks", values[:, 2:, None], torch.zeros(3)),
    ]
    expected = torch.nn.functional.huber_loss(
        values / sigma, torch.zeros_like(values), reduction="none", delta=1.345
    ).mean(1)
    torch.testing.assert_close(huber(blocks, {"tracks": sigma}), expected)
    values[1, 3] = float("nan")
    assert huber(blocks, {"tracks": sigma}).tolist() == [pytest.approx(float(expected[0])), float("inf")]
