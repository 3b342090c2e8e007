"""Captures of a place, made in code: a plant in a pot, on a ground between hedges, with haze far away."""

from __future__ import annotations

import math

import torch
from shared import unit
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.alocasia import alocasia

SHARES = {"ground": 0.40, "hedges": 0.42, "haze": 0.14}
"""Shares of the Gaussians; the plant and its pot are the rest."""

GROUND, HEDGE, FAR = 6.0, (4.0, 5.0, 1.3), (12.0, 40.0)
"""Half the side of the ground; where hedges begin and end, and their height; distances of the haze [m]."""


def place(count: int, seed: int = 0, sh_degree: int = 3) -> tuple[GaussianCloud, Tensor]:
    """A capture of a place with y down, as COLMAP has it, 0.4 scene units to a metre.

    Returns:
        The Gaussians in random order, and which of them are the plant and its pot, shape (count,).
    """
    draw = torch.Generator().manual_seed(seed)

    def uniform(n: int, *ends: tuple[float, float]) -> Tensor:
        low, high = torch.tensor(ends).T
        return low + (high - low) * torch.rand(n, len(ends), generator=draw)

    sizes = {name: round(share * count) for name, share in SHARES.items()}
    plant = _plant(count - sum(sizes.values()))
    sizes["ground"] += count - sum(sizes.values()) - len(plant)  # of the plant, as many as its growth gives

    n = sizes["ground"]
    means = uniform(n, (-GROUND, GROUND), (-GROUND, GROUND), (-0.012, 0.0))
    tint = 0.85 + 0.3 * torch.rand(n, 1, generator=draw)
    side = 2 * GROUND / math.sqrt(n)
    flat = torch.tensor([0.7 * side, 0.7 * side, 0.1 * side]).log().expand(n, 3)
    parts = [_cloud(means, _about_z(n, draw), flat, 0.9, tint * torch.tensor([0.42, 0.36, 0.28]))]

    n = sizes["hedges"]  # on three sides
    along, across = uniform(n, (-HEDGE[1], HEDGE[1]), (HEDGE[0], HEDGE[1])).T
    wall = torch.randint(3, (n,), generator=draw)[:, None]
    flank = torch.where(wall == 0, torch.stack([along, across], -1), torch.stack([across, along], -1))
    flank = torch.where(wall == 2, -flank, flank)
    means = torch.cat([flank, uniform(n, (0.0, HEDGE[2]))], -1)
    tint = 0.6 + 0.8 * torch.rand(n, 1, generator=draw)
    leaf = torch.tensor([0.02, 0.012, 0.002]).log().expand(n, 3)
    parts.append(_cloud(means, torch.randn(n, 4, generator=draw), leaf, 0.8, tint * torch.tensor([0.20, 0.38, 0.14])))

    n = sizes["haze"]
    way = unit(n, 3, generator=draw, dtype=torch.float32)
    way[:, 2] = way[:, 2].abs()
    means = way * uniform(n, FAR)
    tint = torch.tensor([0.62, 0.72, 0.86]) + 0.1 * torch.randn(n, 1, generator=draw)
    parts.append(_cloud(means, torch.randn(n, 4, generator=draw), torch.full((n, 3), math.log(0.5)), 0.3, tint))

    parts.append(plant)
    fields = {
        name: torch.cat([getattr(part, name) for part in parts])
        for name in ("means", "quats", "scales", "opacities", "sh")
    }
    mine = torch.zeros(count, dtype=torch.bool)
    mine[-len(plant) :] = True
    order = torch.randperm(count, generator=draw)
    rest = 0.02 * torch.randn(count, (sh_degree + 1) ** 2 - 1, 3, generator=draw)
    cloud = GaussianCloud(**(fields | {"sh": torch.cat([fields["sh"], rest], 1)})).select(order)
    return _turned(cloud), mine[order]


def _plant(count: int) -> GaussianCloud:
    spacing = 0.02
    for _ in range(4):
        cloud = alocasia(spacing=spacing)
        cloud = cloud.select((cloud.means[:, 2] > 0.004) | (cloud.means[:, :2].norm(dim=-1) < 0.05))
        if len(cloud) > 0.9 * count:
            break
        spacing *= math.sqrt(len(cloud) / count)
    return GaussianCloud(cloud.means, cloud.quats, cloud.scales, cloud.opacities, cloud.sh[:, :1])


def _about_z(n: int, draw: torch.Generator) -> Tensor:
    """Rotations about z, nearly, as quaternions (n, 4)."""
    angle = math.pi * torch.rand(n, generator=draw)
    quats = torch.stack([angle.cos(), angle * 0, angle * 0, angle.sin()], -1)
    return quats + 0.03 * torch.randn(n, 4, generator=draw)


def _cloud(means: Tensor, quats: Tensor, scales: Tensor, opacity: float, colour: Tensor) -> GaussianCloud:
    """Gaussians of one opacity, with colours (n, 3)."""
    logits = torch.full((len(means),), math.log(opacity / (1 - opacity)))
    return GaussianCloud(means, quats, scales, logits, ((colour - 0.5) / 0.28209479177387814)[:, None])


def _turned(cloud: GaussianCloud) -> GaussianCloud:
    """From metres with z up to scene units with y down."""
    x, y, z = cloud.means.unbind(-1)
    w, i, j, k = cloud.quats.unbind(-1)
    h = math.sqrt(0.5)  # a quarter turn about x: y becomes -z, and z becomes y
    quats = torch.stack([h * (w - i), h * (i + w), h * (j - k), h * (k + j)], -1)
    means = 0.4 * torch.stack([x, -z, y], -1)
    return GaussianCloud(means, quats, cloud.scales + math.log(0.4), cloud.opacities, cloud.sh)
