"""Pinhole cameras in the OpenCV convention, and functions that place one."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_shape, check_vector
from gaussian_swaying._fixed import fixed
from gaussian_swaying.geometry.origin import Origin
from gaussian_swaying.geometry.rotations import check_direction, rows_from_z

NEAR = 0.01
"""Near plane, in distances to what the camera looks at, or in sizes of it."""


def counted_pose(world_to_camera: Tensor, origin: Origin) -> Tensor:
    """The pose (4, 4), float64, relative to another origin."""
    moved = world_to_camera.clone()
    moved[:3, 3] += moved[:3, :3] @ torch.tensor(origin, dtype=moved.dtype)
    return moved


def check_pixels(name: str, value: Any) -> int:
    """Return ``value`` if it is a positive integer, or raise an error that names the field."""
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"Expected `{name}` to be a whole number of pixels, but got {value!r}.")
    if value <= 0:
        raise ValueError(f"Expected `{name}` to be a positive number of pixels, but got {value}.")
    return value


def check_fov(name: str, value: float) -> float:
    """Return ``value`` if it is a field of view in degrees, or raise an error that names the field."""
    if not 0.0 < value < 180.0:
        raise ValueError(f"Expected `{name}` to be between 0 and 180 degrees (both excluded), but got {value}.")
    return float(value)


def check_elevation(name: str, value: float) -> float:
    """Return ``value`` if it is an elevation in degrees, or raise an error that names the field."""
    if not -90.0 < value < 90.0:
        raise ValueError(f"Expected `{name}` to be between -90 and 90 degrees (both excluded), but got {value}.")
    return float(value)


@fixed
@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Pinhole camera in the OpenCV convention: x to the right, y down, z forward.

    The centre of the pixel in row i and column j is at (j + 0.5, i + 0.5).

    Attributes:
        world_to_camera: Matrix that takes world points to camera points [scene units], shape (4, 4).
        intrinsics: Matrix with fx, fy, cx, cy [pixels], shape (3, 3). Skew is ignored.
        width: Image width [pixels].
        height: Image height [pixels].
        near: Gaussians whose centre has a smaller depth are not drawn [scene units]; the default is for objects of
            about 1 unit.

    Raises:
        TypeError: If a matrix is not a tensor or the image size is not an integer.
        ValueError: If a matrix has another shape, or the image size or ``near`` is not positive.
    """

    world_to_camera: Tensor
    intrinsics: Tensor
    width: int
    height: int
    near: float = 0.01
    _eye: Tensor | None = field(default=None, init=False, repr=False)  # if known, as an inverse takes long

    def __post_init__(self) -> None:
        check_shape("world_to_camera", self.world_to_camera, 4, 4)
        check_shape("intrinsics", self.intrinsics, 3, 3)
        check_pixels("width", self.width)
        check_pixels("height", self.height)
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

        They are copied from the host to a GPU in one go, and the host does not wait for it.
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


# A camera is made for every frame: plain numbers take a tenth of the time of small tensors.


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
    near: float | None = None,
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Camera:
    """Camera at ``eye`` with ``target`` at the image centre and ``up`` towards the top of the image.

    Args:
        eye: Position of the camera [scene units], shape (3,).
        target: Point seen at the image centre [scene units], shape (3,).
        up: Direction seen upwards in the image, any length, shape (3,).
        fov_y_degrees: Vertical field of view [degrees]. Pixels are square.
        width: Image width [pixels].
        height: Image height [pixels].
        near: Near plane [scene units]; :data:`NEAR` of the distance when None.
        dtype: Precision of the matrices; the default precision of torch when None.

    Example:
        >>> look_at_camera((0, -2, 0), (0, 0, 0), (0, 0, 1), 40.0, 480, 270).position[1]
        tensor(-2.)
    """
    width, height = check_pixels("width", width), check_pixels("height", height)
    tangent = math.tan(math.radians(0.5 * check_fov("fov_y_degrees", fov_y_degrees)))
    eye_point, up_axis = check_vector("eye", eye), check_direction("up", up)
    forward = [a - b for a, b in zip(check_vector("target", target), eye_point, strict=True)]
    distance = math.hypot(*forward)
    if not distance > 0:
        raise ValueError(f"Expected `eye` and `target` to differ, but both are {list(eye_point)}.")
    forward = [item / distance for item in forward]
    right = _cross(forward, up_axis)
    across = math.hypot(*right)
    if across < 1e-6:
        raise ValueError(f"Expected `up` not to be along the line of sight, but got {list(up_axis)}.")
    right = [item / across for item in right]
    axes = (right, _cross(forward, right), forward)
    rows = [[*axis, 0.0 - _dot(axis, eye_point)] for axis in axes]  # never -0.0
    world_to_camera = torch.tensor([*rows, [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
    focal = 0.5 * height / tangent
    intrinsics = torch.tensor(
        [[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]], dtype=torch.float64
    )
    camera = Camera(world_to_camera, intrinsics, width, height, NEAR * distance if near is None else near)
    object.__setattr__(camera, "_eye", torch.tensor(eye_point, dtype=torch.float64))  # known without an inverse
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
    near: float | None = None,
    *,
    device: torch.device | str | None = None,
    dtype: torch.dtype | None = None,
) -> Camera:
    """Camera on a sphere around ``center`` that looks at ``center``.

    Azimuth turns counter-clockwise about ``up``. For ``up = (0, 0, 1)`` the eye is on the +x side at azimuth 0, the +y
    side at 90 and the -y side at -90. For any other ``up`` these directions are rotated by the minimal rotation that
    takes +z to ``up`` (:func:`rotation_from_z`): for ``up = (0, -1, 0)`` the eye is on the +x side at azimuth 0, the +z
    side at 90 and the -z side at -90.

    Args:
        center: Centre of the sphere [scene units], shape (3,).
        up: Direction seen upwards in the image, any length, shape (3,).
        radius: Distance of the eye from ``center`` [scene units].
        azimuth_degrees: Angle about ``up`` [degrees].
        elevation_degrees: Angle above the plane perpendicular to ``up`` [degrees], between -90 and 90 (both excluded).
        fov_y_degrees: Vertical field of view [degrees].
        width: Image width [pixels].
        height: Image height [pixels].
        near: Near plane [scene units]; :data:`NEAR` of the distance when None.
        dtype: Precision of the matrices; the default precision of torch when None.
    """
    check_positive("radius", radius)
    check_elevation("elevation_degrees", elevation_degrees)
    azimuth, elevation = math.radians(azimuth_degrees), math.radians(elevation_degrees)
    horizontal = math.cos(elevation)
    local = [horizontal * math.cos(azimuth), horizontal * math.sin(azimuth), math.sin(elevation)]
    center_point = check_vector("center", center)
    offset = [_dot(row, local) for row in rows_from_z(check_direction("up", up))]
    eye = [c + radius * o for c, o in zip(center_point, offset, strict=True)]
    return look_at_camera(eye, center_point, up, fov_y_degrees, width, height, near, device=device, dtype=dtype)


def resized_intrinsics(
    w: float, h: float, fx: float, fy: float, cx: float, cy: float, width: int | None, height: int | None
) -> tuple[Tensor, int, int]:
    """Intrinsics of the same view with another image size.

    Args:
        w: Width that the intrinsics belong to [pixels].
        h: Height that they belong to [pixels].
        fx: Focal length along the rows [pixels].
        fy: Focal length along the columns [pixels].
        cx: Column of the principal point [pixels].
        cy: Row of the principal point [pixels].
        width: New width [pixels]; by default unchanged, or the one that keeps the aspect ratio.
        height: New height [pixels], with the same default.

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


def project(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Pixel coordinates (N, 2) and depths (N,) [scene units] of points (N, 3), in float64; depth <= 0 is behind."""
    check_shape("points", points, None, 3)
    view, intrinsics = camera.world_to_camera.cpu().double(), camera.intrinsics.cpu().double()
    inside = points.detach().cpu().double() @ view[:3, :3].T + view[:3, 3]
    depth = inside[:, 2]
    pixel = inside @ intrinsics.T
    return pixel[:, :2] / torch.where(depth.abs() < 1e-12, 1e-12, depth)[:, None], depth


def azimuth_beside(flow: Sequence[float]) -> float | None:
    """Azimuth [degrees] from which a flow [m/s, z up] goes to the right; None if the flow is not level."""
    x, y, z = flow
    level = math.hypot(x, y)
    return math.degrees(math.atan2(-x, y)) if level > abs(z) else None
