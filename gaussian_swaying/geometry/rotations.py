"""Rotations as matrices and quaternions."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_vector


def quat_to_rotation(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions.

    Returns:
        Shape (..., 3, 3); columns are the axes of the Gaussian.
    """
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
    """
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


def quat_multiply(first: Tensor, second: Tensor) -> Tensor:
    """Hamilton's product of quaternions: the rotation of ``second``, and then that of ``first``.

    Args:
        first: Quaternion wxyz, shape (4,).
        second: Quaternions wxyz, shape (..., 4).

    Returns:
        Quaternions wxyz, not normalised, shape (..., 4).
    """
    w, x, y, z = first.unbind(-1)
    left = torch.stack([w, -x, -y, -z, x, w, -z, y, y, z, w, -x, z, -y, x, w]).view(4, 4)
    return second @ left.T


def rodrigues(turn: Tensor) -> tuple[Tensor, Tensor]:
    """The sine of an angle over it, and one less its cosine over its square, for an axis times angle [rad] (..., 3).

    Shape (..., 1) each; both are exact for small angles.
    """
    half = torch.linalg.vector_norm(turn, dim=-1, keepdim=True) / (2 * math.pi)
    return torch.sinc(2 * half), 0.5 * torch.sinc(half) ** 2


def turn_of(turn: Tensor) -> Tensor:
    """R - 1 for the rotation R by an axis times angle [rad], by Rodrigues' formula; small angles lose no digits.

    Args:
        turn: Axis times angle, shape (..., 3).

    Returns:
        Shape (..., 3, 3).
    """
    sine, cosine = (part[..., None] for part in rodrigues(turn))
    x, y, z = turn.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    outer = turn[..., :, None] * turn[..., None, :]
    square = turn.square().sum(-1)[..., None, None] * torch.eye(3, dtype=turn.dtype, device=turn.device)
    return torch.addcmul(sine * cross, cosine, outer - square)


def rotation_of(turn: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of an axis times angle [rad], shape (..., 3)."""
    return torch.eye(3, dtype=turn.dtype, device=turn.device) + turn_of(turn)


def rotation_from_z(up: Sequence[float] | Tensor) -> Tensor:
    """Minimal rotation that takes +z to ``up``; its transpose takes ``up`` to +z.

    For (0, 0, -1), where the minimal rotation is not unique, it is the half turn about x.

    Args:
        up: Direction of any length, shape (3,).

    Returns:
        Rotation matrix in float64 on the CPU, shape (3, 3).
    """
    return torch.tensor(rows_from_z(check_direction("up", up)), dtype=torch.float64)


def rows_from_z(up: Sequence[float]) -> list[list[float]]:
    """Rows of :func:`rotation_from_z`, from a vector of length one."""
    x, y, z = up
    if z < -1.0 + 1e-12:
        return [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    f = 1.0 / (1.0 + z)  # Rodrigues' formula with axis (-y, x, 0) and cosine z
    return [[1.0 - f * x * x, -f * x * y, x], [-f * x * y, 1.0 - f * y * y, y], [-x, -y, z]]


def check_direction(name: str, value: Sequence[float] | Tensor) -> tuple[float, ...]:
    """Return ``value`` as a 3-vector of length one, or raise an error that names the field."""
    vector = check_vector(name, value)
    length = math.hypot(*vector)
    if length < 1e-12:
        raise ValueError(f"Expected `{name}` to be a direction, but got the zero vector.")
    return tuple(item / length for item in vector)
