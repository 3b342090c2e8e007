"""How far two solutions of a flag are apart, and the variants that show how well the reference knows itself."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from flag_motion import Cloth
from flag_reference import FlagPattern, least_quality


def even_uv(pattern: FlagPattern, along: int = 80) -> np.ndarray:
    """Positions spread evenly over the flag at rest, ``along`` of them on the longer side, shape (P, 2)."""
    spacing = pattern.longer_side / along
    counts = [max(1, round(side / spacing)) for side in (pattern.width, pattern.height)]
    axes = [(np.arange(count) + 0.5) / count for count in counts]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 2)


def chamfer_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Half the sum of the mean distances from each set of points to the nearest of the other.

    Args:
        a: Points, shape (P, 3).
        b: Points, shape (Q, 3).

    Returns:
        Not squared, in the unit of the points.
    """
    import torch

    from gaussian_swaying.metrics.chamfer import chamfer_distance as between

    one, other = (torch.from_numpy(np.ascontiguousarray(points)) for points in (a, b))
    return float(between(one, other, direction="average"))


def difference(pattern: FlagPattern, a: Cloth, b: Cloth, every: int = 1, along: int = 80) -> dict[str, Any]:
    """Distance between two solutions of one flag.

    Args:
        pattern: The flag.
        a: One solution.
        b: The other solution, on any mesh.
        every: Compare only every ``every``-th frame.
        along: Points along the longer side, see :func:`even_uv`.

    Returns:
        As shares of the longer side: ``chamfer``, the mean of :func:`chamfer_distance` over the frames;
        ``chamfer_per_frame``; and ``corresponding``, the mean distance between the same positions on the cloth.

    Raises:
        ValueError: If the numbers of frames differ.
    """
    if len(a.positions) != len(b.positions):
        raise ValueError(f"Expected as many frames in both solutions, but got {len(a.positions)}, {len(b.positions)}.")
    uv = even_uv(pattern, along)
    one, other = (cloth.sample(uv)[::every] for cloth in (a, b))
    distances = [chamfer_distance(p, q) / pattern.longer_side for p, q in zip(one, other, strict=True)]
    apart = np.linalg.norm(one - other, axis=-1).mean() / pattern.longer_side
    return {
        "chamfer": float(np.mean(distances)),
        "corresponding": float(apart),
        "chamfer_per_frame": [round(value, 6) for value in distances],
        "frames_compared": len(distances),
        "points": len(uv),
    }


VARIANTS = ("steps doubled", "coarser", "finer", "half the cells", "hardly bending", "self-contact")


def variants(pattern: FlagPattern, names: Iterable[str] = VARIANTS) -> dict[str, FlagPattern]:
    """The same flag with twice the steps, and on meshes with three and five quarters as many cells along a side.

    The last two are different flags, on half as many cells: one with a fiftieth of the bending stiffness, which shows
    the effect of bending, and one with self-contact. The same flag on that mesh is included for comparison. Where the
    mesh changes, the steps change by powers of two, so that Blender's bending stays within its limit.
    """
    coarser, finer = (replace(pattern, cells=times * pattern.cells // 4) for times in (3, 5))
    half = replace(pattern, cells=pattern.cells // 2)
    slack, apart = replace(half, bending=0.02), replace(half, self_collision=True)
    table = {
        "steps doubled": replace(pattern, quality=2 * pattern.quality),
        "coarser": replace(coarser, quality=least_quality(coarser)),
        "finer": replace(finer, quality=least_quality(finer)),
        "half the cells": replace(half, quality=least_quality(half)),
        "hardly bending": replace(slack, quality=least_quality(slack)),
        "self-contact": replace(apart, quality=least_quality(apart)),
    }
    return {name: table[name] for name in names}
