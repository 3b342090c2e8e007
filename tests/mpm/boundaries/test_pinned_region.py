"""A pin holds its region and nothing else."""

import pytest

from gaussian_swaying.geometry.regions import Box
from gaussian_swaying.mpm.boundaries.pinned_region import PinnedRegion

FORMULATIONS = ["total", "updated"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_pin_holds_only_its_end(formulation, block, run_for):
    points = block()
    pin = PinnedRegion(Box([None, None, 0.34], [None, None, None]))
    state = run_for(formulation, [pin], points, 0.3)
    held = points.position[:, 2] > 0.34
    moved = (state.position - points.position).norm(dim=-1)
    assert float(moved[held].max()) < 0.01
    # the static sag of a rod this long is 2 to 4 mm; `updated` holds all nodes that the pinned layer touches
    assert float(moved[~held].max()) > 0.001
