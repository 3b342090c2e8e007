"""The part of a splat that moves in a film, and the end at which it is held: the one that does not move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.fitting.film import FULL, LEAST, off_camera
from gaussian_swaying.fitting.registration import SOLID, in_space
from gaussian_swaying.fitting.tracks import follow, opencv
from gaussian_swaying.fitting.videos import Footage
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.rendering.protocol import RenderOutput

END = 0.12
"""Part of an object that is one of its ends, as a share of its length in that direction."""
FLAT = 0.3
"""Least length in a direction that has ends, per the largest one."""
FEWEST = 5
"""Fewest points that make an end."""
STILL, MOVED = 0.35, 3.0
"""Largest motion of a held end, per that of the liveliest quarter of the points, and the least of these [pixels]."""

LIVELY = 0.25
"""Motion of what moves, per that of the liveliest fiftieth of the points; the rest is drift of the tracks."""
MOST = 0.5
"""Largest share of the points that move if there are things around that do not."""
CELLS, PAD = 24, 0.02
"""Cells along what moves, within two of which things are connected; and what its box is larger, as shares of it."""


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


def held_end(places: Tensor, moved: Tensor, up: Sequence[float]) -> HeldEnd | None:
    """Find the end of an object that moves least in a film.

    Args:
        places: Of points on the object, shape (T, 3).
        moved: How far each goes [pixels], shape (T,).
        up: Direction that is up, shape (3,).

    Returns:
        None if no end is much more still than the rest, as in an object that is held at a corner or within.
    """
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


def moving_box(places: Tensor, moved: Tensor, cloud: GaussianCloud) -> tuple[Tensor, Tensor] | None:
    """The box of what moves among things that do not, and of all that is connected with it.

    Args:
        places: Of points that the film shows, shape (T, 3).
        moved: How far each goes [pixels], shape (T,).
        cloud: The splat.

    Returns:
        Lower and upper corner [scene units], shape (3,); None if most of what is seen moves, or hardly anything.
    """
    goes = moved > max(MOVED, LIVELY * float(moved.quantile(0.98))) if len(moved) else moved > 0
    if not 4 * FEWEST <= int(goes.sum()) <= MOST * len(goes):
        return None
    low, high = (places[goes].quantile(share, dim=0) for share in (0.02, 0.98))
    longest = float((high - low).max())
    means = cloud.means.double()
    near = ((means > low - longest) & (means < high + longest)).all(-1) & (cloud.opacities > 0)
    points = means[near]
    part = connected_parts(points, max(longest / CELLS, 2 * particle_spacing(points)))
    inside = ((points >= low) & (points <= high)).all(-1)
    if not bool(inside.any()):
        return None
    own = points[part == int(part[inside].mode().values)]
    pad = PAD * longest
    return own.amin(0) - pad, own.amax(0) + pad


def moving_points(video: Footage, picture: RenderOutput) -> tuple[Tensor, Tensor]:
    """Follow points of a splat through a film, and take the shake of a hand off.

    Args:
        video: The film; the object is at rest in its first frame.
        picture: The splat, drawn from the camera of the first frame.

    Returns:
        The places in the splat of those that are seen for half of the film, (T, 3), and how far each goes at most, (T,)
        [pixels].
    """
    import numpy as np

    cv2: Any = opencv()
    grey = cv2.cvtColor(video.images[0].numpy(), cv2.COLOR_RGB2GRAY)
    cover = (picture.alpha[..., 0].detach().cpu().numpy() > SOLID).astype(np.uint8)
    around = (cv2.dilate(cover, np.ones((31, 31), np.uint8)) == 0).astype(np.uint8)
    corners = [cv2.goodFeaturesToTrack(grey, 600, 0.01, 5, mask=mask) for mask in (cover, around)]
    there, beside = (np.zeros((0, 2)) if one is None else one.reshape(-1, 2) + 0.5 for one in corners)
    position, seen = follow(video.images.numpy(), np.concatenate([there, beside]))
    world, known = in_space(picture, video.cameras[0], there)
    outside = position[:, len(there) :], seen[:, len(there) :]
    position, seen = position[:, : len(there)], seen[:, : len(there)]
    gone = np.zeros(len(there))
    K = video.cameras[0].intrinsics.double().numpy()
    for k in range(1, len(position)):
        used = known & seen[k]
        if len(beside) >= LEAST:  # what lies around the splat
            moved, valid = outside[0][k], outside[1][k]
            turn = cv2.estimateAffinePartial2D(outside[0][0][valid], moved[valid], ransacReprojThreshold=1.5)[0]
            start = position[0] if turn is None else position[0] @ turn[:, :2].T + turn[:, 2]
            far = np.linalg.norm(position[k] - start, axis=-1)[used]
        elif cover.mean() > FULL:
            far = off_camera(world[used], position[k, used], K, MOVED)
        else:
            far = np.linalg.norm(position[k] - position[0], axis=-1)[used]
        if far is not None:
            gone[used] = np.maximum(gone[used], far)
    kept = known & (seen.mean(0) > 0.5)
    return torch.from_numpy(world[kept]), torch.from_numpy(gone[kept])
