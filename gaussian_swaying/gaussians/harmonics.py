"""Colour as real spherical harmonics of the view direction: evaluation and rotation."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

_DEGREE_OF_COEFFICIENTS = {1: 0, 4: 1, 9: 2, 16: 3}
SH_DC = 0.28209479177387814
_C1 = 0.4886025119029199
_C2 = (1.0925484305920792, 1.0925484305920792, 0.31539156525252005, 1.0925484305920792, 0.5462742152960396)
_C3 = (
    0.5900435899266435,
    2.890611442640554,
    0.4570457994644658,
    0.3731763325901154,
    0.4570457994644658,
    1.445305721320277,
    0.5900435899266435,
)


def sh_degree(coefficients: int) -> int:
    """Degree 0 to 3 of spherical harmonics with 1, 4, 9 or 16 coefficients; ValueError for another number."""
    if coefficients not in _DEGREE_OF_COEFFICIENTS:
        raise ValueError(f"Expected `sh` to have 1, 4, 9 or 16 coefficients, but got {coefficients}.")
    return _DEGREE_OF_COEFFICIENTS[coefficients]


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    r"""Real spherical harmonics with the signs of 3D Gaussian Splatting.

    Orthonormal over the sphere, with the Condon-Shortley phase: band 1 is :math:`c_1(-y, z, -x)` (Sloan 2013,
    "Efficient Spherical Harmonic Evaluation"; Kerbl et al. 2023).

    Args:
        directions: Unit vectors, shape (..., 3).
        degree: Highest band, 0 to 3.

    Returns:
        Basis functions in the order (0, 0), (1, -1), (1, 0), (1, 1), (2, -2) ..., shape (..., (degree + 1)^2).
    """
    x, y, z = directions.unbind(-1)
    basis = [torch.full_like(x, SH_DC)]
    if degree >= 1:
        basis += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [_C2[0] * x * y, -_C2[1] * y * z, _C2[2] * (2 * zz - xx - yy), -_C2[3] * x * z, _C2[4] * (xx - yy)]
    if degree >= 3:
        basis += [
            -_C3[0] * y * (3 * xx - yy),
            _C3[1] * x * y * z,
            -_C3[2] * y * (4 * zz - xx - yy),
            _C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            -_C3[4] * x * (4 * zz - xx - yy),
            _C3[5] * z * (xx - yy),
            -_C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(basis, dim=-1)


def evaluate_sh(sh: Tensor, directions: Tensor) -> Tensor:
    """Value of spherical harmonics in given directions, before the offset and clamp of :func:`sh_to_color`.

    Args:
        directions: Directions from the camera to the Gaussians, of any length above zero, shape (..., 3).

    Returns:
        Values per channel, shape (..., 3).
    """
    degree = sh_degree(sh.shape[-2])
    if degree == 0:  # the same in every direction
        return SH_DC * torch.broadcast_tensors(sh[..., 0, :], directions)[0]
    unit = torch.nn.functional.normalize(directions, dim=-1)
    basis = sh_basis(unit, degree) if unit.device.type == "cpu" else _basis_by_product(unit, degree)
    return (basis[..., None] * sh).sum(-2)


_kept: dict[tuple[int, torch.dtype, torch.device], Tensor] = {}


def _basis_by_product(directions: Tensor, degree: int) -> Tensor:
    """:func:`sh_basis` as one product of matrices: on a GPU dozens of small operations take longer."""
    key = (degree, directions.dtype, directions.device)
    if key not in _kept:
        with torch.inference_mode(False):
            _kept[key] = _coefficients(degree).to(directions.device, directions.dtype)
    return _monomials(directions, degree) @ _kept[key]


def _monomials(points: Tensor, degree: int) -> Tensor:
    """All products of ``degree`` factors out of 1, x, y, z for points (..., 3); shape (..., 4^degree)."""
    factors = torch.nn.functional.pad(points, (1, 0), value=1.0)
    products = factors
    for _ in range(degree - 1):
        products = (products[..., :, None] * factors[..., None, :]).flatten(-2)
    return products


@functools.cache
def _coefficients(degree: int) -> Tensor:
    """Matrix that takes :func:`_monomials` to :func:`sh_basis`, float64, shape (4^degree, (degree + 1)^2)."""
    with torch.inference_mode(False):
        axis = torch.arange(-3, 4, 2, dtype=torch.float64)  # four values determine a cubic polynomial
        points = torch.cartesian_prod(axis, axis, axis)
        matrix = torch.linalg.pinv(_monomials(points, degree)) @ sh_basis(points, degree)
        return matrix.where(matrix.abs() > 1e-9, 0.0)  # round-off


def sh_to_color(sh: Tensor, directions: Tensor) -> Tensor:
    """Colour seen in given directions: the harmonics plus 0.5, clamped to be at least 0.

    Args:
        directions: Directions from the camera to the Gaussians, of any length above zero, shape (..., 3).

    Returns:
        RGB colour, at least 0, where 1 is white, shape (..., 3).

    Example:
        >>> sh_to_color(torch.zeros(1, 4, 3), torch.tensor([[0.0, 0.0, 1.0]]))
        tensor([[0.5000, 0.5000, 0.5000]])
    """
    return (evaluate_sh(sh, directions) + 0.5).clamp_min(0)


def rotate_sh(sh: Tensor, rotation: Tensor) -> Tensor:
    r"""Rotate the coefficients with an object, so that the colour in direction d becomes that in R^T d.

    Each band is rotated separately. Its matrix follows exactly from 2l + 1 fixed directions :math:`d_k`,
    :math:`D_l = Y_l(d_k)^{-1} Y_l(R^T d_k)`, without Wigner recurrences. Differentiable.

    Args:
        rotation: Rotation matrices, shape (..., 3, 3), for example from the polar decomposition of a deformation
            gradient; the gradient itself is not a rotation.

    Returns:
        Coefficients of the rotated object, shape (..., K, 3).
    """
    degree = sh_degree(sh.shape[-2])
    bands = [torch.broadcast_tensors(sh[..., :1, :], rotation[..., :1, :])[0]]
    for band in range(1, degree + 1):
        directions, inverse = _sampling(band)
        turned = directions.to(rotation) @ rotation  # each row is R^T d_k
        values = sh_basis(turned, band)[..., band * band :]
        bands.append(inverse.to(rotation) @ (values @ sh[..., band * band : (band + 1) ** 2, :]))
    return torch.cat(bands, dim=-2)


@functools.cache
def _sampling(band: int) -> tuple[Tensor, Tensor]:
    """Directions (2l+1, 3) and the inverse of their band's matrix (condition number below 6), in float64."""
    with torch.inference_mode(False):  # they are cached, and may be needed for a gradient later
        count = 2 * band + 1
        index = torch.arange(count, dtype=torch.float64)
        z = -0.3 + 1.1 * (index + 0.5) / count
        angle = index * (torch.pi * (3 - 5**0.5))
        radius = (1 - z * z).sqrt()
        directions = torch.stack([radius * angle.cos(), radius * angle.sin(), z], dim=-1)
        return directions, torch.linalg.inv(sh_basis(directions, band)[:, band * band :])
