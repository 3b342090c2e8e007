"""The Gaussians that a brush touches on the screen."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.rendering.protocol import RenderOutput

SOLID = 0.5  # opacity of a pixel from which on something is hidden behind it
REACH = 2.0  # standard deviations of a Gaussian within which it belongs to the surface that is drawn


@dataclass(frozen=True, eq=False)
class Seen:
    """Gaussians on a screen.

    Attributes:
        column: Columns of the centres [pixels], float32, shape (N,).
        row: Rows of the centres [pixels], float32, shape (N,).
        inside: Which centres lie in the picture and in front of the camera, bool, shape (N,).
        front: Which of them nothing hides, bool, shape (N,).
    """

    column: Tensor
    row: Tensor
    inside: Tensor
    front: Tensor


def seen(means: Tensor, covariances: Tensor, camera: Camera, picture: RenderOutput, slack: float = 0.0) -> Seen:
    """Project Gaussians to the screen, and mark those that the drawn surface does not hide.

    A Gaussian is hidden if it lies behind the depth at the pixel of its centre, by more than a slack and two standard
    deviations of its own. These are taken along the line of sight, and across it times the slope of the depth, as the
    depth of a surface at a slant is that of the nearer Gaussians there. Pixels that are less than half opaque hide
    nothing.

    Args:
        covariances: Their covariances [scene units²], shape (N, 3, 3).
        picture: A picture of them from there, which may have fewer pixels.
        slack: See there [scene units].
    """
    pixel, depth = project(means, camera)
    size = torch.tensor([camera.width, camera.height])
    inside = (depth >= camera.near) & (pixel >= 0).all(-1) & (pixel < size).all(-1)
    index = inside.nonzero()[:, 0]
    height, width = picture.alpha.shape[:2]
    column, row = (pixel[index] * torch.tensor([width, height]) / size).long().unbind(-1)
    alpha, drawn = (values[..., 0].detach().cpu().double() for values in (picture.alpha, picture.depth))
    drawn = torch.where(alpha >= SOLID, drawn / alpha.clamp(min=SOLID), torch.inf)
    slope = _slope(drawn)[row, column]
    own = index.to(means.device)
    ray = torch.nn.functional.normalize(means[own] - camera.position.to(means), dim=-1)
    along = torch.einsum("ni,nij,nj->n", ray, covariances[own], ray)
    across = (covariances[own].diagonal(dim1=-2, dim2=-1).sum(-1) - along).clamp(min=0).sqrt().cpu().double()
    across = across / depth[index] * (float(camera.intrinsics[0, 0]) * width / camera.width)  # in pixels of the picture
    reach = REACH * along.clamp(min=0).sqrt().cpu().double() + slope * (1 + REACH * across)
    front = torch.zeros_like(inside)
    front[index[depth[index] <= drawn[row, column] + reach + slack]] = True
    column, row = pixel.float().unbind(-1)
    return Seen(column.contiguous(), row.contiguous(), inside, front)


def _slope(depth: Tensor) -> Tensor:
    """The slope of a depth [scene units for each pixel], shape (H, W); where nothing is drawn, the depth is infinite.

    In each direction the smaller of the differences to both neighbours counts: they differ at the edge of an object.
    """
    total = torch.zeros_like(depth)
    for axis in (0, 1):
        steps = depth.diff(dim=axis).abs().nan_to_num(nan=torch.inf)  # also between two that are infinite
        nothing = torch.full_like(depth.narrow(axis, 0, 1), torch.inf)
        least = torch.minimum(torch.cat([nothing, steps], axis), torch.cat([steps, nothing], axis))
        total += torch.where(least.isinf(), 0.0, least).square()
    return total.sqrt()


def touched(view: Seen, path: Tensor, radius: float, through: bool = False) -> Tensor:
    """Indices of Gaussians whose centres a brush touches along a path, rising, int64, shape (M,).

    Args:
        path: Corners of the path [pixels], shape (S, 2); the brush goes straight from one to the next.
        radius: Radius of the brush [pixels].
    """
    check_shape("path", path, None, 2)
    check_positive("radius", radius)
    if len(path) == 0:
        raise ValueError("Expected `path` to have at least one corner.")
    low, high = path.amin(0) - radius, path.amax(0) + radius
    near = view.inside.clone() if through else view.front.clone()
    for place, least, most in ((view.column, low[0], high[0]), (view.row, low[1], high[1])):
        near &= (place >= float(least)) & (place <= float(most))
    index = near.nonzero()[:, 0]
    centre = torch.stack([view.column[index], view.row[index]], -1).double()
    path = path.double()
    first, last = (path, path) if len(path) == 1 else (path[:-1], path[1:])
    hit = torch.zeros(len(index), dtype=torch.bool)
    for a, b in zip(first, last, strict=True):
        left = (~hit).nonzero()[:, 0]
        along, away = b - a, centre[left] - a
        share = ((away @ along) / (along @ along).clamp(min=1e-12)).clamp(0, 1)
        hit[left] = (away - share[:, None] * along).square().sum(-1) <= radius**2
    return index[hit]
