"""Rayleigh damping: rates proportional to the mass, and a viscous stress, which is proportional to the stiffness."""

import math

from torch import Tensor

from gaussian_swaying.geometry.linalg import entries, matrix
from gaussian_swaying.geometry.linalg_triton import matmul, scale9, transpose
from gaussian_swaying.kernels.derive import on_tensors
from gaussian_swaying.kernels.language import triton


def decay_rate(ratio: float, frequency: float) -> float:
    r"""Rate :math:`\alpha = 4 \pi f \zeta` [1/s] at which velocities decay, for a damping ratio at a frequency.

    A mode of circular frequency :math:`\omega` is damped with the ratio :math:`\alpha / (2 \omega)` (Rayleigh damping,
    mass part), so one of twice the frequency has half of it.

    Args:
        frequency: f [Hz].
    """
    return 4 * math.pi * frequency * ratio


@triton.jit
def kelvin_voigt(F, rate, mu, lam, time):
    """Entries of :func:`kelvin_voigt_pk1`."""
    product = matmul(transpose(F), rate)
    trace = lam * (product[0] + product[4] + product[8])
    s01 = mu * (product[1] + product[3])
    s02 = mu * (product[2] + product[6])
    s12 = mu * (product[5] + product[7])
    stress = (
        2 * mu * product[0] + trace, s01, s02, s01, 2 * mu * product[4] + trace, s12, s02, s12,
        2 * mu * product[8] + trace,
    )  # fmt: skip
    return scale9(time, matmul(F, stress))


def kelvin_voigt_pk1(F: Tensor, F_rate: Tensor, mu: Tensor, lam: Tensor, time: float) -> Tensor:
    r"""Viscous first Piola-Kirchhoff stress :math:`\beta F (2 \mu \dot E + \lambda \operatorname{tr}(\dot E) I)` [Pa].

    :math:`E = \tfrac12 (F^T F - I)` is the Green strain, so rigid motion is not damped. About the rest state a mode of
    circular frequency :math:`\omega` is damped with the ratio :math:`\zeta = \beta \omega / 2` (Rayleigh damping,
    stiffness part).

    Args:
        F_rate: Its rate [1/s], shape (..., 3, 3).
        time: :math:`\beta` [s].

    Returns:
        Shape (..., 3, 3).
    """
    return matrix(on_tensors(kelvin_voigt)(entries(F), entries(F_rate), mu, lam, time))


def damped_substep(limit: float, time: float) -> float:
    r"""Substep with stiffness damping that is as stable as ``limit`` is without damping.

    Symplectic Euler with the damping force at the last velocity is stable for
    :math:`\omega^2 (\Delta t^2 + 2 \beta \Delta t) \le 4` (Jury's criterion for one mode).

    Args:
        limit: Substep without damping [s].
        time: :math:`\beta` [s].

    Returns:
        Substep [s].
    """
    return limit if time == 0 else limit**2 / (time + math.sqrt(time**2 + limit**2))
