"""Frozen fields that the mean wind carries: turbulence made here, and fields made elsewhere."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.wind.effects import Moment, WindEffect, placed
from gaussian_swaying.wind.spectra import SPECTRA, resolved_share
from gaussian_swaying.wind.tables import Tabulated, wind_axes
from gaussian_swaying.wind.turbulence_box import sheared_variances, turbulence_box


def box_axes(flow: Tensor, sides: Sequence[float], tilted: bool) -> Tensor:
    r"""Axes of a box that a flow carries along its x axis, as rows; y is horizontal.

    A periodic box repeats after one length. With ``tilted``, it is turned against the flow, so that each length later a
    point meets the box 0.382 of its width and 0.236 of its height further on, and only after many lengths close to the
    first place. The turn does not change isotropic turbulence.

    Args:
        flow: The flow [m/s], shape (3,); x if it is zero.
        sides: Lengths of the box along its axes [m].
        tilted: Whether to turn it.

    Returns:
        Orthonormal, shape (3, 3), float64.
    """
    axes = wind_axes(flow.double())
    if not tilted:
        return axes
    first = torch.tensor([sides[0], 0.382 * sides[1], 0.236 * sides[2]], dtype=torch.float64)
    first = first / first.norm()  # the direction of the flow along the axes of the box
    second = torch.nn.functional.normalize(torch.tensor([-first[1], first[0], 0.0], dtype=torch.float64), dim=0)
    turn = torch.stack([first, second, torch.linalg.cross(first, second)])  # rows: x, y, z of the flow in the box
    return turn.T @ axes


class CarriedField(Tabulated):
    """Adds a frozen field that the mean flow carries along (Taylor 1938), by linear interpolation.

    Args:
        table: Velocities at the corners of its cells, along its own axes, shape (X, Y, Z, 3), float32.
        spacing: Sides of a cell [m].
        origin: A point in scene units; in Python [m], z up, from the object's centre.
        anchor: Position of that point in the field at time zero, from its first corner, along its axes [m].
        wraps: Whether it repeats along each axis; if not, its outermost values go on outside.
        scale: Factor of the velocities.
        tilted: See :func:`box_axes`.

    Raises:
        ValueError: If the table has the wrong shape.
    """

    def __init__(
        self,
        table: Tensor,
        spacing: Sequence[float],
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        anchor: Sequence[float] = (0.0, 0.0, 0.0),
        wraps: tuple[bool, bool, bool] = (True, True, True),
        scale: float = 1.0,
        tilted: bool = False,
    ) -> None:
        if table.ndim != 4 or table.shape[-1] != 3 or min(table.shape[:3]) < 2:
            raise ValueError(f"Expected `table` of shape (X, Y, Z, 3), at least 2 each, but got {tuple(table.shape)}.")
        self.spacing = check_vector("spacing", spacing)
        self.origin, (self.scale,) = check_vector("origin", origin), check_vector("scale", [scale], 1)
        self.tilted = bool(tilted)
        step, place, first = (torch.tensor(v, dtype=torch.float64) for v in (self.spacing, self.origin, anchor))
        super().__init__(table, step, place, wraps)
        self.register_buffer("anchor", first, persistent=False)
        self.register_buffer("start", torch.zeros_like(first), persistent=False)

    anchor: Tensor
    start: Tensor

    def along(self, flow: Tensor) -> WindEffect:
        """The field with its x axis turned into the flow."""
        return changed(self, axes=box_axes(flow.detach().cpu(), (self.sizes * self.step).tolist(), self.tilted))

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The origin in metres."""
        return changed(self, place=torch.tensor(placed(frame, self.origin), dtype=torch.float64))

    def now(self, moment: Moment) -> Tensor:
        """The place of the object's centre in the field, in its first period where it repeats, and the strength."""
        place = self.anchor - (self.place + self.start + moment.carried) @ self.axes.T
        parts = zip(place.unbind(-1), (self.sizes * self.step).unbind(), self.wraps, strict=True)
        place = torch.stack([x.remainder(side) if wraps else x for x, side, wraps in parts], dim=-1)
        return torch.cat([place / self.step, torch.zeros_like(place[:, :1]) + self.strength(moment.flow)], dim=-1)

    def strength(self, flow: Tensor) -> Tensor | float:
        """Factor of the velocities in a mean flow [m/s], shape (n, 3); shape (n, 1), or one number."""
        return self.scale

    twin = Tabulated.twin


class Turbulence(CarriedField):
    """Turbulence in space and time: a box without divergence that the mean wind carries along.

    It depends on its seed alone: not on the device, the substep or the number of Gaussians. See
    :func:`~gaussian_swaying.wind.turbulence_box.turbulence_box`. A cell of a sixteenth of the length resolves 92 % of
    the variance of the along-wind component, and interpolation between its corners takes some more of the smallest
    waves (docs/wind.md).

    Args:
        intensity: Standard deviation of the component along the wind per speed of the mean flow.
        length: Its integral length scale [m]: roughly the size of the largest gusts. Near the ground it is about the
            height above it.
        spectrum: ``von_karman``, or ``kaimal`` for a boundary layer.
        gamma: Mann's shear, which makes gusts along the wind stronger than those up and down; 3.9 near the ground, and
            0 for isotropic turbulence. It makes gusts longer than the box can contain: raise ``spacing`` to a quarter
            of ``length``.
        cells: Cells of the box along the wind, across and up.
        spacing: Side of a cell [m]; a sixteenth of ``length`` if null.
        seed: Another seed is another turbulence.
        start: How far the air has come when the run begins [m], z up: another stretch of the same turbulence.

    Example:
        >>> gusts = Turbulence(intensity=0.2, length=1.0, cells=[32, 16, 16], spacing=0.25)
        >>> gusts.table.shape
        torch.Size([32, 16, 16, 3])
    """

    twin = Tabulated.twin

    def __init__(
        self,
        intensity: float = 0.15,
        length: float = 1.0,
        spectrum: str = "von_karman",
        gamma: float = 0.0,
        cells: Sequence[int] = (256, 128, 128),
        spacing: float | None = None,
        seed: int = 0,
        start: Sequence[float] = (0.0, 0.0, 0.0),
    ) -> None:
        check_positive("intensity", intensity, allow_zero=True)
        check_positive("length", length)
        check_choice("spectrum", spectrum, SPECTRA)
        if spacing is not None:
            check_positive("spacing", spacing)
        side = length / 16 if spacing is None else float(spacing)
        table = _box(tuple(cells), side, float(length), spectrum, float(gamma), int(seed)).clone()
        relative = 1 / math.sqrt(sheared_variances(float(gamma))[0])  # the component along the wind has the intensity
        # Mann's box has a direction, and so has one whose repetition is avoided by a turn
        super().__init__(table, [side] * 3, scale=float(intensity) * relative, tilted=gamma == 0)
        self.start = torch.tensor(check_vector("start", start), dtype=torch.float64)
        self.intensity, self.length, self.spectrum, self.gamma = float(intensity), float(length), spectrum, float(gamma)

    @property
    def resolved(self) -> float:
        """Share of the variance along the wind that the cells resolve; without the shear."""
        return resolved_share(self.length, self.spacing, self.spectrum)  # type: ignore[arg-type]

    def strength(self, flow: Tensor) -> Tensor:
        """Standard deviation [m/s] in a mean flow: in proportion to its speed."""
        return self.scale * torch.linalg.vector_norm(flow, dim=-1, keepdim=True)


@lru_cache(maxsize=2)
def _box(cells: tuple[int, ...], side: float, length: float, spectrum: str, gamma: float, seed: int) -> Tensor:
    """Return :func:`turbulence_box`, cached, so that the same turbulence in another wind need not be made again."""
    return turbulence_box(cells, [side] * 3, length, spectrum, gamma, seed)
