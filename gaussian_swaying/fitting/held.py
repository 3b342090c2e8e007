"""The end at which an object is held, from a film of it: the one that does not move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.fitting.registration import SOLID, in_space
from gaussian_swaying.fitting.tracks import follow, opencv
from gaussian_swaying.fitting.videos import Footage
from gaussian_swaying.rendering.protocol import RenderOutput

END = 0.12
"""Part of an object that is one of its ends, as a share of its length in that direction."""
FLAT = 0.3
"""Least length in a direction that has ends, per the largest one."""
FEWEST = 5
"""Fewest points that make an end."""
STILL, MOVED = 0.35, 3.0
"""Largest motion of a held end, per that of the liveliest quarter of the points, and the least of these [pixels]."""


@dataclass(frozen=True)
class HeldEnd:
    """The end that does not move.

    Attributes:
        name: ``top``, ``bottom``, or ``+x`` to ``-z`` of the splat.
        direction: Towards it, shape (3,).
        moves: How far points there move [pixels].
        others: How far the liveliest quarter moves [pixels].
    """

    name: str
    direction: tuple[float, ...]
    moves: float
    others: float


def held_end(video: Footage, picture: RenderOutput, up: Sequence[float]) -> HeldEnd | None:
    """Find the end of an object that moves least in a film.

    Args:
        video: The film; the object is at rest in its first frame.
        picture: The object, drawn from the camera of the first frame.
        up: Direction that is up, shape (3,).

    Returns:
        None if no end is much more still than the rest, as in an object that is held at a corner or within.

    Raises:
        ImportError: Without OpenCV.
    """
    places, moved = moving_points(video, picture)
    if len(moved) < 4 * FEWEST:
        return None
    others = float(moved.quantile(0.75))
    if others < MOVED:
        return None
    upward = torch.nn.functional.normalize(torch.as_tensor(up, dtype=torch.float64), dim=0)
    ends = {"top": upward, "bottom": -upward}
    for axis, name in enumerate("xyz"):
        if abs(float(upward[axis])) < 0.7:
            unit = torch.eye(3, dtype=torch.float64)[axis]
            ends |= {f"+{name}": unit, f"-{name}": -unit}
    along = {name: places @ direction for name, direction in ends.items()}
    length = {name: float(own.max() - own.min()) for name, own in along.items()}
    found = []
    for name, own in along.items():
        there = own > own.max() - END * length[name]
        if length[name] >= FLAT * max(length.values()) and int(there.sum()) >= FEWEST:
            found.append((float(moved[there].median()), name))
    if not found or min(found)[0] > STILL * others:
        return None
    moves, name = min(found)
    return HeldEnd(name, tuple(ends[name].tolist()), moves, others)


def moving_points(video: Footage, picture: RenderOutput) -> tuple[Tensor, Tensor]:
    """Places in the splat of points of the object that are followed, (T, 3), and how far each goes, (T,) [pixels]."""
    import numpy as np

    cv2: Any = opencv()
    grey = cv2.cvtColor(video.images[0].numpy(), cv2.COLOR_RGB2GRAY)
    cover = (picture.alpha[..., 0].detach().cpu().numpy() > SOLID).astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(grey, 600, 0.01, 5, mask=cover)
    if corners is None:
        return torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, dtype=torch.float64)
    start = corners.reshape(-1, 2).astype(np.float64) + 0.5
    position, seen = follow(video.images.numpy(), start)
    world, known = in_space(picture, video.cameras[0], start)
    gone = np.where(seen, np.linalg.norm(position - position[:1], axis=-1), 0.0).max(0)
    return torch.from_numpy(world[known]), torch.from_numpy(gone[known])


__all__ = ["HeldEnd", "held_end", "moving_points"]
