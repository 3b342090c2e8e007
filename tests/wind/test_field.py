import math
from copy import deepcopy

import pytest
import torch
from shared import double, near, peak, value_error
from torch.testing import assert_close

from gaussian_swaying import GaussianGust, SineSway, UniformGust, WindField
from gaussian_swaying._fixed import assign, changed
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.wind.effects import Profile
from gaussian_swaying.wind.field import WITHIN, FlowKey, counter_uniform, stream_start


def test_counter_generator_is_pinned():
    """The gusts of a recorded run must not change with a refactoring."""
    numbers = on_tensors(counter_uniform)(stream_start(0, 0), torch.arange(3), 0)
    assert numbers.tolist() == pytest.approx([0.44450017537021086, 0.6106274652827197, 0.6089826835956642], abs=1e-15)


def test_sample_holds_for_its_interval_whatever_the_rounding():
    wind = WindField([1.0, 0, 0], modulations=[GaussianGust(interval=0.04)])
    frames = torch.arange(1, 500, dtype=torch.float64)
    exact = wind(frames * 0.04 + 0.02)
    near(wind(frames * 0.04 + 1e-9), exact, 0)
    near(wind(frames * 0.04 - 1e-9), exact, 0)
    near(wind(frames * 0.04 + 0.0399), exact, 0)


def test_sine_sways_the_largest_component_by_half():
    wind = WindField([-1.0, 0.2, 4.0], modulations=[SineSway(amplitude=0.5, period=2.0)])
    assert_close(wind(0.5), double([-1.0, 0.2, 6.0]))
    assert_close(wind(1.5), double([-1.0, 0.2, 2.0]))
    samples = wind(torch.arange(2000).double() * 1e-3)
    near(samples.mean(0), double([-1.0, 0.2, 4.0]), 1e-9)


def test_modulations_compose_in_order():
    flow = double([2.0, 0.0, 0.0])
    sine, gust = SineSway(period=2.0), UniformGust(0.3)
    both = WindField([2.0, 0, 0], modulations=[sine, gust])(0.5)
    only_gust = WindField([2.0, 0, 0], modulations=[SineSway(amplitude=0.0), gust])(0.5)
    assert_close(both, 1.5 * only_gust)
    assert peak(both - 1.5 * flow) > 1e-3


def _gusty(k):
    modulations = [
        SineSway(0.3 + 0.1 * k, 1.0 + k, 0.2 * k),
        UniformGust(0.1 * k, 0.04 + 0.01 * k),
        GaussianGust(0.3 * k, 0.05),
    ]
    return WindField([3.0 + k, 0.5 * k, 0.0], modulations=modulations, seed=7**k * (-1) ** k)


def _scheduled(k, interpolation):
    keys = [FlowKey(0.5 * j + 0.1 * k, [1.0 * j + k, 2.0, -j], gusts=0.5 * j + k) for j in range(1 + k)]
    return WindField(schedule=keys, interpolation=interpolation, modulations=[GaussianGust()], seed=k)


@pytest.mark.parametrize(
    "winds",
    [
        [_gusty(k) for k in range(4)],
        [_scheduled(k, "step") for k in range(3)],
        [_scheduled(k, "linear") for k in range(3)],
        [WindField([2.0, 0.0, 0.0], seed=2**70)],
    ],
    ids=["gusts", "steps", "lines", "steady"],
)
def test_winds_of_several_scenes_together(winds):
    """As each by itself; a schedule takes the times of all, between which the flow is rounded anew."""
    times = torch.linspace(-0.3, 4.0, 37, dtype=torch.float64)
    both = WindField.together(winds)
    near(both(times), torch.stack([wind(times) for wind in winds], dim=1), 1e-14)
    near(both.carried(times), torch.stack([wind.carried(times) for wind in winds], dim=1), 1e-14)
    assert both.scenes == len(winds)


def test_the_kernel_modulates_as_torch_does(kernel_device):
    times = torch.cat([torch.linspace(-0.2, 3, 90), torch.tensor([0.05, 0.1, 0.5, 1.3, 1e4])]).double()
    for wind in (_gusty(2), WindField.together([_gusty(k) for k in range(1, 4)]), _scheduled(2, "linear")):
        moved, expected = deepcopy(wind).to(kernel_device), wind(times)
        for _ in range(2):
            at = times.to(kernel_device)
            flow, gusts = moved.mean_flow(at), moved.strength(at)
            at = at.reshape(-1, *[1] * (flow.ndim - 2)).expand(flow.shape[:-1])
            assert moved._known_rows(at)
            assert_close(moved.modulated(flow, at, gusts.expand(at.shape)).cpu(), expected, rtol=1e-11, atol=1e-12)
            assert_close(moved(times.to(kernel_device)).cpu(), expected, rtol=1e-11, atol=1e-12)
            if wind.scenes is None:
                assign(moved, seed=5)
                expected = changed(wind, seed=5)(times)


def test_the_kernel_refuses_a_wind_that_it_does_not_know():
    class Own(UniformGust):
        pass

    class Other(WindField):
        pass

    gust = UniformGust()
    for wind in (WindField(modulations=[Own()]), Other(modulations=[gust]), WindField(modulations=[gust]).float()):
        assert not wind._known_rows(torch.zeros(3).double())


def test_winds_of_other_kinds_are_not_joined():
    assert WindField.together([_gusty(1), WindField([1.0, 0.0, 0.0])]) is None
    assert WindField.together([WindField([1.0, 0.0, 0.0], effects=[Profile()])]) is None


def test_seeds_of_several_scenes():
    times = torch.linspace(0.0, 1.0, 9, dtype=torch.float64)
    wind, own = _gusty(2), [_gusty(2).with_seeds([seed]) for seed in (3, 4)]
    found = wind.with_seeds([3, 4])(times[:, None].expand(-1, 2))
    assert torch.equal(found, torch.cat([one(times[:, None]) for one in own], dim=1))
    assert torch.equal(wind.with_seeds([wind.seed])(times[:, None])[:, 0], wind(times))


def test_schedule_steps_and_ramps():
    keys = [FlowKey(0.0, [0, 0, -1.5]), FlowKey(1.0, [0, 0, 1.5])]
    step = WindField(schedule=keys)
    assert step(0.99)[2] == -1.5
    assert step(1.0)[2] == 1.5
    assert step(50.0)[2] == 1.5
    ramp = WindField(schedule=keys, interpolation="linear")
    assert float(ramp(0.5)[2]) == pytest.approx(0.0)
    assert float(ramp(0.75)[2]) == pytest.approx(0.75)
    assert float(ramp(9.0)[2]) == pytest.approx(1.5)
    assert ramp(torch.linspace(0, 1, 7, dtype=torch.float64)).shape == (7, 3)


def test_speed_direction_and_gusts_are_curves_of_their_own():
    """Each goes through the keys that give it; a turn goes the shorter way, and a gust comes when it is asked for."""
    keys = [FlowKey(0.0, gusts=0.0), FlowKey(1.0, speed=2.0), FlowKey(2.0, azimuth=170.0)]
    keys += [FlowKey(3.0, speed=6.0, gusts=2.0), FlowKey(4.0, azimuth=-150.0)]
    gust = SineSway(0.5, 4.0, -math.pi / 2)  # greatest every second second
    wind = WindField([0.0, 1.0, 1.0], keys, interpolation="linear", modulations=[gust])
    times = torch.linspace(-1.0, 5.0, 601, dtype=torch.float64)
    speed, azimuth = 2 + 2 * (times - 1).clamp(0, 2), (170 + 20 * (times - 2).clamp(0, 2)).deg2rad()
    expected = speed[:, None] / math.sqrt(2) * torch.stack([azimuth.cos(), azimuth.sin(), torch.ones(601)], -1)
    near(wind.mean_flow(times), expected, 6 * WITHIN)
    near(wind.mean_flow(double([2.0, 4.0])), expected[[300, 500]], 1e-12)
    near(wind.strength(times), 2 * times.clamp(0, 3) / 3, 1e-12)
    steps = WindField(schedule=[FlowKey(0.0, speed=1.0, azimuth=0.0), FlowKey(1.0, azimuth=90.0, gusts=3.0)])
    near(steps(double([0.9, 1.0])), double([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), 1e-12)
    assert steps.strength(double([0.0, 2.0])).tolist() == [3.0, 3.0]


def test_the_strength_multiplies_what_is_added_to_the_mean():
    times = torch.linspace(0.0, 1.0, 21, dtype=torch.float64)
    plain, keys = _gusty(2), [FlowKey(0.0, gusts=0.0), FlowKey(1.0, gusts=2.0)]
    wind = WindField(plain.flow, keys, interpolation="linear", modulations=plain.modulations, seed=plain.seed)
    near(wind(times) - plain.flow, 2 * times[:, None] * (plain(times) - plain.flow), 1e-13)
    assert torch.equal(WindField(plain.flow, keys[:1], modulations=plain.modulations)(times), plain.flow.expand(21, 3))
    assert torch.equal(wind.with_flow([1.0, 0.0, 0.0]).strength(times), wind.strength(times))
    for given in (plain, wind):
        assert given.flow.tolist() == [5.0, 1.0, 0.0]


def test_bad_settings_are_refused():
    for kind, given, field in (
        (WindField, {"flow": [1.0, 2.0]}, "flow"),
        (WindField, {"flow": [1.0, math.nan, 0.0]}, "flow"),
        (WindField, {"schedule": [FlowKey(0, [1, 2])]}, "schedule.flow"),
        (WindField, {"schedule": [FlowKey(1, [0] * 3), FlowKey(1, [0] * 3)]}, "schedule"),
        (WindField, {"interpolation": "cubic"}, "interpolation"),
        (WindField, {"schedule": [FlowKey(0, speed=-1.0)]}, "schedule.speed"),
        (WindField, {"schedule": [FlowKey(0, gusts=-1.0)]}, "schedule.gusts"),
        (GaussianGust, {"std": -1}, "std"),
        (GaussianGust, {"interval": 0}, "interval"),
        (UniformGust, {"delta": -0.1}, "delta"),
        (SineSway, {"period": 0}, "period"),
    ):
        with value_error(f"{field}`"):
            kind(**given)


@pytest.mark.parametrize(
    ("words", "keys"),
    [
        ("either `flow`, or `speed` and `azimuth`, not both", [FlowKey(0.0, [1.0, 0.0, 0.0]), FlowKey(1.0, speed=2.0)]),
        ("either `flow`, or `speed` and `azimuth`, not both", [FlowKey(0.0, [1.0, 0.0, 0.0], azimuth=2.0)]),
        ("No key of `schedule` gives `speed`, and `flow` is zero", [FlowKey(0.0, azimuth=2.0)]),
        ("No key of `schedule` gives `azimuth`, and `flow` is zero", [FlowKey(0.0, speed=2.0)]),
        ("only a time at 1 s: add one of flow, speed, azimuth, gusts", [FlowKey(0.0, gusts=1.0), FlowKey(1.0)]),
    ],
)
def test_keys_that_do_not_fit_are_refused(words, keys):
    with value_error(words):
        WindField(schedule=keys)


# ---- statistics of what is drawn, not of the substep at which it is read

T, STD, DELTA = 0.04, 0.3, 0.3  # s, m/s, share
COARSE, FINE = 1e-2, 1e-3  # two substeps [s]
INTERVALS = 6000  # samples drawn in a record of 240 s
FOUR = 4 / math.sqrt(INTERVALS)  # standard errors that an estimate may be off

# name, modulation, mean flow, standard deviation of a component that has a mean
GUSTS = {
    "gaussian": (GaussianGust(STD, T), [2.0, -1.0, 0.5], STD),
    "uniform": (UniformGust(DELTA, T), [2.0, 0.0, 0.0], 2.0 * DELTA / math.sqrt(3)),
}


def _read(gust, dt, seconds=INTERVALS * T, seed=11, flow=None):
    """The wind at every substep: shape (steps, 3)."""
    modulation, mean, _ = GUSTS[gust]
    wind = WindField(mean if flow is None else flow, modulations=[modulation], seed=seed)
    return wind(torch.arange(round(seconds / dt)).double() * dt)


def _gusts(gust, dt, **more):
    return (_read(gust, dt, **more) - double(GUSTS[gust][1]))[:, 0]


@pytest.mark.parametrize("dt", [COARSE, FINE])
@pytest.mark.parametrize("gust", GUSTS)
def test_autocovariance_is_a_triangle_as_wide_as_the_interval(gust, dt):
    """s^2 (1 - |lag| / T), averaged over the phase: so the spectrum is 2 s^2 T sinc^2(f T), whatever the substep."""
    _, mean, std = GUSTS[gust]
    record = _read(gust, dt) - double(mean)
    assert peak(record.mean(0)) < FOUR * std
    per_interval = round(T / dt)
    whole = len(record) - 4 * per_interval  # a whole number of intervals, the same for every lag
    for lag in sorted({0, *(round(share * per_interval) for share in (0.25, 0.5, 0.75, 1.0, 1.5, 3.0))}):
        found = (record[:whole] * record[lag : lag + whole]).mean(0)
        expected = std**2 * max(0.0, 1 - lag / per_interval) * (double(mean) != 0).double()
        near(found, expected, FOUR * std**2 * math.sqrt(2))


def _uncorrelated(a, b):
    assert len(a) == INTERVALS
    product = (a - a.mean()) * (b - b.mean()) / (a.std() * b.std())
    return abs(float(product.mean())) < FOUR


def test_components_are_independent():
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
    values = twice(torch.arange(INTERVALS).double() * T)[:, 0]
    assert float(values.square().mean()) == pytest.approx(2 * STD**2, abs=2 * STD**2 * math.sqrt(2) * FOUR)
    first = _gusts("gaussian", T)
    assert _uncorrelated(first, values - first)
