"""Pictures beside the colour: depth, normals and scalars on the surface, as numbers and as colours.

Gaussians are blended from front to back, so each of these is the mean over the Gaussians seen at a pixel, by their
weights. A pixel in which they cover less than half has no value.
"""

from __future__ import annotations

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.rendering.base import RenderOutput

PASSES = ("color", "depth", "normal", "force")
COVERED = 0.5
"""Opacity of a pixel from which it has a depth, a normal or a force."""
MAX_STEPS = 65535
"""Largest number of a picture of 16 bits."""

# viridis (S. van der Walt and N. Smith, CC0) at nine places, evenly from 0 to 1
_VIRIDIS = (
    (0.267, 0.005, 0.329),
    (0.279, 0.175, 0.483),
    (0.230, 0.322, 0.546),
    (0.173, 0.449, 0.558),
    (0.128, 0.567, 0.551),
    (0.158, 0.684, 0.502),
    (0.369, 0.789, 0.383),
    (0.678, 0.864, 0.190),
    (0.993, 0.906, 0.144),
)


def colormap(values: Tensor) -> Tensor:
    """Colours from dark violet at 0 over green to yellow at 1 (viridis); values beyond take the ends' colours.

    Args:
        values: Shape (...); NaN takes the colour of 0.

    Returns:
        Colours in [0, 1], shape (..., 3).
    """
    table = torch.tensor(_VIRIDIS, dtype=values.dtype).to(values.device, non_blocking=True)
    place = values.nan_to_num(0.0).clamp(0, 1) * (len(_VIRIDIS) - 1)
    low = place.floor().clamp(max=len(_VIRIDIS) - 2)
    return torch.lerp(table[low.long()], table[low.long() + 1], (place - low)[..., None])


def mean_depth(picture: RenderOutput) -> Tensor:
    """Depth along the optical axis [scene units], 0 where nothing is, shape (H, W)."""
    covered = picture.alpha >= COVERED
    return torch.where(covered, picture.depth / picture.alpha.clamp_min(COVERED), 0.0)[..., 0]


def depth_steps(depth: Tensor, step: float) -> Tensor:
    """Depth as whole numbers for a picture of 16 bits: 0 where nothing is, otherwise 1 to 65535.

    Args:
        depth: Depth, 0 where nothing is, shape (...).
        step: Depth of one step, in the same unit.

    Returns:
        Shape (...), int32.
    """
    steps = (depth / step).round().clamp(1, MAX_STEPS)
    return torch.where(depth > 0, steps, 0.0).int()


def depth_colors(depth: Tensor, near: float, far: float) -> Tensor:
    """Colours of a depth: yellow at ``near`` or before, violet at ``far`` or beyond, black where nothing is.

    Args:
        depth: Depth, 0 where nothing is, shape (H, W).
        near: Nearest depth of the scale.
        far: Farthest depth of the scale.

    Returns:
        Shape (H, W, 3).
    """
    return torch.where(depth[..., None] > 0, colormap((far - depth) / (far - near)), 0.0)


def facing(normals: Tensor, view: Tensor) -> Tensor:
    """Normals turned towards the eye, as patches have no outside.

    Args:
        normals: Shape (N, 3).
        view: Directions from the eye to the patches, shape (N, 3).

    Returns:
        Shape (N, 3).
    """
    return torch.where((normals * view).sum(-1, keepdim=True) > 0, -normals, normals)


def normal_colors(blended: Tensor, alpha: Tensor, rotation: Tensor) -> Tensor:
    """Colours of normals: (n + 1) / 2 in red, green and blue, black where nothing is.

    Args:
        blended: Blended normals in scene axes, shape (H, W, 3).
        alpha: Opacity, shape (H, W, 1).
        rotation: From scene axes to those of the picture, shape (3, 3).

    Returns:
        Shape (H, W, 3).
    """
    check_shape("blended", blended, 3)
    normals = torch.nn.functional.normalize(blended @ rotation.mT.to(blended), dim=-1)
    return torch.where(alpha >= COVERED, 0.5 * (normals + 1), 0.0)


def scalar_colors(blended: Tensor, alpha: Tensor, largest: float) -> Tensor:
    """Colours of a blended scalar: violet at 0, yellow at ``largest`` and above, black where nothing is.

    Args:
        blended: Blended values, shape (H, W).
        alpha: Opacity, shape (H, W, 1).
        largest: End of the scale, in the unit of the values.

    Returns:
        Shape (H, W, 3).
    """
    mean = blended / alpha[..., 0].clamp_min(COVERED)
    return torch.where(alpha >= COVERED, colormap(mean / largest), 0.0)
