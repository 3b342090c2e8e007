"""Shared by the tests of cameras."""

import pytest
import torch


@pytest.fixture
def project():
    """Column and row of a point in a camera's image [pixels], and its depth."""

    def project(camera, point):
        local = camera.world_to_camera[:3, :3] @ torch.as_tensor(point, dtype=camera.intrinsics.dtype)
        pixel = camera.intrinsics @ (local + camera.world_to_camera[:3, 3])
        return (pixel[:2] / pixel[2]).tolist(), float(pixel[2])

    return project
