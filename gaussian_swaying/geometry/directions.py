"""Lines spread evenly over all directions, two axes across each, and the area of a convex hull."""

from __future__ import annotations

import math

import torch
from torch import Tensor


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
    """Area of the convex hull of points.

    The outermost points in 1,000 directions stand for all; a sphere comes out less than 1 % too small. A flat sheet has
    two sides, so its hull has twice its area.

    Args:
        points: Shape (N, 3).

    Returns:
        Area [scene units^2]; 0 for fewer than three points.
    """
    if len(points) < 3:
        return 0.0
    from scipy.spatial import ConvexHull

    places = points.detach().cpu().double()
    heights = (part @ places.mT for part in spread_lines(500).split(50))
    outer = places[torch.cat([end for h in heights for end in (h.argmax(1), h.argmin(1))]).unique()]
    enough = torch.cat([outer, outer[:1].expand(3, 3)])  # of a line two points are left, and a hull needs four
    return float(ConvexHull(enough, qhull_options="QJ").area)  # also of points in a plane
