"""Effects that are looked up in a table, by linear interpolation between its corners."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from gaussian_swaying.geometry.linalg_triton import add3, chosen, matvec, scale3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.twins import Numbers, Twin
from gaussian_swaying.wind.effects import Moment, WindEffect


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
    for i in tl.static_range(2):
        for j in tl.static_range(2):
            if i == 0:
                x = x0
                wx = 1 - fx
            else:
                x = x1
                wx = fx
            if j == 0:
                y = y0
                w = wx * (1 - fy)
            else:
                y = y1
                w = wx * fy
            line = (x * my + y) * mz
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
    """``Tabulated``; ``numbers``: from places to cells (9), from the axes of the table (9), its sizes (3).

    ``now``: place of the origin [cells] (3) and factor; of a table for each time also the numbers of two and the share
    of the second. ``OPTIONS``: whether it repeats along each axis (3), values of a corner, whether it has times.
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
    """Axes with the first along a flow and the second horizontal, as rows, shape (3, 3), without making the host wait.

    Args:
        flow: The flow [m/s], shape (3,); x if it is zero.
    """
    speed = torch.linalg.vector_norm(flow)
    eye = torch.diag(torch.ones_like(flow))
    x = torch.where(speed > 0, flow / speed.clamp(min=1e-30), eye[0])
    y = torch.linalg.cross(torch.where(x[2].abs() > 0.99, eye[0], eye[2]), x)
    y = y / torch.linalg.vector_norm(y)
    return torch.stack([x, y, torch.linalg.cross(x, y)])


class Tabulated(WindEffect):
    """Base of effects whose values are in a table: velocities that are added, or shares of the velocity that are left.

    Args:
        table: Values at the corners of its cells, along its own axes, shape (X, Y, Z, 3), or (X, Y, Z, 1) for shares;
            for each of several times (T, X, Y, Z, 3).
        step: Sides of a cell [m], shape (3,), float64.
        place: Where its first corner is, or a point that the subclass knows [m], shape (3,), float64.
        wraps: Whether it repeats along each axis; if not, its outermost values go on outside.
    """

    recordable = True
    table: Tensor
    sizes: Tensor
    axes: Tensor
    step: Tensor
    place: Tensor

    def __init__(
        self, table: Tensor, step: Tensor, place: Tensor, wraps: tuple[bool, bool, bool] = (False, False, False)
    ) -> None:
        super().__init__()
        self.wraps = wraps
        sizes, eye = torch.tensor(table.shape[-4:-1], dtype=torch.float64), torch.eye(3, dtype=torch.float64)
        for name, value in {"table": table, "sizes": sizes, "axes": eye, "step": step, "place": place}.items():
            self.register_buffer(name, value, persistent=False)

    @abstractmethod
    def now(self, moment: Moment) -> Tensor:
        """The numbers of n times, see :func:`tabulated`: shape (n, 4), or (n, 7) with a table for each time."""

    def twin(self) -> Twin:
        timed = self.table.ndim > 4

        def numbers() -> Tensor:
            return torch.cat([(self.axes / self.step[:, None]).reshape(-1), self.axes.T.reshape(-1), self.sizes])

        return Twin(
            tabulated,
            options=(*map(bool, self.wraps), self.table.shape[-1], timed),
            numbers=Numbers(21, numbers),
            per_substep=Numbers(7 if timed else 4, self.now),
            table=Numbers(self.table.numel(), lambda: self.table),
            sources=(self,),
        )
