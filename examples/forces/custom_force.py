"""A force that is compiled. One device function serves torch, the kernels of a CPU and GPU, and pages that simulate."""

import torch

from gaussian_swaying import Force, MaterialPoints, MPMSolver
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.device_functions import DeviceFunction, Numbers


@triton.jit
def circling_air(F, velocity, position, point, numbers, now, table, OPTIONS: tl.constexpr):
    x, y, drag = position[0] - numbers[0], position[1] - numbers[1], point[0]
    turn = numbers[3] / (x * x + y * y + numbers[2])
    return (drag * (-turn * y - velocity[0]), drag * (turn * x - velocity[1]), -drag * velocity[2]), drag


class PointVortex(Force):
    recordable = True

    def __init__(self, center: list[float], circulation: float) -> None:  # m, m²/s
        super().__init__()
        self.register_buffer("numbers", torch.tensor([*center, 0.04, circulation / 6.2832]))  # slower within 0.2 m
        self.register_buffer("drag", torch.tensor([0.1]))  # kg/s

    def device_function(self):
        own = {"per_point": Numbers(1, lambda: self.drag), "numbers": Numbers(4, lambda: self.numbers)}
        return DeviceFunction(circling_air, **own, sources=(self.drag, self.numbers), implicit=True)


if __name__ == "__main__":
    place = 0.05 + 0.2 * torch.rand(300, 3, generator=torch.Generator().manual_seed(0))
    points = MaterialPoints.create(place, volume=1e-4, density=50.0, youngs_modulus=1e4, poisson_ratio=0.3)
    solvers = [MPMSolver(dx=0.1, gravity=(0, 0, 0), transfer=transfer) for transfer in ("torch", "kernels")]
    vortex = PointVortex([0.15, 0.15], 30.0)
    torch_v, kernels_v = (s.rollout(s.init_state(points), 1e-3, 5, vortex).velocity for s in solvers)
    apart = float((torch_v - kernels_v).norm() / torch_v.norm())
    print(f"kernels and torch differ by {apart:.1e}")
    assert apart < 2e-5
