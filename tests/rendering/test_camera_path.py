import json
import math

import pytest
import torch
from shared import double, value_error

from gaussian_swaying.captures.capture_camera import CaptureCamera
from gaussian_swaying.rendering.cameras.camera import orbit_camera
from gaussian_swaying.rendering.cameras.camera_path import LookAtCamera, OrbitCamera
from gaussian_swaying.rendering.cameras.keyframes import CameraKey


def test_orbit_path_scales_with_the_object_and_turns_with_time():
    path = OrbitCamera(
        64,
        48,
        fov_y=30.0,
        azimuth=10.0,
        elevation=20.0,
        radius=3.0,
        degrees_per_second=40.0,
        target_offset=(0.0, 0.5, 0.0),
    )
    center, up = double([1.0, 2.0, 3.0]), torch.tensor([0.0, 0.0, 1.0])
    camera = path(7, 2.0, center, up, 0.2)
    expected = orbit_camera((1.0, 2.1, 3.0), (0, 0, 1), 0.6, 90.0, 20.0, 30.0, 64, 48, dtype=torch.float64)
    assert camera.intrinsics.dtype == torch.float64
    torch.testing.assert_close(camera.world_to_camera, expected.world_to_camera)
    torch.testing.assert_close(camera.intrinsics, expected.intrinsics)
    assert (camera.width, camera.height) == (64, 48)


def test_look_at_path_takes_the_up_direction_of_the_scene_by_default(project):
    center, scene_up = torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
    camera = LookAtCamera((0, 0, -2), (0, 0, 0), up=None, width=64, height=48, fov_y=30.0)(
        0, 0.0, center, scene_up, 1.0
    )
    assert project(camera, (0, -0.1, 0))[0][1] < 24
    camera = LookAtCamera((0, 0, -2), (0, 0, 0), up=(0, 1, 0), width=64, height=48, fov_y=30.0)(
        0, 0.0, center, scene_up, 1.0
    )
    assert project(camera, (0, -0.1, 0))[0][1] > 24


@pytest.mark.parametrize(
    ("arguments", "error", "field"),
    [
        ({"width": 0}, ValueError, "width"),
        ({"height": 10.5}, TypeError, "height"),
        ({"width": True}, TypeError, "width"),
        ({"fov_y": 180.0}, ValueError, "fov_y"),
        ({"fov_y": 0.0}, ValueError, "fov_y"),
        ({"elevation": 90.0}, ValueError, "elevation"),
        ({"azimuth": math.nan}, ValueError, "azimuth"),
        ({"radius": 0.0}, ValueError, "radius"),
        ({"target_offset": (0, 0)}, ValueError, "target_offset"),
    ],
)
def test_bad_orbit_arguments(arguments, error, field):
    with pytest.raises(error, match=f"`{field}`"):
        OrbitCamera(**arguments)


def test_bad_look_at_and_capture_arguments():
    with value_error("`eye`"):
        LookAtCamera((0, 0), (0, 0, 0))
    with value_error("`eye` and `target`"):
        LookAtCamera((0, 0, 0), (0, 0, 0))
    with value_error("`up`"):
        LookAtCamera((0, 0, 1), (0, 0, 0), up=(0, 0, 0))
    with pytest.raises(TypeError, match="`width`"):
        CaptureCamera("transforms.json", width=0.5)
    with value_error("`eye` or `keys`"):
        LookAtCamera()


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_near_plane_has_the_size_of_the_scene(unit, tmp_path):
    centre, up = torch.full((3,), 2.0 * unit), torch.tensor([0.0, 0.0, 1.0])
    data = {"w": 8, "h": 8, "camera_angle_x": 1.0, "frames": [{"transform_matrix": torch.eye(4).tolist()}]}
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps(data))
    for camera, expected in (
        (OrbitCamera(radius=2.0), 0.02),
        (LookAtCamera((0.0, 0.0, 0.0), (0.0, 3.0 * unit, 0.0)), 0.03),
        (LookAtCamera(keys=[CameraKey(0.0, eye=[2 * unit, unit, 2 * unit])]), 0.01),
        (CaptureCamera(file, 0), 0.01),
    ):
        assert camera(0, 0.0, centre, up, unit).near == pytest.approx(expected * unit)
