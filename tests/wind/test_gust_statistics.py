"""Statistics of the gusts: of what is drawn, not of the substep at which it is read."""

import math

import pytest
import torch
from shared import double
from torch.testing import assert_close

from gaussian_swaying import GaussianGust, UniformGust, WindField

T, STD, DELTA = 0.04, 0.3, 0.3  # s, m/s, share
COARSE, FINE = 1e-2, 1e-3  # two substeps [s]
INTERVALS = 6000  # samples drawn in a record of 240 s
FOUR = 4 / math.sqrt(INTERVALS)  # standard errors that an estimate may be off

# name, modulation, mean flow, standard deviation of a component, kurtosis
GUSTS = {
    "gaussian": (GaussianGust(STD, T), [2.0, -1.0, 0.5], STD, 3.0),
    "uniform": (UniformGust(DELTA, T), [2.0, 0.0, 0.0], 2.0 * DELTA / math.sqrt(3), 1.8),
}


def _read(gust, dt, seconds=INTERVALS * T, seed=11, flow=None):
    """The wind at every substep: shape (steps, 3)."""
    modulation, mean, _, _ = GUSTS[gust]
    wind = WindField(mean if flow is None else flow, modulations=[modulation], seed=seed)
    return wind(torch.arange(round(seconds / dt), dtype=torch.float64) * dt)


def _gusts(gust, dt, **more):
    """The same without the mean flow that was set, first component."""
    return (_read(gust, dt, **more) - double(GUSTS[gust][1]))[:, 0]


@pytest.mark.parametrize("gust", GUSTS)
def test_two_substeps_read_the_same_samples(gust):
    ratio = round(COARSE / FINE)
    assert torch.equal(_read(gust, FINE)[::ratio], _read(gust, COARSE))


@pytest.mark.parametrize("dt", [COARSE, FINE])
@pytest.mark.parametrize("gust", GUSTS)
def test_mean_and_variance(gust, dt):
    """Standard errors: s / sqrt(M) of the mean, s^2 sqrt((kurtosis - 1) / M) of the variance about a known mean."""
    _, mean, std, kurtosis = GUSTS[gust]
    values = (_read(gust, dt) - double(mean)).T
    for one in values if gust == "gaussian" else values[:1]:
        assert abs(float(one.mean())) < FOUR * std
        assert float(one.square().mean()) == pytest.approx(std**2, abs=FOUR * std**2 * math.sqrt(kurtosis - 1))


@pytest.mark.parametrize("dt", [COARSE, FINE])
@pytest.mark.parametrize("gust", GUSTS)
def test_autocovariance_is_a_triangle_as_wide_as_the_interval(gust, dt):
    """s^2 (1 - |lag| / T), averaged over the phase: so the spectrum is 2 s^2 T sinc^2(f T), whatever the substep."""
    _, _, std, _ = GUSTS[gust]
    values = _gusts(gust, dt)
    per_interval = round(T / dt)
    whole = len(values) - 4 * per_interval  # a whole number of intervals, the same for every lag
    for lag in sorted({0, *(round(share * per_interval) for share in (0.25, 0.5, 0.75, 1.0, 1.5, 3.0))}):
        found = float((values[:whole] * values[lag : lag + whole]).mean())
        expected = std**2 * max(0.0, 1 - lag / per_interval)
        assert found == pytest.approx(expected, abs=FOUR * std**2 * math.sqrt(2)), f"lag {lag * dt} s"


def _uncorrelated(a, b):
    """Both standardised, one value for each interval."""
    assert len(a) == INTERVALS
    product = (a - a.mean()) * (b - b.mean()) / (a.std() * b.std())
    return abs(float(product.mean())) < FOUR


def test_components_are_independent():
    """Not only uncorrelated: neither are their squares."""
    values = _read("gaussian", T) - double([2.0, -1.0, 0.5])
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert _uncorrelated(values[:, i], values[:, j])
        assert _uncorrelated(values[:, i].square(), values[:, j].square())


def test_one_uniform_factor_scales_all_components():
    values = _read("uniform", T, flow=[2.0, -1.0, 0.5])
    assert_close(values, values[:, :1] * double([1.0, -0.5, 0.25]))
    factor = values[:, 0] / 2
    assert 1 - DELTA <= factor.min() < 1 - 0.998 * DELTA
    assert 1 + 0.998 * DELTA < factor.max() <= 1 + DELTA


@pytest.mark.parametrize("gust", GUSTS)
def test_seeds_are_independent(gust):
    one = _gusts(gust, T, seed=11)
    for seed in (12, 13, 11 + 2**32):
        other = _gusts(gust, T, seed=seed)
        assert _uncorrelated(one, other)
        assert _uncorrelated(one[1:].square().repeat(2)[:INTERVALS], other.square())
        assert _uncorrelated(one.roll(1), other)  # not the same record, shifted by one


def test_modulations_of_one_field_draw_from_streams_of_their_own():
    """Two equal gusts add variances; from one stream they would add amplitudes, to twice as much."""
    twice = WindField([0.0, 0.0, 0.0], modulations=[GaussianGust(STD, T), GaussianGust(STD, T)], seed=11)
    values = twice(torch.arange(INTERVALS, dtype=torch.float64) * T)[:, 0]
    assert float(values.square().mean()) == pytest.approx(2 * STD**2, abs=2 * STD**2 * math.sqrt(2) * FOUR)
    first = _gusts("gaussian", T)
    assert _uncorrelated(first, values - first)
