"""Coloured points, read from .ply and .obj files or sampled on a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._inputs import check_regular
from gaussian_swaying._ply_table import read_header
from gaussian_swaying.geometry.meshes import fans, parse_obj, ply_polygons
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Coloured points.

    Attributes:
        points: Positions [scene units], float32, shape (P, 3).
        colors: Colours in 0 to 1, float32, shape (P, 3).
        normals: Unit normals, float32, shape (P, 3), where the source has a surface, else None.

    Raises:
        ValueError: If a tensor has another shape.
    """

    points: Tensor
    colors: Tensor
    normals: Tensor | None = None

    def __len__(self) -> int:
        return len(self.points)


def sample_mesh(vertices: PointCloud, faces: Tensor, count: int, seed: int = 0) -> PointCloud:
    """Points uniform on the surface of a mesh, with the normals of its faces.

    Args:
        vertices: Vertices with their colours.
        faces: Indices of vertices, shape (T, 3).
        count: Number of points.
        seed: Of the random numbers.
    """
    if len(faces) == 0 or int(faces.min()) < 0 or int(faces.max()) >= len(vertices):
        raise ValueError(f"Expected faces with indices from 0 to {len(vertices) - 1}: export the mesh again.")
    generator = torch.Generator().manual_seed(seed)
    corners = vertices.points.double()[faces]
    cross = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    total = cross.norm(dim=-1).cumsum(0)
    if not float(total[-1]) > 0:
        raise ValueError("Expected a mesh with area, but all its faces are degenerate: export the mesh again.")
    draw = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    picked = torch.searchsorted(total, draw[:, 0] * total[-1], right=True).clamp_max(len(faces) - 1)
    root = draw[:, 1].sqrt()
    weights = torch.stack([1 - root, root * (1 - draw[:, 2]), root * draw[:, 2]], -1)[..., None]
    points = (weights * corners[picked]).sum(1).float()
    shade = (weights * vertices.colors.double()[faces[picked]]).sum(1).float()
    normals = torch.nn.functional.normalize(cross[picked], dim=-1).float()
    return PointCloud(points, shade, normals)


def read_ply_points(path: Path, origin: Origin = NO_ORIGIN) -> tuple[PointCloud, Tensor | None]:
    """Read the vertices of a .ply file, ASCII or binary, and its faces.

    Args:
        path: The file.
        origin: Point of the file from which the vertices count.

    Returns:
        The vertices, grey if they have no colours, and triangles (T, 3) as indices, or None if there are none.
    """
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
    _check_points(path, points, colors)
    try:
        faces = fans(ply_polygons(ply))
    except ValueError as error:
        raise ValueError(f"{path} cannot be read ({error}): export the mesh again.") from error
    return PointCloud(torch.from_numpy(points), torch.from_numpy(np.ascontiguousarray(colors))), faces if len(
        faces
    ) else None


def read_obj_mesh(path: Path, origin: Origin = NO_ORIGIN) -> tuple[PointCloud, Tensor]:
    """Read a mesh from a Wavefront .obj file.

    Args:
        path: The file. Polygons are cut into triangles; textures are not read, but vertex colours are.
        origin: Point of the file from which the vertices count.

    Returns:
        The vertices, grey if they have no colours, and triangles (T, 3) as indices.
    """
    try:
        text = check_regular(path, "the mesh").read_text(encoding="utf-8-sig", errors="replace")
        vertices, polygons = parse_obj(text)
        points = (np.array([row[:3] for row in vertices]).reshape(-1, 3) - origin).astype(np.float32)
    except OSError as error:
        raise ValueError(f"Cannot read the mesh {path} ({error.strerror}): check the path.") from error
    except ValueError as error:
        raise ValueError(f"{path} is not a Wavefront .obj ({error}): export the mesh again.") from error
    colors = [row[3:6] if len(row) >= 6 else [0.5, 0.5, 0.5] for row in vertices]
    _check_points(path, points, np.array(colors, dtype=np.float32))
    faces = fans(polygons)
    if len(faces) == 0 or int(faces.min()) < 0 or int(faces.max()) >= len(points):
        raise ValueError(f"{path} has no faces, or faces of vertices that do not exist: export the mesh again.")
    return PointCloud(torch.from_numpy(points), torch.tensor(colors)), faces


def _check_points(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    if len(points) == 0:
        raise ValueError(f"{path} has no points: export it again, or set the initial points to random.")
    if not np.isfinite(points).all() or not np.isfinite(colors).all():
        raise ValueError(f"{path} has points or colours that are NaN or infinite: remove them.")
