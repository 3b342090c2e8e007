"""Cameras around a moving cloth, and what the camera of a phone does to a picture."""

from __future__ import annotations

import io
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from blender_images import View, look_at
from fit_cases import FitVideo
from flag_pictures import lens_fields, view_of_all

from gaussian_swaying._files import atomic

_PLACES = ((-28, 8), (36, 14), (152, 10), (-140, 6), (72, 22), (-72, 18), (108, 16), (-104, 4))
"""Azimuth from the mean normal of the cloth, and elevation, of each camera [degrees]."""


def mean_normal(positions: np.ndarray, faces: np.ndarray, rest_normal: np.ndarray) -> np.ndarray:
    """Mean direction that a moving cloth faces, made level and of length one.

    Units: ``positions`` [m].

    Returns:
        Shape (3,).
    """
    corners = positions[:, faces].astype(np.float64)
    area = np.cross(corners[:, :, 2] - corners[:, :, 0], corners[:, :, 3] - corners[:, :, 1])
    normal = area.mean((0, 1)) * [1.0, 1.0, 0.0]
    size = np.linalg.norm(normal)
    if size < 1e-3 * np.linalg.norm(area, axis=-1).mean():
        return rest_normal
    return normal / size * (1.0 if normal @ rest_normal >= 0 else -1.0)


def ring_views(positions: np.ndarray, normal: np.ndarray, video: FitVideo) -> list[View]:
    """Still cameras on tripods around a cloth, each of which sees all of the motion.

    Units: ``positions`` [m].
    """
    heading = math.atan2(normal[1], normal[0])
    views = []
    for azimuth, elevation in _PLACES[: video.cameras]:
        turn, rise = heading + math.radians(azimuth), math.radians(elevation)
        ray = np.array([math.cos(turn) * math.cos(rise), math.sin(turn) * math.cos(rise), math.sin(rise)])
        frame = look_at(ray, np.zeros(3))[:3, :3]
        views.append(view_of_all(frame, positions, *video.size, math.radians(video.angle)))
    return views


def add_noise(picture: np.ndarray, video: FitVideo, key: tuple[int, ...]) -> np.ndarray:
    """Noise of a sensor: that of reading out, and that of counting photons, whose variance grows with the light.

    Returns:
        Colours in 0 to 255, uint8, shape (H, W, 3).
    """
    generator = np.random.default_rng([video.seed, *key])
    deviation = np.sqrt(video.read_noise**2 + video.shot_noise * picture)
    noisy = picture + deviation * generator.standard_normal(picture.shape)
    return np.round(255.0 * noisy.clip(0.0, 1.0)).astype(np.uint8)


def compress(picture: np.ndarray, quality: int) -> bytes:
    """A picture (H, W, 3), uint8, as a JPEG file with colours at half the resolution."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(picture).save(file, format="JPEG", quality=quality, subsampling="4:2:0")
    return file.getvalue()


def write_h264(path: Path, pictures: Iterable[np.ndarray], size: tuple[int, int], fps: float, crf: int = 28) -> None:
    """Write pictures, uint8 (H, W, 3), as a film in H.264.

    Units: ``size`` [pixels].
    """
    from imageio_ffmpeg import write_frames

    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic(path) as temporary:
        more = ["-f", "mp4", "-crf", str(crf)]
        film = write_frames(str(temporary), size, fps=fps, macro_block_size=2, quality=None, output_params=more)
        film.send(None)
        for picture in pictures:
            film.send(np.ascontiguousarray(picture).tobytes())
        film.close()


def composite(rgba: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """A picture with alpha (H, W, 4), uint8, in front of a colour; 0 to 1, float64, shape (H, W, 3)."""
    colour, alpha = rgba[..., :3] / 255.0, rgba[..., 3:] / 255.0
    return colour * alpha + (1.0 - alpha) * np.array(background)


def frame_name(camera: int, frame: int) -> str:
    """Path of a picture below the folder of its case."""
    return f"images/camera{camera}/{frame:04d}.jpg"


def mask_name(camera: int, frame: int) -> str:
    """Path of a silhouette below the folder of its case."""
    return f"masks/camera{camera}/{frame:04d}.png"


def video_fields(views: list[View], frames: int, fps: float) -> dict[str, Any]:
    """The fields of ``transforms.json``: all pictures of all cameras with times [s], ordered by camera and time."""
    rows = [
        {
            "file_path": frame_name(camera, frame),
            "mask_path": mask_name(camera, frame),
            "time": frame / fps,
            "camera": f"camera{camera}",
            "transform_matrix": views[camera].pose.tolist(),
        }
        for camera in range(len(views))
        for frame in range(frames)
    ]
    return lens_fields(views[0]) | {"fps": fps, "frames": rows}
