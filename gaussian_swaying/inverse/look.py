"""A first look at a film: whether its first frame shows the splat, and from where its camera says."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gaussian_swaying.inverse.registration import SOLID, Draw, find_camera, grey_of
from gaussian_swaying.inverse.tracks import ALIKE, alike, corners, follow
from gaussian_swaying.inverse.unknowns import FILM_START
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.simulation import Simulation

FOUND = 0.2
"""Least share of the points of the splat's picture that look alike in a frame that shows it."""

AWAY = 3.0
"""Largest distance between points of the splat at rest and those of a first frame that shows it at rest [pixels]."""

LARGER, ASIDE = 1.08, 10.0
"""Ratio of distances, and angle [degrees], from which a camera is another one; less may be the motion of the splat."""


def shown_in(picture: RenderOutput, frame: Tensor) -> tuple[float, float]:
    """Share of the points of a picture of the splat that are alike in a frame (H, W, 3), and how far they are [pixels].

    Each is followed from the picture to the frame; the distance is a median.
    """
    import numpy as np

    drawn, real = grey_of(picture.color), grey_of(frame)
    mask = (picture.alpha[..., 0].detach().cpu().numpy() > SOLID).astype(np.uint8)
    start = corners(drawn, 300, 0.01, 5, mask)
    if not len(start):
        return 0.0, math.inf
    pair = np.stack([drawn, real])
    place, seen = follow(pair, start)
    good = torch.from_numpy(seen[1]) & (alike(torch.from_numpy(pair)[..., None], torch.from_numpy(place)) > ALIKE)
    off = torch.from_numpy(place[1] - place[0])[good].norm(dim=-1)
    return float(good.double().mean()), float(off.median()) if len(off) else math.inf


def first_look(simulation: Simulation, video: Footage, moving: bool) -> list[str]:
    """A sentence if the camera of a video is not where it is said to be; ValueError if it does not show the splat.

    A film that begins in motion may look like anything in its first frame.
    """
    from scipy.spatial.transform import Rotation

    painter, rest, frame, given = simulation.painter, simulation.scene.rest(), video.images[0], video.cameras[0]

    def draw(camera: Camera) -> RenderOutput:
        with torch.no_grad():
            return painter.picture(rest, camera.to(painter.device, torch.float32))

    share, off = shown_in(draw(given), frame)
    other = None if share >= FOUND and off <= AWAY else _elsewhere(draw, frame, given, share)
    if other is None and share < FOUND and not moving:
        raise ValueError(
            f"The first frame of camera {video.name} does not show the splat where its camera looks: give a film of "
            "this splat, or find its camera with `gaussian-swaying camera FILM SPLAT` (its places may be in another "
            f"unit); if it begins in motion, add {FILM_START}: {{range: [-1, 0]}} to `unknowns`."
        )
    if other is None:
        return []
    middle = rest.means.double().cpu().mean(0)
    near, far = ((camera.position.double().cpu() - middle).norm() for camera in (other, given))
    larger = float(far / near)
    turn = other.world_to_camera[:3, :3].double().cpu() @ given.world_to_camera[:3, :3].double().cpu().T
    angle = math.degrees(Rotation.from_matrix(turn.numpy()).magnitude())
    if max(larger, 1 / larger) < LARGER and angle < ASIDE:
        return []
    return [
        f"The first frame of camera {video.name} shows the splat {larger:.2f} times as large and {angle:.0f} degrees "
        "from where its `transform_matrix` says: its places are in another unit than the splat, or it is another "
        "camera. Find it with `gaussian-swaying camera FILM SPLAT`."
    ]


def _elsewhere(draw: Draw, frame: Tensor, given: Camera, share: float) -> Camera | None:
    """Another camera, from which more than a share of the splat's points are alike in a frame; None if none is."""
    try:
        found = find_camera(draw, frame, [given]).camera
    except ValueError:
        return None
    better, off = shown_in(draw(found), frame)
    return found if better >= max(FOUND, share) and off < 0.5 * AWAY else None
