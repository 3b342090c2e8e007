"""Coloured points, read from .ply files."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._ply_table import read_header
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Coloured points.

    Attributes:
        points: Positions [scene units], float32, shape (P, 3).
        colors: Colours in 0 to 1, float32, shape (P, 3).
    """

    points: Tensor
    colors: Tensor

    def __len__(self) -> int:
        return len(self.points)


def read_ply_points(path: Path, origin: Origin = NO_ORIGIN) -> PointCloud:
    """Read the vertices of a .ply file, ASCII or binary; grey if they have no colours."""
    from plyfile import PlyData, PlyParseError

    try:
        read_header(path)  # checks that the file is long enough for its header
        ply = PlyData.read(str(path))
        table = ply["vertex"].data
        columns = [np.asarray(table[axis], dtype=np.float64) for axis in ("x", "y", "z")]
        points = (np.stack(columns, -1) - origin).astype(np.float32)
    except OSError as error:
        raise ValueError(f"Cannot read the points {path} ({error.strerror}): check the path.") from error
    except (PlyParseError, KeyError, ValueError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} is not a .ply with vertices x, y, z ({error}): export it again.") from error
    names = table.dtype.names or ()
    colors = np.full_like(points, 0.5)
    if all(name in names for name in ("red", "green", "blue")):
        colors = np.stack([np.asarray(table[name], dtype=np.float32) for name in ("red", "green", "blue")], -1)
        colors /= 255 if table["red"].dtype.kind in "ui" else 1
    if len(points) == 0:
        raise ValueError(f"{path} has no points: export it again, or set the initial points to random.")
    if not np.isfinite(points).all() or not np.isfinite(colors).all():
        raise ValueError(f"{path} has points or colours that are NaN or infinite: remove them.")
    return PointCloud(torch.from_numpy(points), torch.from_numpy(np.ascontiguousarray(colors)))
