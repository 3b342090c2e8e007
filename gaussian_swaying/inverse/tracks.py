"""Point tracks: Gaussians that a camera sees at rest, followed through its video by Lucas and Kanade's method.

The tracker is OpenCV's pyramidal Lucas-Kanade (Bouguet 2000), frame to frame. A track ends where following it back
does not return to where it came from.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.inverse.videos import Footage
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import Camera, project
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.draw import Painter
from gaussian_swaying.simulation.simulation import Simulation

WINDOW, WIDE = 15, 960
"""Side of the square that is followed, where the longer side of the picture has at most ``WIDE`` [pixels]."""

LARGE = 2.0
"""Standard deviations of Gaussians that are left out, per the side of a window."""


def drawn_beside(painter: Painter, gaussians: DeformedGaussians, camera: Camera, places: Tensor) -> Tensor:
    """Rendered minus projected centres of Gaussians, averaged over windows at places (T, 2) [pixels], float64, (T, 2).

    A picture whose colours are the projected centres shows in each pixel the mean centre of the Gaussians that are seen
    there. The offset of a pixel is its own place minus this. Gaussians larger than windows, as those of a sky, are left
    out.
    """
    side, middle = window_of(camera.width, camera.height), torch.tensor([0.5 * camera.width, 0.5 * camera.height])
    pixel, depth = project(gaussians.means, camera)
    wide = gaussians.covariances.diagonal(dim1=-2, dim2=-1).amax(-1).sqrt().to(depth)
    counts = (wide * float(camera.intrinsics[0, 0]) < LARGE * side * depth) & (depth > camera.near)
    centres = torch.cat([pixel - middle.to(pixel), torch.ones_like(pixel[:, :1])], 1)
    opacity = painter.opacity().detach()
    colours = torch.where(counts[:, None], centres, 0.0).to(opacity)
    with torch.no_grad():
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


LEVELS = 3
BACK = 0.5
"""Largest distance between a point and the one found by following it back [pixels]."""

STILL = 0.5
"""Largest distance that a point moves which stands still [pixels]: noise and compression."""

QUALITY = 0.02
"""Least texture of a point, as a share of the best one: smallest eigenvalue of the structure tensor."""

EDGE = 4.0
"""Least distance from the edges of the picture [pixels]."""

ALIKE = 0.7
"""Least correlation of a point's surroundings in a picture of the splat and in the first frame."""

OPAQUE = 0.3
"""Least opacity of a Gaussian that is followed."""

BEHIND = 0.03
"""Largest depth of a visible Gaussian behind the rendered depth, as a share of the object's size."""

THIN = 0.25
"""Gaussians near the border of the object are left out if at least this share of the visible ones lies a window away
from it. In an object as thin as a window, all are kept."""


@dataclass(frozen=True, eq=False)
class Tracks:
    """Gaussians that were followed in the video of one camera.

    Attributes:
        index: Their indices among the moving Gaussians of the scene, shape (T,).
        position: Position of each in the picture [pixels], float64, shape (F, T, 2).
        seen: Whether the track is still valid, bool, shape (F, T).
    """

    index: Tensor
    position: Tensor
    seen: Tensor


def track(simulation: Simulation, video: Footage, most: int = 400, first: DeformedGaussians | None = None) -> Tracks:
    """Follow the Gaussians that a camera sees in its first frame, those with the most texture.

    Args:
        first: What that frame shows, about, if it is not the scene at rest. The Gaussians are followed from a picture
            of it to the frame; those whose surroundings do not look alike there are not seen.
    """
    chosen, start, drawn = _chosen(simulation, video, most, first)
    images = video.images if first is None else torch.cat([drawn[None], video.images])
    position, seen = map(torch.from_numpy, follow(images.numpy(), start.numpy()))
    if first is None:
        return Tracks(chosen, position, seen)
    seen &= alike(images[:2], position[:2]) > ALIKE
    return Tracks(chosen, position[1:], seen[1:])


def drawn_by(simulation: Simulation, gaussians: DeformedGaussians, camera: Camera) -> Tensor:
    """The picture of some Gaussians in a camera, dtype uint8, shape (H, W, 3)."""
    painter = simulation.painter
    own = camera.to(painter.device)
    with torch.no_grad():
        colour = painter.picture(gaussians, own).color
    return (colour.clamp(0, 1) * 255).round().to(torch.uint8).cpu()


def beside_rest(simulation: Simulation, video: Footage, most: int = 400) -> float:
    """Distance between the splat at rest and the first frame of a video [pixels], of the upper quarter of points.

    A shift of all points alike is a fault of the camera, and left out.
    """
    rest, moving = simulation.scene.rest(), simulation.scene.moving
    found = track(simulation, replace(video, images=video.images[:1]), most, rest)
    means = rest.means[moving[found.index.to(moving.device)]].cpu()
    off = (found.position[0] - project(means, video.cameras[0])[0])[found.seen[0]]
    return float((off - off.median(0).values).norm(dim=-1).quantile(0.75)) if len(off) else 0.0


def alike(images: Tensor, position: Tensor) -> Tensor:
    """Correlation of the surroundings of points in two pictures (2, H, W, 3) at positions (2, T, 2), shape (T,)."""
    side = window_of(images.shape[2], images.shape[1])
    planes = images.double().mean(-1)[:, None]
    height, width = planes.shape[-2:]
    reach = torch.arange(side, dtype=torch.float64) - side // 2
    row, column = torch.meshgrid(reach, reach, indexing="ij")
    places = position[:, :, None] + torch.stack([column, row], -1).reshape(1, 1, -1, 2)
    grid = 2 * places / torch.tensor([width, height], dtype=torch.float64) - 1
    found = torch.nn.functional.grid_sample(planes, grid, padding_mode="border", align_corners=False)[:, 0]
    found = found - found.mean(-1, keepdim=True)
    return (found[0] * found[1]).sum(-1) / (found[0].norm(dim=-1) * found[1].norm(dim=-1)).clamp(min=1e-9)


def still_until(simulation: Simulation, video: Footage, tracks: Tracks) -> float:
    """Time of the last frame before a quarter of the points begins to move [s]; 0 if it moves in the first frames.

    A point has moved if it is more than :data:`STILL` from where the camera of the frame would see it if it had stayed.
    """
    scene = simulation.scene
    means = scene.model.means.detach()[scene.moving[tracks.index.to(scene.moving.device)]]
    off = tracks.position - torch.stack([project(means, camera)[0] for camera in video.cameras])
    moved = (off - off[:1]).norm(dim=-1)
    moved = torch.where(tracks.seen, moved, torch.nan).nanquantile(0.75, dim=1)
    begun = (moved > STILL).nonzero()[:, 0]
    return float(video.times[max(int(begun[0]) - 1, 0)]) if len(begun) else 0.0


def match(
    simulation: Simulation, video: Footage, states: Sequence[State], most: int = 400, moving: bool = False
) -> Tracks:
    """Find the Gaussians of a simulation, which must be within tens of pixels, anew in each frame of the video.

    Where Gaussians overlap, the picture shows mostly the nearest ones. So it shows a Gaussian beside its projected
    centre, by a part of a pixel that depends on the angle of view (:func:`drawn_beside`). A video of the real object
    does not have this offset; one that was rendered from the splat has it, too. The first frame, at rest, shows which
    is the case. The offset that remains there comes from a camera that is not quite right: its median is subtracted in
    all frames, unless the video begins in motion. Gaussians near the border are left out, as the border of a splat is
    not quite that of the real object.

    Args:
        states: The state at the time of each frame; fewer if only the first frames are wanted.
        moving: Whether the video begins in motion.
    """
    import numpy as np

    scene, painter, count = simulation.scene, simulation.painter, len(video.times)
    chosen, *_ = _chosen(simulation, video, most, painter.deformed(states[0]) if moving else None)
    index = scene.moving[chosen.to(scene.moving.device)]
    position = torch.zeros(count, len(chosen), 2, dtype=torch.float64)
    seen = torch.zeros(count, len(chosen), dtype=torch.bool)
    share, shift = 0.0, torch.zeros(2, dtype=torch.float64)
    for k, state in enumerate(states):
        camera = video.cameras[k].to(painter.device)
        with torch.no_grad():
            gaussians = painter.deformed(state)
            picture = painter.picture(gaussians, camera)
        pixel, depth = project(gaussians.means[index], video.cameras[k])
        there = _inside(pixel, picture, _in_sight(pixel, depth, picture, BEHIND * scene.size))
        shown = (picture.color.clamp(0, 1) * 255).round().to(torch.uint8).cpu().numpy()
        pair = np.stack([shown, video.images[k].numpy()])
        found, good = follow(pair, pixel.numpy())
        position[k], seen[k] = torch.from_numpy(found[1]), torch.from_numpy(good[1]) & there
        if k == 0 or share:
            beside = drawn_beside(painter, gaussians, camera, pixel)
            if k == 0 and bool(seen[0].any()):
                share, shift = _at_rest((position[0] - pixel)[seen[0]], beside[seen[0]])
                shift = torch.zeros_like(shift) if moving else shift
            position[k] += share * beside
        position[k] -= shift
    return Tracks(chosen, position, seen)


def _at_rest(off: Tensor, beside: Tensor) -> tuple[float, Tensor]:
    """Return the share of the splat's offsets (T, 2) that a video at rest lacks, 0 to 1, and the median of the rest."""
    share = float((-(off * beside).sum() / beside.square().sum().clamp(min=1e-12)).clamp(0.0, 1.0))
    return share, (off + share * beside).median(0).values


def follow(images: Any, start: Any) -> tuple[Any, Any]:
    """Follow points (T, 2) [pixels; the first pixel's centre is at 0.5] through uint8 frames (F, H, W, ...).

    NumPy arrays: positions, float64, shape (F, T, 2), and whether each is still valid, shape (F, T).
    """
    import numpy as np

    cv2 = opencv()
    count, (height, width) = len(start), images.shape[1:3]
    options = {"winSize": (window_of(width, height),) * 2, "maxLevel": LEVELS}
    options["criteria"] = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 40, 0.001)
    position = np.zeros((len(images), count, 2))
    seen = np.zeros((len(images), count), dtype=bool)
    now = np.ascontiguousarray(start - 0.5, dtype=np.float32)[:, None]
    position[0], seen[0] = now[:, 0] + 0.5, True
    for k in range(1, len(images)):
        if not count:
            break
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
    import numpy as np

    found = opencv().goodFeaturesToTrack(grey, most, quality, apart, mask=mask)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + 0.5


def _chosen(
    simulation: Simulation, video: Footage, most: int, first: DeformedGaussians | None
) -> tuple[Tensor, Tensor, Tensor]:
    """Return Gaussians that are visible at first and have texture around them, a few pixels apart, and their pixels.

    The picture that shows the texture is the first frame, or that of other Gaussians; it is returned, too.
    """
    import numpy as np

    scene, painter, camera = simulation.scene, simulation.painter, video.cameras[0]
    image = video.images[0] if first is None else drawn_by(simulation, first, camera)
    with torch.no_grad():
        first, own = first or scene.rest(), camera.to(painter.device)
        pixel, depth = project(first.means[scene.moving], camera)
        picture = painter.picture(first, own)
    opaque = scene.model.opacity().cpu()[scene.moving.cpu()] > OPAQUE
    place = (_in_sight(pixel, depth, picture, BEHIND * scene.size) & opaque).nonzero()[:, 0]
    column, row = pixel[place].long().unbind(-1)
    width, height = video.size
    texture = torch.from_numpy(np.asarray(opencv().cornerMinEigenVal(_grey(image), 7)))
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


def _grey(images: Tensor) -> Any:
    weights = torch.tensor([0.299, 0.587, 0.114])
    return (images.float() @ weights).round().clamp(0, 255).to(torch.uint8).numpy()


def opencv() -> Any:
    """Import and return ``cv2`` (OpenCV), which tracks points."""
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "A fit and a registration need OpenCV: pip install 'gaussian-swaying[fit]'.", name="cv2"
        ) from error
    return cv2
