"""A typical stretch of turbulence: its motion is that of a long record, which is that of each oscillator."""

import math

import numpy as np
import pytest
import torch

from gaussian_swaying.aero.looks import look
from gaussian_swaying.preview import stretch
from gaussian_swaying.preview.stretch import cloth_motion, rate_for, typical_start


@pytest.mark.parametrize(("frequency", "ratio"), [(0.8, 0.08), (2.0, 0.1), (5.0, 0.05)])
def test_the_stretch_is_as_the_record(frequency, ratio):
    """In ten seconds after two, without what rang before: the same mean in both halves, and that of the record.

    The sum of all faults is least, so each is small, or little more: means to 0.15 and 0.1, and the fluctuation to 0.4.
    One stretch of ten seconds of a turbulence of 30 % would be off by more (a standard deviation of some 0.15).
    """
    wind = look("breeze", height=0.5, seed=1)
    moved, ringing = motion = cloth_motion(wind, torch.zeros(1, 3), frequency, ratio)
    start, rate = typical_start(motion, frequency), rate_for(frequency)
    begin, length = round(start * rate), round(max(10.0, 10 / frequency) * rate)
    part = (moved[begin : begin + length] - ringing(begin, length))[round(2 * rate) :]
    whole = moved[round(20 * rate) :]
    mean, half = whole.mean(0), len(part) // 2
    assert np.linalg.norm(part.mean(0) - mean) < 0.15 * np.linalg.norm(mean)
    assert np.linalg.norm(part[:half].mean(0) - part[half:].mean(0)) < 0.1 * np.linalg.norm(mean)
    assert np.linalg.norm(part.std(0)) == pytest.approx(np.linalg.norm(whole.std(0)), rel=0.4)


def test_the_motion_is_that_of_an_oscillator():
    """In a constant load it comes to rest at load / omega², and the load acts in the step after it."""
    square, alpha = (2 * math.pi) ** 2, 0.9
    push = np.ones((400, 1))
    moved, ringing = stretch._motion(push, np.array([square]), np.array([alpha]), np.array([[2.0], [0.0], [0.0]]), 20.0)
    omega, time = math.sqrt(square - alpha**2), np.arange(400) / 20
    exact = 2 / square * (1 - np.exp(-alpha * time) * (np.cos(omega * time) + alpha / omega * np.sin(omega * time)))
    np.testing.assert_allclose(moved[:, 0], exact, atol=1e-12)
    assert not moved[:, 1:].any()
    push[100:] = 0  # then it rings down, and that is what is left of what was before
    moved, ringing = stretch._motion(push, np.array([square]), np.array([alpha]), np.array([[2.0], [0.0], [0.0]]), 20.0)
    # the rate at the start is a central difference: an error of (omega dt)² / 6 = 1.6 %
    np.testing.assert_allclose(ringing(120, 100), moved[120:220], atol=0.02 * abs(moved[120:140]).max())


def test_a_thing_that_is_too_stiff_for_the_record_follows_the_wind():
    motion = cloth_motion(look("storm", seed=2), torch.zeros(1, 3), 40.0, 0.05)
    start = typical_start(motion, 40.0)
    moved = motion[0]
    part = moved[round((start + 2) * 25) : round((start + 10) * 25)]
    assert np.linalg.norm(part.mean(0) - moved[50:].mean(0)) < 0.1 * np.linalg.norm(moved[50:].mean(0))


def test_samples_suit_the_frequency():
    assert rate_for(0.1) == 8.0
    assert rate_for(1.0) == 14.0
    assert rate_for(40.0) == 25.0
