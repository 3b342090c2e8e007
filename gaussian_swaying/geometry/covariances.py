"""Covariances of Gaussians, and how they follow a deformation."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import matmul3
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat


def covariance(quats: Tensor, log_scales: Tensor) -> Tensor:
    r"""Covariances :math:`A = R S S^T R^T` (Kerbl et al. 2023, equation 6).

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
