"""Dry sand."""

from gaussian_swaying.geometry.linalg_triton import where3
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.triton.functions import LawFunctions
from gaussian_swaying.mpm.laws.triton.hencky import energy, principal, wave
from gaussian_swaying.mpm.laws.triton.shared import drawn_back, log, split_strain


@triton.jit
def flow(a, mu, lam, internal, p, dt):
    """``drucker_prager``; ``p`` is the slope of the cone, and 1 with a volume correction, else 0."""
    slope = p[0]
    corrected = p[1]
    given = internal * corrected
    third = given / 3
    l0 = log(a[0])
    l1 = log(a[1])
    l2 = log(a[2])
    trace, d, norm, direction = split_strain(l0 + third, l1 + third, l2 + third)
    excess = norm + slope * (3 * lam + 2 * mu) / (2 * mu) * trace
    grown = tl.exp(third)
    flowed = drawn_back(trace, d, direction, tl.maximum(excess, 0.0))
    new = where3(excess <= 0, (a[0] * grown, a[1] * grown, a[2] * grown), flowed)
    one = a[0] * 0 + 1
    new = where3(trace > 0, (one, one, one), new)
    change = l0 + l1 + l2 - log(new[0]) - log(new[1]) - log(new[2])
    return new, internal + corrected * change


FUNCTIONS = LawFunctions(principal=principal, flow=flow, energy=energy, wave=wave)
