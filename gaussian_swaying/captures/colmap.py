"""Captures described by a sparse COLMAP model, binary or text."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._inputs import check_regular, decoded
from gaussian_swaying.captures.lens import NO_DISTORTION, Lens
from gaussian_swaying.captures.photos import clean_name
from gaussian_swaying.captures.point_cloud import PointCloud
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.geometry.rotations import quat_to_rotation

# name and number of parameters of each camera model, in the order of COLMAP's numbers
_MODELS = (
    ("SIMPLE_PINHOLE", 3),
    ("PINHOLE", 4),
    ("SIMPLE_RADIAL", 4),
    ("RADIAL", 5),
    ("OPENCV", 8),
    ("OPENCV_FISHEYE", 8),
    ("FULL_OPENCV", 12),
    ("FOV", 5),
    ("SIMPLE_RADIAL_FISHEYE", 4),
    ("RADIAL_FISHEYE", 5),
    ("THIN_PRISM_FISHEYE", 12),
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
)
_READABLE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def colmap_models(path: Path) -> list[tuple[Path, int]]:
    """Folders of sparse models below a capture, with their numbers of images, the largest first.

    Models are in ``sparse`` or ``colmap/sparse``, in numbered folders there, or in the folder itself.
    """
    folders = []
    for top in (path / "sparse", path / "colmap" / "sparse"):
        folders += [*sorted(top.glob("*"), key=lambda folder: (len(folder.name), folder.name)), top]
    found = [folder for folder in folders if _has(folder, "images")]
    if _has(path, "images") and _has(path, "cameras"):
        found.append(path)
    counted = [(folder, len(_read(folder, "images", _binary_images, _text_images))) for folder in found]
    return sorted(counted, key=lambda item: -item[1])


def _has(folder: Path, name: str) -> bool:
    return any((folder / f"{name}{suffix}").is_file() for suffix in (".bin", ".txt"))


def read_colmap_points(model: Path, origin: Origin = NO_ORIGIN) -> PointCloud | None:
    """Read ``points3D`` of a model.

    Returns:
        The points; None if there are none.
    """
    if not _has(model, "points3D"):
        return None
    table: np.ndarray = _read(model, "points3D", _binary_points, _text_points)
    if not np.isfinite(table).all():
        raise ValueError(f"The COLMAP model {model} has points3D that are NaN or infinite: export the model again.")
    if len(table) == 0:
        return None
    return PointCloud(torch.from_numpy(table[:, :3] - origin).float(), torch.from_numpy(table[:, 3:]).float() / 255)


def read_colmap_views(model: Path) -> list[tuple[str, Lens, Tensor]]:
    """Read only the cameras of a sparse model; the images need not exist.

    Returns:
        Name, lens and world-to-camera matrix (float64, shape (4, 4)) of each image, in the order of the file.
    """
    lenses: dict[int, Lens] = _read(model, "cameras", _binary_cameras, _text_cameras)
    rows: list[tuple[str, tuple[float, ...], int]] = _read(model, "images", _binary_images, _text_images)
    views = []
    for name, pose, camera in rows:
        where = f"The image {name} of the COLMAP model {model}"
        if camera not in lenses:
            raise ValueError(f"{where} names camera {camera}, which is not in `cameras`: export the model again.")
        views.append((clean_name(name), lenses[camera], _pose(where, pose)))
    return views


def _pose(where: str, pose: tuple[float, ...]) -> Tensor:
    if not all(map(math.isfinite, pose)) or math.hypot(*pose[:4]) < 1e-6:
        raise ValueError(f"{where} has the pose {list(pose)}, which is not rigid: export the model again.")
    found, given = torch.eye(4, dtype=torch.float64), torch.tensor(pose, dtype=torch.float64)
    found[:3, :3], found[:3, 3] = quat_to_rotation(given[:4]), given[4:]
    return found


class _UnknownLensError(Exception):
    """The file is intact, but its lens model is not supported."""


def _lens(identity: int, model: str, width: int, height: int, values: tuple[float, ...]) -> Lens:
    if model not in _READABLE:
        raise _UnknownLensError(
            f"camera {identity} has the model {model}, whose distortion is not supported (only "
            f"{', '.join(_READABLE)}): run `colmap image_undistorter` and give its output"
        )
    if len(values) != dict(_MODELS)[model]:
        raise ValueError(f"camera {identity} of model {model} has {len(values)} parameters")
    if model in ("PINHOLE", "OPENCV"):
        fx, fy, cx, cy, *rest = values
    else:
        fx, cx, cy, *rest = values
        fy = fx
    distortion = (*rest, *NO_DISTORTION)[:5]  # k1, k2, p1, p2 in this order in every model that has them
    return Lens(fx, fy, cx, cy, width, height, distortion)


def _read(model: Path, name: str, binary: Callable[[bytes], Any], text: Callable[[Iterator[str]], Any]) -> Any:
    file = model / f"{name}.bin"
    if not file.is_file():
        file = model / f"{name}.txt"
    try:
        check_regular(file, name)
        if file.suffix == ".bin":
            return binary(file.read_bytes())
        lines = decoded(file.read_bytes()).replace("\r", "\n").split("\n")
        return text(line for line in lines if line.strip() and not line.lstrip().startswith("#"))
    except OSError as error:
        raise ValueError(
            f"Cannot read {name} of the COLMAP model {model} ({error.strerror}): give cameras, images and points3D, "
            "all .bin or all .txt."
        ) from error
    except _UnknownLensError as error:
        raise ValueError(f"In the COLMAP file {file} {error}.") from error
    except (struct.error, IndexError, ValueError) as error:
        raise ValueError(f"The COLMAP file {file} is damaged ({error}): export the model again.") from error


class _Bytes:
    """Reads numbers of a little-endian binary file one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.place = data, 0

    def take(self, form: str) -> tuple[Any, ...]:
        values = struct.unpack_from("<" + form, self.data, self.place)
        self.place += struct.calcsize("<" + form)
        return values

    def word(self) -> str:
        end = self.data.index(b"\0", self.place)
        value = self.data[self.place : end].decode("utf-8")
        self.place = end + 1
        return value

    def skip(self, count: int) -> None:
        self.place += count
        if self.place > len(self.data):
            raise ValueError("it ends too early")


def _binary_cameras(data: bytes) -> dict[int, Lens]:
    source, result = _Bytes(data), {}
    for _ in range(source.take("Q")[0]):
        identity, model, width, height = source.take("iiQQ")
        if not 0 <= model < len(_MODELS):
            raise _UnknownLensError(
                f"camera {identity} has the unknown model {model} (only {', '.join(_READABLE)} are supported): run "
                "`colmap image_undistorter` and give its output"
            )
        name, count = _MODELS[model]
        result[identity] = _lens(identity, name, width, height, source.take(f"{count}d"))
    return result


def _text_cameras(lines: Iterator[str]) -> dict[int, Lens]:
    result = {}
    for words in map(str.split, lines):
        values = tuple(float(word) for word in words[4:])
        result[int(words[0])] = _lens(int(words[0]), words[1], int(words[2]), int(words[3]), values)
    return result


def _binary_images(data: bytes) -> list[tuple[str, tuple[float, ...], int]]:
    source, result = _Bytes(data), []
    for _ in range(source.take("Q")[0]):
        _identity, *pose, camera = source.take("i7di")
        result.append((source.word(), tuple(pose), camera))
        source.skip(24 * source.take("Q")[0])
    return result


def _text_images(lines: Iterator[str]) -> list[tuple[str, tuple[float, ...], int]]:
    """Lines of images; a second line with points that the image sees may be empty, and then it may be missing."""
    result = []
    image = False  # whether the line before was that of an image
    for line in lines:
        words = line.split(maxsplit=9)
        image = not (image and _sees(line))
        if image:
            if not words[9:]:
                raise ValueError(f"image {words[0]} has no name")
            result.append((words[9].rstrip(), tuple(float(word) for word in words[1:8]), int(words[8])))
    return result


def _sees(line: str) -> bool:
    words = line.split()
    try:
        return len([float(word) for word in words[:12]]) % 3 == len(words) % 3 == 0
    except ValueError:
        return False


def _binary_points(data: bytes) -> np.ndarray:
    source, result = _Bytes(data), []
    for _ in range(source.take("Q")[0]):
        _identity, x, y, z, red, green, blue, _error, seen = source.take("Q3d3BdQ")
        result.append((x, y, z, red, green, blue))
        source.skip(8 * seen)
    return np.array(result, dtype=np.float64).reshape(-1, 6)


def _text_points(lines: Iterator[str]) -> np.ndarray:
    rows = [[float(word) for word in words[1:7]] for words in map(str.split, lines)]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)
