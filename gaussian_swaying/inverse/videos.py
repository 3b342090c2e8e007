"""Videos with known cameras: a folder with ``transforms.json`` whose frames have times."""

from __future__ import annotations

import logging
import math
import os
from bisect import bisect_left
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from fractions import Fraction
from functools import partial
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._inputs import check_regular
from gaussian_swaying.captures.images import PosedImage, image_head, load_image, remapped
from gaussian_swaying.captures.lens import Lens
from gaussian_swaying.captures.photos import clean_name, is_turned
from gaussian_swaying.captures.transforms import check_rigid, lens_of_transforms, read_transforms, transforms_files
from gaussian_swaying.geometry.origin import NO_ORIGIN, Origin
from gaussian_swaying.rendering.cameras.camera import NEAR, Camera, counted_pose
from gaussian_swaying.rendering.cameras.transforms_json import load_transforms, read_number, read_pose

MOST_BYTES = 2 << 30  # of the pixels of all videos of a fit: 345 frames of 1920 x 1080
CLOSE = 2e-6  # times of frames of several cameras that are the same [s]
NARROWEST = 16  # fewest pixels of a frame of a film on its shorter side
MOST_PIXELS = 40_000_000  # most pixels of a frame of a film; 8K has 33 million. ffmpeg itself refuses larger ones


@dataclass(frozen=True, eq=False)
class Footage:
    """The video of one camera: times [s], ascending, cameras, and frames, dtype uint8, shape (F, H, W, 3)."""

    name: str
    times: tuple[float, ...]
    cameras: tuple[Camera, ...]
    images: Tensor

    @property
    def size(self) -> tuple[int, int]:
        return self.images.shape[2], self.images.shape[1]

    def frame_at(self, time: float) -> int | None:
        """The frame that was taken at a time [s], to two microseconds; None if there is none."""
        found = bisect_left(self.times, time - CLOSE)
        return found if found < len(self.times) and self.times[found] < time + CLOSE else None


def _take(room: list[int], path: Path, width: int, height: int, frames: int = 1) -> None:
    """Take frames of a file off the bytes that may still be decoded."""
    room[0] -= frames * 3 * width * height
    if room[0] < 0:
        raise ValueError(
            f"The videos have more than {MOST_BYTES / 2**30:g} GiB of pixels together ({path}, {width} x {height}): "
            "cut them to the motion that is fitted and predicted, make them smaller, or choose `cameras`."
        )


Shots = tuple[Tensor, Lens, list[Tensor], float]  # pose, lens without distortion, pictures, and their rate [1/s]


def read_videos(
    paths: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    cameras: Sequence[str] | None = None,
    size: float = 1.0,
    origin: Origin = NO_ORIGIN,
) -> list[Footage]:
    """Read the videos of one motion, one for each camera, sorted by name. The earliest frame is at time zero.

    Args:
        paths: A folder or a transforms.json, or several, of one clock; docs/fit.md describes them.
        cameras: Names of the cameras that are wanted, and decoded; None for all.
        size: Size of what they show [scene units], which the near plane of the cameras follows.
        origin: Point of the files from which the places of the splat count.
    """
    parts: dict[str, list[tuple[float, Callable[[list[int]], Shots] | Path]]] = {}  # a path is a missing picture
    owners: dict[str, int] = {}
    for number, path in enumerate([paths] if isinstance(paths, str | os.PathLike) else paths):
        for name, time, part in _read(Path(path)):
            own = name if owners.setdefault(name, number) == number else f"{number}-{name}"
            parts.setdefault(own, []).append((time, part))
    begin = min(time for own in parts.values() for time, _ in own)
    for name in cameras or ():
        if name not in parts:
            raise ValueError(f"There is no camera {name!r} in `videos`: `cameras` may be {', '.join(sorted(parts))}.")
    wanted = {name: parts[name] for name in sorted(cameras or parts)}
    lost = [part for own in wanted.values() for _, part in own if isinstance(part, Path)]
    if lost:
        raise ValueError(
            f"{len(lost)} of the pictures of `videos` do not exist, the first of them {lost[0]}: put them there, or "
            "remove their frames from transforms.json."
        )
    room, found = [MOST_BYTES], []
    for name, own_parts in wanted.items():
        shots: list[tuple[float, Camera, Tensor]] = []
        for time, part in own_parts:
            assert not isinstance(part, Path)
            view, lens, images, rate = part(room)
            pose = counted_pose(view, origin).float()
            camera = Camera(pose, lens.intrinsics().float(), lens.width, lens.height, NEAR * size)
            shots += [(time + k / rate, camera, image) for k, image in enumerate(images)]
        taken, views, frames = zip(*sorted(shots, key=itemgetter(0)), strict=True) if shots else ((), (), ())
        for before, after in pairwise(taken):
            if after - before < 1e-6:
                raise ValueError(
                    f"The camera {name!r} has two frames at {after:g} s: give every camera its own `camera` in "
                    "transforms.json, and every frame its `time`."
                )
        sizes = {tuple(image.shape[:2]) for image in frames}
        if len(sizes) > 1:
            raise ValueError(f"The frames of camera {name!r} have different sizes: {sorted(sizes)}; make them equal.")
        if len(frames) < 3:
            raise ValueError(f"The camera {name!r} has {len(frames)} frames: a motion needs three or more.")
        found.append(Footage(name, tuple(time - begin for time in taken), views, torch.stack(frames)))
    return found


def frame_times(videos: Sequence[Footage]) -> list[float]:
    """All times at which a camera took a frame [s], ascending; times closer than a microsecond are one."""
    found: list[float] = []
    for time in sorted({time for video in videos for time in video.times}):
        if not found or time - found[-1] > 1e-6:
            found.append(time)
    return found


def _read(path: Path) -> Iterator[tuple[str, float, Callable[[list[int]], Shots] | Path]]:
    """Camera, time [s] and reader of each picture and film."""
    if not path.exists():
        raise FileNotFoundError(f"{path} does not exist: set `videos` to a folder with transforms.json.")
    files = transforms_files(path)
    if not files:
        raise ValueError(f"{path} has no transforms.json: write one with the cameras and times of the frames.")
    for file, _ in files:
        data, where, posed = load_transforms(file), f"`{file}`", {item.name: item for item in read_transforms(file)[0]}
        for k, frame in enumerate(data["frames"]):
            time, field = read_number(where, frame, "time"), "camera" if "camera" in frame else "camera_name"
            camera = str(frame.get(field, "0"))
            if "/" in camera or "\\" in camera:  # files are named after it
                raise ValueError(
                    f"The field `frames[{k}].{field}` of the camera file {where} is {camera!r}: set it to a name "
                    "without / and \\."
                )
            if "video_path" in frame:
                yield camera, time or 0.0, partial(_film, file, where, data, k)
                continue
            if time is None:
                raise ValueError(f"The field `frames[{k}].time` of the camera file {where} is missing: add it [s].")
            name = clean_name(str(frame.get("file_path", "")))
            yield camera, time, partial(_picture, posed[name]) if name in posed else file.parent / name


def _picture(item: PosedImage, room: list[int]) -> Shots:
    _take(room, item.path, item.lens.width, item.lens.height)
    turned = is_turned(*image_head(item.path), (item.lens.width, item.lens.height))
    pixels = load_image(item.path, item.lens, turned=bool(turned))
    return item.world_to_camera, item.lens.undistorted(), [pixels[..., :3].contiguous()], 1.0


def _film(file: Path, where: str, data: dict[str, Any], index: int, room: list[int]) -> Shots:
    entry = data["frames"][index]
    path = check_regular(file.parent / str(entry["video_path"]), "the video")
    fps, begun, seconds = (read_number(where, entry, name) for name in ("fps", "begin", "seconds"))
    wanted = [read_number(where, {name: data.get(name)} | entry, name) for name in ("w", "h")]
    taken = [] if not begun else ["-ss", f"{begun:.6f}"]
    taken += [] if seconds is None else ["-t", f"{seconds:.6f}"]
    images: list[Tensor] = []
    with closing(frames_of(path, taken, scaled(*wanted))) as film:
        head = next(film)
        size = check_wide(path, *head["size"])
        lens = lens_of_transforms(where, data, entry, size)
        if (lens.width, lens.height) != size:
            raise ValueError(f"The video {path} is not {lens.width} x {lens.height} as its camera in {where} says.")
        pose = read_pose(where, data, index)
        check_rigid(f"The field `frames[{index}].transform_matrix` of the camera file {where}", pose)
        rate = fps or head["fps"]
        if not rate > 0:
            raise ValueError(f"The video {path} does not say its frame rate: add `fps` to its entry in {where}.")
        length = min(head["duration"] - (begun or 0), math.inf if seconds is None else seconds)
        _take(list(room), path, *size, frames=int(head["fps"] * max(length, 0)))  # what it says; it may have more
        for frame in film:
            _take(room, path, *size)
            picture = torch.from_numpy(frame)
            images.append(remapped(picture, lens) if lens.distorted else picture)
    if not images and 0 < head["duration"] <= (begun or 0):
        raise ValueError(
            f"The field `frames[{index}].begin` of the camera file {where} is {begun:g} s, behind the end of the film "
            f"{path} at {head['duration']:g} s: set it to a time in the film."
        )
    return torch.linalg.inv(pose), lens.undistorted(), images, rate


def check_wide(path: Path, width: int, height: int) -> tuple[int, int]:
    """Return the size of the frames of a film, or raise ValueError if they are too narrow for an object."""
    if min(width, height) < NARROWEST:
        raise ValueError(
            f"The frames of {path} are read with {width} x {height} pixels, and an object needs {NARROWEST} each way: "
            "give a film that is less wide or less tall, or a larger one."
        )
    return width, height


def frames_of(
    path: Path, inputs: Sequence[str] = (), outputs: Sequence[str] = (), grey: bool = False
) -> Generator[Any, None, None]:
    """Read a film with options of ffmpeg for the file and for the frames, at the frame rate that its head states.

    Of a variable rate, ffmpeg would repeat frames up to a higher one.

    Yields:
        The head as of imageio-ffmpeg, whose ``fps`` is 0 if it is not known, then each frame, dtype uint8, shape
        (H, W) if ``grey``, else (H, W, 3).
    """
    from imageio_ffmpeg import read_frames

    kind = {"pix_fmt": "gray", "bits_per_pixel": 8} if grey else {}
    limits = ["-max_pixels", str(MOST_PIXELS)]
    try:
        with closing(read_frames(path, input_params=limits, output_params=["-frames:v", "1"])) as film:
            stated = next(film)["fps"]
        television = Fraction(1000 * round(1.001 * stated), 1001)  # such as 24000/1001, which the head rounds to 23.98
        rounded = stated != round(stated) and abs(television - stated) < 0.0051
        rate = television if rounded else Fraction(stated).limit_denominator(100)
        steady = ["-r", str(rate)] if rate else []
        given: dict[str, Any] = {"input_params": [*limits, *inputs], "output_params": [*steady, *outputs]}
        with closing(read_frames(path, **given, **kind)) as film:
            head = next(film)
            shape = (*head["size"][::-1], *([] if grey else [3]))
            yield head | {"fps": float(rate)}
            for frame in film:
                yield np.frombuffer(bytearray(frame), dtype=np.uint8).reshape(shape)
    except Exception as error:  # ffmpeg's errors are of many kinds
        if "max pixel count" in str(error):
            raise ValueError(f"The video {path} has more than {MOST_PIXELS:,} pixels: make it smaller.") from None
        told = str(error).splitlines()[0]
        raise ValueError(f"The video {path} cannot be read ({told}): convert it to mp4.") from error


def scaled(width: float | None, height: float | None) -> list[str]:
    """Options of ffmpeg that scale a film to a size [pixels], in its own proportions; none if there is no size."""
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it warns of every film that is scaled
    if not (width and height):
        return []
    return ["-vf", f"scale={width:.0f}:{height:.0f}:force_original_aspect_ratio=decrease:flags=area"]
