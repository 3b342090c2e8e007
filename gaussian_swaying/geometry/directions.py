"""Lines spread evenly over all directions, two axes across each, and the area of a convex hull from its projections."""

from __future__ import annotations

import math

import torch
from torch import Tensor

_SUPPORTS = 1000  # directions in which the outermost points are found
_SIDES = 128  # sides of the outline that a line sees


def spread_lines(count: int) -> Tensor:
    """Unit vectors spread evenly over half a sphere, one for each line through its centre, on a spiral.

    Returns:
        Shape (count, 3), float64.
    """
    index = torch.arange(count, dtype=torch.float64)
    z, angle = 1 - (index + 0.5) / max(count, 1), index * math.pi * (3 - math.sqrt(5))
    ring = (1 - z * z).sqrt()
    return torch.stack([ring * angle.cos(), ring * angle.sin(), z], dim=-1)


def axes_across(lines: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors at right angles to each unit vector (D, 3) and to each other, each of shape (D, 3)."""
    helper = torch.nn.functional.one_hot(lines.abs().argmin(-1), 3).to(lines)
    first = torch.nn.functional.normalize(torch.linalg.cross(lines, helper), dim=-1)
    return first, torch.linalg.cross(lines, first)


def hull_area(points: Tensor) -> float:
    r"""Area of the convex hull of points, by Cauchy's formula: four times its mean projected area.

    The outermost points in 1,000 directions stand for all; a sphere comes out less than 1 % too small. A flat sheet has
    two sides, so its hull has twice its area.

    Args:
        points: Shape (N, 3).

    Returns:
        Area [scene units^2]; 0 for fewer than three points.
    """
    if len(points) < 3:
        return 0.0
    places = points.detach().cpu().double()
    half = spread_lines(_SUPPORTS // 2)
    heights = (part @ places.mT for part in half.split(50))
    outer = places[torch.cat([end for h in heights for end in (h.argmax(1), h.argmin(1))]).unique()]
    outer = outer - outer.mean(0)
    lines = spread_lines(100)
    first, second = axes_across(lines)
    angle = torch.arange(_SIDES, dtype=torch.float64) * (2 * math.pi / _SIDES)
    shadow = torch.stack([outer @ first.mT, outer @ second.mT], dim=-1).movedim(1, 0)  # (D, K, 2)
    toward = torch.stack([angle.cos(), angle.sin()])  # (2, sides)
    corner = shadow.gather(1, (shadow @ toward).argmax(1)[..., None].expand(-1, -1, 2))
    after = corner.roll(-1, 1)
    twice = (corner[..., 0] * after[..., 1] - corner[..., 1] * after[..., 0]).sum(-1)
    return 4 * float(0.5 * twice.mean())
