"""Point tracks: Gaussians followed through a video by OpenCV's pyramidal Lucas-Kanade (Bouguet 2000)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.draw import Painter
from gaussian_swaying.simulation.simulation import Simulation

LEVELS = 3
BACK = 0.5  # largest distance between a point and the one found by following it back [pixels]
STILL = 0.5  # largest distance that a point moves which stands still [pixels]: noise and compression
QUALITY = 0.02  # least texture of a point, as a share of the best one: smallest eigenvalue of the structure tensor
EDGE = 4.0  # least distance from the edges of the picture [pixels]
ALIKE = 0.7  # least correlation of a point's surroundings in a picture of the splat and in the first frame
OPAQUE = 0.3  # least opacity of a Gaussian that is followed
BEHIND = 0.03  # largest depth of a visible Gaussian behind the rendered depth, as a share of the object's size
PATCHES = 4  # squares along each side of the object: clusters
THIN = 0.25  # windows over the border are kept if fewer points than this share lie inside
GREY = torch.tensor([0.299, 0.587, 0.114])
WINDOW, WIDE = 15, 960  # side of the square that is followed, in pictures of at most this side [pixels]
LARGE = 2.0  # standard deviations of Gaussians that are left out, per the side of a window


@torch.no_grad()
def drawn_beside(painter: Painter, gaussians: DeformedGaussians, camera: Camera, places: Tensor) -> Tensor:
    """Rendered minus projected centres of Gaussians, averaged over windows at places (T, 2) [pixels], float64, (T, 2).

    A picture whose colours are the projected centres shows in each pixel the mean centre of the Gaussians that are seen
    there. Gaussians larger than windows, as those of a sky, are left out.
    """
    side, middle = window_of(camera.width, camera.height), torch.tensor([0.5 * camera.width, 0.5 * camera.height])
    pixel, depth = project(gaussians.means, camera)
    wide = gaussians.covariances.diagonal(dim1=-2, dim2=-1).amax(-1).sqrt().to(depth)
    counts = (wide * float(camera.intrinsics[0, 0]) < LARGE * side * depth) & (depth > camera.near)
    centres = torch.cat([pixel - middle.to(pixel), torch.ones_like(pixel[:, :1])], 1)
    opacity = painter.opacity().detach()
    colours = torch.where(counts[:, None], centres, 0.0).to(opacity)
    drawn = painter.renderer(gaussians.means, gaussians.covariances, opacity, colours, camera).color.cpu().double()
    y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    mean, weight = drawn.split([2, 1], -1)
    sums = torch.cat([weight * (torch.stack([x, y], -1) - middle) - mean, weight], -1).permute(2, 0, 1)
    averaged = torch.nn.functional.avg_pool2d(sums[None], side, 1, side // 2)[0]
    column, row = (part.clamp(0, most - 1) for part, most in zip(places.long().T, averaged.shape[:0:-1], strict=True))
    off, weight = averaged[:, row, column].mT.split([2, 1], -1)
    return off / weight.clamp(min=1e-6)


def window_of(width: int, height: int) -> int:
    """Side of the square that is followed in a picture of this size [pixels]; odd."""
    return 2 * round(WINDOW // 2 * max(1.0, max(width, height) / WIDE)) + 1


@dataclass(frozen=True, eq=False)
class Tracks:
    """Gaussians of a simulation that were followed in the video of one camera.

    Their indices among the moving ones (T,), positions [pixels], float64, (F, T, 2), and which are still valid (F, T).
    Residuals are multiplied by ``trust`` (F, T).
    """

    simulation: Simulation
    video: Footage
    index: Tensor
    position: Tensor
    seen: Tensor
    trust: Tensor | None = None

    @cached_property
    def rest(self) -> Tensor:
        """Places at rest [scene units], shape (T, 3)."""
        scene = self.simulation.scene
        return scene.model.means.detach()[scene.moving[self.index.to(scene.moving.device)]]

    @cached_property
    def at_rest(self) -> Tensor:
        """Where each frame would have them at rest [pixels], shape (F, T, 2)."""
        return torch.stack([project(self.rest.cpu(), camera)[0] for camera in self.video.cameras])

    @cached_property
    def _follow(self) -> Any:
        scene = self.simulation.scene
        return scene.follow.some(self.index.to(scene.moving.device)).to(scene.moving.device)

    @cached_property
    def _cluster(self) -> Tensor:
        points = self.rest.cpu()
        if len(points) < 3:
            return torch.zeros(len(points), dtype=torch.long)
        centred = (points - points.mean(0)).double()
        flat = centred @ torch.linalg.svd(centred, full_matrices=False)[2][:2].mT
        low, high = flat.amin(0), flat.amax(0)
        cell = ((flat - low) / (high - low).clamp(min=1e-12) * PATCHES).long().clamp(0, PATCHES - 1)
        return cell[:, 0] * PATCHES + cell[:, 1]

    def shown(self, states: Sequence[State]) -> Tensor:
        """Places of the Gaussians in some states [scene units], on the CPU, shape (B, T, 3)."""
        moves = torch.stack([self._follow.motion(state)[0] for state in states]).to(self.rest)
        return (self.rest + self.simulation.scene.frame.displacement_to_scene(moves)).cpu()

    def pixels(self, shown: Tensor, frame: int) -> Tensor:
        """Where a frame would have them [pixels], shape (B, T, 2)."""
        return project(shown.flatten(0, 1), self.video.cameras[frame])[0].unflatten(0, shown.shape[:2])

    def beside(self, shown: Tensor, frame: int) -> tuple[Tensor, Tensor]:
        """Residuals of some states in a frame [pixels], shape (B, R, 2), and their clusters, shape (R,)."""
        seen = self.seen[frame]
        off = self.pixels(shown[:, seen], frame) - self.position[frame, seen]
        return off if self.trust is None else self.trust[frame, seen, None] * off, self._cluster[seen]

    def still_until(self) -> float:
        """Time of the last frame before a quarter of them begins to move [s]; 0 if they move in the first frames."""
        off = self.position - self.at_rest
        moved = (off - off[:1]).norm(dim=-1)
        moved = torch.where(self.seen, moved, torch.nan).nanquantile(0.75, dim=1)
        begun = (moved > STILL).nonzero()[:, 0]
        return float(self.video.times[max(int(begun[0]) - 1, 0)]) if len(begun) else 0.0


def track(simulation: Simulation, video: Footage, most: int = 400, first: DeformedGaussians | None = None) -> Tracks:
    """Follow the Gaussians that a camera sees in its first frame, those with the most texture.

    If that frame shows other Gaussians than those at rest (``first``), they are followed from a picture of them.
    """
    chosen, start, drawn = _chosen(simulation, video, most, first)
    images = video.images if first is None else torch.cat([drawn[None], video.images])
    position, seen = map(torch.from_numpy, follow(images.numpy(), start.numpy()))
    if first is None:
        return Tracks(simulation, video, chosen, position, seen)
    seen &= alike(images[:2], position[:2]) > ALIKE
    return Tracks(simulation, video, chosen, position[1:], seen[1:])


@torch.no_grad()
def picture_of(simulation: Simulation, gaussians: DeformedGaussians, camera: Camera) -> RenderOutput:
    """The picture of Gaussians of a simulation in a camera."""
    return simulation.painter.picture(gaussians, camera.to(simulation.painter.device))


def in_bytes(picture: RenderOutput) -> Tensor:
    """The colours of a picture, dtype uint8, shape (H, W, 3)."""
    return (picture.color.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def alike(images: Tensor, position: Tensor) -> Tensor:
    """Correlation of the surroundings of points in two pictures (2, H, W, 3) at positions (2, T, 2), shape (T,)."""
    cv2, side = opencv(), window_of(images.shape[2], images.shape[1])
    found = []
    for plane, own in zip(images.float().mean(-1).numpy(), (position - 0.5).tolist(), strict=True):
        parts = np.array([cv2.getRectSubPix(plane, (side, side), place) for place in own]).reshape(len(own), side**2)
        found.append(torch.from_numpy(parts - parts.mean(1, keepdims=True)))
    return torch.nn.functional.cosine_similarity(found[0], found[1])


@torch.no_grad()
def match(
    simulation: Simulation, video: Footage, states: Sequence[State], most: int = 400, moving: bool = False
) -> Tracks:
    """Find the Gaussians of a simulation, which must be within tens of pixels, anew in the frame of each of its states.

    Where Gaussians overlap, the picture shows one beside its projected centre (:func:`drawn_beside`); a video of the
    real object does not. The first frame, at rest, shows which is the case. The offset that remains there comes from
    the camera: its median is subtracted in all frames, unless the video begins in motion. Gaussians near the border are
    left out, as the border of a splat is not quite that of the real object.
    """
    scene, painter, count = simulation.scene, simulation.painter, len(video.times)
    chosen, *_ = _chosen(simulation, video, most, painter.deformed(states[0]) if moving else None)
    index = scene.moving[chosen.to(scene.moving.device)]
    position = torch.zeros(count, len(chosen), 2, dtype=torch.float64)
    seen = torch.zeros(count, len(chosen), dtype=torch.bool)
    share, shift = 0.0, torch.zeros(2, dtype=torch.float64)
    for k, state in enumerate(states):
        gaussians = painter.deformed(state)
        picture = picture_of(simulation, gaussians, video.cameras[k])
        pixel, depth = project(gaussians.means[index], video.cameras[k])
        there = _inside(pixel, picture, _in_sight(pixel, depth, picture, BEHIND * scene.size))
        found, good = follow(torch.stack([in_bytes(picture), video.images[k]]).numpy(), pixel.numpy())
        position[k], seen[k] = torch.from_numpy(found[1]), torch.from_numpy(good[1]) & there
        if k == 0 or share:
            beside = drawn_beside(painter, gaussians, video.cameras[k].to(painter.device), pixel)
            if k == 0 and bool(seen[0].any()):
                off, own = (position[0] - pixel)[seen[0]], beside[seen[0]]
                share = float((-(off * own).sum() / own.square().sum().clamp(min=1e-12)).clamp(0.0, 1.0))
                shift = shift if moving else (off + share * own).median(0).values
            position[k] += share * beside
        position[k] -= shift
    return Tracks(simulation, video, chosen, position, seen)


def follow(images: Any, start: Any) -> tuple[Any, Any]:
    """Follow points (T, 2) [pixels; the first pixel's centre is at 0.5] through uint8 frames (F, H, W, ...).

    NumPy arrays: positions, float64, shape (F, T, 2), and whether each is still valid, shape (F, T).
    """
    cv2 = opencv()
    count, (height, width) = len(start), images.shape[1:3]
    stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.001)
    options = {"winSize": (window_of(width, height),) * 2, "maxLevel": LEVELS, "criteria": stop}
    position = np.zeros((len(images), count, 2))
    seen = np.zeros((len(images), count), dtype=bool)
    now = np.ascontiguousarray(start - 0.5, dtype=np.float32)[:, None]
    position[0], seen[0] = now[:, 0] + 0.5, True
    for k in range(1, len(images) if count else 0):
        there, found, _ = cv2.calcOpticalFlowPyrLK(images[k - 1], images[k], now, None, **options)
        back, returned, _ = cv2.calcOpticalFlowPyrLK(images[k], images[k - 1], there, None, **options)
        off = np.linalg.norm((back - now)[:, 0], axis=-1)
        inside = ((there[:, 0] >= 0) & (there[:, 0] <= (width - 1, height - 1))).all(-1)
        good = (found[:, 0] > 0) & (returned[:, 0] > 0) & (off < BACK) & inside
        seen[k] = seen[k - 1] & good
        now = np.where(seen[k][:, None, None], there, now)
        position[k] = now[:, 0] + 0.5
    return position, seen


def corners(grey: Any, most: int, quality: float, apart: float, mask: Any) -> Any:
    """Places with texture within a mask [pixels], at most so many and so far apart, NumPy array, shape (T, 2)."""
    found = opencv().goodFeaturesToTrack(grey, most, quality, apart, mask=mask)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + 0.5


@torch.no_grad()
def _chosen(
    simulation: Simulation, video: Footage, most: int, first: DeformedGaussians | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Gaussians that are visible at first, with texture and a few pixels apart, their pixels, and the picture."""
    scene, camera = simulation.scene, video.cameras[0]
    picture = picture_of(simulation, first or scene.rest(), camera)
    image = video.images[0] if first is None else in_bytes(picture)
    pixel, depth = project((first or scene.rest()).means[scene.moving], camera)
    opaque = scene.model.opacity().cpu()[scene.moving.cpu()] > OPAQUE
    place = (_in_sight(pixel, depth, picture, BEHIND * scene.size) & opaque).nonzero()[:, 0]
    column, row = pixel[place].long().unbind(-1)
    width, height = video.size
    grey = (image.float() @ GREY).round().clamp(0, 255).to(torch.uint8).numpy()
    texture = torch.from_numpy(np.asarray(opencv().cornerMinEigenVal(grey, 7)))
    score = texture[row, column]
    sharpest = texture.max() if scene.all_move else score.amax() if len(score) else 0.0  # not that of a background
    good = score > QUALITY * sharpest
    place, score, column, row = (part[good] for part in (place, score, column, row))
    order = score.argsort(descending=True, stable=True)
    taken = torch.zeros(height + 8, width + 8, dtype=torch.bool)
    kept: list[int] = []
    for k in order.tolist():
        r, c = int(row[k]), int(column[k])
        if len(kept) < most and not taken[r + 4, c + 4]:
            taken[r + 2 : r + 7, c + 2 : c + 7] = True
            kept.append(int(place[k]))
    chosen = torch.tensor(sorted(kept), dtype=torch.long)
    return chosen, pixel[chosen], image


def _in_sight(pixel: Tensor, depth: Tensor, picture: RenderOutput, behind: float) -> Tensor:
    """Mask of points (T, 2) at depths (T,) that lie in a picture, away from its edges, and not behind its surface."""
    expected = (picture.depth / picture.alpha.clamp(min=1e-3))[..., 0].cpu()
    height, width = expected.shape
    inside = (pixel > EDGE).all(-1) & (pixel[:, 0] < width - EDGE) & (pixel[:, 1] < height - EDGE) & (depth > 0)
    column, row = torch.where(inside[:, None], pixel, EDGE).long().unbind(-1)
    return inside & (depth < expected[row, column] + behind)


def _inside(pixel: Tensor, picture: RenderOutput, there: Tensor) -> Tensor:
    """Mask of the points ``there`` whose window contains no border of the object; all of them if hardly any is left."""
    alpha = picture.alpha[..., 0].cpu()
    side = window_of(alpha.shape[1], alpha.shape[0])
    least = -torch.nn.functional.max_pool2d(-alpha[None], side, 1, side // 2)[0]
    column, row = torch.where(there[:, None], pixel, 0.0).long().unbind(-1)
    inside = there & (least[row, column] >= 0.5)
    return inside if int(inside.sum()) >= THIN * int(there.sum()) else there


def opencv() -> Any:
    """Import and return ``cv2`` (OpenCV), which tracks points."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError("A fit needs OpenCV: pip install 'gaussian-swaying[fit]'.", name="cv2") from error
    return cv2
