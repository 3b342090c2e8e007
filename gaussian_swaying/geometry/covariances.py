"""Covariances of Gaussians, and how they follow a deformation."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import matmul3, polar_rotation
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat


def covariance(quats: Tensor, log_scales: Tensor) -> Tensor:
    r"""Covariances :math:`A = R S S^T R^T` (Kerbl et al. 2023, equation 6).

    Args:
        quats: Quaternions wxyz of any length above zero, shape (..., 4).
        log_scales: Logarithm of the standard deviations [scene units], shape (..., 3).

    Returns:
        Symmetric matrices [scene units^2], shape (..., 3, 3).
    """
    axes = quat_to_rotation(quats) * log_scales.exp()[..., None, :]
    return axes @ axes.mT


def covariance_to_quat_scale(covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Quaternions and scales of covariances, to store deformed Gaussians in a .ply file.

    Computed in float64. The axes are right-handed, sorted from the smallest, and their signs depend on the matrix
    alone. A standard deviation below 1e-7 times the largest is raised to that value, so singular matrices are allowed.

    Args:
        covariances: Symmetric positive semi-definite matrices [scene units^2], shape (N, 3, 3).

    Returns:
        Quaternions wxyz of unit length, shape (N, 4), and logarithm of the standard deviations [scene units],
        shape (N, 3).
    """
    values, axes = torch.linalg.eigh(in_double(covariances))
    largest = axes.abs().argmax(-2, keepdim=True)
    axes = axes * torch.where(axes.gather(-2, largest) < 0, -1.0, 1.0)
    axes = torch.cat([axes[..., :2], torch.linalg.cross(axes[..., 0], axes[..., 1])[..., None]], dim=-1)
    floor = (values[..., -1:] * 1e-14).clamp_min(1e-60)
    log_scales = 0.5 * values.clamp_min(floor).log()
    return rotation_to_quat(axes).to(covariances), log_scales.to(covariances)


def deform_covariance(deformation_gradient: Tensor, covariances: Tensor) -> Tensor:
    r"""Covariances after a deformation, :math:`a = F A F^T` (Gaussian Swaying, "Surface Formulation").

    Args:
        deformation_gradient: Total deformation gradient F, shape (..., 3, 3).
        covariances: Covariances A at rest [scene units^2], shape (..., 3, 3).

    Returns:
        Shape (..., 3, 3).
    """
    return matmul3(matmul3(deformation_gradient, covariances), deformation_gradient.mT)


def limit_stretch(covariances: Tensor, rest: Tensor, max_stretch: float, shape: Tensor | None = None) -> Tensor:
    r"""Limit the size of Gaussians that are stretched too far, and blend them towards a given shape.

    The size of a Gaussian is :math:`\sqrt{\operatorname{tr} a}`. Where it is :math:`r` times that at rest and
    :math:`r > r_{max}`, the covariance becomes

    .. math::
        w\, a + (1 - w)\, B, \qquad w = \frac{r_{max}^2 - 1}{r^2 - 1},

    whose size is :math:`r_{max}` times that at rest: a slightly stretched B instead of a streak. Gaussians below the
    limit do not change, and the result is continuous at the limit.

    Args:
        covariances: Covariances a [scene units^2], shape (..., 3, 3).
        rest: Covariances A at rest [scene units^2], shape (..., 3, 3).
        max_stretch: Largest ratio of the sizes, above 1.
        shape: Covariances B [scene units^2] with the trace of A, shape (..., 3, 3); None for a ball, as for a grain
            that has lost its shape.

    Returns:
        Shape (..., 3, 3).
    """
    size, size_at_rest = _trace(covariances)[..., None, None], _trace(rest)[..., None, None]
    excess = (max_stretch**2 - 1) * size_at_rest
    over = size - size_at_rest
    weight = excess / torch.maximum(over, excess)
    if shape is None:
        shape = torch.eye(3, dtype=rest.dtype, device=rest.device) * (size_at_rest / 3)
    return torch.where(over > excess, weight * covariances + (1 - weight) * shape, covariances)


def limit_deformed(
    deformation_gradient: Tensor,
    covariances: Tensor,
    rest: Tensor,
    max_stretch: float,
    solid: Tensor,
    rotations: Tensor | None = None,
) -> Tensor:
    """:func:`limit_stretch` with the shape that suits the material: the shape at rest for solids, else a ball.

    A Gaussian of a solid returns towards its shape at rest, rotated with the material. A Gaussian of a plastic material
    becomes rounder. On a CPU only Gaussians beyond the limit are computed. On a GPU all are, so that the host does not
    have to wait.

    Args:
        deformation_gradient: Total deformation gradient F, shape (N, 3, 3).
        covariances: Covariances F A F^T [scene units^2], shape (N, 3, 3).
        rest: Covariances A at rest [scene units^2], shape (N, 3, 3).
        max_stretch: Largest ratio of the sizes, above 1.
        solid: Which Gaussians are solid, bool, shape (N,).
        rotations: Polar factors of F, shape (N, 3, 3), if they are known.

    Returns:
        Shape (N, 3, 3).
    """
    if covariances.device.type == "cpu":
        beyond = (_trace(covariances) > max_stretch**2 * _trace(rest)).nonzero()[:, 0]
        if len(beyond) == 0:
            return covariances
        turn = polar_rotation(deformation_gradient[beyond]) if rotations is None else rotations[beyond]
        part = (covariances[beyond], rest[beyond])
        return covariances.index_copy(0, beyond, limit_stretch(*part, max_stretch, _own(part[1], turn, solid[beyond])))
    turn = polar_rotation(deformation_gradient) if rotations is None else rotations
    return limit_stretch(covariances, rest, max_stretch, _own(rest, turn, solid))


def _own(rest: Tensor, turn: Tensor, solid: Tensor) -> Tensor:
    """The rotated shape at rest for solids, else the ball with the same trace."""
    ball = torch.eye(3, dtype=rest.dtype, device=rest.device) * (_trace(rest)[:, None, None] / 3)
    return torch.where(solid[:, None, None], matmul3(matmul3(turn, rest), turn.mT), ball)


def _trace(matrices: Tensor) -> Tensor:
    return matrices.diagonal(dim1=-2, dim2=-1).sum(-1)
