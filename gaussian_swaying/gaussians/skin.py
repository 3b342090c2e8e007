"""Gaussians that follow the points of another solver: a cloth, a mesh, a skeleton, particles."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from gaussian_swaying._checks import check_like, check_shape
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import Fixed
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.model import DeformedGaussians, GaussianSurfaceModel
from gaussian_swaying.geometry.linalg import entries, matrix
from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy9,
    cross3,
    dot3,
    load3,
    load9,
    matvec,
    outer3,
    plus_identity,
    scale3,
    store3,
    where3,
    where9,
)
from gaussian_swaying.geometry.neighbours import nearest_neighbours
from gaussian_swaying.geometry.patches import area_vector, deform_all, deform_and_store
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch, replaces

FLAT = 0.02
"""Ratio of two moments of the neighbours below which they are a sheet or a line: a thickness of 0.14 of their width."""
WIDTH = 32
"""Gaussians that lie together in memory."""
NEIGHBOURS = 12
"""Points that a Gaussian follows: twice what a quadratic in a sheet has terms."""
_HOPS = 4  # edges between the nearest point and the others that a Gaussian follows
_FAR = 2.0  # distances between points beyond which a Gaussian is not in the material
_FOCUS = 7.0  # weights of neighbours are exp(-7 (d / s)²), where s is the distance of the fourth one for each direction
_RIDGE = 1e-6  # weight of curvature that the neighbours do not determine
_CHUNK = 1 << 16  # Gaussians that are bound at once


@triton.jit
def completed(G, axis, kind):
    """F of a Gaussian from the gradient of the displacement along the directions that its neighbours span.

    ``axis`` is the unit normal of a sheet (``kind`` 2), which stays normal and keeps its thickness (Kirchhoff's
    hypothesis), or the unit tangent of a line (``kind`` 1), which turns by the smallest rotation.
    """
    F = plus_identity(G)
    across, _det = area_vector(F, axis)
    size = tl.sqrt(dot3(across, across))
    normal = where3(size > 0, scale3(1.0 / tl.where(size > 0, size, 1.0), across), axis)
    sheet = axpy9(1.0, F, 1.0, outer3(add3(normal, -1.0, axis), axis))
    along = matvec(F, axis)
    size = tl.sqrt(dot3(along, along))
    tangent = where3(size > 0, scale3(1.0 / tl.where(size > 0, size, 1.0), along), axis)
    v = cross3(axis, tangent)
    c = dot3(axis, tangent)
    turn = (c, -v[2], v[1], v[2], c, -v[0], -v[1], v[0], c)
    turn = axpy9(1.0, turn, 1.0, outer3(scale3(1.0 / tl.maximum(1.0 + c, 1e-6), v), v))
    line = axpy9(1.0, turn, 1.0, outer3(scale3(size - 1.0, tangent), axis))
    return where9(kind == 2, sheet, where9(kind == 1, line, F))


@triton.jit
def _skin(
    moved, gradient, index, weight, slopes, arm, axis, kind, means, covariance, normal,
    means_out, covariance_out, normal_out, rotation_out, count,
    K: tl.constexpr, WIDTH: tl.constexpr, GIVEN: tl.constexpr, TURN: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One Gaussian per lane."""
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = lane < count
    nil = 0.0 * tl.load(means + lane, mask, 0.0)
    u = (nil, nil, nil)
    G = (nil, nil, nil, nil, nil, nil, nil, nil, nil)
    start = tl.program_id(0) * BLOCK
    column = start % WIDTH + tl.arange(0, BLOCK)
    first = (start // WIDTH) * (WIDTH * K)
    for k in range(K):
        near = first + WIDTH * k + column
        place = tl.load(index + near, mask, 0)
        w = tl.load(weight + near, mask, 0.0)
        step = load3(moved, 1, 3 * place, mask)
        u = add3(u, w, step)
        if GIVEN:
            G = axpy9(w, load9(gradient, 1, 9 * place, mask), 1.0, G)
        else:
            slope = load3(slopes, WIDTH, 3 * (first + WIDTH * k) + column, mask)
            G = axpy9(1.0, outer3(step, slope), 1.0, G)
    if GIVEN:
        F = plus_identity(G)
    else:
        F = completed(G, load3(axis, 1, 3 * lane, mask), tl.load(kind + lane, mask, 3))
    a = load3(arm, 1, 3 * lane, mask)
    x = add3(add3(load3(means, 1, 3 * lane, mask), 1.0, u), 1.0, add3(matvec(F, a), -1.0, a))
    store3(means_out, 1, 3 * lane, x, mask)
    deform_and_store(
        F, covariance, normal, kind, covariance_out, normal_out, rotation_out, 1.0, lane, mask, TURN, False
    )


class SplatSkin(Fixed, nn.Module):
    r"""Moves Gaussians with points that any solver moves.

    The displacement of a Gaussian is that of a quadratic fitted to its nearest points by moving least squares
    (Lancaster & Salkauskas 1981), in as many directions as they span: along a line, in a sheet, or in space. The fit is
    linear in what the points do, so that :math:`u = \sum_k \phi_k u_k` and
    :math:`F = I + \sum_k u_k \otimes \nabla \phi_k`, with constant weights. Across a sheet F keeps the thickness, and
    around a line it turns by the smallest rotation. A rigid motion of the whole comes out exactly, but for the twist of
    a line, and in a solid any affine map does.

    Args:
        gaussians: The Gaussians at rest. Those of a model keep their gradients; they stay bound to the points that were
            close to them at first.
        points: Points of the solver at rest, in scene units, shape (P, 3).
        faces: Triangles, tetrahedra or edges between the points, shape (T, 2 to 4). A Gaussian then follows only points
            within four edges of its nearest one, not those of a sheet close by.

    Raises:
        ValueError: If a tensor does not have the shape above, or a point is not finite.
    """

    rest: Tensor
    index: Tensor
    weight: Tensor
    slope: Tensor
    arm: Tensor
    axis: Tensor
    dimensions: Tensor
    _covariances: Tensor
    _normals: Tensor

    def __init__(
        self,
        gaussians: GaussianSurfaceModel | GaussianCloud,
        points: Tensor,
        faces: Tensor | None = None,
    ) -> None:
        super().__init__()
        if isinstance(gaussians, GaussianCloud):
            gaussians = GaussianSurfaceModel(gaussians, requires_grad=False, copy=False)
        check_shape("points", points, None, 3, batches=False)
        if len(points) == 0 or not bool(torch.isfinite(points).all()):
            raise ValueError("Expected `points` to be one finite place or more: leave out what the solver has lost.")
        self.gaussians = gaussians
        device, kind = gaussians.means.device, gaussians.means.dtype
        rest = in_double(points.detach().cpu())
        reach = None if faces is None else _reach(faces, len(rest))
        places, spacing = in_double(gaussians.means.detach().cpu()), _spacing(rest)
        parts = [_bound(rest, part, spacing, reach) for part in places.split(_CHUNK)]
        index, weight, slope, arm, axis, dimensions = (torch.cat(part) for part in zip(*parts, strict=True))
        self.register_buffer("rest", points.detach().to(device, kind))
        self.register_buffer("index", _together(index).to(device, torch.int32))
        self.register_buffer("weight", _together(weight).to(device, kind))
        self.register_buffer("slope", _together(slope).to(device, kind))
        self.register_buffer("arm", arm.to(device, kind))
        self.register_buffer("axis", axis.to(device, kind))
        self.register_buffer("dimensions", dimensions.to(device, torch.int8))
        self.register_buffer("_covariances", gaussians.covariance().detach())
        self.register_buffer("_normals", gaussians.normals().detach())

    def forward(self, points: Tensor, deformation_gradient: Tensor | None = None) -> DeformedGaussians:
        """The Gaussians where the points have moved.

        Args:
            points: Places of the points [scene units], shape (..., P, 3).
            deformation_gradient: F of the points in the axes of the scene, shape (..., P, 3, 3), if the solver knows
                it; the Gaussians then take it from there.

        Returns:
            Centres, covariances F A Fᵀ, normals and rotations; these are identities if no colour depends on the
            direction of view.

        Raises:
            ValueError: If a tensor does not have the shape above.
        """
        self._check(points, deformation_gradient)
        given = [points] if deformation_gradient is None else [points, deformation_gradient]
        turn, count = self.gaussians.view_dependent, len(self.gaussians)
        eye = torch.eye(3, dtype=points.dtype, device=points.device)
        if points.dim() == 2 and replaces([*given, *self.gaussians.parameters()]):
            moved = (points - self.rest).contiguous()
            gradient = moved if deformation_gradient is None else (deformation_gradient - eye).contiguous()
            own = self.gaussians.means.detach(), self._covariances, self._normals
            made = [torch.empty_like(tensor) for tensor in own]
            turns = torch.empty_like(own[1]) if turn else eye.expand(count, 3, 3)
            block = lanes(points.device, WIDTH)
            if count:
                with torch.cuda.device_of(points):
                    launch(_skin, (triton.cdiv(count, block),))(
                        moved, gradient, self.index, self.weight, self.slope, self.arm, self.axis, self.dimensions,
                        *own, *made, turns if turn else made[1], count, K=self.index.shape[1],
                        WIDTH=WIDTH, GIVEN=deformation_gradient is not None, TURN=turn, BLOCK=block, num_warps=1,
                    )  # fmt: skip
            return DeformedGaussians(made[0], made[1], made[2], turns, model=self.gaussians)
        means, F = self.motion(points, deformation_gradient)
        covariances, normals, rotations = deform_all(
            F, self.gaussians.covariance(), self.gaussians.normals(), rotations=turn
        )
        if rotations is None:
            rotations = eye.expand(*means.shape[:-1], 3, 3)
        return DeformedGaussians(means, covariances, normals, rotations, model=self.gaussians)

    def motion(self, points: Tensor, deformation_gradient: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Centres (..., N, 3) and deformation gradients (..., N, 3, 3) of the Gaussians, as :meth:`forward`."""
        self._check(points, deformation_gradient)
        moved = self._gathered(points - self.rest)
        eye = torch.eye(3, dtype=points.dtype, device=points.device)
        if deformation_gradient is None:
            G = self._apart(torch.einsum("...bkli,bkjl->...blij", moved, self.slope), 3)
            F = matrix(on_tensors(completed)(entries(G), self.axis.unbind(-1), self.dimensions))
        else:
            rows = self._gathered((deformation_gradient - eye).flatten(-2))
            F = eye + self._averaged(rows).unflatten(-1, (3, 3))
        turned = ((F - eye) @ self.arm[..., None])[..., 0]
        return self.gaussians.means + self._averaged(moved) + turned, F

    def velocity(self, velocity: Tensor) -> Tensor:
        """Velocity of the Gaussians, shape (..., N, 3), from that of the points, shape (..., P, 3)."""
        check_shape("velocity", velocity, len(self.rest), 3)
        return self._averaged(self._gathered(velocity))

    def spread(self, force: Tensor) -> Tensor:
        """Forces on the points, shape (..., P, 3), from forces on the Gaussians, shape (..., N, 3).

        They have the same sum, and the same power at any motion of the points (the transpose of :meth:`velocity`).
        """
        check_shape("force", force, len(self.gaussians), 3)
        padded = torch.nn.functional.pad(force, (0, 0, 0, -len(self.gaussians) % WIDTH))
        shares = self.weight[..., None] * padded.unflatten(-2, (-1, 1, WIDTH))
        found = force.new_zeros(*force.shape[:-2], len(self.rest), 3)
        return found.index_add(-2, self.index.flatten().long(), shares.flatten(-4, -2))

    def _gathered(self, values: Tensor) -> Tensor:
        """Values of the points (..., P, C) at the neighbours, shape (..., B, K, WIDTH, C)."""
        return values.index_select(-2, self.index.flatten().long()).unflatten(-2, tuple(self.index.shape))

    def _averaged(self, gathered: Tensor) -> Tensor:
        """Values at the neighbours, at the Gaussians: shape (..., N, C)."""
        return self._apart(torch.einsum("...bkli,bkl->...bli", gathered, self.weight), 2)

    def _apart(self, values: Tensor, last: int) -> Tensor:
        """Values (..., B, WIDTH, ...) of the Gaussians in one row; ``last`` counts from the dimension WIDTH."""
        return values.flatten(-last - 1, -last).narrow(-last, 0, len(self.gaussians))

    def _check(self, points: Tensor, deformation_gradient: Tensor | None) -> None:
        check_shape("points", points, len(self.rest), 3)
        check_like("points", points, self.rest, "the Gaussians are")
        if deformation_gradient is not None:
            check_shape("deformation_gradient", deformation_gradient, len(self.rest), 3, 3)
            check_like("deformation_gradient", deformation_gradient, self.rest, "the Gaussians are")


def _together(rows: Tensor) -> Tensor:
    """Rows (N, ..., K) as (B, K, ..., WIDTH), so that a Gaussian's neighbours lie close in memory."""
    padded = torch.cat([rows, rows.new_zeros(-len(rows) % WIDTH, *rows.shape[1:])])
    return padded.unflatten(0, (-1, WIDTH)).movedim(1, -1).movedim(-2, 1).contiguous()


def _spacing(points: Tensor) -> Tensor:
    """Distance from each point to the fourth nearest other one, shape (P,); infinite for a single one."""
    if len(points) == 1:
        return torch.full((1,), torch.inf, dtype=points.dtype)
    return nearest_neighbours(points, min(4, len(points) - 1))[0][:, -1]


def _reach(faces: Tensor, count: int) -> Tensor:
    """Pairs of points within some edges of each other, as sorted numbers ``first * count + second``."""
    from scipy.sparse import coo_array, eye_array

    check_shape("faces", faces, None, None, batches=False)
    known = faces.detach().cpu().long()
    if known.numel() and not 0 <= int(known.min()) <= int(known.max()) < count:
        raise ValueError(f"Expected `faces` to number points from 0 to {count - 1}, but got {int(known.max())}.")
    corners = known.shape[1]
    pairs = torch.cat([known[:, [i, j]] for i in range(corners) for j in range(corners) if i != j]).numpy()
    near = coo_array(([True] * len(pairs), (pairs[:, 0], pairs[:, 1])), shape=(count, count)).tocsr()
    near = (near + eye_array(count, dtype=bool)).tocsr()
    found: Any = near
    for _ in range(_HOPS - 1):
        found = found @ near
    found = found.tocoo()
    return torch.from_numpy(found.row.astype("int64") * count + found.col).sort()[0]


def _bound(
    points: Tensor, places: Tensor, spacing: Tensor, reach: Tensor | None
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Neighbours of places (N, K), their weights (N, K) and slopes (N, 3, K), and what no fit tells.

    That is the arm from where the fit is read (N, 3), the axis of :func:`completed` (N, 3), and the number of
    directions that the neighbours span (N,).
    """
    count = min(NEIGHBOURS, len(points))
    candidates = min(count if reach is None else 3 * count, len(points))
    distance, index = nearest_neighbours(points, candidates, places)
    first = index[:, 0].clone()
    far = distance[:, 0] > _FAR * spacing[first]
    read = torch.where(far[:, None], points[first], places)
    if bool(far.any()):
        distance[far], index[far] = nearest_neighbours(points, candidates, read[far])
    allowed = torch.ones_like(index, dtype=torch.bool)
    if reach is not None:
        pair = first[:, None] * len(points) + index
        allowed = reach[torch.searchsorted(reach, pair).clamp_max(len(reach) - 1)] == pair
        order = torch.where(allowed, distance, torch.inf).argsort(stable=True)[:, :count]
        distance, index, allowed = (part.gather(1, order) for part in (distance, index, allowed))
    distance = torch.where(allowed, distance, 0.0)
    radius = distance.amax(1, keepdim=True).clamp_min(1e-30)
    near = (points[index] - read[:, None]) / radius[..., None]
    share = allowed / allowed.sum(1, keepdim=True)
    middle = near - (share[..., None] * near).sum(1, keepdim=True)
    moments, axes = torch.linalg.eigh(torch.einsum("nk,nki,nkj->nij", share, middle, middle))
    moments, axes = moments.flip(-1).clamp_min(0.0), axes.flip(-1)  # the longest first
    spans = torch.stack(
        [moments[:, 0] > 1e-12, moments[:, 1] > FLAT * moments[:, 0], moments[:, 2] > FLAT * moments[:, 1]], -1
    ).cumprod(-1)  # directions beyond the first one that is missing are missing, too
    dimensions = spans.sum(-1)
    q = (near @ axes) * spans[:, None].to(near)
    x, y, z = q.unbind(-1)
    terms = torch.stack([torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, y * z, z * x], -1)
    used = torch.cat([torch.ones_like(spans[:, :1]), spans, spans, spans[:, [1, 2, 2]]], -1)
    rank = torch.minimum(4 * dimensions, allowed.sum(1)).clamp_min(1) - 1
    size = distance.gather(1, rank[:, None]).clamp_min(1e-30)
    weight = torch.where(allowed, (-_FOCUS * (distance / size) ** 2).exp(), 0.0)
    loaded = weight[..., None] * terms
    ridge = torch.where(used > 0, terms.new_tensor([0.0] * 4 + [_RIDGE] * 6) * weight.sum(1, keepdim=True), 1.0)
    rows = torch.linalg.solve(loaded.mT @ terms + torch.diag_embed(ridge), loaded.mT)[:, :4]
    slope = rows[:, 1:] * spans[..., None].to(rows) / radius[..., None]  # (N, 3, K), along the axes
    position = points[index]
    tangents = torch.einsum("nki,njk->nij", position, slope)  # those of the fitted surface, as columns
    gram = tangents.mT @ tangents + torch.diag_embed(1 - spans.to(tangents))
    slope = tangents @ torch.linalg.solve(gram, slope)  # so that the sum of X and its slopes is a projection
    line, sheet = tangents[..., 0], torch.linalg.cross(tangents[..., 0], tangents[..., 1])
    axis = torch.where((dimensions == 2)[:, None], sheet, torch.where((dimensions == 1)[:, None], line, axes[..., 0]))
    axis = torch.nn.functional.normalize(axis, dim=-1)
    arm = places - torch.einsum("nk,nki->ni", rows[:, 0], position)
    return index, rows[:, 0], slope, arm, axis, dimensions
