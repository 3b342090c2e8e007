"""Stiffness-proportional damping as a Triton function; the reference is :mod:`~gaussian_swaying.mpm.damping`."""

import triton
import triton.language as tl  # noqa: F401  (Triton's interpreter needs it)

from gaussian_swaying.geometry.linalg_triton import matmul, scale9, transpose


@triton.jit
def kelvin_voigt_pk1(F, rate, mu, lam, time):
    """``damping.kelvin_voigt_pk1``."""
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
