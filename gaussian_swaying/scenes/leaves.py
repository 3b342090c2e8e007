"""A leafy branch."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import Patches, copies, facing, join, to_cloud, tube
from gaussian_swaying.scenes.plant_parts import Draw, leaf, tints

# start, end and radius of the straight pieces of wood [m]: the branch, then its twigs
WOOD = (
    ((-0.90, 0.0, 0.00), (0.63, 0.0, 0.18), 0.016),
    ((-0.57, 0.0, 0.04), (-0.21, -0.09, 0.45), 0.009),
    ((-0.30, 0.0, 0.07), (0.09, 0.12, -0.30), 0.009),
    ((0.00, 0.0, 0.10), (0.36, -0.08, 0.51), 0.009),
    ((0.24, 0.0, 0.13), (0.63, 0.09, -0.15), 0.009),
)


def leafy_branch(spacing: float = 0.006, count: int = 150) -> GaussianCloud:
    """A leafy branch about 1.8 m long in the x-z plane, z up. Left of x = -0.9 m it continues without leaves.

    A straight branch with four straight twigs (:data:`WOOD`) and leaves of 17 cm.

    Args:
        spacing: Distance between Gaussians [m]; a leaf has at least one.
    """
    h, draw = spacing, Draw()
    ends = torch.tensor([piece[:2] for piece in WOOD], dtype=torch.float64)
    parts = []
    for piece, (_, _, radius) in zip(ends, WOOD, strict=True):
        parts.append(tube(piece, [radius, 0.6 * radius], h, (0.36, 0.26, 0.18)))
    lengths = (ends[:, 1] - ends[:, 0]).norm(dim=-1)
    shares = lengths * torch.tensor([0.7, 1.0, 1.0, 1.0, 1.0], dtype=torch.float64)
    counts = (shares / shares.sum() * count).long().clamp(min=1)
    counts[0] += count - int(counts.sum())
    for piece, number in zip(ends, counts.tolist(), strict=True):
        if number > 0:
            parts.append(_leaves(h, draw, piece, number))
    # from the cut out of the picture: the wood behind the pins, without leaves
    parts.append(tube([[-2.4, 0.05, -0.30], [-0.90, 0.0, 0.0]], [0.030, 0.016], max(h, 0.01), (0.36, 0.26, 0.18)))
    return to_cloud(join(parts), overlap=0.45)


def _leaves(spacing: float, draw: Draw, piece: Tensor, count: int) -> Patches:
    along = torch.nn.functional.normalize(piece[1] - piece[0], dim=-1)
    place = (torch.arange(count, dtype=torch.float64) + draw.uniform(0.2, 0.8, count)) / count
    place = 0.12 + 0.88 * place
    spot = torch.lerp(piece[0], piece[1], place[:, None])
    # alternately to both sides of the wood, slightly forwards, and around it
    y = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
    side = torch.nn.functional.normalize(torch.linalg.cross(y, along), dim=-1)
    sign = 1 - 2 * (torch.arange(count) % 2)[:, None].double()
    way = sign * side + 0.7 * along + 0.45 * draw.normal(count, 3)
    up = -y + 0.45 * draw.normal(count, 3)  # the upper sides are seen from the front
    blade = leaf(
        0.17, 0.075, spacing, taper=(0.6, 0.9), droop=0.18, colour=(0.26, 0.47, 0.14),
        vein=(0.50, 0.66, 0.32), veins=5,
    )  # fmt: skip
    size = draw.uniform(0.75, 1.15, count)
    return copies(blade, facing(way, up), size, spot, tints(draw, count, 0.22))
