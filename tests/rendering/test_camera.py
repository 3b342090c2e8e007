import dataclasses
import math

import pytest
import torch
from shared import near, value_error, without_waits

from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera, orbit_camera


def test_look_at_puts_the_target_at_the_centre_and_up_at_the_top(device, dtype, project):
    camera = look_at_camera((1, -3, 2), (0.5, 0.2, 0.1), (0, 0, 1), 35.0, 64, 48, device=device, dtype=dtype)
    assert camera.position.dtype == dtype
    assert camera.position.device.type == device.type
    camera = camera.to("cpu")
    pixel, depth = project(camera, (0.5, 0.2, 0.1))
    assert pixel == pytest.approx([32.0, 24.0], abs=1e-4)
    assert depth == pytest.approx(math.dist((1, -3, 2), (0.5, 0.2, 0.1)), rel=1e-5)
    assert camera.position.tolist() == pytest.approx([1, -3, 2], abs=1e-5)
    above, _ = project(camera, (0.5, 0.2, 0.4))
    assert above[1] < 20
    assert above[0] == pytest.approx(32.0, abs=1e-4)
    rotation = camera.world_to_camera[:3, :3]
    near(rotation @ rotation.T, torch.eye(3, dtype=dtype), 1e-6)
    assert float(torch.linalg.det(rotation)) == pytest.approx(1.0, abs=1e-5)


@pytest.mark.gpu
def test_a_camera_goes_to_the_gpu_without_a_wait():
    """Matrices and eye in one copy; the eye, computed in float64 before, is as near as float32 can hold it."""
    camera = look_at_camera((1e3, -3, 2), (0.5, 0.2, 0.1), (0, 0, 1), 35.0, 64, 48, dtype=torch.float64)
    camera.to("cuda", torch.float32)
    with without_waits():
        moved = camera.to("cuda", torch.float32)
        assert moved.to(moved.intrinsics.device, torch.float32) is moved
        eye = moved.position
    assert torch.equal(eye.cpu(), camera.position.float())
    for name in ("world_to_camera", "intrinsics"):
        assert torch.equal(getattr(moved, name).cpu(), getattr(camera, name).float())
    # another matrix has another eye
    shifted = moved.world_to_camera.clone()
    shifted[2, 3] += 1.0
    other = dataclasses.replace(moved, world_to_camera=shifted)
    torch.testing.assert_close(other.position, torch.linalg.inv(shifted)[:3, 3])


def test_look_at_field_of_view_and_handedness(project):
    """Eye on -y that looks along +y with z up: +x is to the right, and 45 degrees up is the top edge at 90 degrees."""
    camera = look_at_camera((0, -2, 0), (0, 0, 0), (0, 0, 1), 90.0, 100, 50)
    assert project(camera, (0, 0, 2))[0] == pytest.approx([50.0, 0.0], abs=1e-4)
    assert project(camera, (1, 0, 0))[0] == pytest.approx([62.5, 25.0], abs=1e-4)


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
def test_orbit_angles(up, azimuth, elevation, expected, project):
    center = torch.tensor([0.3, -0.4, 0.5])
    camera = orbit_camera(center, up, 2.0, azimuth, elevation, 40.0, 60, 40)
    assert (camera.position - center).tolist() == pytest.approx(list(expected), abs=1e-5)
    assert project(camera, center)[0] == pytest.approx([30.0, 20.0], abs=1e-4)
    top, _ = project(camera, center + 0.1 * torch.tensor(up, dtype=torch.float32))
    assert top[1] < 20.0


def test_bad_arguments():
    with value_error(r"`up`.*line of sight"):
        look_at_camera((0, 0, 1), (0, 0, 0), (0, 0, 1), 40.0, 8, 8)
    with value_error("`world_to_camera`"):
        Camera(torch.eye(3), torch.eye(3), 8, 8)
