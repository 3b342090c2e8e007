"""Pictures other than colour: depth, normals and scalars on the surface, as numbers and as colours.

Gaussians are blended from front to back, so each value is the weighted mean over the Gaussians seen at a pixel. A pixel
covered by less than half has no value.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_shape
from gaussian_swaying.rendering.protocol import RenderOutput

COVERED = 0.5
"""Smallest opacity of a pixel with a depth, a normal or a force."""
MAX_STEPS = 65535
"""Largest number in a 16-bit picture."""


def mean_depth(picture: RenderOutput) -> Tensor:
    """Depth along the optical axis [scene units], 0 for empty pixels, shape (H, W)."""
    covered = picture.alpha >= COVERED
    return torch.where(covered, picture.depth / picture.alpha.clamp_min(COVERED), 0.0)[..., 0]


def depth_steps(depth: Tensor) -> Tensor:
    """Depth as millimetres for a 16-bit picture: 0 for empty pixels, otherwise 1 to 65535.

    Args:
        depth: Depth [m], 0 for empty pixels, shape (...).

    Returns:
        Shape (...), int32.
    """
    steps = (1000 * depth).round().clamp(1, MAX_STEPS)
    return torch.where(depth > 0, steps, 0.0).int()


def depth_colors(depth: Tensor, near: float | Tensor, far: float | Tensor) -> Tensor:
    """Colours of a depth: yellow up to ``near``, violet from ``far`` on, black for empty pixels.

    Args:
        depth: Depth, 0 for empty pixels, shape (H, W).

    Returns:
        Shape (H, W, 3).
    """
    return torch.where(depth[..., None] > 0, colormap((far - depth) / (far - near)), 0.0)


def facing(normals: Tensor, view: Tensor) -> Tensor:
    """Normals flipped towards the eye, since patches have no outside.

    Args:
        normals: Shape (N, 3).
        view: Directions from the eye to the patches, shape (N, 3).

    Returns:
        Shape (N, 3).
    """
    return torch.where((normals * view).sum(-1, keepdim=True) > 0, -normals, normals)


def _shown(alpha: Tensor, smooth: bool) -> Tensor:
    """Return the visibility of pixels of some opacity: 1 if covered, else 0; with smooth edges, a ramp between them."""
    return ((2 * alpha - COVERED).clamp(0, 1) if smooth else alpha >= COVERED).to(alpha)


def normal_colors(blended: Tensor, alpha: Tensor, rotation: Tensor, smooth: bool = False) -> Tensor:
    """Colours of normals: (n + 1) / 2 in red, green and blue, black for empty pixels.

    Args:
        blended: Blended normals in scene axes, shape (H, W, 3).
        alpha: Opacity, shape (H, W, 1).
        rotation: From scene axes to those of the picture, shape (3, 3).
        smooth: Whether edges fade to black instead of ending at a pixel.

    Returns:
        Shape (H, W, 3).
    """
    check_shape("blended", blended, 3)
    normals = torch.nn.functional.normalize(blended @ rotation.mT.to(blended), dim=-1)
    return _shown(alpha, smooth) * 0.5 * (normals + 1)


def scalar_colors(blended: Tensor, alpha: Tensor, largest: float, smooth: bool = False) -> Tensor:
    """Colours of a blended scalar: violet at 0, yellow at ``largest`` and above, black for empty pixels.

    Args:
        blended: Blended values, shape (H, W).
        alpha: Opacity, shape (H, W, 1).
        smooth: Whether edges fade to black instead of ending at a pixel.

    Returns:
        Shape (H, W, 3).
    """
    mean = blended / alpha[..., 0].clamp_min(0.5 * COVERED)
    return _shown(alpha, smooth) * colormap(mean / largest)


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
    """Colours from dark violet at 0 through green to yellow at 1 (viridis); values outside are clamped.

    Args:
        values: Shape (...); NaN gets the colour of 0.

    Returns:
        Colours in [0, 1], shape (..., 3).
    """
    table = torch.tensor(_VIRIDIS, dtype=values.dtype).to(values.device, non_blocking=True)
    place = values.nan_to_num(0.0).clamp(0, 1) * (len(_VIRIDIS) - 1)
    low = place.floor().clamp(max=len(_VIRIDIS) - 2)
    return torch.lerp(table[low.long()], table[low.long() + 1], (place - low)[..., None])


@dataclass(frozen=True)
class Pass:
    """A picture of each frame that a run can record.

    Args:
        draw: Makes its colours, shape (H, W, 3), of a :class:`~gaussian_swaying.simulation.draw.View`.
        raw: Makes 16-bit numbers, int32, shape (H, W), which are recorded as well.
        alone: Whether it shows the Gaussians alone, so that it suits copies, and a motion that closes.
        air: Whether only a simulation with computed air has it.
    """

    draw: Callable[[Any], Tensor]
    raw: Callable[[Any], Tensor] | None = None
    alone: bool = False
    air: bool = False


PASSES = {
    "color": Pass(lambda view: view.picture.color, alone=True),
    "depth": Pass(
        lambda view: depth_colors(mean_depth(view.picture), *view.depth_range),
        lambda view: depth_steps(mean_depth(view.picture) * view.painter.scene.frame.metres_per_unit),
        alone=True,
    ),
    "normal": Pass(lambda view: view.normals(), alone=True),
    "force": Pass(lambda view: view.pressure()),
    "wind": Pass(lambda view: view.wind()),
    "vorticity": Pass(lambda view: view.vorticity(), air=True),
}
"""All passes by their names; another entry can be recorded and shown like them."""
