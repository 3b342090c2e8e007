"""The cameras of a capture as camera paths of a run: one of them, or a path through all."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying._checks import check_positive
from gaussian_swaying.captures.colmap import colmap_models, read_colmap_views
from gaussian_swaying.captures.photos import clean_name
from gaussian_swaying.captures.transforms import transforms_files
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.geometry.rotations import quat_to_rotation, rotation_to_quat
from gaussian_swaying.rendering.cameras.camera import NEAR, Camera, counted_pose, resized_intrinsics
from gaussian_swaying.rendering.cameras.camera_path import CameraPath, check_picture
from gaussian_swaying.rendering.cameras.keyframes import interpolate_keys
from gaussian_swaying.rendering.cameras.transforms_json import camera_of_transforms, load_transforms


def read_views(
    path: str | Path,
    width: int | None = None,
    height: int | None = None,
    near: float = 0.01,
    origin: Origin = NO_ORIGIN,
) -> list[tuple[str, Camera]]:
    """Read the cameras of a capture; its images need not exist.

    Args:
        path: A transforms.json, a folder with one (or with ``transforms_train.json`` ...), a COLMAP model, or a folder
            with one, such as ``sparse/0``, which is preferred; of several that with most images is read.
        width: Width of the images to render [pixels]; by default that of the capture.
        height: Height of the images to render [pixels]; by default that of the capture.
        near: Near plane [scene units]; a hundredth of the distance or of the object's size when None.

    Returns:
        Name and camera of each view, sorted by name. Lens distortion is ignored: the cameras are pinhole cameras with
        the same focal lengths.
    """
    root = Path(path)
    models = colmap_models(root)
    views: list[tuple[str, Camera]] = []
    if models:
        for name, lens, world_to_camera in read_colmap_views(models[0][0]):
            numbers = (lens.width, lens.height, lens.fx, lens.fy, lens.cx, lens.cy)
            intrinsics, columns, rows = resized_intrinsics(*numbers, width, height)
            camera = Camera(counted_pose(world_to_camera, origin), intrinsics, columns, rows, near)
            views.append((name, camera.to(dtype=torch.get_default_dtype())))
    else:
        for file, _ in transforms_files(root):
            data = load_transforms(file)
            for index, frame in enumerate(data["frames"]):
                name = clean_name(str(frame.get("file_path", index)))
                views.append((name, camera_of_transforms(file, data, index, width, height, near, origin)))
    if not views:
        raise ValueError(
            f"`{path}` has no cameras: give a transforms.json, a COLMAP model (cameras and images, .bin or .txt), or "
            "the folder that contains one."
        )
    return sorted(views, key=lambda view: view[0])


@dataclass(eq=False)
class CaptureCamera(CameraPath):
    """Cameras of a ``transforms.json`` or a COLMAP model: one of them, or a path through all, sorted by name.

    The files are read at the first frame; the images need not exist. Lens distortion is ignored.

    Args:
        path: A transforms.json, a COLMAP model, or a folder that contains one.
        view: Name of the view, with or without folder and extension, or its number from 0 when sorted by name; null to
            move through all views.
        seconds_per_view: Time from one view to the next [s]; the path ends at the last.
        width: Image width [pixels]; by default that of the capture.
        height: Image height [pixels]; by default that of the capture.

    Raises:
        TypeError: If an argument has the wrong type.
        ValueError: If a number is out of range; at the first frame, if the files are bad or have no such view, or if a
            path through views of different sizes has no ``width`` and ``height``.
    """

    captured = True

    path: str | Path
    view: int | str | None = None
    _: KW_ONLY
    seconds_per_view: float = 0.5
    width: int | None = None
    height: int | None = None

    @property
    def still(self) -> bool:  # type: ignore[override]
        return self.view is not None

    def __post_init__(self) -> None:
        check_positive("seconds_per_view", self.seconds_per_view)
        check_picture(self)
        self._cameras: list[Camera] = []
        self._rows: list[list[float]] = []

    def __call__(self, frame: int, time: float, center: Tensor, up: Tensor, size: float) -> Camera:
        """Camera of a frame, see :meth:`CameraPath.__call__`."""
        if not self._cameras:
            self._read(NEAR * size)
        if len(self._cameras) == 1:
            return self._cameras[0].to(center.device, center.dtype)
        times = [k * self.seconds_per_view for k in range(len(self._cameras))]
        row = torch.tensor(interpolate_keys(times, self._rows, time), dtype=torch.float64)
        eye, quat, (fx, fy, cx, cy) = row[:3], row[3:7], row[7:].tolist()
        world_to_camera = torch.eye(4, dtype=torch.float64)
        world_to_camera[:3, :3] = quat_to_rotation(quat)
        world_to_camera[:3, 3] = -world_to_camera[:3, :3] @ eye
        intrinsics = torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], dtype=torch.float64)
        first = self._cameras[0]
        camera = Camera(world_to_camera, intrinsics, first.width, first.height, first.near)
        return camera.to(center.device, center.dtype)

    def _read(self, near: float) -> None:
        views = read_views(self.path, self.width, self.height, near, self._origin)
        if self.view is not None:
            self._cameras = [views[self._index([name for name, _ in views])][1]]
            return
        cameras = [camera for _, camera in views]
        sizes = {(camera.width, camera.height) for camera in cameras}
        if len(sizes) > 1:
            raise ValueError(
                f"The views of `{self.path}` have {len(sizes)} different sizes, which one video cannot show: set both "
                "`width` and `height` of the camera."
            )
        eyes = torch.stack([camera.position for camera in cameras]).double()
        quats = rotation_to_quat(torch.stack([camera.world_to_camera[:3, :3] for camera in cameras]).double())
        for k, _ in enumerate(pairwise(cameras)):  # use the sign of the quaternion that gives the shorter way
            if float(quats[k] @ quats[k + 1]) < 0:
                quats[k + 1] = -quats[k + 1]
        lenses = torch.stack([camera.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]] for camera in cameras]).double()
        self._rows = torch.cat([eyes, quats, lenses], dim=1).tolist()
        self._cameras = cameras

    def _index(self, names: list[str]) -> int:
        if isinstance(self.view, int):
            if not 0 <= self.view < len(names):
                raise ValueError(
                    f"`{self.path}` has no view {self.view}: set `view` between 0 and {len(names) - 1}, or to a name."
                )
            return self.view
        view = str(self.view).removeprefix("./")
        for short in (lambda name: name, lambda name: Path(name).name, lambda name: Path(name).stem):
            matches = [k for k, name in enumerate(names) if short(name) == view]
            if len(matches) == 1:
                return matches[0]
        raise ValueError(
            f"`{self.path}` has no view `{view}`, or several: set `view` to one of {len(names)} names such as "
            f"{names[0]}."
        )


def photo_azimuth(eyes: Tensor, center: Tensor, rotation: Tensor) -> float | None:
    """Azimuth of the side from which photos were taken [degrees]; None if they were taken from all around.

    Args:
        eyes: Positions of the cameras [scene units], shape (C, 3).
        center: Centre of the object [scene units], shape (3,).
        rotation: Scene axes to axes with z up, float64, shape (3, 3).
    """
    away = ((eyes.double() - center.double()) @ rotation.T)[:, :2]
    mean = torch.nn.functional.normalize(away, dim=-1).mean(0)
    return math.degrees(math.atan2(float(mean[1]), float(mean[0]))) if float(mean.norm()) > 0.5 else None
