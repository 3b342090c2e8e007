"""A potted ficus."""

from __future__ import annotations

import math

import torch

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import copies, facing, join, to_cloud, tube
from gaussian_swaying.scenes.plant_parts import Draw, bezier, leaf, pot, tints
from gaussian_swaying.scenes.stage import cast, floor


def ficus(spacing: float = 0.008, count: int = 2400) -> GaussianCloud:
    """A ficus tree 2 m tall, z up, in a pot on a floor at z = 0; the soil is at z = 0.30 m.

    The trunk rises from the soil to z = 1.25 m and has branches, twigs and leaves of 8 cm.

    Args:
        spacing: Distance between Gaussians [m]; a leaf has at least one. On the trunk and branches it is at most 3 and
            4.5 cm, so that they stay stiff on a coarse grid.
    """
    h, draw = spacing, Draw()
    bark = (0.42, 0.33, 0.25)
    trunk = bezier([[0, 0, 0.28], [0.10, 0.02, 0.6], [-0.10, -0.03, 0.95], [0.02, 0.0, 1.25]])
    thick = torch.linspace(0.055, 0.026, len(trunk), dtype=torch.float64)
    shade = (cast((0.0, 0.0, 1.4), 0.85, 0.28), cast((0.0, 0.0, 0.15), 0.26, 0.5), (0.0, 0.0, 0.22, 0.6))
    ground = floor(max(2 * h, 0.03), (0.84, 0.82, 0.78), shade)
    parts = [ground, pot(0.32, 0.15, 0.20, max(h, 0.012)), tube(trunk, thick, min(h, 0.03), bark)]
    twigs = []
    for number in range(16):
        share = 0.55 + 0.45 * number / 15
        start = trunk[round(share * (len(trunk) - 1))]
        azimuth = 2.39996 * number + float(draw.uniform(-0.3, 0.3, 1))
        rise = math.radians(15 + 60 * number / 15)
        length = 0.50 - 0.08 * abs(number - 7) / 8 + float(draw.uniform(-0.05, 0.05, 1))
        out = torch.tensor([math.cos(azimuth), math.sin(azimuth), 0.0], dtype=torch.float64)
        lift = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
        end = start + length * (math.cos(rise) * out + math.sin(rise) * lift)
        branch = bezier(torch.stack([start, start + 0.6 * (end - start) + 0.06 * lift, end]), 13)
        parts.append(tube(branch, torch.linspace(0.015, 0.007, 13), min(h, 0.045), bark))
        twigs.append(branch[6:])
        for place in (4, 6, 8, 10, 12):
            root = branch[place]
            way = torch.nn.functional.normalize(end - start + 0.75 * length * draw.normal(3), dim=-1)
            tip = root + float(draw.uniform(0.16, 0.26, 1)) * way
            twig = bezier(torch.stack([root, 0.5 * (root + tip) + 0.02 * lift, tip]), 7)
            parts.append(tube(twig, torch.linspace(0.006, 0.003, 7), max(h, 0.012), bark))
            twigs.append(twig[1:])
    # leaves are attached to points of the twigs and point away from the trunk, drooping a little
    spots = torch.cat(twigs)
    spot = spots[(draw.uniform(0, 1, count) * len(spots)).long().clamp(max=len(spots) - 1)]
    middle = torch.tensor([0.0, 0.0, 1.15], dtype=torch.float64)
    way = torch.nn.functional.normalize(spot - middle, dim=-1) + 0.6 * draw.normal(count, 3)
    way[:, 2] -= 0.35
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) + 0.35 * draw.normal(count, 3)
    blade = leaf(0.08, 0.04, h, droop=0.2, colour=(0.24, 0.52, 0.18), vein=(0.38, 0.64, 0.28))
    size = draw.uniform(0.75, 1.2, count)
    deep = ((spot - middle).norm(dim=-1, keepdim=True) / 0.6).clamp(0.55, 1.0)  # darker inside the crown
    parts.append(copies(blade, facing(way, up), size, spot, deep * tints(draw, count)))
    return to_cloud(join(parts), overlap=0.45)
