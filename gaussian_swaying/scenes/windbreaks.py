"""Scenes that show wind with a shape: a row of plants, and a ficus behind a wall."""

from __future__ import annotations

import torch

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.ficus import ficus
from gaussian_swaying.scenes.patches import Patches, box, copies, facing, join, to_cloud, tube
from gaussian_swaying.scenes.plant_parts import Draw, bezier, leaf, tints
from gaussian_swaying.scenes.procedural import both
from gaussian_swaying.scenes.stage import cast, floor


def plant_row(spacing: float = 0.012, count: int = 60, plants: int = 5) -> GaussianCloud:
    """A row of leafy plants along x on a floor at z = 0, z up.

    Each has a stem of 1.1 m and leaves of 16 cm, and they stand 0.6 m apart, around x = 0.

    Args:
        spacing: Distance between Gaussians [m]; a leaf has at least one.
    """
    draw = Draw()
    places = [(k - 0.5 * (plants - 1)) * 0.6 for k in range(plants)]
    shade = [cast((x, 0.0, 0.5), 0.3, 0.35) for x in places]
    parts: list[Patches] = [floor(max(2 * spacing, 0.03), (0.62, 0.58, 0.44), shade)]
    for x in places:
        parts += _plant(spacing, count, draw, x)
    return to_cloud(join(parts), overlap=0.45)


def _plant(spacing: float, leaves: int, draw: Draw, x: float) -> list[Patches]:
    lean = draw.uniform(-0.05, 0.05, 2).tolist()
    stem = bezier([[x, 0.0, -0.02], [x + lean[0], lean[1], 0.5], [x, 0.0, 1.1]])
    green = tube(stem, torch.linspace(0.014, 0.006, len(stem)), spacing, (0.30, 0.42, 0.16))
    share = (torch.arange(leaves, dtype=torch.float64) + draw.uniform(0.2, 0.8, leaves)) / leaves
    place = (0.22 + 0.77 * share) * (len(stem) - 1)
    low = place.long().clamp(max=len(stem) - 2)
    spot = torch.lerp(stem[low], stem[low + 1], (place - low)[:, None])
    turn = 2.39996 * torch.arange(leaves, dtype=torch.float64) + draw.uniform(-0.4, 0.4, leaves)
    way = torch.stack([turn.cos(), turn.sin(), 0.15 + 0.5 * share], dim=-1) + 0.15 * draw.normal(leaves, 3)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) + 0.2 * draw.normal(leaves, 3)
    blade = leaf(0.16, 0.055, spacing, droop=0.15, colour=(0.26, 0.50, 0.15), vein=(0.45, 0.62, 0.28))
    size = draw.uniform(0.75, 1.15, leaves) * (1.1 - 0.45 * share)
    return [green, copies(blade, facing(way, up), size, spot, tints(draw, leaves))]


def ficus_behind_wall(spacing: float = 0.008, count: int = 2400) -> GaussianCloud:
    """A :func:`~gaussian_swaying.scenes.ficus.ficus`, and a garden wall upwind of it, at x = -1.5 m, on its floor.

    The wall is 1.3 m high and 2.4 m long. The arguments are those of the tree, which comes first.
    """
    wall = box((-1.6, -1.2, 0.0), (-1.4, 1.2, 1.3), max(0.03, spacing), (0.70, 0.52, 0.42))
    z, y = wall.center[:, 2], wall.center[:, 1]
    course = torch.floor(z / 0.13)  # rows of stones, each shifted by a half
    joint = (z / 0.13 - course < 0.22) | ((y / 0.3 + 0.5 * course) % 1 < 0.1)
    wall = wall.painted((0.80, 0.76, 0.70), joint)
    return both(ficus(spacing, count), to_cloud(wall, two_sided=False))
