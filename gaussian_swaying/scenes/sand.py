"""A bear of sand."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import Patches, join, to_cloud
from gaussian_swaying.scenes.plant_parts import Draw
from gaussian_swaying.scenes.stage import floor

# mounds (x, y, foot radius, stretch along x, stretch along y, height of the foot) [m]: belly, head, muzzle, ears, arms,
# legs; the bear lies on its back with its head towards +y
MOUNDS = (
    (0.00, 0.00, 0.48, 1.0, 1.20, 0.0),
    (0.00, 0.80, 0.42, 1.1, 1.0, 0.0),
    (0.00, 0.72, 0.15, 1.15, 1.0, 0.125),
    (-0.36, 1.14, 0.19, 1.0, 1.0, 0.0),
    (0.36, 1.14, 0.19, 1.0, 1.0, 0.0),
    (-0.62, 0.26, 0.22, 1.45, 1.0, 0.0),
    (0.62, 0.26, 0.22, 1.45, 1.0, 0.0),
    (-0.42, -0.68, 0.27, 1.0, 1.30, 0.0),
    (0.42, -0.68, 0.27, 1.0, 1.30, 0.0),
)


SLOPE = 28.0  # degrees; sand with a friction angle of 30 degrees rests below that
OPEN = 3  # layers of grains that the wind reaches: they share the area of the surface


def bear_height(x: Tensor, y: Tensor) -> Tensor:
    """Height of the surface over the beach [m], zero outside the bear; x and y of the same shape."""
    rise, tip = math.tan(math.radians(SLOPE)), 0.10  # a tip this round
    top = torch.zeros_like(x)
    for cx, cy, foot, ex, ey, base in MOUNDS:
        r = torch.hypot((x - cx) / ex, (y - cy) / ey)
        mound = base + rise * (math.hypot(foot, tip) - torch.hypot(r, torch.full_like(r, tip)))
        top = torch.maximum(top, torch.where(mound > base, mound, top))
    return top


def sand_bear(spacing: float = 0.013, interior: bool = True) -> GaussianCloud:
    """A bear of sand lying on a beach, 2.3 m from head to foot, z up, the bear on z = 0.

    Dry sand has no cohesion, so the bear is made of mounds (:data:`MOUNDS`) that are nowhere steeper than
    :data:`SLOPE` and stand by themselves. It is solid. The wind reaches :data:`OPEN` layers of grains, which share the
    area of the surface. So where the wind has blown grains away, there are more. Deeper grains are specks on a lattice,
    too small to be seen or to feel the wind.

    Args:
        spacing: Distance between Gaussians [m], on the surface and inside.
    """
    h, draw = spacing, Draw()
    xs = torch.arange(-1.05, 1.05, h, dtype=torch.float64) + 0.5 * h
    ys = torch.arange(-1.10, 1.40, h, dtype=torch.float64) + 0.5 * h
    x, y = (part.reshape(-1) for part in torch.meshgrid(xs, ys, indexing="ij"))
    x, y = x + h * draw.uniform(-0.2, 0.2, len(x)), y + h * draw.uniform(-0.2, 0.2, len(y))
    z = bear_height(x, y)
    on = z > 0.25 * h
    x, y, z = x[on], y[on], z[on]
    step = 1e-3 * h
    zx = (bear_height(x + step, y) - bear_height(x - step, y)) / (2 * step)
    zy = (bear_height(x, y + step) - bear_height(x, y - step)) / (2 * step)
    one, nil = torch.ones_like(x), torch.zeros_like(x)
    colour = torch.tensor([0.86, 0.70, 0.46], dtype=torch.float64) * (1 + 0.08 * draw.normal(len(x), 1))
    g = h / math.sqrt(OPEN)  # a grain's share of the surface
    across, along = g * torch.stack([one, nil, zx], -1), g * torch.stack([nil, one, zy], -1)
    skin = Patches(torch.stack([x, y, z], -1), across, along, colour)
    skin = skin.painted(0.82 * colour, _in(x, y, 0.0, 0.02, 0.30))  # the damp belly
    skin = skin.painted((0.16, 0.11, 0.08), _in(x, y, 0.0, 0.72, 0.065))
    for side in (-1, 1):
        skin = skin.painted((0.13, 0.10, 0.08), _in(x, y, 0.17 * side, 0.93, 0.05))
        skin = skin.painted(0.75 * colour, _in(x, y, 0.36 * side, 1.14, 0.09))
        skin = skin.painted(0.75 * colour, _in(x, y, 0.42 * side, -0.76, 0.12))
    step = min(max(h, 0.03), 0.12)
    beach = floor(step, (0.66, 0.55, 0.39), flat=2.2, fade=(3.0, 9.0), ambient=0.35)
    # slightly below, or it would cover the grains on it: Gaussians are drawn in the order of their centres
    parts = [skin, beach.mapped(shift=(0.0, 0.1, -1.6 * step))]
    if interior:
        layers = torch.arange(int(float(z.max()) / h) + 1, dtype=torch.float64) * h + 0.5 * h
        column, level = torch.meshgrid(torch.arange(len(x)), torch.arange(len(layers)), indexing="ij")
        inside = layers[level] < z[column] - 0.9 * h
        column, level = column[inside], level[inside]
        center = torch.stack([x[column], y[column], layers[level]], -1)
        center[:, :2] += 0.5 * h * (level % 2)[:, None]  # between the grains of the layers above and below
        near = (z[column] - layers[level] < (OPEN - 0.1) * h)[:, None]
        edge = torch.where(near, g, 0.02 * h).double()
        along_x, along_y = torch.eye(3, dtype=torch.float64)[:2]
        shade = torch.tensor([0.80, 0.64, 0.41], dtype=torch.float64) * (1 + 0.10 * draw.normal(len(center), 1))
        parts.append(Patches(center, edge * along_x, edge * along_y, shade))
    return to_cloud(join(parts), overlap=0.55, ambient=0.35, two_sided=False)


def _in(x: Tensor, y: Tensor, cx: float, cy: float, radius: float) -> Tensor:
    return torch.hypot(x - cx, y - cy) < radius
