"""The content of a reference folder: pictures in order, and a moving surface."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._inputs import read_arrays


@dataclass(frozen=True, slots=True, eq=False)
class Cloth:
    """The surface of a reference.

    Attributes:
        positions: Vertices of each frame in the axes and from the origin of the scene [m], float32, shape (T, V, 3).
        faces: Triangles as indices of vertices, shape (F, 3).
        side: Its longer side at rest [m], if the file has it.
    """

    positions: Tensor
    faces: Tensor
    side: float | None = None


def read_cloth(path: str | os.PathLike[str]) -> Cloth:
    """Read ``cloth.npz``: ``positions`` (T, V, 3) [m] and ``faces`` (F, 3), or (F, 4) for squares, which are halved.

    The longer side [m] is ``side``, or else the larger of ``width`` and ``height`` in the JSON text ``settings``, if
    these exist.
    """
    found = read_arrays(path, "the reference", ("positions", "faces"), ("side", "settings"))
    positions = torch.from_numpy(found["positions"].astype(np.float32))
    faces = torch.from_numpy(found["faces"].astype(np.int64))
    if positions.dim() != 3 or positions.shape[-1] != 3 or len(positions) == 0:
        raise ValueError(f"Expected `positions` of {path} of shape (T, V, 3), but got {tuple(positions.shape)}.")
    if faces.dim() != 2 or faces.shape[-1] not in (3, 4) or len(faces) == 0:
        raise ValueError(f"Expected `faces` of {path} of shape (F, 3) or (F, 4), but got {tuple(faces.shape)}.")
    if faces.shape[-1] == 4:
        faces = torch.cat([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]])
    if int(faces.min()) < 0 or int(faces.max()) >= positions.shape[1]:
        raise ValueError(f"Expected `faces` of {path} to hold indices from 0 to {positions.shape[1] - 1}.")
    if not bool(torch.isfinite(positions).all()):
        raise ValueError(f"Expected `positions` of {path} to be finite: make the reference again.")
    return Cloth(positions, faces, _side(path, found))


def _side(path: str | os.PathLike[str], found: dict[str, Any]) -> float | None:
    if "side" in found:
        side = float(found["side"])
    else:
        settings = json.loads(str(found.get("settings", "{}")))
        if not {"width", "height"} <= set(settings):
            return None
        side = float(max(settings["width"], settings["height"]))
    check_positive(f"side of {path}", side)
    return side


def surface_points(vertices: Tensor, faces: Tensor, count: int, seed: int = 0) -> Tensor:
    """Random points on a triangle mesh, uniform by area; the same mesh and seed give the same points.

    Args:
        vertices: Vertices [m], shape (V, 3).
        faces: Triangles, shape (F, 3).

    Returns:
        Points [m], float32, shape (count, 3).
    """
    generator = torch.Generator().manual_seed(seed)
    corners = vertices.double()[faces]
    total = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1).cumsum(0)
    if not float(total[-1]) > 0:
        raise ValueError("Expected a mesh with area, but all its faces are degenerate: export the mesh again.")
    draw = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    picked = torch.searchsorted(total, draw[:, 0] * total[-1], right=True).clamp_max(len(faces) - 1)
    root = draw[:, 1].sqrt()
    weights = torch.stack([1 - root, root * (1 - draw[:, 2]), root * draw[:, 2]], -1)[..., None]
    return (weights * corners[picked]).sum(1).float()


def frame_files(folder: Path) -> list[Path]:
    """The pictures ``frames/<number>.png`` of a folder in order; their numbers must be consecutive."""
    files = [path for path in (folder / "frames").glob("*.png") if not path.name.startswith(".")]
    for path in files:
        if not path.stem.isdecimal():
            raise ValueError(f"Expected the name of {path} to be the number of its frame: rename it, or move it away.")
    files.sort(key=lambda path: int(path.stem))
    for before, after in pairwise(files):
        if int(after.stem) != int(before.stem) + 1:
            raise ValueError(f"Frames are missing or duplicated between {before} and {after.name}: make them again.")
    return files
