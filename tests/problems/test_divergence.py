"""An inverted flag, and the wind at which it no longer stays straight."""

import math

import pytest
from bench.problems.divergence import critical, divergence


def test_the_least_pressure_at_which_a_straight_plate_diverges():
    """The series of the slope from the free end, the sum of (-k)^n / (3n)!, vanishes at the held end."""
    k = critical()
    assert k == pytest.approx(6.330, abs=5e-4)
    assert sum((-k) ** n / math.factorial(3 * n) for n in range(12)) == pytest.approx(0.0, abs=1e-12)


def test_a_plate_comes_back_below_and_goes_away_above():
    found = divergence(cells=8, slenderness=30.0)
    assert found["below"] < 0 < found["above"]
    assert abs(found["error"]) < 0.08
