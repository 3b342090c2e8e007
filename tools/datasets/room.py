"""A still room around what is filmed: walls, a ground and boxes, the same for Blender and as a splat.

All surfaces have the print of the cloth, larger and paler, so that a camera can be followed in front of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.scenes.patches import Patches, join, sheet, to_cloud
from gaussian_swaying.scenes.printed_cloth import PERIOD, printed_colours

LARGER = 2.0
"""How much larger the print is than on cloth, for something that is 1 m long."""
PALE = 0.55
"""Share of grey that is mixed into the print."""
OVERLAP = 0.6
"""Standard deviation of a Gaussian per its distance to the next one: little is seen through."""
TEXELS = 800
"""Texels along a period of the print."""

Square = tuple[np.ndarray, np.ndarray, np.ndarray]
"""A surface: its corner, and its sides as vectors [m]; the outside is that of their cross product."""


def squares(low: np.ndarray, high: np.ndarray, ground: float) -> list[Square]:
    """The room around a motion that stays between two corners: two walls, the ground, and three boxes.

    Units: ``low``, ``ground`` [m].
    """
    size = float((high - low).max())
    left, back = low[0] - 0.9 * size, high[1] + 0.35 * size
    corner, x, y, z = np.array([left, back, ground]), *np.eye(3) * size
    found = [
        (corner, 7 * x, 5 * z),
        (corner - 6 * y, 6 * y, 5 * z),
        (corner - 6 * y, 7 * x, 6 * y),
    ]
    middle = 0.5 * (low[0] + high[0])
    for across, depth, side, height in ((-0.75, 0.3, 0.3, 0.45), (0.45, 0.42, 0.38, 0.25), (-0.1, 0.35, 0.25, 0.7)):
        at = np.array([middle + across * size, back - depth * size, ground])
        found += block(at, at + size * np.array([side, 0.8 * depth, height]))
    return found


def block(low: np.ndarray | Sequence[float], high: np.ndarray | Sequence[float]) -> list[Square]:
    """The sides and the top of an upright box between two corners [m]."""
    corner = np.asarray(low, dtype=float)
    x, y, z = np.diag(np.asarray(high, dtype=float) - corner)
    return [
        (corner, x, z),
        (corner + x, y, z),
        (corner + x + y, -x, z),
        (corner + y, -y, z),
        (corner + z, x, y),
    ]


def tile(texels: int = TEXELS) -> np.ndarray:
    """A period of the print as an image in 0 to 1, upper row first, shape (T, T, 3), float32."""
    step = (torch.arange(texels) + 0.5) * (PERIOD / texels)
    v, u = torch.meshgrid(step.flip(0), step, indexing="ij")
    return _print(u, v).float().numpy()


def mesh(room: Sequence[Square], size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The surfaces for Blender: corners [m], squares of them, and places on :func:`tile`, which repeats.

    Units: ``size`` [m].

    Returns:
        Shapes (4 S, 3), (S, 4) and (4 S, 2).
    """
    corners = np.concatenate([[c, c + a, c + a + b, c + b] for c, a, b in room])
    places = np.concatenate([_places(k, *np.array([[0, 0], [1, 0], [1, 1], [0, 1]]).T, *sides[1:], size)
                             for k, sides in enumerate(room)])  # fmt: skip
    return corners, np.arange(len(corners)).reshape(-1, 4), places / PERIOD


def splat(room: Sequence[Square], size: float, spacing: float, light: Sequence[float], ambient: float) -> GaussianCloud:
    """The surfaces as flat Gaussians, with the light of two lamps in opposite directions, but without shadows.

    Units: ``size``, ``spacing`` [m].
    """
    patches = join([_patches(k, *sides, size, spacing) for k, sides in enumerate(room)])
    way = torch.tensor(light, dtype=torch.float64)
    lit = ambient + (1 - ambient) * (patches.normal @ (way / way.norm())).abs()
    return to_cloud(patches.painted(patches.colour * lit[:, None]), OVERLAP, ambient=1.0)


def _patches(number: int, corner: np.ndarray, a: np.ndarray, b: np.ndarray, size: float, spacing: float) -> Patches:
    columns, rows = (max(1, round(float(np.linalg.norm(side)) / spacing)) for side in (a, b))
    c, a_, b_ = (torch.from_numpy(np.asarray(part, dtype=float)) for part in (corner, a, b))
    patches = sheet(lambda v, u: c + u[..., None] * a_ + v[..., None] * b_, rows, columns)
    v, u = np.divmod(np.arange(rows * columns), columns)
    places = torch.from_numpy(_places(number, (u + 0.5) / columns, (v + 0.5) / rows, a, b, size))
    return patches.painted(_print(*places.T))


def _places(number: int, u: np.ndarray, v: np.ndarray, a: np.ndarray, b: np.ndarray, size: float) -> np.ndarray:
    """Places on the print [m], shape (P, 2), of places in 0 to 1 on a surface; each surface has its own part of it."""
    sides = np.stack([u * np.linalg.norm(a), v * np.linalg.norm(b)], -1)
    return sides / (LARGER * size) + 0.37 * number * np.array([1.0, 0.6])


def _print(u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    return (1 - PALE) * printed_colours(u, v) + PALE * 0.55
