"""A wall telephone with its handset on a coiled cord."""

from __future__ import annotations

import math

import torch

from gaussian_swaying._checks import check_positive
from gaussian_swaying.data.procedural import ProceduralScene
from gaussian_swaying.data.scenes.patches import (
    Patches,
    box,
    check_spacing,
    frames_along,
    join,
    resample,
    revolution,
    sheet,
    steps,
    to_cloud,
    tube,
)
from gaussian_swaying.data.scenes.plant_parts import bezier
from gaussian_swaying.gaussians.ply import GaussianCloud

RED, CREAM, DARK = (0.72, 0.10, 0.09), (0.90, 0.87, 0.80), (0.13, 0.13, 0.14)


class TelephoneScene(ProceduralScene):
    """A red telephone on a wall, z up, seen from -y: the handset on its hook, and a coiled cord that hangs in a loop.

    The wall is the plane y = 0.10 m; telephone and handset end at z = 0 and the cord hangs below, to z = -0.5 m.

    Args:
        spacing: Distance between Gaussians along the cord [m]; elsewhere at least 8 mm.
        turns: Turns of the coil.
    """

    def __init__(self, spacing: float = 0.004, turns: int = 46) -> None:
        self.spacing = check_spacing(spacing, 0.2)
        check_positive("generator.turns", turns)
        self.turns = int(turns)

    def generate(self) -> GaussianCloud:
        """Make the telephone."""
        h = self.spacing
        coarse = min(max(h, 0.008), 0.04)
        parts = [self._wall(coarse), *self._body(coarse), *self._handset(coarse), self.cord()]
        return to_cloud(join(parts), overlap=0.5, two_sided=False)

    def cord(self) -> Patches:
        """The coiled cord: straight for 3 cm at its ends."""
        loop = bezier([[-0.19, -0.05, 0.01], [-0.24, -0.07, -0.72], [0.16, -0.08, -0.72], [0.10, 0.0, 0.01]], 121)
        count = 16 * self.turns + 1
        line = resample(loop, count)
        axes = frames_along(line)
        share = torch.linspace(0, 1, count, dtype=torch.float64)
        coil = 0.016 * ((share - 0.04) / 0.04).clamp(0, 1) * ((0.96 - share) / 0.04).clamp(0, 1)
        angle = 2 * math.pi * self.turns * share
        path = line + coil[:, None] * (angle.cos()[:, None] * axes[..., 0] + angle.sin()[:, None] * axes[..., 1])
        return tube(path, torch.full((count,), 0.0045), self.spacing, DARK)

    def _wall(self, h: float) -> Patches:
        def surface(v: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
            return torch.stack([-1.3 + 2.6 * u, torch.full_like(u, 0.10), -0.91 + 1.69 * v], dim=-1)

        wall = sheet(surface, steps(1.69, 2 * h), steps(2.6, 2 * h), (0.78, 0.80, 0.74))
        line = ((wall.center[:, 2] + 0.91) % 0.26 < 2 * h) | ((wall.center[:, 0] + 1.3) % 0.26 < 2 * h)
        return wall.painted((0.66, 0.68, 0.62), line)  # tiles

    def _body(self, h: float) -> list[Patches]:
        parts = [box((-0.09, -0.04, 0.0), (0.21, 0.10, 0.42), h, RED)]
        parts.append(box((-0.05, -0.052, 0.03), (0.17, -0.04, 0.27), h, CREAM))
        parts.append(box((-0.03, -0.055, 0.31), (0.15, -0.04, 0.38), h, DARK))
        for row in range(4):
            for column in range(3):
                x, z = -0.018 + 0.078 * column, 0.058 + 0.052 * row
                parts.append(box((x - 0.022, -0.064, z - 0.016), (x + 0.022, -0.052, z + 0.016), h, DARK))
        parts.append(box((-0.26, -0.02, 0.24), (-0.09, 0.02, 0.28), h, DARK))  # the hook
        return parts

    def _handset(self, h: float) -> list[Patches]:
        grip = bezier([[-0.19, -0.03, 0.02], [-0.19, -0.11, 0.10], [-0.19, -0.11, 0.36], [-0.19, -0.03, 0.42]], 33)
        parts = [tube(grip, torch.full((33,), 0.024), h, RED)]
        # the cups open towards the wall: solids of revolution laid on their side
        cup = revolution(
            [[0.0, -0.05], [0.030, -0.045], [0.048, -0.02], [0.050, 0.02], [0.044, 0.03], [0.0, 0.032]], h, RED
        )
        lying = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], dtype=torch.float64)
        parts += [cup.mapped(lying, (-0.19, -0.04, z)) for z in (0.035, 0.405)]
        return parts
