"""A law of your own: Saint Venant and Kirchhoff's. Its energy is all there is to write; the rest is derived from it.

A YAML names it as ``material: {law: {class_path: custom_law.SaintVenant, init_args: {factor: 2.0}}}``.
"""

import torch

from gaussian_swaying import ConstitutiveLaw
from gaussian_swaying.kernels.language import tl, triton  # noqa: F401  (Triton's interpreter looks for tl)
from gaussian_swaying.mpm.laws.law import DeviceLaw


@triton.jit
def saint_venant_energy(a, mu, lam, internal, p):
    e0, e1, e2 = 0.5 * (a[0] * a[0] - 1), 0.5 * (a[1] * a[1] - 1), 0.5 * (a[2] * a[2] - 1)  # of principal stretches
    trace = e0 + e1 + e2
    return p[0] * (mu * (e0 * e0 + e1 * e1 + e2 * e2) + 0.5 * lam * (trace * trace))  # J/m³


class SaintVenant(ConstitutiveLaw):
    device = DeviceLaw(energy=saint_venant_energy)

    def __init__(self, factor: float = 1.0) -> None:
        super().__init__()
        self.factor = factor

    @property
    def numbers(self) -> tuple[float, ...]:  # what `p` is
        return (self.factor,)


if __name__ == "__main__":
    F = torch.eye(3).double() + 0.2 * torch.randn(50, 3, 3).double()
    E = 0.5 * (F.mT @ F - torch.eye(3))
    exact = 1.5 * F @ (8e3 * E + 6e3 * E.diagonal(dim1=-2, dim2=-1).sum(-1)[:, None, None] * torch.eye(3))
    mu, lam = torch.full((50,), 4e3).double(), torch.full((50,), 6e3).double()
    error = float((SaintVenant(1.5).pk1(F, mu, lam) - exact).norm() / exact.norm())
    print(f"error of the stress: {error:.1e}")
    assert error < 1e-9
