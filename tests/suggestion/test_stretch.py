"""A typical stretch of turbulence: its motion is that of a long record, which is that of each oscillator."""

import math

import numpy as np
import pytest
import torch
from shared import double

from gaussian_swaying.suggestion import stretch
from gaussian_swaying.suggestion.stretch import cloth_motion, rate_for, typical_start
from gaussian_swaying.wind.turbulence import look


@pytest.mark.parametrize(("frequency", "ratio"), [(0.8, 0.08), (2.0, 0.1), (5.0, 0.05)])
def test_the_stretch_is_as_the_record(frequency, ratio):
    """In ten seconds after two, without what rang before: the same mean in both halves, and that of the record.

    Means to 0.2, which OFF and its size allow, and to 0.1, and the fluctuation to 0.4. In most stretches the
    halves differ by 0.15 or more.
    """
    wind = look("storm", height=0.5, seed=1)
    moved, ringing = motion = cloth_motion(wind, torch.zeros(1, 3), frequency, ratio)
    start, rate = typical_start(motion, frequency, tonal=False), rate_for(frequency)
    begin, length = round(start * rate), round(max(10.0, 10 / frequency) * rate)
    part = (moved[begin : begin + length] - ringing(np.array([begin]), length)[0])[round(2 * rate) :]
    whole = moved[round(20 * rate) :]
    mean, half = whole.mean(0), len(part) // 2
    assert np.linalg.norm(part.mean(0) - mean) < 0.2 * np.linalg.norm(mean)
    assert np.linalg.norm(part[:half].mean(0) - part[half:].mean(0)) < 0.1 * np.linalg.norm(mean)
    assert np.linalg.norm(part.std(0)) == pytest.approx(np.linalg.norm(whole.std(0)), rel=0.4)


def test_the_own_frequency_leads_where_it_should():
    """At one place in 30 % of turbulence the wind's slow gusts lead in most stretches."""
    motion = cloth_motion(look("breeze", height=0.5, seed=1), torch.zeros(1, 3), 2.0, 0.1)

    def lead(begin):
        part = (motion[0][begin : begin + 200] - motion[1](np.array([begin]), 200)[0])[40:, 0]
        power = abs(np.fft.rfft((part - part.mean()) * np.hanning(160))) ** 2
        f = np.fft.rfftfreq(160, 1 / 20)
        return power[abs(f - 2.0) < 0.44].max() / power[(f > 0.2) & (f < 1.5)].max()

    assert np.quantile([lead(begin) for begin in range(1000, 20_000, 200)], 0.3) < 0.8  # not so in many others
    assert lead(round(typical_start(motion, 2.0) * 20)) > 1.0


@pytest.mark.parametrize(("minor", "any_stretch"), [(0.83, False), (0.6, True)])
def test_both_axes_of_a_round_motion_have_its_frequency(minor, any_stretch):
    time = np.arange(4000) / 10  # its frequency is 1 Hz; whole periods of 4 s have the same mean in both halves
    early = time < 300  # a later stretch has another mean, which is less of a fault
    slow = np.where(early, np.sin(0.5 * np.pi * time), np.cos(2 * np.pi * time))
    along = np.where(early, 1.0, 1.5) + 0.4 * np.sin(2 * np.pi * time)
    moved = np.stack([along, 0.4 * minor * slow, 0 * time], 1)
    start = typical_start((moved, lambda begin, samples: np.zeros((len(begin), samples, 3))), 1.0)
    assert (start < 290) == any_stretch


def test_the_motion_is_that_of_an_oscillator():
    """In a constant load it comes to rest at load / omega², and the load acts in the step after it."""
    square, alpha, tip = np.array([(2 * math.pi) ** 2]), 0.9, np.array([[2.0], [0.0], [0.0]])
    response = stretch._response(square, np.array([[2 * alpha]]), tip, math.inf)
    push = np.ones((400, 1))
    moved, ringing = stretch._motion(push @ response.taken, response, 20.0)
    omega, time = math.sqrt(square[0] - alpha**2), np.arange(400) / 20
    exact = 2 / square * (1 - np.exp(-alpha * time) * (np.cos(omega * time) + alpha / omega * np.sin(omega * time)))
    np.testing.assert_allclose(moved[:, 0], exact, atol=1e-12)
    assert not moved[:, 1:].any()
    push[100:] = 0  # then it rings down, and that is what is left of what was before
    moved, ringing = stretch._motion(push @ response.taken, response, 20.0)
    np.testing.assert_allclose(ringing(np.array([120]), 100)[0], moved[120:220], atol=1e-12)
    at_once = stretch._response(square, np.array([[2 * alpha]]), tip, 1.0)
    np.testing.assert_allclose((push @ at_once.taken)[:, 0], 2 / square[0] * push[:, 0])


def test_modes_that_share_their_damping_are_those_of_the_matrix():
    square, damping = np.array([4.0, 9.0]), np.array([[0.8, 0.5], [0.3, 1.2]])
    response = stretch._response(square, damping, np.eye(3)[:, :2], math.inf)
    moved, _ = stretch._motion(np.tile([1.0, -2.0], (4000, 1)) @ response.taken, response, 20.0)
    np.testing.assert_allclose(moved[-1], [1 / 4, -2 / 9, 0], atol=1e-9)
    # and in a sine of 0.4 Hz that of (omega² - w² + i w damping), to the delay of half a step
    w, time = 0.8 * math.pi, np.arange(4000) / 50
    moved, _ = stretch._motion(np.sin(w * time)[:, None] * [1.0, 0.0] @ response.taken, response, 50.0)
    answer = np.linalg.solve(np.diag(square) - w**2 * np.eye(2) + 1j * w * damping, [1.0, 0.0])
    expected = (answer * np.exp(1j * w * (time[2000:, None] - 0.01))).imag
    np.testing.assert_allclose(moved[2000:, :2], expected, atol=1e-3 * abs(answer).max())


def test_places_on_one_line_meet_the_same_wind_one_after_the_other():
    wind = look("gusts", seed=3)
    places, pull = np.array([[0.0, 0.2, 0.1], [1.6, 0.2, 0.1]]), np.zeros((2, 3, 2))
    pull[0, 0, 0] = pull[1, 0, 1] = 1.0
    push = stretch._push(wind, places, pull, 25.0)
    np.testing.assert_allclose(push[5:, 1], push[:-5, 0], rtol=1e-4)  # 1.6 m in 5 samples at 8 m/s
    air = wind.at(double(4.0), torch.from_numpy(places[:1]).float())[0].double()
    assert push[100, 0] == pytest.approx(float(air.norm() * air[0]), rel=1e-3)


def test_a_thing_that_is_too_stiff_for_the_record_follows_the_wind():
    motion = cloth_motion(look("storm", seed=2), torch.zeros(1, 3), 40.0, 0.05)
    start = typical_start(motion, 40.0)
    moved = motion[0]
    part = moved[round((start + 2) * 25) : round((start + 10) * 25)]
    assert np.linalg.norm(part.mean(0) - moved[50:].mean(0)) < 0.1 * np.linalg.norm(moved[50:].mean(0))


def test_samples_suit_the_frequency():
    assert rate_for(0.1) == 6.0
    assert rate_for(1.0) == 10.0
    assert rate_for(40.0) == 25.0
