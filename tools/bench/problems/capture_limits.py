"""How well photos with known cameras can tell where a surface is and how it is turned, at best."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.rendering.cameras.camera import Camera


def surface_limits(
    cameras: Sequence[Camera],
    centre: Tensor,
    normal: Tensor,
    size: float,
    pixel_error: float = 0.05,
    patch: int = 7,
    one_side: bool = True,
) -> dict[str, float]:
    r"""Smallest error of the height and the tilt of a square patch of a surface (a Cramér-Rao bound).

    If the surface is moved by h along its normal n, the point that a pixel sees moves along the surface by
    :math:`h\, s_v` with :math:`s_v = (r_v - (r_v \cdot n)\, n) / (r_v \cdot n)` for the direction :math:`r_v` of the
    view. The texture is not known, so only differences between views count. A window of ``patch`` x ``patch`` pixels
    finds each coordinate of its place in a photo to ``pixel_error``. With f pixels per unit of angle at the distance z,
    the information about h on a square metre is

    .. math:: I = \sum_v \frac{(f / z_v)^2 |r_v \cdot n|}{p^2} \, \frac{|s_v - \bar s|^2}{(\epsilon z_v / f)^2},

    the error of the height of a square of side L is :math:`1 / \sqrt{I L^2}`, and that of its slope
    :math:`\sqrt{12 / (I L^4)}`. If the errors of all windows of a photo are the same (a wrong camera, or the blur of
    the renderer), they do not average out: then :math:`I L^2` is the sum without the number of windows.

    Args:
        cameras: The cameras.
        centre: Centre of the patch [scene units], shape (3,).
        normal: Its unit normal, shape (3,).
        size: Its side [scene units].
        pixel_error: Standard deviation of each coordinate of a window in a photo [pixels].
        patch: Side of a window [pixels].
        one_side: Use only the cameras on the side of the normal; they see another side of a sheet differently.

    Returns:
        ``views`` that see the patch at less than 80 degrees, ``height`` [scene units] and ``tilt_deg`` with independent
        windows, and ``height_common`` [scene units] if all windows of a photo share their error.

    Raises:
        ValueError: If a number is not positive, or fewer than two cameras see the patch.
    """
    for name, value in (("size", size), ("pixel_error", pixel_error), ("patch", patch)):
        check_positive(name, value)
    centre, normal = centre.double(), torch.nn.functional.normalize(normal.double(), dim=0)
    toward, scale = [], []
    for camera in cameras:
        ray = camera.position.double() - centre
        distance = float(ray.norm())
        facing = float(ray @ normal) / distance
        if abs(facing) < math.cos(math.radians(80.0)) or (one_side and facing < 0):
            continue
        toward.append(ray / distance)
        scale.append(float(camera.intrinsics[0, 0]) / distance)
    if len(toward) < 2:
        raise ValueError("Expected at least two of `cameras` to see the patch: turn `normal`, or move `centre`.")
    rays, pixels = torch.stack(toward), torch.tensor(scale, dtype=torch.float64)  # pixels per scene unit
    cosine = rays @ normal
    slide = (rays - cosine[:, None] * normal) / cosine[:, None]
    precision = (pixels / pixel_error).square()
    centre_of = (precision[:, None] * slide).sum(0) / precision.sum()
    each = precision * (slide - centre_of).square().sum(-1)  # of one window in each view
    windows = pixels.square() * cosine.abs() / patch**2  # on a square unit
    density = float((windows * each).sum())
    return {
        "views": float(len(toward)),
        "height": 1.0 / math.sqrt(density * size**2),
        "tilt_deg": math.degrees(math.sqrt(12.0 / (density * size**4))),
        "height_common": 1.0 / math.sqrt(float(each.sum())),
    }
