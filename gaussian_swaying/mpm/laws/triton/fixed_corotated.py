"""Fixed corotated elasticity."""

from gaussian_swaying.geometry.linalg_triton import (
    axpy9,
    cofactor,
    cofactor_change,
    determinant,
    dot9,
    largest,
    largest_eigenvalue,
    matmul,
    polar_change,
    polar_rotation,
    transpose,
)
from gaussian_swaying.kernels.language import tl, triton  # noqa: F401  (Triton's interpreter looks for tl)
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions


@triton.jit
def corotated_stress(a, mu, lam):
    """Principal first Piola-Kirchhoff stresses of the fixed corotated energy."""
    pressure = lam * (a[0] * a[1] * a[2] - 1)
    return (
        2 * mu * (a[0] - 1) + pressure * a[1] * a[2],
        2 * mu * (a[1] - 1) + pressure * a[2] * a[0],
        2 * mu * (a[2] - 1) + pressure * a[0] * a[1],
    )


@triton.jit
def principal(a, mu, lam, internal, p):
    """Principal first Piola-Kirchhoff stresses."""
    return corotated_stress(a, mu, lam)


@triton.jit
def pk1(F, mu, lam, internal, p):
    """``fixed_corotated_pk1``."""
    cof = cofactor(F)
    pressure = lam * (determinant(F, cof) - 1)
    return axpy9(2 * mu, axpy9(1.0, F, -1.0, polar_rotation(F)), pressure, cof)


@triton.jit
def kirchhoff(F, mu, lam, internal, p):
    """P F^T."""
    return matmul(pk1(F, mu, lam, internal, p), transpose(F))


@triton.jit
def energy(F, mu, lam):
    """``fixed_corotated_energy``."""
    cof = cofactor(F)
    change = determinant(F, cof) - 1
    off = axpy9(1.0, F, -1.0, polar_rotation(F))
    return mu * dot9(off, off) + 0.5 * lam * change * change


@triton.jit
def wave(F, mu, lam):
    """The first of ``fixed_corotated_moduli``."""
    cof = cofactor(F)
    area = largest_eigenvalue(matmul(transpose(cof), cof))
    return 2 * mu + lam * largest(area, 1.0)


@triton.jit
def adjoint(F, Q, mu, lam):
    """Derivative of :func:`pk1` in the direction Q, and of Q : P by mu and lam."""
    cof = cofactor(F)
    change = determinant(F, cof) - 1
    R = polar_rotation(F)
    growth = dot9(cof, Q)
    bend = axpy9(2 * mu, axpy9(1.0, Q, -1.0, polar_change(F, R, Q)), lam * growth, cof)
    by_mu = 2 * dot9(Q, axpy9(1.0, F, -1.0, R))
    return axpy9(1.0, bend, lam * change, cofactor_change(F, Q)), by_mu, change * growth


FUNCTIONS = LawFunctions(principal=principal, pk1=pk1, kirchhoff=kirchhoff, energy=energy, wave=wave, adjoint=adjoint)
