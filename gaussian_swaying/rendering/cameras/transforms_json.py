"""Cameras of a ``transforms.json`` in the NeRF, Blender or instant-ngp style."""

import math
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._inputs import read_json
from gaussian_swaying._numbers import sense_of
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.rendering.cameras.camera import Camera, counted_pose, resized_intrinsics

_AXES = {"opengl": [1.0, -1.0, -1.0, 1.0], "opencv": [1.0, 1.0, 1.0, 1.0]}  # signs of their x, y, z in those of OpenCV


def camera_of_transforms(
    path: str | Path,
    data: dict[str, Any],
    frame: int,
    width: int | None = None,
    height: int | None = None,
    near: float = 0.01,
    origin: Origin = NO_ORIGIN,
) -> Camera:
    """One camera of a ``transforms.json`` in the NeRF, Blender or instant-ngp style.

    ``transform_matrix`` is camera-to-world with OpenGL axes (x right, y up, z backward), or with those of OpenCV (x
    right, y down, z forward) if the file has ``"axes": "opencv"`` at its top. The intrinsics come from
    ``fl_x``, ``fl_y``, ``cx``, ``cy``, ``w`` and ``h`` [pixels], or from ``camera_angle_x`` [radians]; a value inside
    the frame takes precedence over one at the top of the file. If ``cx`` and ``cy`` are missing, the image centre is
    used. If ``fl_y`` is missing, it comes from ``camera_angle_y``, or pixels are square. Lens distortion (``k1``,
    ``p1``, ...) is ignored: undistort the images first.

    Args:
        frame: Index in its list ``frames``, from 0.
        width: Width of the image to render [pixels]; the intrinsics are rescaled. By default that of the file, or
            the one that keeps the file's aspect ratio when only ``height`` is given.
        height: Height of the image to render [pixels], with the same defaults.
        near: Near plane [scene units].
    """
    where = f"`{path}`"
    pixels = read_intrinsics(where, {**data, **data["frames"][frame]}, width, height)
    intrinsics, width, height = resized_intrinsics(*pixels, width, height)
    world_to_camera = counted_pose(torch.linalg.inv(read_pose(where, data, frame)), origin)
    return Camera(world_to_camera, intrinsics, width, height, near).to(dtype=torch.get_default_dtype())


def load_transforms(path: str | Path) -> dict[str, Any]:
    """Read a ``transforms.json`` of NeRF, Blender or instant-ngp.

    Returns:
        Its fields; ``frames`` is a list of at least one dictionary.
    """
    where = f"`{path}`"
    data = read_json(path, "camera file")
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(item, dict) for item in frames):
        raise ValueError(f"The camera file {where} has no list `frames`: give a transforms.json of NeRF or Blender.")
    if data.get("axes", "opengl") not in list(_AXES):
        raise ValueError(
            f"The field `axes` of the camera file {where} is {data['axes']!r}: set it to opengl or opencv."
        )
    return data


def read_number(where: str, fields: dict[str, Any], name: str) -> float | None:
    """Return a finite number of a transforms.json, or None if the field is missing."""
    value = fields.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"The field `{name}` of the camera file {where} is {value!r}: set it to a number.")
    sense = sense_of(name)
    if sense is not None and not sense.low <= value <= sense.high:
        raise ValueError(f"The field `{name}` of the camera file {where} is {value:g}: set it {sense.words}.")
    return float(value)


def read_intrinsics(
    where: str, fields: dict[str, Any], width: int | None, height: int | None
) -> tuple[float, float, float, float, float, float]:
    """Return width, height, fx, fy, cx, cy [pixels] at the resolution of a transforms.json."""
    names = ("w", "h", "fl_x", "fl_y", "cx", "cy", "camera_angle_x", "camera_angle_y")
    w, h, fx, fy, cx, cy, angle_x, angle_y = (read_number(where, fields, name) for name in names)
    if fx is not None and (w is None or h is None):
        raise ValueError(f"The camera file {where} has `fl_x` but no `w` and `h`: add the size of its images [pixels].")
    w = float(width) if w is None and width is not None else w
    h = float(height) if h is None and height is not None else h
    if w is None or h is None:
        raise ValueError(f"The camera file {where} has no image size `w` and `h`: set both `width` and `height`.")
    for name, angle in (("camera_angle_x", angle_x), ("camera_angle_y", angle_y)):
        if angle is not None and not 0.0 < angle < math.pi:
            raise ValueError(
                f"The field `{name}` of the camera file {where} is {angle}: set it in radians, above 0 and below pi."
            )
    if fx is None and angle_x is None:
        raise ValueError(
            f"The camera file {where} has no focal length: add `fl_x` [pixels] or `camera_angle_x` [radians]."
        )
    if fx is None and angle_x is not None:
        fx = 0.5 * w / math.tan(0.5 * angle_x)
    assert fx is not None
    if fy is None:
        fy = fx if angle_y is None else 0.5 * h / math.tan(0.5 * angle_y)
    for name, value in (("w", w), ("h", h), ("fl_x", fx), ("fl_y", fy)):
        if value <= 0:
            raise ValueError(f"The field `{name}` of the camera file {where} is {value}: set it to a positive number.")
    return w, h, fx, fy, 0.5 * w if cx is None else cx, 0.5 * h if cy is None else cy


def read_pose(where: str, data: dict[str, Any], frame: int) -> Tensor:
    """Return the camera-to-world matrix of a frame with OpenCV axes, in float64, shape (4, 4)."""
    fields = data["frames"][frame]
    name = f"frames[{frame}].transform_matrix"
    if "transform_matrix" not in fields:
        raise ValueError(f"The camera file {where} has no `{name}`: add the camera-to-world matrix, 4 rows of 4.")
    try:
        matrix = torch.tensor(fields["transform_matrix"], dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"The field `{name}` of the camera file {where} must be 4 rows of 4 numbers.") from error
    shape = tuple(matrix.shape)
    if shape != (4, 4) or not bool(torch.isfinite(matrix).all()):
        found = "NaN or infinite ones" if shape == (4, 4) else f"shape {shape}"
        raise ValueError(
            f"The field `{name}` of the camera file {where} must be 4 rows of 4 finite numbers, but has {found}."
        )
    if abs(float(torch.linalg.det(matrix))) < 1e-9:
        raise ValueError(f"The field `{name}` of the camera file {where} is singular: export the camera again.")
    return matrix * torch.tensor(_AXES[data.get("axes", "opengl")], dtype=torch.float64)
