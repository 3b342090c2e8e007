"""The camera of a frame, and of each frame of a film from a hand, from the splat that they show."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

from gaussian_swaying.gaussians.cloud import GaussianCloud
from gaussian_swaying.gaussians.harmonics import SH_DC
from gaussian_swaying.gaussians.measures import Gaussians
from gaussian_swaying.geometry.covariances import covariance
from gaussian_swaying.geometry.origin import Origin
from gaussian_swaying.inverse.plan import FILM_START
from gaussian_swaying.inverse.tracks import ALIKE, GREY, STILL, alike, corners, drawn_beside, follow, opencv, picture_of
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.rendering.cameras.camera import Camera, orbit_camera
from gaussian_swaying.rendering.gsplat_renderer import make_renderer
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
SHARE = 0.02  # share of a pixel from which what moves is seen in it
REACH = 0.25  # how far what is simulated goes, per its longer side in the picture
LOOKS = 8  # frames that are compared with the first one to see whether a camera moves
DRAWN, FIRST = 2, 4  # pictures that are drawn for a frame, and for the first one
AGREE, MANY = 0.25, 0.2  # share of points that agree on a camera; of frames without background in a doubtful fit
BLOCK = 4  # side of squares over which colours are averaged [pixels]
DARK, BRIGHT = 8, 247  # mean grey level that tells nothing, and that of a pixel which may be cut off
FEWEST_SQUARES = 50  # fewest squares that make a gain
Draw = Callable[[Camera], RenderOutput]  # draws the splat, at rest


@dataclass(frozen=True, eq=False)
class Registration:
    """The camera of a frame, the points that were matched and agree on it, and their root mean square [pixels]."""

    camera: Camera
    matches: int
    agreeing: int
    residual: float


def painter_of(cloud: GaussianCloud) -> Draw:
    """A function that draws a splat on black, in the colours that it has from all sides."""
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
        raise ValueError("The splat was not found in the frame: give a nearer camera, or a frame with more texture.")
    for _ in range(ROUNDS):
        best = _by_features(sift, wanted, draw(best.camera), best.camera, focal) or best
    for _ in range(ROUNDS if best.agreeing < ENOUGH else 0):
        best = by_flow(grey, draw(best.camera), best.camera, focal, CLOSE) or best
    return best


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


def pose_of(world: Any, there: Any, K: Any, near: float) -> tuple[Any, Any, Any, Any] | None:
    """The camera that sees points (T, 3) where most of their places (T, 2) are [pixels]; None if too few agree.

    A mask of the points that agree, by less than ``near`` [pixels], rotation, shift, and distances of all [pixels].
    """
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
    return _seen_from(picture, camera, here, there, focal)


def by_flow(
    grey: Any, picture: RenderOutput, camera: Camera, focal: bool = False, near: float = 0, where: Tensor | None = None,
    beside: Callable[[Camera, Any], Any] | None = None,
) -> Registration | None:  # fmt: skip
    """The camera of a frame, as :func:`grey_of` has it, from a picture from nearby; None if too few points agree.

    Most points may have moved by some 20 pixels. Only pixels ``where`` (H, W) count; ``near`` 0 is what is usual. A
    frame that shows things where they are needs ``beside``.
    """
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
    picture: RenderOutput, camera: Camera, here: Any, there: Any, focal: bool, near: float = 0
) -> Registration | None:
    """The camera that sees what the picture shows at ``here`` at ``there``; None if too few pairs agree."""
    cv2, K = opencv(), camera.intrinsics.double().cpu().numpy()
    world, known = in_space(picture, camera, here)
    world, there = world[known], np.ascontiguousarray(there[known], dtype=np.float64)
    near = near or NEAR * math.hypot(camera.width, camera.height)
    pose = pose_of(world, there, K, near) if len(world) >= LEAST else None
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
    rest, frame, given = simulation.scene.rest(), video.images[0], video.cameras[0]

    def draw(camera: Camera) -> RenderOutput:
        return picture_of(simulation, rest, camera.to(dtype=torch.float32))

    share, off, most = shown_in(draw(given), frame)
    other = None
    if share < FOUND or off > AWAY:
        with suppress(ValueError):  # it is not found from another camera either
            found = find_camera(draw, frame, [given]).camera
            better, left, _ = shown_in(draw(found), frame)
            other = found if better >= max(FOUND, share) and left < 0.5 * AWAY else None
    if other is None and share < FOUND and (earliest is None or earliest >= 0):
        raise ValueError(
            f"The first frame of camera {video.name} does not show the splat where its camera looks: give a film of "
            "this splat, or find its camera with `gaussian-swaying camera FILM SPLAT` (its places may be in another "
            f"unit); if it begins in motion, add {FILM_START}: {{range: [-1, 0]}} to `unknowns`."
        )
    if other is None and (earliest is not None or most <= AWAY):
        return []
    if other is None:
        return [
            f"The first frame of camera {video.name} is {most:.2g} pixels away from the splat at rest: the film begins "
            f"in motion. Add {FILM_START}: {{range: [-1, 0]}} to `unknowns`, or give a film that begins at rest."
        ]
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
                raise ValueError(f"`also_moves` has {name!r}, but the scene has no parts: set `scene.parts`.")
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
        if bool(simulated.any()):
            cv2, places = opencv(), simulated.nonzero()
            side = 1 + int((places.amax(0) - places.amin(0)).max())
            away = cv2.distanceTransform((~simulated).byte().numpy(), cv2.DIST_L2, 5)
            simulated = torch.from_numpy(away) <= REACH * side
        return picture, (picture.alpha[..., 0].cpu() > SOLID) & ~simulated & ~named

    def beside(self, camera: Camera, pixel: Any) -> Any:
        """How far the picture shows things beside where they are, at pixels, NumPy array, shape (N, 2)."""
        device = self._painter.device
        return drawn_beside(self._painter, self._rest, camera.to(device), torch.from_numpy(pixel)).numpy()


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
    camera, ways = video.cameras[0], [None, background.beside]
    for image in video.images:
        for _ in range(DRAWN if found else FIRST):
            picture, still = background.draw(camera)
            tried = {way: by_flow(grey_of(image), picture, camera, where=still, beside=way) for way in ways}
            seen = min(filter(None, tried.values()), key=lambda one: one.residual, default=None)
            if seen is None or seen.agreeing < AGREE * seen.matches:
                seen = None
                break
            camera = seen.camera
        if seen is not None:
            ways = [way for way in ways if tried[way] is seen]
        found.append(seen)
        tick(1)
    unseen = tuple(k for k, camera in enumerate(found) if camera is None)
    if 2 * len(unseen) > len(found):
        raise ValueError(
            f"The camera {video.name!r} moves, but {len(unseen)} of its {len(found)} frames show too little of what "
            "stands still in the splat: stand it on a tripod, or film something still and textured, too."
        )
    seen_at = [(time, one) for time, one in zip(video.times, found, strict=True) if one is not None]
    moments, poses = [time for time, _ in seen_at], [one.camera.world_to_camera.double() for _, one in seen_at]
    there, times = torch.linalg.inv(torch.stack(poses)).numpy(), np.clip(video.times, moments[0], moments[-1])
    pose = np.zeros((len(times), 4, 4)) + np.eye(4)
    pose[:, :3, :3] = Slerp(moments, Rotation.from_matrix(there[:, :3, :3]))(times).as_matrix()
    pose[:, :3, 3] = np.stack([np.interp(times, moments, own) for own in there[:, :3, 3].T], 1)
    views = torch.linalg.inv(torch.from_numpy(pose)).to(video.cameras[0].world_to_camera)
    cameras = tuple(replace(seen_at[0][1].camera, world_to_camera=view) for view in views)
    residual = float(torch.tensor([one.residual for _, one in seen_at]).median())
    return replace(video, cameras=cameras), unseen, residual


def gains(video: Footage, background: Background) -> Tensor | None:
    """Brightness of each frame over that of the splat in red, green and blue, float64, shape (F, 3).

    Frames that show too little of the background have those of their neighbours; None if all do.
    """
    found, drawn = [], None
    for camera, image in zip(video.cameras, video.images, strict=True):
        if drawn is not camera:
            drawn = camera
            picture, still = background.draw(camera)
            wanted = 255 * picture.color.cpu().double()
        found.append(gain_of(image.double(), wanted, still).numpy())
    rows, times = np.stack(found), np.array(video.times)
    known = np.isfinite(rows[:, 0])
    if not known.any():
        return None
    return torch.from_numpy(np.stack([np.interp(times, times[known], own[known]) for own in rows.T], 1))


def gain_of(image: Tensor, picture: Tensor, still: Tensor) -> Tensor:
    """The gain of each colour, float64, shape (3,), between a picture and an image of grey levels up to 255 (H, W, 3).

    It is the median over squares of the mask ``still`` (H, W); NaN if there are too few.
    """
    inside = _averaged(still.double()[..., None])[:, 0] == 1
    seen, wanted = _averaged(image), _averaged(picture)
    cut = _averaged((torch.maximum(image, picture) >= BRIGHT).double())
    inside &= ((seen > DARK) & (wanted > DARK) & (cut == 0)).all(1)
    return (seen / wanted)[inside].median(0).values if int(inside.sum()) >= FEWEST_SQUARES else torch.nan * seen[0]


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
                "`hand_held` needs something still and textured in the splat and in the film: use a tripod, or add it."
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
