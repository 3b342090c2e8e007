"""A law of your own: Saint Venant and Kirchhoff's, in torch and inside the compiled kernels.

``python examples/custom_law.py`` compares the two, and the stress with the energy. A YAML names the law as
``material: {law: {class_path: custom_law.SaintVenant, init_args: {factor: 2.0}}}``.
"""

import torch
from torch import Tensor

from gaussian_swaying import ConstitutiveLaw, MaterialPoints, MPMSolver
from gaussian_swaying.geometry.linalg import matmul3
from gaussian_swaying.geometry.linalg_triton import axpy9, matmul, transpose
from gaussian_swaying.kernels.language import tl, triton  # noqa: F401  (Triton's interpreter looks for tl)
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.twins import Numbers, Twin


class SaintVenant(ConstitutiveLaw):
    """Hooke's law in the Green strain, times a factor."""

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self.factor = factor

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """Energy density [J/m³]."""
        E = 0.5 * (matmul3(F.mT, F) - torch.eye(3, dtype=F.dtype, device=F.device))
        return self.factor * (mu * E.square().sum((-1, -2)) + 0.5 * lam * E.diagonal(dim1=-2, dim2=-1).sum(-1).square())

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """First Piola-Kirchhoff stress [Pa]: the definition."""
        mu, pressure = mu[..., None, None], 0.5 * (lam * (F.square().sum((-1, -2)) - 3))[..., None, None]
        return self.factor * (mu * matmul3(F, matmul3(F.mT, F)) + (pressure - mu) * F)

    def moduli(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Bounds on the stiffness [Pa], for the time step."""
        size = F.square().sum((-1, -2)).clamp(min=3)
        return self.factor * (2 * mu + lam) * size, self.factor * (2 * mu + 3 * lam) * size

    def twin(self) -> Twin | None:
        """The same for the kernels, with one number."""
        return Twin(LawFunctions(pk1=pk1, kirchhoff=kirchhoff), numbers=Numbers(1, lambda: [self.factor]))


@triton.jit
def pk1(F, mu, lam, internal, p):  # noqa: ANN001, ANN201
    """As ``SaintVenant.pk1``."""
    C = matmul(transpose(F), F)
    pressure = 0.5 * lam * (C[0] + C[4] + C[8] - 3)
    return axpy9(p[0] * mu, matmul(F, C), p[0] * (pressure - mu), F)


@triton.jit
def kirchhoff(F, mu, lam, internal, p):  # noqa: ANN001, ANN201
    """P F^T."""
    return matmul(pk1(F, mu, lam, internal, p), transpose(F))


def main(kind: type[SaintVenant] = SaintVenant) -> tuple[float, float]:
    """Error of the stress, which is the derivative of the energy, and of kernels against torch after five substeps."""
    draw = torch.Generator().manual_seed(0)
    F = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(50, 3, 3, generator=draw)
    law, (mu, lam) = kind(1.5), torch.tensor([[4e3], [6e3]], dtype=torch.float64).expand(2, 50)
    (slope,) = torch.autograd.grad(law.energy(F.requires_grad_(), mu, lam).sum(), F)
    wrong = float((law.pk1(F.detach(), mu, lam) - slope).norm() / slope.norm())
    place = 0.2 * torch.rand(40, 3, generator=draw).to("cuda" if torch.cuda.is_available() else "cpu")
    points = MaterialPoints.create(place, volume=1e-4, density=50.0, youngs_modulus=1e4, poisson_ratio=0.3, law=law)
    solvers = [MPMSolver(dx=0.1, transfer=transfer) for transfer in ("torch", "kernels")]
    ends = [solver.rollout(solver.init_state(points, 100 * place**2), 1e-3, 5).F_total for solver in solvers]
    apart = float((ends[1] - ends[0]).norm() / ends[0].norm())
    print(f"error of the stress: {wrong:.1e}; kernels and torch differ by {apart:.1e}")
    return wrong, apart


if __name__ == "__main__":
    assert max(main()) < 2e-5
