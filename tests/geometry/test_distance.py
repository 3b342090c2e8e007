"""Signed distances of solids, against brute force and exact values."""

import math

import pytest
import torch

from gaussian_swaying.geometry.distance import (
    DistanceGrid,
    ball_distance,
    box_distance,
    capsule_distance,
    grid_distance,
)
from gaussian_swaying.geometry.keyed_path import KeyedPath, between, rotation_of
from gaussian_swaying.geometry.meshes import mesh_distance, read_mesh, triangle_distance

HALF = torch.tensor([0.3, 0.2, 0.5], dtype=torch.float64)
SOLIDS = {
    "ball": lambda x: ball_distance(x, 0.4),
    "capsule": lambda x: capsule_distance(x, HALF, 0.1),
    "point capsule": lambda x: capsule_distance(x, 0 * HALF, 0.1),
    "box": lambda x: box_distance(x, HALF),
}


def _places(count=4000):
    return 2 * torch.rand(count, 3, dtype=torch.float64) - 1


@pytest.mark.parametrize("solid", SOLIDS)
def test_the_gradient_is_that_of_the_distance(solid):
    """Its norm is one, and the surface lies a distance back along it."""
    place = _places().requires_grad_()
    distance, normal = SOLIDS[solid](place)
    (slope,) = torch.autograd.grad(distance.sum(), place)
    torch.testing.assert_close(normal, slope)
    torch.testing.assert_close(normal.norm(dim=-1), torch.ones(len(place), dtype=torch.float64))
    outside = distance > 0
    foot = (place - distance[:, None] * normal)[outside]
    torch.testing.assert_close(SOLIDS[solid](foot)[0], torch.zeros(len(foot), dtype=torch.float64), atol=1e-12, rtol=0)


def test_the_middle_of_a_solid_has_a_normal():
    for solid in SOLIDS.values():
        distance, normal = solid(torch.zeros(1, 3, dtype=torch.float64))
        assert float(distance) < 0
        assert abs(float(normal.norm()) - 1) < 1e-12


def test_a_grid_interpolates_and_extends():
    """A linear distance is exact within the grid; outside it grows with the distance from it."""
    axes = [torch.arange(n, dtype=torch.float64) * 0.25 - 0.5 for n in (5, 6, 7)]
    direction = torch.tensor([0.48, 0.6, 0.64], dtype=torch.float64)
    nodes = torch.cartesian_prod(*axes)
    grid = DistanceGrid((nodes @ direction).reshape(5, 6, 7), torch.full((3,), -0.5, dtype=torch.float64), 0.25)
    place = _places(500) * torch.tensor([0.5, 0.5, 0.5])
    distance, normal = grid.at(place)
    torch.testing.assert_close(distance, place @ direction)
    torch.testing.assert_close(normal, direction.expand_as(normal))
    beyond = torch.tensor([[3.5, 0.1, 0.1]], dtype=torch.float64)
    distance, normal = grid_distance(beyond, grid.values, grid.origin, 0.25)
    edge = torch.tensor([0.5, 0.1, 0.1], dtype=torch.float64)
    torch.testing.assert_close(distance, (edge @ direction)[None] + 3.0)
    torch.testing.assert_close(normal, torch.tensor([[1.0, 0, 0]], dtype=torch.float64))


def test_a_grid_needs_two_nodes_on_each_axis():
    with pytest.raises(ValueError, match="at least 2 nodes"):
        DistanceGrid(torch.zeros(1, 3, 3), torch.zeros(3), 0.1)


CUBE_OBJ = """
v -1 -1 -1
v 1 -1 -1
v 1 1 -1
v -1 1 -1
v -1 -1 1
v 1 -1 1
v 1 1 1
v -1 1 1
f 1 4 3 2
f 5/1 6/2 7/3 8/4
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f -8 -4 -1 -5
"""


def _cube(tmp_path):
    file = tmp_path / "cube.obj"
    file.write_text(CUBE_OBJ)
    return file


def test_a_mesh_has_the_distance_of_the_box_that_it_is(tmp_path):
    vertices, faces = read_mesh(_cube(tmp_path))
    assert faces.shape == (12, 3)
    grid = mesh_distance(vertices, faces, cells=16)
    nodes = torch.cartesian_prod(
        *(grid.origin[k] + grid.spacing * torch.arange(n, dtype=torch.float64) for k, n in enumerate(grid.values.shape))
    )
    exact = box_distance(nodes, torch.ones(3, dtype=torch.float64))[0]
    torch.testing.assert_close(grid.values.reshape(-1), exact, atol=1e-12, rtol=0)


def test_a_ply_is_read_as_the_obj(tmp_path):
    from plyfile import PlyData, PlyElement

    vertices, faces = read_mesh(_cube(tmp_path))
    import numpy as np

    vertex = np.array([tuple(v) for v in vertices.tolist()], dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    face = np.empty(len(faces), dtype=[("vertex_indices", "i4", (3,))])
    face["vertex_indices"] = faces.numpy()
    file = tmp_path / "cube.ply"
    PlyData([PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]).write(str(file))
    again = read_mesh(file)
    assert torch.equal(again[0], vertices)
    assert torch.equal(again[1], faces)


def test_an_open_mesh_is_refused(tmp_path):
    file = tmp_path / "open.obj"
    file.write_text("\n".join(CUBE_OBJ.strip().splitlines()[:-1]))
    with pytest.raises(ValueError, match="not closed"):
        mesh_distance(*read_mesh(file), cells=16)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.stl", "", r"\.ply or \.obj"),
        ("a.obj", "v 0 0 0\n", "no faces"),
        ("a.obj", "v 0 0 zero\nf 1 1 1", "cannot be read"),
        ("a.obj", "v 0 0 0\nf 1 2 3", "without vertices"),
        ("a.ply", "splat", "cannot be read"),
    ],
)
def test_a_bad_mesh_is_refused_by_name(tmp_path, name, text, message):
    (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_mesh(tmp_path / name)


def test_distances_of_triangles_agree_with_samples():
    corners = torch.rand(50, 3, 3, dtype=torch.float64)
    place = _places(50)
    found = triangle_distance(place, corners)
    share = torch.distributions.Dirichlet(torch.ones(3, dtype=torch.float64)).sample((20000,))
    sampled = (place[:, None] - share @ corners).norm(dim=-1).amin(-1)
    assert bool((found <= sampled + 1e-12).all())
    torch.testing.assert_close(found, sampled, atol=0.02, rtol=0)


def test_a_path_is_straight_between_its_keys():
    path = KeyedPath(
        [0.0, 1.0, 3.0], moves=[[0, 0, 0], [2, 0, 0], [2, 4, 0]], turns=[[0, 0, 0], [0, 0, 90], [0, 0, 90]]
    )
    times, moves, turns = path.keys()
    for time, move, angle in ((-1, (0, 0, 0), 0), (0.5, (1, 0, 0), 45), (2.0, (2, 2, 0), 90), (9.0, (2, 4, 0), 90)):
        now = torch.tensor(time, dtype=torch.float64)
        torch.testing.assert_close(between(times, moves, now), torch.tensor(move, dtype=torch.float64))
        x = rotation_of(between(times, turns, now)) @ torch.tensor([1.0, 0, 0], dtype=torch.float64)
        radians = torch.deg2rad(torch.tensor(float(angle), dtype=torch.float64))
        torch.testing.assert_close(x[:2], torch.stack([radians.cos(), radians.sin()]))
    assert path.speed == 2.0


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"times": [1.0, 1.0]}, "`times` of the path to rise"),
        ({"times": []}, "at least one"),
        ({"times": [math.nan]}, "`times` to be finite"),
        ({"times": [0.0, math.nan, 1.0]}, "`times` to be finite"),
        ({"times": [0.0, math.inf]}, "`times` to be finite"),
        ({"times": [0.0, 1.0], "moves": [[0, 0, 0]]}, "`moves` of the path to have one entry"),
    ],
)
def test_a_bad_path_is_refused(keys, message):
    with pytest.raises(ValueError, match=message):
        KeyedPath(**keys)
