"""Batched 3x3 matrices: cofactor, determinant, polar rotation, eigenvectors, singular value decomposition."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

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
    """Product of 3x3 matrices (..., 3, 3); on a GPU written out, as the library is slow for small matrices."""
    return a @ b if a.device.type == "cpu" else (a[..., :, :, None] * b[..., None, :, :]).sum(-2)


def determinant(matrix: Tensor, cofactors: Tensor | None = None) -> Tensor:
    """Determinant of 3x3 matrices (..., 3, 3), from the cofactors if they are given; shape (...)."""
    cofactors = cofactor(matrix) if cofactors is None else cofactors
    return (matrix[..., 0, :] * cofactors[..., 0, :]).sum(-1)


def polar_rotation(matrix: Tensor, iterations: int | None = None) -> Tensor:
    r"""The rotation nearest to F: the factor R of the polar decomposition F = R S, by the scaled Newton iteration.

    :math:`X_{k+1} = \tfrac12 (\zeta_k X_k + \zeta_k^{-1} X_k^{-T})` with
    :math:`\zeta_k = (\lVert X_k^{-1} \rVert_F / \lVert X_k \rVert_F)^{1/2}` (Higham 1986, "Computing the polar
    decomposition - with applications"). It converges quadratically to the nearest orthogonal matrix. Where that is a
    reflection (an inverted element), its axis of smallest stretch is reversed, which gives the nearest rotation
    (Irving, Teran & Fedkiw 2004).

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
    with torch.no_grad():
        constant = matrix.detach()
        rotation = _nearest_rotation(constant, iterations or (8 if matrix.dtype == torch.float64 else 5))
    if not (torch.is_grad_enabled() and matrix.requires_grad):
        return rotation
    with torch.no_grad():
        # for the axial vectors of Omega and of the right-hand side: (tr(S) I - S) omega = k
        stretch = matmul3(rotation.mT, constant)
        trace = stretch.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
        system = trace * torch.eye(3, dtype=matrix.dtype, device=matrix.device) - 0.5 * (stretch + stretch.mT)
        cof = cofactor(system)
        finfo = torch.finfo(matrix.dtype)
        least = finfo.eps**0.5 * system.abs().amax((-1, -2)).pow(3).clamp(min=finfo.tiny**0.5)
        inverse = cof / torch.maximum(determinant(system, cof), least)[..., None, None]
    change = matmul3(rotation.mT, matrix - constant)
    skew = change - change.mT
    axial = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    spin = (inverse * axial[..., None, :]).sum(-1)
    # rows of R times Omega
    return rotation + torch.linalg.cross(rotation, spin[..., None, :].expand_as(rotation), dim=-1)


def _nearest_rotation(matrix: Tensor, iterations: int) -> Tensor:
    """Value of :func:`polar_rotation`."""
    tiny = torch.finfo(matrix.dtype).tiny ** 0.25
    x = matrix
    for _ in range(iterations):
        cof = cofactor(x)
        det = determinant(x, cof)
        det = det.abs().clamp(min=tiny).copysign(det)[..., None, None]
        inverse_transpose = cof / det
        ratio = inverse_transpose.square().sum((-1, -2), keepdim=True) / x.square().sum((-1, -2), keepdim=True).clamp(
            min=tiny
        )
        zeta = ratio.clamp(min=torch.finfo(x.dtype).tiny).pow(0.25)
        x = 0.5 * (zeta * x + inverse_transpose / zeta)
    reflected = (determinant(x) < 0)[..., None, None]
    # asking a GPU would make the host wait
    if x.device.type == "cpu" and not bool(reflected.any()):
        return x
    stretch = matmul3(x.mT, matrix)
    axis = _weakest_axis(0.5 * (stretch + stretch.mT))
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


_PAIRS = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # two axes and the third


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Product of vectors whose components come first, (3, N); shape (N,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _jacobi_angle(app: Tensor, aqq: Tensor, apq: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Tangent, cosine and sine of the smaller rotation that annihilates ``apq`` (Golub & Van Loan, section 8.5)."""
    gap, twice = aqq - app, 2 * apq
    # the squares may underflow; the root is at least as long as either side, and the tangent at most one
    root = torch.maximum((gap.square() + twice.square()).sqrt(), twice.abs()) + torch.finfo(app.dtype).tiny
    tangent = torch.where(gap < 0, -twice, twice) / (gap.abs() + root)
    cosine = (1 + tangent.square()).rsqrt()
    return tangent, cosine, cosine * tangent


def _jacobi(entries: dict[tuple[int, int], Tensor]) -> tuple[list[Tensor], list[Tensor]]:
    """Eigenvalues (N,) and eigenvectors (3, N), unsorted, from the upper triangle of symmetric matrices."""
    a = entries
    one, zero = torch.ones_like(a[0, 0]), torch.zeros_like(a[0, 0])
    v = [torch.stack([one if row == column else zero for row in range(3)]) for column in range(3)]
    # convergence is quadratic; of 1e5 matrices of all condition numbers, all converged at least one sweep earlier
    for _ in range(5 if one.dtype == torch.float64 else 4):
        for p, q, r in _PAIRS:
            rp, rq = (min(r, p), max(r, p)), (min(r, q), max(r, q))
            t, c, s = _jacobi_angle(a[p, p], a[q, q], a[p, q])
            shift = t * a[p, q]
            a[p, p], a[q, q], a[p, q] = a[p, p] - shift, a[q, q] + shift, zero
            a[rp], a[rq] = c * a[rp] - s * a[rq], s * a[rp] + c * a[rq]
            v[p], v[q] = c * v[p] - s * v[q], s * v[p] + c * v[q]
    return [a[0, 0], a[1, 1], a[2, 2]], v


def _sort(keys: list[Tensor], *columns: list[Tensor]) -> None:
    """Sort in place, largest key (N,) first; swapping two columns (3, N) negates one, to keep determinants."""
    for p, q in ((0, 1), (0, 2), (1, 2)):
        swap = keys[p] < keys[q]
        keys[p], keys[q] = torch.maximum(keys[p], keys[q]), torch.minimum(keys[p], keys[q])
        for column in columns:
            column[p], column[q] = (
                torch.where(swap, column[q], column[p]),
                torch.where(swap, -column[p], column[q]),
            )


def _matrix(columns: list[Tensor], shape: torch.Size) -> Tensor:
    """Columns (3, N) to matrices of a shape (..., 3, 3)."""
    return torch.stack(columns, dim=-1).transpose(0, 1).reshape(shape)


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
    columns = F.reshape(-1, 3, 3).permute(2, 1, 0).contiguous()  # column, component, matrix
    _, v = _jacobi({(i, j): _dot(columns[i], columns[j]) for i in range(3) for j in range(i, 3)})
    b = [axis[0] * columns[0] + axis[1] * columns[1] + axis[2] * columns[2] for axis in v]
    for _ in range(2):
        for p, q, _r in _PAIRS:
            _, c, s = _jacobi_angle(_dot(b[p], b[p]), _dot(b[q], b[q]), _dot(b[p], b[q]))
            b[p], b[q] = c * b[p] - s * b[q], s * b[p] + c * b[q]
            v[p], v[q] = c * v[p] - s * v[q], s * v[p] + c * v[q]
    _sort([_dot(column, column) for column in b], b, v)
    first = _unit(b[0], v[0])
    # second column: what is left of it across the first, or any direction across the first
    component = torch.where(first[0].abs() < 0.8, 1.0, 0.0).to(F.dtype)
    other = torch.stack([component, 1 - component, torch.zeros_like(component)])
    second = _unit(b[1] - _dot(first, b[1]) * first, _unit(other - _dot(first, other) * first, other))
    second = _unit(second - _dot(first, second) * first, second)
    third = torch.linalg.cross(first, second, dim=0)
    return _matrix([first, second, third], F.shape), _matrix(v, F.shape)


def _unit(vector: Tensor, fallback: Tensor) -> Tensor:
    """Vectors (3, N) of length one; the fallback where a vector is zero."""
    squared = _dot(vector, vector)
    tiny = torch.finfo(vector.dtype).tiny * 1e6
    return torch.where(squared > tiny, vector * squared.clamp(min=tiny).rsqrt(), fallback)


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
        parts: From :func:`spectrum`.
        function: Principal values y (..., 3) from stretches (..., 3). It may couple the three, but must be symmetric in
            them: permuted stretches give permuted values. Other tensors that it uses get gradients too.
        values: ``function(parts.stretch)``, if already computed.
        rotated: Return R V diag(y) V^T = U diag(y) V^T instead.

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
