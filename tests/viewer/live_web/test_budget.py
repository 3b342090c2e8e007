"""The grid that fits a kind of machine."""

import pytest
from shared import value_error

from gaussian_swaying.viewer.live_web.budget import finest_within


def sheet(dx):
    return 1e5 * dx**-3


@pytest.mark.parametrize("budget", [1e7, 1e8, 3e8])
def test_the_finest_grid_within_the_budget(budget):
    tried = []

    def load(dx):
        tried.append(dx)
        return sheet(dx)

    dx, found = finest_within(load, 0.05, budget)
    assert found == sheet(dx) <= budget
    assert dx <= 1.1 * max(0.05, (1e5 / budget) ** (1 / 3))
    assert len(tried) <= 6


def test_of_two_grids_within_the_budget_it_is_the_finer():
    """A load that falls faster than foreseen: the first guess is too coarse, and a finer one is tried."""
    tried = {}

    def load(dx):
        tried[dx] = 100 * (0.05 / dx) ** 5
        return tried[dx]

    dx, found = finest_within(load, 0.05, 1.0)
    within = [one for one in tried if tried[one] <= 1.0]
    assert len(within) > 1
    assert (dx, found) == (min(within), tried[min(within)])


def test_the_configured_grid_is_kept_if_it_fits():
    assert finest_within(sheet, 0.2, 1e9) == (0.2, sheet(0.2))


def test_too_coarse_a_grid_is_passed_over():
    """A pin that holds nothing on a coarse grid; the errors of the configured grid are raised."""

    def load(dx):
        if dx > 0.15:
            raise ValueError("the pin holds nothing")
        return sheet(dx)

    dx, found = finest_within(load, 0.05, 1e6)
    assert 0.05 < dx <= 0.15
    assert found > 1e6
    with value_error("the pin holds nothing"):
        finest_within(load, 0.2, 1e6)
