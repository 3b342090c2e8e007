"""Overlap: where Gaussians overlap, a picture shows mostly the nearest ones, so it shows a surface beside its place.

It is beside by a part of a pixel that depends on the angle of view. A splat that was trained on pictures shows a
surface where they do; one that was made of points on the surface does not. A film of the thing tells which is the case.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.rendering.cameras.camera import Camera, project, resized_intrinsics
from gaussian_swaying.simulation.draw import Painter

WINDOW, WIDE = 15, 960
"""Side of the square that is followed, where the longer side of the picture has at most ``WIDE`` [pixels]."""
AROUND = 6.0
"""Border around the windows in which Gaussians are drawn to see how they overlap, in their standard deviations."""
LARGE = 2.0
"""Standard deviations of Gaussians that are left out, per the side of a window."""
MANY = 1000
"""Windows that are averaged at a time, so that memory does not grow with the picture."""
_DRAWN = 1e-3
"""Least sum of the weights of a Gaussian in a picture with which it counts as visible [pixels]."""


class Overlap:
    """The offset between what a splat shows and where it is, all over a picture.

    Args:
        painter: Draws the picture.
        gaussians: All Gaussians of it.
        camera: Its camera.
    """

    def __init__(self, painter: Painter, gaussians: DeformedGaussians, camera: Camera) -> None:
        self.camera = camera
        share = min(1.0, WIDE / max(camera.width, camera.height))
        width, height = (round(share * side) for side in (camera.width, camera.height))
        scale = torch.tensor([width / camera.width, height / camera.height], dtype=torch.float64)
        small = camera.to("cpu", torch.float64)
        (fx, _, cx), (_, fy, cy), _ = small.intrinsics.tolist()
        lens, *_ = resized_intrinsics(camera.width, camera.height, fx, fy, cx, cy, width, height)
        small = replace(small, intrinsics=lens.double(), width=width, height=height)
        self._small, self._step = small, window_of(width, height) // 2
        rows, columns = (torch.arange(0, side, self._step) for side in (height, width))
        places = torch.cartesian_prod(rows, columns).flip(-1) + 0.5
        found = drawn_beside(painter, gaussians, small.to(painter.device, camera.intrinsics.dtype), places)
        self._field = (found / scale).T.reshape(1, 2, len(rows), len(columns))

    def at(self, places: Tensor) -> Tensor:
        """The offset at places in space (N, 3), float64: rendered minus projected pixels, shape (N, 2)."""
        pixel = project(places, self._small)[0]
        ends = self._step * (torch.tensor(self._field.shape[:1:-1]) - 1)  # the last column and row
        grid = 2 * (pixel - 0.5) / ends - 1
        grid = grid[None, None]
        found = torch.nn.functional.grid_sample(self._field, grid, padding_mode="border", align_corners=True)
        return found[0, :, 0].T


def drawn_beside(painter: Painter, gaussians: DeformedGaussians, camera: Camera, places: Tensor) -> Tensor:
    """Return the offset between the rendered and the projected centres of Gaussians, averaged over windows.

    The rendered centre of a Gaussian is the mean of all pixels, weighted by its share of each after alpha compositing.
    These weights are the derivatives of the picture by the colours. Gaussians larger than windows, as those of a sky,
    have no place in them, and are left out.

    Args:
        painter: Draws the picture.
        gaussians: All Gaussians of it, N.
        camera: Its camera, on their device.
        places: Centres of the windows [pixels], shape (T, 2).

    Returns:
        Rendered minus projected centre [pixels], float64, shape (T, 2).
    """
    if not len(places):
        return torch.zeros(0, 2, dtype=torch.float64)
    opacity, whole = painter.opacity().detach(), (camera.width, camera.height)
    pixel, depth = project(gaussians.means, camera)
    wide = gaussians.covariances.diagonal(dim1=-2, dim2=-1).amax(-1).sqrt().to(depth)
    size = wide * float(camera.intrinsics[0, 0]) / depth.clamp(min=camera.near)
    small = size < LARGE * window_of(*whole)
    camera, left, top = _part(camera, pixel, size, small & (depth > camera.near), places)
    width, height = camera.width, camera.height

    def drawn(colours: Tensor) -> Tensor:
        return painter.renderer(gaussians.means, gaussians.covariances, opacity, colours, camera).color

    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    middle = torch.tensor([0.5 * width, 0.5 * height])
    asked = torch.stack([torch.ones(height, width), x - middle[0], y - middle[1]], -1).to(opacity)
    colours = torch.zeros(len(opacity), 3, device=opacity.device, requires_grad=True)
    with torch.enable_grad():
        (sums,) = torch.autograd.grad(drawn(colours), colours, asked)
    weight, centre = sums[:, :1], (project(gaussians.means, camera)[0] - middle).to(sums)
    counts = (weight > _DRAWN) & small.to(weight.device)[:, None]
    shift = torch.where(counts, sums[:, 1:] / weight - centre, 0.0)
    with torch.no_grad():
        field = drawn(torch.cat([shift, counts.to(shift)], 1)).cpu().double()
    found = torch.cat(
        [
            field[row - top, column - left].mean(1)
            for column, row in (windows(some, *whole) for some in places.split(MANY))
        ]
    )
    return found[:, :2] / found[:, 2:].clamp(min=1e-6)


def _part(camera: Camera, pixel: Tensor, size: Tensor, some: Tensor, places: Tensor) -> tuple[Camera, int, int]:
    """The camera of some windows and what is around them, also beyond the picture; its left and upper end.

    Args:
        camera: The camera of the picture.
        pixel: Centres of the Gaussians [pixels], shape (N, 2).
        size: Their standard deviations [pixels], shape (N,).
        some: Those that are to be whole, bool, shape (N,).
        places: Centres of the windows [pixels], shape (T, 2).
    """
    outer = windows(torch.stack([places.amin(0), places.amax(0)]), camera.width, camera.height)
    low, high = (torch.stack([end(side) for side in outer]).to(pixel) for end in (torch.min, torch.max))
    near = size[some & ((pixel >= low) & (pixel <= high)).all(-1)]
    border = math.ceil(AROUND * float(near.kthvalue(math.ceil(0.95 * len(near))).values)) if len(near) else 0
    left, top = (int(end) - border for end in low)
    right, bottom = (int(end) + border + 1 for end in high)
    lens = camera.intrinsics.clone()
    lens[:2, 2] -= lens.new_tensor([left, top])
    return replace(camera, intrinsics=lens, width=right - left, height=bottom - top), left, top


def window_of(width: int, height: int) -> int:
    """Side of the square that is followed in a picture of this size [pixels]; odd."""
    return 2 * round(WINDOW // 2 * max(1.0, max(width, height) / WIDE)) + 1


def windows(places: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Columns and rows of the pixels in the window around each place (T, 2), clamped to the picture; shape (T, W²)."""
    side = window_of(width, height)
    reach = torch.arange(side) - side // 2
    beside = torch.cartesian_prod(reach, reach)
    column, row = (places.long()[:, None] + beside).unbind(-1)
    return column.clamp(0, width - 1), row.clamp(0, height - 1)
