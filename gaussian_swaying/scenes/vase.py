"""A vase with flowers on a cloth."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import (
    Patches,
    copies,
    ellipsoid,
    facing,
    join,
    revolution,
    sheet,
    steps,
    to_cloud,
    tube,
)
from gaussian_swaying.scenes.plant_parts import Draw, bezier, leaf, tints

PETALS = ((0.93, 0.42, 0.52), (0.97, 0.80, 0.30), (0.95, 0.93, 0.90), (0.72, 0.36, 0.70))


def vase(spacing: float = 0.004, count: int = 15) -> GaussianCloud:
    """A vase 0.30 m tall with a bunch of flowers, on a round chequered cloth, z up, the table top at z = 0.

    The mouth of the vase is at z = 0.30 m, and the flowers reach up to 0.62 m. The cloth has a radius of 0.34 m on the
    table and hangs 0.14 m over its edge.

    Args:
        spacing: Distance between Gaussians [m].
    """
    h, draw = spacing, Draw()
    profile = bezier([[0.055, 0, 0.0], [0.16, 0, 0.05], [0.13, 0, 0.20], [0.02, 0, 0.22], [0.065, 0, 0.30]])
    jar = revolution(profile[:, [0, 2]], max(h, 0.005), (0.25, 0.42, 0.62))
    band = (jar.center[:, 2] - 0.12).abs() < 0.012
    parts = [jar.painted((0.92, 0.90, 0.84), band), _cloth(max(h, 0.006))]
    for number in range(count):
        parts += _flower(h, draw, number, count)
    parts.append(_greens(h, draw, 2 * count))
    return to_cloud(join(parts))


def _cloth(h: float) -> Patches:
    """A disc on the table with a wavy hem over the edge; its squares are 7 cm."""
    table, reach = 0.34, 0.48

    def surface(v: Tensor, u: Tensor) -> Tensor:
        angle, r = 2 * math.pi * u, 0.02 + (reach - 0.02) * (1 - v)
        over = (r - table).clamp_min(0)
        wave = 0.16 * over * torch.sin(11 * angle)
        flat = r.clamp_max(table) + 0.12 * over + wave
        return torch.stack([flat * angle.cos(), flat * angle.sin(), -0.985 * over], dim=-1)

    cloth = sheet(surface, steps(reach, h), steps(2 * math.pi * 0.75 * table, h), (0.93, 0.91, 0.86))
    x, y = cloth.center[:, 0], cloth.center[:, 1]
    dark = (torch.floor(x / 0.07) + torch.floor(y / 0.07)) % 2 == 0
    return cloth.painted((0.70, 0.22, 0.20), dark)


def _flower(h: float, draw: Draw, number: int, flowers: int) -> list[Patches]:
    azimuth, lean = 2.39996 * number, math.sqrt((number + 0.5) / flowers)
    out = torch.tensor([math.cos(azimuth), math.sin(azimuth), 0.0], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    root = 0.03 * lean * out + 0.24 * up
    top = 0.20 * lean * out + (0.60 - 0.18 * lean**2 + float(draw.uniform(-0.02, 0.02, 1))) * up
    stem = bezier(torch.stack([root, 0.5 * root + 0.5 * top + 0.05 * up - 0.02 * out, top]))
    gaze = torch.nn.functional.normalize(0.9 * lean * out + up, dim=-1)
    side = torch.linalg.cross(gaze, torch.tensor([0.31, 0.17, 0.93], dtype=torch.float64))
    side = torch.nn.functional.normalize(side, dim=-1)
    other = torch.linalg.cross(gaze, side)
    petal = leaf(0.055, 0.034, h, taper=(0.7, 0.45), droop=0.25, fold=0.2, colour=PETALS[number % 4], vein=(1, 1, 1))
    petal = petal.painted(PETALS[number % 4])
    ways, tops = [], []
    for ring, (count, rise) in enumerate(((8, 0.15), (6, 0.75))):
        angle = 2 * math.pi * (torch.arange(count, dtype=torch.float64) + 0.5 * ring) / count
        spoke = angle.cos()[:, None] * side + angle.sin()[:, None] * other
        ways.append(spoke + rise * gaze)
        tops.append(gaze - rise * spoke)
    way = torch.cat(ways)
    size = torch.cat([torch.full((8,), 1.0), torch.full((6,), 0.75)]).double()
    bloom = copies(petal, facing(way, torch.cat(tops)), size, top.expand(14, 3), tints(draw, 14, 0.08))
    heart = ellipsoid((top + 0.006 * gaze).tolist(), (0.012, 0.012, 0.012), h, (0.95, 0.72, 0.15))
    return [tube(stem, torch.full((len(stem),), 0.0045), h, (0.30, 0.50, 0.20)), bloom, heart]


def _greens(spacing: float, draw: Draw, count: int) -> Patches:
    azimuth = 2.39996 * torch.arange(count, dtype=torch.float64) + 1.0
    rise = draw.uniform(0.9, 2.0, count)
    way = torch.stack([azimuth.cos(), azimuth.sin(), rise], dim=-1)
    spot = torch.stack([0.03 * azimuth.cos(), 0.03 * azimuth.sin(), draw.uniform(0.29, 0.36, count)], dim=-1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(count, 3)
    blade = leaf(0.16, 0.04, spacing, droop=0.22, colour=(0.20, 0.42, 0.18), vein=(0.42, 0.60, 0.34))
    return copies(blade, facing(way, up), draw.uniform(0.7, 1.1, count), spot, tints(draw, count))
