"""A film and a splat: its size, when it begins to move, what moves in it, and the end that is held."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._inputs import check_regular
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.inverse.registration import SOLID, in_space, off_camera
from gaussian_swaying.inverse.tracks import corners, follow, opencv
from gaussian_swaying.inverse.videos import Footage, check_wide, frames_of, next_of, scaled
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput

SIDE, SMALL = 960, 240  # longer sides of frames at most, and of those that show when it begins to move [pixels]
DIFFERENT, MOVED_SHARE = 8.0, 0.02  # grey levels by which a pixel has moved, and share of those in a frame
DIAGONAL = math.hypot(36, 24)  # of the film to which a focal length in mm is equivalent [mm]
FULL = 0.6  # share of the picture that a splat covers which has surroundings: then most of its points stand still
STRAY, IN_A_ROW = 1.5, 3  # motion of a point where most of the picture is still [pixels], and frames in which some do
LEAST_SHAKEN = 8  # fewest points that tell how a hand shakes
END, FLAT, FEWEST = 0.12, 0.3, 5  # length of an end per the whole; of a direction per the longest; points of an end
STILL, LEAST_MOTION = 0.35, 3.0  # motion of a held end per that of the liveliest quarter; least of that [pixels]
LIVELY, MOST = 0.25, 0.5  # motion per that of the liveliest fiftieth, and largest share of the points that move
CELLS, PAD = 24, 0.02  # cells along what moves, within two of which things are connected; margin of its box
_FOCAL = re.compile(r"focal.?length\S*35mm\S*\s*:\s*([0-9.]+)", re.IGNORECASE)


@dataclass(frozen=True)
class Film:
    """A film whose frames are read in another size, by which it is ``full`` times as large.

    ``seconds`` is infinite, and ``focal`` (on 35 mm film [mm]) None, if the file does not say it.
    """

    path: Path
    width: int
    height: int
    full: float
    fps: float
    seconds: float
    focal: float | None = None

    def first_frame(self) -> Tensor:
        """The first frame, dtype uint8, shape (H, W, 3)."""
        with closing(frames_of(self.path, outputs=scaled(self.width, self.height))) as frames:
            head, frame = next_of(frames, self.path), next_of(frames, self.path)
            return torch.frombuffer(bytearray(frame), dtype=torch.uint8).reshape(*head["size"][::-1], 3)


def open_film(path: str | Path, side: float | None = None) -> Film:
    """Read the head of a film whose frames are to have at most this longer side [pixels]."""
    file = check_regular(Path(path), "the film")
    with closing(frames_of(file)) as frames:
        head = next_of(frames, file)
        if head is None or next_of(frames, file) is None:
            raise ValueError(f"The film {file} has no frames: convert it to mp4.")
    width, height = head["size"]
    factor = max(1.0, max(width, height) / (side or SIDE))
    if not head["fps"] > 0:
        raise ValueError(f"The film {file} does not say its frame rate: convert it to mp4.")
    size = check_wide(file, round(width / factor), round(height / factor))
    return Film(file, *size, factor, head["fps"], float(head["duration"]) or math.inf, _focal(file))


def _focal(path: Path) -> float | None:
    from imageio_ffmpeg import get_ffmpeg_exe

    words = [get_ffmpeg_exe(), "-hide_banner", "-i", str(path)]
    told = subprocess.run(words, capture_output=True, stdin=subprocess.DEVNULL, check=False)
    found = _FOCAL.search(told.stderr.decode(errors="replace"))
    value = float(found[1]) if found else 0.0
    return value if 5 <= value <= 1000 else None


def view_of_focal(millimetres: float, width: int, height: int) -> float:
    """Vertical field of view [degrees] of a focal length that is equivalent to so many mm on 35 mm film.

    Example:
        >>> round(view_of_focal(43.27, 300, 400), 1)
        43.6
    """
    return 2 * math.degrees(math.atan(0.5 * height * DIAGONAL / (millimetres * math.hypot(width, height))))


class Points:
    """Points of a splat in the grey first frame of a film, at rest, and points around it, which tell how a hand shakes.

    The splat is drawn from the camera of the first frame, perhaps larger. If it is ``full``, it covers most of the
    picture, and most of its points stand still.
    """

    def __init__(self, grey: Any, picture: RenderOutput, camera: Camera) -> None:
        cv2, scale = opencv(), camera.width / grey.shape[1]
        alpha = picture.alpha[..., 0].detach().cpu().numpy()
        cover = (cv2.resize(alpha, grey.shape[::-1], interpolation=cv2.INTER_AREA) > SOLID).astype(np.uint8)
        around = (cv2.dilate(cover, np.ones((15, 15), np.uint8)) == 0).astype(np.uint8)
        own, beside = (corners(grey, 600, 0.01, 4, mask) for mask in (cover, around))
        self.start, self._count = np.concatenate([own, beside]), len(own)
        self.full = len(beside) < LEAST_SHAKEN and cover.mean() > FULL
        self.world, self.known = in_space(picture, camera, own * scale)
        self._lens = camera.intrinsics.double().numpy() / np.array([[scale], [scale], [1.0]])

    def far(self, place: Any, seen: Any, near: float) -> Any:
        """How far points of the splat, of all (T, 2), have gone [pixels]; NaN if not known."""
        found, used = np.full(self._count, np.nan), seen[: self._count] & self.known
        there = place[: self._count][used]
        if self.full:
            off = off_camera(self.world[used], there, self._lens, near)
            found[used] = np.nan if off is None else off
        else:
            turn = self.shake(place, seen)
            found[used] = np.linalg.norm(there - self.start[: self._count][used] @ turn[:, :2].T - turn[:, 2], axis=-1)
        return found

    def shake(self, place: Any, seen: Any) -> Any:
        around, turn = seen.copy(), None
        around[: self._count] = False
        if around.sum() >= LEAST_SHAKEN:
            turn = opencv().estimateAffinePartial2D(self.start[around], place[around], ransacReprojThreshold=1.5)[0]
        return np.eye(2, 3) if turn is None else turn


def begins_to_move(film: Film, picture: RenderOutput, camera: Camera) -> float | None:
    """Time of the first frame in which the object, not only the camera, has moved [s]; None if there is none."""
    cv2: Any = opencv()
    factor = max(1.0, max(film.width, film.height) / SMALL)
    size = round(film.width / factor), round(film.height / factor)
    with closing(frames_of(film.path, outputs=scaled(*size), grey=True)) as frames:
        shape = next_of(frames, film.path)["size"][::-1]
        first = np.frombuffer(next_of(frames, film.path), dtype=np.uint8).reshape(shape)
        cover = (
            cv2.resize(picture.alpha[..., 0].detach().cpu().numpy(), shape[::-1], interpolation=cv2.INTER_AREA) > 0.3
        )
        inside = cover if cover.any() else ~cover
        points, number, in_a_row = Points(first, picture, camera), 1, 0
        while (frame := next_of(frames, film.path)) is not None:
            grey = np.frombuffer(frame, dtype=np.uint8).reshape(shape)
            moved = _differs(first, grey, inside)
            if moved:
                (_, place), (_, seen) = follow(np.stack([first, grey]), points.start)
                if points.full:
                    far = points.far(place, seen, STRAY)
                    moved = (far > STRAY).sum() >= max(LEAST_SHAKEN, MOVED_SHARE * np.isfinite(far).sum())
                else:
                    how = {"flags": cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, "borderMode": cv2.BORDER_REPLICATE}
                    moved = _differs(first, cv2.warpAffine(grey, points.shake(place, seen), shape[::-1], **how), inside)
            in_a_row = in_a_row + 1 if moved else 0
            if in_a_row == (IN_A_ROW if points.full else 1):
                return (number + 1 - in_a_row) / film.fps
            number += 1
    return None


def _differs(first: Any, grey: Any, where: Any) -> bool:
    before, now = (picture[where].astype(float) for picture in (first, grey))
    level = now * (before.mean() / max(now.mean(), 1.0))
    return bool((abs(level - before) > DIFFERENT).mean() > MOVED_SHARE)


def held_end(places: Tensor, moved: Tensor, up: Sequence[float]) -> tuple[str, float, float] | None:
    """Find the end of an object that moves least in a film, from how far points (T, 3) of it go, (T,) [pixels].

    Its name, and how far it and the liveliest quarter of the points go. None if no end is much more still than the
    rest.
    """
    if len(moved) < 4 * FEWEST or (others := float(moved.quantile(0.75))) < LEAST_MOTION:
        return None
    upward = torch.nn.functional.normalize(torch.as_tensor(up, dtype=torch.float64), dim=0)
    ends = {"top": upward, "bottom": -upward}
    for axis, name in enumerate("xyz"):
        if abs(float(upward[axis])) < 0.7:
            unit = torch.eye(3, dtype=torch.float64)[axis]
            ends |= {f"+{name}": unit, f"-{name}": -unit}
    along = {name: places @ direction for name, direction in ends.items()}
    length = {name: float(own.max() - own.min()) for name, own in along.items()}
    found = []
    for name, own in along.items():
        there = own > own.max() - END * length[name]
        if length[name] >= FLAT * max(length.values()) and int(there.sum()) >= FEWEST:
            found.append((float(moved[there].median()), name))
    if not found or min(found)[0] > STILL * others:
        return None
    moves, name = min(found)
    return name, moves, others


def moving_box(places: Tensor, moved: Tensor, cloud: GaussianCloud) -> tuple[Tensor, Tensor] | None:
    """Corners (3,) of the box of what moves, and of all that is connected with it, from how far points (T, 3) go, (T,).

    None if most of what is seen moves, or hardly anything.
    """
    goes = moved > max(LEAST_MOTION, LIVELY * float(moved.quantile(0.98))) if len(moved) else moved > 0
    if not 4 * FEWEST <= int(goes.sum()) <= MOST * len(goes):
        return None
    low, high = (places[goes].quantile(share, dim=0) for share in (0.02, 0.98))
    longest = float((high - low).max())
    means = cloud.means.double()
    points = means[((means > low - longest) & (means < high + longest)).all(-1) & (cloud.opacities > 0)]
    part = connected_parts(points, max(longest / CELLS, 2 * particle_spacing(points)))
    inside = ((points >= low) & (points <= high)).all(-1)
    if not bool(inside.any()):
        return None
    own = points[part == int(part[inside].mode().values)]
    return own.amin(0) - PAD * longest, own.amax(0) + PAD * longest


def moving_points(video: Footage, picture: RenderOutput) -> tuple[Tensor, Tensor]:
    """Places (T, 3) of a splat that are seen for half of a film, and how far each goes, without the hand [pixels]."""
    cv2, images = opencv(), video.images.numpy()
    points = Points(cv2.cvtColor(images[0], cv2.COLOR_RGB2GRAY), picture, video.cameras[0])
    position, seen = follow(images, points.start)
    gone, own = np.zeros(len(points.world)), seen[:, : len(points.world)]
    for place, valid in zip(position[1:], seen[1:], strict=True):
        gone = np.fmax(gone, points.far(place, valid, LEAST_MOTION))
    kept = points.known & (own.mean(0) > 0.5)
    return torch.from_numpy(points.world[kept]), torch.from_numpy(gone[kept])
