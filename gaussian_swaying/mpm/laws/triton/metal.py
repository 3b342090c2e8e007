"""Metal and plasticine: the radial return."""

from gaussian_swaying.geometry.linalg_triton import where3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.laws.triton.hencky import energy, principal, wave
from gaussian_swaying.mpm.laws.triton.shared import ROOT, drawn_back, log, split_strain


@triton.jit
def flow(a, mu, lam, internal, p, dt):
    """``von_mises``; ``p`` are the yield stress, its growth, and its least value."""
    yield_stress = p[0]
    hardening = p[1]
    residual = p[2]
    trace, d, norm, direction = split_strain(log(a[0]), log(a[1]), log(a[2]))
    trial = 2 * mu * norm
    line = yield_stress + hardening * internal
    stiffness = 2 * mu + 2.0 / 3.0 * hardening
    floor_flow = (trial - ROOT * residual) / (2 * mu)
    line_flow = (trial - ROOT * line) / tl.where(stiffness > 0, stiffness, 1.0)
    amount = tl.where(stiffness > 0, tl.minimum(line_flow, floor_flow), floor_flow)
    yields = trial > tl.maximum(line, residual) * ROOT
    amount = tl.where(yields, amount, 0.0)
    return where3(yields, drawn_back(trace, d, direction, amount), a), internal + ROOT * amount


FUNCTIONS = LawFunctions(principal=principal, flow=flow, energy=energy, wave=wave)
