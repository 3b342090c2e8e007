"""A box that keeps everything in."""

import pytest
import torch

from gaussian_swaying.mpm.boundaries.enclosing_box import EnclosingBox

FORMULATIONS = ["total", "updated"]


@pytest.mark.slow(gate=["total"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_enclosing_box_keeps_everything_in(formulation, block, run_for):
    points = block(low=(0.3, 0.3, 0.3))
    velocity = torch.tensor([4.0, -3.0, 2.0], dtype=torch.float64).expand_as(points.position)
    box = EnclosingBox([0, 0, 0], [1, 1, 1])
    state = run_for(formulation, [box], points, 1.0, velocity)
    # contact is resolved to one cell
    assert float(state.position.min()) > -0.1
    assert float(state.position.max()) < 1.1
