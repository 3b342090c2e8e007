"""Triangle meshes: reading .ply and .obj files, and the signed distance to a closed mesh on a grid."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._inputs import check_regular
from gaussian_swaying._ply_table import read_header
from gaussian_swaying.geometry.distance import DistanceGrid
from gaussian_swaying.geometry.neighbours import nearest_neighbours

MOST_NODES = 4_000_000
"""Most nodes of a distance grid."""

LARGEST_MESH = 1 << 28
"""Largest file of a mesh [bytes]; some three million vertices as .obj."""

MOST_SQUARES = 10_000_000
"""Bound on the size of a mesh: the sum of (longest side / cell of the distance grid)² over its triangles."""

_DISAGREE = 0.02
"""Share of the nodes next to which the rays along the three axes may disagree; more of them mean a hole."""

_JITTER = (0.00191, 0.00317, 0.00253)  # of a cell: no ray runs along an edge of a mesh with round coordinates


def read_mesh(path: str | os.PathLike[str]) -> tuple[Tensor, Tensor]:
    """Vertices and triangles of a .ply or .obj file; polygons are cut into fans.

    Returns:
        Vertices, shape (V, 3), float64, and triangles, shape (T, 3), int64.
    """
    file = Path(path)
    readers = {".ply": _read_ply, ".obj": _read_obj}
    if file.suffix.lower() not in readers:
        raise ValueError(f"Expected a mesh as .ply or .obj, but got {file}.")
    check_regular(file, "the mesh", LARGEST_MESH)
    if file.suffix.lower() == ".ply":
        read_header(file)  # its sentences name the file
    try:
        vertices, polygons = readers[file.suffix.lower()](file)
        triangles = fans(polygons)
    except Exception as error:  # plyfile and numbers that are too large raise many kinds of errors
        told = str(error).strip() or type(error).__name__
        raise ValueError(
            f"The mesh {file} cannot be read ({told:.200}): export it again as .obj with triangles."
        ) from error
    if not len(triangles):
        raise ValueError(f"The mesh {file} has no faces: a point cloud or a splat is no mesh.")
    if int(triangles.min()) < 0 or int(triangles.max()) >= len(vertices) or not bool(torch.isfinite(vertices).all()):
        raise ValueError(f"The mesh {file} has faces without vertices, or vertices that are NaN or infinite.")
    if _on_a_line(vertices[triangles.unique()]):
        raise ValueError(f"The mesh {file} has all its vertices on one line, so it has no surface: export it again.")
    return vertices, triangles


def _on_a_line(places: Tensor) -> bool:
    """True if all places (V, 3) are on one line, within the rounding of files to float32.

    Rounding moves a coordinate c by at most c / 2^24, so a place by sqrt(3) times that of the largest coordinate. The
    second singular value is the root of the sum of the squared distances from the line that fits best.
    """
    largest = float(places.abs().max())
    scaled = places / largest if largest > 0 else places
    spread = torch.linalg.svdvals(scaled - scaled.mean(0))
    return len(spread) < 2 or float(spread[1]) <= (3 * len(places)) ** 0.5 / 2**24


def _read_ply(file: Path) -> tuple[Tensor, list[list[int]]]:
    from plyfile import PlyData

    data = PlyData.read(str(file))
    if "vertex" not in data:
        raise ValueError("it has no element `vertex`")
    vertex = data["vertex"]
    return torch.stack([torch.tensor(vertex[axis].astype("float64")) for axis in "xyz"], dim=-1), ply_polygons(data)


def ply_polygons(data: Any) -> list[list[int]]:
    """The faces of a .ply that plyfile has read, as indices of vertices; ValueError if they have none."""
    if "face" not in data or not data["face"].count:
        return []
    face = data["face"]
    name = next((p.name for p in face.properties if p.name in ("vertex_indices", "vertex_index")), None)
    if name is None:
        raise ValueError("its faces have no `vertex_indices`")
    return [[int(k) for k in polygon] for polygon in face[name]]


def _read_obj(file: Path) -> tuple[Tensor, list[list[int]]]:
    vertices, polygons = parse_obj(file.read_text("utf-8"))
    return torch.tensor([row[:3] for row in vertices], dtype=torch.float64).reshape(-1, 3), polygons


def parse_obj(text: str) -> tuple[list[list[float]], list[list[int]]]:
    """The numbers of each vertex of a Wavefront .obj, with its colour if it has one, and polygons as their indices."""
    vertices: list[list[float]] = []
    polygons: list[list[int]] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words[:1] == ["v"]:
            if len(words) < 4:
                raise ValueError(f"line {number} has a vertex of fewer than three numbers")
            vertices.append([float(word) for word in words[1:]])
        elif words[:1] == ["f"]:
            numbers = [int(word.split("/")[0]) for word in words[1:]]
            if 0 in numbers:
                raise ValueError(f"line {number} has a face with the vertex 0, but they count from 1")
            polygons.append([k - 1 if k > 0 else len(vertices) + k for k in numbers])
    return vertices, polygons


def fans(polygons: Sequence[Sequence[int]]) -> Tensor:
    """The triangles (T, 3) into which polygons are cut from their first vertex."""
    return torch.tensor([(p[0], p[k], p[k + 1]) for p in polygons for k in range(1, len(p) - 1)]).long().reshape(-1, 3)


def mesh_distance(vertices: Tensor, faces: Tensor, cells: int = 48) -> DistanceGrid:
    """Signed distance to a closed mesh on a grid around it.

    The distance is that to the nearest of the triangles that contain the nearest of many samples of the surface. Inside
    is where most of the rays along the three axes cross the surface an odd number of times.

    Args:
        vertices: Shape (V, 3).
        faces: Triangles, shape (T, 3).

    Returns:
        The distances, on a grid that reaches three cells beyond the mesh.
    """
    corners = vertices.detach().double().cpu()[faces.cpu()]  # (T, 3 corners, 3)
    low, high = corners.flatten(0, 1).amin(0), corners.flatten(0, 1).amax(0)
    spacing = float((high - low).amax()) / cells
    if not 0 < spacing < float("inf"):
        raise ValueError("The mesh has no extent, or an infinite one: export it again.")
    size = ((high - low) / spacing).ceil().long() + 7
    if int(size.prod()) > MOST_NODES:
        raise ValueError(f"A distance grid of {size.tolist()} nodes is too large: lower `cells`.")
    origin = low - 3 * spacing
    axes = [origin[k] + spacing * torch.arange(int(size[k]), dtype=torch.float64) for k in range(3)]
    nodes = torch.cartesian_prod(*axes)
    shape = tuple(size.tolist())
    distance = _nearest_distance(nodes, corners, spacing).reshape(shape)
    votes = torch.stack([_inside(corners, origin, spacing, shape, axis) for axis in range(3)]).sum(0)
    unsure = ((votes == 1) | (votes == 2)).double().mean()
    if float(unsure) > _DISAGREE:
        raise ValueError(
            f"The mesh is not closed: rays along the three axes disagree about {100 * float(unsure):.0f} % of the "
            "space around it; close its holes, or give it a thickness."
        )
    if not bool(((votes >= 2) & (distance > 1e-6 * spacing)).any()):  # those on the surface are neither
        raise ValueError(
            f"The mesh encloses none of the nodes of its grid, {spacing:.3g} apart: give it a thickness, or raise "
            "`cells`."
        )
    sign = torch.where(votes >= 2, -1.0, 1.0).double()
    return DistanceGrid(sign * distance, origin, spacing)


def _nearest_distance(nodes: Tensor, corners: Tensor, spacing: float) -> Tensor:
    """Distance of places (N, 3) from triangles (T, 3, 3)."""
    longest = (corners - corners.roll(1, dims=1)).norm(dim=-1).amax(-1)
    per_side = (longest / spacing).ceil().clamp(min=1)
    if float(per_side.square().sum()) > MOST_SQUARES:
        raise ValueError(f"The mesh has {len(corners):,} triangles, too many, or too many large ones: simplify it.")
    per_side = per_side.long().clamp(max=64)
    samples, owner = [], []
    for count in per_side.unique().tolist():
        own = (per_side == count).nonzero()[:, 0]
        grid = torch.cartesian_prod(torch.arange(count + 1), torch.arange(count + 1)).double() / count
        grid = grid[grid.sum(-1) <= 1 + 1e-9]
        a, b, c = corners[own].unbind(1)
        place = a[:, None] + grid[:, :1] * (b - a)[:, None] + grid[:, 1:] * (c - a)[:, None]
        samples.append(place.reshape(-1, 3))
        owner.append(own.repeat_interleave(len(grid)))
    sample, of = torch.cat(samples), torch.cat(owner)
    near = nearest_neighbours(sample, min(6, len(sample)), nodes)[1]
    best = torch.full((len(nodes),), float("inf"), dtype=torch.float64)
    for k in range(near.shape[1]):
        best = best.minimum(triangle_distance(nodes, corners[of[near[:, k]]]))
    return best


def triangle_distance(place: Tensor, corners: Tensor) -> Tensor:
    """Distance of each place (N, 3) from its triangle (N, 3, 3): the foot within it, or the nearest of its sides."""
    a, b, c = corners.unbind(-2)
    ab, ac, ap = b - a, c - a, place - a
    d1, d2 = (ab * ap).sum(-1), (ac * ap).sum(-1)
    bp, cp = place - b, place - c
    d3, d4, d5, d6 = (ab * bp).sum(-1), (ac * bp).sum(-1), (ab * cp).sum(-1), (ac * cp).sum(-1)
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    total = va + vb + vc  # above zero inside
    inside = (va > 0) & (vb > 0) & (vc > 0)
    foot = a + (vb / total)[:, None] * ab + (vc / total)[:, None] * ac
    best = torch.where(inside, (place - foot).norm(dim=-1), float("inf"))
    for p, q in ((a, b), (b, c), (c, a)):
        side = q - p
        t = ((place - p) * side).sum(-1) / (side * side).sum(-1).clamp(min=torch.finfo(place.dtype).tiny)
        best = best.minimum((place - p - t.clamp(0, 1)[:, None] * side).norm(dim=-1))
    return best


def _inside(corners: Tensor, origin: Tensor, spacing: float, shape: tuple[int, ...], axis: int) -> Tensor:
    """Return 1 where the ray along an axis up to a node crosses the triangles an odd number of times, else 0; long."""
    u, v = (k for k in range(3) if k != axis)
    nu, nv, nw = shape[u], shape[v], shape[axis]
    scaled = (corners - origin) / spacing
    flat = torch.stack([scaled[..., u] - _JITTER[u], scaled[..., v] - _JITTER[v]], dim=-1)  # (T, 3, 2)
    low, high = flat.amin(1).ceil().long().clamp(min=0), flat.amax(1).floor().long()
    high = high.minimum(torch.tensor([nu - 1, nv - 1]))
    many = (high - low + 1).clamp(min=0)
    count = many.prod(-1)
    triangle = torch.repeat_interleave(torch.arange(len(count)), count)
    within = torch.arange(len(triangle)) - (count.cumsum(0) - count)[triangle]
    i = low[triangle, 0] + within // many[triangle, 1].clamp(min=1)
    j = low[triangle, 1] + within % many[triangle, 1].clamp(min=1)
    place = torch.stack([i, j], dim=-1).double()
    a, b, c = flat[triangle].unbind(1)

    def turn(p: Tensor, q: Tensor) -> Tensor:
        return (q[:, 0] - p[:, 0]) * (place[:, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (place[:, 0] - p[:, 0])

    wa, wb, wc = turn(b, c), turn(c, a), turn(a, b)
    total = wa + wb + wc
    hit = ((wa >= 0) & (wb >= 0) & (wc >= 0)) | ((wa <= 0) & (wb <= 0) & (wc <= 0))
    hit &= total != 0
    depth = scaled[triangle, :, axis]
    height = (wa * depth[:, 0] + wb * depth[:, 1] + wc * depth[:, 2]) / torch.where(total == 0, 1.0, total)
    k = height.ceil().long().clamp(0, nw)
    crossings = torch.zeros(nu * nv, nw + 1, dtype=torch.long)
    crossings.view(-1).index_add_(0, ((i * nv + j) * (nw + 1) + k)[hit], torch.ones(int(hit.sum()), dtype=torch.long))
    odd = (crossings.cumsum(1)[:, :nw] % 2).reshape(nu, nv, nw)
    return odd.movedim(2, axis)
