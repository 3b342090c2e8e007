"""Areas of Gaussian patches: each taken alone, or shared so that overlapping patches add up to the surface."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.kernels.launch import replaces

_RAYS = 32  # number of directions in which the cell of a patch is measured
_SLAB = 0.75  # half thickness of one sheet, in neighbour spacings
_REACH = 5.0  # longest reach of a patch over uncovered surface, in standard deviations
_CLUSTER = 0.15  # centres closer than this, in neighbour spacings, are one cluster
_SPIKE = 2.0  # longest reach of a cell, in neighbour spacings
_CHUNK = 512  # cells measured together: few enough for the cache of a processor
_FALSE_EDGE = 0.0015  # chance that a direction inside a surface of random points looks like a border


def patch_area(log_scales: Tensor) -> Tensor:
    r"""Area of each Gaussian taken alone, :math:`\pi s_1 s_2` of its two larger scales (Gaussian Swaying).

    Overlapping Gaussians are counted several times: see :func:`coverage_area` for areas that add up to the surface.

    Returns:
        Areas [scene units^2], shape (...).

    Example:
        >>> patch_area(torch.tensor([[2.0, 3.0, 0.1]]).log())
        tensor([18.8496])
    """
    return math.pi * (log_scales.sum(-1) - log_scales.amin(-1)).exp()


@torch.no_grad()
def coverage_area(
    means: Tensor, normals: Tensor, log_scales: Tensor, opacity: Tensor | None = None, neighbours: int = 24
) -> Tensor:
    r"""Areas of overlapping patches that add up to the area of their surface.

    Unlike that of :func:`patch_area`, the sum does not depend on the number of Gaussians or their overlap. Two steps:

    1. The surface is divided among the centres. Each centre gets its Voronoi cell in its tangent plane, measured along
       rays to the bisectors with its nearest neighbours on the same sheet (those less than 3/4 of the local neighbour
       spacing off the tangent plane). At a border of the surface the cell extends as far outwards as it does inwards.
       No cell extends further than two neighbour spacings or five standard deviations of the nearby Gaussians.
    2. Each cell is shared among the Gaussians in proportion to their opacity there,
       :math:`A_i = \sum_j V_j \frac{g_i(x_j)}{\sum_l g_l(x_j)}`,
       :math:`g_i(x) = o_i \exp(-\lvert x - x_i \rvert^2 / (2 s_{i1} s_{i2}))`: a faint or tiny Gaussian among opaque
       ones gets little. The sum does not change.

    Parallel sheets at least one neighbour spacing apart count separately; closer ones count as one. Layers behind the
    skin of a captured object are sheets, too (see :func:`~gaussian_swaying.gaussians.openness.openness`). A Gaussian
    with fewer than three neighbours in reach keeps its :func:`patch_area`. Computed in float64 on the CPU, so the
    result is the same on every device; not differentiable.

    Args:
        opacity: Opacities from 0 to 1, shape (N,); None if all are equal.
        neighbours: Nearest centres to consider for each one, at least 6.

    Returns:
        Areas [scene units^2], finite and above zero, shape (N,).
    """
    count = means.shape[0]
    if not bool(torch.isfinite(means).all()):
        raise ValueError("Expected `means` to be finite, but some are NaN or infinite; remove these Gaussians.")
    weight = torch.ones(count, dtype=torch.float64)
    if opacity is not None:
        weight = opacity.detach().cpu().double().clamp_min(1e-6)
    if count == 0:
        return means.new_zeros(0)
    # Gaussians with the same centre form one site; in the end its cell is shared among them by weight.
    centres = means.detach().cpu().double()
    owner = equal_rows(centres)
    site = centres.new_empty(int(owner.max()) + 1, 3).index_put((owner,), centres)
    own_area = patch_area(log_scales.detach().cpu().double())
    load = weight * own_area
    order = torch.argsort(load, stable=True)
    rank = torch.empty(count, dtype=torch.long).scatter_(0, order, torch.arange(count))
    heaviest = torch.zeros(len(site), dtype=torch.long).scatter_reduce_(0, owner, rank, "amax", include_self=False)
    first = order[heaviest]  # a site has the normal and size of its heaviest Gaussian
    normal = torch.nn.functional.normalize(normals.detach().cpu().double()[first], dim=-1)
    disc = own_area[first]
    total = torch.zeros(len(site), dtype=torch.float64).index_add_(0, owner, weight)
    if len(site) > 3:
        distance, index = nearest_neighbours(site, min(neighbours, len(site) - 1))
        cell = torch.empty(len(site), dtype=torch.float64)
        share = torch.zeros(len(site), dtype=torch.float64)
        same = torch.empty_like(index, dtype=torch.bool)
        for start in range(0, len(site), _CHUNK):
            rows = slice(start, start + _CHUNK)
            offset = site[index[rows]] - site[rows, None]
            parts = offset, distance[rows], normal[rows], disc[rows], disc[index[rows]]
            cell[rows], same[rows] = _cells(*parts, start)
        for start in range(0, len(site), 8192):
            rows = slice(start, start + 8192)
            # g of every candidate at this site, the site's own Gaussians first
            exponent = -0.5 * math.pi * distance[rows].square() / disc[index[rows]]
            density = torch.cat(
                [total[rows, None], torch.where(same[rows], total[index[rows]] * exponent.exp(), 0)], dim=1
            )
            part = density * (cell[rows] / density.sum(1))[:, None]
            share[rows] += part[:, 0]
            share.index_add_(0, index[rows].reshape(-1), part[:, 1:].reshape(-1))
    else:
        share = disc
    load_of_site = torch.zeros(len(site), dtype=torch.float64).index_add_(0, owner, load)
    areas = share[owner] * load / load_of_site[owner]
    return areas.to(means).clamp_min(torch.finfo(means.dtype).tiny)


def _rays(phase: int, count: int) -> Tensor:
    """Directions in which cells are measured (B, rays, 2); each cell rotates them by another angle."""
    turn = torch.arange(phase, phase + count, dtype=torch.float64) * 0.6180339887498949 % 1  # errors average out
    angle = (turn[:, None] + torch.arange(_RAYS)) * (2 * math.pi / _RAYS)
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def _open_cosine(neighbours: Tensor) -> Tensor:
    """Cosine of the angle within which an open direction has no neighbour, from the number of neighbours.

    With m random neighbours that angle is empty by chance with probability _FALSE_EDGE. It is 60 degrees for m = 16,
    less than the 90 degrees at a straight edge.
    """
    half_angle = math.pi * (1 - _FALSE_EDGE ** (1 / neighbours.clamp_min(1)))
    return half_angle.clamp(math.radians(50), math.radians(85)).cos()


def _cells(
    offset: Tensor, distance: Tensor, normal: Tensor, disc: Tensor, discs: Tensor, phase: int
) -> tuple[Tensor, Tensor]:
    if not replaces((offset,), torch.float64):
        return _cell_area(offset, distance, normal, disc, discs, phase)
    from gaussian_swaying.gaussians.area_triton import cells

    neighbours = offset.shape[1]
    cluster = _CLUSTER * math.sqrt(math.pi / neighbours)
    ray, open_cosine = _rays(phase, len(offset)), _open_cosine(torch.arange(neighbours + 1, dtype=torch.float64))
    return cells(offset, distance, normal, disc, discs, ray, open_cosine, cluster, _SLAB, _SPIKE, _REACH)


def _cell_area(
    offset: Tensor, distance: Tensor, normal: Tensor, disc: Tensor, discs: Tensor, phase: int
) -> tuple[Tensor, Tensor]:
    """Areas of the Voronoi cells (B,) in the tangent planes, and which neighbours (B, k) are on the same sheet."""
    # Clusters, such as clones from densification, count once in the estimate of the spacing.
    close = _CLUSTER * distance[:, -1] * math.sqrt(math.pi / offset.shape[1])
    gap = torch.cdist(offset, offset, compute_mode="donot_use_mm_for_euclid_dist")
    repeat = (gap < close[:, None, None]).tril(-1).any(-1) | (distance < close[:, None])
    spacing = distance[:, -1] * (math.pi / (~repeat).sum(-1).clamp_min(1)).sqrt()
    size = (disc / math.pi).sqrt()
    height = (offset * normal[:, None]).sum(-1)
    same = height.abs() <= _SLAB * spacing[:, None]
    helper = torch.nn.functional.one_hot(normal.abs().argmin(-1), 3).to(normal)
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, normal), dim=-1)
    second = torch.linalg.cross(normal, first)
    flat = torch.stack([(offset * first[:, None]).sum(-1), (offset * second[:, None]).sum(-1)], dim=-1)
    squared = flat.square().sum(-1)
    stacked = same & (squared <= 1e-12 * spacing[:, None].square())
    same &= ~stacked

    ray = _rays(phase, len(offset))
    along = ray @ flat.mT  # (B, rays, k)
    facing = same[:, None] & (along > 0)
    reach = torch.where(facing, 0.5 * squared[:, None] / along, torch.inf).amin(-1)
    cosine = torch.where(same[:, None], along / squared.sqrt().clamp_min(1e-300)[:, None], -1).amax(-1)

    found = same.sum(-1, keepdim=True)
    local_size = ((disc[:, None] + (same * discs).sum(-1, keepdim=True)) / (math.pi * (1 + found))).sqrt()
    limit = torch.minimum(_SPIKE * spacing[:, None], _REACH * local_size)
    open_cosine = _open_cosine((same & ~repeat).sum(-1, keepdim=True))
    # At a border: up to three straight edges, each as far out as the cell extends on the other side.
    for _ in range(3):
        widest = cosine.argmin(-1, keepdim=True)
        is_open = cosine.gather(-1, widest) < open_cosine
        opposite = reach.gather(-1, (widest + _RAYS // 2) % _RAYS)
        edge = torch.where(opposite > limit, size[:, None], opposite)
        toward = (ray * ray.gather(1, widest[..., None].expand(-1, -1, 2))).sum(-1)
        cut = torch.where(is_open & (toward > 1e-6), edge / toward.clamp_min(1e-6), torch.inf)
        reach = torch.minimum(reach, cut)
        cosine = torch.where(toward > 0.5, 1, cosine)
    reach = torch.minimum(reach, limit)
    area = reach.square().mean(-1) * math.pi
    near = (same & (squared.sqrt() < 2 * limit)).sum(-1)
    return torch.where(near < 3, disc, area) / (1 + stacked.sum(-1)), same | stacked
