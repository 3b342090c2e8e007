"""The floor of the generated scenes, which fades into the background and has soft shadows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from gaussian_swaying.scenes.patches import LIGHT, Patches, join, revolution
from gaussian_swaying.scenes.plant_parts import Draw

SKY = (0.75, 0.82, 0.90)  # the background of these scenes
_REACH = 14.0  # radius of the floor [m]
_GROWTH = 0.07  # the width of a ring as a share of its radius, since distant rings look smaller
_OVERLAP = 1.5
Shadow = tuple[float, float, float, float]  # x, y, radius [m], and how much darker its middle is, from 0 to 1


def floor(
    spacing: float,
    colour: Sequence[float],
    shadows: Sequence[Shadow] = (),
    *,
    flat: float = 0.0,
    fade: tuple[float, float] = (1.2, 5.0),
    ambient: float = 0.45,
) -> Patches:
    """A round floor at z = 0 that faces up and fades into the colour of the sky.

    Args:
        spacing: Distance between Gaussians near the middle [m], which grows with the distance from it.
        flat: Radius within which the distance between Gaussians does not grow [m], so that none covers an object there.
        fade: Distances from the middle at which the fading starts and ends [m].
        ambient: That of :func:`~gaussian_swaying.scenes.patches.to_cloud`; the colours make up for its light at the
            horizon.
    """
    edges = [0.0]
    while edges[-1] < _REACH:
        edges.append(edges[-1] + max(spacing, _GROWTH * (edges[-1] - flat)))
    edges[-1] = max(_REACH, edges[-2] + 1e-3)
    rings = [revolution([[high, 0.0], [low, 0.0]], high - low, colour) for low, high in pairwise(edges)]
    ground = join(rings)
    x, y = ground.center[:, 0], ground.center[:, 1]
    paint = torch.tensor(colour, dtype=torch.float64) * (1 + 0.015 * Draw().normal(len(ground), 1))
    for sx, sy, radius, depth in shadows:
        near = torch.exp(-((x - sx) ** 2 + (y - sy) ** 2) / radius**2)
        paint = paint * (1 - depth * near)[:, None]
    lit = ambient + (1 - ambient) * LIGHT[2] / math.hypot(*LIGHT)
    far = ((torch.hypot(x, y) - fade[0]) / (fade[1] - fade[0])).clamp(0, 1)
    far = (far * far * (3 - 2 * far))[:, None]
    distant = torch.tensor(SKY, dtype=torch.float64) / lit
    # larger than their cells, so that the floor shows no lattice
    ground = replace(ground, across=_OVERLAP * ground.across, along=_OVERLAP * ground.along)
    return ground.painted(paint * (1 - far) + distant * far)


def cast(point: Sequence[float] | Tensor, radius: float, depth: float) -> Shadow:
    """The shadow on the floor of something round at a point (3,) [m], under the light baked into the colours."""
    x, y, z = (float(value) for value in point)
    return (x - LIGHT[0] / LIGHT[2] * z, y - LIGHT[1] / LIGHT[2] * z, radius, depth)
