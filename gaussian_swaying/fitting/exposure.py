"""Exposure and white balance of a film, frame by frame, judged by the still background of the splat.

A camera that changes its exposure or white balance multiplies each colour by a number, also of colours with a gamma
curve. This gain makes the background of the splat as bright as that of the frame; what moves or shines there is left
out by a median.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.fitting.background import Background
from gaussian_swaying.fitting.videos import Footage
from gaussian_swaying.rendering.cameras.camera import Camera

BLOCK = 4
"""Side of the squares over which colours are averaged [pixels], so that edges, noise and compression count little."""
DARK, BRIGHT = 8, 247
"""Mean grey level up to which a square tells nothing, and that of a pixel from which it may be cut off."""
LEAST = 50
"""Fewest squares that make a gain."""


def gains(video: Footage, background: Background) -> tuple[Tensor, tuple[int, ...]] | None:
    """Brightness of each frame over that of the splat, by colour.

    Args:
        video: The film, with the camera of each frame.
        background: What stands still.

    Returns:
        Gains of red, green and blue, float64, shape (F, 3), and the frames that show too little of the background,
        which have those of their neighbours. None if all do.
    """
    import numpy as np

    found: list[Tensor | None] = []
    drawn: tuple[Camera, Tensor, Tensor] | None = None
    for camera, image in zip(video.cameras, video.images, strict=True):
        if drawn is None or drawn[0] is not camera:
            picture, still = background.draw(camera)
            drawn = (camera, 255 * picture.color.cpu().double(), still)
        found.append(gain_of(image.double(), *drawn[1:]))
    known = [k for k, one in enumerate(found) if one is not None]
    if not known:
        return None
    rows = np.stack([one.numpy() for one in found if one is not None])
    moments = [video.times[k] for k in known]
    filled = [np.interp(video.times, moments, own) for own in rows.T]
    return torch.from_numpy(np.stack(filled, 1)), tuple(k for k, one in enumerate(found) if one is None)


def gain_of(image: Tensor, picture: Tensor, still: Tensor) -> Tensor | None:
    """The gain of each colour, float64, shape (3,), between a picture and an image of grey levels up to 255 (H, W, 3).

    It is the median over squares of the mask ``still`` (H, W), weighed by their brightness in the picture, which
    minimises the sum of distances. None if there are too few squares.
    """
    inside = _averaged(still.double()[..., None])[:, 0] == 1
    seen, wanted = _averaged(image), _averaged(picture)
    cut = _averaged((torch.maximum(image, picture) >= BRIGHT).double())
    inside &= ((seen > DARK) & (wanted > DARK) & (cut == 0)).all(1)
    if int(inside.sum()) < LEAST:
        return None
    return torch.stack([_median(s / w, w) for s, w in zip(seen[inside].T, wanted[inside].T, strict=True)])


def with_gains(images: Tensor, found: Sequence[Tensor] | Tensor) -> Tensor:
    """Frames (F, H, W, 3), uint8, divided by their gains (F, 3)."""
    out = torch.empty_like(images)  # a film may be large: no second list of its frames
    for one, image, gain in zip(out, images, found, strict=True):
        one.copy_((image.float() / gain.float()).round().clamp(0, 255))
    return out


def _averaged(picture: Tensor) -> Tensor:
    """Means over squares of a picture (H, W, C), shape (N, C)."""
    means = torch.nn.functional.avg_pool2d(picture.permute(2, 0, 1)[None], BLOCK)[0]
    return means.flatten(1).T


def _median(values: Tensor, weights: Tensor) -> Tensor:
    order = values.argsort()
    total = weights[order].cumsum(0)
    return values[order[int(torch.searchsorted(total, 0.5 * total[-1]))]]
