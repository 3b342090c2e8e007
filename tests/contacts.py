"""Measures of contact: gaps between surfaces, and edges of a sheet that cross its triangles."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gaussian_swaying.mpm.contact import ContactStage
from gaussian_swaying.mpm.state import MPMState
from gaussian_swaying.mpm.transfer import bspline_stencil, gather

_CHUNK = 20_000_000


def samples(stage: ContactStage, state: MPMState) -> tuple[Tensor, Tensor]:
    """Positions of the contact samples now [m], shape (C, 3), and their unit normals."""
    surface, moved = stage.surface, state.node_displacement
    assert moved is not None
    rows = gather(moved, bspline_stencil(surface.read, state.grid, False))
    F = torch.eye(3).to(moved) + rows[:, 1:4].mT
    position = surface.read + rows[:, 0] + (F @ (surface.place - surface.read)[..., None])[..., 0]
    normal = (torch.linalg.inv(F).mT @ surface.normal[..., None])[..., 0]
    return position, torch.nn.functional.normalize(normal, dim=-1)


def pairs(stage: ContactStage, position: Tensor, reach: float) -> Tensor:
    """Pairs of samples closer than a reach now and not at rest, the smaller number first, shape (2, M)."""
    found = torch.from_numpy(cKDTree(position.cpu().numpy()).query_pairs(reach, output_type="ndarray")).long().T
    first, second = stage.surface.place.cpu()[found]
    return found[:, (first - second).norm(dim=-1) >= stage.apart].to(position.device)


def gaps(stage: ContactStage, state: MPMState) -> Tensor:
    """Distances of all surfaces that lie above each other and were no neighbours at rest, in units of the thickness.

    Returns:
        One for each pair of samples whose discs lie above each other, shape (M,); none farther than the reach of a
        disc. It is the distance along the mean of the normals of the discs, weighted with the heights above them.
    """
    position, normal = samples(stage, state)
    both = pairs(stage, position, stage.reach)
    arm = position[both[0]] - position[both[1]]
    height = (arm * normal[both]).sum(-1)
    over = arm.square().sum(-1) - height.square() < stage.surface.radius[both].square()
    along = ((height * over)[..., None] * normal[both]).sum(0)
    along = torch.nn.functional.normalize(along, dim=-1, eps=1e-18)
    return ((arm * along).sum(-1) / stage.surface.thickness[both].mean(0))[over.any(0)]


def sheet_triangles(nx: int, ny: int, first: int = 0) -> Tensor:
    """Triangles of a sheet of nx times ny points in rows, the first of them numbered ``first``; shape (T, 3)."""
    number = first + torch.arange(nx * ny).reshape(nx, ny)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[:-1, 1:], number[1:, 1:]
    corners = [torch.stack([a, b, d], -1), torch.stack([a, d, c], -1)]
    return torch.cat([part.reshape(-1, 3) for part in corners])


@torch.no_grad()
def crossings(place: Tensor, triangles: Tensor) -> int:
    """How many pairs of an edge and a triangle, without a common corner, cross each other.

    An edge crosses a triangle if its ends lie on different sides of its plane, and the line through it passes all three
    sides of the triangle in the same direction: signs of volumes of tetrahedra.

    Units: ``place`` [m].

    Returns:
        The number; zero if no part of the surface passes through another.
    """
    place, triangles = place.double().cpu(), triangles.cpu()
    sides = torch.cat([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    edges = sides.sort(-1)[0].unique(dim=0)
    corners = place[triangles]
    low, high = corners.amin(1), corners.amax(1)
    found, step = 0, max(1, _CHUNK // len(triangles))
    for first in range(0, len(edges), step):
        ends = place[edges[first : first + step]]
        below, above = ends.amin(1), ends.amax(1)
        near = ((below[:, None] <= high) & (above[:, None] >= low)).all(-1)
        own = (edges[first : first + step, None, :, None] == triangles[:, None, :]).flatten(2).any(-1)
        edge, face = (near & ~own).nonzero(as_tuple=True)
        p, q = ends[edge].unbind(1)
        a, b, c = corners[face].unbind(1)
        side = [_volume(a, b, c, p), _volume(a, b, c, q)]
        turn = [_volume(p, q, a, b), _volume(p, q, b, c), _volume(p, q, c, a)]
        same = ((turn[0] > 0) & (turn[1] > 0) & (turn[2] > 0)) | ((turn[0] < 0) & (turn[1] < 0) & (turn[2] < 0))
        found += int((same & (side[0] * side[1] < 0)).sum())
    return found


def _volume(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> Tensor:
    return (torch.linalg.cross(b - a, c - a, dim=-1) * (d - a)).sum(-1)
