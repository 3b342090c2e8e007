"""Videos with known cameras: a folder with ``transforms.json`` whose frames have times."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._inputs import check_regular
from gaussian_swaying.captures.images import load_image, read_image
from gaussian_swaying.captures.transforms import read_transforms, transforms_files
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.cameras.transforms_json import camera_of_transforms, load_transforms, read_number

MOST_FRAMES = 100_000


@dataclass(frozen=True, eq=False)
class Footage:
    """The video of one camera.

    Attributes:
        name: Name of the camera.
        times: Time of each frame since the motion began [s], ascending.
        cameras: The camera of each frame; the same one for a tripod.
        images: Frames, dtype uint8, shape (F, H, W, 3).
        masks: Opacity of the object in each frame, dtype uint8, shape (F, H, W); None if it is not known.
    """

    name: str
    times: tuple[float, ...]
    cameras: tuple[Camera, ...]
    images: Tensor
    masks: Tensor | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height [pixels]."""
        return self.images.shape[2], self.images.shape[1]


@dataclass
class _Shot:
    """One frame while it is read."""

    time: float
    camera: Camera
    image: Tensor
    mask: Tensor | None


def read_videos(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]], cameras: Sequence[str] | None = None
) -> list[Footage]:
    """Read the videos of one motion.

    Each folder has a ``transforms.json`` as of Nerfstudio. A frame has ``file_path``, ``transform_matrix``, ``time``
    [s] and, with several cameras, ``camera``, a name or a number; a transparent image or ``mask_path`` gives the
    silhouette. An entry with ``video_path`` instead of ``file_path`` is a whole video of a camera that stands still:
    ``time`` is then that of its first frame, and ``fps`` replaces the frame rate of the file.

    Args:
        paths: A folder or a transforms.json, or several. Their times belong to the same clock.
        cameras: Names of the cameras that are wanted; None for all.

    Returns:
        One for each camera, sorted by name. The earliest frame is at time zero.

    Raises:
        FileNotFoundError: If a path does not exist.
        ValueError: If a file or a field is bad; the message names it and the remedy.
    """
    several = [paths] if isinstance(paths, str | os.PathLike) else list(paths)
    if not several:
        raise ValueError("Expected `videos` to name a folder with transforms.json.")
    shots: dict[str, list[_Shot]] = {}
    for number, path in enumerate(map(Path, several)):
        found = _read(path)
        for name, own in found.items():
            shots.setdefault(name if len(several) == 1 or name not in shots else f"{number}-{name}", []).extend(own)
    begin = min(shot.time for own in shots.values() for shot in own)
    for name in cameras or ():
        if name not in shots:
            raise ValueError(f"There is no camera {name!r} in `videos`: `cameras` may be {', '.join(sorted(shots))}.")
    return [_footage(name, shots[name], begin) for name in sorted(cameras or shots)]


def frame_times(videos: Sequence[Footage]) -> list[float]:
    """All times at which a camera took a frame [s], ascending; times closer than a microsecond are one."""
    found: list[float] = []
    for time in sorted({time for video in videos for time in video.times}):
        if not found or time - found[-1] > 1e-6:
            found.append(time)
    return found


def _footage(name: str, shots: list[_Shot], begin: float) -> Footage:
    shots = sorted(shots, key=lambda shot: shot.time)
    times = [shot.time - begin for shot in shots]
    for before, after in pairwise(times):
        if after - before < 1e-6:
            raise ValueError(
                f"The camera {name!r} has two frames at {after + begin:g} s: give every camera its own `camera` in "
                "transforms.json, and every frame its `time`."
            )
    sizes = {tuple(shot.image.shape[:2]) for shot in shots}
    if len(sizes) > 1:
        raise ValueError(f"The frames of camera {name!r} have different sizes: {sorted(sizes)}; make them equal.")
    if len(shots) < 3:
        raise ValueError(f"The camera {name!r} has {len(shots)} frames: a motion needs three or more.")
    masks = [shot.mask for shot in shots]
    known = None if any(mask is None for mask in masks) else torch.stack([mask for mask in masks if mask is not None])
    images = torch.stack([shot.image for shot in shots])
    return Footage(name, tuple(times), tuple(shot.camera for shot in shots), images, known)


def _read(path: Path) -> dict[str, list[_Shot]]:
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: set `videos` to a folder with transforms.json.")
    files = transforms_files(path)
    if not files:
        raise ValueError(f"{path} has no transforms.json: write one with the cameras and times of the frames.")
    shots: dict[str, list[_Shot]] = {}
    for file, _ in files:
        data, where = load_transforms(file), f"`{file}`"
        frames = data["frames"]
        films = [k for k, frame in enumerate(frames) if "video_path" in frame]
        for k in films:
            shots.setdefault(_camera_name(frames[k]), []).extend(_film(file, where, data, k))
        if len(films) == len(frames):
            continue
        posed = {item.name: item for item in read_transforms(file)[0]}
        for k, frame in enumerate(frames):
            name = str(frame.get("file_path", "")).replace("\\", "/").removeprefix("./")
            if "video_path" in frame or name not in posed:
                continue
            item = posed[name]
            time = read_number(where, frame, "time")
            if time is None:
                raise ValueError(f"The field `frames[{k}].time` of the camera file {where} is missing: add it [s].")
            lens = item.lens.undistorted()
            camera = Camera(item.world_to_camera.float(), lens.intrinsics().float(), lens.width, lens.height)
            pixels = load_image(item.path, item.lens)
            mask = pixels[..., 3].clone() if pixels.shape[-1] == 4 else None
            if isinstance(frame.get("mask_path"), str):
                mask = read_image(file.parent / frame["mask_path"])[..., 0].clone()
                if mask.shape != pixels.shape[:2]:
                    raise ValueError(f"The mask {frame['mask_path']} of {where} is not as large as its frame.")
            shots.setdefault(_camera_name(frame), []).append(_Shot(time, camera, pixels[..., :3].contiguous(), mask))
    if not shots:
        raise ValueError(f"{path} has no frames on disk: put the images of its transforms.json beside it.")
    return shots


def _camera_name(frame: dict[str, Any]) -> str:
    return str(frame.get("camera", frame.get("camera_name", "0")))


def _film(file: Path, where: str, data: dict[str, Any], index: int) -> list[_Shot]:
    """The frames of a video file."""
    import imageio.v3 as iio

    entry = data["frames"][index]
    path = check_regular(file.parent / str(entry["video_path"]), "the video")
    camera = camera_of_transforms(file, data, index)
    fps, begin = read_number(where, entry, "fps"), read_number(where, entry, "time") or 0.0
    try:
        rate = fps or float(iio.immeta(path, plugin="FFMPEG")["fps"])
        pictures = [torch.from_numpy(picture[..., :3].copy()) for picture in iio.imiter(path, plugin="FFMPEG")]
    except Exception as error:  # ffmpeg's errors are of many kinds
        raise ValueError(
            f"The video {path} cannot be read ({str(error).splitlines()[0]}): convert it to mp4."
        ) from error
    if not pictures or tuple(pictures[0].shape[:2]) != (camera.height, camera.width):
        raise ValueError(f"The video {path} is not {camera.width} x {camera.height} as its camera in {where} says.")
    return [_Shot(begin + k / rate, camera, picture, None) for k, picture in enumerate(pictures[:MOST_FRAMES])]


__all__ = ["Footage", "frame_times", "read_videos"]
