"""The still background of a splat: what a film shows that neither the fit nor the wind moves."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.fitting.overlap import Overlap
from gaussian_swaying.fitting.registration import SOLID
from gaussian_swaying.fitting.tracks import opencv
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.rendering.protocol import RenderOutput
from gaussian_swaying.simulation.simulation import Simulation

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
