"""Camera paths that a configuration can name. They give the camera of each frame of a run."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from typing import Any

from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._fixed import Fixed
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.rendering.cameras.camera import (
    Camera,
    check_direction,
    check_elevation,
    check_fov,
    check_pixels,
    look_at_camera,
    orbit_camera,
)
from gaussian_swaying.rendering.cameras.keyframes import CameraKey, KeyedCamera


class CameraPath(Fixed, ABC):
    """Base class of the camera paths that a configuration can name.

    Attributes:
        captured: Whether the cameras are those of photographs. Such cameras may be inside the object's box.
        still: Whether the camera is the same in every frame.
    """

    captured: bool = False
    still: bool = False

    _origin: Origin = NO_ORIGIN

    def counted_from(self, origin: Origin) -> CameraPath:
        """The path for a splat whose origin was taken off; converted if its places come from a file."""
        if not self.captured or origin == self._origin:
            return self
        path = replace(self)  # type: ignore[type-var]
        path._origin = origin
        return path

    @abstractmethod
    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame.

        Args:
            time: Time of the frame [s].
            center: Centre of the object [scene units], shape (3,).
            up: Up direction of the scene, shape (3,).
            size: Longest side of the object [scene units].

        Returns:
            The camera, on the device and in the precision of ``center``.
        """


def check_picture(camera: CameraPath) -> None:
    """Raise TypeError or ValueError unless size and field of view of a path's pictures are valid."""
    given = vars(camera)
    for name in ("width", "height"):
        if given[name] is not None:  # that of the capture
            check_pixels(name, given[name])
    if "fov_y" in given:
        check_fov("fov_y", given["fov_y"])


@dataclass(eq=False, kw_only=True)
class PinholePath(CameraPath):
    """Base class of the paths of a pinhole camera that is not that of a capture.

    Args:
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].
    """

    width: int = 960
    height: int = 540
    fov_y: float = 40.0

    def __post_init__(self) -> None:
        check_picture(self)

    def picture(self, like: Tensor, fov_y: float | None = None) -> dict[str, Any]:
        """Keyword arguments (lens, size, device, dtype) of :func:`look_at_camera` and :func:`orbit_camera`."""
        lens = {"fov_y_degrees": fov_y or self.fov_y, "width": self.width, "height": self.height}
        return {**lens, "device": like.device, "dtype": like.dtype}


@dataclass(eq=False)
class OrbitCamera(PinholePath):
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

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range.
    """

    width: int = 960
    height: int = 540
    _: KW_ONLY
    azimuth: float = -60.0
    elevation: float = 15.0
    radius: float = 2.0
    degrees_per_second: float = 0.0
    target_offset: Sequence[float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("azimuth", "degrees_per_second"):
            check_vector(name, [getattr(self, name)], 1)
        check_elevation("elevation", self.elevation)
        check_positive("radius", self.radius)
        self.target_offset = check_vector("target_offset", self.target_offset)

    @property
    def still(self) -> bool:  # type: ignore[override]
        """True if it does not move."""
        return self.degrees_per_second == 0

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        check_positive("size", size)
        target = [c + size * o for c, o in zip(check_vector("center", center), self.target_offset, strict=True)]
        azimuth = self.azimuth + self.degrees_per_second * time
        return orbit_camera(target, up, size * self.radius, azimuth, self.elevation, **self.picture(center))


@dataclass(eq=False)
class LookAtCamera(PinholePath):
    """Camera at a given point, or on a path through keys: from eye to eye, or on a sphere about its target.

    Args:
        eye: Position [scene units], 3 numbers.
        target: Point at the image centre [scene units], 3 numbers; the object's centre when None.
        keys: Instead, times and positions, sorted by time. The speed between them is continuous and does not overshoot;
            the camera is at rest before the first key and after the last.
        up: Direction seen upwards in the image where an ``eye`` is given, 3 numbers; that of the scene when None.
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range, the line of sight is not defined, the times do not increase, or the
            keys give neither or both of eye and angles.

    Example:
        >>> keys = [CameraKey(0.0, azimuth=-90, elevation=10, radius=2), CameraKey(2.0, azimuth=0)]
        >>> import torch
        >>> center, up = torch.zeros(3), torch.tensor([0.0, 0.0, 1.0])
        >>> LookAtCamera(keys=keys)(50, 2.0, center, up, 1.0).position.round(decimals=3)
        tensor([1.9700, 0.0000, 0.3470])
    """

    eye: Sequence[float] | None = None
    target: Sequence[float] | None = None
    _: KW_ONLY
    keys: list[CameraKey] | None = None
    up: Sequence[float] | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if (self.eye is None) == (self.keys is None):
            raise ValueError("Expected `eye` or `keys` of the LookAtCamera, but got neither or both.")
        self.eye = None if self.eye is None else check_vector("eye", self.eye)
        self.target = None if self.target is None else check_vector("target", self.target)
        self.up = None if self.up is None else check_direction("up", self.up)
        eye, target = (None if place is None else list(place) for place in (self.eye, self.target))
        keys = [CameraKey(0.0, eye, target=target)] if self.keys is None else self.keys
        self._path = KeyedCamera(keys, self.fov_y)

    @property
    def still(self) -> bool:  # type: ignore[override]
        """True if it does not move."""
        return len(self._path.times) == 1

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        check_positive("size", size)
        place, target, fov = self._path.at(time, check_vector("center", center))
        picture = self.picture(center, fov)
        if self._path.orbits:
            azimuth, elevation, radius = place
            return orbit_camera(target, up, size * radius, azimuth, elevation, **picture)
        return look_at_camera(place, target, up if self.up is None else self.up, **picture)
