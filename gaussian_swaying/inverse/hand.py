"""Films from a hand: the camera and the brightness of each frame, from what stands still in the splat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.inverse.registration import LEAST, SOLID, Beside, Registration, grey_of, refine
from gaussian_swaying.inverse.tracks import STILL, corners, drawn_beside, follow, opencv
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.simulation import Simulation

SHARE = 0.02  # share of a pixel from which what moves is seen in it
REACH = 0.25  # how far what is simulated goes, per its longer side in the picture
LOOKS = 8  # frames that are compared with the first one to see whether a camera moves
DRAWN, FIRST = 2, 4  # pictures that are drawn for a frame, and for the first one
AGREE, MANY = 0.25, 0.2  # share of points that agree on a camera; of frames without background in a doubtful fit
BLOCK = 4  # side of squares over which colours are averaged [pixels]
DARK, BRIGHT = 8, 247  # mean grey level that tells nothing, and that of a pixel which may be cut off
FEWEST_SQUARES = 50  # fewest squares that make a gain


class Background:
    """Draws a scene at rest, and says which pixels show what is not simulated, nor named in ``also_moves``."""

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

    @torch.no_grad()
    def draw(self, camera: Camera) -> tuple[RenderOutput, Tensor]:
        """The picture of the scene at rest, and its background: bool, on the CPU, shape (H, W)."""
        painter, rest = self._painter, self._rest
        camera = camera.to(painter.device)
        picture = painter.picture(rest, camera)
        drawn = painter.renderer(rest.means, rest.covariances, painter.opacity(), self._moves, camera).color
        simulated, named, _ = (drawn > SHARE).cpu().unbind(-1)
        return picture, (picture.alpha[..., 0].cpu() > SOLID) & ~_widened(simulated) & ~named

    def beside(self, camera: Camera, pixel: Any) -> Any:
        """How far the picture shows things beside where they are, at pixels, NumPy array, shape (N, 2)."""
        device = self._painter.device
        return drawn_beside(self._painter, self._rest, camera.to(device), torch.from_numpy(pixel)).numpy()


def _widened(moving: Tensor) -> Tensor:
    cv2 = opencv()
    rows, columns = moving.nonzero().unbind(1)
    if not len(rows):
        return moving
    side = 1 + max(int(rows.max() - rows.min()), int(columns.max() - columns.min()))
    return torch.from_numpy(cv2.distanceTransform((~moving).byte().numpy(), cv2.DIST_L2, 5)) <= REACH * side


def moves_by(video: Footage, background: Background) -> float:
    """Distance that the background goes in the film of a camera that is said to stand still [pixels]; 0 if unknown.

    Of each point only the motion across its edge counts, as nothing holds it along a plain pole.
    """
    cv2 = opencv()
    _, still = background.draw(video.cameras[0])
    first = grey_of(video.images[0])
    start, most = corners(first, 300, 0.01, 7, still.byte().numpy()), 0.0
    if len(start) < LEAST:
        return 0.0
    column, row = (start - 0.5).round().astype(int).T
    across = cv2.cornerEigenValsAndVecs(first, 7, 3)[row, column, 2:4]
    last = len(video.times) - 1
    for k in sorted({round(last * (n + 1) / LOOKS) for n in range(LOOKS)}):
        (_, position), (_, seen) = follow(np.stack([first, grey_of(video.images[k])]), start)
        if seen.sum() >= LEAST:
            most = max(most, float(np.median(abs(((position - start) * across)[seen].sum(-1)))))
    return most


def follow_camera(
    video: Footage, background: Background, tick: Callable[[int], object] = int
) -> tuple[Footage, tuple[int, ...], float]:
    """The video with the camera of each frame, from that of the first frame.

    The first frame tells by what fits better whether the film shows things where they are, or where the splat is drawn.
    Frames that show too little of the background are listed, and have a camera between those of their neighbours. The
    number is the median distance of points that agree [pixels].
    """
    found: list[Registration | None] = []
    camera = video.cameras[0]
    ways: tuple[Beside | None, ...] = (None, background.beside)
    for image in video.images:
        seen = None
        for _ in range(DRAWN if found else FIRST):
            picture, still = background.draw(camera)
            tried = {way: refine(image, picture, camera, still, way) for way in ways}
            seen = min(filter(None, tried.values()), key=lambda one: one.residual, default=None)
            if seen is None or seen.agreeing < AGREE * seen.matches:
                seen = None
                break
            camera = seen.camera
        if seen is not None:
            ways = tuple(way for way in ways if tried[way] is seen)
        found.append(seen)
        tick(1)
    unseen = tuple(k for k, camera in enumerate(found) if camera is None)
    if 2 * len(unseen) > len(found):
        raise ValueError(
            f"The camera {video.name!r} moves, but {len(unseen)} of its {len(found)} frames show too little of what "
            "stands still in the splat: stand it on a tripod, or film something still and textured, too, and have it "
            "in the splat."
        )
    residual = torch.tensor([one.residual for one in found if one is not None]).median()
    return replace(video, cameras=_filled(video, found)), unseen, float(residual)


def _filled(video: Footage, found: Sequence[Registration | None]) -> tuple[Camera, ...]:
    from scipy.spatial.transform import Rotation, Slerp

    known = [(time, one.camera) for time, one in zip(video.times, found, strict=True) if one is not None]
    moments, poses = [time for time, _ in known], torch.stack([one.world_to_camera.double() for _, one in known])
    poses = torch.linalg.inv(poses).numpy()
    times = np.clip(video.times, moments[0], moments[-1])
    pose = np.zeros((len(times), 4, 4)) + np.eye(4)
    pose[:, :3, :3] = Slerp(moments, Rotation.from_matrix(poses[:, :3, :3]))(times).as_matrix()
    pose[:, :3, 3] = np.stack([np.interp(times, moments, own) for own in poses[:, :3, 3].T], 1)
    views = torch.linalg.inv(torch.from_numpy(pose)).to(video.cameras[0].world_to_camera)
    return tuple(replace(known[0][1], world_to_camera=view) for view in views)


def gains(video: Footage, background: Background) -> Tensor | None:
    """Brightness of each frame over that of the splat in red, green and blue, float64, shape (F, 3).

    Frames that show too little of the background have those of their neighbours; None if all do.
    """
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
    filled = [np.interp(video.times, [video.times[k] for k in known], own) for own in rows.T]
    return torch.from_numpy(np.stack(filled, 1))


def gain_of(image: Tensor, picture: Tensor, still: Tensor) -> Tensor | None:
    """The gain of each colour, float64, shape (3,), between a picture and an image of grey levels up to 255 (H, W, 3).

    It is the median over squares of the mask ``still`` (H, W); None if there are too few.
    """
    inside = _averaged(still.double()[..., None])[:, 0] == 1
    seen, wanted = _averaged(image), _averaged(picture)
    cut = _averaged((torch.maximum(image, picture) >= BRIGHT).double())
    inside &= ((seen > DARK) & (wanted > DARK) & (cut == 0)).all(1)
    return (seen / wanted)[inside].median(0).values if int(inside.sum()) >= FEWEST_SQUARES else None


def with_gains(images: Tensor, found: Sequence[Tensor] | Tensor) -> Tensor:
    """Frames (F, H, W, 3), uint8, divided by their gains (F, 3)."""
    out = torch.empty_like(images)  # a film may be large: no second list of its frames
    for one, image, gain in zip(out, images, found, strict=True):
        one.copy_((image.float() / gain.float()).round().clamp(0, 255))
    return out


def _averaged(picture: Tensor) -> Tensor:
    return torch.nn.functional.avg_pool2d(picture.permute(2, 0, 1)[None], BLOCK)[0].flatten(1).T


def prepared(
    simulation: Simulation,
    videos: Sequence[Footage],
    hand_held: bool | None = None,
    also_moves: Sequence[str] = (),
    tick: Callable[[int], object] = int,
) -> tuple[list[Footage], list[str], list[str]]:
    """Find the camera of each frame of films from a hand, and take drifts of exposure and white balance off all films.

    Returns:
        The films, and sentences: what the background says of them, if the splat has one, and what speaks against them.
    """
    background = Background(simulation, also_moves)
    if not background.exists:
        if hand_held:
            raise ValueError(
                "`hand_held` needs something that stands still in the splat, but all of it moves: stand the camera on "
                "a tripod, or have something still and textured, too, in the film and in the splat."
            )
        return list(videos), [], []
    found, told, doubts = [], list[str](), list[str]()
    for video in videos:
        still = all(torch.equal(video.cameras[0].world_to_camera, camera.world_to_camera) for camera in video.cameras)
        moved = moves_by(video, background) if still and hand_held is not False else 0.0
        if hand_held or (moved > STILL and hand_held is None):
            video, unseen, residual = follow_camera(video, background, tick)
            told.append(
                f"camera {video.name}: held in a hand; its background goes {moved:.3g} pixels. The camera of each "
                f"frame was found, {residual:.2f} pixels off."
            )
            if len(unseen) > MANY * len(video.times):
                doubts.append(
                    f"camera {video.name}: {len(unseen)} of {len(video.times)} frames show too little of what stands "
                    "still, and have the camera of their neighbours: film more of it, or from a tripod."
                )
        if (bright := gains(video, background)) is not None:
            video = replace(video, images=with_gains(video.images, bright))
            rows = zip(("red", "green", "blue"), bright.amin(0).tolist(), bright.amax(0).tolist(), strict=True)
            divided = ", ".join(f"{name} {low:.2f} to {high:.2f}" for name, low, high in rows)
            told.append(f"camera {video.name}: as bright as the splat now; the frames were divided by {divided}.")
        found.append(video)
    return found, told, doubts
