"""A force of your own: air that circles a vertical axis in gusts, in torch and inside the compiled kernels.

``python examples/custom_force.py`` compares the two, and checks the circulation. A YAML names the force as
``forces: [{class_path: custom_force.PointVortex, init_args: {center: [0.1, 0.1], circulation: 3.0}}]``.
"""

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from gaussian_swaying import Force, MaterialPoints, MPMSolver
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.state import State
from gaussian_swaying.mpm.twins import Numbers, Twin


class PointVortex(Force):
    """Air that circles a vertical axis, faster and slower in turns, and drags particles along.

    Args:
        center: Where the axis crosses the ground [m].
        circulation: Mean circulation of the air [m²/s].
        core: Radius within which the air slows down [m].
        drag: Force per speed of the air [kg/s].
        period: Of the gusts [s].
    """

    recordable = True

    def __init__(
        self, center: Sequence[float], circulation: float, core: float = 0.2, drag: float = 0.1, period: float = 0.01
    ) -> None:
        super().__init__()
        self.register_buffer("numbers", torch.tensor([*center, core**2]))
        self.register_buffer("drag", torch.tensor([drag]))
        self.circulation, self.period = circulation, period

    def turn(self, time: Tensor) -> Tensor:
        """The circulation over two pi at times [s] of any shape."""
        return self.circulation / (2 * math.pi) * (1 + 0.5 * torch.sin(2 * math.pi * time / self.period))

    def forward(self, state: State) -> tuple[Tensor, Tensor]:
        """Drag and its resistance: the definition."""
        x, y, core = self.numbers.to(state.position)
        x, y = state.position[..., 0] - x, state.position[..., 1] - y
        turn = self.turn(state.time).to(x) / (x * x + y * y + core)
        air = torch.stack([-turn * y, turn * x, torch.zeros_like(x)], dim=-1)
        drag = self.drag.to(x).expand_as(x)
        return drag[..., None] * (air - state.velocity), drag

    def twin(self) -> Twin | None:
        """The same for the kernels: one number per point (zero where there is none), three for all, one per substep."""

        def turns(time: Tensor, dt: Tensor, steps: int) -> Tensor:
            return self.turn(time + dt * torch.arange(steps, dtype=torch.float64, device=time.device))[:, None]

        return Twin(
            circling_air,
            per_point=Numbers(1, lambda: self.drag),
            numbers=Numbers(3, lambda: self.numbers),
            per_substep=Numbers(1, turns),
            sources=(self.drag,),
            implicit=True,
        )


@triton.jit
def circling_air(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):  # noqa: ANN001, ANN201
    """As ``PointVortex.forward``."""
    x = position[0] - numbers[0]
    y = position[1] - numbers[1]
    turn = now[0] / (x * x + y * y + numbers[2])
    drag = point[0]
    return (drag * (-turn * y - velocity[0]), drag * (turn * x - velocity[1]), -drag * velocity[2]), drag


def circulation_error(vortex: PointVortex, radius: float = 0.1) -> float:
    """Relative error of the circulation around a circle about the axis at time zero, in torch."""
    angle = 2 * math.pi * torch.arange(100, dtype=torch.float64) / 100
    along = torch.stack([-angle.sin(), angle.cos(), 0 * angle], -1)
    x, y, core = vortex.numbers.double()
    place = torch.stack([x + radius * angle.cos(), y + radius * angle.sin(), 0 * angle], -1)
    points = MaterialPoints.create(place, volume=1e-4, density=50.0, youngs_modulus=1e4, poisson_ratio=0.3)
    force, drag = vortex(MPMSolver(dx=0.1).init_state(points))
    found = 2 * math.pi * radius * float(((force / drag[:, None]) * along).sum(-1).mean())
    return abs(found / (vortex.circulation * radius**2 / (radius**2 + float(core))) - 1)


def main() -> float:
    """Largest difference between kernels and torch after some substeps, per largest velocity."""
    print(f"error of the circulation: {circulation_error(PointVortex([0.1, 0.1], 30.0)):.1e}")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    place = 0.06 + 0.18 * torch.rand(40, 3, generator=torch.Generator().manual_seed(0)).to(device)
    points = MaterialPoints.create(place, volume=1e-4, density=50.0, youngs_modulus=1e4, poisson_ratio=0.3)
    ends = []
    for transfer in ("torch", "kernels"):
        solver = MPMSolver(dx=0.1, transfer=transfer)
        vortices = [PointVortex([0.1, 0.1], 30.0).to(device), PointVortex([0.2, 0.1], -20.0).to(device)]
        with torch.no_grad():
            ends.append(solver.rollout(solver.init_state(points), 1e-3, 5, vortices).velocity)
    difference = float((ends[1] - ends[0]).abs().max() / ends[0].abs().max())
    print(f"kernels and torch differ by {difference:.1e} of {ends[0].abs().max():.2f} m/s")
    return difference


if __name__ == "__main__":
    assert main() < 2e-5
