"""A potted alocasia."""

from __future__ import annotations

import math

import torch

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import Patches, facing, join, to_cloud, tube
from gaussian_swaying.scenes.plant_parts import Draw, bezier, leaf, pot
from gaussian_swaying.scenes.stage import cast, floor


def alocasia(spacing: float = 0.005, count: int = 8, size: float = 0.0) -> GaussianCloud:
    """An alocasia (elephant's ear) about 1.1 m tall, in a pot on a floor at z = 0, z up; the soil is at 0.20 m.

    Each bent stalk has one broad blade of 38 cm.

    Args:
        spacing: Distance between Gaussians [m].
        size: Radius of a floor without shadows and with small Gaussians, where copies can stand [m]; 0 for the floor of
            one plant.
    """
    h, draw = spacing, Draw()
    shade = (cast((0.0, 0.0, 0.8), 0.50, 0.22), cast((0.0, 0.0, 0.1), 0.22, 0.5), (0.0, 0.0, 0.19, 0.55))
    flat = size
    far = max(flat, 0.9), max(flat + 2.0, 3.5)
    ground = floor(max(2 * h, 0.02), (0.86, 0.82, 0.76), () if flat else shade, flat=flat, fade=far)
    parts = [ground, pot(0.22, 0.13, 0.17, max(h, 0.01), (0.86, 0.84, 0.80))]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    for number in range(count):
        share = (number + 0.5) / count
        azimuth = 2.39996 * number + 0.5
        out = torch.tensor([math.cos(azimuth), math.sin(azimuth), 0.0], dtype=torch.float64)
        reach, height = 0.10 + 0.26 * share, 0.95 - 0.42 * share + float(draw.uniform(-0.03, 0.03, 1))
        root = 0.035 * out + 0.18 * up
        top = reach * out + height * up
        stalk = bezier(torch.stack([root, root + 0.6 * (height - 0.18) * up, top]))
        parts.append(tube(stalk, torch.linspace(0.0065, 0.004, len(stalk)), h, (0.45, 0.52, 0.28)))
        parts.append(_blade(h, top, out - 0.55 * up, up + 0.9 * out, float(draw.uniform(0.85, 1.1, 1))))
    return to_cloud(join(parts))


def _blade(spacing: float, top: torch.Tensor, way: torch.Tensor, up: torch.Tensor, size: float) -> Patches:
    blade = leaf(
        0.38, 0.25, spacing / size, taper=(0.42, 0.95), droop=0.22, fold=0.22,
        colour=(0.12, 0.34, 0.16), vein=(0.62, 0.74, 0.50), veins=6,
    )  # fmt: skip
    turn = facing(way[None], up[None])[0]
    return blade.mapped(shift=(0.0, -0.076, 0.002)).mapped(size * turn, top)
