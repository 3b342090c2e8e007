"""Effects that are looked up in a table, by linear interpolation between its corners.

Fields that the mean wind carries, winds from files, and the shelter that a body gives itself.
"""

from __future__ import annotations

import os
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._devices import in_double
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.geometry.linalg_triton import add3, chosen, matvec, scale3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers
from gaussian_swaying.wind.effects import Moment, WindEffect, placed
from gaussian_swaying.wind.wind_files import read_bts, read_grid


@triton.jit
def _corners(x, n, WRAPS: tl.constexpr):
    """The two rows of a table around a place on one axis, and the share of the second; n is a whole number.

    They lie in the table even if the place is NaN or infinite, as where a simulation diverges.
    """
    if not WRAPS:
        x = tl.minimum(tl.maximum(x, 0.0), n - 1)
    first = tl.floor(x)
    share = x - first
    if WRAPS:
        low = first - n * tl.floor(first / n)
        low = tl.where(low >= n, 0.0, low)
        high = tl.where(low + 1 >= n, 0.0, low + 1)
    else:
        low = first
        high = tl.minimum(first + 1, n - 1)
    last = n.to(tl.int32) - 1
    row = tl.minimum(tl.maximum(low.to(tl.int32), 0), last)
    return row, tl.minimum(tl.maximum(high.to(tl.int32), 0), last), share


@triton.jit
def look_up(table, sizes, place, OPTIONS: tl.constexpr):
    """Three values of a table, or one and two zeros; ``OPTIONS`` begins as those of :func:`tabulated`."""
    x0, x1, fx = _corners(place[0], sizes[0], OPTIONS[0])
    y0, y1, fy = _corners(place[1], sizes[1], OPTIONS[1])
    z0, z1, fz = _corners(place[2], sizes[2], OPTIONS[2])
    my = sizes[1].to(tl.int32)
    mz = sizes[2].to(tl.int32)
    zero = fx * 0
    a, b, c = zero, zero, zero
    xs, ys, wx, wy = (x0, x1), (y0, y1), (1 - fx, fx), (1 - fy, fy)
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            w = wx[i] * wy[j]
            line = (xs[i] * my + ys[j]) * mz
            low = table + (line + z0) * OPTIONS[3]
            high = table + (line + z1) * OPTIONS[3]
            w0 = w * (1 - fz)
            w1 = w * fz
            a += w0 * tl.load(low) + w1 * tl.load(high)
            if OPTIONS[3] == 3:
                b += w0 * tl.load(low + 1) + w1 * tl.load(high + 1)
                c += w0 * tl.load(low + 2) + w1 * tl.load(high + 2)
    return a, b, c


@triton.jit
def tabulated(v, x, numbers, now, table, OPTIONS: tl.constexpr):
    """Device function of ``Tabulated``: looks a table of velocities or factors up, and applies it.

    ``numbers``: matrix from places to cells (9), matrix from the axes of the table (9), its sizes (3). ``now``: origin
    [cells] (3) and factor; with a table for each time also the indices of two tables and the weight of the second.
    ``OPTIONS``: whether it repeats along each axis (3), values per corner, whether it has times.
    """
    p = add3(matvec(numbers, x), 1.0, now)
    sizes = chosen(numbers, 18, 3)
    if OPTIONS[3] == 1:
        found = look_up(table, sizes, p, OPTIONS)
        found = scale3(found[0], v)
    else:
        if OPTIONS[4]:
            whole = sizes[0].to(tl.int32) * sizes[1].to(tl.int32) * sizes[2].to(tl.int32) * OPTIONS[3]
            before = look_up(table + now[4].to(tl.int32) * whole, sizes, p, OPTIONS)
            after = look_up(table + now[5].to(tl.int32) * whole, sizes, p, OPTIONS)
            found = add3(scale3(1 - now[6], before), now[6], after)
        else:
            found = look_up(table, sizes, p, OPTIONS)
        found = add3(v, now[3], matvec(chosen(numbers, 9, 9), found))
    return found


def wind_axes(flow: Tensor) -> Tensor:
    """Axes as rows, shape (3, 3): the first along a flow, the second horizontal; the host does not wait.

    Args:
        flow: The flow [m/s], shape (3,); x if it is zero.
    """
    speed = torch.linalg.vector_norm(flow)
    eye = torch.diag(torch.ones_like(flow))
    x = torch.where(speed > 0, flow / speed.clamp(min=1e-30), eye[0])
    y = torch.linalg.cross(torch.where(x[2].abs() > 0.99, eye[0], eye[2]), x)
    y = y / torch.linalg.vector_norm(y)
    return torch.stack([x, y, torch.linalg.cross(x, y)])


class Tabulated(WindEffect, ABC):
    """Base of effects in a table of added velocities, or of factors on the velocity.

    Args:
        table: Values at the corners of its cells, along its own axes, shape (X, Y, Z, 3), or (X, Y, Z, 1) for shares;
            for each of several times (T, X, Y, Z, 3).
        step: Sides of a cell [m], shape (3,), float64.
        origin: Where its first corner is, or a point that the subclass knows, in scene units; in Python [m], z up.
        wraps: Whether it repeats along each axis; if not, its outermost values go on outside.
    """

    recordable = True
    table: Tensor
    sizes: Tensor
    axes: Tensor
    step: Tensor
    place: Tensor

    def __init__(
        self,
        table: Tensor,
        step: Tensor,
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        wraps: tuple[bool, bool, bool] = (False, False, False),
    ) -> None:
        super().__init__()
        self.wraps, self.origin = wraps, check_vector("origin", origin)
        place = torch.tensor(self.origin, dtype=torch.float64)
        sizes, eye = torch.tensor(table.shape[-4:-1], dtype=torch.float64), torch.eye(3, dtype=torch.float64)
        for name, value in {"table": table, "sizes": sizes, "axes": eye, "step": step, "place": place}.items():
            self.register_buffer(name, value, persistent=False)

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The origin in metres."""
        return changed(self, place=torch.tensor(placed(frame, self.origin), dtype=torch.float64))

    @abstractmethod
    def now(self, moment: Moment) -> Tensor:
        """The numbers of n times, see :func:`tabulated`: shape (n, 4), or (n, 7) with a table for each time."""

    def device_function(self) -> DeviceFunction:
        timed = self.table.ndim > 4

        def numbers() -> Tensor:
            return torch.cat([(self.axes / self.step[:, None]).reshape(-1), self.axes.T.reshape(-1), self.sizes])

        return DeviceFunction(
            tabulated,
            options=(*map(bool, self.wraps), self.table.shape[-1], timed),
            numbers=Numbers(21, numbers),
            per_substep=Numbers(7 if timed else 4, self.now),
            table=Numbers(self.table.numel(), lambda: self.table),
            sources=(self,),
        )


def box_axes(flow: Tensor, sides: Sequence[float], tilted: bool) -> Tensor:
    r"""Axes of a box that a flow carries along its x axis, as rows; y is horizontal.

    A periodic box repeats after one length. With ``tilted``, it is turned against the flow, so that each length later a
    point meets the box 0.382 of its width and 0.236 of its height further on, and only after many lengths close to the
    first place. The turn does not change isotropic turbulence.

    Args:
        flow: The flow [m/s], shape (3,); x if it is zero.
        sides: Lengths of the box along its axes [m].

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
        (self.scale,), self.tilted = check_vector("scale", [scale], 1), bool(tilted)
        step, first = (torch.tensor(v, dtype=torch.float64) for v in (self.spacing, anchor))
        super().__init__(table, step, origin, wraps)
        self.register_buffer("anchor", first, persistent=False)
        self.register_buffer("start", torch.zeros_like(first), persistent=False)

    anchor: Tensor
    start: Tensor

    def along(self, flow: Tensor) -> WindEffect:
        return changed(self, axes=box_axes(flow.detach().cpu(), (self.sizes * self.step).tolist(), self.tilted))

    def now(self, moment: Moment) -> Tensor:
        """Position of the object's centre in the field, within its first period, and the strength."""
        place = self.anchor - (self.place + self.start + moment.carried) @ self.axes.T
        parts = zip(place.unbind(-1), (self.sizes * self.step).unbind(), self.wraps, strict=True)
        place = torch.stack([x.remainder(side) if wraps else x for x, side, wraps in parts], dim=-1)
        return torch.cat([place / self.step, moment.gusts[:, None] * self.strength(moment.flow)], dim=-1)

    def strength(self, flow: Tensor) -> Tensor | float:
        """Factor of the velocities in a mean flow [m/s], shape (n, 3); shape (n, 1), or one number."""
        return self.scale

    device_function = Tabulated.device_function


class FrozenWind(CarriedField):
    """Adds a frozen field from a file, carried by the mean flow: TurbSim's .bts, hipersim's .nc, or a .npz.

    The x axis of the file points along the flow, y to its left, z up. Along the wind it repeats; across and up, the
    outermost values extend outside.

    A .bts contains the mean wind as well. The mean at the hub is subtracted, since ``wind.flow`` has it and must have
    the same speed; the turbulence and the profile of the mean are left. Other files contain deviations from the mean.

    Args:
        path: The file; for .nc and .npz see :func:`~gaussian_swaying.wind.wind_files.read_grid`.
        origin: The point, in scene units, that passes the first plane of the file at time zero: in the middle of its
            width, and on the ground for a .bts, at z = 0 of the file otherwise.
        scale: Factor of the velocities.

    Raises:
        ValueError: If the file does not fit, or the flow is not that of a .bts.
    """

    device_function = Tabulated.device_function

    def __init__(
        self, path: str | os.PathLike[str], origin: Sequence[float] = (0.0, 0.0, 0.0), scale: float = 1.0
    ) -> None:
        self.path, self.speed = str(path), None
        if Path(path).suffix == ".bts":
            found = read_bts(path)
            speed = found.speed
            velocity = torch.from_numpy(found.velocity).clone()
            velocity[..., 0] -= speed
            table = velocity.roll(-1, 0).flip(0)  # later planes are further upwind
            if table.shape[2] == 1:
                table = table.expand(-1, -1, 2, -1)
            spacing = (speed * found.dt, *found.spacing)
            middle = 0.5 * (table.shape[1] - 1) * spacing[1]
            super().__init__(
                table.contiguous(), spacing, origin, (0.0, middle, -found.bottom), (True, False, False), scale
            )
            self.speed = speed
            return
        grid = read_grid(path)
        if len(grid.times) > 1:
            raise ValueError(f"{path} changes over time: use RecordedWind.")
        table = torch.from_numpy(grid.velocity)[0]
        middle = 0.5 * (table.shape[1] - 1) * grid.spacing[1]
        anchor = (0.0, middle, -grid.first[2])
        super().__init__(table.contiguous(), grid.spacing, origin, anchor, (True, False, False), scale)

    def along(self, flow: Tensor) -> WindEffect:
        """The field with its x axis turned into the flow, which must be that of the file."""
        speed = float(flow.norm())
        if self.speed is not None and abs(speed - self.speed) > 0.01 * self.speed:
            raise ValueError(
                f"The mean wind of {self.path} is {self.speed:.4g} m/s, but `wind.flow` has {speed:.4g} m/s: set it to "
                f"{self.speed:.4g} m/s in the direction that you want."
            )
        return super().along(flow)


class RecordedWind(Tabulated):
    """Adds a wind that was recorded on a regular grid, over time; linear in time and along each axis.

    Outside the grid, the outermost values apply. With ``wind.flow: [0, 0, 0]`` it is the whole wind.

    Args:
        path: A .npz or .nc file, see :func:`~gaussian_swaying.wind.wind_files.read_grid`; places in m and velocities in
            m/s, z up.
        origin: The point x = y = z = 0 of the file, in scene units.
        start: Time of the file at time zero of the run [s]; its first time if null.
        repeat: Whether it starts again after its last time, which is then followed by the first as by any other; if
            not, the last field stays.
        scale: Factor of the velocities.

    Raises:
        ValueError: If the file does not fit.
    """

    device_function = Tabulated.device_function

    def __init__(
        self,
        path: str | os.PathLike[str],
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        start: float | None = None,
        repeat: bool = False,
        scale: float = 1.0,
    ) -> None:
        grid = read_grid(path)
        (self.scale,), self.repeat, self.path = check_vector("scale", [scale], 1), bool(repeat), str(path)
        times = torch.from_numpy(grid.times)
        begin = float(times[0]) if start is None else check_vector("start", [start], 1)[0]
        step = float((times[-1] - times[0]) / (len(times) - 1)) if len(times) > 1 else 1.0
        check_positive("the step of time", step)
        self.period = float(times[-1] - times[0]) + step
        spacing, first = (torch.tensor(v, dtype=torch.float64) for v in (grid.spacing, grid.first))
        super().__init__(torch.from_numpy(grid.velocity), spacing, origin)
        begin_at = torch.tensor(begin - float(times[0]), dtype=torch.float64)
        for name, value in {"times": times - times[0], "begin": begin_at, "first": first}.items():
            self.register_buffer(name, value, persistent=False)

    times: Tensor
    begin: Tensor
    first: Tensor

    def now(self, moment: Moment) -> Tensor:
        last = len(self.times) - 1
        now = moment.time + self.begin
        now = now.remainder(self.period) if self.repeat else now
        key = (torch.searchsorted(self.times, now, right=True) - 1).clamp(0, last)
        after = (key + 1).remainder(last + 1) if self.repeat else (key + 1).clamp(max=last)
        begin, end = self.times.index_select(0, key), self.times.index_select(0, after)
        share = (now - begin) / torch.where(after > key, end - begin, self.period - begin)
        place = (-(self.place + self.first) / self.step).expand(len(now), 3)
        rest = torch.stack([torch.full_like(now, self.scale), key, after, share.clamp(0, 1)], dim=-1)
        return torch.cat([place, rest], dim=-1)


def extinction(density: Tensor, spacing: Tensor) -> Tensor:
    r"""Share of the wind left after its way along the first axis of a grid.

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
    """Distribute amounts to the eight corners around each place, with trilinear weights.

    They are summed as whole numbers of 2^-40 of the largest, so that the sum does not depend on its order.

    Args:
        place: Places in cells from the first corner, shape (P, 3); within the grid.

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

    device_function = Tabulated.device_function

    def __init__(self, cells: int = 32, strength: float = 1.0) -> None:
        if isinstance(cells, bool) or not isinstance(cells, int) or not 4 <= cells <= 256:
            raise ValueError(f"Expected `cells` to be a whole number from 4 to 256, but got {cells!r}.")
        check_positive("strength", strength, allow_zero=True)
        self.cells, self.strength = cells, float(strength)
        super().__init__(torch.ones(cells, cells, cells, 1), torch.ones(3, dtype=torch.float64))

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
