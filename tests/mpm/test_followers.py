"""Where Gaussians read the motion of the nodes."""

import torch
from shared import solid

from gaussian_swaying.mpm.followers import on_material


def test_places_without_all_their_nodes_are_read_at_a_material_point():
    """Cells end at halves: (1.6, 2.4) shares a cell with the point at (2, 2), (2.6, 2) reads nodes beyond it."""
    points = solid(torch.tensor([[2.0, 2.0, 2.0], [9.25, 2.0, 2.0]]), 1.0, 1.0, 1.0)
    place = torch.tensor(
        [
            [1.6, 2.4, 2.1],  # its nodes are those of the first point
            [8.9, 1.7, 2.2],  # and here of the second
            [2.6, 2.0, 2.0],  # some of its nodes have no mass
            [5.5, 2.0, 2.0],  # none of its nodes has mass
            [2.0, 0.2, 2.0],  # some of its nodes are not in the grid
            [2.0, 90.0, 2.0],  # none of its nodes is
        ],
        dtype=torch.float64,
    )
    nearest = torch.tensor([1, 0, 0, 1, 0, 1])
    expected = torch.cat([place[:2], points.position.double()[nearest[2:]]])
    read, nodes = on_material(place, nearest, points, 1.0)
    assert nodes is None
    assert torch.equal(read, expected)
