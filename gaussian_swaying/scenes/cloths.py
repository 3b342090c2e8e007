"""Cloths that touch something."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import Patches, box, ellipsoid, join, sheet, steps, to_cloud, tube
from gaussian_swaying.scenes.procedural import ProceduralScene
from gaussian_swaying.scenes.stage import cast, floor

RED, BLUE, WHITE, WOOD, STEEL = (
    (0.75, 0.18, 0.15),
    (0.16, 0.30, 0.62),
    (0.9, 0.88, 0.84),
    (0.58, 0.42, 0.28),
    (0.5,) * 3,
)
GROUND = (0.52, 0.54, 0.55)


@dataclass(eq=False)
class ClothScene(ProceduralScene):
    """A cloth above a ball or a table or under a ball, or two flags in metres. The floor is z = 0.

    The cloths come first, so a configuration can select them by their height or place.

    Args:
        setting: ``ball`` (radius 0.3 m, centre 0.35 m high, the cloth 0.68 m high), ``table`` (1 x 0.7 m, 0.5 m high,
            the cloth at 0.58 m), ``drop`` (the cloth in a frame, 0.5 m high, and a ball of radius 0.15 m, centre 0.95 m
            high, to fall onto it) or ``flags`` (poles at x = 0, y = 0 and at x = 0.45 m, y = 0.16 m).
        side: Sides of the cloth [m]: of a flag, its length along x; it is two thirds as high.
        spacing: Distance between Gaussians [m].
    """

    setting: Literal["ball", "table", "drop", "flags"] = "ball"
    side: float = 1.2
    spacing: float = 0.0125

    def __post_init__(self) -> None:
        self.check("side")

    def generate(self) -> GaussianCloud:
        made = {"ball": self._ball, "table": self._table, "drop": self._drop, "flags": self._flags}
        cloths, rest = made[self.setting]()
        shadows = [cast([0.0, 0.0, 0.3], 0.35, 0.3)] if self.setting != "flags" else []
        ground = floor(0.04, GROUND, shadows, flat=1.5)
        return to_cloud(join([*cloths, *rest, ground]))

    def _cloth(self, height: float, colour: tuple[float, ...]) -> Patches:
        count = steps(self.side, self.spacing)

        def level(v: Tensor, u: Tensor) -> Tensor:
            return torch.stack([self.side * (u - 0.5), self.side * (v - 0.5), torch.full_like(u, height)], dim=-1)

        cloth = sheet(level, count, count, colour)
        square = (cloth.center[:, :2] / 0.15).floor().sum(-1) % 2 == 0
        return cloth.painted(WHITE, square)

    def _ball(self) -> tuple[list[Patches], list[Patches]]:
        return [self._cloth(0.68, RED)], [ellipsoid([0, 0, 0.35], [0.3] * 3, 0.02, STEEL)]

    def _table(self) -> tuple[list[Patches], list[Patches]]:
        top = box([-0.5, -0.35, 0.44], [0.5, 0.35, 0.5], 0.02, WOOD)
        legs = [box([x, y, 0.0], [x + 0.06, y + 0.06, 0.44], 0.02, WOOD) for x in (-0.5, 0.44) for y in (-0.35, 0.29)]
        return [self._cloth(0.58, BLUE)], [top, *legs]

    def _drop(self) -> tuple[list[Patches], list[Patches]]:
        ball = ellipsoid([0, 0, 0.95], [0.15] * 3, self.spacing, BLUE)
        ball = ball.painted(WHITE, (ball.center[:, 2] - 0.95).abs() < 0.04)
        a = 0.5 * self.side
        corners = [[-a, -a], [a, -a], [a, a], [-a, a]]
        bars = [
            tube([[*one, 0.5], [*other, 0.5]], [0.014, 0.014], 0.012, WOOD)
            for one, other in zip(corners, [*corners[1:], corners[0]], strict=True)
        ]
        posts = [tube([[*corner, 0.0], [*corner, 0.5]], [0.016, 0.016], 0.012, WOOD) for corner in corners]
        return [self._cloth(0.5, RED), ball], [*bars, *posts]

    def _flags(self) -> tuple[list[Patches], list[Patches]]:
        high = 2 / 3 * self.side
        rows, columns = steps(high, self.spacing), steps(self.side, self.spacing)
        flags, poles = [], []
        for x, y, colour in ((0.0, 0.0, RED), (0.45, 0.16, BLUE)):

            def upright(v: Tensor, u: Tensor, x: float = x, y: float = y) -> Tensor:
                return torch.stack([x + self.side * u, torch.full_like(u, y), 0.7 + high * v], dim=-1)

            flag = sheet(upright, rows, columns, colour)
            stripe = (flag.center[:, 2] - 0.7) / high
            flags.append(flag.painted(WHITE, (stripe > 1 / 3) & (stripe < 2 / 3)))
            poles.append(tube([[x - 0.024, y, 0.0], [x - 0.024, y, 0.75 + high]], [0.016, 0.016], 0.012, STEEL))
        return flags, poles
