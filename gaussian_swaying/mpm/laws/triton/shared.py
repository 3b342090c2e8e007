"""Building blocks of the laws' device functions, as in :mod:`gaussian_swaying.mpm.laws.shared`."""

import math

from gaussian_swaying.geometry.linalg_triton import dot3, largest, largest_eigenvalue, matmul, transpose
from gaussian_swaying.kernels.language import tl, triton
from gaussian_swaying.mpm.laws.shared import LOG_LIMIT
from gaussian_swaying.mpm.laws.shared import ROOT as _ROOT

LOG_FLOOR = tl.constexpr(LOG_LIMIT)
LOG_OF_FLOOR = tl.constexpr(math.log(LOG_LIMIT))
ROOT = tl.constexpr(_ROOT)
EPSILON = tl.constexpr(2**-23)  # of float32


@triton.jit
def log(x):
    """``shared.continued_log``."""
    inside = tl.maximum(x, LOG_FLOOR)
    return tl.log(inside) + (x - inside) / LOG_FLOOR


@triton.jit
def stretch_of_log(x):
    """``shared.stretch_of_log``."""
    return tl.exp(tl.maximum(x, LOG_OF_FLOOR))


@triton.jit
def split_strain(e0, e1, e2):
    """Trace, deviator, its norm and its direction (``shared.split_strain``)."""
    trace = e0 + e1 + e2
    d = (e0 - trace / 3, e1 - trace / 3, e2 - trace / 3)
    squared = dot3(d, d)
    some = squared > 1.4210855e-14  # the square of float32's epsilon, as in the reference
    norm = tl.where(some, tl.sqrt(tl.where(some, squared, 1.0)), 0.0)
    scale = 1.0 / tl.where(some, norm, 1.0)
    return trace, d, norm, (d[0] * scale, d[1] * scale, d[2] * scale)


@triton.jit
def drawn_back(trace, d, direction, flow):
    """Stretches after a flow along the deviator."""
    mean = trace / 3
    return (
        stretch_of_log(d[0] - flow * direction[0] + mean),
        stretch_of_log(d[1] - flow * direction[1] + mean),
        stretch_of_log(d[2] - flow * direction[2] + mean),
    )


@triton.jit
def share_above(x, y, floor):
    """Share of the way from y to x that lies above a floor."""
    gap = x - y
    none = gap == 0
    above = (tl.maximum(x, floor) - tl.maximum(y, floor)) / tl.where(none, 1.0, gap)
    return tl.where(none, tl.where(x < floor, 0.0, 1.0), above)


@triton.jit
def log_difference(x, y):
    """(log x - log y) / (x - y) of the continued logarithm, accurate to round-off also if x is close to y."""
    share = share_above(x, y, LOG_FLOOR)
    x = tl.maximum(x, LOG_FLOOR)
    y = tl.maximum(y, LOG_FLOOR)
    ratio = (x - y) / (x + y)
    w = ratio * ratio
    near = w < 0.04
    # log x - log y = 2 artanh((x - y) / (x + y))
    series = 2 * (1 + w * (1.0 / 3 + w * (1.0 / 5 + w * (1.0 / 7 + w / 9)))) / (x + y)
    slope = tl.where(near, series, tl.log(x / y) / tl.where(near, 1.0, x - y))
    return share * slope + (1 - share) / LOG_FLOOR


@triton.jit
def spectral_modulus(own, first, second, third, mu, lam):
    """``wave`` of ``shared.spectral_moduli``, from H_ii and each H_ij, twist and flip.

    The pairs of axes are (1, 2), (0, 2) and (0, 1).
    """
    rest = 2 * mu + lam
    unit = tl.maximum(rest, 1e-30)  # or the cube of a modulus would overflow
    m0 = first[0] / unit
    m1 = second[0] / unit
    m2 = third[0] / unit
    matrix = (own[0] / unit, m2, m1, m2, own[1] / unit, m0, m1, m0, own[2] / unit)
    bound = largest(unit * largest_eigenvalue(matrix), 2 * mu + 3 * tl.maximum(lam, 0.0))
    bound = largest(bound, largest(first[1], first[2]))
    bound = largest(bound, largest(second[1], second[2]))
    bound = largest(bound, largest(third[1], third[2]))
    wave = largest(largest(own[0], own[1]), largest(own[2], rest))
    wave = largest(wave, largest(first[1] - first[0], first[2] + first[0]))
    wave = largest(wave, largest(second[1] - second[0], second[2] + second[0]))
    wave = largest(wave, largest(third[1] - third[0], third[2] + third[0]))
    return tl.minimum(wave, bound, tl.PropagateNan.ALL)


@triton.jit
def to_principal(u, Q, v):
    """U^T Q V."""
    return matmul(matmul(transpose(u), Q), v)


@triton.jit
def spectral_change(u, v, b, own, first, second, third):
    """The derivative of a stress in a direction, from B = U^T Q V and the arguments of :func:`spectral_modulus`.

    A symmetric part of B off the diagonal is multiplied by flip, a skew one by twist.
    """
    s12 = 0.5 * first[2] * (b[5] + b[7])
    t12 = 0.5 * first[1] * (b[5] - b[7])
    s02 = 0.5 * second[2] * (b[2] + b[6])
    t02 = 0.5 * second[1] * (b[2] - b[6])
    s01 = 0.5 * third[2] * (b[1] + b[3])
    t01 = 0.5 * third[1] * (b[1] - b[3])
    inner = (
        own[0] * b[0] + third[0] * b[4] + second[0] * b[8], s01 + t01, s02 + t02,
        s01 - t01, third[0] * b[0] + own[1] * b[4] + first[0] * b[8], s12 + t12,
        s02 - t02, s12 - t12, second[0] * b[0] + first[0] * b[4] + own[2] * b[8],
    )  # fmt: skip
    return matmul(matmul(u, inner), transpose(v))
