import json
import math

import pytest
import torch
from shared import EYE, double, near, value_error
from small_captures import write_colmap, write_transforms
from torch.testing import assert_close

from gaussian_swaying.captures.capture_camera import CaptureCamera, read_views
from gaussian_swaying.rendering.cameras.camera import look_at_camera
from gaussian_swaying.rendering.cameras.camera_path import OrbitCamera

CENTER, UP = torch.zeros(3).double(), double([0.0, 0.0, 1.0])
ANGLES = {"a.png": 0.0, "b.png": 0.25 * math.pi, "c.png": 0.5 * math.pi}


def _cameras():
    """Camera of each name: a quarter of a circle."""
    eyes = {name: (3 * math.cos(angle), 3 * math.sin(angle), 1) for name, angle in ANGLES.items()}
    return {
        name: look_at_camera(eye, (0, 0, 0), (0, 0, 1), 40.0, 64, 48, dtype=torch.float64) for name, eye in eyes.items()
    }


@pytest.fixture(params=["transforms", "colmap"])
def capture(request, tmp_path):
    cameras = [_cameras()[name] for name in ("c.png", "a.png", "b.png")]
    names, without = ["images/c.png", "images/a.png", "images/b.png"], {"images": False}
    if request.param == "transforms":
        return write_transforms(tmp_path, cameras, names, **without)
    return write_colmap(tmp_path, cameras, names, binary=False, **without)


def _same(camera, expected):
    near(camera.world_to_camera, expected.world_to_camera, 1e-5)
    assert_close(camera.intrinsics, expected.intrinsics, rtol=1e-6, atol=1e-4)
    assert (camera.width, camera.height) == (expected.width, expected.height)


@pytest.mark.parametrize("view", [1, "images/b.png", "b.png", "b"])
def test_one_view_by_number_or_name(view, capture):
    path = CaptureCamera(capture, view=view)
    for time in (0.0, 5.0):
        _same(path(0, time, CENTER, UP, 1.0), _cameras()["b.png"])
    assert [name for name, _ in read_views(capture)] == ["images/a.png", "images/b.png", "images/c.png"]


def test_a_journey_meets_every_view_in_the_order_of_names(capture):
    path = CaptureCamera(capture, seconds_per_view=2.0)
    for k, name in enumerate(("a.png", "b.png", "c.png")):
        _same(path(0, 2.0 * k, CENTER, UP, 1.0), _cameras()[name])
    _same(path(0, 99.0, CENTER, UP, 1.0), _cameras()["c.png"])
    between = path(0, 1.0, CENTER, UP, 1.0)
    rotation = between.world_to_camera[:3, :3]
    near(rotation @ rotation.T, EYE, 1e-5)
    seen = between.world_to_camera[:3] @ double([0.0, 0.0, 0.0, 1.0])
    assert abs(float(seen[0] / seen[2])) < 0.05  # it still looks about where both neighbours look
    assert 2.5 < between.position[:2].norm() < 3.0


def test_the_picture_can_have_another_size(capture):
    camera = CaptureCamera(capture, view=0, width=32)(0, 0.0, CENTER, UP, 1.0)
    assert (camera.width, camera.height) == (32, 24)
    assert_close(camera.intrinsics[:2], 0.5 * _cameras()["a.png"].intrinsics[:2], rtol=1e-6, atol=1e-5)


def test_bad_views(capture, tmp_path):
    with value_error("no view 3: set `view` between 0 and 2"):
        CaptureCamera(capture, view=3)(0, 0.0, CENTER, UP, 1.0)
    with value_error(r"no view `d`, or several: .* such as images/a\.png"):
        CaptureCamera(capture, view="d")(0, 0.0, CENTER, UP, 1.0)
    empty = tmp_path / "empty"
    empty.mkdir()
    with value_error(r"has no cameras: give a transforms\.json"):
        CaptureCamera(empty)(0, 0.0, CENTER, UP, 1.0)


def test_views_of_different_sizes_need_one(tmp_path):
    frames = [
        {"file_path": name, "transform_matrix": torch.eye(4).tolist(), "w": w, "h": 48, "fl_x": 50.0}
        for name, w in (("a", 64), ("b", 32))
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"frames": frames}))
    with value_error("2 different sizes"):
        CaptureCamera(tmp_path)(0, 0.0, CENTER, UP, 1.0)
    assert CaptureCamera(tmp_path, width=16, height=16)(0, 0.0, CENTER, UP, 1.0).width == 16


def test_places_that_count_from_an_origin(capture):
    origin = (1000.5, -2000.0, 3.0)
    path = CaptureCamera(capture, "b")
    before = path(0, 0.0, CENTER, UP, 1.0).position
    after = path.counted_from(origin)(0, 0.0, CENTER, UP, 1.0).position
    near(after, before - double(origin), 2e-4)  # float32
    assert path(0, 0.0, CENTER, UP, 1.0).position.equal(before)
    orbit = OrbitCamera()
    assert orbit.counted_from(origin) is orbit
