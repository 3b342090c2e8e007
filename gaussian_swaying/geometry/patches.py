"""Gaussians as surface patches: normal and area, and how they follow a deformation."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying.geometry.covariances import deform_covariance, limit_deformed
from gaussian_swaying.geometry.linalg import cofactor, determinant, polar_rotation
from gaussian_swaying.geometry.rotations import quat_to_rotation
from gaussian_swaying.kernels.launch import replaces


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
    cof, vector = _cofactor_times(deformation_gradient, normals)
    return _unit_normal(vector, determinant(deformation_gradient, cof), normals)


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
    cof, vector = _cofactor_times(deformation_gradient, normals)
    normal = _unit_normal(vector, determinant(deformation_gradient, cof), normals)
    return normal, vector.norm(dim=-1) * areas


def _unit_normal(vector: Tensor, determinants: Tensor, normals: Tensor) -> Tensor:
    """F^-T N made unit from cof(F) N (..., 3) and det F (...); the normals at rest where that is zero."""
    largest = torch.linalg.vector_norm(vector.detach(), float("inf"), dim=-1, keepdim=True)
    flat = largest == 0
    # + 0.0, as the sign of a negative zero is no reflection
    scale = torch.where(flat, 1, largest).copysign(determinants.detach()[..., None] + 0.0)
    vector = torch.where(flat, normals, vector / scale)  # scaled: squares cannot underflow
    return vector / vector.square().sum(-1, keepdim=True).sqrt()


def _cofactor_times(deformation_gradient: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """The cofactors of F (..., 3, 3) and their product with N (..., 3)."""
    cof = cofactor(deformation_gradient)
    return cof, (cof * normals[..., None, :]).sum(-1)


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
        rotations: Whether to compute the rotations.
        max_stretch: Limit of :func:`limit_deformed`, above 1; None for none.
        solid: Which Gaussians are solid, bool, shape (N,); needed with ``max_stretch``.

    Returns:
        :func:`deform_covariance` within the limit, :func:`deform_normal` and
        :func:`~gaussian_swaying.geometry.linalg.polar_rotation`, or None in its place.
    """
    tensors = (deformation_gradient, covariances, normals)
    if replaces(tensors):
        from gaussian_swaying.geometry import patches_triton

        return patches_triton.deform_all(*tensors, rotations, max_stretch, solid)
    drawn = deform_covariance(deformation_gradient, covariances)
    turns = polar_rotation(deformation_gradient) if rotations else None
    if max_stretch is not None and solid is not None:
        drawn = limit_deformed(deformation_gradient, drawn, covariances, max_stretch, solid, turns)
    return drawn, deform_normal(deformation_gradient, normals), turns
