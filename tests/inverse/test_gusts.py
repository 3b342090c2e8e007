"""Mean, intensity and time scale of a wind whose numbers are known."""

import math

import pytest
import torch
from shared import double, randn, seeded

from gaussian_swaying.inverse.unknowns import Unknown, changes_of, gusts_of, spectrum

MEAN, INTENSITY, SCALE, EVERY = 4.0, 0.2, 0.8, 0.375


def process(seed, seconds, error=0.0):
    """Speeds of Ornstein and Uhlenbeck's process at some times, and the covariance of their errors."""
    generator = seeded(seed)
    count = round(seconds / EVERY) + 1
    draw = randn(2, count, generator=generator)
    keep, speeds = math.exp(-EVERY / SCALE), [float(draw[0, 0])]
    for step in draw[0, 1:].tolist():
        speeds.append(keep * speeds[-1] + math.sqrt(1 - keep**2) * step)
    times = [EVERY * k for k in range(count)]
    seen = MEAN * (1 + INTENSITY * double(speeds)) + error * draw[1]
    return times, seen, error**2 * torch.eye(count).double()


@pytest.mark.parametrize(("seconds", "error"), [(24.0, 0.0), (24.0, 0.3), (3.0, 0.1)])
def test_the_intervals_contain_the_truth_as_often_as_they_say(seconds, error):
    """Two times of three, each of the three numbers, also where the film is short or errors are as large as gusts."""
    inside = torch.zeros(3)
    for seed in range(40):
        found = spectrum(*process(seed, seconds, error))
        intervals = (found.mean, found.intensity, found.time_scale)
        inside += torch.tensor([low <= true <= high for (_, low, high), true in zip(intervals, TRUTH, strict=True)])
    assert (inside / 40).tolist() == pytest.approx([0.68] * 3, abs=0.2)


TRUTH = (MEAN, INTENSITY, SCALE)


def test_a_long_film_tells_the_time_scale_and_a_short_one_says_that_it_does_not():
    long = [spectrum(*process(seed, 40.0, 0.1)) for seed in range(12)]
    short = [spectrum(*process(seed, 3.0, 0.1)) for seed in range(12)]
    assert sum(one.told for one in long) >= 10
    assert sum(one.told for one in short) <= 2
    assert torch.tensor([one.time_scale[0] for one in long]).median() == pytest.approx(SCALE, rel=0.3)
    assert "their time scale" in long[0].sentence()
    assert "3 s are too short to tell their time scale" in short[0].sentence()


def test_errors_of_a_fit_are_no_gusts():
    """A steady wind that is seen with errors: a weak intensity, if the errors are known."""
    generator = seeded(0)
    times = [EVERY * k for k in range(40)]
    speeds = MEAN + 0.4 * randn(40, generator=generator)
    seen = [spectrum(times, speeds, error**2 * torch.eye(40).double()) for error in (0.4, 0.01)]
    assert seen[0].intensity[0] < 0.05
    assert seen[1].intensity[0] == pytest.approx(0.1, rel=0.2)


def test_the_gusts_of_a_fitted_wind():
    """Its knots are speeds in m/s, whose errors come from those of the speed and of the factors."""
    speed = Unknown("wind.speed", 1.0, 16.0, "log")
    unknowns = [Unknown("material.E", 1e3, 1e5, "log"), speed, *changes_of([speed], 3.0)]
    place = [0.5, 0.5, *(u.share(1.5 if k % 2 else 0.7) for k, u in enumerate(unknowns[2:]))]
    small = gusts_of(unknowns, place, 1e-8 * torch.eye(len(unknowns)))
    assert small.seconds == 3.0
    values = [4.0 * u.value(share) for u, share in zip(unknowns[2:], place[2:], strict=True)]
    times = [0.0, *(float(u.name.split("@")[1]) for u in unknowns[2:])]
    exact = spectrum(times, torch.tensor([4.0, *values]).double(), 1e-8 * torch.eye(len(times)).double())
    assert small.intensity == pytest.approx(exact.intensity, rel=1e-3)
    assert gusts_of(unknowns, place, 1e-1 * torch.eye(len(unknowns))).intensity[1] < 0.5 * small.intensity[1]
    assert gusts_of(unknowns[:2], place[:2], torch.eye(2)) is None
