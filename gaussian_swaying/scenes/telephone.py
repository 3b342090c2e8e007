"""A wall telephone with its handset on a coiled cord."""

from __future__ import annotations

import math

import torch

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import (
    Patches,
    box,
    frames_along,
    join,
    resample,
    revolution,
    sheet,
    steps,
    to_cloud,
    tube,
)
from gaussian_swaying.scenes.plant_parts import bezier

RED, CREAM, DARK = (0.72, 0.10, 0.09), (0.90, 0.87, 0.80), (0.13, 0.13, 0.14)


def telephone(spacing: float = 0.004, count: int = 16) -> GaussianCloud:
    """A red telephone on a tiled wall, z up, seen from -y. The handset is off the hook and hangs on a coiled cord.

    The wall is the plane y = 0.10 m; the telephone ends at z = 0. The cord hangs below it to z = -0.37 m, and the
    handset hangs from the cord to z = -0.81 m.

    Args:
        spacing: Distance between Gaussians along the cord [m]; elsewhere at least 8 mm.
    """
    coarse = min(max(spacing, 0.008), 0.04)
    parts = [_wall(coarse), *_body(coarse), *handset(coarse), cord(spacing, count)]
    return to_cloud(join(parts), overlap=0.5, two_sided=False)


def cord(spacing: float, turns: int) -> Patches:
    """The coiled cord, straight for some centimetres at its ends; spacing [m]."""
    hang = bezier([[-0.03, 0.01, 0.01], [-0.05, -0.02, -0.10], [-0.10, -0.06, -0.24], [-0.10, -0.06, -0.37]], 121)
    count = 20 * turns + 1
    line = resample(hang, count)
    axes = frames_along(line)
    share = torch.linspace(0, 1, count, dtype=torch.float64)
    coil = 0.022 * ((share - 0.06) / 0.08).clamp(0, 1) * ((0.94 - share) / 0.08).clamp(0, 1)
    angle = 2 * math.pi * turns * share
    path = line + coil[:, None] * (angle.cos()[:, None] * axes[..., 0] + angle.sin()[:, None] * axes[..., 1])
    return tube(path, torch.full((count,), 0.006), spacing, DARK)


def _wall(h: float) -> Patches:
    def surface(v: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
        return torch.stack([-1.82 + 3.64 * u, torch.full_like(u, 0.10), -1.30 + 2.34 * v], dim=-1)

    wall = sheet(surface, steps(2.34, 2 * h), steps(3.64, 2 * h), (0.78, 0.80, 0.74))
    line = ((wall.center[:, 2] + 1.30) % 0.26 < 2 * h) | ((wall.center[:, 0] + 1.82) % 0.26 < 2 * h)
    return wall.painted((0.66, 0.68, 0.62), line)  # tiles


def _body(h: float) -> list[Patches]:
    parts = [box((-0.09, -0.04, 0.0), (0.21, 0.10, 0.42), h, RED)]
    parts.append(box((-0.05, -0.052, 0.03), (0.17, -0.04, 0.27), h, CREAM))
    parts.append(box((-0.03, -0.055, 0.31), (0.15, -0.04, 0.38), h, DARK))
    for row in range(4):
        for column in range(3):
            x, z = -0.018 + 0.078 * column, 0.058 + 0.052 * row
            parts.append(box((x - 0.022, -0.064, z - 0.016), (x + 0.022, -0.052, z + 0.016), h, DARK))
    parts.append(box((-0.26, -0.02, 0.24), (-0.09, 0.02, 0.28), h, DARK))  # the hook
    return parts


def handset(h: float) -> list[Patches]:
    """The handset, upside down, its cups half turned away from the wall; ``h`` is the spacing [m]."""
    grip = bezier([[0.0, -0.04, -0.20], [0.0, 0.05, -0.12], [0.0, 0.05, 0.12], [0.0, -0.04, 0.20]], 33)
    parts = [tube(grip, torch.full((33,), 0.024), h, RED)]
    # the cups are solids of revolution laid on their side
    cup = revolution(
        [[0.0, -0.05], [0.030, -0.045], [0.048, -0.02], [0.050, 0.02], [0.044, 0.03], [0.0, 0.032]], h, RED
    )
    lying = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
    parts += [cup.mapped(lying, (0.0, -0.03, z)).painted(RED) for z in (-0.185, 0.185)]
    turn, lean = math.radians(55.0), math.radians(4.0)
    about_z = [[math.cos(turn), -math.sin(turn), 0.0], [math.sin(turn), math.cos(turn), 0.0], [0.0, 0.0, 1.0]]
    about_y = [[math.cos(lean), 0.0, math.sin(lean)], [0.0, 1.0, 0.0], [-math.sin(lean), 0.0, math.cos(lean)]]
    matrix = torch.tensor(about_y, dtype=torch.float64) @ torch.tensor(about_z, dtype=torch.float64)
    return [part.mapped(matrix, (-0.11, -0.06, -0.57)) for part in parts]
