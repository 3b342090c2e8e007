"""A rigid plate that falls in computed air."""

import numpy as np
import pytest
from bench.problems.tumbling import falling


def test_a_heavy_plate_begins_to_fall_freely():
    """Before the air resists: m g = 1/2 moves the plate, of mass 100, and the air that it pushes, pi / 4."""
    found = falling(10.0, cells=10, until=0.5, side=6, tilt=0.0)
    assert found["speed"] == pytest.approx(0.375 * 0.5 / (100 + np.pi / 4), rel=0.02)
    assert found["swing"] == pytest.approx(0.0, abs=1e-4)


def test_a_light_plate_swings_from_side_to_side():
    """Froude number 0.3; the same on both sides, as nothing but the tilt tells left from right."""
    found, other = (falling(0.3, cells=10, until=7.0, side=6, tilt=tilt) for tilt in (0.3, -0.3))
    assert found["turns"] < 0.3
    assert np.diff(np.sign(found["angles"])).any()
    assert found["swing"] > 0.4
    assert 0.3 < found["speed"] < 1.0
    np.testing.assert_allclose(found["angles"][:1000], -other["angles"][:1000], atol=0.02)
