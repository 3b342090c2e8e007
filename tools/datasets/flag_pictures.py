"""Textures, cameras and lamps of the flags."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from blender_images import View, look_at
from flag_reference import FlagPattern

from gaussian_swaying.scenes.printed_cloth import printed_colours

_BANDS = ((0.83, 0.30, 0.18), (0.95, 0.92, 0.85), (0.13, 0.33, 0.55))

_DISC, _WHITE = (0.93, 0.68, 0.20), 0.9


def draw_texture(pattern: FlagPattern, width: int = 1024) -> np.ndarray:
    """Colours of a flag in 0 to 1, upper row first, shape (H, W, 3), float32.

    ``white`` is plain, ``stripes`` has three bands and a disc, ``printed`` has features everywhere, as in
    ``FlagScene``, and anything else is the path of an image.
    """
    if pattern.texture == "white":
        return np.full((2, 2, 3), _WHITE, dtype=np.float32)
    if pattern.texture not in ("stripes", "printed"):
        import imageio.v3 as iio

        try:
            image = iio.imread(pattern.texture)
        except Exception as error:  # each image reader raises its own kinds of errors
            raise ValueError(
                f"Cannot read the texture {pattern.texture} ({error}): give white, stripes or an image."
            ) from error
        if image.dtype != np.uint8 or image.ndim != 3:
            raise ValueError(f"The texture {pattern.texture} is not an image of 8 bits in colour: export it as such.")
        return (image[..., :3] / 255).astype(np.float32)
    height = max(2, round(width * pattern.height / pattern.width))
    x = (np.arange(width) + 0.5) / width * pattern.width
    z = (1 - (np.arange(height) + 0.5) / height)[:, None] * pattern.height
    if pattern.texture == "printed":
        places = torch.from_numpy(np.stack(np.broadcast_arrays(x, z)))
        return printed_colours(*places).float().numpy()
    band = ((1 - z / pattern.height) * 3).astype(np.int64).clip(0, 2)
    colors = np.array(_BANDS)[np.broadcast_to(band, (height, width))]
    disc = np.hypot(x - 0.5 * pattern.width, z - 0.5 * pattern.height) < 0.2 * pattern.height
    colors[disc] = _DISC
    return colors.astype(np.float32)


def sphere_views(pattern: FlagPattern, count: int, size: int, angle: float = math.radians(40.0)) -> list[View]:
    """Cameras all around the flag at rest, spread evenly over a sphere on a golden spiral, upright in z.

    Units: ``size`` [pixels]; ``angle`` [radians].
    """
    radius = 1.1 * 0.5 * math.hypot(pattern.width, pattern.height, 2 * pattern.ripple) / math.sin(0.5 * angle)
    index = np.arange(count) + 0.5
    z = 1 - 2 * index / count
    turn = math.pi * (1 + math.sqrt(5)) * index
    flat = np.sqrt(1 - z * z)
    rays = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], -1)
    center = pattern.center()
    return [View(look_at(center + radius * ray, center), angle, size, size) for ray in rays]


def reference_view(
    pattern: FlagPattern, positions: np.ndarray, width: int, height: int, angle: float = math.radians(40.0)
) -> View:
    """The camera of the reference video: it looks along the initial normal, and the whole motion is in view.

    Units: ``positions`` [m]; ``width``, ``height`` [pixels]; ``angle`` [radians].
    """
    frame = look_at(pattern.center() + pattern.normal(), pattern.center())[:3, :3]
    return view_of_all(frame, positions, width, height, angle)


def view_of_all(frame: np.ndarray, positions: np.ndarray, width: int, height: int, angle: float) -> View:
    """The camera with given axes that has a whole motion in view, with 4 % of margin on each side.

    Units: ``positions`` [m]; ``width``, ``height`` [pixels]; ``angle`` [radians].
    """
    seen = positions.reshape(-1, 3).astype(np.float64) @ frame  # right, up, towards the camera
    middle = 0.5 * (seen.min(0) + seen.max(0))
    tangent = math.tan(0.5 * angle) * np.array([1.0, height / width]) / 1.08
    middle[2] = max((np.abs(seen[:, k] - middle[k]) / tangent[k] + seen[:, 2]).max() for k in (0, 1))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = frame, frame @ middle
    return View(pose, angle, width, height)


def lamp_position(pattern: FlagPattern, side: int = 1) -> np.ndarray:
    """Position of the area light [m]: on the initial normal, six flag lengths away; ``side`` -1 mirrors it."""
    return pattern.center() + side * 6.0 * pattern.longer_side * pattern.normal()


def frame_order(count: int, stride: int = 10) -> list[int]:
    """The order in which frames are made: every ``stride``-th first, so that an unfinished set spans the motion."""
    return sorted(range(count), key=lambda frame: (frame % stride != 0, frame))


def lens_fields(view: View) -> dict[str, Any]:
    """The fields of a ``transforms.json`` that all cameras of one lens share."""
    w, h = view.width, view.height
    return {"fl_x": view.focal, "fl_y": view.focal, "cx": 0.5 * w, "cy": 0.5 * h, "w": w, "h": h}


def transforms_fields(views: list[View], names: list[str]) -> dict[str, Any]:
    """The fields of a ``transforms.json`` for cameras that differ only in pose."""
    frames = [{"file_path": name, "transform_matrix": v.pose.tolist()} for v, name in zip(views, names, strict=True)]
    return {"camera_angle_x": views[0].angle_x} | lens_fields(views[0]) | {"frames": frames}
