"""Gaussians as surface patches: normal and area, and how they follow a deformation."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.geometry.covariances import deform_covariance
from gaussian_swaying.geometry.linalg import entries, matrix, polar_rotation, vectors
from gaussian_swaying.geometry.linalg_triton import (
    axpy9,
    cofactor,
    dot3,
    load3,
    load9,
    matmul,
    matvec,
    scale3,
    store3,
    store9,
    transpose,
    where3,
    where9,
)
from gaussian_swaying.geometry.linalg_triton import (
    polar_rotation as polar,
)
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch, replaces

BLOCK = 128


@triton.jit
def area_vector(F, n):
    """cof(F) N, which is as long as the area has grown (Nanson's formula), and det F."""
    c = cofactor(F)
    return matvec(c, n), dot3(F, c)


@triton.jit
def deformed_patch(F, n, area, max_ratio):
    """Unit normal and area after a deformation, from one cofactor matrix; no area grows beyond ``max_ratio``.

    Where cof(F) N is zero, because F flattens the patch to a line, the normal at rest stays.
    """
    vector, det = area_vector(F, n)
    size = tl.sqrt(dot3(vector, vector))
    flat = size == 0
    scale = tl.where(det < 0, -1.0, 1.0) / tl.where(flat, 1.0, size)
    normal = where3(flat, n, scale3(scale, vector))
    return normal, tl.minimum(size, max_ratio) * area


@triton.jit
def deformed_normal(F, n):
    """The normal of :func:`deformed_patch`, scaled so that squares cannot underflow."""
    v, det = area_vector(F, n)
    largest = tl.maximum(tl.abs(v[0]), tl.maximum(tl.abs(v[1]), tl.abs(v[2])))
    flat = largest == 0
    scale = tl.where(flat, 1.0, largest)
    scale = tl.where(det < 0, -scale, scale)
    v = where3(flat, n, (v[0] / scale, v[1] / scale, v[2] / scale))
    size = tl.sqrt(dot3(v, v))
    return v[0] / size, v[1] / size, v[2] / size


@triton.jit
def _limited(drawn, rest, turn, solid, square):
    r"""Covariance of a Gaussian that is not stretched too far; ``square`` is that of the largest stretch.

    The size of a Gaussian is :math:`\sqrt{\operatorname{tr} a}`. Where it is :math:`r` times that at rest and
    :math:`r > r_{max}`, the covariance becomes

    .. math::
        w\, a + (1 - w)\, B, \qquad w = \frac{r_{max}^2 - 1}{r^2 - 1},

    whose size is :math:`r_{max}` times that at rest: a slightly stretched B instead of a streak. For a solid, B is the
    shape at rest, turned with the material; for a grain, which has lost its shape, a ball. Gaussians below the limit do
    not change, and the result is continuous at the limit.
    """
    size = rest[0] + rest[4] + rest[8]
    excess = (square - 1) * size
    over = drawn[0] + drawn[4] + drawn[8] - size
    weight = excess / tl.maximum(tl.maximum(over, excess), 1e-37)
    ball, nil = size / 3, 0.0 * size
    shape = matmul(matmul(turn, rest), transpose(turn))
    shape = where9(solid, shape, (ball, nil, nil, nil, ball, nil, nil, nil, ball))
    return where9(over > excess, axpy9(weight, drawn, 1 - weight, shape), drawn)


@triton.jit
def deform_and_store(
    f, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, index, mask,
    TURN: tl.constexpr, LIMIT: tl.constexpr,
):  # fmt: skip
    """Covariance, normal and rotation of some patches after a deformation ``f``, as :func:`deform_all`."""
    a = load9(covariance, 1, 9 * index, mask)
    drawn = matmul(matmul(f, a), transpose(f))
    if LIMIT:
        drawn = _limited(drawn, a, polar(f), tl.load(solid + index, mask, 1) != 0, square)
    store9(covariance_out, 1, 9 * index, drawn, mask)
    n = load3(normal, 1, 3 * index, mask)
    store3(normal_out, 1, 3 * index, deformed_normal(f, n), mask)
    if TURN:
        store9(rotation_out, 1, 9 * index, polar(f), mask)


@triton.jit
def _deform(
    F, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, count,
    TURN: tl.constexpr, LIMIT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    f = load9(F, 1, 9 * index, mask)
    deform_and_store(
        f, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, index, mask, TURN, LIMIT
    )


def smallest_axis_normal(quats: Tensor, log_scales: Tensor) -> Tensor:
    """Unit normals along the smallest axis of each Gaussian (Guedon & Lepetit 2024, "SuGaR").

    The sign is that of the axis in the rotation matrix, so it does not tell inside from outside.

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).
        log_scales: Logarithm of the standard deviations [scene units], shape (..., 3).

    Returns:
        Shape (..., 3).
    """
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
    """
    return vectors(on_tensors(deformed_normal)(entries(deformation_gradient), normals.unbind(-1)))


def deform_patch(deformation_gradient: Tensor, normals: Tensor, areas: Tensor) -> tuple[Tensor, Tensor]:
    r"""Normals and areas after a deformation, from one cofactor matrix.

    Normals as :func:`deform_normal`; areas :math:`a = \lVert \operatorname{cof}(F) N \rVert A` (Nanson's formula).

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        normals: Unit normals N at rest, shape (..., 3).
        areas: Areas A at rest [scene units^2], shape (...).

    Returns:
        Shapes (..., 3) and (...).
    """
    given = entries(deformation_gradient), normals.unbind(-1), areas
    normal, area = on_tensors(deformed_patch)(*given, math.inf)
    return vectors(normal), area


def deform_all(
    deformation_gradient: Tensor,
    covariances: Tensor,
    normals: Tensor,
    rotations: bool = True,
    max_stretch: float | None = None,
    solid: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Covariances, normals and rotations after a deformation; in float32 without gradients in one kernel.

    Args:
        deformation_gradient: Total deformation gradient F, shape (N, 3, 3).
        covariances: Covariances A at rest [scene units^2], shape (N, 3, 3).
        normals: Unit normals N at rest, shape (N, 3).
        max_stretch: Largest ratio of the sizes, above 1; None for none.
        solid: Which Gaussians are solid, bool, shape (N,); needed with ``max_stretch``.

    Returns:
        :func:`deform_covariance` within the limit, :func:`deform_normal` and
        :func:`~gaussian_swaying.geometry.linalg.polar_rotation`, or None in its place.
    """
    tensors = (deformation_gradient, covariances, normals)
    if replaces(tensors):
        return _deform_all(*tensors, rotations, max_stretch, solid)
    drawn = deform_covariance(deformation_gradient, covariances)
    turns = None if not rotations and max_stretch is None else polar_rotation(deformation_gradient)
    if max_stretch is not None and solid is not None and turns is not None:
        drawn = matrix(on_tensors(_limited)(*map(entries, (drawn, covariances, turns)), solid, max_stretch**2))
    return drawn, deform_normal(deformation_gradient, normals), turns if rotations else None


def _deform_all(
    deformation_gradient: Tensor,
    covariances: Tensor,
    normals: Tensor,
    rotations: bool,
    max_stretch: float | None = None,
    solid: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """:func:`deform_all` in one kernel; float32, without gradient."""
    shape = deformation_gradient.shape[:-2]
    count = shape.numel()
    given = [deformation_gradient, covariances.expand(*shape, 3, 3), normals.expand(*shape, 3)]
    F, covariance, normal = (tensor.detach().contiguous() for tensor in given)
    made = [torch.empty_like(F), torch.empty_like(normal), torch.empty_like(F) if rotations else F]
    limit = max_stretch is not None and solid is not None
    keeps = F if solid is None or not limit else solid.contiguous().view(torch.int8)
    block = lanes(F.device, BLOCK)
    if count > 0:
        with torch.cuda.device_of(F):
            launch(_deform, (triton.cdiv(count, block),))(
                F, covariance, normal, keeps, *made, float(max_stretch or 1) ** 2, count,
                TURN=rotations, LIMIT=limit, BLOCK=block,
            )  # fmt: skip
    return made[0], made[1], made[2] if rotations else None
