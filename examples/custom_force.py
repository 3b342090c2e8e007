"""A force of your own: air that circles a vertical axis in gusts, one function for torch and the compiled kernels.

``python examples/custom_force.py`` compares the two, and checks the circulation. A YAML names the force as
``forces: [{class_path: custom_force.PointVortex, init_args: {center: [0.1, 0.1], circulation: 3.0}}]``.
"""

import math

import torch
from torch import Tensor

from gaussian_swaying import Force, MaterialPoints, MPMSolver
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers


class PointVortex(Force):
    """Air of a mean circulation [m²/s] about an axis, in gusts of a period [s], that drags [kg/s] particles along."""

    recordable = True

    def __init__(
        self, center: list[float], circulation: float, core: float = 0.2, drag: float = 0.1, period: float = 0.01
    ) -> None:
        super().__init__()
        self.register_buffer("numbers", torch.tensor([*center, core**2]))  # the air is slower within the core [m]
        self.register_buffer("drag", torch.tensor([drag]))
        self.circulation, self.period = circulation, period

    def turn(self, time: Tensor) -> Tensor:
        """The circulation over two pi at times [s] of any shape."""
        return self.circulation / (2 * math.pi) * (1 + 0.5 * torch.sin(2 * math.pi * time / self.period))

    def device_function(self) -> DeviceFunction | None:
        """One number per point (zero where there is none), three for all, one per substep."""

        def turns(time: Tensor, dt: Tensor, steps: int) -> Tensor:
            return self.turn(time + dt * torch.arange(steps, dtype=torch.float64, device=time.device))[:, None]

        numbers = {"per_point": Numbers(1, lambda: self.drag), "numbers": Numbers(3, lambda: self.numbers)}
        return DeviceFunction(
            circling_air, **numbers, per_substep=Numbers(1, turns), sources=(self.drag,), implicit=True
        )


@triton.jit
def circling_air(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):  # noqa: ANN001, ANN201
    """Drag and its resistance."""
    x, y, drag = position[0] - numbers[0], position[1] - numbers[1], point[0]
    turn = now[0] / (x * x + y * y + numbers[2])
    return (drag * (-turn * y - velocity[0]), drag * (turn * x - velocity[1]), -drag * velocity[2]), drag


def main(kind: type[PointVortex] = PointVortex) -> tuple[float, float]:
    """Error of the circulation on a circle, and how far kernels and torch differ after five substeps; both relative."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    angle = 2 * math.pi * torch.arange(100, device=device) / 100
    out, along = (torch.stack([*xy, 0 * angle], -1) for xy in ((angle.cos(), angle.sin()), (-angle.sin(), angle.cos())))
    points = MaterialPoints.create(0.15 + 0.1 * out, volume=1e-4, density=50.0, youngs_modulus=1e4, poisson_ratio=0.3)
    vortices, ends = [kind([0.15, 0.15], 30.0).to(device), kind([0.25, 0.15], -20.0).to(device)], []
    for solver in (MPMSolver(dx=0.1, transfer=transfer) for transfer in ("torch", "kernels")):
        with torch.no_grad():
            ends.append(solver.rollout(solver.init_state(points), 1e-3, 5, vortices).velocity)
    force, drag = vortices[0](MPMSolver(dx=0.1).init_state(points))
    found = 2 * math.pi * 0.1 * float((force * along).sum(-1).mean() / drag[0])
    errors = abs(found / (30.0 * 0.1**2 / (0.1**2 + 0.2**2)) - 1), float((ends[1] - ends[0]).norm() / ends[0].norm())
    print(f"error of the circulation: {errors[0]:.1e}; kernels and torch differ by {errors[1]:.1e}")
    return errors


if __name__ == "__main__":
    assert max(main()) < 2e-5
