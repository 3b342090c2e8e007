"""Pinhole cameras in the OpenCV convention, and the camera paths that a configuration can name."""

import json
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape, check_vector


def _check_pixels(name: str, value: Any) -> int:
    """Return ``value`` if it is a positive integer, or raise an error that names the field."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"Expected `{name}` to be a whole number of pixels, but got {value!r}.")
    if value <= 0:
        raise ValueError(f"Expected `{name}` to be a positive number of pixels, but got {value}.")
    return value


def _check_fov(name: str, value: float) -> float:
    """Return ``value`` if it is a field of view in degrees, or raise an error that names the field."""
    if not 0.0 < value < 180.0:
        raise ValueError(f"Expected `{name}` to be between 0 and 180 degrees (both excluded), but got {value}.")
    return float(value)


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Pinhole camera in the OpenCV convention: x to the right, y down, z forward.

    The centre of the pixel in row i and column j is at (j + 0.5, i + 0.5).

    Attributes:
        world_to_camera: Matrix that takes world points to camera points [scene units], shape (4, 4).
        intrinsics: Matrix with fx, fy, cx, cy [pixels], shape (3, 3). Skew is ignored.
        width: Image width [pixels].
        height: Image height [pixels].
        near: Gaussians whose centre has a smaller depth are not drawn [scene units].

    Raises:
        TypeError: If a matrix is not a tensor or the image size is not an integer.
        ValueError: If a matrix has another shape, or the image size or ``near`` is not positive.
    """

    world_to_camera: Tensor
    intrinsics: Tensor
    width: int
    height: int
    near: float = 0.01
    _eye: Tensor | None = field(default=None, init=False, repr=False)  # of a camera that came from the host

    def __post_init__(self) -> None:
        check_shape("world_to_camera", self.world_to_camera, 4, 4)
        check_shape("intrinsics", self.intrinsics, 3, 3)
        _check_pixels("width", self.width)
        _check_pixels("height", self.height)
        check_positive("near", self.near)

    @property
    def position(self) -> Tensor:
        """Eye in world coordinates [scene units], shape (3,)."""
        if self._eye is not None:
            return self._eye
        inverse, _ = torch.linalg.inv_ex(self.world_to_camera)
        return inverse[:3, 3]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Camera":
        """Return the camera with its matrices on another device or in another precision.

        From the host to a GPU they go in one copy, which the host does not wait for.
        """
        target = self.intrinsics.device if device is None else torch.device(device)
        parts, eye = (self.world_to_camera, self.intrinsics), self._eye
        if target.type == "cuda" and all(part.device.type == "cpu" and not part.requires_grad for part in parts):
            packed = torch.cat([part.reshape(-1).to(dtype=dtype) for part in (*parts, self.position)])
            packed = packed.pin_memory().to(target, non_blocking=True)
            view, intrinsics, eye = packed[:16].view(4, 4), packed[16:25].view(3, 3), packed[25:]
        else:
            view, intrinsics = (part.to(device=device, dtype=dtype) for part in parts)
            eye = None if eye is None else eye.to(device=device, dtype=dtype)
            if view is self.world_to_camera and intrinsics is self.intrinsics:
                return self
        moved = replace(self, world_to_camera=view, intrinsics=intrinsics)
        object.__setattr__(moved, "_eye", eye)
        return moved


def rotation_from_z(up: Sequence[float] | Tensor) -> Tensor:
    """Minimal rotation that takes +z to ``up``; its transpose takes ``up`` to +z.

    For the one direction where the minimal rotation is not unique, (0, 0, -1), it is the half turn about x.

    Args:
        up: Direction of any length, shape (3,).

    Returns:
        Rotation matrix in float64 on the CPU, shape (3, 3).

    Raises:
        ValueError: If ``up`` is zero or not finite.
    """
    return torch.tensor(_rows_from_z(_unit("up", up)), dtype=torch.float64)


# A camera is made for every frame: plain numbers take a tenth of the time of small tensors.


def _rows_from_z(up: Sequence[float]) -> list[list[float]]:
    """Rows of :func:`rotation_from_z`, from a vector of length one."""
    x, y, z = up
    if z < -1.0 + 1e-12:
        return [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    f = 1.0 / (1.0 + z)  # Rodrigues' formula with axis (-y, x, 0) and cosine z
    return [[1.0 - f * x * x, -f * x * y, x], [-f * x * y, 1.0 - f * y * y, y], [-x, -y, z]]


def _unit(name: str, value: Sequence[float] | Tensor) -> tuple[float, ...]:
    """Return a checked 3-vector of length one."""
    vector = check_vector(name, value)
    length = math.hypot(*vector)
    if length < 1e-12:
        raise ValueError(f"Expected `{name}` to be a direction, but got the zero vector.")
    return tuple(item / length for item in vector)


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Sequence[float], b: Sequence[float]) -> list[float]:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def look_at_camera(
    eye: Sequence[float] | Tensor,
    target: Sequence[float] | Tensor,
    up: Sequence[float] | Tensor,
    fov_y_degrees: float,
    width: int,
    height: int,
    near: float = 0.01,
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Camera:
    """Camera at ``eye`` that has ``target`` at the image centre and ``up`` towards the top of the image.

    Args:
        eye: Position of the camera [scene units], shape (3,).
        target: Point seen at the image centre [scene units], shape (3,).
        up: Direction seen upwards in the image, any length, shape (3,).
        fov_y_degrees: Vertical field of view [degrees]. Pixels are square.
        width: Image width [pixels].
        height: Image height [pixels].
        near: Near plane [scene units].
        device: Device of the matrices.
        dtype: Precision of the matrices; the default precision of torch when None.

    Returns:
        The camera.

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If ``eye`` and ``target`` coincide, ``up`` is zero or along the line of sight, or a number is
            out of range.

    Example:
        >>> look_at_camera((0, -2, 0), (0, 0, 0), (0, 0, 1), 40.0, 480, 270).position[1]
        tensor(-2.)
    """
    width, height = _check_pixels("width", width), _check_pixels("height", height)
    tangent = math.tan(math.radians(0.5 * _check_fov("fov_y_degrees", fov_y_degrees)))
    eye_point, up_axis = check_vector("eye", eye), _unit("up", up)
    forward = [a - b for a, b in zip(check_vector("target", target), eye_point, strict=True)]
    distance = math.hypot(*forward)
    if distance < 1e-12:
        raise ValueError(f"Expected `eye` and `target` to differ, but both are {list(eye_point)}.")
    forward = [item / distance for item in forward]
    right = _cross(forward, up_axis)
    across = math.hypot(*right)
    if across < 1e-6:
        raise ValueError(f"Expected `up` not to lie along the line of sight, but got {list(up_axis)}.")
    right = [item / across for item in right]
    axes = (right, _cross(forward, right), forward)
    rows = [[*axis, 0.0 - _dot(axis, eye_point)] for axis in axes]  # never -0.0
    world_to_camera = torch.tensor([*rows, [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    focal = 0.5 * height / tangent
    intrinsics = torch.tensor(
        [[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    camera = Camera(world_to_camera, intrinsics, width, height, near)
    return camera.to(device, dtype or torch.get_default_dtype())


def orbit_camera(
    center: Sequence[float] | Tensor,
    up: Sequence[float] | Tensor,
    radius: float,
    azimuth_degrees: float,
    elevation_degrees: float,
    fov_y_degrees: float,
    width: int,
    height: int,
    near: float = 0.01,
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Camera:
    """Camera on a sphere around ``center`` that looks at ``center``.

    Azimuth turns counter-clockwise about ``up``. For ``up = (0, 0, 1)`` the eye is on the +x side at azimuth 0, the
    +y side at 90 and the -y side at -90. For any other ``up`` these directions are carried along by the minimal
    rotation that takes +z to ``up`` (:func:`rotation_from_z`): for ``up = (0, -1, 0)`` the eye is on the +x side at
    azimuth 0, the +z side at 90 and the -z side at -90.

    Args:
        center: Centre of the sphere [scene units], shape (3,).
        up: Direction seen upwards in the image, any length, shape (3,).
        radius: Distance of the eye from ``center`` [scene units].
        azimuth_degrees: Angle about ``up`` [degrees].
        elevation_degrees: Angle above the plane across ``up`` [degrees], between -90 and 90 (both excluded).
        fov_y_degrees: Vertical field of view [degrees].
        width: Image width [pixels].
        height: Image height [pixels].
        near: Near plane [scene units].
        device: Device of the matrices.
        dtype: Precision of the matrices; the default precision of torch when None.

    Returns:
        The camera.

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range.
    """
    check_positive("radius", radius)
    _check_elevation("elevation_degrees", elevation_degrees)
    azimuth, elevation = math.radians(azimuth_degrees), math.radians(elevation_degrees)
    horizontal = math.cos(elevation)
    local = [horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation)]
    center_point = check_vector("center", center)
    offset = [_dot(row, local) for row in _rows_from_z(_unit("up", up))]
    eye = [c + radius * o for c, o in zip(center_point, offset, strict=True)]
    return look_at_camera(eye, center_point, up, fov_y_degrees, width, height, near, device=device, dtype=dtype)


def _check_elevation(name: str, value: float) -> float:
    """Return ``value`` if it is an elevation in degrees that leaves the up direction defined."""
    if not -90.0 < value < 90.0:
        raise ValueError(f"Expected `{name}` to be between -90 and 90 degrees (both excluded), but got {value}.")
    return float(value)


def camera_from_transforms(
    path: str | Path,
    frame: int,
    width: int | None = None,
    height: int | None = None,
    near: float = 0.01,
) -> Camera:
    """Read one camera of a ``transforms.json`` in the NeRF, Blender or instant-ngp style.

    ``transform_matrix`` is camera-to-world with OpenGL axes (x right, y up, z backward). The intrinsics come from
    ``fl_x``, ``fl_y``, ``cx``, ``cy``, ``w`` and ``h`` [pixels], or from ``camera_angle_x`` [radians]; a value inside
    the frame wins over the one at the top of the file. Missing ``cx`` and ``cy`` are the image centre, missing
    ``fl_y`` makes square pixels (or comes from ``camera_angle_y``). Lens distortion (``k1``, ``p1``, ...) is ignored:
    undistort the images first.

    Args:
        path: The file.
        frame: Index in its list ``frames``, from 0.
        width: Width of the image to render [pixels]; the intrinsics are rescaled. By default that of the file, or
            the one that keeps the file's aspect ratio when only ``height`` is given.
        height: Height of the image to render [pixels], likewise.
        near: Near plane [scene units].

    Returns:
        The camera, in the default precision of torch.

    Raises:
        TypeError: If ``frame``, ``width`` or ``height`` is not an integer.
        ValueError: If the file is missing, is not JSON, lacks a field or has a bad one. The message names the file,
            the field and the remedy.
    """
    if isinstance(frame, bool) or not isinstance(frame, int):
        raise TypeError(f"Expected `frame` to be a whole number, but got {frame!r}.")
    return camera_of_transforms(path, load_transforms(path), frame, width, height, near)


def camera_of_transforms(
    path: str | Path,
    data: dict[str, Any],
    frame: int,
    width: int | None = None,
    height: int | None = None,
    near: float = 0.01,
) -> Camera:
    """One camera of a ``transforms.json`` that :func:`load_transforms` has read; see :func:`camera_from_transforms`."""
    where = f"`{path}`"
    frames = data["frames"]
    if not 0 <= frame < len(frames):
        raise ValueError(f"The camera file {where} has no frame {frame}: set `frame` between 0 and {len(frames) - 1}.")
    for name, size in (("width", width), ("height", height)):
        if size is not None:
            _check_pixels(name, size)
    pixels = read_intrinsics(where, {**data, **frames[frame]}, width, height)
    intrinsics, width, height = resized_intrinsics(*pixels, width, height)
    world_to_camera = torch.linalg.inv(read_pose(where, frame, frames[frame]))
    return Camera(world_to_camera, intrinsics, width, height, near).to(dtype=torch.get_default_dtype())


def resized_intrinsics(
    w: float, h: float, fx: float, fy: float, cx: float, cy: float, width: int | None, height: int | None
) -> tuple[Tensor, int, int]:
    """Intrinsics of the same view in another number of pixels.

    Args:
        w: Width that the intrinsics belong to [pixels].
        h: Height that they belong to [pixels].
        fx: Focal length along the rows [pixels].
        fy: Focal length along the columns [pixels].
        cx: Column of the principal point [pixels].
        cy: Row of the principal point [pixels].
        width: Wanted width [pixels]; by default the present one, or the one that keeps the aspect ratio.
        height: Wanted height [pixels], likewise.

    Returns:
        Matrix in float64, shape (3, 3), width and height.
    """
    if width is None:
        width = round(w) if height is None else max(1, round(height * w / h))
        height = round(h) if height is None else height
    elif height is None:
        height = max(1, round(width * h / w))
    x, y = width / w, height / h
    return (
        torch.tensor([[fx * x, 0.0, cx * x], [0.0, fy * y, cy * y], [0.0, 0.0, 1.0]], dtype=torch.float64),
        width,
        height,
    )


def load_transforms(path: str | Path) -> dict[str, Any]:
    """Read a ``transforms.json`` of NeRF, Blender or instant-ngp.

    Args:
        path: The file.

    Returns:
        Its fields; ``frames`` is a list of at least one dictionary.

    Raises:
        ValueError: If the file is missing, is not JSON or has no list ``frames``.
    """
    where = f"`{path}`"
    try:
        data = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"Cannot read the camera file {where} ({error.strerror}): check `path`.") from error
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"The camera file {where} is not valid JSON ({error}): export it again.") from error
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(item, dict) for item in frames):
        raise ValueError(f"The camera file {where} has no list `frames`: give a transforms.json of NeRF or Blender.")
    return data


def read_number(where: str, fields: dict[str, Any], name: str) -> float | None:
    """Return a finite number of a transforms.json, or None if the field is missing."""
    value = fields.get(name)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"The field `{name}` of the camera file {where} is {value!r}: set it to a number.")
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


def read_pose(where: str, frame: int, fields: dict[str, Any]) -> Tensor:
    """Return the camera-to-world matrix of a frame with OpenCV axes, in float64, shape (4, 4)."""
    name = f"frames[{frame}].transform_matrix"
    if "transform_matrix" not in fields:
        raise ValueError(f"The camera file {where} has no `{name}`: add the camera-to-world matrix, 4 rows of 4.")
    try:
        matrix = torch.tensor(fields["transform_matrix"], dtype=torch.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"The field `{name}` of the camera file {where} must be 4 rows of 4 numbers.") from error
    if tuple(matrix.shape) != (4, 4) or not bool(torch.isfinite(matrix).all()):
        raise ValueError(
            f"The field `{name}` of the camera file {where} must be 4 rows of 4 finite numbers, "
            f"but has shape {tuple(matrix.shape)}."
        )
    if abs(float(torch.linalg.det(matrix))) < 1e-9:
        raise ValueError(f"The field `{name}` of the camera file {where} is singular: export the camera again.")
    return matrix * torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64)  # OpenGL y, z -> OpenCV y, z


class CameraPath(ABC):
    """Base class of the camera paths that a configuration can name.

    Attributes:
        captured: Whether the cameras stood where photographs were taken, be it within the object's box.
    """

    captured: bool = False

    @abstractmethod
    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame.

        Args:
            frame: Index of the frame.
            time: Time of the frame [s].
            center: Centre of the object [scene units], shape (3,).
            up: Up direction of the scene, shape (3,).
            size: Longest side of the object [scene units].

        Returns:
            The camera, on the device and in the precision of ``center``.
        """


class OrbitCamera(CameraPath):
    """Camera that looks at the object from a sphere around it, and may travel about the up direction.

    See :func:`orbit_camera` for what azimuth and elevation mean.

    Args:
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].
        azimuth: Angle about the up direction at time 0 [degrees].
        elevation: Angle above the horizontal plane [degrees], between -90 and 90 (both excluded).
        radius: Distance from the target, in multiples of the object's longest side.
        degrees_per_second: Speed of the azimuth [degrees/s].
        target_offset: From the object's centre to the point looked at, along the scene's axes, in multiples of the
            object's longest side.
        near: Near plane [scene units].

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range.
    """

    def __init__(
        self,
        width: int = 480,
        height: int = 270,
        fov_y: float = 40.0,
        azimuth: float = -60.0,
        elevation: float = 15.0,
        radius: float = 2.0,
        degrees_per_second: float = 0.0,
        target_offset: Sequence[float] = (0.0, 0.0, 0.0),
        near: float = 0.01,
    ) -> None:
        self.width, self.height = _check_pixels("width", width), _check_pixels("height", height)
        self.fov_y = _check_fov("fov_y", fov_y)
        self.azimuth = check_vector("azimuth", [azimuth], 1)[0]
        self.elevation = _check_elevation("elevation", elevation)
        check_positive("radius", radius)
        self.radius = float(radius)
        self.degrees_per_second = check_vector("degrees_per_second", [degrees_per_second], 1)[0]
        self.target_offset = check_vector("target_offset", target_offset)
        check_positive("near", near)
        self.near = float(near)

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        check_positive("size", size)
        return orbit_camera(
            [c + size * o for c, o in zip(check_vector("center", center), self.target_offset, strict=True)],
            up,
            size * self.radius,
            self.azimuth + self.degrees_per_second * time,
            self.elevation,
            self.fov_y,
            self.width,
            self.height,
            self.near,
            device=center.device,
            dtype=center.dtype,
        )


class LookAtCamera(CameraPath):
    """Camera that stands still at a given point.

    Args:
        eye: Position [scene units], 3 numbers.
        target: Point at the image centre [scene units], 3 numbers.
        up: Direction seen upwards in the image, 3 numbers; that of the scene when None.
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].
        near: Near plane [scene units].

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range, or the line of sight is not defined.
    """

    def __init__(
        self,
        eye: Sequence[float],
        target: Sequence[float],
        up: Sequence[float] | None = None,
        width: int = 480,
        height: int = 270,
        fov_y: float = 40.0,
        near: float = 0.01,
    ) -> None:
        self.eye, self.target = check_vector("eye", eye), check_vector("target", target)
        if self.eye == self.target:
            raise ValueError(f"Expected `eye` and `target` to differ, but both are {list(self.eye)}.")
        self.up = None if up is None else _unit("up", up)
        self.width, self.height = _check_pixels("width", width), _check_pixels("height", height)
        self.fov_y = _check_fov("fov_y", fov_y)
        check_positive("near", near)
        self.near = float(near)

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        return look_at_camera(
            self.eye,
            self.target,
            up if self.up is None else self.up,
            self.fov_y,
            self.width,
            self.height,
            self.near,
            device=center.device,
            dtype=center.dtype,
        )


class TransformsCamera(CameraPath):
    """Captured camera of a ``transforms.json``; the file is read at the first frame.

    Args:
        path: The file, see :func:`camera_from_transforms`.
        frame: Index of the camera in the file, from 0. It is the same camera in every frame of the video.
        width: Image width [pixels]; by default that of the file.
        height: Image height [pixels]; by default that of the file.
        near: Near plane [scene units].

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range; at the first frame, if the file is bad.
    """

    captured = True

    def __init__(
        self,
        path: str | Path,
        frame: int = 0,
        width: int | None = None,
        height: int | None = None,
        near: float = 0.01,
    ) -> None:
        if isinstance(frame, bool) or not isinstance(frame, int):
            raise TypeError(f"Expected `frame` to be a whole number, but got {frame!r}.")
        if frame < 0:
            raise ValueError(f"Expected `frame` not to be negative, but got {frame}.")
        self.path, self.frame = path, frame
        self.width = None if width is None else _check_pixels("width", width)
        self.height = None if height is None else _check_pixels("height", height)
        check_positive("near", near)
        self.near = float(near)
        self._camera: Camera | None = None

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        if self._camera is None:
            self._camera = camera_from_transforms(self.path, self.frame, self.width, self.height, self.near)
        return self._camera.to(center.device, center.dtype)
