"""Whether the cameras, points and photos of a capture belong together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from torch import Tensor

from gaussian_swaying.rendering.cameras.camera import Camera

TURNED_AXES = (
    "y and z of the camera axes seem to be turned round; if so, set `axes` of the transforms.json to opencv (y down, "
    "z forward) or opengl (y up, z backward, as without it)"
)
_SAMPLE = 1000  # points that are looked at


def places_in_picture(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Project points into a camera, ignoring occlusion.

    Args:
        points: Points [scene units], on the CPU, shape (N, 3).

    Returns:
        Column and row of each [pixels], shape (N, 2), and which are in the picture, shape (N,).
    """
    view, intrinsics = camera.world_to_camera.to(points), camera.intrinsics.to(points)
    local = points @ view[:3, :3].T + view[:3, 3]
    depth = local[:, 2:]
    place = local[:, :2] / depth.clamp_min(1e-30) * intrinsics.diagonal()[:2] + intrinsics[:2, 2]
    inside = (place >= 0) & (place < place.new_tensor([camera.width, camera.height])) & (depth > 0)
    return place, inside.all(-1)


def cameras_that_see(points: Tensor, cameras: Sequence[Camera]) -> tuple[int, int]:
    """Number of cameras that see any of the points (N, 3): as given, and with y and z of the camera flipped."""
    some = points[:: -(-len(points) // _SAMPLE)].double()
    turned = [replace(camera, world_to_camera=turned_axes(camera.world_to_camera)) for camera in cameras]
    as_given, other = (sum(bool(places_in_picture(some, c)[1].any()) for c in kind) for kind in (cameras, turned))
    return as_given, other


def turned_axes(world_to_camera: Tensor) -> Tensor:
    """A pose (4, 4) with the camera's y and z flipped: between OpenGL's and OpenCV's axes."""
    return world_to_camera * world_to_camera.new_tensor([1.0, -1.0, -1.0, 1.0])[:, None]
