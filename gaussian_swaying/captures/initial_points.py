"""Initial points for Gaussians: from a capture or a file, or random."""

from __future__ import annotations

import math
import os
from pathlib import Path

import torch
from einops import rearrange
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector, check_whole
from gaussian_swaying.captures.agreement import TURNED_AXES, places_in_picture
from gaussian_swaying.captures.capture import Capture, axes_meet_behind, common_focus, view_reach
from gaussian_swaying.captures.point_cloud import PointCloud, read_ply_points

_ATTEMPTS = 100

_CANDIDATES = 8  # for each of the points at which the photos agree
_WIDTH = 160  # to which the photos are reduced for them [pixels]


def initial_points(
    capture: Capture,
    source: str | os.PathLike[str] = "auto",
    count: int = 100_000,
    seed: int = 0,
    half_side: float | None = None,
) -> PointCloud:
    """Initial points for training on a capture.

    Random points are never closer to a camera than half of its distance to the point that all cameras look at.
    Otherwise they would end as haze that only this camera sees.

    Args:
        source: ``capture`` for the points of the capture, ``random`` for a cube, ``auto`` for the points of the capture
            if it has any, else random; ``consistent`` for :func:`consistent_points`; or a .ply file with points.
        count: Number of random or consistent points. All points of a capture or a file are used.
        half_side: Half the side of the cube [scene units]. The default is how far the median camera sees to each side
            of the point that all cameras look at.
    """
    check_whole("count", count, 1)
    if source == "capture" or (source == "auto" and capture.points is not None):
        if capture.points is None or capture.colors is None:
            raise ValueError(
                f"The capture {capture.path} has no points: set the initial points to random or to a file."
            )
        return PointCloud(capture.points, capture.colors)
    if source in ("auto", "random"):
        center, reach = _view_cube(capture) if half_side is None else (_focus(capture), half_side)
        return _away_from_cameras(capture, center, reach, count, seed)
    if source == "consistent":
        return consistent_points(capture, count, seed, half_side)
    path = Path(source)
    if path.suffix.lower() == ".ply":
        return read_ply_points(path, capture.origin)
    raise ValueError(
        f"Initial points cannot come from {source!s}: set auto, capture, random, consistent, or a .ply file."
    )


def random_points(center: Tensor, half_side: float, count: int, seed: int = 0) -> PointCloud:
    """Points of random colour, uniform in an upright cube.

    Args:
        center: Centre of the cube [scene units], shape (3,).
        half_side: Half its side [scene units].
    """
    check_vector("center", center)
    check_positive("half_side", half_side)
    generator = torch.Generator().manual_seed(seed)
    draw = torch.rand(count, 6, generator=generator)
    return PointCloud(center.float() + half_side * (2 * draw[:, :3] - 1), draw[:, 3:].contiguous())


def _away_from_cameras(capture: Capture, center: Tensor, reach: float, count: int, seed: int) -> PointCloud:
    points = colors = torch.zeros(0, 3)
    for attempt in range(_ATTEMPTS):
        more = random_points(center, reach, count, seed + 1_000_003 * attempt)
        kept = _clear(capture, center, more.points)
        points, colors = torch.cat([points, more.points[kept]]), torch.cat([colors, more.colors[kept]])
        if len(points) >= count:
            return PointCloud(points[:count], colors[:count])
    raise ValueError(
        f"The cameras of {capture.path} leave no room for random initial points between them: set the initial points "
        "to consistent or to a .ply file, or give a larger half side."
    )


def _clear(capture: Capture, center: Tensor, points: Tensor) -> Tensor:
    """Return a mask of the points (N, 3) at least half as far from every camera as the centre is, shape (N,)."""
    eyes = torch.stack([view.camera.position for view in capture.split("train")]).float()
    limit = 0.5 * (eyes - center.float()).norm(dim=-1)
    return torch.cat([(torch.cdist(part, eyes) >= limit).all(-1) for part in points.split(1 << 16)])


def consistent_points(capture: Capture, count: int, seed: int = 0, half_side: float | None = None) -> PointCloud:
    """Points at which the photos agree on a colour: of random candidates, those whose colour varies least.

    In the spirit of space carving by photo-consistency (Kutulakos & Seitz 2000), without its test of occlusion. Half
    of the candidates are uniform in the cube of :func:`initial_points`, the others around it, as dense per logarithm of
    the distance up to ten times its half side; each half gives half of the points, so that the background has some.

    Args:
        half_side: Half the side of the cube [scene units]; that of :func:`initial_points` by default.

    Returns:
        The points, with the mean of their colours in the photos.
    """
    center, reach = _view_cube(capture) if half_side is None else (_focus(capture), half_side)
    generator = torch.Generator().manual_seed(seed)
    inner = _CANDIDATES * (count - count // 2)
    outer = _CANDIDATES * (count // 2)
    near = 2 * torch.rand(inner, 3, generator=generator) - 1
    ray = torch.nn.functional.normalize(torch.randn(outer, 3, generator=generator), dim=-1)
    far = ray * 10.0 ** torch.rand(outer, 1, generator=generator)
    points = center.float() + reach * torch.cat([near, far])
    clear = _clear(capture, center, points)
    seen, total, squares = torch.zeros(len(points)), torch.zeros(len(points), 3), torch.zeros(len(points))
    for view in capture.split("train"):
        pixels = rearrange(view.load()[..., :3], "h w c -> 1 c h w").float() / 255
        height = max(round(_WIDTH * pixels.shape[2] / pixels.shape[3]), 1)
        photo = torch.nn.functional.interpolate(pixels, (height, _WIDTH), mode="area")[0]
        place, inside = places_in_picture(points, view.camera)
        size = place.new_tensor([_WIDTH / view.camera.width, height / view.camera.height])
        column, row = (place[inside] * size).long().unbind(-1)
        color = photo[:, row.clamp_max(height - 1), column.clamp_max(_WIDTH - 1)].T
        seen[inside] += 1
        total[inside] += color
        squares[inside] += color.square().sum(-1)
    mean = total / seen.clamp_min(1)[:, None]
    spread = squares / seen.clamp_min(1) - mean.square().sum(-1)
    spread[(seen < 3) | ~clear] = math.inf
    parts = ((spread[:inner], 0, count - count // 2), (spread[inner:], inner, count // 2))
    chosen = torch.cat([begin + part.topk(number, largest=False).indices for part, begin, number in parts])
    missing = int(spread[chosen].isinf().sum())
    if missing:
        photos = len(capture.split("train"))
        cause = "there are too few photos (`test_every`)"
        if photos >= 3:
            cause = "the cameras overlap too little, or are not those of the photos"
        raise ValueError(
            f"Only {count - missing} of {count} consistent points were found: of the places tried, "
            f"{float((seen < 3).float().mean()):.0%} are in fewer than three of the {photos} training photos, and "
            f"{float((~clear).float().mean()):.0%} close to a camera: {cause}. Correct this, or set "
            "a smaller `point_count` or the initial points to random."
        )
    return PointCloud(points[chosen], mean[chosen].clamp(0.0, 1.0))


def _focus(capture: Capture) -> Tensor:
    cameras = [view.camera for view in capture.split("train")]
    focus = common_focus(cameras)
    if focus is None:
        behind = f", but away from one ({TURNED_AXES})" if axes_meet_behind(cameras) else ""
        raise ValueError(
            f"The cameras of {capture.path} look at no common point{behind}, so no random initial points can be placed:"
            " set the initial points to a .ply file."
        )
    return focus


def _view_cube(capture: Capture) -> tuple[Tensor, float]:
    focus = _focus(capture)
    return focus, view_reach([view.camera for view in capture.split("train")], focus)
