"""Cameras of films: registration, tripod and hand, exposure, background, and the end that is held."""

from __future__ import annotations

import math
import re
import subprocess
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_whole
from gaussian_swaying._inputs import check_regular
from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.grouping import connected_parts
from gaussian_swaying.geometry.neighbours import particle_spacing
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.inverse.tracks import Overlap, follow, opencv, window_of
from gaussian_swaying.inverse.videos import Footage, check_wide, frames_of, next_of, scaled
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera, project
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.simulation import Simulation

RATIO = 0.8
"""Largest distance of a feature to its match, per that to the next best one (Lowe 2004)."""

NEAR = 0.006
"""Largest distance between a point and its match that agree on a camera, as a share of the picture's diagonal."""

CLOSE = 1.5
"""The same of points that are followed on thin things [pixels]."""

LEAST = 12
"""Fewest matches that make a camera."""

SOLID = 0.9
"""Least opacity of the picture at a feature, whose depth is then known."""

ENOUGH = 60
"""Features that agree with which none need to be followed."""

REFINED = 5
"""Times that a camera is refined and the points that agree on it are chosen anew."""

ROUNDS = 3
"""Pictures that are drawn from a camera that is already near, for features and for points that are followed."""


@dataclass(frozen=True, eq=False)
class Registration:
    """The camera of a frame.

    Attributes:
        camera: The camera.
        matches: Points that were matched at the end.
        agreeing: Those that agree on the camera.
        residual: Root mean square of their distances [pixels].
        spread: Covariance of a small rotation of the camera's axes [rad], and of a shift along them [scene units],
            float64, shape (6, 6). Points nearer than the window in which they are followed count as one.
        itself: Whether the frame shows the thing itself, and not what the splat shows; False if it was not asked.
    """

    camera: Camera
    matches: int
    agreeing: int
    residual: float
    spread: Tensor
    itself: bool = False


def cameras_around(
    center: Sequence[float] | Tensor,
    distance: float,
    up: Sequence[float] | Tensor,
    fov_y_degrees: float,
    width: int,
    height: int,
    count: int = 12,
    elevations: Sequence[float] = (0.0, 30.0),
) -> list[Camera]:
    """Cameras around an object from which a registration may start.

    Args:
        center: Of the object [scene units], shape (3,).
        distance: From there [scene units].
        up: Direction that is up, shape (3,).
        fov_y_degrees: Vertical field of view [degrees].
        width: Of the frame [pixels].
        height: Of the frame [pixels].
        count: Directions around the object.
        elevations: Angles above the level [degrees].
    """
    check_whole("count", count, 1)
    middle = torch.as_tensor(center, dtype=torch.float64)
    axis = torch.nn.functional.normalize(torch.as_tensor(up, dtype=torch.float64), dim=0)
    across = torch.eye(3, dtype=torch.float64)[int(axis.abs().argmin())]
    first = torch.nn.functional.normalize(torch.linalg.cross(axis, across), dim=0)
    second = torch.linalg.cross(axis, first)
    found = []
    for elevation in map(math.radians, elevations):
        for turn in (2 * math.pi * k / count for k in range(count)):
            level = math.cos(turn) * first + math.sin(turn) * second
            eye = middle + distance * (math.cos(elevation) * level + math.sin(elevation) * axis)
            found.append(look_at_camera(eye, middle, axis, fov_y_degrees, width, height, dtype=torch.float64))
    return found


def find_camera(
    draw: Callable[[Camera], RenderOutput], frame: Tensor, start: Sequence[Camera], *, focal: bool = False
) -> Registration:
    """Find the camera of a frame of something that stands still.

    Args:
        draw: Draws the splat, at rest.
        frame: The frame, dtype uint8, shape (H, W, 3), without lens distortion.
        start: Cameras to begin with, of the frame's size and with its intrinsics; the one with the most matches that
            agree is taken. One is enough if it is within some 20 degrees.
        focal: Whether the focal length is to be found, too. It needs depth in what is seen, or a slanted surface.

    Raises:
        ImportError: Without OpenCV.
        ValueError: If the frame and the cameras do not fit, or the splat is not found in the frame.
    """
    cv2 = opencv()
    height, width = frame.shape[:2]
    if not start or any((camera.width, camera.height) != (width, height) for camera in start):
        raise ValueError(f"Expected `start` to be cameras of the frame's size, {width} x {height}.")
    grey = grey_of(frame)
    sift = cv2.SIFT_create(nfeatures=4000, contrastThreshold=0.02)
    wanted = sift.detectAndCompute(grey, None)
    best: Registration | None = None
    for camera in start:
        found = _by_features(cv2, sift, wanted, draw(camera), camera, focal=False)
        if found is not None and (best is None or found.agreeing > best.agreeing):
            best = found
    if best is None:
        raise ValueError(
            "The splat was not found in the frame: give a camera that is nearer, a frame that shows more of it, or one "
            "with more texture."
        )
    for _ in range(ROUNDS):
        best = _by_features(cv2, sift, wanted, draw(best.camera), best.camera, focal) or best
    for _ in range(ROUNDS if best.agreeing < ENOUGH else 0):
        best = _by_flow(cv2, grey, draw(best.camera), best.camera, focal) or best
    return best


def refine(
    frame: Tensor,
    picture: RenderOutput,
    camera: Camera,
    where: Tensor,
    overlap: Overlap | None = None,
    itself: bool | None = None,
) -> Registration | None:
    """The camera of a frame, from points that are followed there from a picture taken nearby.

    Args:
        frame: The frame, dtype uint8, shape (H, W, 3).
        picture: The splat, drawn from ``camera``.
        camera: A camera so near that most points move by less than some 20 pixels.
        where: The pixels of the picture that count, bool, shape (H, W).
        overlap: Of the picture, or of one from nearby; None to take the picture as it is.
        itself: Whether the frame shows the thing itself, so that the overlap counts; None to find out.

    Returns:
        None if too few points agree.
    """
    near = NEAR * math.hypot(camera.width, camera.height)
    return _by_flow(opencv(), grey_of(frame), picture, camera, False, near, where, overlap, itself)


def grey_of(image: Tensor) -> Any:
    """An image of bytes or of colours in [0, 1], (H, W, 3), as grey bytes whose contrast is the same everywhere."""
    whole = image.float() if image.dtype == torch.uint8 else image.detach().float().cpu().clamp(0, 1) * 255
    grey = whole @ torch.tensor([0.299, 0.587, 0.114])
    equal = opencv().createCLAHE(clipLimit=3.0, tileGridSize=(8, 8))  # takes what another light changes
    return equal.apply(grey.round().to(torch.uint8).numpy())


def in_space(picture: RenderOutput, camera: Camera, pixel: Any) -> tuple[Any, Any]:
    """Places on the surface that pixels (N, 2) of a picture show, float64, and a mask of those whose depth is known."""
    import numpy as np

    alpha = picture.alpha[..., 0].detach().cpu().numpy()
    depth = (picture.depth / picture.alpha.clamp(min=1e-3))[..., 0].detach().cpu().numpy().astype(np.float64)
    height, width = alpha.shape
    x, y = pixel[:, 0] - 0.5, pixel[:, 1] - 0.5
    column, row = np.clip(np.floor(x).astype(int), 0, width - 2), np.clip(np.floor(y).astype(int), 0, height - 2)
    corners = [(row + i, column + j) for i in (0, 1) for j in (0, 1)]
    known = np.min([alpha[corner] for corner in corners], 0) > SOLID
    fx, fy = x - column, y - row
    shares = ((1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx)
    z = sum(share * depth[corner] for share, corner in zip(shares, corners, strict=True))
    K = camera.intrinsics.double().cpu().numpy()
    local = np.stack([(pixel[:, 0] - K[0, 2]) / K[0, 0] * z, (pixel[:, 1] - K[1, 2]) / K[1, 1] * z, z], 1)
    view = camera.world_to_camera.double().cpu().numpy()
    return (local - view[:3, 3]) @ view[:3, :3], known


def _by_features(
    cv2: Any, sift: Any, wanted: tuple[Any, Any], picture: RenderOutput, camera: Camera, focal: bool
) -> Registration | None:
    """The camera from matched features; None if too few agree."""
    import numpy as np

    mask = (picture.alpha[..., 0].detach().cpu().numpy() > SOLID).astype(np.uint8)
    points, codes = sift.detectAndCompute(grey_of(picture.color), mask)
    if codes is None or wanted[1] is None or len(points) < LEAST or len(wanted[0]) < LEAST:
        return None
    pairs = cv2.BFMatcher().knnMatch(codes, wanted[1], k=2)
    good = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
    if len(good) < LEAST:
        return None
    here = np.array([points[one.queryIdx].pt for one in good]) + 0.5  # OpenCV counts from the centre of a pixel
    there = np.array([wanted[0][one.trainIdx].pt for one in good]) + 0.5
    return _pose(cv2, picture, camera, here, there, focal, NEAR * math.hypot(camera.width, camera.height))


def _by_flow(
    cv2: Any,
    grey: Any,
    picture: RenderOutput,
    camera: Camera,
    focal: bool,
    near: float = CLOSE,
    where: Tensor | None = None,
    overlap: Overlap | None = None,
    itself: bool | None = None,
) -> Registration | None:
    """The camera from points that are followed from the picture to the frame; None if too few are."""
    import numpy as np

    drawn = grey_of(picture.color)
    solid = picture.alpha[..., 0].detach().cpu().numpy() > SOLID
    solid = solid if where is None else solid & where.numpy()
    mask = cv2.erode(solid.astype(np.uint8), np.ones((5, 5), np.uint8))
    corners = cv2.goodFeaturesToTrack(drawn, 1000, 0.005, 3, mask=mask)
    if corners is None or len(corners) < LEAST:
        return None
    here = corners.reshape(-1, 2).astype(np.float64) + 0.5
    colours = np.stack([drawn, grey])[..., None].repeat(3, -1)
    place, seen = follow(colours, here)
    return _pose(cv2, picture, camera, here[seen[1]], place[1][seen[1]], focal, near, overlap, itself)


def _pose(
    cv2: Any,
    picture: RenderOutput,
    camera: Camera,
    here: Any,
    there: Any,
    focal: bool,
    near: float,
    overlap: Overlap | None = None,
    itself: bool | None = None,
) -> Registration | None:
    """The camera that sees what the picture shows at ``here`` at ``there``; None if too few pairs agree."""
    import numpy as np

    world, known = in_space(picture, camera, here)
    world, there = world[known], np.ascontiguousarray(there[known], dtype=np.float64)
    if overlap is None:
        return _seen_from(cv2, world, there, camera, focal, near)
    beside = overlap.at(torch.from_numpy(world)).numpy()
    if itself is None:
        found = _seen_from(cv2, world, there, camera, focal, near)
        itself = found is not None and _lacking(world, there, beside, found.camera, near) > 0.5
    found = _seen_from(cv2, world, there + itself * beside, camera, focal, near)
    return None if found is None else replace(found, itself=itself)


def _seen_from(cv2: Any, world: Any, there: Any, camera: Camera, focal: bool, near: float) -> Registration | None:
    """The camera that sees places (N, 3) at pixels (N, 2), near another; None if too few agree."""
    import numpy as np

    if len(world) < LEAST:
        return None
    K = camera.intrinsics.double().cpu().numpy().copy()
    done, turn, shift, _ = cv2.solvePnPRansac(
        world, there, K, None, iterationsCount=2000, reprojectionError=near, confidence=0.9999, flags=cv2.SOLVEPNP_AP3P
    )
    view = camera.world_to_camera.double().cpu().numpy()
    begun = cv2.solvePnPRefineLM(world, there, K, None, cv2.Rodrigues(view[:3, :3])[0], view[:3, 3:].copy())
    found = [_agreeing(cv2, world, there, K, near, *pair) for pair in [begun] + [(turn, shift)] * done]
    index, turn, shift = max(found, key=lambda one: len(one[0]))
    if len(index) < LEAST:
        return None
    if focal:
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
        flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
        size = (camera.width, camera.height)
        given = ([world[index].astype(np.float32)], [there[index].astype(np.float32)], size, K, None)
        _, K, _, (turn,), (shift,) = cv2.calibrateCamera(*given, flags=flags)
    off = cv2.projectPoints(world[index], turn, shift, K, None)[0].reshape(-1, 2) - there[index]
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = cv2.Rodrigues(turn)[0], shift.reshape(3)
    seen = replace(camera, world_to_camera=torch.from_numpy(view), intrinsics=torch.from_numpy(np.asarray(K, float)))
    residual = float(np.sqrt((off**2).sum(1).mean()))
    spread = _spread(world[index], there[index], seen, residual)
    return Registration(seen, len(world), len(index), residual, spread)


def _lacking(world: Any, there: Any, beside: Any, camera: Camera, near: float) -> float:
    """The share of an overlap that explains best what no small change of the camera does.

    It is near 1 in a frame of the thing itself, and near 0 in one of what the splat shows.

    Args:
        world: Places (N, 3).
        there: Where the frame has them [pixels], shape (N, 2).
        beside: Where the splat is drawn, beside where they are [pixels], shape (N, 2).
        camera: A camera that sees the places about there.
        near: Distance from which a place is somewhere else [pixels].
    """
    places, shift = torch.from_numpy(world), torch.from_numpy(beside)
    off = torch.from_numpy(there) - project(places, camera)[0]
    good = off.norm(dim=-1) < near
    basis = torch.linalg.qr(_slope(places[good], camera)).Q
    left, along = (part[good].flatten() for part in (off, shift))
    along = along - basis @ (basis.T @ along)
    return float(-(left @ along) / (along @ along).clamp(min=1e-12))


def _agreeing(cv2: Any, world: Any, there: Any, K: Any, near: float, turn: Any, shift: Any) -> tuple[Any, Any, Any]:
    import numpy as np

    index: Any = np.arange(0)
    for _ in range(REFINED):
        off = cv2.projectPoints(world, turn, shift, K, None)[0].reshape(-1, 2) - there
        index = np.flatnonzero(np.linalg.norm(off, axis=1) < near)
        if len(index) < LEAST:
            break
        turn, shift = cv2.solvePnPRefineLM(world[index], there[index], K, None, turn, shift)
    return index, turn, shift


def _spread(world: Any, there: Any, camera: Camera, residual: float) -> Tensor:
    """Covariance of a camera (6, 6), from the points (N, 3) that it sees at ``there`` (N, 2), off by ``residual``."""
    slope = _slope(torch.from_numpy(world), camera)
    apart = len(set(map(tuple, (there // window_of(camera.width, camera.height)).astype(int).tolist())))
    variance = 0.5 * residual**2 * len(world) / apart
    return variance * torch.linalg.pinv(slope.T @ slope, hermitian=True)


def _slope(places: Tensor, camera: Camera) -> Tensor:
    """Derivatives of the pixels of places (N, 3) by a small rotation of the camera's axes and a shift, (2N, 6)."""
    view, K = camera.world_to_camera, camera.intrinsics
    local = places @ view[:3, :3].T + view[:3, 3]
    x, y, z = local.unbind(1)
    zero = torch.zeros_like(z)
    by_place = torch.stack([K[0, 0] / z, zero, -K[0, 0] * x / z**2, zero, K[1, 1] / z, -K[1, 1] * y / z**2], 1)
    by_place = by_place.unflatten(1, (2, 3))
    by_turn = torch.linalg.cross(local[:, None].expand_as(by_place), by_place)
    return torch.cat([by_turn, by_place], 2).flatten(0, 1)


SIDE = 960
"""Longer side of the frames that are used, at most [pixels]."""

SMALL = 240
"""Longer side of the frames in which motion is looked for, at most [pixels]."""

DIFFERENT, MOVED_SHARE = 8.0, 0.02
"""Grey levels by which a pixel differs that has moved, and the share of such pixels in a frame that has."""

DIAGONAL = math.hypot(36, 24)
"""Of the film to which a focal length in mm is equivalent [mm]."""

FULL = 0.6
"""Share of the picture that a splat covers which has surroundings: then most of its points stand still."""

STRAY, IN_A_ROW = 1.5, 3
"""Distance of a point that moves from where the camera sees it at rest [pixels], and frames in which some do."""

LEAST_SHAKEN = 8
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
    return bool((abs(level - before) > DIFFERENT).mean() > MOVED_SHARE)


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
        if points is None or len(points) < LEAST_SHAKEN:
            return grey
        there, found, _ = cv2.calcOpticalFlowPyrLK(first, grey, points, None)
        kept = found[:, 0] > 0
        if kept.sum() < LEAST_SHAKEN:
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
        return off is not None and bool((off > STRAY).sum() >= max(LEAST_SHAKEN, MOVED_SHARE * len(off)))

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
    if len(world) < LEAST_SHAKEN:
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


END = 0.12
"""Part of an object that is one of its ends, as a share of its length in that direction."""

FLAT = 0.3
"""Least length in a direction that has ends, per the largest one."""

FEWEST = 5
"""Fewest points that make an end."""

STILL, LEAST_MOTION = 0.35, 3.0
"""Largest motion of a held end, per that of the liveliest quarter of the points, and the least of these [pixels]."""

LIVELY = 0.25
"""Motion of what moves, per that of the liveliest fiftieth of the points; the rest is drift of the tracks."""

MOST = 0.5
"""Largest share of the points that move if there are things around that do not."""

CELLS, PAD = 24, 0.02
"""Cells along what moves, within two of which things are connected; and what its box is larger, as shares of it."""


@dataclass(frozen=True)
class HeldEnd:
    """The end that does not move.

    Attributes:
        name: ``top``, ``bottom``, or ``+x`` to ``-z`` of the splat.
        direction: Towards it, shape (3,).
        moves: How far points there move [pixels].
        others: How far the liveliest quarter moves [pixels].
    """

    name: str
    direction: tuple[float, ...]
    moves: float
    others: float


def held_end(places: Tensor, moved: Tensor, up: Sequence[float]) -> HeldEnd | None:
    """Find the end of an object that moves least in a film.

    Args:
        places: Of points on the object, shape (T, 3).
        moved: How far each goes [pixels], shape (T,).
        up: Direction that is up, shape (3,).

    Returns:
        None if no end is much more still than the rest, as in an object that is held at a corner or within.
    """
    if len(moved) < 4 * FEWEST:
        return None
    others = float(moved.quantile(0.75))
    if others < LEAST_MOTION:
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
    return HeldEnd(name, tuple(ends[name].tolist()), moves, others)


def moving_box(places: Tensor, moved: Tensor, cloud: GaussianCloud) -> tuple[Tensor, Tensor] | None:
    """The box of what moves among things that do not, and of all that is connected with it.

    Args:
        places: Of points that the film shows, shape (T, 3).
        moved: How far each goes [pixels], shape (T,).
        cloud: The splat.

    Returns:
        Lower and upper corner [scene units], shape (3,); None if most of what is seen moves, or hardly anything.
    """
    goes = moved > max(LEAST_MOTION, LIVELY * float(moved.quantile(0.98))) if len(moved) else moved > 0
    if not 4 * FEWEST <= int(goes.sum()) <= MOST * len(goes):
        return None
    low, high = (places[goes].quantile(share, dim=0) for share in (0.02, 0.98))
    longest = float((high - low).max())
    means = cloud.means.double()
    near = ((means > low - longest) & (means < high + longest)).all(-1) & (cloud.opacities > 0)
    points = means[near]
    part = connected_parts(points, max(longest / CELLS, 2 * particle_spacing(points)))
    inside = ((points >= low) & (points <= high)).all(-1)
    if not bool(inside.any()):
        return None
    own = points[part == int(part[inside].mode().values)]
    pad = PAD * longest
    return own.amin(0) - pad, own.amax(0) + pad


def moving_points(video: Footage, picture: RenderOutput) -> tuple[Tensor, Tensor]:
    """Follow points of a splat through a film, and take the shake of a hand off.

    Args:
        video: The film; the object is at rest in its first frame.
        picture: The splat, drawn from the camera of the first frame.

    Returns:
        The places in the splat of those that are seen for half of the film, (T, 3), and how far each goes at most, (T,)
        [pixels].
    """
    import numpy as np

    cv2: Any = opencv()
    grey = cv2.cvtColor(video.images[0].numpy(), cv2.COLOR_RGB2GRAY)
    cover = (picture.alpha[..., 0].detach().cpu().numpy() > SOLID).astype(np.uint8)
    around = (cv2.dilate(cover, np.ones((31, 31), np.uint8)) == 0).astype(np.uint8)
    corners = [cv2.goodFeaturesToTrack(grey, 600, 0.01, 5, mask=mask) for mask in (cover, around)]
    there, beside = (np.zeros((0, 2)) if one is None else one.reshape(-1, 2) + 0.5 for one in corners)
    position, seen = follow(video.images.numpy(), np.concatenate([there, beside]))
    world, known = in_space(picture, video.cameras[0], there)
    outside = position[:, len(there) :], seen[:, len(there) :]
    position, seen = position[:, : len(there)], seen[:, : len(there)]
    gone = np.zeros(len(there))
    K = video.cameras[0].intrinsics.double().numpy()
    for k in range(1, len(position)):
        used = known & seen[k]
        if len(beside) >= LEAST:  # what lies around the splat
            moved, valid = outside[0][k], outside[1][k]
            turn = cv2.estimateAffinePartial2D(outside[0][0][valid], moved[valid], ransacReprojThreshold=1.5)[0]
            start = position[0] if turn is None else position[0] @ turn[:, :2].T + turn[:, 2]
            far = np.linalg.norm(position[k] - start, axis=-1)[used]
        elif cover.mean() > FULL:
            far = off_camera(world[used], position[k, used], K, LEAST_MOTION)
        else:
            far = np.linalg.norm(position[k] - position[0], axis=-1)[used]
        if far is not None:
            gone[used] = np.maximum(gone[used], far)
    kept = known & (seen.mean(0) > 0.5)
    return torch.from_numpy(world[kept]), torch.from_numpy(gone[kept])


SHARE = 0.02
"""Share of a pixel from which what moves is seen in it."""

REACH = 0.25
"""Distance that what is simulated is expected to go, as a share of its longer side in the picture. What goes farther is
left to the robust estimates."""


class Background:
    """Draws a scene at rest, and says which pixels show what stands still.

    Args:
        simulation: The scene. What it moves is no background.
        also_moves: Names of parts of its splat that move in the film, too, though the simulation does not move them.

    Raises:
        ValueError: If there is no such part.
    """

    def __init__(self, simulation: Simulation, also_moves: Sequence[str] = ()) -> None:
        scene = simulation.scene
        self._painter, self._rest = simulation.painter, scene.rest()
        simulated = torch.zeros(len(self._rest.means), dtype=torch.bool)
        simulated[scene.moving.cpu()] = True
        named = torch.zeros_like(simulated)
        for name in also_moves:
            if scene.parts is None:
                raise ValueError(
                    f"`also_moves` names the part {name!r}, but the scene has no parts: set `scene.parts` in the base."
                )
            named |= scene.parts.mask(name)[scene.drawn]
        self.exists = not bool((simulated | named).all())
        self._moves = torch.stack([simulated, named, named], 1).to(self._rest.means)

    def draw(self, camera: Camera) -> tuple[RenderOutput, Tensor]:
        """The picture of the scene at rest, and its background: bool, on the CPU, shape (H, W)."""
        painter, rest = self._painter, self._rest
        camera = camera.to(painter.device)
        with torch.no_grad():
            picture = painter.picture(rest, camera)
            drawn = painter.renderer(rest.means, rest.covariances, painter.opacity(), self._moves, camera).color
        simulated, named, _ = (drawn > SHARE).cpu().unbind(-1)
        return picture, (picture.alpha[..., 0].cpu() > SOLID) & ~_widened(simulated) & ~named

    def overlap(self, camera: Camera) -> Overlap:
        """The offsets by which the picture of a camera shows the scene at rest beside its place."""
        return Overlap(self._painter, self._rest, camera)


def _widened(moving: Tensor) -> Tensor:
    """A mask (H, W) with all that is nearer to it than what moves is expected to go."""
    cv2 = opencv()
    rows, columns = moving.nonzero().unbind(1)
    if not len(rows):
        return moving
    side = 1 + max(int(rows.max() - rows.min()), int(columns.max() - columns.min()))
    return torch.from_numpy(cv2.distanceTransform((~moving).byte().numpy(), cv2.DIST_L2, 5)) <= REACH * side


LOOKS = 8
"""Frames that are compared with the first one to see whether a camera moves."""

DRAWN, FIRST = 2, 4
"""Pictures that are drawn for a frame, and for the first one."""

AGREE = 0.25
"""Least share of the points of a frame that agree on its camera."""

ASIDE = 0.02
"""Way that the picture goes, as a share of its longer side, after which the splat's overlap is another."""


@dataclass(frozen=True, eq=False)
class Motion:
    """The cameras of a film.

    Attributes:
        cameras: The camera of each frame.
        unseen: Frames that show too little of the background; their cameras lie between those of their neighbours.
        residual: Median over the frames of the root mean square distance of the points that agree [pixels].
        itself: Whether the film shows the thing itself, and not what the splat shows.
    """

    cameras: tuple[Camera, ...]
    unseen: tuple[int, ...]
    residual: float
    itself: bool


def moves_by(video: Footage, background: Background) -> float:
    """Distance that the background goes in the film of a camera that is said to stand still [pixels].

    It is the median over points and the largest of :data:`LOOKS` frames. Of each point only the motion across its edge
    counts, as nothing holds it along a plain pole. 0 if the background has too few points.
    """
    import numpy as np

    cv2 = opencv()
    _, still = background.draw(video.cameras[0])
    first = grey_of(video.images[0])
    corners = cv2.goodFeaturesToTrack(first, 300, 0.01, 7, mask=still.byte().numpy())
    if corners is None or len(corners) < LEAST:
        return 0.0
    start, most = corners.reshape(-1, 2) + 0.5, 0.0
    column, row = corners.reshape(-1, 2).round().astype(int).T
    across = cv2.cornerEigenValsAndVecs(first, 7, 3)[row, column, 2:4]
    last = len(video.times) - 1
    for k in sorted({round(last * (n + 1) / LOOKS) for n in range(LOOKS)}):
        pair = np.stack([first, grey_of(video.images[k])])[..., None].repeat(3, -1)
        position, seen = follow(pair, start)
        if seen[1].sum() >= LEAST:
            most = max(most, float(np.median(abs(((position[1] - start) * across)[seen[1]].sum(-1)))))
    return most


def stands_still(video: Footage) -> bool:
    """True if all frames of a video are said to have the same camera."""
    views = torch.stack([camera.world_to_camera for camera in video.cameras])
    return bool((views == views[:1]).all())


def follow_camera(video: Footage, background: Background) -> Motion:
    """Find the camera of each frame.

    Args:
        video: The film. Its cameras may be those of the first frame, or rough ones of all frames.
        background: What stands still.
    """
    found: list[Registration | None] = []
    residuals: list[float] = []
    last: Camera | None = None
    overlap: Overlap | None = None
    itself: bool | None = None
    probes = _probes(video.cameras[0], background)
    for k, given in enumerate(video.cameras):
        camera = given if last is None else _carried(given, video.cameras[k - 1], last)
        seen = None
        for number in range(FIRST if last is None else DRAWN):
            near = last is not None or number > 0
            if near and itself is not False and (overlap is None or _goes(overlap.camera, camera, probes)):
                overlap = background.overlap(camera)
            picture, still = background.draw(camera)
            here = refine(video.images[k], picture, camera, still, overlap, itself)
            if here is None or here.agreeing < AGREE * here.matches:
                seen = None
                break
            seen, camera = here, here.camera
        if seen is not None and itself is None:
            itself = seen.itself
        last = camera
        found.append(seen)
        residuals += [] if seen is None else [seen.residual]
    unseen = tuple(k for k, camera in enumerate(found) if camera is None)
    if 2 * len(unseen) > len(found):
        raise ValueError(
            f"The camera {video.name!r} moves, but {len(unseen)} of its {len(found)} frames show too little of what "
            "stands still in the splat: stand it on a tripod, or film something still and textured, too, and have it "
            "in the splat."
        )
    cameras = smoothed(found, video.times, probes[0])
    like = video.cameras[0].world_to_camera
    cameras = [replace(camera, world_to_camera=camera.world_to_camera.to(like)) for camera in cameras]
    return Motion(tuple(cameras), unseen, float(torch.tensor(residuals).median()), bool(itself))


def smoothed(found: Sequence[Registration | None], times: Sequence[float], pivot: Tensor) -> list[Camera]:
    """Smooth cameras in time, and fill in those that are missing from their neighbours.

    Six numbers are smoothed: the rotation, and where the camera sees a point in the middle of the background. An error
    of the rotation hardly changes the latter.

    Args:
        found: The cameras; None where one is missing.
        times: Their times [s].
        pivot: The point [scene units], float64, shape (3,).
    """
    import numpy as np

    known = [(time, one) for time, one in zip(times, found, strict=True) if one is not None]
    moments, base = [time for time, _ in known], known[0][1].camera.world_to_camera[:3, :3]
    numbers, errors = torch.zeros(2, len(known), 6, dtype=torch.float64)
    for k, (_, one) in enumerate(known):
        view = one.camera.world_to_camera
        seen = view[:3, :3] @ pivot
        numbers[k] = torch.cat([_turn_between(base, view[:3, :3]), seen + view[:3, 3]])
        change = torch.eye(6, dtype=torch.float64)
        change[3:, :3] = -torch.linalg.cross(seen.expand(3, 3), torch.eye(3, dtype=torch.float64)).T
        errors[k] = (change @ one.spread @ change.T).diagonal().sqrt()
    own = [smooth(*pair) for pair in zip(numbers.T.numpy(), errors.T.numpy(), strict=True)]
    filled = torch.from_numpy(np.stack([np.interp(times, moments, one) for one in own], 1))
    result = []
    for turn, place in zip(*filled.split(3, 1), strict=True):
        view = torch.eye(4, dtype=torch.float64)
        view[:3, :3] = rotation_of(turn) @ base
        view[:3, 3] = place - view[:3, :3] @ pivot
        result.append(replace(known[0][1].camera, world_to_camera=view))
    return result


def smooth(values: Any, errors: Any) -> Any:
    """The most likely course of a number whose second differences are random, seen with noise.

    It minimises the sum of squares of noise over its standard error and of second differences over their standard
    deviation, which has the largest marginal likelihood of a grid.

    Args:
        values: What was seen at equal steps of time, NumPy array, float64, shape (N,).
        errors: Standard errors, shape (N,).

    Returns:
        Shape (N,); with fewer than four values these.
    """
    import numpy as np
    from scipy.linalg import cho_solve_banded, cholesky_banded

    count = len(values)
    if count < 4:
        return values
    rough, difference = np.zeros((3, count)), (1.0, -2.0, 1.0)
    for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)):  # upper bands of the squares of second differences
        rough[2 - j + i, j : count - 2 + j] += difference[i] * difference[j]
    weights, best, found = errors**-2.0, -np.inf, values
    for variance in np.median(errors) ** 2 * np.logspace(-6, 6, 49):
        bands = rough / variance
        bands[2] += weights
        factor = cholesky_banded(bands)
        course = cho_solve_banded((factor, False), weights * values)
        likelihood = (weights * values * course).sum() - 2 * np.log(factor[2]).sum() - (count - 2) * np.log(variance)
        if likelihood > best:
            best, found = likelihood, course
    return found


def _turn_between(first: Tensor, second: Tensor) -> Tensor:
    """Axis times angle [rad] of the rotation from one matrix to another (3,)."""
    return torch.from_numpy(opencv().Rodrigues((second @ first.T).numpy())[0][:, 0])


def _carried(given: Camera, before: Camera, found: Camera) -> Camera:
    """A camera moved from the last frame's, which was found, as the given ones move; still if they are."""
    there, then, now = (c.world_to_camera.double().cpu() for c in (found, before, given))
    return replace(given, world_to_camera=now @ torch.linalg.inv(then) @ there, intrinsics=found.intrinsics)


def _goes(camera: Camera, other: Camera, probes: Tensor) -> bool:
    """True if two cameras see some points (N, 3) so differently that the splat's overlap is another."""
    here, there = (project(probes, one.to("cpu", torch.float64))[0] for one in (camera, other))
    return float((here - there).norm(dim=-1).amax()) > ASIDE * max(camera.width, camera.height)


def _probes(camera: Camera, background: Background) -> Tensor:
    """Points that a camera sees (4, 3): in the middle of the picture, as far away as the background is, and beside it.

    The others are to the right, below and nearer, so that they also tell if a camera rolls, comes nearer, or walks
    around the first.
    """
    picture, still = background.draw(camera)
    depth = (picture.depth / picture.alpha.clamp(min=1e-3))[..., 0].cpu()
    far = float(depth[still if bool(still.any()) else depth > 0].median())
    view, around = camera.world_to_camera.double().cpu(), torch.tensor([0.3, 0.3, -0.3], dtype=torch.float64)
    middle = camera.position.double().cpu() + far * view[2, :3]
    return torch.cat([middle[None], middle + far * around[:, None] * view[:3, :3]])


BLOCK = 4
"""Side of the squares over which colours are averaged [pixels], so that edges, noise and compression count little."""

DARK, BRIGHT = 8, 247
"""Mean grey level up to which a square tells nothing, and that of a pixel from which it may be cut off."""

FEWEST_SQUARES = 50
"""Fewest squares that make a gain."""


def gains(video: Footage, background: Background) -> tuple[Tensor, tuple[int, ...]] | None:
    """Brightness of each frame over that of the splat, by colour.

    Args:
        video: The film, with the camera of each frame.
        background: What stands still.

    Returns:
        Gains of red, green and blue, float64, shape (F, 3), and the frames that show too little of the background,
        which have those of their neighbours. None if all do.
    """
    import numpy as np

    found: list[Tensor | None] = []
    drawn: tuple[Camera, Tensor, Tensor] | None = None
    for camera, image in zip(video.cameras, video.images, strict=True):
        if drawn is None or drawn[0] is not camera:
            picture, still = background.draw(camera)
            drawn = (camera, 255 * picture.color.cpu().double(), still)
        found.append(gain_of(image.double(), *drawn[1:]))
    known = [k for k, one in enumerate(found) if one is not None]
    if not known:
        return None
    rows = np.stack([one.numpy() for one in found if one is not None])
    moments = [video.times[k] for k in known]
    filled = [np.interp(video.times, moments, own) for own in rows.T]
    return torch.from_numpy(np.stack(filled, 1)), tuple(k for k, one in enumerate(found) if one is None)


def gain_of(image: Tensor, picture: Tensor, still: Tensor) -> Tensor | None:
    """The gain of each colour, float64, shape (3,), between a picture and an image of grey levels up to 255 (H, W, 3).

    It is the median over squares of the mask ``still`` (H, W), weighed by their brightness in the picture, which
    minimises the sum of distances. None if there are too few squares.
    """
    inside = _averaged(still.double()[..., None])[:, 0] == 1
    seen, wanted = _averaged(image), _averaged(picture)
    cut = _averaged((torch.maximum(image, picture) >= BRIGHT).double())
    inside &= ((seen > DARK) & (wanted > DARK) & (cut == 0)).all(1)
    if int(inside.sum()) < FEWEST_SQUARES:
        return None
    return torch.stack([_median(s / w, w) for s, w in zip(seen[inside].T, wanted[inside].T, strict=True)])


def with_gains(images: Tensor, found: Sequence[Tensor] | Tensor) -> Tensor:
    """Frames (F, H, W, 3), uint8, divided by their gains (F, 3)."""
    out = torch.empty_like(images)  # a film may be large: no second list of its frames
    for one, image, gain in zip(out, images, found, strict=True):
        one.copy_((image.float() / gain.float()).round().clamp(0, 255))
    return out


def _averaged(picture: Tensor) -> Tensor:
    """Means over squares of a picture (H, W, C), shape (N, C)."""
    means = torch.nn.functional.avg_pool2d(picture.permute(2, 0, 1)[None], BLOCK)[0]
    return means.flatten(1).T


def _median(values: Tensor, weights: Tensor) -> Tensor:
    order = values.argsort()
    total = weights[order].cumsum(0)
    return values[order[int(torch.searchsorted(total, 0.5 * total[-1]))]]
