"""Sheets of one layer as Triton functions; the reference is :mod:`~gaussian_swaying.mpm.sheets`."""

from gaussian_swaying.geometry.linalg_triton import (
    add3,
    axpy3,
    axpy9,
    cofactor,
    dot3,
    matvec,
    outer3,
    scale3,
    scale9,
    transpose,
)
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.triton.body import pk1
from gaussian_swaying.mpm.sheets import DIRECTOR, LEAST

_DIRECTOR = tl.constexpr(DIRECTOR)
_LEAST = tl.constexpr(LEAST)


@triton.jit
def flattened(F, n, mu, lam):
    """``sheets.flattened``: F, the direction, the ratios of area and thickness, and the derivative of the latter."""
    turned = matvec(cofactor(F), n)
    area = tl.sqrt(tl.maximum(dot3(turned, turned), _LEAST * _LEAST))
    bulk = tl.maximum(lam, 0.0)
    below = tl.maximum(2 * mu + bulk * area * area, 1e-30)  # a lane without a particle has no stiffness
    thickness = (2 * mu + bulk * area) / below
    thinning = bulk * (1 - 2 * area * thickness) / below
    m = scale3(1 / area, turned)
    across = axpy3(thickness, m, -1.0, matvec(F, n))
    return axpy9(1.0, F, 1.0, outer3(across, n)), m, area, thickness, thinning


@triton.jit
def without_normal(a, n):
    """A matrix A (I - n n^T)."""
    return axpy9(1.0, a, -1.0, outer3(matvec(a, n), n))


@triton.jit
def sheet_pk1(F, n, mu, lam, row, LAWS: tl.constexpr):
    """``sheets.sheet_pk1``, and F in plane stress."""
    flat, m, area, thickness, thinning = flattened(F, n, mu, lam)
    P = pk1(flat, mu, lam, row, LAWS)
    q = matvec(P, n)
    volume = tl.where(dot3(n, n) > 0, area * thickness, 1.0)
    G = scale9(1 / volume, cofactor(flat))
    dual = matvec(transpose(G), q)
    P = axpy9(1.0, P, thinning * area * dot3(q, m), G)
    P = without_normal(axpy9(1.0, P, -thickness, outer3(m, dual)), n)
    out = matvec(F, n)
    c = matvec(transpose(F), out)
    along = dot3(n, c)
    shear = add3(c, -along, n)
    side = add3(matvec(F, shear), along - 1, out)
    own = axpy9(1.0, outer3(out, shear), 1.0, outer3(side, n))
    return axpy9(1.0, P, _DIRECTOR * mu, own), flat
