"""Pictures of a scene with several copies of its object."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying._turns import in_turn
from gaussian_swaying.gaussians.model import DeformedGaussians
from gaussian_swaying.mpm.state import State
from gaussian_swaying.rendering.cameras.camera import Camera
from gaussian_swaying.simulation.copies import Copies
from gaussian_swaying.simulation.painter import Painter, seen_from
from gaussian_swaying.simulation.simulated_scene import SimulatedScene


class CopiesPainter(Painter):
    """Draws the static Gaussians once and the object once for each copy, all from one splat.

    What is drawn are S static Gaussians, and for each of the B copies M that move and H of parts that are held. Only
    centres, shapes, normals and colours exist for each copy; harmonics and opacities are those of the splat.

    Args:
        scene: As for :class:`Painter`.
        copies: The copies.
        parts: The other arguments of a :class:`Painter`.
    """

    def __init__(self, scene: SimulatedScene, copies: Copies, *parts: Any) -> None:
        super().__init__(scene, *parts)
        self.copies = copies
        count = len(scene.model.means)
        moves, belongs = torch.zeros(count, dtype=torch.bool), torch.zeros(count, dtype=torch.bool)
        moves[scene.moving], belongs[scene.simulated], belongs[scene.carried] = True, True, True
        self.register_buffer("still", (~belongs).nonzero()[:, 0], persistent=False)
        self.register_buffer("held", (belongs & ~moves).nonzero()[:, 0], persistent=False)
        self.still: Tensor
        self.held: Tensor
        means = scene.model.means.detach()[scene.simulated]
        placed = torch.stack([copies.place(k, means) for k in range(len(copies))])
        extent = (placed.amax((0, 1)) - placed.amin((0, 1))).amax()
        alone = (means.amax(0) - means.amin(0)).amax()
        self._size = scene.size + float(extent - alone)
        own, all_of_them = (scene.frame.point_to_sim(in_double(part)) for part in (means, placed))
        middle, before = (0.5 * (part.amin(0) + part.amax(0)) for part in (all_of_them.flatten(0, 1), own))
        self._center = scene.center + scene.frame.displacement_to_scene(middle - before)

    @property
    def center(self) -> Tensor:
        """Centre of all copies at rest [scene units], shape (3,)."""
        return self._center

    @property
    def size(self) -> float:
        """Longest side of all copies at rest [scene units]."""
        return self._size

    def _hits(self, eye: Tensor) -> bool:
        return any(super(CopiesPainter, self)._hits(point) for point in self.copies.in_object(eye).to(eye))

    @in_turn
    def deformed(self, state: State) -> DeformedGaussians:
        """The static Gaussians and those of all copies in a state of shape (B, ...), in scene units."""
        scene, copies, turned = self.scene, self.copies, self.scene.model.view_dependent
        rest = scene.rest()
        kept = ("means", "covariances", "normals", *(["rotations"] if turned else []))
        parts = {name: [getattr(rest, name)[self.still]] for name in kept}
        held = {name: getattr(rest, name)[self.held] for name in kept}
        for number, A in enumerate(copies.rotation):
            moved, A = scene.moved(state.scene(number), rotations=turned), A.to(rest.means)
            own = {name: torch.cat([moved[name], held[name]]) for name in kept}
            parts["means"].append(copies.place(number, own["means"]))
            parts["covariances"].append(A @ own["covariances"] @ A.mT)
            parts["normals"].append(own["normals"] @ A.mT)
            if turned:
                parts["rotations"].append(A @ own["rotations"])
        found: dict[str, Any] = {name: torch.cat(tensors) for name, tensors in parts.items()}
        found.setdefault("rotations", scene.identity.expand(len(found["means"]), 3, 3))
        return DeformedGaussians(**found)

    @in_turn
    def colors(self, gaussians: DeformedGaussians, camera: Camera) -> Tensor:
        """As those of a :class:`Painter`, shape (S + B (M + H), 3); of what is static they are computed once."""
        model, eye = self.scene.model, camera.position.to(gaussians.means)
        still, moving = self._still_colours(camera, eye)
        held = torch.cat([model.sh0[self.held], model.shN[self.held]], 1)
        sizes = [len(self.still), *[len(moving), len(held)] * len(self.copies)]
        given = gaussians.means, gaussians.normals, gaussians.rotations
        _, *groups = zip(*(each.split(sizes) for each in given), strict=True)
        found = [still[self.still]]
        for number, (means, normals, rotations) in enumerate(groups):
            moves = number % 2 == 0
            turned = rotations if model.view_dependent else None
            view, colours = seen_from(moving if moves else held, eye, means, turned)
            found.append(self._shaded(colours, normals, view) if moves else colours)
        return torch.cat(found)

    def opacity(self) -> Tensor:
        """Opacities of the Gaussians that are drawn, shape (S + B (M + H),)."""
        opacity = self.scene.model.opacity()
        own = torch.cat([opacity[self.scene.moving], opacity[self.held]])
        return torch.cat([opacity[self.still], own.repeat(len(self.copies))])
