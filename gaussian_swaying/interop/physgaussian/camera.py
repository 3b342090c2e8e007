"""The camera of a PhysGaussian configuration, and reading of the cameras of a 3DGS model."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive, check_vector
from gaussian_swaying._inputs import read_json
from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera
from gaussian_swaying.rendering.cameras.camera_path import PinholePath


@dataclass(eq=False)
class PhysGaussianCamera(PinholePath):
    """Camera of a PhysGaussian configuration: a camera of the model, or one on a sphere that looks at a point.

    Azimuth is defined as in PhysGaussian: from the horizontal part of (1, 1, 1), or of (0.72, 0.37, -0.67) if (1, 1, 1)
    is nearly perpendicular to ``up``, and clockwise about ``up`` as seen from above.

    Args:
        cameras: ``cameras.json`` of the model, for the lens and for ``index``; without it ``fov_y`` and the size are
            used.
        index: Index of the camera, from 0; -1 for the sphere.
        azimuth: Angle about ``up`` in the first moving frame [degrees].
        elevation: Angle above the horizontal plane [degrees].
        radius: Distance [scene units].
        delta_azimuth: Change per frame [degrees].
        delta_elevation: Change per frame [degrees].
        delta_radius: Change per frame [scene units].
        viewpoint: Target point, in the normalised space of ``normalisation``; in scene units without it.
        up: Direction seen upwards, in the same space.
        width: Image width [pixels].
        height: Image height [pixels].
        fov_y: Vertical field of view [degrees].
        near: Near plane [scene units]; a hundredth of the distance or of the object's size when None.

    Raises:
        ValueError: If a number is out of range; at the first frame, if the file is bad.
    """

    cameras: str | os.PathLike[str] | None = None
    index: int = -1
    _: KW_ONLY
    azimuth: float = 0.0
    elevation: float = 0.0
    radius: float = 2.0
    delta_azimuth: float = 0.0
    delta_elevation: float = 0.0
    delta_radius: float = 0.0
    viewpoint: Sequence[float] = (1.0, 1.0, 1.0)
    up: Sequence[float] = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_positive("radius", self.radius)
        if self.index >= 0 and self.cameras is None:
            raise ValueError(f"Camera {self.index} is a camera of the model: set `cameras` to its `cameras.json`.")
        self.viewpoint, self.up = check_vector("viewpoint", self.viewpoint), check_vector("up", self.up)
        if not any(self.up):
            raise ValueError("Expected `up` to be a direction, but got zero.")
        self.frame: SimFrame | None = None
        self._model: Camera | None = None

    def eye(self, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        """Position, target and up of the sphere's camera in a frame: scene units, shape (3,), float64."""
        moved = max(frame - 1, 0)  # the first frame here is at rest, and PhysGaussian does not draw it
        azimuth = math.radians(self.azimuth + moved * self.delta_azimuth)
        elevation = math.radians(self.elevation + moved * self.delta_elevation)
        radius = self.radius + moved * self.delta_radius
        check_positive("radius", radius)
        target, up = (torch.tensor(v, dtype=torch.float64) for v in (self.viewpoint, self.up))
        if self.frame is not None:
            target, up = self.frame.point_to_sim(target), self.frame.direction_to_sim(up)
        up = up / up.norm()
        ahead = torch.ones(3, dtype=torch.float64)
        if abs(float(ahead @ up)) < 0.01:
            ahead = torch.tensor([0.72, 0.37, -0.67], dtype=torch.float64)
        ahead = ahead - (ahead @ up) * up
        ahead = ahead / ahead.norm()
        aside = torch.linalg.cross(ahead, up)
        level = math.cos(azimuth) * ahead + math.sin(azimuth) * aside
        return target + radius * (math.cos(elevation) * level + math.sin(elevation) * up), target, up

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        if self._model is None and self.cameras is not None:
            self._model = read_model_camera(self.cameras, max(self.index, 0), self.near_of(size))
        if self._model is not None and self.index >= 0:
            return self._model.to(center.device, center.dtype)
        width, height = (self.width, self.height) if self._model is None else (self._model.width, self._model.height)
        camera = look_at_camera(*self.eye(frame), self.fov_y, width, height, self.near, dtype=torch.float64)
        if self._model is not None:
            camera = replace(camera, intrinsics=self._model.intrinsics)
        return camera.to(center.device, center.dtype)


def read_model_camera(path: str | os.PathLike[str], index: int, near: float = 0.01) -> Camera:
    """Read a camera from the ``cameras.json`` of a 3DGS model.

    Args:
        path: The file: a list of cameras with ``position``, ``rotation`` (camera to world, OpenCV axes), ``fx``, ``fy``
            [pixels], ``width`` and ``height``.
        index: Index of the camera, from 0.
        near: Near plane [scene units]; a hundredth of the distance or of the object's size when None.

    Returns:
        The camera in float64; the principal point is the image's centre.
    """
    entries = read_json(path, "camera file")
    if not isinstance(entries, list) or not 0 <= index < len(entries):
        count = len(entries) if isinstance(entries, list) else 0
        raise ValueError(f"The camera file `{path}` has {count} cameras, and none with the index {index}.")
    try:
        entry = entries[index]
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3] = torch.tensor(entry["rotation"], dtype=torch.float64)
        pose[:3, 3] = torch.tensor(entry["position"], dtype=torch.float64)
        width, height = int(entry["width"]), int(entry["height"])
        rows = [[float(entry["fx"]), 0.0, 0.5 * width], [0.0, float(entry["fy"]), 0.5 * height], [0.0, 0.0, 1.0]]
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise ValueError(
            f"The camera {index} of `{path}` is not one of 3DGS ({error}): it needs position, rotation, fx, fy, width "
            "and height."
        ) from error
    return Camera(torch.linalg.inv(pose), torch.tensor(rows, dtype=torch.float64), width, height, near)
