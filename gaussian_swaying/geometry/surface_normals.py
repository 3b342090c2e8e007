"""Normals of the surface that points lie on, from the positions of their neighbours."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.neighbours import nearest_neighbours

_CHUNK = 16_384  # points at a time: their neighbours take 13 MB


@torch.no_grad()
def neighbour_normals(points: Tensor, normals: Tensor, weights: Tensor | None = None, neighbours: int = 16) -> Tensor:
    r"""Normals of planes through neighbouring points.

    Each plane is the one of least weighted squares through a point and its nearest neighbours (Hoppe et al. 1992,
    "Surface reconstruction from unorganized points"). A neighbour counts with :math:`w_j (n_i \cdot n_j)^2`, so that
    another sheet, or the other face of an edge, counts little.

    Photos determine the positions of trained Gaussians better than their orientations: the smallest axes of small
    Gaussians may lean by some tenths of a degree over large parts of a surface, while their centres do not.

    Args:
        points: Points on a surface, shape (N, 3).
        normals: Their own unit normals, of either sign, shape (N, 3).
        weights: Weight of each point, such as opacity times area, shape (N,); equal weights when None.
        neighbours: Nearest points that a plane goes through, at least 3.

    Returns:
        Unit normals on the sides of ``normals``, of shape and precision of ``normals``. A point without a plane (with
        fewer than three others, or all on a line) keeps its own. Computed in float64 on the CPU, so the result is the
        same on every device; not differentiable.
    """
    count = len(points)
    if count < 4:
        return normals.clone()
    place, own = points.detach().cpu().double(), torch.nn.functional.normalize(normals.detach().cpu().double(), dim=-1)
    share = torch.ones(count, dtype=torch.float64) if weights is None else weights.detach().cpu().double()
    _, index = nearest_neighbours(place, min(neighbours, count - 1))
    index = torch.cat([torch.arange(count)[:, None], index], dim=1)
    found = torch.empty_like(own)
    for start in range(0, count, _CHUNK):
        rows = slice(start, start + _CHUNK)
        beside = index[rows]
        weight = share[beside] * (own[beside] * own[rows, None]).sum(-1).square()
        weight = weight / weight.sum(1, keepdim=True).clamp_min(torch.finfo(torch.float64).tiny)
        offset = place[beside] - place[rows, None]
        offset = offset - (weight[..., None] * offset).sum(1, keepdim=True)
        spread = torch.einsum("nk,nki,nkj->nij", weight, offset, offset)
        values, vectors = torch.linalg.eigh(spread)
        flat = values[:, 1] > 1e-9 * values[:, 2]
        plane = torch.where(flat[:, None], vectors[..., 0], own[rows])
        found[rows] = torch.where((plane * own[rows]).sum(-1, keepdim=True) < 0, -plane, plane)
    return found.to(normals)
