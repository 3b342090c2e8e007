"""Pictures of a snapshot from the camera of a browser, as large as the machine can keep up with."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.player.session import Snapshot
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.passes import PASSES
from gaussian_swaying.rendering.tints import by_role
from gaussian_swaying.simulation.body import SimulatedScene
from gaussian_swaying.simulation.draw import View

LEAST = 96  # pixels of the shorter side
SIZES = (1.0, 0.75, 0.5, 0.375, 0.25)
MOST_SIDE = 16384  # pixels of a browser's window
FLIP = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))  # to a camera with y down and z forward


@dataclass(frozen=True)
class Eye:
    """The view of a browser.

    Attributes:
        matrix: From the axes of its camera, y up and z backwards, to those of a film, float64, shape (4, 4).
        fov: Vertical field of view [rad].
        near: Nearest depth that is drawn, in units of a film.
        size: Width and height of its window [pixels].
    """

    matrix: Tensor
    fov: float
    near: float
    size: tuple[int, int]

    @classmethod
    def told(cls, message: Mapping[str, Any]) -> Eye:
        """Parse a message with ``matrix`` (column by column), ``fov`` [degrees], ``near`` and ``size``."""
        matrix = torch.tensor(message["matrix"], dtype=torch.float64).reshape(4, 4).T
        fov, near = math.radians(message["fov"]), float(message["near"])
        width, height = (int(side) for side in message["size"])
        if not (bool(matrix.isfinite().all()) and 0 < fov < math.pi and 1e-9 < near < 1e9):
            raise ValueError("the view is not finite")
        if not (0 < width <= MOST_SIDE and 0 < height <= MOST_SIDE):
            raise ValueError(f"the window is not of 1 to {MOST_SIDE} pixels")
        return cls(matrix, fov, near, (width, height))

    def camera(self, scene: SimulatedScene, width: int, height: int) -> Camera:
        """The camera of a picture with so many pixels, in scene units."""
        rotation = scene.frame.rotation.T.cpu().double() @ self.matrix[:3, :3] @ FLIP
        place = scene.frame.point_to_scene(self.matrix[:3, 3] * scene.size * scene.frame.metres_per_unit)
        view = torch.eye(4, dtype=torch.float64)
        view[:3, :3], view[:3, 3] = rotation.mT, -rotation.mT @ place
        focal = 0.5 * height / math.tan(0.5 * self.fov)
        intrinsics = torch.tensor([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]]).double()
        return Camera(view, intrinsics, width, height, self.near * scene.size)


@torch.inference_mode()
def draw(
    snapshot: Snapshot,
    camera: Camera,
    shown: str = "color",
    force_end: float = 1.0,
    roles: Tensor | None = None,
) -> np.ndarray:
    """The picture of a snapshot, uint8, shape (H, W, 3).

    Args:
        force_end: End of the colour scale of the wind force [Pa].
        roles: Roles whose tints the colours get, as in :func:`~gaussian_swaying.rendering.tints.by_role`, shape (N,).
    """
    painter, state = snapshot.simulation.painter, snapshot.state
    means = painter.scene.model.means
    camera, gaussians, colours = camera.to(means.device, means.dtype), painter.deformed(state), None
    if roles is not None and len(roles) == len(gaussians.means):  # not those of a scene that was just replaced
        colours = by_role(painter.colors(gaussians, camera), roles)
    picture = PASSES[shown].draw(View(painter, state, gaussians, camera, colours, True, force_end))
    return (picture.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


@torch.inference_mode()
def under_cursor(snapshot: Snapshot, origin: Sequence[float], direction: Sequence[float]) -> list[float] | None:
    """Position of the first visible Gaussian on a ray [scene units]; None if there is none.

    Args:
        origin: Start of the ray [scene units].
    """
    scene = snapshot.simulation.scene
    means = snapshot.simulation.painter.deformed(snapshot.state).means
    seen = (scene.model.opacity() > 0.2).to(means.device)
    means = in_double(means)
    start = torch.tensor(list(origin), dtype=torch.float64, device=means.device)
    along = torch.nn.functional.normalize(torch.tensor(list(direction), dtype=torch.float64), dim=0).to(means)
    depth = (means - start) @ along
    beside = torch.linalg.vector_norm(means - start - depth[:, None] * along, dim=-1)
    seen &= depth > 0
    if not scene.all_move:
        moves = torch.zeros_like(seen)
        moves[scene.moving.to(moves.device)] = True
        seen &= moves
    near = seen & (beside < 0.02 * scene.size)
    if not bool(near.any()):
        return None
    return [float(x) for x in means[depth.where(near, math.inf).argmin()]]


class PictureSize:
    """Adapts the size of pictures to the time that drawing may take.

    Args:
        seconds: Time that a picture may take [s].
        largest: Most pixels of the longer side.
        level: First index in :data:`SIZES`.
    """

    def __init__(self, seconds: float = 0.08, largest: int = 1920, level: int = 0) -> None:
        self.seconds, self.largest, self._level = seconds, largest, level

    def fit(self, width: int, height: int, still: bool = False) -> tuple[int, int]:
        """Even size for a window, with its aspect ratio; the largest if nothing moves."""
        width, height = max(width, 1), max(height, 1)
        largest = min(1.0, self.largest / max(width, height))
        scale = largest if still else largest * SIZES[self._level]
        scale = min(max(scale, LEAST / min(width, height)), largest)
        return max(2 * round(width * scale / 2), 2), max(2 * round(height * scale / 2), 2)

    def took(self, seconds: float) -> None:
        while seconds > 1.3 * self.seconds and self._level < len(SIZES) - 1:
            seconds *= (SIZES[self._level + 1] / SIZES[self._level]) ** 2  # about as many pixels as it takes time
            self._level += 1
        if seconds < 0.3 * self.seconds and self._level > 0:
            self._level -= 1
