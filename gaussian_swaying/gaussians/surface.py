"""Gaussians as surface patches: normal, area, and how both and the covariance follow a deformation."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_choice, check_shape
from gaussian_swaying.gaussians.ply import GaussianCloud, read_ply, write_ply
from gaussian_swaying.gaussians.spherical_harmonics import sh_to_color
from gaussian_swaying.mpm.linalg import cofactor, determinant

_RAYS = 32  # directions in which the cell of a patch is measured
_SLAB = 0.75  # half thickness of one sheet, in neighbour spacings
_REACH = 5.0  # longest reach of a patch over uncovered surface, in standard deviations
_CLUSTER = 0.15  # centres closer than this, in neighbour spacings, are one cluster
_SPIKE = 2.0  # longest reach of a cell, in neighbour spacings
_FALSE_EDGE = 0.0015  # chance that a direction inside a random surface looks as if the surface ended there


def quat_to_rotation(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions.

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).

    Returns:
        Shape (..., 3, 3); columns are the axes of the Gaussian.

    Raises:
        ValueError: If ``quats`` has another shape.
    """
    check_shape("quats", quats, 4)
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    entries = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def rotation_to_quat(rotation: Tensor) -> Tensor:
    """Unit quaternions of rotation matrices, by the largest of four equivalent forms (Shepperd 1978).

    Args:
        rotation: Rotation matrices, shape (..., 3, 3).

    Returns:
        Quaternions wxyz with w >= 0, shape (..., 4).

    Raises:
        ValueError: If ``rotation`` has another shape.
    """
    check_shape("rotation", rotation, 3, 3)
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in rotation.unbind(-2))
    # Row k is 4 q_k q: the outer product of the quaternion with itself.
    outer = torch.stack(
        [
            torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
            torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
            torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
            torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
        ],
        dim=-2,
    )
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    quats = torch.nn.functional.normalize(row, dim=-1)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def covariance(quats: Tensor, log_scales: Tensor) -> Tensor:
    r"""Covariances :math:`A = R S S^T R^T` (Kerbl et al. 2023, equation 6).

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).
        log_scales: Logarithm of the standard deviations [scene units], shape (..., 3).

    Returns:
        Symmetric matrices [scene units^2], shape (..., 3, 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("log_scales", log_scales, 3)
    axes = quat_to_rotation(quats) * log_scales.exp()[..., None, :]
    return axes @ axes.mT


def covariance_to_quat_scale(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions and scales of covariances, to store deformed Gaussians in a .ply file.

    Computed in float64. The axes are right-handed, sorted from the smallest, and their signs depend on the matrix
    alone. A standard deviation below 1e-7 times the largest is raised to that, so that singular matrices pass.

    Args:
        covariances: Symmetric positive semi-definite matrices [scene units^2], shape (N, 3, 3).

    Returns:
        Quaternions wxyz of unit length, shape (N, 4), and logarithm of the standard deviations [scene units],
        shape (N, 3).

    Raises:
        ValueError: If ``covariances`` has another shape.
    """
    check_shape("covariances", covariances, 3, 3)
    values, axes = torch.linalg.eigh(covariances.double())
    largest = axes.abs().argmax(-2, keepdim=True)
    axes = axes * torch.where(axes.gather(-2, largest) < 0, -1.0, 1.0)
    axes = torch.cat([axes[..., :2], torch.linalg.cross(axes[..., 0], axes[..., 1])[..., None]], dim=-1)
    floor = (values[..., -1:] * 1e-14).clamp_min(1e-60)
    log_scales = 0.5 * values.clamp_min(floor).log()
    return rotation_to_quat(axes).to(covariances.dtype), log_scales.to(covariances.dtype)


def deform_covariance(deformation_gradient: Tensor, covariances: Tensor) -> Tensor:
    r"""Covariances after a deformation, :math:`a = F A F^T` (Gaussian Swaying, "Surface Formulation").

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        covariances: Covariances A at rest [scene units^2], shape (..., 3, 3).

    Returns:
        Shape (..., 3, 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("deformation_gradient", deformation_gradient, 3, 3)
    check_shape("covariances", covariances, 3, 3)
    return deformation_gradient @ covariances @ deformation_gradient.mT


def smallest_axis_normal(quats: Tensor, log_scales: Tensor) -> Tensor:
    """Unit normals along the smallest axis of each Gaussian (Guedon & Lepetit 2024, "SuGaR").

    The sign is that of the axis in the rotation matrix, so it carries no meaning of inside or outside.

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).
        log_scales: Logarithm of the standard deviations [scene units], shape (..., 3).

    Returns:
        Shape (..., 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    check_shape("log_scales", log_scales, 3)
    rotation = quat_to_rotation(quats)
    index = log_scales.argmin(-1)[..., None, None].expand(*log_scales.shape[:-1], 3, 1)
    return rotation.gather(-1, index).squeeze(-1)


def deform_normal(deformation_gradient: Tensor, normals: Tensor) -> Tensor:
    r"""Unit normals after a deformation, :math:`n = F^{-T} N / \lVert F^{-T} N \rVert` (Gaussian Swaying).

    Computed from the cofactor matrix, :math:`F^{-T} = \operatorname{cof}(F) / \det F`, which needs no inverse and is
    finite for a singular F. Where cof(F) N is zero, because F flattens the patch to a line, the normal at rest stays.

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        normals: Unit normals N at rest, shape (..., 3).

    Returns:
        Shape (..., 3).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    cof, vector = _cofactor_times(deformation_gradient, normals)
    vector = torch.where(determinant(deformation_gradient, cof)[..., None] < 0, -vector, vector)
    largest = vector.detach().abs().amax(-1, keepdim=True)
    flat = largest == 0
    vector = torch.where(flat, normals, vector / torch.where(flat, 1, largest))  # scaled: squares cannot underflow
    return vector / vector.square().sum(-1, keepdim=True).sqrt()


def deform_area(deformation_gradient: Tensor, normals: Tensor, areas: Tensor) -> Tensor:
    r"""Patch areas after a deformation, :math:`a = \lVert \operatorname{cof}(F) N \rVert A` (Nanson's formula).

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        normals: Unit normals N at rest, shape (..., 3).
        areas: Areas A at rest [scene units^2], shape (...).

    Returns:
        Shape (...).

    Raises:
        ValueError: If a tensor does not have the shape above.
    """
    return _cofactor_times(deformation_gradient, normals)[1].norm(dim=-1) * areas


def _cofactor_times(deformation_gradient: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """The cofactors of F (..., 3, 3) and their product with N (..., 3)."""
    check_shape("deformation_gradient", deformation_gradient, 3, 3)
    check_shape("normals", normals, 3)
    cof = cofactor(deformation_gradient)
    return cof, (cof @ normals[..., None]).squeeze(-1)


def patch_area(log_scales: Tensor) -> Tensor:
    r"""Area of each Gaussian taken alone, :math:`\pi s_1 s_2` of its two larger scales (Gaussian Swaying).

    Overlapping Gaussians are counted several times: see :func:`coverage_area` for areas that add up to the surface.

    Args:
        log_scales: Logarithm of the standard deviations [scene units], shape (..., 3).

    Returns:
        Areas [scene units^2], shape (...).

    Raises:
        ValueError: If ``log_scales`` has another shape.

    Example:
        >>> patch_area(torch.tensor([[2.0, 3.0, 0.1]]).log())
        tensor([18.8496])
    """
    check_shape("log_scales", log_scales, 3)
    return math.pi * (log_scales.sum(-1) - log_scales.amin(-1)).exp()


@torch.no_grad()
def coverage_area(
    means: Tensor, normals: Tensor, log_scales: Tensor, opacity: Tensor | None = None, neighbours: int = 24
) -> Tensor:
    r"""Areas of overlapping patches that add up to the area of the surface they lie on.

    The sum does not depend on how many Gaussians carry the surface nor on how much they overlap, unlike that of
    :func:`patch_area`. In two steps:

    1. The surface is divided among the centres: each gets the cell of the points nearest to it (Voronoi) in its
       tangent plane, measured along rays to the bisectors with its nearest neighbours on the same sheet (those less
       than 3/4 of the local neighbour spacing off the tangent plane). Where the surface ends, the cell ends as far
       beyond the centre as it reaches inwards. No cell reaches further than two neighbour spacings or five standard
       deviations of the Gaussians around.
    2. Each cell is shared among the Gaussians in proportion to their opacity there,
       :math:`A_i = \sum_j V_j \frac{g_i(x_j)}{\sum_l g_l(x_j)}`,
       :math:`g_i(x) = o_i \exp(-\lvert x - x_i \rvert^2 / (2 s_{i1} s_{i2}))`: a faint or tiny Gaussian among opaque
       ones carries little. This keeps the sum.

    Parallel sheets at least one neighbour spacing apart count separately; closer ones count as one. A Gaussian with
    fewer than three neighbours in reach keeps its :func:`patch_area`. Computed in float64 on the CPU, so the result is
    the same on every device; not differentiable.

    Args:
        means: Centres [scene units], shape (N, 3).
        normals: Unit normals, of either sign, shape (N, 3).
        log_scales: Logarithm of the standard deviations [scene units], shape (N, 3).
        opacity: Opacities from 0 to 1, shape (N,); None if all are equal.
        neighbours: Nearest centres to consider for each one, at least 6.

    Returns:
        Areas [scene units^2], finite and above zero, shape (N,).

    Raises:
        ValueError: If a tensor does not have the shape above, ``means`` is not finite or ``neighbours`` is below 6.
    """
    check_shape("means", means, None, 3)
    count = means.shape[0]
    check_shape("normals", normals, count, 3)
    check_shape("log_scales", log_scales, count, 3)
    if neighbours < 6:
        raise ValueError(f"Expected `neighbours` to be at least 6, but got {neighbours}.")
    if not bool(torch.isfinite(means).all()):
        raise ValueError("Expected `means` to be finite, but some are NaN or infinite; remove these Gaussians.")
    weight = torch.ones(count, dtype=torch.float64)
    if opacity is not None:
        check_shape("opacity", opacity, count)
        weight = opacity.detach().cpu().double().clamp_min(1e-6)
    if count == 0:
        return means.new_zeros(0)
    # Gaussians that share a centre form one site; its cell is shared among them by weight at the end.
    site, owner = torch.unique(means.detach().cpu().double(), dim=0, return_inverse=True)
    own_area = patch_area(log_scales.detach().cpu().double())
    load = weight * own_area
    order = torch.argsort(load, stable=True)
    rank = torch.empty(count, dtype=torch.long).scatter_(0, order, torch.arange(count))
    heaviest = torch.zeros(len(site), dtype=torch.long).scatter_reduce_(0, owner, rank, "amax", include_self=False)
    first = order[heaviest]  # the heaviest Gaussian of a site gives its normal and its size
    normal = torch.nn.functional.normalize(normals.detach().cpu().double()[first], dim=-1)
    disc = own_area[first]
    total = torch.zeros(len(site), dtype=torch.float64).index_add_(0, owner, weight)
    if len(site) > 3:
        distance, index = _nearest(site, min(neighbours, len(site) - 1))
        cell = torch.empty(len(site), dtype=torch.float64)
        share = torch.zeros(len(site), dtype=torch.float64)
        for start in range(0, len(site), 8192):
            rows = slice(start, start + 8192)
            offset = site[index[rows]] - site[rows, None]
            cell[rows], same = _cell_area(offset, distance[rows], normal[rows], disc[rows], disc[index[rows]], start)
            # g of every candidate at this site, the site's own Gaussians first
            exponent = -0.5 * math.pi * distance[rows].square() / disc[index[rows]]
            density = torch.cat([total[rows, None], torch.where(same, total[index[rows]] * exponent.exp(), 0)], dim=1)
            part = density * (cell[rows] / density.sum(1))[:, None]
            share[rows] += part[:, 0]
            share.index_add_(0, index[rows].reshape(-1), part[:, 1:].reshape(-1))
    else:
        share = disc
    load_of_site = torch.zeros(len(site), dtype=torch.float64).index_add_(0, owner, load)
    areas = share[owner] * load / load_of_site[owner]
    return areas.to(means).clamp_min(torch.finfo(means.dtype).tiny)


def _cell_area(
    offset: Tensor, distance: Tensor, normal: Tensor, disc: Tensor, discs: Tensor, phase: int
) -> tuple[Tensor, Tensor]:
    """Areas of the Voronoi cells (B,) in the tangent planes, and which neighbours (B, k) lie on the same sheet."""
    # Clusters, such as the clones that densification leaves, count once in the estimate of the spacing.
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

    # Each cell has its own turn of the rays, spread evenly, so that the error of the quadrature averages out.
    turn = torch.arange(phase, phase + len(offset), dtype=torch.float64) * 0.6180339887498949 % 1
    angle = (turn[:, None] + torch.arange(_RAYS)) * (2 * math.pi / _RAYS)
    ray = torch.stack([angle.cos(), angle.sin()], dim=-1)
    along = ray @ flat.mT  # (B, rays, k)
    facing = same[:, None] & (along > 0)
    reach = torch.where(facing, 0.5 * squared[:, None] / along, torch.inf).amin(-1)
    cosine = torch.where(same[:, None], along / squared.sqrt().clamp_min(1e-300)[:, None], -1).amax(-1)

    found = same.sum(-1, keepdim=True)
    local_size = ((disc[:, None] + (same * discs).sum(-1, keepdim=True)) / (math.pi * (1 + found))).sqrt()
    limit = torch.minimum(_SPIKE * spacing[:, None], _REACH * local_size)
    # A direction is open if no neighbour lies within an angle of it that m random ones leave empty by chance with
    # probability _FALSE_EDGE; 60 degrees for m = 16, and less than the 90 degrees that a straight edge leaves empty.
    half_angle = (math.pi * (1 - _FALSE_EDGE ** (1 / (same & ~repeat).sum(-1, keepdim=True).clamp_min(1)))).clamp(
        math.radians(50), math.radians(85)
    )
    open_cosine = half_angle.cos()
    # Where the surface ends: up to three straight edges, each as far out as the cell reaches on the other side.
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


def _nearest(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Distances (N, k), ascending, and indices (N, k) of the nearest other points, by grids that coarsen.

    A point is settled on the first grid whose 27 cells around it hold k others within one cell size; only the points
    not settled yet go on to the grid of twice the cell size. Memory is bounded by chunks of candidate pairs.
    """
    total = len(points)
    low = points.amin(0)
    extent = float((points.amax(0) - low).amax())
    distance = torch.empty(total, count, dtype=points.dtype)
    index = torch.empty(total, count, dtype=torch.long)
    shifts = torch.cartesian_prod(*(torch.arange(-1, 2),) * 3)
    pending = torch.arange(total)
    level = _first_level(points, low, extent)
    while len(pending):
        size = extent * 2.0**-level
        cells = ((points - low) / size).floor().long()
        key, order = _cell_key(cells).sort(stable=True)
        wanted = _cell_key(cells[pending, None] + shifts)
        begin = torch.searchsorted(key, wanted)
        length = torch.searchsorted(key, wanted, right=True) - begin
        candidates = length.sum(-1)
        last = level <= 0
        keep = torch.nonzero(candidates > count).squeeze(-1)
        keep = keep[candidates[keep].argsort(stable=True)]  # rows of one chunk need about the same width
        settled = torch.zeros(len(pending), dtype=torch.bool)
        start = 0
        while start < len(keep):
            width = max(1, 4_000_000 // int(candidates[keep[min(start + 20_000, len(keep) - 1)]]))
            rows = keep[start : start + min(width, 20_000)]
            start += len(rows)
            near, who = _nearest_among(points, pending[rows], order, begin[rows], length[rows], count)
            done = torch.ones(len(rows), dtype=torch.bool) if last else near[:, -1] <= size
            distance[pending[rows[done]]], index[pending[rows[done]]] = near[done], who[done]
            settled[rows[done]] = True
        pending = pending[~settled]
        level -= 1
    return distance, index


def _first_level(points: Tensor, low: Tensor, extent: float) -> int:
    """The coarsest grid, as halvings of the extent, with at most 32 points in a cell; none is finer than 2^-40."""
    for level in range(1, 40):
        cells = ((points - low) / (extent * 2.0**-level)).floor().long()
        if int(_cell_key(cells).unique(return_counts=True)[1].max()) <= 32:
            return level
    return 40


def _cell_key(cells: Tensor) -> Tensor:
    """One number per cell (..., 3); cells 2^20 apart share it, which only adds candidates that are too far away."""
    x, y, z = (cells & (2**20 - 1)).unbind(-1)
    return (x << 40) | (y << 20) | z


def _nearest_among(
    points: Tensor, query: Tensor, order: Tensor, begin: Tensor, length: Tensor, count: int
) -> tuple[Tensor, Tensor]:
    """The nearest of the points in 27 runs (B, 27) of ``order`` for each query (B,), other than itself."""
    ends = length.cumsum(-1)
    column = torch.arange(int(ends[:, -1].max()))
    run = torch.searchsorted(ends, column.expand(len(query), -1).contiguous(), right=True).clamp_max(26)
    place = begin.gather(-1, run) + column - (ends - length).gather(-1, run)
    who = order[place.clamp_max(len(points) - 1)]
    squared = (points[who] - points[query, None]).square().sum(-1)
    squared = squared.masked_fill((column >= ends[:, -1:]) | (who == query[:, None]), torch.inf)
    nearest, at = squared.topk(count, dim=-1, largest=False, sorted=True)
    return nearest.sqrt(), who.gather(-1, at)


@dataclass(frozen=True, slots=True)
class DeformedGaussians:
    """What a renderer and a shader need of Gaussians after a deformation.

    Attributes:
        means: Centres [scene units], shape (..., N, 3).
        covariances: Covariances F A F^T [scene units^2], shape (..., N, 3, 3).
        normals: Unit normals F^-T N, shape (..., N, 3).
    """

    means: Tensor
    covariances: Tensor
    normals: Tensor


class GaussianSurfaceModel(nn.Module):
    """3D Gaussians as surface patches (Gaussian Swaying, "Surface Formulation").

    Parameters in storage form, with the names of gsplat: ``means`` (N, 3), ``quats`` (N, 4) wxyz, ``scales`` (N, 3) as
    logarithms, ``opacities`` (N,) as logits, ``sh0`` (N, 1, 3) and ``shN`` (N, K - 1, 3).

    Args:
        cloud: Gaussians to start from; their tensors are copied.
        requires_grad: Whether the parameters are to be trained.
    """

    reference_normals: Tensor | None

    def __init__(self, cloud: GaussianCloud, requires_grad: bool = True) -> None:
        super().__init__()

        def parameter(tensor: Tensor) -> nn.Parameter:
            return nn.Parameter(tensor.detach().clone(), requires_grad=requires_grad)

        self.means = parameter(cloud.means)
        self.quats = parameter(cloud.quats)
        self.scales = parameter(cloud.scales)
        self.opacities = parameter(cloud.opacities)
        self.sh0 = parameter(cloud.sh[:, :1])
        self.shN = parameter(cloud.sh[:, 1:])
        self.register_buffer("reference_normals", None if cloud.normals is None else cloud.normals.detach().clone())

    @classmethod
    def from_cloud(cls, cloud: GaussianCloud, requires_grad: bool = True) -> GaussianSurfaceModel:
        """The model of given Gaussians."""
        return cls(cloud, requires_grad)

    @classmethod
    def from_ply(cls, path: str | os.PathLike[str], requires_grad: bool = True) -> GaussianSurfaceModel:
        """The model of the Gaussians in a file, with the errors of :func:`gaussian_swaying.gaussians.ply.read_ply`."""
        return cls(read_ply(path), requires_grad)

    def to_cloud(self) -> GaussianCloud:
        """The Gaussians in storage form, detached; they share memory with the parameters except for ``sh``."""
        return GaussianCloud(
            means=self.means.detach(),
            quats=self.quats.detach(),
            scales=self.scales.detach(),
            opacities=self.opacities.detach(),
            sh=self.sh.detach(),
            normals=self.reference_normals,
        )

    def save_ply(self, path: str | os.PathLike[str]) -> None:
        """Write a 3DGS file, with the errors of :func:`gaussian_swaying.gaussians.ply.write_ply`."""
        write_ply(path, self.to_cloud())

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def sh(self) -> Tensor:
        """All spherical harmonics coefficients, shape (N, K, 3)."""
        return torch.cat([self.sh0, self.shN], dim=1)

    def covariance(self) -> Tensor:
        """Covariances at rest [scene units^2], shape (N, 3, 3)."""
        return covariance(self.quats, self.scales)

    def normals(self) -> Tensor:
        """Unit normals at rest along the smallest axes, on the side of the file's normals if it had any, (N, 3)."""
        normals = smallest_axis_normal(self.quats, self.scales)
        if self.reference_normals is None:
            return normals
        return torch.where((normals * self.reference_normals).sum(-1, keepdim=True) < 0, -normals, normals)

    def areas(self, mode: str = "coverage", neighbours: int = 24) -> Tensor:
        """Patch areas at rest [scene units^2], shape (N,).

        Args:
            mode: "paper" for :func:`patch_area`, which is differentiable, or "coverage" for :func:`coverage_area`.
            neighbours: Nearest centres that "coverage" considers.

        Returns:
            Shape (N,).

        Raises:
            ValueError: If ``mode`` is neither.
        """
        check_choice("mode", mode, ("paper", "coverage"))
        if mode == "paper":
            return patch_area(self.scales)
        return coverage_area(self.means, self.normals(), self.scales, self.opacity(), neighbours)

    def opacity(self) -> Tensor:
        """Opacities from 0 to 1, shape (N,)."""
        return self.opacities.sigmoid()

    def colors(self, directions: Tensor) -> Tensor:
        """RGB colours seen along directions from the camera (..., N, 3) of any length above zero; shape (..., N, 3)."""
        return sh_to_color(self.sh, directions)

    def deformed(self, position: Tensor, deformation_gradient: Tensor) -> DeformedGaussians:
        """The Gaussians after a deformation.

        Args:
            position: Deformed centres [scene units], shape (..., N, 3).
            deformation_gradient: Total deformation gradients, shape (..., N, 3, 3).

        Returns:
            Centres, covariances and normals.

        Raises:
            ValueError: If a tensor does not have the shape above.
        """
        check_shape("position", position, len(self), 3)
        check_shape("deformation_gradient", deformation_gradient, len(self), 3, 3)
        return DeformedGaussians(
            means=position,
            covariances=deform_covariance(deformation_gradient, self.covariance()),
            normals=deform_normal(deformation_gradient, self.normals()),
        )
