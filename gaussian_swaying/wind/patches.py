r"""The wind on groups of patches that move together: sums over the patches of a material point.

A point may carry many patches, with normals of all directions. Under a deformation gradient F of the point, the area
vector of a patch, :math:`\mathbf{b} = A \mathbf{N}` at rest, becomes :math:`\operatorname{cof}(F)\, \mathbf{b}`
(Nanson's formula). The terms of the force of :func:`~gaussian_swaying.wind.force.aero_force` then need three sums:

.. math::
    \mathbf{s} = \operatorname{cof} F \sum_i \operatorname{sign}(\mathbf{b}_i \cdot \mathbf{w})\, \mathbf{b}_i, \qquad
    T = \frac1\kappa \operatorname{cof} F\, \Bigl(\sum_i A_i \mathbf{N}_i \mathbf{N}_i^T\Bigr) \operatorname{cof} F^T,
    \qquad A = \operatorname{tr} T, \qquad \mathbf{w} = \operatorname{cof} F^T \mathbf{v}_r

The paper's drag is :math:`C_D v_r^2 \mathbf{s}`, the projected one :math:`C_D v_r T \mathbf{v}_r`, the linear one
:math:`C_D |\mathbf{u}| T \mathbf{v}_r` with the wind u, friction
:math:`C_F v_r (A - T) \mathbf{v}_r`, and lift follows from s. The sum of signs is over all directions, the others are
constant tensors of six numbers. All are exact for F that turns, or stretches patches of one direction; the mean growth
of the area :math:`\kappa` stands for that of each patch.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from gaussian_swaying.geometry.groups import equal_rows, sums

MOST = 243
"""Most directions that are kept for the patches of one point; similar ones are joined until there are no more."""

_ANGLES = (0.003, 0.01, 0.03, 0.1, 0.25)  # [rad] of the cells of directions; the coarsest make 3 x 9 x 9 of them

_COARSE = (0.5,)
"""The same angles where the sum of signs is a small part of the force; 3 x 5 x 5 cells."""


class Patches(nn.Module):
    """Surface patches and the material points that carry them.

    Args:
        normal: Unit normals at rest, of either sign, shape (Q, 3).
        area: Areas at rest [m²], shape (Q,).
        point: The material point of each, shape (Q,).
        count: Number of material points P.
    """

    normal: Tensor
    area: Tensor
    point: Tensor

    def __init__(self, normal: Tensor, area: Tensor, point: Tensor, count: int) -> None:
        super().__init__()
        self.count = int(count)
        self.register_buffer("normal", normal, persistent=False)
        self.register_buffer("area", area, persistent=False)
        self.register_buffer("point", point, persistent=False)

    def areas(self) -> Tensor:
        """Area of the patches of each material point at rest [m²], shape (P,)."""
        return sums(self.area, self.point, self.count)


class PatchSums(nn.Module):
    """The constant sums over the patches of each material point.

    Args:
        patches: The patches.
        coarse: Whether directions up to 0.25 rad from their mean may be joined: for laws in which only the
            lift depends on the sum of signs.
        tensor: Sum of A N N^T, if it is known better than from joined patches.

    Attributes:
        tensor: Sum of A N N^T [m²], shape (P, 3, 3).
        vector: Area vectors A N at rest [m²], joined with those of similar direction, sorted by point, shape (V, 3).
        point: The material point of each, shape (V,).
        single: Whether no point has patches of more than one direction.
    """

    tensor: Tensor
    vector: Tensor
    point: Tensor

    def __init__(self, patches: Patches, coarse: bool = False, tensor: Tensor | None = None) -> None:
        super().__init__()
        like = patches.area
        with torch.no_grad():
            normal, area, point = patches.normal.cpu().double(), patches.area.cpu().double(), patches.point.cpu()
            if tensor is None:
                tensor = second_moments(normal, area, point, patches.count)
            vector, owner = joined_directions(normal, area, point, tensor.cpu().double(), coarse)
        self.register_buffer("tensor", tensor.to(like), persistent=False)
        self.register_buffer("vector", vector.to(like), persistent=False)
        self.register_buffer("point", owner.to(like.device), persistent=False)
        self.single = len(owner) == 0 or int(owner.bincount().amax()) <= 1

    def grouped(self, group: Tensor, count: int, coarse: bool = False) -> PatchSums:
        """The sums of groups of points.

        Args:
            group: The group of each point, shape (P,).
        """
        length = self.vector.norm(dim=-1)
        normal = self.vector / length[:, None].clamp(min=torch.finfo(length.dtype).tiny)
        patches = Patches(normal, length, group[self.point], count)
        return PatchSums(patches, coarse, sums(self.tensor, group, count))

    @property
    def area(self) -> Tensor:
        """Area of the patches of each point at rest [m²], shape (P,)."""
        return self.tensor.diagonal(dim1=-2, dim2=-1).sum(-1)

    @property
    def rows(self) -> int:
        """Length of the :meth:`table` in rows of four numbers."""
        return len(self.vector) + 2 * len(self.tensor)

    def lists(self) -> Tensor:
        """First row and number of vectors of each point in the :meth:`table`, shape (P, 2)."""
        count = self.point.bincount(minlength=len(self.tensor))
        first = count.cumsum(0) - count + 2 * torch.arange(len(count), device=count.device)
        return torch.stack([first, count], -1).to(self.tensor)

    def table(self) -> Tensor:
        """Patch sums for the kernels: per point two rows for its tensor, then one per vector; shape (4 rows,)."""
        first = self.lists()[:, 0].long()
        found = self.tensor.new_zeros(self.rows, 4)
        upper = self.tensor[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
        found[first], found[first + 1, :2] = upper[:, :4], upper[:, 4:]
        found[torch.arange(len(self.point), device=first.device) + 2 * (self.point + 1), :3] = self.vector
        return found.reshape(-1)

    def normals(self) -> Tensor:
        """Unit normal of each point, if it has patches of one direction, shape (P, 3); z where it has none."""
        normal = self.tensor.new_tensor([0.0, 0.0, 1.0]).repeat(len(self.tensor), 1)
        return normal.index_copy(0, self.point, torch.nn.functional.normalize(self.vector, dim=-1))


def second_moments(normal: Tensor, area: Tensor, point: Tensor, count: int) -> Tensor:
    """Sum of A N N^T over normals (Q, 3) and areas (Q,) of each point (Q,), shape (count, 3, 3)."""
    return sums(area[:, None, None] * normal[:, :, None] * normal[:, None, :], point, count)


def joined_directions(
    normal: Tensor, area: Tensor, point: Tensor, tensor: Tensor, coarse: bool = False
) -> tuple[Tensor, Tensor]:
    """Area vectors of the patches of each point, joined where the directions are alike.

    Directions are sorted into cells of 0.003 rad around the main direction of the point, or of more until at most
    :data:`MOST` cells are used.

    Args:
        normal: Unit normals, shape (Q, 3).
        area: Areas, shape (Q,).
        point: The point of each, shape (Q,).
        tensor: Sum of A N N^T of each point, shape (P, 3, 3).
        coarse: Start with cells of 0.5 rad.

    Returns:
        Vectors as long as the sum of their areas, shape (V, 3), and their points, ascending, shape (V,).
    """
    axes = torch.linalg.eigh(tensor)[1].flip(-1)  # the main direction first
    local = (axes[point].mT @ normal[..., None])[..., 0]
    major = local.abs().argmax(-1, keepdim=True)  # the face of a cube that the direction points to
    sign = torch.where(local.gather(-1, major) < 0, -1.0, 1.0)
    on_face = local * sign / local.gather(-1, major).abs()
    pending = torch.arange(len(point))
    cell = torch.zeros(len(point), 5, dtype=torch.long)
    for level, angle in enumerate(_COARSE if coarse else _ANGLES):
        rows = torch.cat([(on_face[pending] / angle).round().long(), major[pending]], -1)
        cell[pending] = torch.cat([rows, torch.full_like(rows[:, :1], level)], -1)
        group = equal_rows(torch.cat([point[pending, None], rows], -1))
        count = int(group.max()) + 1 if len(group) else 0
        used = group.new_zeros(count).index_put((group,), point[pending]).bincount(minlength=len(tensor))
        pending = pending[used[point[pending]] > MOST]
    group = equal_rows(torch.cat([point[:, None], cell], -1))
    total = sums(sign * area[:, None] * normal, group)
    size = sums(area, group)
    owner = torch.zeros(len(size), dtype=torch.long).index_put((group,), point)
    return torch.nn.functional.normalize(total, dim=-1) * size[:, None], owner
