"""Normals of the surface that points lie on, from the positions of their neighbours."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gaussian_swaying.geometry.directions import axes_across
from gaussian_swaying.geometry.neighbours import nearest_neighbours

_CHUNK = 4096  # points at a time: their neighbours take 40 MB
_SEARCH = 65_536  # points that are searched for at a time: 0.4 GB
_SIZES = 4  # of neighbourhoods, each twice as wide as the one before it
_AS_GOOD = 2.0  # a wider surface may lie so much farther from its points than the first one
_ROUNDS = 2  # fits to a neighbourhood, each with weights by how far the surface before it was off
_TINY = torch.finfo(torch.float64).tiny


@torch.no_grad()
def neighbour_normals(points: Tensor, normals: Tensor, weights: Tensor | None = None, neighbours: int = 128) -> Tensor:
    r"""Normals of smooth surfaces through neighbouring points.

    Each surface is a polynomial of degree two over the plane across the normal of a point, of least weighted squares
    through its nearest neighbours (Cazals and Pouget 2005, "Estimating differential quantities using polynomial
    fitting of osculating jets"). A neighbour counts with :math:`w_j (n_i \cdot n_j)^2 (1 - r^2 / R^2)`, and less the
    farther it lies off the surface, :math:`(1 + (d / s)^2)^{-2}` (Geman and McClure 1987), so that another leaf, or
    the other face of an edge, counts little. The scale s is four times the distance that 30 % of the neighbours keep.

    Then the neighbourhood becomes wider, up to eight times, with a quarter, a sixteenth and a 64th of all points, for
    as long as the surface fits as well: what leaves its points no farther away than noise does is not a shape.

    Photos determine the positions of trained Gaussians better than their orientations: the smallest axes of small
    Gaussians may lean by some tenths of a degree over large parts of a surface, while their centres do not.

    Args:
        points: Points on a surface, shape (N, 3).
        normals: Their own unit normals, of either sign, shape (N, 3).
        weights: Weight of each point, such as opacity times area, shape (N,); equal weights when None.
        neighbours: Nearest points that a surface goes through, at least 3.

    Returns:
        Unit normals on the sides of ``normals``, of shape and precision of ``normals``. A point without a surface
        (with fewer than three others, or all on a line) keeps its own. Computed in float64 on the CPU, so the result
        is the same on every device; not differentiable.
    """
    count = len(points)
    if count < 4:
        return normals.clone()
    place, own = points.detach().cpu().double(), normalize(normals.detach().cpu().double(), dim=-1)
    share = torch.ones(count, dtype=torch.float64) if weights is None else weights.detach().cpu().double()
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    found, rows = own.clone(), torch.arange(count)
    limit = torch.full((count,), torch.inf, dtype=torch.float64)
    for size in range(_SIZES):
        some = order[: count // 4**size].sort().values
        if len(rows) == 0 or (size and len(some) <= neighbours):
            break
        parts = []
        for block in rows.split(_SEARCH):
            index = some[nearest_neighbours(place[some], min(neighbours, len(some)), place[block])[1]]
            chunks = zip(block.split(_CHUNK), index.split(_CHUNK), strict=True)
            parts += [_fitted(place, found, share, *chunk) for chunk in chunks]
        surface, off = map(torch.cat, zip(*parts, strict=True))
        fits = off <= limit[rows]
        if not size:
            limit = _AS_GOOD * off
        rows = rows[fits]
        found[rows] = surface[fits]
    return torch.where((found * own).sum(-1, keepdim=True) < 0, -found, found).to(normals)


def _fitted(place: Tensor, normals: Tensor, share: Tensor, rows: Tensor, index: Tensor) -> tuple[Tensor, Tensor]:
    """Normals of surfaces through points ``index`` (N, K) near the points ``rows`` (N,), and how far they are off."""
    offset = place[index] - place[rows, None]
    radius = offset[:, -1].norm(dim=-1).clamp_min(_TINY)
    offset = offset / radius[:, None, None]
    normal = normals[rows]
    weight = share[index] * (normals[index] * normal[:, None]).sum(-1).square()
    off = torch.einsum("nki,ni->nk", offset, normal)
    kept = 1 + round(0.3 * (index.shape[1] - 1))
    little = torch.tensor([1e-12] * 3 + [1e-8] * 3, dtype=torch.float64).diag()  # few neighbours get a plane
    for _ in range(_ROUNDS):
        along = torch.stack(axes_across(normal), 1)
        x, y = torch.einsum("nki,nai->ank", offset, along)
        scale = 4 * off.abs().kthvalue(kept, dim=1, keepdim=True).values + 1e-9
        each = weight * (1 - x * x - y * y).clamp_min(0) / (1 + (off / scale).square()).square()
        each = each / each.sum(1, keepdim=True).clamp_min(_TINY)
        terms = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)
        square = torch.einsum("nk,nki,nkj->nij", each, terms, terms)
        spread = square[:, 1:3, 1:3] - square[:, 0, 1:3, None] * square[:, 0, None, 1:3]
        flat = torch.linalg.eigvalsh(spread)[:, :1] > 1e-9
        height = torch.einsum("nki,ni->nk", offset, normal)
        fit = torch.linalg.solve(square + little, torch.einsum("nk,nki,nk->ni", each, terms, height))
        tilted = normalize(normal - torch.einsum("na,nai->ni", fit[:, 1:3], along), dim=-1)
        normal = torch.where(flat, tilted, normal)
        off = height - torch.einsum("nki,ni->nk", terms, fit)
    return normal, radius * off.abs().kthvalue(kept, dim=1).values
