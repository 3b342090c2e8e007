import pytest
import torch

from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera


def oblique(width, height, away, dtype=torch.float64):
    camera = look_at_camera((0.1, -away, 0.2), (0, 0, 0), (0, 0, 1), 50.0, width, height, 0.2, dtype=dtype)
    intrinsics = camera.intrinsics.clone()
    intrinsics[0, 2] += 1.3
    intrinsics[0, 0] *= 1.1
    return Camera(camera.world_to_camera, intrinsics, width, height, 0.2)


@pytest.fixture
def project():
    """Column and row of a point in a camera's image [pixels], and its depth."""

    def project(camera, point):
        local = camera.world_to_camera[:3, :3] @ torch.as_tensor(point, dtype=camera.intrinsics.dtype)
        pixel = camera.intrinsics @ (local + camera.world_to_camera[:3, 3])
        return (pixel[:2] / pixel[2]).tolist(), float(pixel[2])

    return project
