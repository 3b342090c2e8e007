"""Camera paths that a configuration can name. They give the camera of each frame of a run."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying.rendering.cameras.camera import (
    Camera,
    check_direction,
    check_elevation,
    check_fov,
    check_pixels,
    look_at_camera,
    orbit_camera,
)
from gaussian_swaying.rendering.cameras.transforms_json import camera_from_transforms


class CameraPath(ABC):
    """Base class of the camera paths that a configuration can name.

    Attributes:
        captured: Whether the cameras are those of photographs. Such cameras may be inside the object's box.
        still: Whether the camera is the same in every frame, as long as no attribute of the path changes.
    """

    captured: bool = False
    still: bool = False

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
    """Camera on a sphere around the object that looks at it and may move around the up direction.

    See :func:`orbit_camera` for the definition of azimuth and elevation.

    Args:
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].
        azimuth: Angle about the up direction at time 0 [degrees].
        elevation: Angle above the horizontal plane [degrees], between -90 and 90 (both excluded).
        radius: Distance from the target, in multiples of the object's longest side.
        degrees_per_second: Speed of the azimuth [degrees/s].
        target_offset: Vector from the object's centre to the target, along the scene's axes, in multiples of the
            object's longest side.
        near: Near plane [scene units].

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range.
    """

    def __init__(
        self,
        width: int = 960,
        height: int = 540,
        *,
        fov_y: float = 40.0,
        azimuth: float = -60.0,
        elevation: float = 15.0,
        radius: float = 2.0,
        degrees_per_second: float = 0.0,
        target_offset: Sequence[float] = (0.0, 0.0, 0.0),
        near: float = 0.01,
    ) -> None:
        self.width, self.height = check_pixels("width", width), check_pixels("height", height)
        self.fov_y = check_fov("fov_y", fov_y)
        self.azimuth = check_vector("azimuth", [azimuth], 1)[0]
        self.elevation = check_elevation("elevation", elevation)
        check_positive("radius", radius)
        self.radius = float(radius)
        self.degrees_per_second = check_vector("degrees_per_second", [degrees_per_second], 1)[0]
        self.target_offset = check_vector("target_offset", target_offset)
        check_positive("near", near)
        self.near = float(near)

    @property
    def still(self) -> bool:  # type: ignore[override]
        """True if it does not move."""
        return self.degrees_per_second == 0

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
    """Fixed camera at a given point.

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

    still = True

    def __init__(
        self,
        eye: Sequence[float],
        target: Sequence[float],
        *,
        up: Sequence[float] | None = None,
        width: int = 960,
        height: int = 540,
        fov_y: float = 40.0,
        near: float = 0.01,
    ) -> None:
        self.eye, self.target = check_vector("eye", eye), check_vector("target", target)
        if self.eye == self.target:
            raise ValueError(f"Expected `eye` and `target` to differ, but both are {list(self.eye)}.")
        self.up = None if up is None else check_direction("up", up)
        self.width, self.height = check_pixels("width", width), check_pixels("height", height)
        self.fov_y = check_fov("fov_y", fov_y)
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
    still = True

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
        self.width = None if width is None else check_pixels("width", width)
        self.height = None if height is None else check_pixels("height", height)
        check_positive("near", near)
        self.near = float(near)
        self._camera: Camera | None = None

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        if self._camera is None:
            self._camera = camera_from_transforms(self.path, self.frame, self.width, self.height, self.near)
        return self._camera.to(center.device, center.dtype)
