import json
import math

import pytest
import torch
from shared import value_error

from gaussian_swaying.captures.capture_camera import CaptureCamera, read_views

# Blender camera at (1, 2, 3) that looks along +x with z up: OpenGL axes right = -y, up = +z, backward = -x.
POSE = [[0.0, 0.0, -1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def _write(tmp_path, **fields):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(fields))
    return path


def test_transforms_blender(tmp_path, project):
    angle = 2 * math.atan(0.5)  # focal length equal to the width
    path = _write(tmp_path, camera_angle_x=angle, frames=[{"transform_matrix": POSE}])
    ((_, camera),) = read_views(path, 80, 60)
    expected = torch.tensor([[0.0, -1, 0, 2], [0, 0, -1, 3], [1, 0, 0, -1], [0, 0, 0, 1]])
    torch.testing.assert_close(camera.world_to_camera, expected)
    torch.testing.assert_close(camera.intrinsics, torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]]))
    assert camera.position.tolist() == pytest.approx([1, 2, 3])
    assert project(camera, (3.0, 2.0, 3.0)) == (pytest.approx([40.0, 30.0]), pytest.approx(2.0))


def test_transforms_instant_ngp_rescales_and_overrides(tmp_path):
    frames = [{"transform_matrix": POSE}, {"transform_matrix": POSE, "fl_x": 300.0, "cx": 90.0}]
    path = _write(tmp_path, fl_x=200.0, fl_y=210.0, cx=99.0, cy=52.0, w=200, h=100, frames=frames)
    first = read_views(path)[0][1]
    assert (first.width, first.height) == (200, 100)
    torch.testing.assert_close(first.intrinsics, torch.tensor([[200.0, 0, 99], [0, 210, 52], [0, 0, 1]]))
    half = read_views(path, width=100)[1][1]
    assert (half.width, half.height) == (100, 50)
    torch.testing.assert_close(half.intrinsics, torch.tensor([[150.0, 0, 45], [0, 105, 26], [0, 0, 1]]))
    tall = read_views(path, 100, 100)[0][1]
    torch.testing.assert_close(tall.intrinsics, torch.tensor([[100.0, 0, 49.5], [0, 210, 52], [0, 0, 1]]))
    moving = CaptureCamera(path, 1, height=50)
    center = torch.zeros(3).double()
    for frame in range(2):
        camera = moving(frame, 0.1 * frame, center, center, 1.0)
        torch.testing.assert_close(camera.intrinsics, half.intrinsics.double())


GOOD = {"camera_angle_x": 0.8, "w": 8, "h": 6, "frames": [{"transform_matrix": POSE}]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": None}, "no list `frames`"),
        ({"frames": []}, "no list `frames`"),
        ({"frames": [{}]}, r"no `frames\[0\].transform_matrix`"),
        ({"frames": [{"transform_matrix": [[1, 2], [3]]}]}, "4 rows of 4"),
        ({"frames": [{"transform_matrix": [[1, 2], [3, 4]]}]}, r"4 rows of 4 finite numbers.*\(2, 2\)"),
        ({"frames": [{"transform_matrix": [[0.0] * 4] * 4}]}, "singular"),
        ({"camera_angle_x": None}, "no focal length.*`fl_x`"),
        ({"camera_angle_x": "wide"}, "`camera_angle_x`.*set it to a number"),
        ({"camera_angle_x": 50.0}, "`camera_angle_x`.*radians"),
        ({"w": None}, "no image size"),
        ({"w": None, "fl_x": 5.0}, "`fl_x` but no `w`"),
        ({"fl_x": -5.0}, "`fl_x`.*positive"),
        ({"h": 0}, "`h`.*from 1 to"),
    ],
)
def test_bad_transforms_are_named(tmp_path, change, message):
    path = _write(tmp_path, **{**GOOD, **change})
    with value_error(message) as info:
        read_views(path)
    assert str(path) in str(info.value)


def test_unreadable_transforms_are_named(tmp_path):
    with value_error(r"missing\.json.*check the path"):
        read_views(tmp_path / "missing.json")
    (tmp_path / "broken.json").write_text("{frames")
    with value_error(r"broken\.json.*not valid JSON"):
        read_views(tmp_path / "broken.json")
    assert read_views(_write(tmp_path, **GOOD))[0][1].width == 8
