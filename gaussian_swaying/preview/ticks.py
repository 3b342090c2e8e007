"""Coordinates along the edges of a box in a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from gaussian_swaying.rendering.cameras.camera import Camera, project

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

COLOUR = (20, 60, 130)
SHORTEST = 0.06  # an edge that looks shorter than this share of the picture's height has no ticks
FORESHORTENED = 0.5  # nor does an edge foreshortened below this share; another view shows them


def nice_ticks(low: float, high: float, most: int = 5) -> tuple[list[float], int]:
    """Round numbers between two bounds, 1, 2 or 5 times a power of ten apart.

    Args:
        low: Lower bound.
        high: Upper bound.
        most: Largest number of them, at least 1.

    Returns:
        The numbers, and how many decimals they need.
    """
    span = high - low
    if not (math.isfinite(span) and span > 0):
        return [], 0
    power = math.floor(math.log10(span / most))
    for step in (m * 10.0 ** (power + k) for k in range(3) for m in (1, 2, 5)):
        first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
        if 0 < last - first + 1 <= most:
            decimals = max(0, -math.floor(math.log10(step) + 1e-9))
            return [round(i * step, decimals) + 0.0 for i in range(first, last + 1)], decimals
    return [], 0


def draw_ticks(
    draw: ImageDraw,
    font: Any,
    low: Sequence[float],
    high: Sequence[float],
    camera: Camera,
) -> None:
    """Ticks with coordinates and the axis' name along one edge of a box for each axis.

    The edge is the rightmost of edges that are upright in the picture, and the lowest of others.

    Args:
        draw: The picture to draw on.
        font: Font of the numbers.
        low: Lower corner [scene units].
        high: Upper corner [scene units].
        camera: Camera of the picture.
    """
    size, focal = (camera.width, camera.height), float(camera.intrinsics[1, 1])
    corners = [[low[a], high[a]] for a in range(3)]
    centre = project(torch.tensor([[0.5 * (a + b) for a, b in corners]], dtype=torch.float64), camera)[0][0]
    for axis, name in enumerate("xyz"):
        edges = []
        others = [a for a in range(3) if a != axis]
        for k in range(4):
            end = [0.0, 0.0, 0.0]
            end[others[0]], end[others[1]] = corners[others[0]][k % 2], corners[others[1]][k // 2]
            first, last = list(end), list(end)
            first[axis], last[axis] = corners[axis]
            ends, depth = project(torch.tensor([first, last], dtype=torch.float64), camera)
            if float(depth.min()) > camera.near:
                edges.append((ends, end, float(depth.mean())))
        if not edges:
            continue
        way = edges[0][0][1] - edges[0][0][0]
        upright = bool(way[1].abs() > 2 * way[0].abs())
        ends, end, depth_of = max(edges, key=lambda edge: float(edge[0][:, 0 if upright else 1].mean()))
        length = float((ends[1] - ends[0]).norm())
        facing = focal * (high[axis] - low[axis]) / depth_of  # its length if it were perpendicular to the line of sight
        if length < max(SHORTEST * size[1], FORESHORTENED * facing):
            continue
        along = (ends[1] - ends[0]) / length
        out = torch.stack([-along[1], along[0]])
        if float(out @ (ends.mean(0) - centre)) < 0:
            out = -out
        apart = 30 if upright else 42
        values, decimals = nice_ticks(low[axis], high[axis], max(2, min(6, int(length / apart))))
        places = torch.tensor([[*end[:axis], value, *end[axis + 1 :]] for value in values], dtype=torch.float64)
        pixels = project(places.reshape(-1, 3), camera)[0]
        sideways = bool(out[0].abs() > out[1].abs())
        anchor = ("lm" if float(out[0]) > 0 else "rm") if sideways else "mt" if float(out[1]) > 0 else "mb"
        for value, at in zip(values, pixels, strict=True):
            tip = at + 7 * out
            draw.line([tuple(at.tolist()), tuple(tip.tolist())], fill=COLOUR, width=2)
            _label(draw, font, tip + 4 * out, f"{value:.{decimals}f}", anchor, size)
        middle = ends.mean(0) + (46 if upright else 30) * out
        _label(draw, font, middle, name, "mm", size, 2)


def _label(
    draw: ImageDraw, font: Any, at: Tensor, text: str, anchor: str, size: tuple[int, int], weight: int = 0
) -> None:
    x, y = at.tolist()
    box = draw.textbbox((x, y), text, font=font, anchor=anchor)
    if box[0] < 0 or box[1] < 0 or box[2] > size[0] or box[3] > size[1]:
        return
    draw.text((x, y), text, fill=COLOUR, font=font, anchor=anchor, stroke_width=2, stroke_fill=(255, 255, 255))
    if weight:  # bold
        draw.text((x + 0.5, y), text, fill=COLOUR, font=font, anchor=anchor)
