"""Cloths that touch something."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import Patches, box, ellipsoid, join, sheet, steps, to_cloud, tube
from gaussian_swaying.scenes.stage import cast, floor

RED, BLUE, WHITE, WOOD, STEEL = (
    (0.75, 0.18, 0.15),
    (0.16, 0.30, 0.62),
    (0.9, 0.88, 0.84),
    (0.58, 0.42, 0.28),
    (0.5,) * 3,
)
GROUND = (0.52, 0.54, 0.55)


def cloths(
    setting: Literal["ball", "table", "drop", "flags"], spacing: float = 0.0125, size: float = 1.2
) -> GaussianCloud:
    """A cloth above a ball or a table or under a ball, or two flags in metres. The floor is z = 0.

    The cloths come first, so a configuration can select them by their height or place.

    Args:
        setting: ``ball`` (radius 0.3 m, centre 0.35 m high, the cloth 0.68 m high), ``table`` (1 x 0.7 m, 0.5 m high,
            the cloth at 0.58 m), ``drop`` (the cloth in a frame, 0.5 m high, and a ball of radius 0.15 m, centre 0.95 m
            high, to fall onto it) or ``flags`` (poles at x = 0, y = 0 and at x = 0.45 m, y = 0.16 m).
        spacing: Distance between Gaussians [m].
        size: Sides of the cloth [m]: of a flag, its length along x; it is two thirds as high.
    """
    made = {"ball": _ball, "table": _table, "drop": _drop, "flags": _flags}
    moving, rest = made[setting](size, spacing)
    shadows = [cast([0.0, 0.0, 0.3], 0.35, 0.3)] if setting != "flags" else []
    ground = floor(0.04, GROUND, shadows, flat=1.5)
    return to_cloud(join([*moving, *rest, ground]))


def _cloth(side: float, spacing: float, height: float, colour: tuple[float, ...]) -> Patches:
    count = steps(side, spacing)

    def level(v: Tensor, u: Tensor) -> Tensor:
        return torch.stack([side * (u - 0.5), side * (v - 0.5), torch.full_like(u, height)], dim=-1)

    cloth = sheet(level, count, count, colour)
    square = (cloth.center[:, :2] / 0.15).floor().sum(-1) % 2 == 0
    return cloth.painted(WHITE, square)


def _ball(side: float, spacing: float) -> tuple[list[Patches], list[Patches]]:
    return [_cloth(side, spacing, 0.68, RED)], [ellipsoid([0, 0, 0.35], [0.3] * 3, 0.02, STEEL)]


def _table(side: float, spacing: float) -> tuple[list[Patches], list[Patches]]:
    top = box([-0.5, -0.35, 0.44], [0.5, 0.35, 0.5], 0.02, WOOD)
    legs = [box([x, y, 0.0], [x + 0.06, y + 0.06, 0.44], 0.02, WOOD) for x in (-0.5, 0.44) for y in (-0.35, 0.29)]
    return [_cloth(side, spacing, 0.58, BLUE)], [top, *legs]


def _drop(side: float, spacing: float) -> tuple[list[Patches], list[Patches]]:
    ball = ellipsoid([0, 0, 0.95], [0.15] * 3, spacing, BLUE)
    ball = ball.painted(WHITE, (ball.center[:, 2] - 0.95).abs() < 0.04)
    a = 0.5 * side
    corners = [[-a, -a], [a, -a], [a, a], [-a, a]]
    bars = [
        tube([[*one, 0.5], [*other, 0.5]], [0.014, 0.014], 0.012, WOOD)
        for one, other in zip(corners, [*corners[1:], corners[0]], strict=True)
    ]
    posts = [tube([[*corner, 0.0], [*corner, 0.5]], [0.016, 0.016], 0.012, WOOD) for corner in corners]
    return [_cloth(side, spacing, 0.5, RED), ball], [*bars, *posts]


def _flags(side: float, spacing: float) -> tuple[list[Patches], list[Patches]]:
    high = 2 / 3 * side
    rows, columns = steps(high, spacing), steps(side, spacing)
    flags, poles = [], []
    for x, y, colour in ((0.0, 0.0, RED), (0.45, 0.16, BLUE)):

        def upright(v: Tensor, u: Tensor, x: float = x, y: float = y) -> Tensor:
            return torch.stack([x + side * u, torch.full_like(u, y), 0.7 + high * v], dim=-1)

        flag = sheet(upright, rows, columns, colour)
        stripe = (flag.center[:, 2] - 0.7) / high
        flags.append(flag.painted(WHITE, (stripe > 1 / 3) & (stripe < 2 / 3)))
        poles.append(tube([[x - 0.024, y, 0.0], [x - 0.024, y, 0.75 + high]], [0.016, 0.016], 0.012, STEEL))
    return flags, poles
