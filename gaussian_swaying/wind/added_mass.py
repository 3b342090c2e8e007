r"""The air that thin, wide things carry along: inertia without weight.

A sheet that is accelerated along its normal accelerates the air around it. To the material points, this air is mass in
proportion to the area of their patches at rest (:func:`with_added_mass`), in all directions: along the sheet a real one
carries hardly any air, but there a sheet hardly gives way. As gravity acts on all mass of the solver, a constant force
takes the weight of the air off again (:class:`AirLift`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from gaussian_swaying._devices import in_double
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.forces import Force
from gaussian_swaying.mpm.state import MaterialPoints, State
from gaussian_swaying.mpm.twins import Numbers, Twin
from gaussian_swaying.wind.force import AeroForce
from gaussian_swaying.wind.patches import Patches


@triton.jit
def steady_force(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):
    """``AirLift``: the numbers of a point are its force; no resistance."""
    return (point[0], point[1], point[2]), point[0] * 0


def carried_mass(patches: Patches, aero: AeroForce) -> Tensor:
    """Mass of the air that the patches of each point carry at rest [kg], shape (P,)."""
    return aero.carried * patches.areas()


def with_added_mass(points: MaterialPoints, patches: Patches, aero: AeroForce) -> MaterialPoints:
    """The material with the air that it carries; the same object if it carries none.

    Args:
        points: The material of one scene.
        patches: Its patches.
        aero: The force of the wind, for ``added_mass`` and ``air_density``.
    """
    if aero.carried == 0:
        return points
    return replace(points, mass=points.mass + carried_mass(patches, aero).to(points.mass))


class AirLift(Force):
    """The weight of carried air, upward, so that gravity pulls at the material alone.

    Args:
        mass: Mass of the air that each point carries [kg], shape (..., P).
        gravity: Acceleration [m/s²].

    Attributes:
        force: Force on each point [N], shape (..., P, 3).

    Example:
        >>> AirLift(torch.tensor([0.5]), [0.0, 0.0, -10.0]).force
        tensor([[-0., -0., 5.]])
    """

    recordable = True

    def __init__(self, mass: Tensor, gravity: Sequence[float]) -> None:
        super().__init__()
        down = torch.tensor(list(gravity), dtype=torch.float64).to(mass)
        self.register_buffer("force", mass.detach()[..., None] * -down)
        self.force: Tensor

    def potential(self, state: State) -> Tensor:
        """Potential energy of the force [J], shape (...) over the batch, float64."""
        return -(in_double(self.force) * in_double(state.position)).sum((-2, -1))

    def twin(self) -> Twin | None:
        return Twin(steady_force, per_point=Numbers(3, lambda: self.force), sources=(self.force,))
