"""One kernel for the fields of deformed patches that a picture needs; the definitions are in ``patches``."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg_triton import (
    axpy9,
    cofactor,
    determinant,
    dot3,
    load3,
    load9,
    matmul,
    matvec,
    polar_rotation,
    scale3,
    store3,
    store9,
    transpose,
    where3,
    where9,
)
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.kernels.launch import lanes, launch

BLOCK = 128


@triton.jit
def area_vector(F, n):
    """cof(F) N, which is as long as the area has grown (Nanson's formula), and det F."""
    c = cofactor(F)
    return matvec(c, n), determinant(F, c)


@triton.jit
def deform_patch(F, n, area, max_ratio):
    """Unit normal and area after a deformation, as ``patches.deform_patch``; no area grows beyond ``max_ratio``."""
    vector, det = area_vector(F, n)
    size = tl.sqrt(dot3(vector, vector))
    flat = size == 0
    scale = tl.where(det < 0, -1.0, 1.0) / tl.where(flat, 1.0, size)
    normal = where3(flat, n, scale3(scale, vector))
    return normal, tl.minimum(size, max_ratio) * area


@triton.jit
def _limited(drawn, rest, turn, solid, square):
    """See ``covariances.limit_deformed``; ``square`` is that of the largest stretch."""
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
    """Covariance, normal and rotation of some patches after a deformation ``f``, as ``patches.deform_all``."""
    a = load9(covariance, 1, 9 * index, mask)
    drawn = matmul(matmul(f, a), transpose(f))
    if LIMIT:
        drawn = _limited(drawn, a, polar_rotation(f), tl.load(solid + index, mask, 1) != 0, square)
    store9(covariance_out, 1, 9 * index, drawn, mask)
    n = load3(normal, 1, 3 * index, mask)
    v, det = area_vector(f, n)
    # scaled, so that squares cannot underflow
    largest = tl.maximum(tl.abs(v[0]), tl.maximum(tl.abs(v[1]), tl.abs(v[2])))
    flat = largest == 0
    scale = tl.where(flat, 1.0, largest)
    scale = tl.where(det < 0, -scale, scale)
    v = where3(flat, n, (v[0] / scale, v[1] / scale, v[2] / scale))
    size = tl.sqrt(dot3(v, v))
    store3(normal_out, 1, 3 * index, (v[0] / size, v[1] / size, v[2] / size), mask)
    if TURN:
        store9(rotation_out, 1, 9 * index, polar_rotation(f), mask)


@triton.jit
def _deform(
    F, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, count,
    TURN: tl.constexpr, LIMIT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One patch per lane."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    f = load9(F, 1, 9 * index, mask)
    deform_and_store(
        f, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, index, mask, TURN, LIMIT
    )


def deform_all(
    deformation_gradient: Tensor,
    covariances: Tensor,
    normals: Tensor,
    rotations: bool,
    max_stretch: float | None = None,
    solid: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """See ``patches.deform_all``; float32, without gradient."""
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
