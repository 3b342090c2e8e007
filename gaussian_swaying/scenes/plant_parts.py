"""Parts of the generated plants: leaves, pots and seeded random numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.scenes.patches import Patches, disc, join, quads, revolution, steps


class Draw:
    """Random numbers of one scene, the same on every machine."""

    def __init__(self) -> None:
        self.generator = torch.Generator().manual_seed(0)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Uniform numbers of a shape, float64."""
        return low + (high - low) * torch.rand(*shape, generator=self.generator, dtype=torch.float64)

    def normal(self, *shape: int) -> Tensor:
        """Standard normal numbers of a shape, float64."""
        return torch.randn(*shape, generator=self.generator, dtype=torch.float64)


def leaf(
    length: float,
    width: float,
    spacing: float,
    *,
    taper: tuple[float, float] = (0.55, 0.85),
    droop: float = 0.25,
    fold: float = 0.15,
    colour: Sequence[float] = (0.2, 0.4, 0.12),
    vein: Sequence[float] = (0.45, 0.6, 0.3),
    veins: int = 0,
) -> Patches:
    """A leaf blade from the origin along +y, its upper side towards +z.

    Its width at the share s of the length is proportional to ``s^p (1 - s)^q``, the largest being ``width``.

    Args:
        length: Length [m].
        width: Largest width [m].
        spacing: Distance between Gaussians [m]; a leaf has at least one Gaussian.
        droop: Distance of the tip below the plane, as a share of the length.
        fold: Height of the rim above the midrib, as a share of the half width.
    """
    p, q = taper
    fine = torch.linspace(0, 1, 513, dtype=torch.float64)
    shape = fine**p * (1 - fine) ** q
    shape = shape * (width / shape.max())
    rows = steps(length, spacing)
    edge = torch.linspace(0, 1, rows + 1, dtype=torch.float64)
    # rows as wide as the blade on average, so that their areas add up to the blade's
    sums = torch.cat([fine.new_zeros(1), (0.5 * (shape[1:] + shape[:-1])).cumsum(0)]) / 512
    at = (edge * 512).round().long()
    widths = (sums[at[1:]] - sums[at[:-1]]) / ((at[1:] - at[:-1]) / 512)
    columns = steps(float(widths.mean()), spacing)
    t = torch.linspace(-1, 1, columns + 1, dtype=torch.float64)
    s = torch.stack([edge[:-1], edge[1:]], dim=1)[:, :, None].expand(rows, 2, columns + 1)
    x = 0.5 * widths[:, None, None] * t.expand(rows, 2, columns + 1)
    z = fold * x.abs() - droop * length * s**2
    corners = torch.stack([x, length * s, z], dim=-1)
    patches = quads(corners, colour)
    if columns > 2:
        middle = t.new_tensor(0.5) * (t[1:] + t[:-1])
        across = middle.abs().expand(rows, columns).reshape(-1)
        down = (0.5 * (edge[1:] + edge[:-1]))[:, None].expand(rows, columns).reshape(-1)
        drawn = across < 1.2 / columns
        if veins and rows > 3 * veins:
            phase = (veins * (down - 0.25 * across)) % 1
            drawn = drawn | (phase < min(0.35, 1.5 * veins / rows))
        patches = patches.painted(vein, drawn)
    return patches


def pot(
    height: float, foot: float, rim: float, spacing: float, colour: Sequence[float] = (0.72, 0.36, 0.22)
) -> Patches:
    """A flower pot on z = 0 with soil in it; its lip is a tenth of its height.

    Args:
        height: Height [m].
        foot: Radius at the bottom [m].
        rim: Radius at the top [m].
        spacing: Distance between Gaussians [m].

    Returns:
        The patches; the soil is at 0.92 of the height.
    """
    lip, wall = 1.08 * rim, 0.92 * rim
    outside = [[foot, 0.0], [0.97 * rim, 0.86 * height], [lip, 0.87 * height], [lip, height], [wall, height]]
    outside += [[wall, 0.9 * height]]
    return join(
        [
            revolution(outside, spacing, colour),
            disc((0.0, 0.0, 0.92 * height), wall, spacing, (0.22, 0.15, 0.10)),
        ]
    )


def tints(draw: Draw, count: int, spread: float = 0.18) -> Tensor:
    """Factors on the colours of leaves (count, 3): some lighter, some yellower."""
    light = 1 + spread * draw.uniform(-1, 1, count, 1)
    warm = spread * draw.uniform(-1, 1, count, 1) * torch.tensor([1.0, 0.3, -0.5], dtype=torch.float64)
    return light + warm


def bezier(points: Sequence[Sequence[float]] | Tensor, count: int = 25) -> Tensor:
    """Points (count, 3) on the Bézier curve of some control points (K, 3)."""
    control = torch.as_tensor(points, dtype=torch.float64)
    t = torch.linspace(0, 1, count, dtype=torch.float64)[:, None]
    degree = len(control) - 1
    weights = [math.comb(degree, k) * t**k * (1 - t) ** (degree - k) for k in range(degree + 1)]
    return torch.cat(weights, dim=1) @ control
