"""Neo-Hookean elasticity."""

from gaussian_swaying.geometry.linalg_triton import (
    axpy9,
    cofactor,
    cofactor_change,
    determinant,
    dot9,
    matmul,
    transpose,
)
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.laws.triton.shared import LOG_FLOOR, log


@triton.jit
def pk1(F, mu, lam, internal, p):
    """``neo_hookean_pk1``."""
    cof = cofactor(F)
    det = determinant(F, cof)
    return axpy9(mu, F, (lam * log(det) - mu) / tl.maximum(det, LOG_FLOOR), cof)


@triton.jit
def kirchhoff(F, mu, lam, internal, p):
    """P F^T."""
    return matmul(pk1(F, mu, lam, internal, p), transpose(F))


@triton.jit
def adjoint(F, Q, mu, lam):
    """Derivative of :func:`pk1` in the direction Q, and of Q : P by mu and lam."""
    cof = cofactor(F)
    det = determinant(F, cof)
    slope = 1.0 / tl.maximum(det, LOG_FLOOR)
    volume = log(det)
    pressure = (lam * volume - mu) * slope
    curvature = (lam - tl.where(det < LOG_FLOOR, 0.0, lam * volume - mu)) * slope * slope
    growth = dot9(cof, Q)
    change = axpy9(mu, Q, curvature * growth, cof)
    by_mu = dot9(F, Q) - slope * growth
    return axpy9(1.0, change, pressure, cofactor_change(F, Q)), by_mu, volume * slope * growth


FUNCTIONS = LawFunctions(pk1=pk1, kirchhoff=kirchhoff, adjoint=adjoint)
