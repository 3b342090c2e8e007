"""Columns of sand at rest and let go."""

import pytest
from bench.problems.granular.columns import column_at_rest, column_collapse
from bench.problems.settings import Settings


def test_column_between_walls_stays_at_rest():
    found = column_at_rest()
    assert found["error"] < 1e-3
    assert found["error"] < 0.3 * found["settlement"]
    assert found["kinetic"] < 1e-4


def test_taller_and_weaker_columns_spread_further():
    """A coarse grid, and not yet at rest."""
    column = {"cells": 3, "duration": 2.0}
    tall, low, weak = (column_collapse(a, friction_angle=f, **column) for a, f in ((1, 30), (2 / 3, 30), (1, 20)))
    assert tall["lost"] == 0
    assert tall["volume_ratio"] == pytest.approx(1.0, abs=0.03)
    assert low["runout"] < 0.5 * tall["runout"] < 0.5 * tall["lube"]
    assert weak["runout"] > 1.2 * tall["runout"]


@pytest.mark.slow(twin="test_taller_and_weaker_columns_spread_further")
def test_column_collapses_and_comes_to_rest():
    tall = column_collapse(1.0, cells=6, duration=4.0)
    assert tall["lost"] == 0
    assert tall["kinetic"] < 1e-2
    assert tall["volume_ratio"] == pytest.approx(1.0, abs=0.03)
    assert 0.5 * tall["lube"] < tall["runout"] < tall["lube"]  # stronger than sand, and stopped early by the grid
    assert tall["height"] == pytest.approx(0.95, abs=0.05)
    assert tall["slope_deg"] < 43.9
    low = column_collapse(0.5, cells=6, duration=4.0)
    weak = column_collapse(1.0, cells=6, friction_angle=20.0, duration=4.0)
    assert low["runout"] < 0.5 * tall["runout"]
    assert weak["runout"] > 1.2 * tall["runout"]


@pytest.mark.slow(twin="test_taller_and_weaker_columns_spread_further")
def test_round_column_spreads():
    found = column_collapse(1.0, Settings(mls=True), cells=3, planar=False, duration=3.0)
    assert found["lost"] == 0
    assert 0.2 < found["runout"] < found["lajeunesse"]


def test_height_is_a_whole_number_of_cells():
    with pytest.raises(ValueError, match="whole number"):
        column_collapse(0.3, cells=4)
