"""Shelter: a body slows the wind on its way through, so that the inner leaves of a crown feel less of it."""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.twins import Numbers, Twin
from gaussian_swaying.wind.effects import Moment, WindEffect
from gaussian_swaying.wind.lookup import trilinear


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


def wind_axes(flow: Tensor) -> Tensor:
    """Axes with the first along a flow, as rows, shape (3, 3), without making the host wait.

    Args:
        flow: The flow [m/s], shape (3,); x if it is zero.
    """
    speed = torch.linalg.vector_norm(flow)
    eye = torch.diag(torch.ones_like(flow))
    x = torch.where(speed > 0, flow / speed.clamp(min=1e-30), eye[0])
    y = torch.linalg.cross(torch.where(x[2].abs() > 0.99, eye[0], eye[2]), x)
    y = y / torch.linalg.vector_norm(y)
    return torch.stack([x, y, torch.linalg.cross(x, y)])


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


class Shelter(WindEffect):
    """The body's own patches slow the wind on its way, by the exponential law of :func:`extinction`.

    Meant for crowns, hedges and stands of plants: many small leaves to a cell. A single sheet across the wind would
    shelter itself, since the cells do not know that its patches lie side by side. It is computed again at the start of
    every frame, from the shape of the body then, in the direction of the mean flow. Place it last in the list.

    Args:
        cells: Corners of the grid along each axis; its side is the longest of the body's box. A cell should contain
            several leaves.
        strength: Factor of the drag area, for example for leaves that the splat does not show.
    """

    recordable = True

    def __init__(self, cells: int = 32, strength: float = 1.0) -> None:
        super().__init__()
        if isinstance(cells, bool) or not isinstance(cells, int) or not 4 <= cells <= 256:
            raise ValueError(f"Expected `cells` to be a whole number from 4 to 256, but got {cells!r}.")
        check_positive("strength", strength, allow_zero=True)
        self.cells, self.strength = cells, float(strength)
        self.register_buffer("table", torch.ones(cells, cells, cells), persistent=False)
        # place in cells: turn @ position + shift
        self.register_buffer("turn", torch.eye(3, dtype=torch.float64), persistent=False)
        self.register_buffer("shift", torch.zeros(3, dtype=torch.float64), persistent=False)
        self.table: Tensor
        self.turn: Tensor
        self.shift: Tensor

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
        self.table.copy_(extinction(density, side))
        self.turn.copy_(in_double(axes) / in_double(side))
        self.shift.copy_(in_double(shift))

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        """Multiply the velocity by the share that is left."""
        place = position @ self.turn.to(position).T + self.shift.to(position)
        return velocity * trilinear(self.table[..., None], place)

    def twin(self) -> Twin:
        from gaussian_swaying.wind.effects_triton import sheltered

        def numbers() -> Tensor:
            return torch.cat([self.turn.reshape(-1), self.shift, self.shift.new_full((3,), self.cells)])

        table = Numbers(self.table.numel(), lambda: self.table)
        return Twin(sheltered, numbers=Numbers(15, numbers), table=table, sources=(self,))
