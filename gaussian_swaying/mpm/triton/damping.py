"""Stiffness-proportional damping as a Triton function; the reference is :mod:`~gaussian_swaying.mpm.damping`."""

from gaussian_swaying.geometry.linalg_triton import axpy9, matmul, scale9, transpose
from gaussian_swaying.kernels.language import tl, triton  # noqa: F401  (Triton's interpreter looks for tl)


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


@triton.jit
def kelvin_voigt_adjoint(F, rate, Q, mu, lam, time):
    """Gradients of Q : P of :func:`kelvin_voigt_pk1` by F, by the rate, by mu and by lam."""
    e = _symmetric(matmul(transpose(F), rate))
    m = _symmetric(matmul(transpose(F), Q))
    stress = _hooke(e, mu, lam)
    other = _hooke(m, mu, lam)
    by_F = axpy9(time, matmul(Q, stress), time, matmul(rate, other))
    products = m[0] * e[0] + m[4] * e[4] + m[8] * e[8] + 2 * (m[1] * e[1] + m[2] * e[2] + m[5] * e[5])
    traces = (m[0] + m[4] + m[8]) * (e[0] + e[4] + e[8])
    return by_F, scale9(time, matmul(F, other)), 2 * time * products, time * traces


@triton.jit
def _symmetric(a):
    s01 = 0.5 * (a[1] + a[3])
    s02 = 0.5 * (a[2] + a[6])
    s12 = 0.5 * (a[5] + a[7])
    return (a[0], s01, s02, s01, a[4], s12, s02, s12, a[8])


@triton.jit
def _hooke(e, mu, lam):
    """2 mu E + lam tr(E) I."""
    trace = lam * (e[0] + e[4] + e[8])
    two = 2 * mu
    return (
        two * e[0] + trace, two * e[1], two * e[2], two * e[3], two * e[4] + trace, two * e[5],
        two * e[6], two * e[7], two * e[8] + trace,
    )  # fmt: skip
