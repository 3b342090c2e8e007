"""A plate that falls in air at rest."""

import math

import numpy as np
import pytest
from bench.problems.falling import GRAVITY, fall, sliding, terminal


def test_a_level_plate_falls_as_a_hyperbolic_tangent():
    times = np.linspace(0, 0.5, 6)
    for law in ("projected", "cross_flow"):
        exact = terminal() * np.tanh(GRAVITY * times / terminal())
        assert sliding(0.0, law, times)[:, 0] == pytest.approx(exact, rel=1e-6)


@pytest.mark.parametrize(("law", "tilt"), [("projected", 0.0), ("projected", 40.0), ("cross_flow", 40.0)])
def test_a_plate_falls_and_keeps_its_angle(law, tilt):
    found = fall(tilt, law, cells=4, settle=1.5)
    assert found["error"] < 2e-3
    assert abs(found["turned"]) < 1e-6
    assert found["along"] == pytest.approx(GRAVITY * math.sin(math.radians(tilt)) * found["simulated_s"], abs=1e-6)


def test_the_air_stops_its_turning():
    """On a coarse grid, whose spread of the mass makes it turn longer."""
    found = fall(spin=0.2, cells=8, settle=1.5)
    assert -0.09 < found["error"] < 0
