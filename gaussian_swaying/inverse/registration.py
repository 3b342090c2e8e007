"""The camera of a frame, from the splat that it shows."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.origin import Origin
from gaussian_swaying.inverse.plan import FILM_START
from gaussian_swaying.inverse.tracks import ALIKE, GREY, alike, corners, follow, opencv, picture_of
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.rendering.cameras.camera import Camera, orbit_camera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.simulation import Simulation
from gaussian_swaying.suggestion.up import guess_up

RATIO = 0.8  # largest distance of a feature to its match, per that to the next best one (Lowe 2004)
NEAR, CLOSE = 0.006, 1.5  # distance of points that agree on a camera, per diagonal; of followed ones [pixels]
LEAST, ENOUGH = 12, 60  # fewest matches that make a camera, and features that agree with which none need to be followed
SOLID = 0.9  # least opacity of the picture at a feature, whose depth is then known
REFINED, ROUNDS = 5, 3  # times that agreeing points are chosen anew, and pictures from a camera that is near
VIEW, ROOM = 50.0, 1.3  # field of view that is tried first [degrees], and distance per that of a full picture
FOUND = 0.2  # least share of the points of the splat's picture that look alike in a frame that shows it
AWAY = 3.0  # largest distance of a first frame from the splat at rest [pixels]
LARGER, ASIDE = 1.08, 10.0  # ratio of distances, and angle [degrees], from which a camera is another one
PICTURE, CAMERAS = "registration.png", "transforms.json"
STILLS = (".png", ".jpg", ".jpeg")
Draw = Callable[[Camera], RenderOutput]  # draws the splat, at rest
Beside = Callable[[Camera, Any], Any]  # how far its picture shows things beside where they are, at pixels (N, 2)


@dataclass(frozen=True, eq=False)
class Registration:
    """The camera of a frame, the points that were matched and agree on it, and their root mean square [pixels]."""

    camera: Camera
    matches: int
    agreeing: int
    residual: float


def painter_of(cloud: GaussianCloud) -> Draw:
    """A function that draws a splat on black, in the colours that it has from all sides."""
    from gaussian_swaying.rendering.gsplat_renderer import make_renderer

    renderer = make_renderer(torch.device("cpu"))
    shape, colour = covariance(cloud.quats, cloud.scales), (0.5 + SH_DC * cloud.sh[:, 0]).clamp(0, 1)

    @torch.no_grad()
    def draw(camera: Camera) -> RenderOutput:
        return renderer(cloud.means, shape, cloud.opacities.sigmoid(), colour, camera.to(dtype=torch.float32))

    return draw


def register(
    frame: Tensor, cloud: GaussianCloud, up: Sequence[float] | None = None, fov: float | None = None
) -> tuple[Registration, RenderOutput]:
    """Find the camera of a frame, uint8 (H, W, 3), of a splat at rest, and the picture of the splat from there.

    What is up in the splat (3,), and the vertical field of view [degrees], are guessed and found if they are None.
    """
    splat, draw, generator = Gaussians.of(cloud), painter_of(cloud), torch.Generator().manual_seed(0)
    height, width = frame.shape[:2]
    up, view = guess_up(splat)[0].direction if up is None else up, VIEW if fov is None else fov
    some = torch.multinomial(torch.from_numpy(splat.weight), 10_000, replacement=True, generator=generator)
    low, high = (torch.quantile(cloud.means[some], share, dim=0) for share in (0.02, 0.98))
    away = ROOM * 0.5 * float((high - low).norm()) / (math.tan(math.radians(view) / 2) * min(1.0, width / height))
    around = cameras_around(0.5 * (low + high), away, up, view, width, height)
    found = find_camera(draw, frame, around, focal=fov is None)
    return found, draw(found.camera)


def cameras_around(
    center: Sequence[float] | Tensor, distance: float, up: Sequence[float] | Tensor, fov: float, width: int, height: int
) -> list[Camera]:
    """Cameras around an object at a distance [scene units] from which a registration may start."""
    turns = ((azimuth, elevation) for elevation in (0.0, 30.0) for azimuth in range(0, 360, 30))
    return [orbit_camera(center, up, distance, *turn, fov, width, height, dtype=torch.float64) for turn in turns]


def fov_of(camera: Camera) -> float:
    """Vertical field of view [degrees]."""
    return 2 * math.degrees(math.atan(0.5 * camera.height / float(camera.intrinsics[1, 1])))


def transforms(camera: Camera, film: str, origin: Origin) -> dict[str, Any]:
    """The content of a transforms.json with one film, or one picture, at time 0; ``origin`` is that of the splat."""
    pose = torch.linalg.inv(camera.world_to_camera.double()) @ torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]).double())
    pose[:3, 3] += torch.tensor(origin, dtype=torch.float64)
    K = camera.intrinsics.double()
    kind = "file_path" if Path(film).suffix.lower() in STILLS else "video_path"
    return {
        "fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2]),
        "w": camera.width, "h": camera.height,
        "frames": [{kind: Path(film).as_posix(), "transform_matrix": pose.tolist(), "time": 0.0}],
    }  # fmt: skip


def find_camera(draw: Draw, frame: Tensor, start: Sequence[Camera], *, focal: bool = False) -> Registration:
    """Find the camera of a frame, uint8 (H, W, 3), of something at rest, without lens distortion.

    Of the cameras to start with, of the frame's size, that with the most matches is taken; one is enough within some 20
    degrees. The ``focal`` length needs depth in what is seen.

    Raises:
        ValueError: If the splat is not found in the frame.
    """
    grey = grey_of(frame)
    sift = opencv().SIFT_create(nfeatures=4000, contrastThreshold=0.02)
    wanted = sift.detectAndCompute(grey, None)
    tried = [_by_features(sift, wanted, draw(camera), camera) for camera in start]
    best = max((one for one in tried if one is not None), key=lambda one: one.agreeing, default=None)
    if best is None:
        raise ValueError(
            "The splat was not found in the frame: give a camera that is nearer, a frame that shows more of it, or one "
            "with more texture."
        )
    for _ in range(ROUNDS):
        best = _by_features(sift, wanted, draw(best.camera), best.camera, focal) or best
    for _ in range(ROUNDS if best.agreeing < ENOUGH else 0):
        best = _by_flow(grey, draw(best.camera), best.camera, focal) or best
    return best


def refine(
    frame: Tensor, picture: RenderOutput, camera: Camera, where: Tensor, beside: Beside | None = None
) -> Registration | None:
    """The camera of a frame from a picture from nearby, of whose pixels ``where`` (H, W) count; None if too few agree.

    Most points may have moved by some 20 pixels. A frame that shows things where they are needs ``beside``.
    """
    return _by_flow(grey_of(frame), picture, camera, False, _near(camera), where, beside)


def _near(camera: Camera) -> float:
    return NEAR * math.hypot(camera.width, camera.height)


def grey_of(image: Tensor) -> Any:
    """An image of bytes or of colours in [0, 1], (H, W, 3), as grey bytes whose contrast is the same everywhere."""
    whole = image.float() if image.dtype == torch.uint8 else image.detach().float().cpu().clamp(0, 1) * 255
    equal = opencv().createCLAHE(clipLimit=3.0, tileGridSize=(8, 8))  # takes what another light changes
    return equal.apply((whole @ GREY).round().to(torch.uint8).numpy())


def in_space(picture: RenderOutput, camera: Camera, pixel: Any) -> tuple[Any, Any]:
    """Places on the surface that pixels (N, 2) of a picture show, float64, and a mask of those whose depth is known."""
    cv2, alpha = opencv(), picture.alpha[..., 0].detach().cpu().numpy()
    depth = picture.depth[..., 0].detach().cpu().numpy() / np.maximum(alpha, 1e-3)
    if not len(pixel):
        return np.zeros((0, 3)), np.zeros(0, dtype=bool)
    at = (pixel - 0.5).astype(np.float32)[None]
    known = cv2.remap(cv2.erode(alpha, np.ones((3, 3))), at, None, cv2.INTER_NEAREST)[0] > SOLID
    z = cv2.remap(depth, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)[0].astype(float)
    ray = np.concatenate([pixel, np.ones_like(pixel[:, :1])], 1) @ np.linalg.inv(camera.intrinsics.double().numpy()).T
    view = camera.world_to_camera.double().cpu().numpy()
    return (z[:, None] * ray - view[:3, 3]) @ view[:3, :3], known


def off_camera(world: Any, there: Any, intrinsics: Any, near: float) -> Any:
    """Distances of points (T, 3) from where the camera sees them that agrees with most of their places (T, 2) [pixels].

    Points agree that are nearer than ``near`` [pixels]. Shape (T,); None if less than half of them agree on a camera.
    """
    found = _pose(world, there, intrinsics, near) if len(world) >= 8 else None
    return None if found is None or 2 * int(found[0].sum()) < len(world) else found[3]


def _pose(world: Any, there: Any, K: Any, near: float) -> tuple[Any, Any, Any, Any] | None:
    cv2, how = opencv(), {"iterationsCount": 2000, "confidence": 0.9999, "flags": opencv().SOLVEPNP_AP3P}
    done, turn, shift, agree = cv2.solvePnPRansac(world, there, K, None, reprojectionError=near, **how)
    if not done:
        return None
    agree = np.isin(np.arange(len(world)), agree)
    for _ in range(REFINED):
        turn, shift = cv2.solvePnPRefineLM(world[agree], there[agree], K, None, turn, shift)
        off = np.linalg.norm(cv2.projectPoints(world, turn, shift, K, None)[0].reshape(-1, 2) - there, axis=-1)
        agree = off < near
        if agree.sum() < 4:
            return None
    return agree, turn, shift, off


def _by_features(
    sift: Any, wanted: tuple[Any, Any], picture: RenderOutput, camera: Camera, focal: bool = False
) -> Registration | None:
    mask = (picture.alpha[..., 0].detach().cpu().numpy() > SOLID).astype(np.uint8)
    points, codes = sift.detectAndCompute(grey_of(picture.color), mask)
    if codes is None or wanted[1] is None or len(points) < LEAST or len(wanted[0]) < LEAST:
        return None
    pairs = opencv().BFMatcher().knnMatch(codes, wanted[1], k=2)
    good = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < RATIO * pair[1].distance]
    if len(good) < LEAST:
        return None
    here = np.array([points[one.queryIdx].pt for one in good]) + 0.5  # OpenCV counts from the centre of a pixel
    there = np.array([wanted[0][one.trainIdx].pt for one in good]) + 0.5
    return _seen_from(picture, camera, here, there, focal, _near(camera))


def _by_flow(
    grey: Any, picture: RenderOutput, camera: Camera, focal: bool, near: float = CLOSE, where: Tensor | None = None,
    beside: Beside | None = None,
) -> Registration | None:  # fmt: skip
    cv2, drawn = opencv(), grey_of(picture.color)
    solid = picture.alpha[..., 0].detach().cpu().numpy() > SOLID
    solid = solid if where is None else solid & where.numpy()
    mask = cv2.erode(solid.astype(np.uint8), np.ones((5, 5), np.uint8))
    here = corners(drawn, 1000, 0.005, 3, mask)
    if len(here) < LEAST:
        return None
    (_, place), (_, seen) = follow(np.stack([drawn, grey]), here)
    there = place[seen] if beside is None else place[seen] + beside(camera, here[seen])
    return _seen_from(picture, camera, here[seen], there, focal, near)


def _seen_from(
    picture: RenderOutput, camera: Camera, here: Any, there: Any, focal: bool, near: float
) -> Registration | None:
    """The camera that sees what the picture shows at ``here`` at ``there``; None if too few pairs agree."""
    cv2, K = opencv(), camera.intrinsics.double().cpu().numpy()
    world, known = in_space(picture, camera, here)
    world, there = world[known], np.ascontiguousarray(there[known], dtype=np.float64)
    pose = _pose(world, there, K, near) if len(world) >= LEAST else None
    if pose is None or pose[0].sum() < LEAST:
        return None
    agree, turn, shift, _ = pose
    world, there = world[agree], there[agree]
    if focal:
        flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_PRINCIPAL_POINT | cv2.CALIB_FIX_ASPECT_RATIO
        flags |= cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3
        size = (camera.width, camera.height)
        given = ([world.astype(np.float32)], [there.astype(np.float32)], size, K.copy(), None)
        _, K, _, (turn,), (shift,) = cv2.calibrateCamera(*given, flags=flags)
    off = cv2.projectPoints(world, turn, shift, K, None)[0].reshape(-1, 2) - there
    view = np.eye(4)
    view[:3, :3], view[:3, 3] = cv2.Rodrigues(turn)[0], shift.reshape(3)
    seen = replace(camera, world_to_camera=torch.from_numpy(view), intrinsics=torch.from_numpy(np.asarray(K, float)))
    return Registration(seen, int(known.sum()), len(world), float(np.sqrt((off**2).sum(1).mean())))


def shown_in(picture: RenderOutput, frame: Tensor) -> tuple[float, float, float]:
    """Share of the points of the splat's picture that are alike in a frame (H, W, 3).

    And how far half and three quarters of them are at most [pixels].
    """
    drawn, real = grey_of(picture.color), grey_of(frame)
    mask = (picture.alpha[..., 0].detach().cpu().numpy() > SOLID).astype(np.uint8)
    start = corners(drawn, 300, 0.01, 5, mask)
    if not len(start):
        return 0.0, math.inf, math.inf
    pair = np.stack([drawn, real])
    place, seen = follow(pair, start)
    good = torch.from_numpy(seen[1]) & (alike(torch.from_numpy(pair)[..., None], torch.from_numpy(place)) > ALIKE)
    off = torch.from_numpy(place[1] - place[0])[good].norm(dim=-1)
    half, most = off.quantile(torch.tensor([0.5, 0.75]).to(off)).tolist() if len(off) else (math.inf, math.inf)
    return float(good.double().mean()), half, most


def first_look(simulation: Simulation, video: Footage, earliest: float | None) -> list[str]:
    """A sentence if the camera of a video is not where it is said to be, or if the video begins in motion.

    ``earliest`` is the low end of the range of ``film.start`` [s], None if that is not sought. A film that may begin in
    motion may look like anything in its first frame; ValueError if any other does not show the splat.
    """
    from scipy.spatial.transform import Rotation

    rest, frame, given = simulation.scene.rest(), video.images[0], video.cameras[0]

    def draw(camera: Camera) -> RenderOutput:
        return picture_of(simulation, rest, camera.to(dtype=torch.float32))

    share, off, most = shown_in(draw(given), frame)
    other = None if share >= FOUND and off <= AWAY else _elsewhere(draw, frame, given, share)
    if other is None and share < FOUND and (earliest is None or earliest >= 0):
        raise ValueError(
            f"The first frame of camera {video.name} does not show the splat where its camera looks: give a film of "
            "this splat, or find its camera with `gaussian-swaying camera FILM SPLAT` (its places may be in another "
            f"unit); if it begins in motion, add {FILM_START}: {{range: [-1, 0]}} to `unknowns`."
        )
    if other is None:
        told = (
            f"The first frame of camera {video.name} is {most:.2g} pixels away from the splat at rest: the film begins "
            f"in motion. Add {FILM_START}: {{range: [-1, 0]}} to `unknowns`, or give a film that begins at rest."
        )
        return [told] if earliest is None and most > AWAY else []
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
    better, off, _ = shown_in(draw(found), frame)
    return found if better >= max(FOUND, share) and off < 0.5 * AWAY else None
