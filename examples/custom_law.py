"""A law of your own: Saint Venant and Kirchhoff's. Its energy is all there is to write.

``python examples/custom_law.py`` compares the stress with Hooke's law, and kernels with torch. A YAML names the law as
``material: {law: {class_path: custom_law.SaintVenant, init_args: {factor: 2.0}}}``.
"""

import torch

from gaussian_swaying import ConstitutiveLaw, MaterialPoints, MPMSolver
from gaussian_swaying.kernels.language import tl, triton  # noqa: F401  (Triton's interpreter looks for tl)
from gaussian_swaying.mpm.laws.law import DeviceLaw


@triton.jit
def saint_venant_energy(a, mu, lam, internal, p):  # noqa: ANN001, ANN201
    """Hooke's law in the Green strain (a² - 1) / 2 of the principal stretches a, times a factor [J/m³]."""
    e0 = 0.5 * (a[0] * a[0] - 1)
    e1 = 0.5 * (a[1] * a[1] - 1)
    e2 = 0.5 * (a[2] * a[2] - 1)
    trace = e0 + e1 + e2
    return p[0] * (mu * (e0 * e0 + e1 * e1 + e2 * e2) + 0.5 * lam * (trace * trace))


class SaintVenant(ConstitutiveLaw):
    """Hooke's law in the Green strain, times a factor."""

    device = DeviceLaw(energy=saint_venant_energy)

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self.factor = factor

    @property
    def numbers(self) -> tuple[float, ...]:
        """What ``p`` is."""
        return (self.factor,)


def main(kind: type[SaintVenant] = SaintVenant) -> tuple[float, float]:
    """Error of the stress of the energy, and of kernels against torch after five substeps."""
    draw = torch.Generator().manual_seed(0)
    F = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(50, 3, 3, generator=draw, dtype=torch.float64)
    E = 0.5 * (F.mT @ F - torch.eye(3))
    exact = 1.5 * F @ (8e3 * E + 6e3 * E.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * torch.eye(3))
    mu, lam = (torch.full((50,), value, dtype=torch.float64) for value in (4e3, 6e3))
    wrong = float((kind(1.5).pk1(F, mu, lam) - exact).norm() / exact.norm())
    place = 0.2 * torch.rand(40, 3, generator=draw).to("cuda" if torch.cuda.is_available() else "cpu")
    points = MaterialPoints.create(
        place, volume=1e-4, density=50.0, youngs_modulus=1e4, poisson_ratio=0.3, law=kind(1.5)
    )
    solvers = [MPMSolver(dx=0.1, transfer=transfer) for transfer in ("torch", "kernels")]
    ends = [solver.rollout(solver.init_state(points, 100 * place**2), 1e-3, 5).F_total for solver in solvers]
    apart = float((ends[1] - ends[0]).norm() / ends[0].norm())
    print(f"error of the stress: {wrong:.1e}; kernels and torch differ by {apart:.1e}")
    return wrong, apart


if __name__ == "__main__":
    assert max(main()) < 2e-5
