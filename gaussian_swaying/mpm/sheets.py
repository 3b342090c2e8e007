r"""Sheets of one layer of points: a membrane in plane stress, with the bending of Kirchhoff's plate.

**Membrane.** What F does across the sheet does not count: the normal stays normal to the middle plane, and the sheet
gets as thin as no stress across it needs (:func:`flattened`). With F itself, every point would hold the slope of the
sheet to that of a second field of the nodes, which on a coarse grid is far stiffer than the sheet (shear locking): a
strip of a fabric on eight cells hung 13 % less than it should, and now 3 %. A weak stiffness, :data:`DIRECTOR` of the
material's own, keeps F across the sheet near its normal.

**Bending.** Points in the middle plane strain only where it stretches or shears. The bending energy to a unit of area,

.. math:: \tfrac12 D \left( (1 - \nu)\,\kappa_{ab} \cdot \kappa_{ab} + \nu\,\kappa_{aa} \cdot \kappa_{bb} \right),
    \qquad \kappa_{ab} = \frac{\partial^2 u}{\partial a\,\partial b},

with two directions a and b along the sheet, is quadratic in the nodal displacement u, whatever the rotation: second
derivatives of a rigid motion vanish, and of a sheet that keeps its lengths they are its curvatures times its normal
(Bergou et al. 2006, "A quadratic bending model for inextensible surfaces"). The splines are quadratic, so they have the
second derivatives that it needs. A sheet that is curved at rest feels the change of its curvature: its normals turn
with F, whose second derivatives along the tangents are taken.

It is summed over the points, of which a cell of a sheet has four or more. With one point to a cell, a sheet that lies
obliquely would bend where none feels it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.linalg import entries, matrix
from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    axpy9,
    cofactor,
    dot3,
    matvec,
    outer3,
    scale3,
    scale9,
    transpose,
)
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.dispatch import pk1
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.mpm.transfer import Stencil, bspline_weights

DIRECTOR = 0.01
"""Stiffness against shear across a sheet and against its thickness, as a share of that of a solid."""

LEAST = 1e-6
"""Least area of a sheet over that at rest."""

_DIRECTOR, _LEAST = tl.constexpr(DIRECTOR), tl.constexpr(LEAST)
_AT_ONCE = 4096  # points or cells; a GPU has a limit
_ROUNDS = 60  # of the power iteration


@triton.jit
def flattened(F, n, mu, lam):
    r"""Deformation gradient in plane stress, :math:`\hat F = F (I - n n^T) + h\,m\,n^T`.

    The sheet has the unit normal m, along cof(F) n, and the area ratio a, its length. The thickness ratio h has no
    stress across the sheet for fixed corotated elasticity, :math:`h = (2 \mu + \lambda a) / (2 \mu + \lambda a^2)`, and
    to first order for other laws.
    """
    turned = matvec(cofactor(F), n)
    area = tl.sqrt(tl.maximum(dot3(turned, turned), _LEAST * _LEAST))
    bulk = tl.maximum(lam, 0.0)
    below = tl.maximum(2 * mu + bulk * area * area, 1e-30)  # a lane without a particle has no stiffness
    thickness = (2 * mu + bulk * area) / below
    thinning = bulk * (1 - 2 * area * thickness) / below
    m = scale3(1 / area, turned)
    across = axpy3(thickness, m, -1.0, matvec(F, n))
    return axpy9(1.0, F, 1.0, outer3(across, n)), m, area, thickness, thinning


@triton.jit
def without_normal(a, n):
    """The tangential part A (I - n n^T) of a matrix."""
    return axpy9(1.0, a, -1.0, outer3(matvec(a, n), n))


@triton.jit
def sheet_stress(F, n, mu, P, flat, m, area, thickness, thinning):
    r"""First Piola-Kirchhoff stress of :math:`\Psi(\hat F) + W(F)` [Pa].

    With :math:`P = \partial \Psi / \partial \hat F`, its normal part q = P n and the dual tangents
    :math:`G = \hat F^{-T}`, the chain rule through m and h gives

    .. math:: (P + h' a\,(q \cdot m)\,G)(I - n n^T) - h\,m\,(G^T q)^T (I - n n^T) .
    """
    q = matvec(P, n)
    volume = tl.where(dot3(n, n) > 0, area * thickness, 1.0)
    G = scale9(1 / volume, cofactor(flat))
    dual = matvec(transpose(G), q)
    P = axpy9(1.0, P, thinning * area * dot3(q, m), G)
    P = without_normal(axpy9(1.0, P, -thickness, outer3(m, dual)), n)
    out = matvec(F, n)
    c = matvec(transpose(F), out)
    along = dot3(n, c)
    shear = add3(c, -along, n)
    side = add3(matvec(F, shear), along - 1, out)
    own = axpy9(1.0, outer3(out, shear), 1.0, outer3(side, n))
    return axpy9(1.0, P, _DIRECTOR * mu, own)


@triton.jit
def sheet_pk1(F, n, mu, lam, row, LAWS: tl.constexpr):
    """The stress of a sheet of a law, ``row`` as for ``dispatch.pk1``, and F in plane stress."""
    flat, m, area, thickness, thinning = flattened(F, n, mu, lam)
    P = pk1(flat, mu, lam, row, LAWS)
    return sheet_stress(F, n, mu, P, flat, m, area, thickness, thinning), flat


@triton.jit
def _director_energy(F, n, mu):
    out = matvec(F, n)
    c = matvec(transpose(F), out)
    along = dot3(n, c)
    shear = add3(c, -along, n)
    thick = along - dot3(n, n)
    return _DIRECTOR * mu * (0.5 * dot3(shear, shear) + 0.25 * thick * thick)


def in_plane_stress(F: Tensor, normal: Tensor, mu: Tensor, lam: Tensor) -> Tensor:
    """Deformation gradients (..., 3, 3) in plane stress, see :func:`flattened`; normals (..., 3), moduli (...)."""
    return matrix(on_tensors(flattened)(entries(F), normal.unbind(-1), mu, lam)[0])


def stress_of_sheets(F: Tensor, normal: Tensor, mu: Tensor, lam: Tensor, pk1: Callable[[Tensor], Tensor]) -> Tensor:
    """See :func:`sheet_stress`.

    Args:
        F: Deformation gradients, shape (..., 3, 3).
        normal: Unit normals at rest, zero where there is no sheet, shape (..., 3).
        mu: Shear moduli [Pa], shape (...).
        lam: First Lamé parameters [Pa], shape (...).

    Returns:
        Shape (..., 3, 3).
    """
    own, n = entries(F), normal.unbind(-1)
    flat, *parts = on_tensors(flattened)(own, n, mu, lam)
    return matrix(on_tensors(sheet_stress)(own, n, mu, entries(pk1(matrix(flat))), flat, *parts))


def director_energy(F: Tensor, normal: Tensor, mu: Tensor) -> Tensor:
    """Energy density of transverse shear and thickness change of sheets [J/m³], shape (...).

    It is :data:`DIRECTOR` times mu times half the square of the shear and a quarter of that of n C n - 1.
    """
    found: Tensor = on_tensors(_director_energy)(entries(F), normal.unbind(-1), mu)
    return found


@dataclass(frozen=True)
class Bending:
    """The stiffness of sheets against bending, as a matrix between the 27 nodes of each cell that they cross.

    Attributes:
        node: Flat indices of the nodes of each, over all scenes, int64, shape (K, 27).
        stiffness: Symmetric matrices [N/m], shape (K, 27, 27).
        example: A point in each, int64, shape (K,).
    """

    node: Tensor
    stiffness: Tensor
    example: Tensor

    def forces(self, displacement: Tensor) -> Tensor:
        """Forces on the nodes [N] from their displacement [m], shape (..., G, 3)."""
        flat = displacement.reshape(-1, 3)
        force = self.stiffness @ flat[self.node]
        return torch.zeros_like(flat).index_add(0, self.node.reshape(-1), -force.reshape(-1, 3)).view_as(displacement)

    def energy(self, displacement: Tensor) -> Tensor:
        """Energy of bending [J], shape (...), of a nodal displacement [m], shape (..., G, 3)."""
        return -0.5 * (displacement * self.forces(displacement)).sum((-2, -1))

    @torch.no_grad()
    def rows(self) -> Tensor:
        """A factorisation of each cell's matrix: rows v with sum v v^T; shape (K, rank of all, 27)."""
        parts = [torch.linalg.eigh(in_double(some)) for some in self.stiffness.split(_AT_ONCE)]
        values, vectors = (torch.cat(column) for column in zip(*parts, strict=True))
        least = 27 * torch.finfo(self.stiffness.dtype).eps * values[:, -1:]
        rank = int((values > least).sum(-1).amax())
        scaled = vectors * values.clamp(min=0).sqrt()[:, None]
        return scaled.mT[:, 27 - rank :].to(self.stiffness)

    @torch.no_grad()
    def fastest(self, inverse_mass: Tensor) -> float:
        """The largest square of a circular frequency [1/s²] of the sheets alone.

        Args:
            inverse_mass: Inverse mass of each node [1/kg], shape (..., G).
        """
        root = in_double(inverse_mass).reshape(-1, 1).sqrt()
        double = Bending(self.node, in_double(self.stiffness), self.example)
        generator = torch.Generator().manual_seed(0)
        mode = torch.randn(len(root), 3, generator=generator, dtype=torch.float64).to(root) * (root > 0)
        for _ in range(_ROUNDS):
            mode = mode / mode.norm().clamp(min=torch.finfo(mode.dtype).tiny)
            mode = -root * double.forces(root * mode)
        return float(mode.norm())


def bending_of(points: MaterialPoints, stencil: Stencil, dx: float, softened: Tensor | None) -> Bending | None:
    """The bending of the sheets of a material; None if it has none.

    Args:
        softened: Factor of the stiffness of each point, shape (..., P); None for one.
    """
    if points.bending is None or points.normal is None:
        return None
    own = points.bending.reshape(-1)
    index = (own.detach() > 0).nonzero()[:, 0]
    if not len(index):
        return None
    own = own[index] if softened is None else own[index] * softened.reshape(-1)[index]
    cells, cell = torch.unique(stencil.cell[index], return_inverse=True)
    fraction = stencil.fraction.T[index]
    normal, poisson = points.normal.detach().reshape(-1, 3)[index], points.poisson_ratio.detach().reshape(-1)[index]
    stiffness = own.new_zeros(len(cells), 27, 27)
    for some in torch.arange(len(index), device=index.device).split(_AT_ONCE):
        a, b, twist = in_double(second_derivatives(fraction.detach()[some], normal[some], dx)).unbind(1)
        nu = in_double(poisson[some])[:, None]
        part = _outer(a, a + nu * b) + _outer(b, b + nu * a) + _outer(2 * (1 - nu) * twist, twist)
        stiffness = stiffness.index_add(0, cell[some], own[some, None, None] * part.to(own))
    example = torch.full_like(cells, len(points.bending.reshape(-1))).scatter_reduce(0, cell, index, "amin")
    return Bending(stencil.node[example], stiffness, example)


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, :, None] * b[:, None]


def second_derivatives(fraction: Tensor, normal: Tensor, dx: float) -> Tensor:
    """Second derivatives of the weights of the 27 nodes of a cell along two directions across a normal [1/m²].

    Args:
        fraction: Place in cells from the first of the three nodes of each axis, shape (K, 3).
        normal: Unit normals, shape (K, 3).

    Returns:
        Along the first direction twice, the second one twice, and both, shape (K, 3, 27).
    """
    weight, slope = bspline_weights(fraction.T)
    bend = weight.new_tensor([1.0, -2.0, 1.0]).view(1, 3, 1).expand_as(weight)
    kinds = (weight, slope / dx, bend / dx**2)

    def product(orders: tuple[int, int, int]) -> Tensor:
        x, y, z = (kinds[order][axis] for axis, order in enumerate(orders))
        return (x[:, None, None] * (y[:, None] * z)).reshape(27, -1)

    pairs = [tuple(int(axis == i) + int(axis == j) for axis in range(3)) for i in range(3) for j in range(3)]
    hessian = torch.stack([product(pair) for pair in pairs]).reshape(3, 3, 27, -1)  # type: ignore[arg-type]
    axes = torch.eye(3, dtype=normal.dtype, device=normal.device)
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, axes[normal.abs().argmin(-1)], dim=-1), dim=-1)
    second = torch.linalg.cross(normal, first, dim=-1)
    return torch.stack(
        [torch.einsum("ijnk,ki,kj->kn", hessian, a, b) for a, b in ((first, first), (second, second), (first, second))],
        dim=1,
    )
