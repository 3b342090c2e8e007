"""What a picture needs of each patch after a deformation, in one kernel; the definitions are in ``surface``."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from gaussian_swaying.geometry.linalg_triton import axpy9, cofactor, matmul, polar_rotation, transpose, where9

BLOCK = 128


@triton.jit
def _load9(pointer, index, mask):
    """A matrix, row by row."""
    at = pointer + 9 * index
    return (
        tl.load(at, mask, 0.0), tl.load(at + 1, mask, 0.0), tl.load(at + 2, mask, 0.0),
        tl.load(at + 3, mask, 0.0), tl.load(at + 4, mask, 0.0), tl.load(at + 5, mask, 0.0),
        tl.load(at + 6, mask, 0.0), tl.load(at + 7, mask, 0.0), tl.load(at + 8, mask, 0.0),
    )  # fmt: skip


@triton.jit
def _store9(pointer, index, value, mask):
    """The counterpart of ``_load9``."""
    for k in tl.static_range(9):
        tl.store(pointer + 9 * index + k, value[k], mask)


@triton.jit
def _limited(drawn, rest, turn, solid, square):
    """See ``surface.limit_deformed``; ``square`` is that of the largest stretch."""
    size = rest[0] + rest[4] + rest[8]
    excess = (square - 1) * size
    over = drawn[0] + drawn[4] + drawn[8] - size
    weight = excess / tl.maximum(tl.maximum(over, excess), 1e-37)
    ball, nil = size / 3, 0.0 * size
    shape = matmul(matmul(turn, rest), transpose(turn))
    shape = where9(solid, shape, (ball, nil, nil, nil, ball, nil, nil, nil, ball))
    return where9(over > excess, axpy9(weight, drawn, 1 - weight, shape), drawn)


@triton.jit
def _deform(
    F, covariance, normal, solid, covariance_out, normal_out, rotation_out, square, count,
    TURN: tl.constexpr, LIMIT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """One patch per lane."""
    index = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    mask = index < count
    f = _load9(F, index, mask)
    a = _load9(covariance, index, mask)
    drawn = matmul(matmul(f, a), transpose(f))
    if LIMIT:
        drawn = _limited(drawn, a, polar_rotation(f), tl.load(solid + index, mask, 1) != 0, square)
    _store9(covariance_out, index, drawn, mask)
    n0 = tl.load(normal + 3 * index, mask, 0.0)
    n1 = tl.load(normal + 3 * index + 1, mask, 0.0)
    n2 = tl.load(normal + 3 * index + 2, mask, 0.0)
    c = cofactor(f)
    x = c[0] * n0 + c[1] * n1 + c[2] * n2
    y = c[3] * n0 + c[4] * n1 + c[5] * n2
    z = c[6] * n0 + c[7] * n1 + c[8] * n2
    # scaled, so that squares cannot underflow
    largest = tl.maximum(tl.abs(x), tl.maximum(tl.abs(y), tl.abs(z)))
    flat = largest == 0
    scale = tl.where(flat, 1.0, largest)
    scale = tl.where(f[0] * c[0] + f[1] * c[1] + f[2] * c[2] < 0, -scale, scale)
    x = tl.where(flat, n0, x / scale)
    y = tl.where(flat, n1, y / scale)
    z = tl.where(flat, n2, z / scale)
    size = tl.sqrt(x * x + y * y + z * z)
    tl.store(normal_out + 3 * index, x / size, mask)
    tl.store(normal_out + 3 * index + 1, y / size, mask)
    tl.store(normal_out + 3 * index + 2, z / size, mask)
    if TURN:
        _store9(rotation_out, index, polar_rotation(f), mask)


def deform_all(
    deformation_gradient: Tensor,
    covariances: Tensor,
    normals: Tensor,
    rotations: bool,
    max_stretch: float | None = None,
    solid: Tensor | None = None,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """See ``surface.deform_all``; float32 on a GPU, without gradient."""
    shape = deformation_gradient.shape[:-2]
    count = shape.numel()
    given = [deformation_gradient, covariances.expand(*shape, 3, 3), normals.expand(*shape, 3)]
    F, covariance, normal = (tensor.detach().contiguous() for tensor in given)
    made = [torch.empty_like(F), torch.empty_like(normal), torch.empty_like(F) if rotations else F]
    limit = max_stretch is not None and solid is not None
    keeps = F if solid is None or not limit else solid.contiguous().view(torch.uint8)
    if count > 0:
        with torch.cuda.device_of(F):
            _deform[(triton.cdiv(count, BLOCK),)](
                F, covariance, normal, keeps, *made, float(max_stretch or 1) ** 2, count,
                TURN=rotations, LIMIT=limit, BLOCK=BLOCK,
            )  # fmt: skip
    return made[0], made[1], made[2] if rotations else None
