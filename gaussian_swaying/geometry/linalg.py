"""Batched 3x3 matrices: cofactor, determinant, polar rotation, singular value decomposition.

The decompositions are those of :mod:`~gaussian_swaying.geometry.linalg_triton`, with exact derivatives.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gaussian_swaying.geometry import linalg_triton as device
from gaussian_swaying.kernels.derive import on_tensors, primitive


def cofactor(matrix: Tensor) -> Tensor:
    r"""Cofactor matrix, :math:`\operatorname{cof} F = \det(F) F^{-T}`, defined for singular matrices too.

    Args:
        matrix: Shape (..., 3, 3).

    Returns:
        Shape (..., 3, 3).
    """
    return torch.linalg.cross(matrix.roll(-1, -2), matrix.roll(-2, -2), dim=-1)


def matmul3(a: Tensor, b: Tensor) -> Tensor:
    """Product of 3x3 matrices (..., 3, 3); on a GPU written out, as the library is slow for small matrices."""
    return a @ b if a.device.type == "cpu" else (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def determinant(matrix: Tensor, cofactors: Tensor | None = None) -> Tensor:
    """Determinant of 3x3 matrices (..., 3, 3), from the cofactors if they are given; shape (...)."""
    cofactors = cofactor(matrix) if cofactors is None else cofactors
    return (matrix[..., 0, :] * cofactors[..., 0, :]).sum(-1)


def entries(matrix: Tensor) -> tuple[Tensor, ...]:
    """The nine entries (...) of matrices (..., 3, 3), row by row, as device functions take them."""
    return matrix.flatten(-2).unbind(-1)


def vectors(parts: Sequence[Tensor]) -> Tensor:
    """Vectors (..., n) of n numbers (...), as device functions return them."""
    return torch.stack(torch.broadcast_tensors(*parts), -1)


def matrix(entries: Sequence[Tensor]) -> Tensor:
    """Matrices (..., 3, 3) of nine entries (...)."""
    return vectors(entries).unflatten(-1, (3, 3))


class _Polar(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(F: Tensor, iterations: int) -> Tensor:
        x = entries(F)
        for _ in range(iterations):
            x = on_tensors(device.polar_step)(x)
        rotation = matrix(x)
        reflected = (determinant(rotation) < 0)[..., None, None]
        # asking a GPU would make the host wait
        if F.device.type == "cpu" and not bool(reflected.any()):
            return rotation
        left, axes = _singular_vectors(F)
        return torch.where(reflected, matmul3(left, axes.mT), rotation)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, int], output: Tensor) -> None:
        ctx.save_for_backward(inputs[0], output)

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor, None]:
        F, rotation = ctx.saved_tensors
        return matrix(on_tensors(device.polar_change)(entries(F), entries(rotation), entries(bar))), None


def polar_rotation(matrix: Tensor, iterations: int | None = None) -> Tensor:
    r"""The rotation nearest to F: the factor R of the polar decomposition F = R S, by the scaled Newton iteration.

    :math:`X_{k+1} = \tfrac12 (\zeta_k X_k + \zeta_k^{-1} X_k^{-T})` with
    :math:`\zeta_k = (\lVert X_k^{-1} \rVert_F / \lVert X_k \rVert_F)^{1/2}` (Higham 1986, "Computing the polar
    decomposition - with applications"). It converges quadratically to the nearest orthogonal matrix. Where that is a
    reflection (an inverted element), the nearest rotation reverses its axis of smallest stretch (Irving, Teran &
    Fedkiw 2004).

    The first derivative is the exact one of the limit, :math:`dR = R \Omega` with
    :math:`\Omega S + S \Omega = R^T dF - dF^T R`, not that of the iteration: it is finite for every F, while that of an
    SVD is not at F = I. It is limited where two stretches are opposite, since R jumps there. Second derivatives are
    not available.

    Args:
        matrix: Shape (..., 3, 3). A singular matrix gives a finite result that need not be orthogonal.
        iterations: Newton iterations; None for 5 in float32 and 8 in float64, which reach round-off for condition
            numbers up to 50.

    Returns:
        Shape (..., 3, 3).
    """
    found: Tensor = _Polar.apply(matrix, iterations or (8 if matrix.dtype == torch.float64 else 5))
    return found


def largest_eigenvalue(matrix: Tensor) -> Tensor:
    """Largest eigenvalue (...) of symmetric matrices (..., 3, 3)."""
    found: Tensor = on_tensors(device.largest_eigenvalue)(entries(matrix))
    return found


_PAIRS = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # two axes and the third


class Spectrum(NamedTuple):
    r"""Principal stretches and axes of F = U diag(a) V^T, from :func:`spectrum`.

    Attributes:
        stretch: Signed principal stretches a, shape (..., 3), sorted; the last alone is negative, and is so for an
            inverted F.
        left: Rotation U of the axes after the deformation, shape (..., 3, 3); constant in the gradient.
        axes: Rotation V, the principal axes as columns, shape (..., 3, 3); constant in the gradient.
        strain: Symmetric, zero on the diagonal. Its value is zero; its derivative is that of V^T S V off the diagonal,
            where S is the symmetric polar factor. Shape (..., 3, 3); None without a gradient.
        spin: Skew. Its value is zero; its derivative is that of V^T R^T R(F) V. Shape (..., 3, 3); None without a
            gradient.
    """

    stretch: Tensor
    left: Tensor
    axes: Tensor
    strain: Tensor | None = None
    spin: Tensor | None = None

    @property
    def rotation(self) -> Tensor:
        """The rotation R = U V^T nearest to F, shape (..., 3, 3), differentiable."""
        left = self.left if self.spin is None else self.left + matmul3(self.left, self.spin)
        return matmul3(left, self.axes.mT)


def spectrum(F: Tensor) -> Spectrum:
    r"""Principal stretches and axes of a deformation gradient, with exact first derivatives at repeated stretches.

    Jacobi rotations of F^T F, one-sided ones of F for full accuracy of the small stretches, and Gram-Schmidt for U
    (after McAdams et al. 2011, "Computing the singular value decomposition of 3x3 matrices with minimal branching and
    elementary floating point operations"). U and V are rotations for any F, singular or inverted.

    For the derivatives write :math:`B = U^T \, dF \, V`. Then :math:`da_i = B_{ii}`, and off the diagonal the spin of R
    and the change of the symmetric factor are :math:`W_{ij} = (B_{ij} - B_{ji}) / (a_i + a_j)` and
    :math:`\tfrac12 (B_{ij} + B_{ji}) + \tfrac12 (a_i - a_j) W_{ij}`: neither divides by differences of stretches, as an
    SVD does. Only at :math:`a_i = -a_j`, where R jumps, is the derivative limited.

    Args:
        F: Shape (..., 3, 3).

    Returns:
        See :class:`Spectrum`.
    """
    with torch.no_grad():
        left, axes = _singular_vectors(F.detach())
    inner = matmul3(matmul3(left.mT, F), axes)
    stretch = inner.diagonal(dim1=-2, dim2=-1)
    if not (torch.is_grad_enabled() and F.requires_grad):
        return Spectrum(stretch, left, axes)
    change = inner - inner.detach()
    a = stretch.detach()
    total = a[..., :, None] + a[..., None, :]
    floor = torch.finfo(F.dtype).eps ** 0.5 * a.abs().amax(-1)[..., None, None].clamp(min=1e-3)
    spin = (change - change.mT) / torch.where(total.abs() < floor, floor, total)
    strain = 0.5 * (change + change.mT + (a[..., :, None] - a[..., None, :]) * spin)
    off_diagonal = 1 - torch.eye(3, dtype=F.dtype, device=F.device)
    return Spectrum(stretch, left, axes, strain * off_diagonal, spin)


def _singular_vectors(F: Tensor) -> tuple[Tensor, Tensor]:
    """Rotations U and V with U^T F V diagonal, sorted by size, all but the last entry not negative."""
    left, _, axes = on_tensors(device.svd3, look_in=True)(entries(F))
    return matrix(left), matrix(axes)


def divided_differences(stretch: Tensor, function: Callable[[Tensor], Tensor]) -> Tensor:
    r""":math:`\Gamma_{ij} = (y_i - y_j) / (a_i - a_j)` of an isotropic tensor function, without gradient.

    Stretches closer than about the cube root of the round-off are moved apart symmetrically, which gives the limit with
    an error of that root squared.

    Args:
        stretch: Principal stretches a, shape (..., 3), largest first.
        function: Principal values y (..., 3) from stretches (..., 3); see :func:`from_principal`.

    Returns:
        Symmetric with a zero diagonal, shape (..., 3, 3).
    """
    step = torch.finfo(stretch.dtype).eps ** (1 / 3)
    gamma: dict[tuple[int, int], Tensor] = {}
    with torch.no_grad():
        a = stretch.detach()
        for i, j, k in _PAIRS:
            middle = 0.5 * (a[..., i] + a[..., j])
            least = step * 0.5 * (a[..., i].abs() + a[..., j].abs()).clamp(min=1e-2)
            half = torch.maximum(0.5 * (a[..., i] - a[..., j]), least)
            parts = {i: middle + half, j: middle - half, k: a[..., k]}
            y = function(torch.stack([parts[m] for m in range(3)], dim=-1))
            gamma[i, j] = gamma[j, i] = (y[..., i] - y[..., j]) / (2 * half)
        zero = torch.zeros_like(gamma[0, 1])
        rows = [torch.stack([zero if i == j else gamma[i, j] for j in range(3)], dim=-1) for i in range(3)]
        return torch.stack(rows, dim=-2)


def from_principal(
    parts: Spectrum,
    function: Callable[[Tensor], Tensor],
    values: Tensor | None = None,
    *,
    rotated: bool = False,
) -> Tensor:
    r"""Isotropic tensor function V diag(y) V^T of the symmetric polar factor, given in principal stretches.

    Its first derivatives are exact, at repeated stretches too: V counts as constant, and :math:`\Gamma` of
    :func:`divided_differences` multiplies the change of the symmetric factor off the diagonal. Second derivatives are
    not available.

    Args:
        function: Principal values y (..., 3) from stretches (..., 3). It may couple the three, but must be symmetric in
            them: permuted stretches give permuted values. Other tensors that it uses get gradients too.
        values: ``function(parts.stretch)``, if already computed.

    Returns:
        Shape (..., 3, 3).
    """
    y = function(parts.stretch) if values is None else values
    frame = parts.left if rotated else parts.axes
    if parts.strain is None or parts.spin is None:
        return matmul3(frame * y[..., None, :], parts.axes.mT)
    inner = y.diag_embed() + divided_differences(parts.stretch, function) * parts.strain
    if rotated:
        inner = inner + parts.spin * y.detach()[..., None, :]
    return matmul3(matmul3(frame, inner), parts.axes.mT)


def svd3(F: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Singular value decomposition F = U diag(sigma) V^T in which U and V are rotations.

    Args:
        F: Shape (..., 3, 3).

    Returns:
        U (..., 3, 3), sigma (..., 3), V (..., 3, 3), sorted; the last of sigma is negative for an inverted F. Only
        sigma carries a gradient: that of U or V has no limit at repeated stretches, see :func:`from_principal`.
    """
    parts = spectrum(F)
    return parts.left, parts.stretch, parts.axes


primitive(device.polar_change, outputs=9)
primitive(
    device.polar_rotation,
    outputs=9,
    on_tensors=lambda F: entries(polar_rotation(matrix(torch.broadcast_tensors(*F)))),
    vjp=lambda given, R, bar: (on_tensors(device.polar_change)(given[0], R, bar),),
)


def _svd3_of_entries(F: Sequence[Tensor]) -> tuple[tuple[Tensor, ...], ...]:
    left, stretch, axes = svd3(matrix(F))
    return entries(left), stretch.unbind(-1), entries(axes)


primitive(device.svd3, outputs=(9, 3, 9), on_tensors=_svd3_of_entries)
