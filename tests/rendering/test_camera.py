"""Cameras against hand-computed geometry."""

import dataclasses
import json
import math

import pytest
import torch

from gaussian_swaying.rendering.camera import (
    Camera,
    LookAtCamera,
    OrbitCamera,
    TransformsCamera,
    camera_from_transforms,
    look_at_camera,
    orbit_camera,
    rotation_from_z,
)

# Blender camera at (1, 2, 3) that looks along +x with z up: OpenGL axes right = -y, up = +z, backward = -x.
POSE = [[0.0, 0.0, -1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def _project(camera, point):
    local = camera.world_to_camera[:3, :3] @ torch.as_tensor(point, dtype=camera.intrinsics.dtype)
    pixel = camera.intrinsics @ (local + camera.world_to_camera[:3, 3])
    return (pixel[:2] / pixel[2]).tolist(), float(pixel[2])


def _write(tmp_path, **fields):
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(fields))
    return path


def test_look_at_puts_the_target_at_the_centre_and_up_at_the_top(device, dtype):
    camera = look_at_camera((1, -3, 2), (0.5, 0.2, 0.1), (0, 0, 1), 35.0, 64, 48, device=device, dtype=dtype)
    assert camera.position.dtype == dtype
    assert camera.position.device.type == device.type
    camera = camera.to("cpu")
    pixel, depth = _project(camera, (0.5, 0.2, 0.1))
    assert pixel == pytest.approx([32.0, 24.0], abs=1e-4)
    assert depth == pytest.approx(math.dist((1, -3, 2), (0.5, 0.2, 0.1)), rel=1e-5)
    assert camera.position.tolist() == pytest.approx([1, -3, 2], abs=1e-5)
    above, _ = _project(camera, (0.5, 0.2, 0.4))
    assert above[1] < 20
    assert above[0] == pytest.approx(32.0, abs=1e-4)
    rotation = camera.world_to_camera[:3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=dtype), atol=1e-6, rtol=0)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.gpu
def test_a_camera_goes_to_the_gpu_without_a_wait():
    """Matrices and eye in one copy; the eye, computed in float64 before, is as near as float32 can hold it."""
    camera = look_at_camera((1e3, -3, 2), (0.5, 0.2, 0.1), (0, 0, 1), 35.0, 64, 48, dtype=torch.float64)
    camera.to("cuda", torch.float32)
    torch.cuda.set_sync_debug_mode("error")
    try:
        moved = camera.to("cuda", torch.float32)
        assert moved.to(moved.intrinsics.device, torch.float32) is moved
        eye = moved.position
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.equal(eye.cpu(), camera.position.float())
    for name in ("world_to_camera", "intrinsics"):
        assert torch.equal(getattr(moved, name).cpu(), getattr(camera, name).float())
    # another matrix has another eye
    shifted = moved.world_to_camera.clone()
    shifted[2, 3] += 1.0
    other = dataclasses.replace(moved, world_to_camera=shifted)
    torch.testing.assert_close(other.position, torch.linalg.inv(shifted)[:3, 3])


def test_a_camera_that_is_where_it_should_be_is_not_copied():
    camera = look_at_camera((1, -3, 2), (0.5, 0.2, 0.1), (0, 0, 1), 35.0, 64, 48)
    assert camera.to("cpu", torch.float32) is camera
    assert camera.to() is camera
    double = camera.to(dtype=torch.float64)
    assert double.position.dtype == torch.float64
    torch.testing.assert_close(double.position.float(), camera.position)


def test_look_at_field_of_view_and_handedness():
    """Eye on -y that looks along +y with z up: +x is to the right, and 45 degrees up is the top edge at 90 degrees."""
    camera = look_at_camera((0, -2, 0), (0, 0, 0), (0, 0, 1), 90.0, 100, 50)
    assert _project(camera, (0, 0, 2))[0] == pytest.approx([50.0, 0.0], abs=1e-4)
    assert _project(camera, (1, 0, 0))[0] == pytest.approx([62.5, 25.0], abs=1e-4)


@pytest.mark.parametrize(
    ("up", "azimuth", "elevation", "expected"),
    [
        ((0, 0, 1), 0.0, 0.0, (2, 0, 0)),
        ((0, 0, 2), 90.0, 0.0, (0, 2, 0)),
        ((0, 0, 1), -90.0, 0.0, (0, -2, 0)),
        ((0, 0, 1), 0.0, 30.0, (math.sqrt(3), 0, 1)),
        ((0, -1, 0), 0.0, 0.0, (2, 0, 0)),
        ((0, -1, 0), 90.0, 0.0, (0, 0, 2)),
        ((0, -1, 0), -90.0, 0.0, (0, 0, -2)),
        ((0, -1, 0), 0.0, 30.0, (math.sqrt(3), -1, 0)),
        ((0, 1, 0), 90.0, 0.0, (0, 0, -2)),
        ((0, 0, -1), 0.0, 30.0, (math.sqrt(3), 0, -1)),
        ((0, 0, -1), 90.0, 0.0, (0, -2, 0)),
    ],
)
def test_orbit_angles(up, azimuth, elevation, expected):
    center = torch.tensor([0.3, -0.4, 0.5])
    camera = orbit_camera(center, up, 2.0, azimuth, elevation, 40.0, 60, 40)
    assert (camera.position - center).tolist() == pytest.approx(list(expected), abs=1e-5)
    assert _project(camera, center)[0] == pytest.approx([30.0, 20.0], abs=1e-4)
    top, _ = _project(camera, center + 0.1 * torch.tensor(up, dtype=torch.float32))
    assert top[1] < 20.0


def test_rotation_from_z_is_the_minimal_rotation():
    for up in torch.randn(20, 3, dtype=torch.float64):
        rotation, unit = rotation_from_z(up), up / up.norm()
        torch.testing.assert_close(rotation[:, 2], unit)
        torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
        assert float(rotation.trace()) == pytest.approx(1 + 2 * float(unit[2]))  # angle = angle between z and up


def test_orbit_path_scales_with_the_object_and_turns_with_time():
    path = OrbitCamera(64, 48, 30.0, 10.0, 20.0, 3.0, degrees_per_second=40.0, target_offset=(0.0, 0.5, 0.0))
    center, up = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0])
    camera = path(7, 2.0, center, up, 0.2)
    expected = orbit_camera((1.0, 2.1, 3.0), (0, 0, 1), 0.6, 90.0, 20.0, 30.0, 64, 48, dtype=torch.float64)
    assert camera.intrinsics.dtype == torch.float64
    torch.testing.assert_close(camera.world_to_camera, expected.world_to_camera)
    torch.testing.assert_close(camera.intrinsics, expected.intrinsics)
    assert (camera.width, camera.height) == (64, 48)


def test_look_at_path_takes_the_up_direction_of_the_scene_by_default():
    center, scene_up = torch.zeros(3), torch.tensor([0.0, -1.0, 0.0])
    camera = LookAtCamera((0, 0, -2), (0, 0, 0), None, 64, 48, 30.0)(0, 0.0, center, scene_up, 1.0)
    assert _project(camera, (0, -0.1, 0))[0][1] < 24
    camera = LookAtCamera((0, 0, -2), (0, 0, 0), (0, 1, 0), 64, 48, 30.0)(0, 0.0, center, scene_up, 1.0)
    assert _project(camera, (0, -0.1, 0))[0][1] > 24


def test_transforms_blender(tmp_path):
    angle = 2 * math.atan(0.5)  # focal length equal to the width
    path = _write(tmp_path, camera_angle_x=angle, frames=[{"transform_matrix": POSE}])
    camera = camera_from_transforms(path, 0, 80, 60)
    expected = torch.tensor([[0.0, -1, 0, 2], [0, 0, -1, 3], [1, 0, 0, -1], [0, 0, 0, 1]])
    torch.testing.assert_close(camera.world_to_camera, expected)
    torch.testing.assert_close(camera.intrinsics, torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]]))
    assert camera.position.tolist() == pytest.approx([1, 2, 3])
    assert _project(camera, (3.0, 2.0, 3.0)) == (pytest.approx([40.0, 30.0]), pytest.approx(2.0))


def test_transforms_instant_ngp_rescales_and_overrides(tmp_path):
    frames = [{"transform_matrix": POSE}, {"transform_matrix": POSE, "fl_x": 300.0, "cx": 90.0}]
    path = _write(tmp_path, fl_x=200.0, fl_y=210.0, cx=99.0, cy=52.0, w=200, h=100, frames=frames)
    first = camera_from_transforms(path, 0)
    assert (first.width, first.height) == (200, 100)
    torch.testing.assert_close(first.intrinsics, torch.tensor([[200.0, 0, 99], [0, 210, 52], [0, 0, 1]]))
    half = camera_from_transforms(path, 1, width=100)
    assert (half.width, half.height) == (100, 50)
    torch.testing.assert_close(half.intrinsics, torch.tensor([[150.0, 0, 45], [0, 105, 26], [0, 0, 1]]))
    tall = camera_from_transforms(path, 0, 100, 100)
    torch.testing.assert_close(tall.intrinsics, torch.tensor([[100.0, 0, 49.5], [0, 210, 52], [0, 0, 1]]))
    moving = TransformsCamera(path, 1, height=50)
    center = torch.zeros(3, dtype=torch.float64)
    for frame in range(2):
        camera = moving(frame, 0.1 * frame, center, center, 1.0)
        torch.testing.assert_close(camera.intrinsics, half.intrinsics.double())


GOOD = {"camera_angle_x": 0.8, "w": 8, "h": 6, "frames": [{"transform_matrix": POSE}]}


@pytest.mark.parametrize(
    ("change", "frame", "message"),
    [
        ({"frames": None}, 0, "no list `frames`"),
        ({"frames": []}, 0, "no list `frames`"),
        ({}, 1, "no frame 1.*between 0 and 0"),
        ({}, -1, "no frame -1"),
        ({"frames": [{}]}, 0, r"no `frames\[0\].transform_matrix`"),
        ({"frames": [{"transform_matrix": [[1, 2], [3]]}]}, 0, "4 rows of 4"),
        ({"frames": [{"transform_matrix": [[1, 2], [3, 4]]}]}, 0, r"4 rows of 4 finite numbers.*\(2, 2\)"),
        ({"frames": [{"transform_matrix": [[0.0] * 4] * 4}]}, 0, "singular"),
        ({"camera_angle_x": None}, 0, "no focal length.*`fl_x`"),
        ({"camera_angle_x": "wide"}, 0, "`camera_angle_x`.*set it to a number"),
        ({"camera_angle_x": 50.0}, 0, "`camera_angle_x`.*radians"),
        ({"w": None}, 0, "no image size"),
        ({"w": None, "fl_x": 5.0}, 0, "`fl_x` but no `w`"),
        ({"fl_x": -5.0}, 0, "`fl_x`.*positive"),
        ({"h": 0}, 0, "`h`.*positive"),
    ],
)
def test_bad_transforms_are_named(tmp_path, change, frame, message):
    path = _write(tmp_path, **{**GOOD, **change})
    with pytest.raises(ValueError, match=message) as info:
        camera_from_transforms(path, frame)
    assert str(path) in str(info.value)


def test_unreadable_transforms_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"missing\.json.*check `path`"):
        camera_from_transforms(tmp_path / "missing.json", 0)
    (tmp_path / "broken.json").write_text("{frames")
    with pytest.raises(ValueError, match=r"broken\.json.*not valid JSON"):
        camera_from_transforms(tmp_path / "broken.json", 0)
    with pytest.raises(TypeError, match="`frame`"):
        camera_from_transforms(_write(tmp_path, **GOOD), 0.5)
    assert camera_from_transforms(_write(tmp_path, **GOOD), 0).width == 8


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
        ({"near": -1.0}, ValueError, "near"),
    ],
)
def test_bad_orbit_arguments(arguments, error, field):
    with pytest.raises(error, match=f"`{field}`"):
        OrbitCamera(**arguments)


def test_bad_look_at_and_transforms_arguments():
    with pytest.raises(ValueError, match="`eye`"):
        LookAtCamera((0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match="`eye` and `target`"):
        LookAtCamera((0, 0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match="`up`"):
        LookAtCamera((0, 0, 1), (0, 0, 0), (0, 0, 0))
    with pytest.raises(ValueError, match=r"`up`.*line of sight"):
        look_at_camera((0, 0, 1), (0, 0, 0), (0, 0, 1), 40.0, 8, 8)
    with pytest.raises(ValueError, match="`frame`"):
        TransformsCamera("transforms.json", -1)
    with pytest.raises(TypeError, match="`width`"):
        TransformsCamera("transforms.json", width=0.5)
    with pytest.raises(ValueError, match="`world_to_camera`"):
        Camera(torch.eye(3), torch.eye(3), 8, 8)
