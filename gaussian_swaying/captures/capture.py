"""Captured scenes: images with their cameras and points."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._checks import check_choice, check_whole
from gaussian_swaying.captures.agreement import TURNED_AXES, cameras_that_see
from gaussian_swaying.captures.colmap import colmap_models, read_colmap_points, read_colmap_views
from gaussian_swaying.captures.images import PosedImage, check_image_size, image_head, load_image
from gaussian_swaying.captures.lens import Lens
from gaussian_swaying.captures.photos import Photos, is_turned, photos_beside, turned_size
from gaussian_swaying.captures.point_cloud import PointCloud, read_ply_points
from gaussian_swaying.captures.transforms import read_transforms, transforms_files
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin, counted_from, origin_of
from gaussian_swaying.rendering.cameras.camera import NEAR, Camera, counted_pose

FORMATS = ("auto", "colmap", "transforms")
SPLITS = ("train", "val", "test")


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One image of a capture with the camera that took it.

    Attributes:
        name: Path of the image as written in the capture's files.
        image_path: The image on disk.
        camera: Pinhole camera of the pixels that :meth:`load` returns, float32; its near plane is at a hundredth of the
            extent of the capture.
        split: ``train``, ``val`` or ``test``.
        lens: Lens of the image on disk.
        downscale: Factor by which width and height of the undistorted image are reduced.
        turned: Whether the pixels on disk are turned as their EXIF tag says.
        mask: Picture that is black where the image is to be empty, or None.
    """

    name: str
    image_path: Path
    camera: Camera
    split: str
    lens: Lens
    downscale: int = 1
    turned: bool = False
    mask: Path | None = None

    def load(self) -> Tensor:
        """Read the pixels, undistorted and downscaled, see :func:`~gaussian_swaying.captures.images.load_image`.

        Returns:
            Dtype uint8, shape (H, W, 3), or (H, W, 4) with premultiplied alpha.
        """
        return load_image(self.image_path, self.lens, self.downscale, self.turned, self.mask)


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
        found: One line that says what was found, and what was not.
        origin: Point of the files from which places count, in float64: zero unless they are far from zero.
    """

    path: Path
    views: tuple[View, ...]
    center: Tensor
    extent: float
    points: Tensor | None = None
    colors: Tensor | None = None
    found: str = ""
    origin: Origin = NO_ORIGIN

    def split(self, name: str) -> tuple[View, ...]:
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
        path: Folder with ``sparse/0``, ``sparse`` or ``colmap/sparse/0`` (of several COLMAP models that with most
            images is read), with ``transforms.json`` or with ``transforms_train.json``; or a transforms.json itself.
        format: ``colmap``, ``transforms``, or ``auto`` for the first of these that exists.
        downscale: Factor by which width and height are reduced.
        test_every: Every n-th image, sorted by name and starting with the first, is used for testing; 0 for none. Not
            used if the capture's files define training and test images.
        images: Folder of the images of a COLMAP model.

    Raises:
        FileNotFoundError: If ``path`` does not exist.
        ValueError: If a file, a field or an image is bad, or there are no training images. The message names the
            problem and the remedy.

    Warns:
        UserWarning: Once, with what was left out, and what the files do not tell.
    """
    root = Path(path)
    check_choice("format", format, FORMATS)
    check_whole("downscale", downscale, 1)
    check_whole("test_every", test_every, 0)
    if not root.exists():
        raise FileNotFoundError(f"{root} does not exist; check the path of the capture.")
    files = _read(root, format, images)
    posed, missing = files.posed, files.missing
    if not posed:
        first = f", the first of them {missing[0]}" if missing else ""
        raise ValueError(f"{root} has no images: all {len(missing)} are missing{first}; put them beside its cameras.")
    posed.sort(key=lambda item: item.name)
    _check_once(root, posed)
    splits = _splits(root, posed, test_every)
    both = [_view(root, item, split, downscale) for item, split in zip(posed, splits, strict=True)]
    views = [view for view, _ in both]
    train = [view.camera for view in views if view.split == "train"]
    eyes = torch.stack([camera.position.double() for camera in train])
    center = eyes.mean(0)
    extent = 1.1 * float((eyes - center).norm(dim=-1).max())
    if not extent > 0:
        raise ValueError(
            f"All {len(eyes)} training cameras of {root} are at the same place, so its depth cannot be learned: "
            "add images from elsewhere, or lower `test_every` to 0."
        )
    views = [replace(view, camera=replace(view.camera, near=NEAR * extent)) for view in views]
    if files.points is not None:
        _check_sight(root, views, files.points.points, read_axes=files.source.startswith("transforms"))
    unsure = [view for view, (_, told) in zip(views, both, strict=True) if not told]
    masks = [item.mask for item in posed if item.mask is not None]
    beside = photos_beside(files.folder, [item.path for item in posed], masks)
    found = [
        f"{len(posed)} of {len(posed) + len(beside)} photos have a camera in {files.source}",
        f"{len(missing) or 'no'} cameras without a photo",
        "no points" if files.points is None else f"{len(files.points):,} points",
        f"{len(masks)} masks, in whose black parts nothing is to be" if masks else "no masks",
    ]
    if any(view.turned for view in views):
        found.append(f"{sum(view.turned for view in views)} photos turned as their EXIF tags say")
    if any(files.origin):
        found.append(counted_from(files.origin))
    lacks = []
    if missing:
        lacks.append(
            f"left out {len(missing)} of {len(missing) + len(posed)} cameras that have no photo on disk, the first of "
            f"them that of {missing[0]}"
        )
    if beside:
        lacks.append(
            f"left out {len(beside)} of {len(beside) + len(posed)} photos on disk that have no camera in {files.source}"
            f", the first of them {beside[0]}: find their cameras, or remove them"
        )
    if unsure:
        lacks.append(
            f"{len(unsure)} photos have an EXIF tag that turns them, the first of them {unsure[0].image_path}, "
            "and nothing tells whether their cameras know: they are read as they are stored; turn their pixels, or "
            "remove the tag"
        )
    if not masks and (files.folder / "masks").is_dir():
        lacks.append(f"not used are the masks in {files.folder / 'masks'}: name them in a transforms.json, `mask_path`")
    if files.points is None and axes_meet_behind(train):
        lacks.append(f"the optical axes meet behind the cameras: {TURNED_AXES}")
    if lacks:
        warnings.warn(f"{root}: {'; '.join(lacks)}.", UserWarning, stacklevel=2)
    points, colors = (None, None) if files.points is None else (files.points.points, files.points.colors)
    return Capture(
        root, tuple(views), center.float(), extent, points, colors, f"{root}: {'; '.join(found)}.", files.origin
    )


@dataclass(frozen=True, eq=False)
class _Files:
    """What the files of a capture say; ``missing`` are the names of photos that do not exist."""

    posed: list[PosedImage]
    missing: list[str]
    points: PointCloud | None
    folder: Path
    source: str
    origin: Origin


def _read(root: Path, format: str, images: str) -> _Files:
    models = colmap_models(root) if format != "transforms" and root.is_dir() else []
    if models:
        folders = [folder for folder in sorted(root.iterdir()) if folder.is_dir()]
        alike = (folder for folder in folders if folder.name.casefold() == images.casefold())
        folder = root / images if (root / images).is_dir() else next(alike, None)
        if folder is None:
            raise ValueError(
                f"{root} has no folder {images}/ with the images of its COLMAP model: set `images` to one of "
                f"{', '.join(f.name for f in folders)}."
            )
        model, photos = models[0][0], Photos(folder)
        named = [(photos.find(name), name, lens, pose) for name, lens, pose in read_colmap_views(model)]
        (source, count), *less = ((f"the COLMAP model {os.path.relpath(path, root)}", count) for path, count in models)
        if less:
            source += f" with {count} images ({', '.join(f'{other} has {count}' for other, count in less)})"
        posed = [PosedImage(name, path, lens, pose) for path, name, lens, pose in named if path is not None]
        missing = [name for path, name, _, _ in named if path is None]
        posed, origin = _counted(posed)
        return _Files(posed, missing, read_colmap_points(model, origin), folder.parent, source, origin)
    if format != "colmap" and transforms_files(root):
        posed, missing, file = read_transforms(root)
        source = " and ".join(file.name for file, _ in transforms_files(root))
        posed, origin = _counted(posed)
        points = None if file is None else read_ply_points(file, origin)
        return _Files(posed, missing, points, root if root.is_dir() else root.parent, source, origin)
    wanted = {"colmap": "sparse/0 or sparse", "transforms": "transforms.json or transforms_train.json"}
    names = " or ".join(wanted.values()) if format == "auto" else wanted[format]
    raise ValueError(f"{root} is not a capture: it has no {names}; give the folder that contains it.")


def _counted(posed: list[PosedImage]) -> tuple[list[PosedImage], Origin]:
    poses = [item.world_to_camera for item in posed]
    origin = origin_of(np.array([(-pose[:3, :3].T @ pose[:3, 3]).tolist() for pose in poses]).reshape(-1, 3))
    return [replace(item, world_to_camera=counted_pose(item.world_to_camera, origin)) for item in posed], origin


def _check_once(root: Path, posed: Sequence[PosedImage]) -> None:
    first: dict[Path, PosedImage] = {}
    for item in posed:
        other = first.setdefault(item.path, item)
        if not torch.allclose(item.world_to_camera, other.world_to_camera):
            raise ValueError(
                f"The cameras of {other.name} and {item.name} of {root} have the same photo {item.path}: correct the "
                "names, or restore the photo that is missing."
            )


def _check_sight(root: Path, views: Sequence[View], points: Tensor, read_axes: bool) -> None:
    seen, turned = cameras_that_see(points, [view.camera for view in views])
    if 2 * seen < len(views):
        cause = "they are not of the same reconstruction as the points: export both again, or remove the points"
        raise ValueError(
            f"Only {seen} of {len(views)} cameras of {root} see any of its points: "
            f"{TURNED_AXES if read_axes and 2 * turned >= len(views) else cause}."
        )


def nearest_to_axes(cameras: Sequence[Camera]) -> Tensor:
    """The point closest to all optical axes, by least squares.

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


def axes_meet_behind(cameras: Sequence[Camera]) -> bool:
    """True if all optical axes meet in one point behind the cameras."""
    focus = nearest_to_axes(cameras)
    local = [camera.world_to_camera[:3].double() @ torch.cat([focus, focus.new_ones(1)]) for camera in cameras]
    return all(bool(place[:2].norm() < -0.1 * place[2]) for place in local)


def common_focus(cameras: Sequence[Camera]) -> Tensor | None:
    """The point nearest to all optical axes, if it is in front of most cameras.

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
    if any(item.split is not None for item in posed):
        splits = [item.split or "train" for item in posed]
        remedy = "add images to its train split"
    else:
        splits = ["test" if test_every and index % test_every == 0 else "train" for index in range(len(posed))]
        remedy = "raise `test_every`, or set it to 0 to test on no image"
    if "train" not in splits:
        raise ValueError(f"The train split of {root} is empty, all {len(posed)} images are for testing: {remedy}.")
    return splits


def _view(root: Path, item: PosedImage, split: str, downscale: int) -> tuple[View, bool]:
    """Check the size of an image on disk against its lens, and make the downscaled view.

    Returns:
        The view, and whether it is known if its pixels have to be turned.
    """
    path, lens, factor = item.path, item.lens, downscale
    small = _made_smaller(root, path, downscale) if downscale > 1 else None
    width, height = (lens.width, lens.height) if small is None else (lens.width / downscale, lens.height / downscale)
    size, orientation = image_head(small or path)
    turned = is_turned(size, orientation, (width, height))
    size = turned_size(size, orientation) if turned else size
    if small is not None:
        if max(abs(size[0] - width), abs(size[1] - height)) >= 1:
            raise ValueError(
                f"The image {small} has {size[0]} x {size[1]} pixels, but {downscale} times smaller than its camera is "
                f"{width:g} x {height:g}: remove the folder, or make it again."
            )
        path, lens, factor = small, lens.resized(*size), 1
    else:
        check_image_size(path, size, lens)
    try:
        seen = lens.undistorted().averaged(factor)
    except ValueError as error:
        raise ValueError(f"The image {path} of {root}: {error}") from error
    if item.mask is not None:
        image_head(item.mask)
    world_to_camera = item.world_to_camera.float()
    camera = Camera(world_to_camera, seen.intrinsics().float(), seen.width, seen.height)
    return View(item.name, path, camera, split, lens, factor, bool(turned), item.mask), turned is not None


def _made_smaller(root: Path, path: Path, downscale: int) -> Path | None:
    top = root if root.is_dir() else root.parent
    parts = path.relative_to(top).parts if path.is_relative_to(top) else ()
    return Photos(top / f"{parts[0]}_{downscale}").find("/".join(parts[1:])) if len(parts) > 1 else None


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
