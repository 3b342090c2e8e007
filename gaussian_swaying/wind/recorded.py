"""Winds made or measured elsewhere, as effects."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import changed
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.wind.carried import CarriedField
from gaussian_swaying.wind.effects import Moment, WindEffect, placed
from gaussian_swaying.wind.tables import Tabulated
from gaussian_swaying.wind.wind_files import read_bts, read_grid


class FrozenWind(CarriedField):
    """Adds a frozen field from a file, carried by the mean flow: TurbSim's .bts, hipersim's .nc, or a .npz.

    The x axis of the file points along the flow, y to its left, z up. Along the wind it starts again at its end; across
    and up its outermost values go on outside.

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

    twin = Tabulated.twin

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

    Outside the grid its outermost values go on. With ``wind.flow: [0, 0, 0]`` it is the whole wind.

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

    twin = Tabulated.twin

    def __init__(
        self,
        path: str | os.PathLike[str],
        origin: Sequence[float] = (0.0, 0.0, 0.0),
        start: float | None = None,
        repeat: bool = False,
        scale: float = 1.0,
    ) -> None:
        grid = read_grid(path)
        self.path, self.origin = str(path), list(check_vector("origin", origin))
        (self.scale,), self.repeat = check_vector("scale", [scale], 1), bool(repeat)
        times = torch.from_numpy(grid.times)
        begin = float(times[0]) if start is None else check_vector("start", [start], 1)[0]
        step = float((times[-1] - times[0]) / (len(times) - 1)) if len(times) > 1 else 1.0
        check_positive("the step of time", step)
        self.period = float(times[-1] - times[0]) + step
        spacing, first, place = (torch.tensor(v, dtype=torch.float64) for v in (grid.spacing, grid.first, self.origin))
        super().__init__(torch.from_numpy(grid.velocity), spacing, place)
        begin_at = torch.tensor(begin - float(times[0]), dtype=torch.float64)
        for name, value in {"times": times - times[0], "begin": begin_at, "first": first}.items():
            self.register_buffer(name, value, persistent=False)

    times: Tensor
    begin: Tensor
    first: Tensor

    def in_frame(self, frame: SimFrame) -> WindEffect:
        """The origin in metres, z up."""
        return changed(self, place=torch.tensor(placed(frame, self.origin), dtype=torch.float64))

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
