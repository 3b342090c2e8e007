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
from gaussian_swaying.mpm.twins import Numbers, Twin
from gaussian_swaying.wind.effects import Moment, WindEffect, placed
from gaussian_swaying.wind.lookup import trilinear
from gaussian_swaying.wind.spectra import SPECTRA, resolved_share
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
    flow = flow.double()
    speed = float(flow.norm())
    x = flow / speed if speed > 0 else torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    if float(x[2].abs()) > 0.99:
        up = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    y = torch.nn.functional.normalize(torch.linalg.cross(up, x), dim=0)
    axes = torch.stack([x, y, torch.linalg.cross(x, y)])
    if not tilted:
        return axes
    first = torch.tensor([sides[0], 0.382 * sides[1], 0.236 * sides[2]], dtype=torch.float64)
    first = first / first.norm()  # the direction of the flow along the axes of the box
    second = torch.nn.functional.normalize(torch.tensor([-first[1], first[0], 0.0], dtype=torch.float64), dim=0)
    turn = torch.stack([first, second, torch.linalg.cross(first, second)])  # rows: x, y, z of the flow in the box
    return turn.T @ axes


class CarriedField(WindEffect):
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

    recordable = True

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
        super().__init__()
        if table.ndim != 4 or table.shape[-1] != 3 or min(table.shape[:3]) < 2:
            raise ValueError(f"Expected `table` of shape (X, Y, Z, 3), at least 2 each, but got {tuple(table.shape)}.")
        self.spacing = check_vector("spacing", spacing)
        self.origin, self.wraps = check_vector("origin", origin), wraps
        self.scale, self.tilted = check_vector("scale", [scale], 1)[0], bool(tilted)
        self.register_buffer("table", table, persistent=False)
        self.register_buffer("axes", torch.eye(3, dtype=torch.float64), persistent=False)
        sides = torch.tensor([n * h for n, h in zip(table.shape[:3], self.spacing, strict=True)], dtype=torch.float64)
        self.register_buffer("sides", sides, persistent=False)
        step = torch.tensor(self.spacing, dtype=torch.float64)
        self.register_buffer("step", step, persistent=False)
        self.register_buffer("place", torch.tensor(self.origin, dtype=torch.float64), persistent=False)
        found = torch.tensor(check_vector("anchor", anchor), dtype=torch.float64)
        self.register_buffer("anchor", found, persistent=False)
        self.register_buffer("start", torch.zeros(3, dtype=torch.float64), persistent=False)
        self.register_buffer("repeats", torch.tensor(wraps), persistent=False)
        self.table: Tensor
        self.axes: Tensor
        self.sides: Tensor
        self.step: Tensor
        self.place: Tensor
        self.anchor: Tensor
        self.start: Tensor
        self.repeats: Tensor

    def along(self, flow: Tensor) -> WindEffect:
        """The field with its x axis turned into the flow."""
        return changed(self, axes=box_axes(flow.detach().cpu(), self.sides.tolist(), self.tilted))

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The origin in metres."""
        return changed(self, place=torch.tensor(placed(frame, self.origin), dtype=torch.float64))

    def offset(self, carried: Tensor) -> Tensor:
        """Place of the object's centre in the field, in cells, when the flow has ``carried`` it [m], shape (..., 3).

        It is reduced to the first period along the axes that repeat, so that float32 is precise enough.
        """
        place = self.anchor - (self.place + self.start + carried) @ self.axes.T
        return torch.where(self.repeats.to(place.device), place.remainder(self.sides), place) / self.step

    def strength(self, flow: Tensor) -> Tensor | float:
        """Factor of the velocities in a mean flow [m/s], shape (..., 3); shape (..., 1), or one number."""
        return self.scale

    def forward(self, velocity: Tensor, position: Tensor, moment: Moment) -> Tensor:
        axes = self.axes.to(position)
        place = position @ (axes / self.step[:, None].to(position)).T + self.offset(moment.carried).to(position)
        found = trilinear(self.table, place, self.wraps) @ axes
        strength = self.strength(moment.flow)
        return velocity.to(found) + (strength.to(found) if isinstance(strength, Tensor) else strength) * found

    def twin(self) -> Twin:
        from gaussian_swaying.wind.effects_triton import carried_field

        def now(moment: Moment) -> Tensor:
            place, strength = self.offset(moment.carried), self.strength(moment.flow)
            return torch.cat([place, torch.zeros_like(place[:, :1]) + strength], dim=-1)

        def numbers() -> Tensor:
            sizes = self.sides.new_tensor(self.table.shape[:3])
            return torch.cat([(self.axes / self.step[:, None]).reshape(-1), self.axes.T.reshape(-1), sizes])

        return Twin(
            carried_field,
            options=tuple(map(bool, self.wraps)),
            numbers=Numbers(21, numbers),
            per_substep=Numbers(4, now),
            table=Numbers(self.table.numel(), lambda: self.table),
            sources=(self,),
        )


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

    recordable = True
    twin = CarriedField.twin

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
