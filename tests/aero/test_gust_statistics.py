"""Statistics of the gusts: of what is drawn, not of the substep at which it is read."""

import math

import pytest
import torch

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
    return (_read(gust, dt, **more) - torch.tensor(GUSTS[gust][1], dtype=torch.float64))[:, 0]


@pytest.mark.parametrize("gust", GUSTS)
def test_two_substeps_read_the_same_samples(gust):
    ratio = round(COARSE / FINE)
    assert torch.equal(_read(gust, FINE)[::ratio], _read(gust, COARSE))


@pytest.mark.parametrize("dt", [COARSE, FINE])
@pytest.mark.parametrize("gust", GUSTS)
def test_mean_and_variance(gust, dt):
    """Standard errors: s / sqrt(M) of the mean, s^2 sqrt((kurtosis - 1) / M) of the variance about a known mean."""
    _, mean, std, kurtosis = GUSTS[gust]
    values = (_read(gust, dt) - torch.tensor(mean, dtype=torch.float64)).T
    for one in values if gust == "gaussian" else values[:1]:
        assert abs(float(one.mean())) < FOUR * std
        assert float(one.square().mean()) == pytest.approx(std**2, abs=FOUR * std**2 * math.sqrt(kurtosis - 1))


@pytest.mark.parametrize("dt", [COARSE, FINE])
@pytest.mark.parametrize("gust", GUSTS)
def test_autocovariance_is_a_triangle_as_wide_as_the_interval(gust, dt):
    """s^2 (1 - |lag| / T), averaged over the phase: the correlation time, its integral, is T / 2 on each side."""
    _, _, std, _ = GUSTS[gust]
    values = _gusts(gust, dt)
    per_interval = round(T / dt)
    lags = sorted({0, *(round(share * per_interval) for share in (0.25, 0.5, 0.75, 1.0, 1.5, 3.0))})
    for lag in lags:
        whole = len(values) - 4 * per_interval  # a whole number of intervals, the same for every lag
        found = float((values[:whole] * values[lag : lag + whole]).mean())
        expected = std**2 * max(0.0, 1 - lag / per_interval)
        assert found == pytest.approx(expected, abs=FOUR * std**2 * math.sqrt(2)), f"lag {lag * dt} s"
    covariance = [float((values[:whole] * values[lag : lag + whole]).mean()) for lag in range(per_interval)]
    # the sum by the trapezium rule; its error adds up over at most an interval
    time = dt * (sum(covariance) - 0.5 * covariance[0]) / std**2
    assert time == pytest.approx(0.5 * T, abs=FOUR * T * math.sqrt(2))


@pytest.mark.parametrize("dt", [COARSE, FINE])
@pytest.mark.parametrize("gust", GUSTS)
def test_spectrum_of_held_samples(gust, dt):
    """One-sided density 2 s^2 T sinc^2(f T), from periodograms of blocks of 30 intervals.

    Read every dt, the squared sine over its argument becomes (sin(pi f T) / sin(pi f dt))^2 (dt / T)^2: the alias.
    """
    _, _, std, _ = GUSTS[gust]
    per_block = 30 * round(T / dt)
    blocks = _gusts(gust, dt).unflatten(0, (-1, per_block))
    density = 2 * torch.fft.rfft(blocks, dim=-1).abs().square().mean(0) * dt / per_block
    frequency = torch.fft.rfftfreq(per_block, dt, dtype=torch.float64)
    band = (frequency > 0) & (frequency < min(2.5 / T, 0.45 / dt))
    sinc = torch.sinc(frequency * T).square()
    alias = (torch.pi * frequency * dt / torch.sin(torch.pi * frequency * dt)).square()
    expected = (2 * std**2 * T * sinc * alias)[band]
    # a periodogram is off by its own size, the mean over the blocks by that over the root of their number;
    # 1.5 times four standard errors, for the tail of the exponential and the number of frequencies
    assert len(blocks) == INTERVALS / 30
    error = (density[band] - expected).abs()
    assert bool((error <= 1.5 * 4 / math.sqrt(len(blocks)) * expected + 1e-12).all())
    # and their level, over the first lobe, within four standard errors
    lobe = frequency[band] < 0.9 / T
    share = (density[band] / expected)[lobe]
    assert float(share.mean()) == pytest.approx(1.0, abs=4 / math.sqrt(len(blocks) * int(lobe.sum())) * math.sqrt(2))
    if dt == FINE:
        assert float(density[band].min()) < 1e-3 * float(density[band].max())  # the zeros at multiples of 1 / T


@pytest.mark.parametrize("gust", GUSTS)
def test_impulse_of_a_second_is_the_same_for_both_substeps(gust):
    """Variance s^2 T x 1 s whatever the substep; white noise drawn per substep would have s^2 dt x 1 s."""
    _, _, std, _ = GUSTS[gust]
    impulses = {dt: _gusts(gust, dt).unflatten(0, (-1, round(1 / dt))).sum(-1) * dt for dt in (COARSE, FINE)}
    torch.testing.assert_close(impulses[COARSE], impulses[FINE], rtol=0, atol=1e-10)
    seconds = len(impulses[FINE])
    for impulse in impulses.values():
        found = float(impulse.square().mean())
        assert found == pytest.approx(std**2 * T, rel=4 * math.sqrt(2 / seconds))
    white = std * torch.randn(seconds, 1000, dtype=torch.float64).sum(-1) * FINE
    assert float(white.square().mean()) < 0.05 * std**2 * T


def _uncorrelated(a, b):
    """Both standardised, one value for each interval."""
    assert len(a) == INTERVALS
    product = (a - a.mean()) * (b - b.mean()) / (a.std() * b.std())
    return abs(float(product.mean())) < FOUR


def test_components_are_independent():
    """Not only uncorrelated: neither are their squares."""
    values = _read("gaussian", T) - torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64)
    for i, j in ((0, 1), (0, 2), (1, 2)):
        assert _uncorrelated(values[:, i], values[:, j])
        assert _uncorrelated(values[:, i].square(), values[:, j].square())


def test_one_uniform_factor_scales_all_components():
    values = _read("uniform", T, flow=[2.0, -1.0, 0.5])
    torch.testing.assert_close(values, values[:, :1] * torch.tensor([1.0, -0.5, 0.25], dtype=torch.float64))
    factor = values[:, 0] / 2
    assert 1 - DELTA <= float(factor.min()) < 1 - 0.998 * DELTA
    assert 1 + 0.998 * DELTA < float(factor.max()) <= 1 + DELTA


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
