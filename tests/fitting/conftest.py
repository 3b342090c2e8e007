"""A small printed flag in the wind."""

import pytest

from gaussian_swaying.simulation.simulation import Simulation


@pytest.fixture
def simulation(own):
    """The flag."""
    return Simulation.from_yaml(own / "base.yaml", device="cpu")
