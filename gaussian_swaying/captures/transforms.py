"""Captures described by ``transforms.json``: NeRF and Blender, instant-ngp, Nerfstudio, BlenderNeRF."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from gaussian_swaying.captures.images import PosedImage, image_size
from gaussian_swaying.captures.lens import Lens
from gaussian_swaying.captures.photos import Photos, clean_name
from gaussian_swaying.rendering.cameras.transforms_json import load_transforms, read_intrinsics, read_number, read_pose

_SPLITS = ("train", "val", "test")
_PINHOLE_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE")
_OTHER_COEFFICIENTS = ("k4", "k5", "k6", "s1", "s2", "s3", "s4")


def transforms_files(path: Path) -> list[tuple[Path, str | None]]:
    """The camera files of a capture with the split of each, or an empty list if there are none.

    Args:
        path: A folder with ``transforms.json`` or ``transforms_{train,val,test}.json``, or one such file.
    """
    if path.suffix == ".json":
        return [(path, None)]
    single = path / "transforms.json"
    if single.is_file():
        return [(single, None)]
    files: list[tuple[Path, str | None]] = [(path / f"transforms_{split}.json", split) for split in _SPLITS]
    return [(file, split) for file, split in files if file.is_file()]


def read_transforms(path: Path) -> tuple[list[PosedImage], list[str], Path | None]:
    """Read the cameras of a capture in the style of NeRF, Blender, instant-ngp or Nerfstudio.

    Intrinsics come from the frame or from the top of the file, as in
    :func:`~gaussian_swaying.rendering.cameras.transforms_json.camera_of_transforms`; if ``w`` and ``h`` are missing,
    the size of the image is used. ``file_path`` may have no extension. Distortion is ``k1``, ``k2``, ``k3``, ``p1`` and
    ``p2``. ``mask_path`` names the mask of an image. The splits come from one file per split, or from the lists
    ``train_filenames``, ``val_filenames`` and ``test_filenames``.

    Args:
        path: Folder or file, see :func:`transforms_files`.

    Returns:
        The images that exist, the names of those that do not, and a point cloud that belongs to the capture or None.
    """
    images: list[PosedImage] = []
    missing: list[str] = []
    points: Path | None = None
    for file, split in transforms_files(path):
        data, where = load_transforms(file), f"`{file}`"
        listed, photos = _listed_splits(where, data), Photos(file.parent)
        for index, frame in enumerate(data["frames"]):
            if "video_path" in frame:  # a film, see inverse.videos
                continue
            name = _file_path(where, index, frame)
            pose = read_pose(where, data, index)
            check_rigid(f"The field `frames[{index}].transform_matrix` of the camera file {where}", pose)
            image = photos.find(name)
            if image is None:
                missing.append(name)
                continue
            lens = lens_of_transforms(where, data, frame, image_size(image))
            own = split if listed is None else listed.get(name)
            mask = None if frame.get("mask_path") is None else _file_path(where, index, frame, "mask_path")
            cover = None if mask is None else photos.find(mask) or file.parent / mask
            images.append(PosedImage(name, image, lens, torch.linalg.inv(pose), own, cover))
        for candidate in (data.get("ply_file_path"), "points3d.ply"):
            if points is None and isinstance(candidate, str) and (file.parent / candidate).is_file():
                points = file.parent / candidate
    return images, missing, points


def _merged(data: dict[str, object], frame: dict[str, object]) -> dict[str, object]:
    hidden: set[str] = set()
    for axis, other in ("xy", "yx"):
        if f"fl_{axis}" in frame or f"camera_angle_{axis}" in frame:
            hidden |= {f"fl_{axis}", f"camera_angle_{axis}"}
        if f"camera_angle_{axis}" in frame:  # a zoom: pixels stay square unless the frame says otherwise
            hidden |= {f"fl_{other}", f"camera_angle_{other}"}
    return {name: value for name, value in data.items() if name not in hidden} | frame


def check_rigid(what: str, pose: torch.Tensor) -> None:
    """Raise ValueError unless a matrix (4, 4) is a rigid motion; ``what`` is the subject of the message."""
    rotation, row = pose[:3, :3], pose.new_tensor([0.0, 0.0, 0.0, 1.0])
    error = max(
        float((rotation @ rotation.T - torch.eye(3, dtype=pose.dtype)).abs().max()), float((pose[3] - row).abs().max())
    )
    if not error <= 1e-3:
        raise ValueError(
            f"{what} is not rigid (off by {error:.3g} from a rotation and a shift): apply the scale of the camera and "
            "export it again."
        )
    if float(torch.linalg.det(rotation)) < 0:
        raise ValueError(f"{what} is a reflection: make the axes of the camera right-handed and export it again.")


def _file_path(where: str, index: int, frame: dict[str, Any], field: str = "file_path") -> str:
    value = frame.get(field)
    if not isinstance(value, str) or not value:
        raise ValueError(
            f"The field `frames[{index}].{field}` of the camera file {where} is {value!r}: set it to an image."
        )
    return clean_name(value)


def _listed_splits(where: str, data: dict[str, Any]) -> dict[str, str] | None:
    result: dict[str, str] = {}
    for split in _SPLITS:
        names = data.get(f"{split}_filenames")
        if names is None:
            continue
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise ValueError(f"The field `{split}_filenames` of the camera file {where} must be a list of file paths.")
        result |= {clean_name(name): split for name in names}
    return result or None


def lens_of_transforms(where: str, data: dict[str, Any], frame: dict[str, Any], size: tuple[int, int]) -> Lens:
    """The lens of a frame.

    Args:
        size: Width and height of the pictures, if the file does not say them [pixels].
    """
    fields = _merged(data, frame)
    model = "a fisheye lens" if fields.get("is_fisheye") else fields.get("camera_model", "OPENCV")
    if model not in _PINHOLE_MODELS:
        raise ValueError(
            f"The camera file {where} asks for {model} (`camera_model`, `is_fisheye`): only "
            f"{', '.join(_PINHOLE_MODELS)} are supported; undistort the images with the tool that found the cameras."
        )
    for name in _OTHER_COEFFICIENTS:
        if read_number(where, fields, name):
            raise ValueError(
                f"The field `{name}` of the camera file {where} is not 0: only k1, k2, k3, p1 and p2 are "
                "supported; undistort the images first."
            )
    width, height = size
    given = {name: value for name, value in fields.items() if value is not None}
    w, h, fx, fy, cx, cy = read_intrinsics(where, {"w": width, "h": height, **given}, None, None)
    distortion = tuple(read_number(where, fields, name) or 0.0 for name in ("k1", "k2", "p1", "p2", "k3"))
    return Lens(fx, fy, cx, cy, round(w), round(h), distortion)
