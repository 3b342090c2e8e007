"""A film before it is fitted: its size, rate and focal length, its first frame, and when it begins to move.

Frames are read one by one in reduced size, so memory does not grow with the film.
"""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._inputs import check_regular
from gaussian_swaying.fitting.registration import in_space
from gaussian_swaying.fitting.tracks import follow, opencv
from gaussian_swaying.fitting.videos import check_wide, frames_of, next_of, scaled
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput

SIDE = 960
"""Longer side of the frames that are used, at most [pixels]."""
SMALL = 240
"""Longer side of the frames in which motion is looked for, at most [pixels]."""
DIFFERENT, MOVED = 8.0, 0.02
"""Grey levels by which a pixel differs that has moved, and the share of such pixels in a frame that has."""
DIAGONAL = math.hypot(36, 24)
"""Of the film to which a focal length in mm is equivalent [mm]."""
FULL = 0.6
"""Share of the picture that a splat covers which has surroundings: then most of its points stand still."""
STRAY, IN_A_ROW = 1.5, 3
"""Distance of a point that moves from where the camera sees it at rest [pixels], and frames in which some do."""
LEAST = 8
"""Fewest points of the background that tell how a hand shakes."""
_FOCAL = re.compile(r"focal.?length\S*35mm\S*\s*:\s*([0-9.]+)", re.IGNORECASE)


@dataclass(frozen=True)
class Film:
    """A film that is read in reduced size.

    Attributes:
        path: The file.
        width: Of the frames as they are read [pixels].
        height: Of them.
        full: Factor by which the film itself is larger.
        fps: Frames per second.
        seconds: Its length [s], as the file says; infinite if it says none, as films that browsers record.
        focal: Focal length that the file says, equivalent to one on 35 mm film [mm]; None if it says none.
    """

    path: Path
    width: int
    height: int
    full: float
    fps: float
    seconds: float
    focal: float | None = None


def open_film(path: str | Path) -> Film:
    """Read the head of a film."""
    file = check_regular(Path(path), "the film")
    with closing(frames_of(file)) as frames:
        head = next_of(frames, file)
        if head is None or next_of(frames, file) is None:
            raise ValueError(f"The film {file} has no frames: convert it to mp4.")
    width, height = head["size"]
    factor = max(1.0, max(width, height) / SIDE)
    if not head["fps"] > 0:
        raise ValueError(f"The film {file} does not say its frame rate: convert it to mp4.")
    size = check_wide(file, round(width / factor), round(height / factor))
    return Film(file, *size, factor, head["fps"], float(head["duration"]) or math.inf, _focal(file))


def first_frame(film: Film) -> Tensor:
    """The first frame, dtype uint8, shape (H, W, 3)."""
    with closing(frames_of(film.path, outputs=scaled(film.width, film.height))) as frames:
        head, frame = next_of(frames, film.path), next_of(frames, film.path)
        return torch.frombuffer(bytearray(frame), dtype=torch.uint8).reshape(*head["size"][::-1], 3)


def pixels_of_focal(millimetres: float, width: int, height: int) -> float:
    """Focal length in pixels of one that is equivalent to so many mm on 35 mm film.

    Example:
        >>> round(pixels_of_focal(43.27, 300, 400))
        500
    """
    return millimetres * math.hypot(width, height) / DIAGONAL


def begins_to_move(film: Film, picture: RenderOutput, camera: Camera) -> float | None:
    """Time of the first frame in which the object is not as in the first one [s]; None if there is none.

    A hand that shakes moves the background, too, and does not count: what lies around the splat, or most of a splat
    that fills the picture.

    Args:
        film: The film; the object is at rest in its first frame. Brighter and darker frames do not count as motion.
        picture: The splat, drawn from the camera of the first frame.
        camera: That camera.
    """
    import numpy as np

    factor = max(1.0, max(film.width, film.height) / SMALL)
    size = round(film.width / factor), round(film.height / factor)
    first: Any = None
    with closing(frames_of(film.path, outputs=scaled(*size), grey=True)) as frames:
        width, height = next_of(frames, film.path)["size"]
        where = picture.alpha[..., 0].detach().cpu().float()[None, None]
        mask = torch.nn.functional.interpolate(where, size=(height, width), mode="area")[0, 0] > 0.3
        if not bool(mask.any()):
            mask = torch.ones_like(mask)
        number, in_a_row, inside = 0, 0, mask.numpy()
        full = inside.mean() > FULL
        while (frame := next_of(frames, film.path)) is not None:
            grey = np.frombuffer(frame, dtype=np.uint8).reshape(height, width)
            if first is None:
                first, steady = grey, _in_a_room(grey, picture, camera) if full else _steady(grey, inside)
            moves = _differs(first, grey, inside) and steady(grey)
            in_a_row = in_a_row + 1 if moves else 0
            if in_a_row == (IN_A_ROW if full else 1):
                return (number + 1 - in_a_row) / film.fps
            number += 1
    return None


def _differs(first: Any, grey: Any, where: Any) -> bool:
    """Return whether some pixels of a frame are not those of the first one, but for its brightness."""
    before, now = (picture[where].astype(float) for picture in (first, grey))
    level = now * (before.mean() / max(now.mean(), 1.0))
    return bool((abs(level - before) > DIFFERENT).mean() > MOVED)


def _steady(first: Any, inside: Any) -> Callable[[Any], bool]:
    """Tells whether the object is not as in the first frame once the shake of a hand is off, by the background.

    Args:
        first: The first frame, uint8 (H, W).
        inside: Where the object is, bool (H, W).
    """
    import numpy as np

    cv2 = opencv()
    around = 255 * (cv2.dilate(inside.astype(np.uint8), np.ones((15, 15), np.uint8)) == 0).astype(np.uint8)
    points = cv2.goodFeaturesToTrack(first, 200, 0.05, 5, mask=around)

    def aligned(grey: Any) -> Any:
        """A frame, moved and turned onto the first one; as it is if the background has too few points."""
        if points is None or len(points) < LEAST:
            return grey
        there, found, _ = cv2.calcOpticalFlowPyrLK(first, grey, points, None)
        kept = found[:, 0] > 0
        if kept.sum() < LEAST:
            return grey
        turn, _ = cv2.estimateAffinePartial2D(there[kept], points[kept])
        return grey if turn is None else cv2.warpAffine(grey, turn, grey.shape[::-1], borderMode=cv2.BORDER_REPLICATE)

    return lambda grey: _differs(first, aligned(grey), inside)


def _in_a_room(first: Any, picture: RenderOutput, camera: Camera) -> Callable[[Any], bool]:
    """Tells whether points are not where a camera sees those that stand still, most of a splat that fills the picture.

    Args:
        first: The first frame, uint8 (H, W).
        picture: The splat, drawn from its camera, which may be larger.
        camera: That camera.
    """
    import numpy as np

    scale = np.array([camera.width / first.shape[1], camera.height / first.shape[0]])
    corners = opencv().goodFeaturesToTrack(first, 500, 0.01, 4)
    start = np.zeros((0, 2)) if corners is None else corners.reshape(-1, 2) + 0.5
    world, known = in_space(picture, camera, start * scale)
    intrinsics = camera.intrinsics.double().numpy() / np.array([[scale[0]], [scale[1]], [1.0]])

    def differs(grey: Any) -> bool:
        (_, there), (_, seen) = follow(np.stack([first, grey])[..., None].repeat(3, -1), start)
        used = seen & known
        off = off_camera(world[used], there[used], intrinsics, STRAY)
        return off is not None and bool((off > STRAY).sum() >= max(LEAST, MOVED * len(off)))

    return differs


def off_camera(world: Any, there: Any, intrinsics: Any, near: float) -> Any:
    """Distances of points in a frame from where the camera sees them that agrees with most of them [pixels].

    Args:
        world: Their places in space, shape (T, 3).
        there: Where they are in the frame [pixels], shape (T, 2).
        intrinsics: Of the camera, shape (3, 3).
        near: Largest distance of points that agree [pixels].

    Returns:
        Shape (T,); None if less than half of them agree on a camera.
    """
    import numpy as np

    cv2 = opencv()
    if len(world) < LEAST:
        return None
    done, turn, shift, agree = cv2.solvePnPRansac(
        world, there, intrinsics, None, reprojectionError=near, flags=cv2.SOLVEPNP_AP3P
    )
    if not done or len(agree) < 0.5 * len(world):
        return None
    agree = agree[:, 0]
    turn, shift = cv2.solvePnPRefineLM(world[agree], there[agree], intrinsics, None, turn, shift)
    return np.linalg.norm(cv2.projectPoints(world, turn, shift, intrinsics, None)[0].reshape(-1, 2) - there, axis=-1)


def _focal(path: Path) -> float | None:
    """The focal length among the tags of a film, as phones write it [mm on 35 mm film]."""
    from imageio_ffmpeg import get_ffmpeg_exe

    told = subprocess.run(
        [get_ffmpeg_exe(), "-hide_banner", "-i", str(path)], capture_output=True, stdin=subprocess.DEVNULL, check=False
    )
    found = _FOCAL.search(told.stderr.decode(errors="replace"))
    value = float(found[1]) if found else 0.0
    return value if 5 <= value <= 1000 else None
