r"""Thin surfaces in a lattice Boltzmann flow: immersed boundaries by direct forcing, with an exchange of momentum.

A surface is a set of points with an area. In a step of the air each of them takes from the air around it, and the air
loses, the momentum

.. math:: \mathbf J_p = \beta_p (\mathbf u(\mathbf x_p) - \bar{\mathbf v}_p), \qquad \beta_p = \frac{\rho h A_p}{c_p}

where :math:`\bar v` is the mean velocity of the point in the step and :math:`\beta` the mass of the layer of air at it
(h is the side of a cell). Air is read, and momentum given, with the quadratic B-spline of three cells along each axis,
a regularised delta (Peskin 2002, Acta Numerica 11); :math:`c_p = \sum_q \sum_n w_{pn} w_{qn} A_q / h^2` is how thickly
the surface covers the cells at p. With it, what the points together give to a cell never moves the air beyond them,
however many layers lie in a cell, and the air has the velocity of the surface after each step (direct forcing, Uhlmann
2005, J. Comput. Phys. 209). Momentum is kept to rounding, as the weights of a point add up to one.

The force on the point is :math:`\beta (\mathbf u - \mathbf v) / \Delta t` in each substep of the body, with the air at
the start of the step. So it is a drag, and air and point together lose the energy
:math:`\tfrac12\beta(u - \bar v)^2` or more. A force that stayed the same in all substeps would feed vibrations that are
faster than the step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying.air.collision import MOMENTS
from gaussian_swaying.air.flow import FLUID
from gaussian_swaying.kernels.launch import replaces
from gaussian_swaying.mpm.transfer import bspline_weights


@dataclass(frozen=True, slots=True)
class Reach:
    """The 27 cells around each point, and their weights.

    Attributes:
        cell: Flat index, int64, shape (27, P).
        weight: Their sum is 1; 0 for cells that are no air, and for points without air, shape (27, P).
    """

    cell: Tensor
    weight: Tensor

    @classmethod
    def around(cls, place: Tensor, kind: Tensor) -> Reach:
        """The cells around places.

        Args:
            place: In cells from the centre of the first cell, shape (P, 3).
            kind: What the cells are, see ``LatticeFlow``, shape (X, Y, Z); an axis of one cell repeats.
        """
        lattice = place.T
        base = torch.floor(lattice - 0.5)
        weight, _ = bspline_weights(lattice - base)  # (3 axes, 3, P)
        first = base.long()
        flat = torch.zeros((), dtype=torch.long, device=place.device)
        share = torch.ones((), dtype=place.dtype, device=place.device)
        for axis, count in enumerate(kind.shape):
            shape = [1, 1, 1, -1]
            shape[axis] = 3
            cell = first[axis] + torch.arange(3, device=place.device)[:, None]
            within = (cell >= 0) & (cell < count) if count > 1 else torch.ones_like(cell, dtype=torch.bool)
            cell = cell.clamp(0, count - 1)
            flat = flat * count + cell.reshape(shape)
            share = share * (weight[axis] * within).reshape(shape)
        flat, share = flat.reshape(27, -1), share.reshape(27, -1)
        share = share * (kind.reshape(-1)[flat] == FLUID)
        total = share.sum(0)
        return cls(flat, torch.where(total > 0, share / total.clamp(min=1e-30), 0.0))

    def read(self, field: Tensor) -> Tensor:
        """Values at the points, of a field with a row for each cell, shape (cells, C); returns shape (P, C)."""
        found = field.index_select(0, self.cell.reshape(-1)).view(27, -1, field.shape[-1])
        return (self.weight[..., None] * found).sum(0)

    def spread(self, amount: Tensor, cells: int) -> Tensor:
        """Amounts of the points, shape (P, C), shared among the cells; returns shape (cells, C)."""
        shares = (self.weight[..., None] * amount).reshape(-1, amount.shape[-1])
        return shares.new_zeros(cells, amount.shape[-1]).index_add_(0, self.cell.reshape(-1), shares)


def velocity_at(moments: Tensor, reach: Reach) -> Tensor:
    """Velocity of the air at points [cells per step], shape (P, 3)."""
    return reach.read(moments[1:4].reshape(3, -1).T)


def look(moments: Tensor, area: Tensor, place: Tensor, kind: Tensor) -> tuple[Tensor, Tensor]:
    r"""Velocity of the air at points, and the mass of the layer of air at each, :math:`A_p / c_p`.

    In float32 it runs as kernels. On a GPU the order of their sums is not fixed.

    Args:
        moments: Of the flow, shape (10, X, Y, Z).
        area: Area of the points in faces of a cell, shape (P,).
        place: In cells from the centre of the first cell, shape (P, 3).
        kind: What the cells are, see ``LatticeFlow``, shape (X, Y, Z).

    Returns:
        Shape (P, 3) [cells per step], and shape (P,) in units of the air in a cell; 0 for points without air.
    """
    if replaces([moments, area, place]):
        from gaussian_swaying.air import immersed_kernels

        found: tuple[Tensor, Tensor] = immersed_kernels.look(moments, area, place, kind)
        return found
    reach = Reach.around(place, kind)
    cover = reach.read(reach.spread(area[:, None], kind.numel()))[:, 0]
    return velocity_at(moments, reach), torch.where(cover > 0, area / cover.clamp(min=1e-30), 0.0)


def give(moments: Tensor, taken: Tensor, place: Tensor, kind: Tensor) -> None:
    """Take momentum of points out of the air, in place.

    Args:
        moments: Of the flow, shape (10, X, Y, Z).
        taken: What the points take, in units of the air in a cell at one cell per step, shape (P, 3).
        place: See :func:`look`.
        kind: See :func:`look`.
    """
    if replaces([moments, taken, place]):
        from gaussian_swaying.air import immersed_kernels

        immersed_kernels.give(moments, taken, place, kind)
        return
    flat = moments.reshape(MOMENTS, -1)
    loss = Reach.around(place, kind).spread(taken, flat.shape[1]).T
    flat[1:4] -= loss / (1 + flat[0])


def together(mass: Tensor, layer: Tensor) -> Tensor:
    r"""The reduced mass :math:`1 / (1/m + 1/\beta)` of two masses; 0 where one of them is 0."""
    return mass * layer / (mass + layer).clamp(min=1e-30)


def exchange(moments: Tensor, velocity: Tensor, area: Tensor, mass: Tensor, place: Tensor, kind: Tensor) -> Tensor:
    """The momentum that free points take from the air in a step without substeps; the air loses it, in ``moments``.

    As in an inelastic collision of each point with the layer of air at it, so that any ratio of masses is stable.

    Args:
        moments: Of the flow, changed in place, shape (10, X, Y, Z).
        velocity: Of the points [cells per step], shape (P, 3).
        area: Their area in faces of a cell, shape (P,).
        mass: Their mass in units of the air in a cell, shape (P,); infinite for still ones is given as a large number.
        place: See :func:`look`.
        kind: See :func:`look`.

    Returns:
        Momentum in units of the air in a cell at one cell per step, shape (P, 3).
    """
    air, layer = look(moments, area, place, kind)
    taken = together(mass, layer)[:, None] * (air - velocity)
    give(moments, taken, place, kind)
    return taken
