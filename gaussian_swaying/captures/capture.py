"""Captured scenes: images with their cameras and points."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_whole
from gaussian_swaying.captures.colmap import colmap_model, read_colmap
from gaussian_swaying.captures.images import PosedImage, check_image_size, image_size, load_image
from gaussian_swaying.captures.lens import Lens
from gaussian_swaying.captures.point_cloud import read_ply_points
from gaussian_swaying.captures.transforms import find_image, read_transforms, transforms_files
from gaussian_swaying.rendering.cameras.camera import Camera

FORMATS = ("auto", "colmap", "transforms")
SPLITS = ("train", "val", "test")


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One image of a capture with the camera that took it.

    Attributes:
        name: Path of the image as written in the capture's files.
        image_path: The image on disk.
        camera: Pinhole camera of the pixels that :meth:`load` returns, float32.
        split: ``train``, ``val`` or ``test``.
        lens: Lens of the image on disk.
        downscale: Factor by which width and height of the undistorted image are reduced.
    """

    name: str
    image_path: Path
    camera: Camera
    split: str
    lens: Lens
    downscale: int = 1

    def load(self) -> Tensor:
        """Read the pixels, undistorted and downscaled, see :func:`~gaussian_swaying.captures.images.load_image`.

        Returns:
            Dtype uint8, shape (H, W, 3), or (H, W, 4) with premultiplied alpha.
        """
        return load_image(self.image_path, self.lens, self.downscale)


@dataclass(frozen=True, slots=True, eq=False)
class Capture:
    """A captured scene, without pixels in memory.

    Attributes:
        path: The folder or file that it was read from.
        views: Its views, sorted by name.
        center: Mean position of the training cameras [scene units], float32, shape (3,).
        extent: 1.1 times the largest distance of a training camera from ``center`` [scene units]. Learning rates and
            thresholds of 3DGS scale with it.
        points: Points of the capture [scene units], float32, shape (P, 3), or None.
        colors: Their colours in 0 to 1, float32, shape (P, 3), or None.
    """

    path: Path
    views: tuple[View, ...]
    center: Tensor
    extent: float
    points: Tensor | None = None
    colors: Tensor | None = None

    def split(self, name: str) -> tuple[View, ...]:
        """Views of ``train``, ``val`` or ``test``, sorted by name."""
        check_choice("name", name, SPLITS)
        return tuple(view for view in self.views if view.split == name)


def read_capture(
    path: str | os.PathLike[str],
    format: str = "auto",
    *,
    downscale: int = 1,
    test_every: int = 8,
    images: str = "images",
) -> Capture:
    """Read the cameras of a capture and check that its images exist and have the right size.

    Lens distortion is removed: the cameras are the pinhole cameras of the undistorted, cropped images. If there is a
    folder ``images_2``, ``images_4`` ... of the wanted size beside the images, it is read instead.

    Args:
        path: Folder with ``sparse/0`` or ``sparse`` (COLMAP), with ``transforms.json`` or with
            ``transforms_train.json``; or a transforms.json itself.
        format: ``colmap``, ``transforms``, or ``auto`` for the first of these that exists.
        downscale: Factor by which width and height are reduced.
        test_every: Every n-th image, sorted by name and starting with the first, is used for testing; 0 for none. Not
            used if the capture's files define training and test images.
        images: Folder of the images of a COLMAP model.

    Returns:
        The capture.

    Raises:
        FileNotFoundError: If ``path`` does not exist.
        ValueError: If a file, a field or an image is bad, or there are no training images. The message names the
            problem and the remedy.

    Warns:
        UserWarning: Once, with the number of frames left out because they have no image.
    """
    root = Path(path)
    check_choice("format", format, FORMATS)
    check_whole("downscale", downscale, 1)
    check_whole("test_every", test_every, 0)
    if not root.exists():
        raise FileNotFoundError(f"{root} does not exist; check the path of the capture.")
    model = colmap_model(root) if format != "transforms" and root.is_dir() else None
    points: Tensor | None = None
    colors: Tensor | None = None
    if model is not None:
        folder = root / images
        if not folder.is_dir():
            raise ValueError(f"{root} has no folder {images}/ with the images of its COLMAP model: set `images`.")
        posed, missing, cloud = read_colmap(model, folder)
        points, colors = (None, None) if cloud is None else cloud
    elif format != "colmap" and transforms_files(root):
        folder = root if root.is_dir() else root.parent
        posed, missing, file = read_transforms(root)
        if file is not None:
            cloud_of_file, _ = read_ply_points(file)
            points, colors = cloud_of_file.points, cloud_of_file.colors
    else:
        wanted = {"colmap": "sparse/0 or sparse", "transforms": "transforms.json or transforms_train.json"}
        names = " or ".join(wanted.values()) if format == "auto" else wanted[format]
        raise ValueError(f"{root} is not a capture: it has no {names}; give the folder that contains it.")
    if not posed:
        first = f", the first of them {missing[0]}" if missing else ""
        raise ValueError(f"{root} has no images: all {len(missing)} are missing{first}; put them beside its cameras.")
    posed = sorted(posed, key=lambda item: item.name)
    splits = _splits(root, posed, test_every)
    views = tuple(_view(root, item, split, downscale) for item, split in zip(posed, splits, strict=True))
    eyes = torch.stack([view.camera.position.double() for view in views if view.split == "train"])
    center = eyes.mean(0)
    extent = 1.1 * float((eyes - center).norm(dim=-1).max())
    if not extent > 0:
        raise ValueError(
            f"All {len(eyes)} training cameras of {root} are at the same place, so its depth cannot be learned: "
            "add images from elsewhere, or lower `test_every` to 0."
        )
    if missing:
        warnings.warn(
            f"{root}: left out {len(missing)} of {len(missing) + len(posed)} frames that have no image, the first of "
            f"them {missing[0]}.",
            UserWarning,
            stacklevel=2,
        )
    return Capture(root, views, center.float(), extent, points, colors)


def nearest_to_axes(cameras: Sequence[Camera]) -> Tensor:
    """The point with the smallest sum of squared distances to all optical axes.

    Args:
        cameras: At least one camera.

    Returns:
        The point [scene units], float64, shape (3,); NaN if the axes are parallel.
    """
    axes = torch.stack([camera.world_to_camera[2, :3].double() for camera in cameras])
    eyes = torch.stack([camera.position.double() for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - axes[:, :, None] * axes[:, None, :]
    matrix = across.sum(0)
    if float(torch.linalg.eigvalsh(matrix)[0]) < 1e-6 * len(cameras):
        return torch.full((3,), float("nan"), dtype=torch.float64)
    return torch.linalg.solve(matrix, (across @ eyes[..., None]).sum(0)[:, 0])


def common_focus(cameras: Sequence[Camera]) -> Tensor | None:
    """The point nearest to all optical axes, if it is in front of most cameras.

    Args:
        cameras: At least one camera.

    Returns:
        The point [scene units], float64, shape (3,); None if they look at no common point.
    """
    focus = nearest_to_axes(cameras)
    if not bool(torch.isfinite(focus).all()):
        return None
    depths = [c.world_to_camera[2, :3].double() @ focus + c.world_to_camera[2, 3].double() for c in cameras]
    return focus if 2 * sum(bool(depth > 0) for depth in depths) > len(cameras) else None


def view_reach(cameras: Sequence[Camera], focus: Tensor) -> float:
    """Return how far to the side of a point (3,) the median camera sees [scene units]."""
    reach = []
    for camera in cameras:
        distance = math.dist(camera.position.tolist(), focus.tolist())
        across = 0.5 * camera.width / float(camera.intrinsics[0, 0])
        upward = 0.5 * camera.height / float(camera.intrinsics[1, 1])
        reach.append(distance * max(across, upward))
    return sorted(reach)[len(reach) // 2]


def _splits(root: Path, posed: list[PosedImage], test_every: int) -> list[str]:
    """Split of each image; images without a split in the files are for training."""
    if any(item.split is not None for item in posed):
        splits = [item.split or "train" for item in posed]
        remedy = "add images to its train split"
    else:
        splits = ["test" if test_every and index % test_every == 0 else "train" for index in range(len(posed))]
        remedy = "raise `test_every`, or set it to 0 to test on no image"
    if "train" not in splits:
        raise ValueError(f"The train split of {root} is empty, all {len(posed)} images are for testing: {remedy}.")
    return splits


def _view(root: Path, item: PosedImage, split: str, downscale: int) -> View:
    """Check the size of an image on disk against its lens, and make the downscaled view."""
    path, lens, factor = item.path, item.lens, downscale
    small = _made_smaller(root, path, downscale) if downscale > 1 else None
    if small is not None:
        width, height = image_size(small)
        if max(abs(width - lens.width / downscale), abs(height - lens.height / downscale)) >= 1:
            raise ValueError(
                f"The image {small} has {width} x {height} pixels, but {downscale} times smaller than its camera is "
                f"{lens.width / downscale:g} x {lens.height / downscale:g}: remove the folder, or make it again."
            )
        path, lens, factor = small, lens.resized(width, height), 1
    else:
        check_image_size(path, image_size(path), lens)
    try:
        seen = lens.undistorted().averaged(factor)
    except ValueError as error:
        raise ValueError(f"The image {path} of {root}: {error}") from error
    world_to_camera = item.world_to_camera.float()
    camera = Camera(world_to_camera, seen.intrinsics().float(), seen.width, seen.height)
    return View(item.name, path, camera, split, lens, factor)


def _made_smaller(root: Path, path: Path, downscale: int) -> Path | None:
    """The same image in the folder ``<folder>_<downscale>`` beside the folder of the images, or None."""
    top = root if root.is_dir() else root.parent
    try:
        parts = path.relative_to(top).parts
    except ValueError:
        return None
    if len(parts) < 2:
        return None
    return find_image(top / f"{parts[0]}_{downscale}", "/".join(parts[1:]))


_BEST = math.radians(5.0)
_BELOW, _ABOVE = math.radians(1.0), math.radians(10.0)


def view_angles(cameras: Sequence[Camera]) -> Tensor:
    """Angles between the optical axes of cameras [rad], float64, shape (V, V)."""
    axis = torch.stack([camera.world_to_camera[2, :3].detach().cpu().double() for camera in cameras])
    axis = torch.nn.functional.normalize(axis, dim=-1)
    return (axis @ axis.T).clamp(-1.0, 1.0).acos()


def neighbouring_views(cameras: Sequence[Camera], count: int = 8, largest_angle: float = 30.0) -> list[list[int]]:
    r"""For each view those that show the same place well, the best first.

    Views are ranked by the angle :math:`\theta` between optical axes,
    :math:`e^{-(\theta - \theta_0)^2 / 2 \sigma^2}` with :math:`\theta_0` = 5 degrees and :math:`\sigma` = 1 below and
    10 degrees above it (Yao et al. 2018, "MVSNet", section 4.1): a smaller angle tells little about depth, and at a
    larger one the picture looks different. A view from the same place tells nothing of depth and is left out.

    Args:
        cameras: The cameras of a capture, on any device.
        count: Most views for each.
        largest_angle: Largest angle between the axes of two views [degrees].

    Returns:
        Lists of indices, one for each camera; empty where no view is close enough.
    """
    if not cameras:
        return []
    angle = view_angles(cameras)
    eye = torch.stack([camera.position.detach().cpu().double() for camera in cameras])
    apart = torch.cdist(eye, eye)
    spread = torch.where(angle < _BEST, _BELOW, _ABOVE)
    score = -((angle - _BEST) / spread).square()
    near = (angle <= math.radians(largest_angle)) & (apart > 1e-6 * apart.max())
    near.fill_diagonal_(False)
    order = torch.where(near, score, -math.inf).argsort(dim=1, descending=True, stable=True)
    return [
        [int(other) for other in row[: min(count, int(number))]] for row, number in zip(order, near.sum(1), strict=True)
    ]
