import math
import os

import pytest
import torch
from shared import double, near, rand, value_error
from torch.testing import assert_close

from gaussian_swaying.geometry import meshes
from gaussian_swaying.geometry.distance import (
    DistanceGrid,
    ball_distance,
    box_distance,
    capsule_distance,
    distance_at,
)
from gaussian_swaying.geometry.keyed_path import KeyedPath, keys_before, pose
from gaussian_swaying.geometry.meshes import mesh_distance, read_mesh, triangle_distance
from gaussian_swaying.kernels.derive import Memory, on_tensors

HALF = double([0.3, 0.2, 0.5])
EYE = torch.eye(3).double().reshape(-1)


def _asked(function, *numbers):
    given = torch.cat([torch.as_tensor(number, dtype=torch.float64).reshape(-1) for number in numbers])
    return lambda place: distance_at(function, place, given, place.new_zeros(1))


SOLIDS = {
    "ball": _asked(ball_distance, 0.4),
    "capsule": _asked(capsule_distance, 0.1, HALF, 1 / HALF.square().sum()),
    "point capsule": _asked(capsule_distance, 0.1, 0 * HALF, 0.0),
    "box": _asked(box_distance, HALF, EYE),
}


def _places(count=4000):
    return 2 * rand(count, 3) - 1


@pytest.mark.parametrize("solid", SOLIDS)
def test_the_gradient_is_that_of_the_distance(solid):
    place = _places().requires_grad_()
    distance, normal = SOLIDS[solid](place)
    (slope,) = torch.autograd.grad(distance.sum(), place)
    assert_close(normal, slope)
    assert_close(normal.norm(dim=-1), torch.ones(len(place)).double())
    outside = distance > 0
    foot = (place - distance[:, None] * normal)[outside]
    near(SOLIDS[solid](foot)[0], torch.zeros(len(foot)).double(), 1e-12)


def test_the_middle_of_a_solid_has_a_normal():
    for solid in SOLIDS.values():
        distance, normal = solid(torch.zeros(1, 3).double())
        assert distance < 0
        assert abs(float(normal.norm()) - 1) < 1e-12


def test_a_grid_interpolates_and_extends():
    """A linear distance is exact within the grid; outside it grows with the distance from it."""
    axes = [torch.arange(n).double() * 0.25 - 0.5 for n in (5, 6, 7)]
    direction = double([0.48, 0.6, 0.64])
    nodes = torch.cartesian_prod(*axes)
    grid = DistanceGrid((nodes @ direction).reshape(5, 6, 7), torch.full((3,), -0.5, dtype=torch.float64), 0.25)
    place = _places(500) * torch.tensor([0.5, 0.5, 0.5])
    distance, normal = grid.at(place)
    assert_close(distance, place @ direction)
    assert_close(normal, direction.expand_as(normal))
    beyond = double([[3.5, 0.1, 0.1]])
    distance, normal = grid.at(beyond)
    edge = double([0.5, 0.1, 0.1])
    assert_close(distance, (edge @ direction)[None] + 3.0)
    assert_close(normal, double([[1.0, 0, 0]]))


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
        *(grid.origin[k] + grid.spacing * torch.arange(n).double() for k, n in enumerate(grid.values.shape))
    )
    exact = _asked(box_distance, torch.ones(3), EYE)(nodes)[0]
    near(grid.values.reshape(-1), exact, 1e-12)


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
    with value_error("not closed"):
        mesh_distance(*read_mesh(file), cells=16)


def _ply(element, *properties, rows=""):
    lines = ["ply", "format ascii 1.0", element, *(f"property float {name}" for name in properties), "end_header"]
    return "\n".join(lines) + "\n" + rows


CORNER = _ply("element vertex 3", *"xyz").removesuffix("end_header\n")
FACE = "element face 1\nproperty list {}\nend_header\n"
ROWS = "0 0 0\n1 0 0\n0 1 0\n"


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.stl", "", r"\.ply or \.obj"),
        ("a.obj", "v 0 0 0\n", "no faces"),
        ("a.obj", "v 0 0 zero\nf 1 1 1", "cannot be read"),
        ("a.obj", "v 0 0 0\nf 1 2 3", "without vertices"),
        ("a.ply", "splat", r"a.ply is not a \.ply file"),
        ("a.obj", "v 0 0\nv 1 1\nv 0 1\nf 1 2 3", "line 1 has a vertex of fewer"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nf 0 1 2\nv 0 1 0", "line 3 has a face with the vertex 0"),
        ("a.obj", "v 0 0 0\nf 1 1 99999999999999999999", "cannot be read"),
        ("a.obj", "v 0 0 0\nv 1 2 3\nv 0.1 0.2 0.3\nv 9 9 0\nf 1 2 3", "on one line"),  # no face has the fourth
        ("a.obj", "v 5 5 5\nf 1 1 1", "on one line"),
        ("a.obj", "v 0 0 0\nf 1 1 1 \udcff", "cannot be read"),
        ("a.ply", _ply("element vertex 2000000000", *"xyz"), "is truncated: its header announces 2,000,000,000"),
        ("a.ply", _ply("element face 1", "x", rows="0\n"), "it has no element `vertex`"),
        ("a.ply", _ply("element vertex 1", *"xyz", rows="0 0 0\n"), "no faces"),
        ("a.ply", _ply("element vertex 1", "x", rows="0\n"), "cannot be read"),
        ("a.ply", CORNER + FACE.format("uchar int corners") + ROWS + "3 0 1 2\n", "faces have no `vertex_indices`"),
        ("a.ply", CORNER + FACE.format("uchar float vertex_index") + ROWS + "3 0 1 inf\n", "cannot be read"),
        ("a.ply", CORNER + FACE.format("uint int vertex_index") + ROWS + "4000000000 0 1\n", "cannot be read"),
    ],
)
def test_a_bad_mesh_is_refused_by_name(tmp_path, name, text, message):
    (tmp_path / name).write_text(text, errors="surrogateescape")
    with value_error(message) as refused:
        read_mesh(tmp_path / name)
    assert str(tmp_path / name) in str(refused.value)


def test_a_list_that_claims_four_billion_corners(tmp_path):
    head = _ply("element vertex 1", *"xyz").replace("ascii", "binary_little_endian").removesuffix("end_header\n")
    file = tmp_path / "a.ply"
    file.write_bytes((head + FACE.format("uint double vertex_indices")).encode() + bytes(12) + b"\xff" * 4)
    with value_error("cannot be read"):
        read_mesh(file)


@pytest.mark.parametrize("name", ["pipe.ply", "pipe.obj"])
@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes")
def test_a_pipe_is_no_mesh(tmp_path, name):
    os.mkfifo(tmp_path / name)
    with value_error("not a regular file"):
        read_mesh(tmp_path / name)


def test_a_mesh_that_is_far_too_large(tmp_path, monkeypatch):
    file = _cube(tmp_path)
    monkeypatch.setattr(meshes, "LARGEST_MESH", file.stat().st_size)
    vertices, faces = read_mesh(file)
    monkeypatch.setattr(meshes, "LARGEST_MESH", file.stat().st_size - 1)
    with value_error(r"more than the .* that the mesh may have"):
        read_mesh(file)
    sides = 12 * 23**2  # sqrt(2) 16 cells
    monkeypatch.setattr(meshes, "MOST_SQUARES", sides)
    mesh_distance(vertices, faces, cells=16)
    monkeypatch.setattr(meshes, "MOST_SQUARES", sides - 1)
    with value_error("12 triangles, too many"):
        mesh_distance(vertices, faces, cells=16)


def test_a_mesh_without_an_inside_is_refused(tmp_path):
    """Without a node inside, the material would pass through."""
    vertices, faces = read_mesh(_cube(tmp_path))
    thin = double([1.0, 1.0, 1e-3])
    with value_error(r"encloses none of the nodes of its grid, 0\.125 apart"):
        mesh_distance(thin * vertices, faces, cells=16)
    for size, word in ((0.0, "no extent"), (1e308, "infinite")):
        with value_error(word):
            mesh_distance(size * vertices, faces, cells=16)


def test_distances_of_triangles_agree_with_samples():
    corners = rand(50, 3, 3)
    place = _places(50)
    found = triangle_distance(place, corners)
    share = torch.distributions.Dirichlet(torch.ones(3).double()).sample((20000,))
    sampled = (place[:, None] - share @ corners).norm(dim=-1).amin(-1)
    assert (found <= sampled + 1e-12).all()
    near(found, sampled, 0.02)


def test_the_distance_of_a_triangle_without_area_is_that_of_its_longest_side():
    a, c = double([0.0, 0.0, 0.0]), double([2.0, 0.0, 0.0])
    place = double([[-3.0, 4.0, 0.0], [0.5, 0.0, 2.0], [2.0, -3.0, 4.0]])
    between = torch.stack([a, 0.25 * c, c]).expand(3, 3, 3)
    assert_close(triangle_distance(place, between), double([5.0, 2.0, 5.0]))
    at_a_point = torch.zeros(3, 3, 3).double()
    assert_close(triangle_distance(place, at_a_point), place.norm(dim=-1))


def test_a_path_is_straight_between_its_keys():
    path = KeyedPath(
        [0.0, 1.0, 3.0], moves=[[0, 0, 0], [2, 0, 0], [2, 4, 0]], turns=[[0, 0, 0], [0, 0, 90], [0, 0, 90]]
    )
    keys = path.keys()
    for time, move, angle in ((-1, (0, 0, 0), 0), (0.5, (1, 0, 0), 45), (2.0, (2, 2, 0), 90), (9.0, (2, 4, 0), 90)):
        now = double(time)
        x, y, z, *turned = on_tensors(pose)(Memory(keys), keys_before(keys, now), now)
        assert_close(torch.stack([x, y, z]), double(move))
        radians = torch.deg2rad(double(float(angle)))
        assert_close(torch.stack([turned[0], turned[3]]), torch.stack([radians.cos(), radians.sin()]))
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
    with value_error(message):
        KeyedPath(**keys)
