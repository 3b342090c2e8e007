"""The surface that a picture of Gaussians shows: normals, distances of planes, and depths of the surface.

Each Gaussian stands for the plane through its centre across its smallest axis. Blended like colours, normals and plane
distances give a plane at every pixel, and the ray of the pixel meets it at a depth that does not depend on where in the
patch the pixel lies (Chen et al. 2024, "PGSR", section 3.2). Blended depths of centres would.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.geometry.patches import smallest_axis_normal
from gaussian_swaying.rendering.cameras.camera import Camera

_GRAZING = 0.02
"""Least cosine between a ray and a normal: a plane seen more from its side has no depth that one could use."""


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMaps:
    """The surface in a picture, in the frame of its camera.

    Attributes:
        normal: Blended normals towards the camera, shorter than 1 where the picture is not opaque, shape (H, W, 3).
        unit: The same with length 1, shape (H, W, 3).
        distance: Signed distance of the plane from the eye, n.x on the plane, negative [scene units], (H, W, 1).
        depth: Depth along the optical axis where the ray meets the plane [scene units], (H, W, 1); 0 where none is.
        known: Whether a pixel shows a surface, bool (H, W, 1).
    """

    normal: Tensor
    unit: Tensor
    distance: Tensor
    depth: Tensor
    known: Tensor


def plane_channels(means: Tensor, quats: Tensor, log_scales: Tensor, camera: Camera) -> Tensor:
    """Return the channels that are blended for :func:`surface_maps`: normal towards the camera, distance of the plane.

    Returns:
        Normals in the frame of the camera and n.x, shape (N, 4). Differentiable in ``means`` and ``quats``.
    """
    check_shape("means", means, None, 3)
    rotation, shift = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    normal = smallest_axis_normal(quats, log_scales) @ rotation.T
    distance = (normal * (means @ rotation.T + shift)).sum(-1, keepdim=True)
    both = torch.cat([normal, distance], dim=-1)
    return torch.where(distance > 0, -both, both)


def pixel_rays(camera: Camera) -> Tensor:
    """Points at depth 1 behind the centres of the pixels, in the frame of the camera, shape (H, W, 3)."""
    matrix = camera.intrinsics
    column = torch.arange(camera.width, device=matrix.device, dtype=matrix.dtype) + 0.5
    row = torch.arange(camera.height, device=matrix.device, dtype=matrix.dtype) + 0.5
    v, u = torch.meshgrid((row - matrix[1, 2]) / matrix[1, 1], (column - matrix[0, 2]) / matrix[0, 0], indexing="ij")
    return torch.stack([u, v, torch.ones_like(u)], dim=-1)


def surface_maps(channels: Tensor, alpha: Tensor, camera: Camera) -> SurfaceMaps:
    r"""The surface of a picture from its blended :func:`plane_channels`.

    With the blended normal :math:`N` and distance :math:`D`, both weighted alike, and the ray r of a pixel, the depth
    is :math:`D / (N \cdot r)`.

    Args:
        channels: Blended channels, shape (H, W, 4).
        alpha: Rendered opacity, shape (H, W, 1).
    """
    check_shape("channels", channels, camera.height, camera.width, 4)
    check_shape("alpha", alpha, camera.height, camera.width, 1)
    normal, rays = channels[..., :3], pixel_rays(camera)
    length = normal.norm(dim=-1, keepdim=True)
    facing = (normal * rays).sum(-1, keepdim=True)
    with torch.no_grad():
        known = (alpha > 0.5) & (-facing > _GRAZING * length * rays.norm(dim=-1, keepdim=True))
        known &= channels[..., 3:] < 0
    safe = torch.where(known, length, 1.0)
    depth = torch.where(known, channels[..., 3:] / torch.where(known, facing, 1.0), 0.0)
    unit = torch.where(known, normal / safe, 0.0)
    distance = torch.where(known, channels[..., 3:] / safe, 0.0)
    return SurfaceMaps(normal, unit, distance, depth, known)
