"""Registration: the camera of a frame, from the frame and the splat that it shows.

Features of pictures of the splat are matched with those of the frame (SIFT, Lowe 2004). The depth of a picture makes
points in space of them, and a camera sees these points where the frame has them (perspective-n-point with RANSAC). A
picture from there has more features in common with the frame, so it is done again. Where few are found, as in thin
things, points are followed from the picture to the frame by Lucas and Kanade's method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._checks import check_whole
from gaussian_swaying.fitting.overlap import Overlap, window_of
from gaussian_swaying.fitting.tracks import follow, opencv
from gaussian_swaying.rendering.cameras.camera import Camera, look_at_camera, project
from gaussian_swaying.rendering.protocol import RenderOutput

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
