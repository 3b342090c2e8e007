"""Onset of flutter of a flag: the linear theory, and how growth is measured."""

import numpy as np
import pytest
from bench.problems.flutter import MODES, mode, neutral, onset, pressure, rate
from scipy.special import hankel2


@pytest.mark.parametrize("kappa", [0.2, 1.0, 4.0])
def test_a_heaving_plate_has_the_lift_of_theodorsen(kappa):
    """Theodorsen (1935, NACA report 496), with the semi-chord 1/2; panels err by some 1/N of the lift."""
    panels = 400
    lift = pressure(np.full((panels, 1), 1j * kappa), kappa).sum() / panels
    first, zeroth = hankel2(1, kappa / 2), hankel2(0, kappa / 2)
    expected = 0.25 * np.pi * kappa**2 - np.pi * first / (first + 1j * zeroth) * 1j * kappa
    assert abs(lift - expected) < 0.02 * abs(expected)


def test_vibrations_of_a_beam_are_orthonormal():
    x = (np.arange(4000) + 0.5) / 4000
    shapes = np.stack([mode(x, n)[0] for n in range(MODES)])
    np.testing.assert_allclose(shapes @ shapes.T / 4000, np.eye(MODES), atol=1e-3)
    for number in (0, 3, MODES - 1):
        shape, slope = mode(x, number)
        np.testing.assert_allclose(np.gradient(shape, x)[1:-1], slope[1:-1], atol=1e-3 * np.abs(slope).max())


def test_a_heavier_flag_needs_more_stiffness():
    """Between mass ratios of 0.7 and 0.8 it jumps from one branch to another (Alben 2008, Phys. Fluids 20)."""
    found = [onset(ratio, count=120)[0] for ratio in (0.2, 0.7, 0.8, 2.0)]
    assert found == sorted(found)
    assert found[2] > 2 * found[1]
    assert found[0] == pytest.approx(0.002, rel=0.02)


def test_growth_is_measured_and_its_zero_found():
    time = np.arange(0, 30, 0.01)
    assert rate(np.exp(0.1 * time) * np.sin(8 * np.pi * time), 0.01) == pytest.approx(0.1, rel=1e-2)
    for start in (0.5, 2.0, 9.0):
        found, tried = neutral(lambda stiffness: 1.5 - np.log(stiffness), start)
        assert found == pytest.approx(np.exp(1.5))
        assert min(tried.values()) < 0 < max(tried.values())
    with pytest.raises(RuntimeError, match="another sign"):
        neutral(lambda stiffness: 1.0, 1.0)
