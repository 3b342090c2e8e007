"""A law of your own: Saint Venant and Kirchhoff's, in torch and inside the compiled kernels.

``python examples/custom_law.py`` compares the two, and the stress with the energy. A YAML names the law as
``material: {law: {class_path: custom_law.SaintVenant, init_args: {factor: 2.0}}}``.
"""

import torch
from torch import Tensor

from gaussian_swaying import ConstitutiveLaw, MaterialPoints, MPMSolver
from gaussian_swaying.geometry.linalg import matmul3
from gaussian_swaying.geometry.linalg_triton import matmul, transpose
from gaussian_swaying.kernels.language import tl, triton  # noqa: F401  (Triton's interpreter looks for tl)
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.twins import Numbers, Twin


class SaintVenant(ConstitutiveLaw):
    """Hooke's law in the Green strain, times a factor."""

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self.factor = factor

    def strain(self, F: Tensor) -> Tensor:
        """The Green strain."""
        return 0.5 * (matmul3(F.mT, F) - torch.eye(3, dtype=F.dtype, device=F.device))

    def energy(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """Energy density [J/m³]."""
        E = self.strain(F)
        trace = E.diagonal(dim1=-2, dim2=-1).sum(-1)
        return self.factor * (mu * E.square().sum((-1, -2)) + 0.5 * lam * trace.square())

    def pk1(self, F: Tensor, mu: Tensor, lam: Tensor, internal: Tensor | None = None) -> Tensor:
        """First Piola-Kirchhoff stress [Pa]: the definition."""
        E = self.strain(F)
        trace = (lam * E.diagonal(dim1=-2, dim2=-1).sum(-1))[..., None, None]
        eye = torch.eye(3, dtype=F.dtype, device=F.device)
        return self.factor * matmul3(F, 2 * mu[..., None, None] * E + trace * eye)

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
    s = p[0]
    stress = (
        s * (mu * (C[0] - 1) + pressure), s * mu * C[1], s * mu * C[2], s * mu * C[3],
        s * (mu * (C[4] - 1) + pressure), s * mu * C[5], s * mu * C[6], s * mu * C[7],
        s * (mu * (C[8] - 1) + pressure),
    )  # fmt: skip
    return matmul(F, stress)


@triton.jit
def kirchhoff(F, mu, lam, internal, p):  # noqa: ANN001, ANN201
    """P F^T."""
    return matmul(pk1(F, mu, lam, internal, p), transpose(F))


def stress_error(law: SaintVenant) -> float:
    """Largest difference between the stress and the derivative of the energy, per largest stress, in torch."""
    F = torch.eye(3, dtype=torch.float64) + 0.2 * torch.randn(50, 3, 3, generator=torch.Generator().manual_seed(0))
    mu, lam = torch.full((2, 50), 4e3, dtype=torch.float64)
    (slope,) = torch.autograd.grad(law.energy(F.requires_grad_(), mu, lam).sum(), F)
    return float((law.pk1(F.detach(), mu, lam) - slope).abs().max() / slope.abs().max())


def main() -> float:
    """Largest difference between kernels and torch after some substeps, per largest F."""
    print(f"error of the stress: {stress_error(SaintVenant(1.5)):.1e}")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    draw = torch.Generator().manual_seed(0)
    place, velocity = 0.06 + 0.18 * torch.rand(40, 3, generator=draw), torch.randn(40, 3, generator=draw)
    points = MaterialPoints.create(
        place.to(device), volume=1e-4, density=50.0, youngs_modulus=1e4, poisson_ratio=0.3, law=SaintVenant(1.5)
    )
    ends = []
    for transfer in ("torch", "kernels"):
        solver = MPMSolver(dx=0.1, transfer=transfer)
        with torch.no_grad():
            ends.append(solver.rollout(solver.init_state(points, velocity.to(device)), 1e-3, 5).F_total)
    difference = float((ends[1] - ends[0]).abs().max() / ends[0].abs().max())
    print(f"kernels and torch differ by {difference:.1e}, at strains up to {SaintVenant().strain(ends[0]).max():.2f}")
    return difference


if __name__ == "__main__":
    assert main() < 2e-5
