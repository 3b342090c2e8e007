"""Velocity boxes, at rest and travelling."""

import pytest
import torch

from gaussian_swaying import Box, MPMSolver, SimFrame
from gaussian_swaying.mpm.boundaries.boundary import Nodes
from gaussian_swaying.mpm.boundaries.velocity_box import VelocityBox

from .bodies import block, lone, march

FORMULATIONS = ["total", "updated"]


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_velocity_box_drives_only_its_side(formulation):
    """Two lone particles on either side of a face: the nodes inside are driven, the others are not."""
    points = lone([[0.0, 0.0, 0.05], [0.0, 0.0, -0.25]])
    drive = VelocityBox(Box([-9, -9, -0.05], [9, 9, 9]), [0.5, 0.0, -0.3], start=0.02, end=0.05)
    ends = march(MPMSolver(dx=0.1, formulation=formulation, gravity=(0, 0, 0), boundaries=[drive]), points, 0.01, 8)
    speed = torch.stack([state.velocity for state in ends])
    assert float(speed[:, 1].abs().max()) == 0.0
    assert float(speed[:3, 0].abs().max()) == 0.0  # states 0 to 2 lie before the window
    torch.testing.assert_close(speed[3, 0], torch.tensor([0.5, 0.0, -0.3], dtype=torch.float64))


def test_a_travelling_box_takes_its_nodes_from_where_it_is():
    """It moves from its start on, in the metres of a frame that scales and rotates; a fixed box does not move."""
    frame = SimFrame.fit(block().position, up=(0.0, 1.0, 0.0), metres_per_unit=0.5)
    box = Box([0.0, 0.0, 0.0], [0.2, 0.4, 0.4])
    drift = frame.direction_to_sim(torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64))
    move = (0.3 * drift).tolist()
    boxes = [VelocityBox(box, move, start=0.1, end=9.0, travels=travels).in_frame(frame) for travels in (True, False)]
    place = torch.rand(500, 3, dtype=torch.float64) * torch.tensor([1.0, 0.6, 0.6])
    for time in (0.1, 0.4):
        nodes = Nodes(torch.tensor(time, dtype=torch.float64), 1e-3, frame.point_to_sim(place))
        driven = [(b(torch.zeros_like(place), nodes) != 0).any(-1) for b in boxes]
        # 0.3 m/s are 0.6 scene units a second
        gone = place - torch.tensor([0.6 * (time - 0.1), 0, 0], dtype=torch.float64)
        assert torch.equal(driven[0], box.contains(gone))
        assert torch.equal(driven[1], box.contains(place))
        assert torch.equal(driven[0], driven[1]) == (time == 0.1)
