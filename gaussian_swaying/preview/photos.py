"""Guesses from the cameras of the photos of a splat: the up direction, the object, and its background."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying.captures.agreement import places_in_picture
from gaussian_swaying.captures.capture import common_focus, view_reach
from gaussian_swaying.captures.capture_camera import read_views
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.geometry.regions import Cylinder
from gaussian_swaying.preview.shape import DIRECTIONS, FEWEST, bounds, extent, largest_plane, plane_axes, rounded
from gaussian_swaying.rendering.cameras.camera import Camera

SEEN = 0.6  # share of the photos in which the object lies
SNAP = 8.0  # an up direction this close to an axis is taken as the axis [degrees]
_MOST_PLANES = 3  # backdrops to look for


@dataclass(frozen=True)
class CapturedFrom:
    """The cameras of photos, and what follows from them.

    Attributes:
        path: The capture.
        cameras: Its cameras.
        eyes: Their positions [scene units], float64, shape (C, 3).
        up: Unit vector that points up.
        confidence: ``high``, ``medium`` or ``low``.
        reason: The reason, in words.
        focus: The point nearest to all optical axes [scene units], float64, shape (3,); None if there is no common
            point.
        reach: Distance to the side of it that the median camera sees [scene units].
    """

    path: str
    cameras: list[Camera]
    eyes: Tensor
    up: tuple[float, ...]
    confidence: str
    reason: str
    focus: Tensor | None
    reach: float

    @property
    def options(self) -> tuple[str, ...]:
        """The values of ``--up`` for this direction and the opposite one."""
        return tuple(" ".join(f"{sign * c + 0.0:.4g}" for c in self.up) for sign in (1.0, -1.0))


@dataclass(frozen=True)
class Backdrop:
    """A plane behind or below the object in the photos: a wall, a floor or a table top.

    Attributes:
        mask: Which points are in it or behind it, shape (N,).
        normal: Unit normal towards the cameras.
        behind: Region of its front face and everything behind it [scene units].
    """

    mask: Tensor
    normal: tuple[float, ...]
    behind: Cylinder


@dataclass(frozen=True)
class ShownObject:
    """The object that photos show.

    Attributes:
        mask: Gaussians visible in at least 60 % of the photos that are not in or behind a backdrop, shape (N,).
        backdrops: Walls, floors and tables that were left out, with masks over all N Gaussians.
        focus: The point that the cameras look at [scene units], shape (3,).
        reach: Distance to the side of it that they see [scene units].
    """

    mask: Tensor
    backdrops: list[Backdrop]
    focus: Tensor
    reach: float

    def nearness(self, points: Tensor) -> Tensor:
        """Weight of each point (N, 3) by its distance d from the focus: exp(-(2 d / reach)²), shape (N,)."""
        return (-((points.double() - self.focus).norm(dim=-1) / (0.5 * self.reach)).square()).exp()

    def floor(self, up: Sequence[float]) -> Tensor:
        """Points of backdrops that are level within 25 degrees, shape (N,)."""
        level = [b.mask for b in self.backdrops if _dot(b.normal, up) > math.cos(math.radians(25))]
        return torch.stack([torch.zeros_like(self.mask), *level]).any(0)

    def wall(self, up: Sequence[float]) -> tuple[float, ...] | None:
        """Direction to the largest wall, a backdrop upright within 25 degrees; None without a wall or with a floor."""
        walls = [b for b in self.backdrops if abs(_dot(b.normal, up)) < math.sin(math.radians(25))]
        if not walls or bool(self.floor(up).any()):
            return None
        return tuple(0.0 - c for c in walls[0].normal)


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(a, b, strict=True))


def captured_from(path: str | Path, origin: Origin = NO_ORIGIN) -> CapturedFrom:
    """Read the cameras of a capture; its photos need not exist.

    Args:
        path: A transforms.json, a COLMAP model, or a folder that contains one.
        origin: Point from which the places of the splat count.

    Returns:
        The cameras, and what follows from them.
    """
    cameras = [camera for _, camera in read_views(path, origin=origin)]
    up, confidence, reason = cameras_up(cameras)
    eyes = torch.stack([camera.position.double() for camera in cameras])
    focus = common_focus(cameras)
    reach = 0.0 if focus is None else view_reach(cameras, focus)
    return CapturedFrom(str(path), cameras, eyes, up, confidence, reason, focus, reach)


def cameras_up(cameras: Sequence[Camera]) -> tuple[tuple[float, ...], str, str]:
    """The up direction, assuming that photos are held level, so that their rows of pixels are horizontal.

    It is the direction perpendicular to the rows of all photos, on the side of the upper edge of most photos. If all
    rows are parallel, or photos were not held level, it is the mean of their upward directions. A direction within 8
    degrees of an axis is set to the axis.

    Args:
        cameras: At least one camera.

    Returns:
        Unit vector in scene axes; ``high``, ``medium`` or ``low``; and why, in words.
    """
    rows, columns = (torch.stack([c.world_to_camera[k, :3].double() for c in cameras]) for k in (0, 1))
    mean = -columns.mean(0)
    agreement = float(mean.norm())
    up = mean / max(agreement, 1e-12)
    confidence, why = ("medium" if agreement > 0.7 else "low"), "the mean of the upward directions of the photos"
    values, axes = torch.linalg.eigh(rows.T @ rows / len(cameras))
    tilt = math.degrees(math.asin(min(1.0, max(0.0, float(values[0])) ** 0.5)))
    across = axes[:, 0] * (1.0 if float(axes[:, 0] @ up) >= 0 else -1.0)
    if float(values[1]) > 0.05 and tilt < 15 and float(across @ up) > 0.7:
        up, confidence = across, "high" if len(cameras) >= 8 else "medium"
        why = f"the {len(cameras)} photos were held level to {tilt:.1f} degrees"
    elif agreement < 1e-6:
        up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    main = int(up.abs().argmax())
    if float(up[main].abs()) > math.cos(math.radians(SNAP)):
        axis = torch.zeros(3, dtype=torch.float64)
        axis[main] = torch.sign(up[main])
        off = math.degrees(math.acos(min(1.0, float(axis @ up))))
        name = max(DIRECTIONS, key=lambda n: sum(a * b for a, b in zip(DIRECTIONS[n], axis.tolist(), strict=True)))
        return DIRECTIONS[name], confidence, f"{why}, {off:.1f} degrees from {name}"
    return tuple(float(c) for c in up), confidence, why


def seen_share(points: Tensor, cameras: Sequence[Camera]) -> Tensor:
    """Share of the pictures that contain each point (N, 3), ignoring occlusion; shape (N,)."""
    return torch.stack([places_in_picture(points.float(), c)[1] for c in cameras]).float().mean(0)


def looked_at(points: Tensor, view: CapturedFrom) -> Tensor:
    """Points that are in at least 60 % of the photos and within reach of their common point, shape (N,)."""
    if view.focus is None:
        raise ValueError(
            f"The cameras of {view.path} do not look at a common point, so the object is not known: set `--region`."
        )
    near = (points.double() - view.focus).norm(dim=-1) < 1.5 * view.reach
    mask = near & (seen_share(points, view.cameras) >= SEEN)
    if int(mask.sum()) < FEWEST:
        focus = [round(float(c), 3) for c in view.focus]
        raise ValueError(
            f"The cameras of `--capture` look at {focus}, where the splat has {int(mask.sum())} Gaussians: use the "
            "capture that it was trained on, or set `--region`."
        )
    return mask


def backdrops(points: Tensor, weight: Tensor, eyes: Tensor, reach: float, cell: float) -> list[Backdrop]:
    """Walls, floors and tables behind what photos show.

    A backdrop is a plane with a thickness of 6 % of the longest side. It contains at least 15 % of the visible area in
    front of the backdrops found before, is at least 0.8 times as wide as photos reach to a side, and is at least 25
    degrees from the others. Nine of ten cameras are in front of it, and so is something that is at least 1.2 times
    narrower than the plane in both directions. Points up to three half thicknesses in front of it also belong to it,
    unless something stands out farther there: this is the roughness of a wall.

    Args:
        points: Centres of the Gaussians in the photos [scene units], shape (N, 3).
        weight: Their visible area, shape (N,).
        eyes: Positions of the cameras [scene units], shape (C, 3).
        reach: Distance to the side that photos show [scene units].
        cell: Coordinates of the regions are rounded to a hundredth of it [scene units].

    Returns:
        The backdrops, the largest first.
    """
    where, weight, eyes = points.double(), weight.double(), eyes.double()
    corner = bounds(points)
    side = max(b - a for a, b in zip(corner["robust_min"], corner["robust_max"], strict=True))
    half = 0.03 * side
    left = torch.ones(len(points), dtype=torch.bool)  # neither in a backdrop nor behind one
    tried = torch.zeros_like(left)
    found: list[Backdrop] = []
    for _ in range(_MOST_PLANES):
        plane = largest_plane(where[left & ~tried], weight[left & ~tried], half)
        if plane is None:
            break
        normal, offset = plane
        if float((eyes @ normal - offset).mean()) < 0:
            normal, offset = -normal, -offset
        height = where @ normal - offset
        layer, behind, front = left & (height.abs() <= half), height < -half, left & (height > half)
        tried |= layer
        if any(float(torch.tensor(other.normal) @ normal.float()) > math.cos(math.radians(25)) for other in found):
            continue  # something fixed to a wall is not another wall
        ahead = float((eyes @ normal - offset > half).double().mean())
        if ahead < 0.9 or float(weight[layer].sum()) < 0.15 * float(weight[left].sum()) or int(front.sum()) < FEWEST:
            continue
        if float(weight[front].sum()) < 0.05 * float(weight[layer | front].sum()):
            continue
        axes = plane_axes(normal)
        wide = [[extent(where[part] @ a, 0.05) for part in (layer, front)] for a in axes]
        if not all(own > max(0.8 * reach, 1.2 * other) for own, other in wide):
            continue
        depth = 4 * side + 2 * half
        center = where[layer].mean(0)
        center = center + (offset + half - 0.5 * depth - float(center @ normal)) * normal
        cylinder = Cylinder(
            [rounded(float(c), cell) for c in center],
            [round(float(c), 6) for c in normal],
            rounded(4 * side, cell),
            rounded(depth, cell),
        )
        rough = front & (height <= 3 * half)
        rough &= ~_below(where @ torch.stack(axes, 1) / (2 * half), front & ~rough)
        mask = ((height <= half) | rough) & left
        found.append(Backdrop(mask | behind, tuple(float(c) for c in normal), cylinder))
        left &= (height > half) & ~rough
    return found


def _below(columns: Tensor, high: Tensor) -> Tensor:
    """Return a mask (N,) of points in or beside a column with at least 3 of the high ones; columns (N, 2)."""
    index = columns.floor().long()
    key = index[:, 0] * 2**31 + index[:, 1]
    full, count = key[high].unique(return_counts=True)
    full = full[count >= 3]
    around = torch.cat([full + a * 2**31 + b for a in (-1, 0, 1) for b in (-1, 0, 1)])
    return torch.isin(key, around)


def shown_object(points: Tensor, opacity: Tensor, weight: Tensor, view: CapturedFrom) -> ShownObject:
    """The object that the photos of a capture show, without its background.

    Args:
        points: Centres [scene units], shape (N, 3).
        opacity: Opacities, shape (N,).
        weight: Visible area, shape (N,).
        view: The cameras of the photos.
    """
    mask = looked_at(points, view)
    assert view.focus is not None
    solid = (mask & (opacity >= 0.1)).nonzero()[:, 0]
    found = []
    for backdrop in backdrops(points[solid], weight[solid], view.eyes, view.reach, 0.02 * view.reach):
        everywhere = backdrop.behind.contains(points.double())
        everywhere[solid[backdrop.mask]] = True
        found.append(dataclasses.replace(backdrop, mask=everywhere))
        mask = mask & ~everywhere
    return ShownObject(mask, found, view.focus, view.reach)
