"""Obstacles by themselves: which nodes they stop and when, and meshes in a frame."""

from pathlib import Path

import pytest
import torch

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.keyed_path import KeyedPath
from gaussian_swaying.mpm.boundaries.ball import BallObstacle
from gaussian_swaying.mpm.boundaries.boundary import Nodes
from gaussian_swaying.mpm.boundaries.mesh import MeshObstacle

MESH = str(Path(__file__).parent / "octahedron.obj")


@pytest.mark.parametrize(("time", "acts"), [(0.4, False), (0.5, True), (0.9, True), (1.0, False)])
def test_an_obstacle_stops_the_nodes_on_and_in_it_in_its_time(time, acts):
    """A ball of radius 2 without friction: what moves into it slides, from its surface inwards."""
    ball = BallObstacle([1.0, 0.0, 0.0], 2.0, friction=0.0, start=0.5, end=1.0)
    place = torch.tensor([[3.0, 0, 0], [2.0, 0, 0], [3.001, 0, 0], [-4.0, 0, 0]], dtype=torch.float64)
    velocity = torch.tensor([[-1.0, 0.5, 0.0]], dtype=torch.float64).expand(4, 3)
    found = ball(velocity, Nodes(torch.tensor(time, dtype=torch.float64), 1e-3, place))
    stopped = torch.tensor([0.0, 0.5, 0.0], dtype=torch.float64)
    expected = torch.where(torch.tensor([[True], [True], [False], [False]]) & acts, stopped, velocity)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("path", [None, KeyedPath([0.0, 1.0], moves=[[0, 0, 0], [1, 2, 3]])])
def test_a_mesh_in_a_frame_is_as_far_as_in_the_scene(path):
    """Turned, moved, and three metres per unit."""
    turn = torch.tensor([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    frame = SimFrame(torch.tensor([0.3, -0.1, 0.2], dtype=torch.float64), turn, 3.0)
    mesh = MeshObstacle(MESH, 12, [0.1, 0.2, 0.3], path=path)
    low, high = mesh.corner, mesh.corner + mesh.spacing * (torch.tensor(mesh.values.shape) - 1)
    draw = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    place = low + draw * (high - low) + torch.tensor([0.1, 0.2, 0.3])
    now = torch.tensor(0.0, dtype=torch.float64)
    distance, normal, speed = mesh.touch(place, now, 0.1)
    found = mesh.in_frame(frame).touch(frame.point_to_sim(place), now, 0.1)
    assert float(distance.amin()) < -2 * mesh.spacing
    assert float(distance.amax()) > 2 * mesh.spacing
    torch.testing.assert_close(found[0], 3 * distance)
    torch.testing.assert_close(found[1], normal @ turn.T)
    torch.testing.assert_close(found[2], 3 * speed @ turn.T)
