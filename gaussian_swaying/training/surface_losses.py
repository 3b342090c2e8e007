"""Losses of the surface in a picture, one view against another.

Only other views tell where the surface is: a point of it must look the same from both (Chen et al. 2024, "PGSR",
section 3.3).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from gaussian_swaying._checks import check_positive
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.planes import SurfaceMaps
from gaussian_swaying.training.losses import LossInputs, LossTerm, OtherView

_GREY = (0.299, 0.587, 0.114)
"""Shares of red, green and blue (ITU-R BT.601)."""


def grey(image: Tensor) -> Tensor:
    """Brightness of a picture (H, W, 3) as (H, W)."""
    return image @ image.new_tensor(_GREY)


def relative_pose(camera: Camera, other: Camera) -> tuple[Tensor, Tensor]:
    """Rotation (3, 3) and shift (3,) from the frame of one camera to that of another."""
    rotation = other.world_to_camera[:3, :3] @ camera.world_to_camera[:3, :3].T
    return rotation, other.world_to_camera[:3, 3] - rotation @ camera.world_to_camera[:3, 3]


def project(point: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pixel coordinates (..., 2) of points in the frame of a camera, and which of them it sees."""
    front = point[..., 2] > camera.near
    depth = torch.where(front, point[..., 2], 1.0)
    fx, fy, cx, cy = (camera.intrinsics[i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    pixel = torch.stack([point[..., 0] / depth * fx + cx, point[..., 1] / depth * fy + cy], dim=-1)
    size = pixel.new_tensor([camera.width, camera.height])
    return pixel, front & ((pixel >= 0.5) & (pixel <= size - 0.5)).all(-1)


def sample(image: Tensor, pixel: Tensor) -> Tensor:
    """Bilinear values (..., C) of a picture (H, W, C) at pixel coordinates (..., 2), differentiable in both."""
    height, width, count = image.shape
    place = 2.0 * pixel / pixel.new_tensor([width, height]) - 1.0
    found = functional.grid_sample(
        image.permute(2, 0, 1)[None], place.reshape(1, -1, 1, 2), mode="bilinear", align_corners=False
    )
    return found[0, :, :, 0].T.reshape(*pixel.shape[:-1], count)


def round_trip(pixel: Tensor, depth: Tensor, camera: Camera, other: OtherView) -> tuple[Tensor, Tensor]:
    """Reprojection error of pixels: to another view and back, by the rendered surfaces.

    Args:
        pixel: Pixel coordinates, shape (S, 2).
        depth: Rendered depth there [scene units], shape (S, 1).

    Returns:
        Distances [pixels], shape (S,), and where they are defined, bool (S,): where both views show a surface.
    """
    rotation, shift = relative_pose(camera, other.camera)
    there, seen = project(_lift(pixel, camera) * depth @ rotation.T + shift, other.camera)
    maps = torch.cat([other.surface.depth, other.surface.known.to(depth.dtype)], dim=-1)
    found = sample(maps, torch.where(seen[:, None], there, 1.0))
    seen = seen & (found[:, 1] > 0.999)  # no neighbour of the pixel is without a surface
    point = _lift(there, other.camera) * torch.where(seen[:, None], found[:, :1], 1.0)
    back, in_front = project((point - shift) @ rotation, camera)
    apart = back - pixel
    seen = seen & in_front
    return torch.where(seen[:, None], apart, 1.0).norm(dim=-1), seen


def _lift(pixel: Tensor, camera: Camera) -> Tensor:
    """Points at depth 1 behind pixels (..., 2), in the frame of the camera, (..., 3)."""
    fx, fy, cx, cy = (camera.intrinsics[i, j] for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    u, v = (pixel[..., 0] - cx) / fx, (pixel[..., 1] - cy) / fy
    return torch.stack([u, v, torch.ones_like(u)], dim=-1)


def warped_patches(
    pixel: Tensor, normal: Tensor, distance: Tensor, camera: Camera, other: OtherView, radius: int
) -> tuple[Tensor, Tensor]:
    r"""Grey values of another view at warped patches.

    A pixel :math:`u` near the centre of a patch lies on the plane :math:`n \cdot x = d` of that centre, at
    :math:`x = d\, r(u) / (n \cdot r(u))`: the homography of the plane, written with rays.

    Args:
        pixel: Centres of the patches [pixels], shape (S, 2).
        normal: Unit normals of their planes in the frame of the camera, shape (S, 3).
        distance: n.x on the planes [scene units], shape (S, 1).
        radius: Half side of a patch [pixels].

    Returns:
        Values, shape (S, P) with P = (2 radius + 1)², and which patches are in the other picture, bool (S,).
    """
    rotation, shift = relative_pose(camera, other.camera)
    rays = _lift(pixel[:, None] + offsets(radius, pixel), camera)  # (S, P, 3)
    facing = (rays * normal[:, None]).sum(-1, keepdim=True)
    fine = (facing < -1e-6).all(1)[:, 0] & (distance[:, 0] < 0)
    point = rays * torch.where(fine[:, None, None], distance[:, None] / torch.where(facing < -1e-6, facing, -1.0), 1.0)
    there, seen = project(point @ rotation.T + shift, other.camera)
    fine = fine & seen.all(-1)
    return sample(grey(other.image)[..., None], torch.where(fine[:, None, None], there, 1.0))[..., 0], fine


def offsets(radius: int, like: Tensor) -> Tensor:
    """Offsets of the pixels of a patch from its centre, row by row, shape ((2 radius + 1)², 2) as x and y."""
    steps = torch.arange(-radius, radius + 1, device=like.device, dtype=like.dtype)
    down, across = torch.meshgrid(steps, steps, indexing="ij")
    return torch.stack([across.reshape(-1), down.reshape(-1)], dim=-1)


def cross_correlation(one: Tensor, two: Tensor, contrast: float = 0.01) -> tuple[Tensor, Tensor]:
    """Normalised cross-correlation of patches of grey values.

    Args:
        one: Values, shape (S, P).
        two: Values, shape (S, P).

    Returns:
        Correlations from -1 to 1, shape (S,), and where both patches have enough contrast, bool (S,).
    """
    one, two = one - one.mean(-1, keepdim=True), two - two.mean(-1, keepdim=True)
    first, second = one.square().mean(-1), two.square().mean(-1)
    fine = (first > contrast**2) & (second > contrast**2)
    scale = torch.where(fine, first * second, 1.0).sqrt()
    return torch.where(fine, (one * two).mean(-1) / scale, 0.0), fine


def textured(image: Tensor, radius: int, contrast: float) -> Tensor:
    """Return a mask (H, W) of pixels of a grey picture whose patch has a standard deviation above ``contrast``.

    False within ``radius`` pixels of the border.
    """
    both = torch.stack([image, image.square()])[None]
    mean, square = functional.avg_pool2d(both, 2 * radius + 1, stride=1)[0]
    return functional.pad(square - mean.square() > contrast**2, [radius] * 4)


def chosen_pixels(known: Tensor, count: int, margin: int) -> Tensor:
    """Rows and columns, int64 (S, 2), of up to ``count`` random pixels where ``known`` (H, W), off the border."""
    inner = torch.zeros_like(known)
    inner[margin : known.shape[0] - margin, margin : known.shape[1] - margin] = True
    found = (known & inner).nonzero()
    if len(found) > count:
        found = found[torch.randint(len(found), (count,), device=known.device)]
    return found


# ---- as terms


class SurfaceTerm(LossTerm):
    """Base class of terms of the surface.

    Args:
        start: Images trained on before this term begins.
        stop: Images trained on before it ends; null for the end of the training.
        fade: Images before ``stop`` over which its weight falls to zero, so that the picture can recover.
        every: Compute it for one image in so many, with so many times its weight.

    Raises:
        ValueError: If ``start``, ``fade`` or ``every`` is too small, or ``stop`` is not after ``start``.
    """

    needs = frozenset({"surface"})

    def __init__(self, start: int = 7000, stop: int | None = None, fade: int = 0, every: int = 1) -> None:
        super().__init__()
        check_positive("start", start, allow_zero=True)
        check_positive("fade", fade, allow_zero=True)
        check_positive("every", every)
        if stop is not None and stop <= start:
            raise ValueError(f"Expected `stop` above `start` ({start}), but got {stop}.")
        if fade and stop is None:
            raise ValueError("Expected `stop` with `fade`: set the number of images after which the weight is zero.")
        self.start, self.stop, self.fade, self.every = int(start), stop, int(fade), int(every)


class MultiViewGeometricLoss(SurfaceTerm):
    r"""Round trips of pixels into another view and back, see :func:`round_trip`.

    The mean of :math:`\phi` with the weights :math:`w = e^{-\phi}` where the distance :math:`\phi` is below
    ``farthest``, and 0 elsewhere, where one view sees what is hidden in the other (Chen et al. 2024, equation 13). The
    surface of the other view is taken as it is: its gradient comes when its turn comes.

    Args:
        start: See :class:`SurfaceTerm`.
        samples: Pixels of an image that are tried.
        farthest: Longest distance that counts [pixels].
        when: Further arguments of :class:`SurfaceTerm`.

    Raises:
        ValueError: If a number is out of range.
    """

    needs = frozenset({"surface", "other_view"})

    def __init__(self, start: int = 7000, samples: int = 102_400, farthest: float = 1.0, **when: Any) -> None:
        super().__init__(start, **when)
        check_positive("samples", samples)
        check_positive("farthest", farthest)
        self.samples, self.farthest = int(samples), float(farthest)

    def forward(self, inputs: LossInputs) -> Tensor:
        """See above; 0 if no pixel can be compared, or no other view is close enough."""
        maps, camera = surface_of(inputs)
        other = inputs.other
        if other is None:
            return maps.depth.sum() * 0.0
        place = chosen_pixels(maps.known[..., 0], self.samples, 1)
        pixel = place.flip(-1).to(maps.depth.dtype) + 0.5
        apart, seen = round_trip(pixel, maps.depth[place[:, 0], place[:, 1]], camera, other)
        weight = trust(apart, seen, self.farthest)
        return weighted_mean(apart, weight)


class MultiViewPhotometricLoss(SurfaceTerm):
    r"""Patches of the photo against those of another photo, warped by the planes of the surface.

    The mean of :math:`1 - \mathrm{NCC}` over patches (Chen et al. 2024, equation 15), with the weights of
    :class:`MultiViewGeometricLoss`, so that what is hidden in the other view does not count. See
    :func:`warped_patches` and :func:`cross_correlation`.

    Args:
        start: See :class:`SurfaceTerm`.
        samples: Patches of an image.
        radius: Half side of a patch [pixels].
        farthest: Longest round trip of a patch that counts [pixels].
        contrast: Least standard deviation of the grey values (0 to 1) in a patch that counts. Where a surface has one
            colour, a patch is noise.
        when: Further arguments of :class:`SurfaceTerm`.

    Raises:
        ValueError: If a number is out of range.
    """

    needs = frozenset({"surface", "other_view"})

    def __init__(
        self,
        start: int = 7000,
        samples: int = 102_400,
        radius: int = 3,
        farthest: float = 1.0,
        contrast: float = 0.01,
        **when: Any,
    ) -> None:
        super().__init__(start, **when)
        for name, value in (("samples", samples), ("radius", radius), ("farthest", farthest), ("contrast", contrast)):
            check_positive(name, value)
        self.samples, self.radius, self.farthest = int(samples), int(radius), float(farthest)
        self.contrast = float(contrast)

    def forward(self, inputs: LossInputs) -> Tensor:
        """See above; 0 if no patch can be compared, or no other view is close enough."""
        maps, camera = surface_of(inputs)
        other = inputs.other
        if other is None:
            return maps.depth.sum() * 0.0
        photo = grey(inputs.target)
        worth = maps.known[..., 0] & textured(photo, self.radius, self.contrast)
        place = chosen_pixels(worth, self.samples, self.radius)
        row, column = place.unbind(-1)
        pixel = place.flip(-1).to(maps.depth.dtype) + 0.5
        with torch.no_grad():
            weight = trust(*round_trip(pixel, maps.depth[row, column], camera, other), self.farthest)
        there, fine = warped_patches(
            pixel, maps.unit[row, column], maps.distance[row, column], camera, other, self.radius
        )
        shift = offsets(self.radius, pixel).long()
        here = photo[row[:, None] + shift[:, 1], column[:, None] + shift[:, 0]]
        alike, contrast = cross_correlation(here, there, self.contrast)
        weight = weight * (fine & contrast)
        return weighted_mean(1.0 - alike, weight)


def trust(apart: Tensor, seen: Tensor, farthest: float) -> Tensor:
    """Weights of pixels by their :func:`round_trip`, without gradient, shape (S,)."""
    return torch.where(seen & (apart < farthest), (-apart).exp(), 0.0).detach()


def weighted_mean(values: Tensor, weight: Tensor) -> Tensor:
    """Mean of values (S,) with weights (S,), 0 if all of them are.

    The sum of the weights divides, not their number (as in PGSR): otherwise a surface that is off would cost less, as
    its round trips are longer and its weights smaller.
    """
    return (weight * values).sum() / weight.sum().clamp_min(1e-6)


def surface_of(inputs: LossInputs) -> tuple[SurfaceMaps, Camera]:
    """Surface maps and camera of a training step."""
    if inputs.surface is None or inputs.camera is None:
        raise ValueError("This loss needs `LossInputs.surface` and `LossInputs.camera`: pass both.")
    return inputs.surface, inputs.camera
