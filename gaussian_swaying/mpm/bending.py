r"""Bending of a sheet of one layer of points, as an energy of its own: Kirchhoff's plate on the grid's splines.

Points in the middle plane of a sheet strain only where it stretches or shears. Its bending energy to a unit of area,

.. math:: \tfrac12 D \left( (1 - \nu)\,\kappa_{ab} \cdot \kappa_{ab} + \nu\,\kappa_{aa} \cdot \kappa_{bb} \right),
    \qquad \kappa_{ab} = \frac{\partial^2 u}{\partial a\,\partial b},

with two directions a and b along the sheet, is quadratic in the nodal displacement u, whatever the rotation: second
derivatives of a rigid motion vanish, and of a sheet that keeps its lengths they are its curvatures times its normal
(Bergou et al. 2006, "A quadratic bending model for inextensible surfaces"). The splines are quadratic, so they have the
second derivatives that it needs. A sheet that is curved at rest feels the change of its curvature: its normals turn
with F, whose second derivatives along the tangents are taken.

In a cell the points of a sheet make one patch, with their mean place and normal and the sum of their stiffness: all of
them share its 27 nodes. Several sheets in a cell, or a fold, make several.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.geometry.groups import equal_rows
from gaussian_swaying.mpm.state import MaterialPoints
from gaussian_swaying.mpm.transfer import Stencil, bspline_weights

ALIKE = math.cos(math.radians(30))
"""Normals of one patch make at most this angle with the first of them, as its cosine."""

_ROUNDS = 60  # of the power iteration


@dataclass(frozen=True)
class Bending:
    """The patches of sheets in the cells of a grid.

    Attributes:
        node: Flat indices of the nodes of each, over all scenes, int64, shape (K, 27).
        curving: Second derivatives of the splines along a and a, b and b, a and b [1/m²], shape (K, 3, 27).
        stiffness: D times the area [N m³], shape (K,).
        poisson: Poisson's ratio, shape (K,).
        example: A point of each, int64, shape (K,).
    """

    node: Tensor
    curving: Tensor
    stiffness: Tensor
    poisson: Tensor
    example: Tensor

    def forces(self, displacement: Tensor) -> Tensor:
        """Forces on the nodes [N] from their displacement [m], shape (..., G, 3)."""
        flat = displacement.reshape(-1, 3)
        curvature = self.curving @ flat[self.node]
        own = torch.stack([torch.ones_like(self.poisson), self.poisson], -1)
        normal = torch.stack([own, own.flip(-1)], -1) @ curvature[:, :2]
        twist = 2 * (1 - self.poisson)[:, None, None] * curvature[:, 2:]
        moment = self.stiffness[:, None, None] * torch.cat([normal, twist], 1)
        force = self.curving.mT @ moment
        return torch.zeros_like(flat).index_add(0, self.node.reshape(-1), -force.reshape(-1, 3)).view_as(displacement)

    def energy(self, displacement: Tensor) -> Tensor:
        """Energy of bending [J], shape (...), of a nodal displacement [m], shape (..., G, 3)."""
        return -0.5 * (displacement * self.forces(displacement)).sum((-2, -1))

    @torch.no_grad()
    def fastest(self, inverse_mass: Tensor) -> float:
        """The largest square of a circular frequency [1/s²] of the sheets alone.

        Args:
            inverse_mass: Inverse mass of each node [1/kg], shape (..., G).
        """
        if not len(self.node):
            return 0.0
        root = in_double(inverse_mass).reshape(-1, 1).sqrt()
        double = Bending(self.node, *(in_double(t) for t in (self.curving, self.stiffness, self.poisson)), self.node)
        generator = torch.Generator().manual_seed(0)
        mode = torch.randn(len(root), 3, generator=generator, dtype=torch.float64).to(root) * (root > 0)
        for _ in range(_ROUNDS):
            mode = mode / mode.norm()
            mode = -root * double.forces(root * mode)
        return float(mode.norm())


@torch.no_grad()
def _members(stencil: Stencil, normal: Tensor, bends: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The points that bend, the patch of each, and the sign that turns its normal to the side of the patch's."""
    index = bends.nonzero()[:, 0]
    first = stencil.first[index]
    unit = first if stencil.nodes is None else equal_rows(torch.cat([first[:, None], stencil.nodes.T[index]], 1))
    cell = torch.unique(unit, return_inverse=True)[1]
    own = normal[index]
    patch, sign = torch.full_like(index, -1), torch.ones_like(own[:, 0])
    left, made = torch.arange(len(index), device=index.device), 0
    while len(left):
        cells, inverse = torch.unique(cell[left], return_inverse=True)
        seed = torch.full_like(cells, len(index)).scatter_reduce(0, inverse, left, "amin")
        cosine = (own[left] * own[seed[inverse]]).sum(-1)
        near = cosine.abs() >= ALIKE
        patch[left[near]] = made + inverse[near]
        sign[left[near]] = cosine[near].sign()
        left, made = left[~near], made + len(cells)
    return index, patch, sign


def bending_patches(points: MaterialPoints, stencil: Stencil, dx: float, softened: Tensor | None) -> Bending | None:
    """The patches of the sheets of a material; None if it has none.

    Args:
        points: The material, of which ``normal`` and ``bending`` say what bends.
        stencil: Support of its points at rest.
        dx: Grid spacing [m].
        softened: Factor of the stiffness of each point, shape (..., P); None for one.
    """
    if points.bending is None or points.normal is None:
        return None
    stiffness = points.bending.reshape(-1)
    index, patch, sign = _members(stencil, points.normal.reshape(-1, 3), stiffness.detach() > 0)
    if not len(index):
        return None
    count = int(patch.max()) + 1
    own = stiffness[index] if softened is None else stiffness[index] * softened.reshape(-1)[index]
    share = in_double(stiffness.detach()[index])

    def mean(values: Tensor) -> Tensor:
        whole = share.new_zeros(count).index_add(0, patch, share)
        summed = share.new_zeros(count, *values.shape[1:])
        return summed.index_add(0, patch, share.view(-1, *[1] * (values.dim() - 1)) * in_double(values)) / whole.view(
            -1, *[1] * (values.dim() - 1)
        )

    fraction = mean(1.5 + in_double(stencil.factors[1, :, 0].T[index]) * dx)
    normal = torch.nn.functional.normalize(mean(sign[:, None] * points.normal.reshape(-1, 3)[index]), dim=-1)
    example = torch.full((count,), len(stiffness), device=index.device).scatter_reduce(0, patch, index, "amin")
    node = stencil.node.view(-1, 27)[example]
    like = stiffness.detach()
    return Bending(
        node,
        second_derivatives(fraction, normal, dx).to(like),
        torch.zeros(count, dtype=own.dtype, device=own.device).index_add(0, patch, own),
        mean(points.poisson_ratio.detach().reshape(-1)[index]).to(like),
        example,
    )


def second_derivatives(fraction: Tensor, normal: Tensor, dx: float) -> Tensor:
    """Second derivatives of the weights of the 27 nodes of a cell along two directions across a normal [1/m²].

    Args:
        fraction: Place in cells from the first of the three nodes of each axis, shape (K, 3).
        normal: Unit normals, shape (K, 3).
        dx: Grid spacing [m].

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
