"""Neighbouring views of a capture: those that see the same surface from nearby, but not from the same place."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.rendering.cameras.camera import Camera

_BEST = math.radians(5.0)
_BELOW, _ABOVE = math.radians(1.0), math.radians(10.0)


def view_angles(cameras: Sequence[Camera]) -> Tensor:
    """Angles between the optical axes of cameras [rad], float64, shape (V, V)."""
    axis = torch.stack([camera.world_to_camera[2, :3].detach().cpu().double() for camera in cameras])
    axis = torch.nn.functional.normalize(axis, dim=-1)
    return (axis @ axis.T).clamp(-1.0, 1.0).acos()


def neighbouring_views(cameras: Sequence[Camera], count: int = 8, largest_angle: float = 30.0) -> list[list[int]]:
    r"""For each view those that show the same place well, the best first.

    Views are ranked by the angle :math:`\theta` between optical axes,
    :math:`e^{-(\theta - \theta_0)^2 / 2 \sigma^2}` with :math:`\theta_0` = 5 degrees and :math:`\sigma` = 1 below and
    10 degrees above it (Yao et al. 2018, "MVSNet", section 4.1): a smaller angle tells little about depth, and at a
    larger one the picture looks different. A view from the same place tells nothing of depth and is left out.

    Args:
        cameras: The cameras of a capture, on any device.
        count: Most views for each.
        largest_angle: Largest angle between the axes of two views [degrees].

    Returns:
        Lists of indices, one for each camera; empty where no view is close enough.

    Raises:
        ValueError: If ``count`` or ``largest_angle`` is not positive.
    """
    check_positive("count", count)
    check_positive("largest_angle", largest_angle)
    if not cameras:
        return []
    angle = view_angles(cameras)
    eye = torch.stack([camera.position.detach().cpu().double() for camera in cameras])
    apart = torch.cdist(eye, eye)
    spread = torch.where(angle < _BEST, _BELOW, _ABOVE)
    score = -((angle - _BEST) / spread).square()
    near = (angle <= math.radians(largest_angle)) & (apart > 1e-6 * apart.max())
    near.fill_diagonal_(False)
    order = torch.where(near, score, -math.inf).argsort(dim=1, descending=True, stable=True)
    return [
        [int(other) for other in row[: min(count, int(number))]] for row, number in zip(order, near.sum(1), strict=True)
    ]
