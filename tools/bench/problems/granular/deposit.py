"""The deposit of a column of sand: bulk, height and slope; and run-outs in experiments."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def bulk(position: Tensor, volume: Tensor, dx: float, planar: bool) -> tuple[float, Tensor, Tensor]:
    """Volume of the bulk [m³], and its thickness [m] over points of the floor at given distances [m], both (N,).

    Sampled at the centres of squares or cubes of a quarter or half a cell, bounded by floor and symmetry planes.
    """
    fine = 4 if planar else 2
    axes = (0, 2) if planar else (0, 1, 2)
    place = position.double().cpu()[:, axes] / dx * fine
    reach = torch.arange(3 * fine)
    index = (torch.floor(place - 1.5 * fine + 0.5)[..., None].long() + reach).unbind(-2)
    weight = torch.ones(len(place), 1, dtype=torch.float64)
    flat = torch.zeros(len(place), 1, dtype=torch.long)
    shape = [int(i.amax()) + 3 * fine for i in index]
    for axis, i in enumerate(index):
        away = ((i + 0.5) - place[:, axis, None]).abs() / fine
        spline = torch.where(away < 0.5, 0.75 - away.square(), 0.5 * (1.5 - away).clamp(min=0).square())
        mirrored = torch.where(i < 0, -1 - i, i)
        weight = (weight[..., None] * spline[:, None]).flatten(1)
        flat = (flat[..., None] * shape[axis] + mirrored[:, None]).flatten(1)
    part = volume.double().cpu() / dx**3
    density = torch.zeros(math.prod(shape), dtype=torch.float64)
    density.index_add_(0, flat.flatten(), (weight * part[:, None]).flatten())
    full = (density.reshape(shape) > 0.5).double()
    step = dx / fine
    thickness = full.sum(-1) * step
    ticks = [(torch.arange(n) + 0.5) * step for n in shape[:-1]]
    distance = torch.stack(torch.meshgrid(*ticks, indexing="ij")).square().sum(0).sqrt()
    area = step * (dx if planar else step)
    return float(thickness.sum()) * area, distance.flatten(), thickness.flatten()


def surface(distance: Tensor, thickness: Tensor, dx: float) -> tuple[float, float]:
    """Height of a deposit [m], and slope between 80 and 20 % of it [degrees]: means over rings half a cell wide."""
    ring = (distance / (0.5 * dx)).long()
    count = torch.zeros(int(ring.amax()) + 1, dtype=torch.float64).index_add_(0, ring, torch.ones_like(thickness))
    height = torch.zeros_like(count).index_add_(0, ring, thickness) / count.clamp(min=1)
    radius = (torch.arange(len(count)) + 0.5) * 0.5 * dx
    top = float(height.amax())
    chosen = (height < 0.8 * top) & (height > 0.2 * top)
    if int(chosen.sum()) < 2:
        return top, math.nan
    x, y = radius[chosen] - radius[chosen].mean(), height[chosen] - height[chosen].mean()
    return top, math.degrees(math.atan(-float((x * y).sum() / x.square().sum())))


def lube(aspect: float, planar: bool = True) -> float:
    """Run-out over half width or radius in the experiments of Lube et al. with sand and other grains.

    Planar: Lube et al. 2005, "Collapses of two-dimensional granular columns", 1.2 a, and 1.9 a^(2/3) where a > 2.3.
    Round: Lube et al. 2004, "Axisymmetric collapses of granular columns", 1.24 a, and 1.6 a^(1/2) where a > 1.7.
    """
    if planar:
        return 1.2 * aspect if aspect <= 2.3 else 1.9 * aspect ** (2 / 3)
    return 1.24 * aspect if aspect <= 1.7 else 1.6 * math.sqrt(aspect)


def lajeunesse(aspect: float) -> float:
    """Run-out over the radius of a round column of glass beads: a, and 2 a^(1/2) where a > 0.74.

    Lajeunesse et al. 2004, "Spreading of a granular mass on a horizontal plane".
    """
    return aspect if aspect <= 0.74 else 2 * math.sqrt(aspect)
