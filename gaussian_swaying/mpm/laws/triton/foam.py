"""Foam."""

from gaussian_swaying.geometry.linalg_triton import where3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.laws.triton.hencky import energy, principal, wave
from gaussian_swaying.mpm.laws.triton.shared import ROOT, drawn_back, log, split_strain


@triton.jit
def flow(a, mu, lam, internal, p, dt):
    """``viscoplastic``; ``p`` are the yield stress and the viscosity."""
    yield_stress = p[0]
    viscosity = p[1]
    trace, d, norm, direction = split_strain(log(a[0]), log(a[1]), log(a[2]))
    over = 2 * mu * norm - ROOT * yield_stress
    x = -2 * mu * dt / tl.maximum(viscosity, 1e-30)
    # one minus exp(x) without loss of digits for a short substep
    series = -x * (1 + x * (0.5 + x * (1.0 / 6 + x * (1.0 / 24 + x / 120))))
    relaxed = tl.where(tl.abs(x) < 0.1, series, 1 - tl.exp(x))
    relaxed = tl.where(viscosity > 0, relaxed, 1.0)
    amount = tl.maximum(over, 0.0) * relaxed / (2 * mu)
    return where3(over > 0, drawn_back(trace, d, direction, amount), a), internal


FUNCTIONS = LawFunctions(principal=principal, flow=flow, energy=energy, wave=wave)
