"""A weakly compressible fluid."""

from gaussian_swaying.geometry.linalg_triton import cofactor, determinant
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.shared import FLUID_LIMIT
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.laws.triton.shared import LOG_FLOOR

FLUID_FLOOR = tl.constexpr(FLUID_LIMIT)


@triton.jit
def kirchhoff(F, mu, lam, internal, p):
    """``fluid_kirchhoff``; ``p`` is the exponent."""
    gamma = p[0]
    cof = cofactor(F)
    det = determinant(F, cof)
    bulk = lam + 2.0 / 3.0 * mu
    inside = tl.maximum(det, FLUID_FLOOR)
    power = tl.exp(-gamma * tl.log(inside))
    value = -det * (bulk / gamma * (power - 1) - bulk * power / inside * (det - inside))
    zero = value * 0
    return (value, zero, zero, zero, value, zero, zero, zero, value)


@triton.jit
def flow(a, mu, lam, internal, p, dt):
    """``fluid_flow``."""
    volume = tl.maximum(a[0] * a[1] * a[2], LOG_FLOOR)
    root = tl.exp(tl.log(volume) / 3)
    return (root, root, root), internal


FUNCTIONS = LawFunctions(kirchhoff=kirchhoff, flow=flow)
