"""Structural similarity of pictures."""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn import functional

SSIM_TAPS = 11
"""Width of the window of :func:`ssim_map` [pixels]."""
_SIGMA = 1.5
_C1, _C2 = 0.01**2, 0.03**2


def ssim_map(image: Tensor, target: Tensor, padding: str = "valid") -> Tensor:
    r"""Structural similarity of two pictures around each pixel (Wang et al. 2004, equation 13).

    Means, variances and covariance under a Gaussian window of 11 x 11 pixels with a standard deviation of 1.5, applied
    along rows and columns in turn, for values from 0 to 1.

    Args:
        image: Picture, shape (..., H, W, C).
        target: Picture to compare it with, of the same shape.
        padding: ``valid`` uses only windows inside the picture, like fused-ssim's option with that name. ``reflect``
            mirrors both pictures at their edges, and its mean is the SSIM of torchmetrics 1.9.

    Returns:
        Similarity up to 1, shape (..., H - 10, W - 10, C) with ``valid``, else that of the pictures.
    """
    height, width, channels = image.shape[-3:]
    if min(height, width) < SSIM_TAPS:
        raise ValueError(f"Expected pictures of at least {SSIM_TAPS} x {SSIM_TAPS} pixels, but got {width} x {height}.")
    # One plane per channel: (1, planes, H, W).
    x, y = (picture.movedim(-1, -3).reshape(1, -1, height, width) for picture in (image, target))
    planes = x.shape[1]
    window = _window(x.dtype, x.device)
    if padding != "valid":
        x, y = (functional.pad(plane, [SSIM_TAPS // 2] * 4, padding) for plane in (x, y))
    moments = torch.cat([x, y, x * x, y * y, x * y], dim=1)
    # planes as groups, not as a batch: the gradient of a convolution of one channel is slow
    groups = moments.shape[1]
    moments = functional.conv2d(moments, window.view(1, 1, 1, -1).expand(groups, 1, 1, -1), groups=groups)
    moments = functional.conv2d(moments, window.view(1, 1, -1, 1).expand(groups, 1, -1, 1), groups=groups)
    mean_x, mean_y, square_x, square_y, product = moments.split(planes, dim=1)
    variance_x = (square_x - mean_x.square()).clamp_min(0.0)
    variance_y = (square_y - mean_y.square()).clamp_min(0.0)
    covariance = product - mean_x * mean_y
    similarity = ((2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)) / (
        (mean_x.square() + mean_y.square() + _C1) * (variance_x + variance_y + _C2)
    )
    return similarity.reshape(*image.shape[:-3], channels, *similarity.shape[-2:]).movedim(-3, -1)


@cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Weights of the window along one side, shape (11,)."""
    with torch.inference_mode(False):  # validation may ask first, and training needs its gradient
        offsets = torch.arange(SSIM_TAPS, dtype=dtype, device=device) - SSIM_TAPS // 2
        window = torch.exp(-0.5 * (offsets / _SIGMA).square())
        return window / window.sum()
