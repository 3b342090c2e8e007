"""Shelter: a body slows the wind on its way through, so that the inner leaves of a crown feel less of it."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.wind.effects import Moment, WindEffect
from gaussian_swaying.wind.tables import Tabulated


def extinction(density: Tensor, spacing: Tensor) -> Tensor:
    r"""Share of the wind that is left on its way along the first axis of a grid.

    Leaves of a drag area per volume a take the momentum :math:`\tfrac12 \rho a u^2` from the air, so that

    .. math:: \frac{du}{ds} = -\tfrac12 a u, \qquad u = u_0 \exp\Bigl(-\tfrac12 \int a\, ds\Bigr)

    as inside plant canopies (Cionco 1965, J. Appl. Meteorol. 4; here without mixing from above). The integral is summed
    by the trapezoidal rule.

    Args:
        density: Drag area (C_D A) per volume at the corners of the cells [1/m], shape (X, Y, Z).
        spacing: Side of a cell along the wind [m], scalar.

    Returns:
        Shape (X, Y, Z).
    """
    depth = spacing * (density.cumsum(0) - 0.5 * density)
    return torch.exp(-0.5 * depth)


def deposited(place: Tensor, amount: Tensor, cells: int) -> Tensor:
    """Amounts shared among the eight corners around each place, by the weights of trilinear interpolation.

    They are summed as whole numbers of 2^-40 of the largest, so that the sum does not depend on its order.

    Args:
        place: Places in cells from the first corner, shape (P, 3); within the grid.
        amount: Shape (P,).
        cells: Corners along each axis.

    Returns:
        Shape (cells, cells, cells).
    """
    place = place.nan_to_num(0.0)
    low = place.floor().clamp(0, cells - 2)
    share = place - low
    unit = in_double(amount).amax().clamp(min=1e-300) * 2.0**-40
    found = torch.zeros(cells**3, dtype=torch.long, device=unit.device)
    for corner in range(8):
        bits = [(corner >> axis) & 1 for axis in range(3)]
        weight, row = amount, torch.zeros_like(low[:, 0], dtype=torch.long)
        for axis, bit in enumerate(bits):
            weight = weight * (share[:, axis] if bit else 1 - share[:, axis])
            row = row * cells + low[:, axis].long() + bit
        found = found.index_add(0, row.to(unit.device), (in_double(weight) / unit).round().long())
    return (found * unit).to(place).view(cells, cells, cells)


class Shelter(Tabulated):
    """The body's own patches slow the wind on its way, by the exponential law of :func:`extinction`.

    Meant for crowns, hedges and stands of plants: many small leaves to a cell. A single sheet across the wind would
    shelter itself, since the cells do not know that its patches lie side by side. It is computed again at the start of
    every frame, from the shape of the body then, in the direction of the mean flow. Place it last in the list.

    Args:
        cells: Corners of the grid along each axis; its side is the longest of the body's box. A cell should contain
            several leaves.
        strength: Factor of the drag area, for example for leaves that the splat does not show.
    """

    twin = Tabulated.twin

    def __init__(self, cells: int = 32, strength: float = 1.0) -> None:
        if isinstance(cells, bool) or not isinstance(cells, int) or not 4 <= cells <= 256:
            raise ValueError(f"Expected `cells` to be a whole number from 4 to 256, but got {cells!r}.")
        check_positive("strength", strength, allow_zero=True)
        self.cells, self.strength = cells, float(strength)
        one = torch.ones(3, dtype=torch.float64)
        super().__init__(torch.ones(cells, cells, cells, 1), one, torch.zeros_like(one))

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """A copy, which a simulation refreshes; the given one stays as it is, for the comparison before a resume."""
        return changed(self, **{name: held.clone() for name, held in self.named_buffers()})

    def refresh(self, position: Tensor, drag_area: Tensor, axes: Tensor) -> None:
        """Compute the share of the wind that is left, from the present shape of the body.

        Args:
            position: Of the particles [m], shape (P, 3).
            drag_area: C_D A of each [m²], shape (P,).
            axes: Axes of the grid, the wind first, as rows, shape (3, 3).
        """
        turned = position @ axes.to(position).T
        low, high = turned.amin(0), turned.amax(0)
        side = ((high - low).amax() / (self.cells - 3)).clamp(min=1e-9)
        shift = 0.5 * (self.cells - 1) - 0.5 * (low + high) / side
        amount = self.strength * drag_area.to(position) / side**3
        density = deposited(turned / side + shift, amount, self.cells)
        self.table.copy_(extinction(density, side)[..., None])
        self.axes.copy_(axes)
        self.step.copy_(side)
        self.place.copy_(shift)

    def now(self, moment: Moment) -> Tensor:
        return torch.nn.functional.pad(self.place, (0, 1)).expand(len(moment.time), 4)
