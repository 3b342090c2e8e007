"""Snow."""

from gaussian_swaying.geometry.linalg_triton import clamp
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.shared import SNOW_RANGE
from gaussian_swaying.mpm.laws.triton.fixed_corotated import corotated_stress
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions

SNOW_LOW = tl.constexpr(SNOW_RANGE[0])
SNOW_HIGH = tl.constexpr(SNOW_RANGE[1])


@triton.jit
def principal(a, mu, lam, internal, p):
    """Principal first Piola-Kirchhoff stresses, with the parameters of ``snow_lame``."""
    factor = tl.exp(p[2] * (1 - clamp(internal, SNOW_LOW, SNOW_HIGH)))
    return corotated_stress(a, mu * factor, lam * factor)


@triton.jit
def flow(a, mu, lam, internal, p, dt):
    """``snow_plasticity``; ``p`` are the critical compression and stretch, and the hardening."""
    low = 1 - p[0]
    high = 1 + p[1]
    kept = (clamp(a[0], low, high), clamp(a[1], low, high), clamp(a[2], low, high))
    lost = a[0] / kept[0] * (a[1] / kept[1]) * (a[2] / kept[2])
    return kept, clamp(internal * lost, SNOW_LOW, SNOW_HIGH)


FUNCTIONS = LawFunctions(principal=principal, flow=flow)
