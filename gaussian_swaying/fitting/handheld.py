"""The motion of a hand-held camera, found frame by frame from the still background of the splat.

Each frame is compared with the splat at rest, drawn from where the last frame's camera was: points of the background
are followed from the picture to the frame, and a camera sees their places in space where the frame has them
(:func:`~gaussian_swaying.fitting.registration.refine`). So nothing drifts. Where the splat is drawn beside its place
(:class:`~gaussian_swaying.fitting.overlap.Overlap`) and the film is not, the points are moved there first.

A Kalman smoother for random accelerations, in the form of Whittaker (1923), then takes off noise: that of the
measurement is known from the points, and the accelerations are those of the largest likelihood, so that a shake that is
larger than the noise stays.

All rows of a frame count as taken at once: a rolling shutter is ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.fitting.background import Background
from gaussian_swaying.fitting.overlap import Overlap
from gaussian_swaying.fitting.registration import LEAST, Registration, grey_of, refine
from gaussian_swaying.fitting.tracks import follow, opencv
from gaussian_swaying.fitting.videos import Footage
from gaussian_swaying.geometry.rotations import rotation_of
from gaussian_swaying.rendering.cameras.camera import Camera, project

LOOKS = 8
"""Frames that are compared with the first one to see whether a camera moves."""
ROUNDS, FIRST = 2, 4
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
        for number in range(FIRST if last is None else ROUNDS):
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
