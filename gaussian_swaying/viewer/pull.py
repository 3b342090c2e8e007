"""A spring between the material around a place and the mouse."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying.geometry.frame import SimFrame
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.state import State
from gaussian_swaying.simulation.body import SimulatedScene

REACH = 0.06  # radius of what is grabbed, as a share of the longest side
QUICK = 40.0  # 1/s: how quickly what is grabbed follows, if nothing else acts on it
STRONGEST = 400.0  # m/s²: largest acceleration of what is grabbed


class Pull(Force):
    """Pulls some particles towards a place, with a spring and a damper that stops it from swinging.

    Args:
        share: Strength with which each particle is pulled, from 0 to 1, shape (P,).
        mass: Mass of each particle [kg], shape (P,).
        offset: From the mean of the pulled particles to each particle [m], shape (P, 3).
        target: Place to which their mean is pulled [m], shape (3,).
        frame: Transform between the scene and metres.
    """

    recordable = True

    def __init__(self, share: Tensor, mass: Tensor, offset: Tensor, target: Tensor, frame: SimFrame) -> None:
        super().__init__()
        self.register_buffer("held", share * mass)
        self.register_buffer("offset", offset)
        self.register_buffer("target", target.clone())
        self.held: Tensor
        self.offset: Tensor
        self.target: Tensor
        self._frame = frame

    @classmethod
    def at(cls, scene: SimulatedScene, state: State, place: Sequence[float]) -> Pull:
        """Make a pull on the particles around a place.

        Args:
            scene: The simulated scene.
            state: Its state now.
            place: The place [scene units].
        """
        position, mass = state.position.detach(), scene.points.mass
        centre = scene.frame.point_to_sim(torch.tensor(list(place), dtype=torch.float64)).to(position)
        reach = REACH * scene.size * scene.frame.metres_per_unit
        distance = torch.linalg.vector_norm(position - centre, dim=-1)
        reach = max(reach, 1.5 * float(distance.amin()))
        share = torch.exp(-((2 * distance / reach) ** 2)).where(distance < reach, 0.0)
        held = share * mass
        mean = (held[:, None] * position).sum(0) / held.sum()
        return cls(share, mass, position - mean, mean, scene.frame)

    def aim(self, place: Sequence[float]) -> None:
        """Set where it pulls to [scene units]."""
        target = self._frame.point_to_sim(torch.tensor(list(place), dtype=torch.float64))
        self.target.copy_(target.to(self.target))

    def forward(self, state: State) -> tuple[Tensor, Tensor]:
        """Force [N], shape (P, 3), and resistance [kg/s], shape (P,)."""
        away = self.target + self.offset - state.position
        pull = QUICK**2 * away
        size = torch.linalg.vector_norm(pull, dim=-1, keepdim=True)
        pull = pull * (STRONGEST / size.clamp(min=STRONGEST))
        damping = 2 * QUICK * self.held
        return self.held[:, None] * pull - damping[:, None] * state.velocity, damping
