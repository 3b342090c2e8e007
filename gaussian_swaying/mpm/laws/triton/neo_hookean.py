"""Neo-Hookean elasticity."""

import triton
import triton.language as tl

from gaussian_swaying.geometry.linalg_triton import axpy9, cofactor, matmul, transpose
from gaussian_swaying.mpm.laws.triton.shared import LOG_FLOOR, log
from gaussian_swaying.mpm.laws.triton.twin import LawTwin


@triton.jit
def pk1(F, mu, lam, internal, p):
    """``neo_hookean_pk1``."""
    cof = cofactor(F)
    det = F[0] * cof[0] + F[1] * cof[1] + F[2] * cof[2]
    return axpy9(mu, F, (lam * log(det) - mu) / tl.maximum(det, LOG_FLOOR), cof)


@triton.jit
def kirchhoff(F, mu, lam, internal, p):
    """P F^T."""
    return matmul(pk1(F, mu, lam, internal, p), transpose(F))


TWIN = LawTwin(pk1=pk1, kirchhoff=kirchhoff)
