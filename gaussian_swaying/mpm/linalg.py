"""Batched 3x3 matrices: cofactor, determinant, polar rotation, singular values."""

import math

import torch
from torch import Tensor


def cofactor(matrix: Tensor) -> Tensor:
    r"""Cofactor matrix, :math:`\operatorname{cof} F = \det(F) F^{-T}`, defined for singular matrices too.

    Args:
        matrix: Shape (..., 3, 3).

    Returns:
        Shape (..., 3, 3).
    """
    return torch.linalg.cross(matrix.roll(-1, -2), matrix.roll(-2, -2), dim=-1)


def matmul3(a: Tensor, b: Tensor) -> Tensor:
    """Product of 3x3 matrices (..., 3, 3); on a GPU by hand, as the library is slow for small ones."""
    return a @ b if a.device.type == "cpu" else (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def determinant(matrix: Tensor, cofactors: Tensor | None = None) -> Tensor:
    """Determinant of 3x3 matrices (..., 3, 3), from the cofactors if they are at hand; shape (...)."""
    cofactors = cofactor(matrix) if cofactors is None else cofactors
    return (matrix[..., 0, :] * cofactors[..., 0, :]).sum(-1)


def polar_rotation(matrix: Tensor, iterations: int = 5) -> Tensor:
    r"""The rotation nearest to F: the factor R of the polar decomposition F = R S, by the scaled Newton iteration.

    :math:`X_{k+1} = \tfrac12 (\zeta_k X_k + \zeta_k^{-1} X_k^{-T})` with
    :math:`\zeta_k = (\lVert X_k^{-1} \rVert_F / \lVert X_k \rVert_F)^{1/2}` (Higham 1986, "Computing the polar
    decomposition - with applications"). It converges quadratically to the nearest orthogonal matrix. Where that is a
    reflection (an inverted element), its axis of smallest stretch is turned round, which gives the nearest rotation
    (Irving, Teran & Fedkiw 2004); that axis counts as constant in the gradient. The gradient is finite at F = I, unlike
    that of an SVD.

    Args:
        matrix: Shape (..., 3, 3). A singular matrix gives a finite result that need not be orthogonal.
        iterations: Newton iterations; 5 reach float32 round-off for condition numbers up to 50, 8 float64.

    Returns:
        Shape (..., 3, 3).
    """
    tiny = torch.finfo(matrix.dtype).tiny ** 0.25
    x = matrix
    for _ in range(iterations):
        cof = cofactor(x)
        det = determinant(x, cof)
        det = torch.where(det.abs() < tiny, torch.where(det < 0, -tiny, tiny), det)[..., None, None]
        inverse_transpose = cof / det
        ratio = inverse_transpose.square().sum((-1, -2), keepdim=True) / x.square().sum((-1, -2), keepdim=True).clamp(
            min=tiny
        )
        zeta = ratio.clamp(min=tiny).pow(0.25)
        x = 0.5 * (zeta * x + inverse_transpose / zeta)
    reflected = (determinant(x) < 0)[..., None, None]
    if x.device.type == "cpu" and not bool(reflected.any()):  # asking a GPU would make the host wait
        return x
    # the identity stands in for proper rotations, so that nothing odd happens to them
    stretch = torch.where(reflected, matmul3(x.mT, matrix), torch.eye(3, dtype=x.dtype, device=x.device))
    axis = _weakest_axis(0.5 * (stretch + stretch.mT)).detach()
    turned = x - 2 * (x * axis[..., None, :]).sum(-1, keepdim=True) * axis[..., None, :]
    return torch.where(reflected, turned, x)


def _weakest_axis(stretch: Tensor) -> Tensor:
    """Unit eigenvector (..., 3) of the smallest eigenvalue of positive semidefinite matrices (..., 3, 3)."""
    eye = torch.eye(3, dtype=stretch.dtype, device=stretch.device)
    shifted = stretch - symmetric_eigenvalues(stretch)[..., 2, None, None] * eye
    tiny = torch.finfo(stretch.dtype).eps * (1 + stretch.abs().amax((-1, -2)))[..., None]
    # the cofactors of a matrix of rank two are the outer product of its null vector; at rank one or less, where the
    # eigenvalue is repeated, any vector orthogonal to the largest row will do
    vector = _largest_row(cofactor(shifted))
    row = _largest_row(shifted)
    across = torch.linalg.cross(row, eye[row.abs().argmin(-1)], dim=-1)
    size, width = (torch.linalg.vector_norm(v, dim=-1, keepdim=True) for v in (vector, across))
    fallback = torch.where(width > tiny, across / width.clamp(min=tiny), eye[2])
    return torch.where(size > tiny * row.abs().amax(-1, keepdim=True), vector / size.clamp(min=tiny * tiny), fallback)


def _largest_row(matrix: Tensor) -> Tensor:
    """The row (..., 3) of largest norm."""
    index = matrix.square().sum(-1).argmax(-1)[..., None, None].expand(*matrix.shape[:-2], 1, 3)
    return matrix.gather(-2, index).squeeze(-2)


def symmetric_eigenvalues(matrix: Tensor) -> Tensor:
    """Eigenvalues of symmetric 3x3 matrices in closed form (Smith 1961), largest first; for diagnostics.

    Args:
        matrix: Symmetric, shape (..., 3, 3). Absolute accuracy is about 1e-8 of the largest in float64.

    Returns:
        Shape (..., 3).
    """
    mean = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)
    deviator = matrix - mean[..., None, None] * torch.eye(3, dtype=matrix.dtype, device=matrix.device)
    radius = (deviator.square().sum((-1, -2)) / 6).sqrt()
    scaled = deviator / radius.clamp(min=torch.finfo(matrix.dtype).tiny ** 0.5)[..., None, None]
    angle = (determinant(scaled) / 2).clamp(-1, 1).acos() / 3
    first = mean + 2 * radius * angle.cos()
    last = mean + 2 * radius * (angle + 2 * math.pi / 3).cos()
    return torch.stack([first, 3 * mean - first - last, last], dim=-1)


def singular_values(matrix: Tensor) -> Tensor:
    """Singular values of 3x3 matrices (..., 3, 3), largest first, computed in float64; for diagnostics."""
    double = matrix.double()
    return symmetric_eigenvalues(double.mT @ double).clamp(min=0).sqrt()
